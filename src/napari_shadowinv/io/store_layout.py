"""Layout of a store of many shots: `create_store` creates it, `grow_store` makes it longer.

The folder's own ``zarr.json`` holds a copy of every array's shape, and who opens the store goes
by that copy. So a store changes its length in one moment: when that one file is replaced.
"""

from __future__ import annotations

import json
import os
import secrets
import shutil
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from napari_shadowinv._system.hidden_files import hidden_name, sweep
from napari_shadowinv._system.machine import defer_interrupts
from napari_shadowinv._typing import AnyArray
from napari_shadowinv.errors import FileFormatError
from napari_shadowinv.io.files import replacing
from napari_shadowinv.io.store import (
    FORMAT,
    STATUS_NAMES,
    StackStore,
    is_along_shots,
    kind_of_shots,
    open_to_write,
    store_error,
)
from napari_shadowinv.io.store_checksums import FIXED, fixed_keys, reseal, seal, stored_checksum
from napari_shadowinv.io.store_columns import columns_of

_TOGETHER = 1024  # values of a coordinate along shots that are one file
_SMALL = 64  # values that are not worth compressing


@dataclass(frozen=True)
class Variable:
    """Array of a store to create."""

    dims: tuple[str, ...]
    dtype: Any
    attributes: Mapping[str, Any]  # its units and long name
    values: AnyArray | None = None  # written at once; without, it is written shot by shot

    @property
    def along_shots(self) -> bool:
        return self.dims[:1] == ("shot",)


@dataclass(frozen=True)
class Contents:
    """Content of a store to create: arrays, lengths of dimensions, attributes of all shots."""

    sizes: Mapping[str, int]
    variables: Mapping[str, Variable]
    coordinates: Mapping[str, Variable]
    attributes: Mapping[str, Any]


def create_store(path: Path, contents: Contents, *, overwrite: bool = False) -> StackStore:
    """Create a store with all its shots pending; it appears completely or not at all."""
    if path.exists() and not overwrite:
        raise FileFormatError(f"{path} exists: resume it, overwrite it, or choose another name")
    sweep(path.parent)
    new = hidden_name(path)
    try:
        # Zarr writes in a thread of its own, which would go on behind our back.
        with defer_interrupts():
            _write_template(new, contents)
        if path.exists():
            old = hidden_name(path)
            os.replace(path, old)
            os.replace(new, path)
            shutil.rmtree(old, ignore_errors=True)
        else:
            os.replace(new, path)
    except OSError as error:
        raise store_error(path, error) from error
    finally:
        shutil.rmtree(new, ignore_errors=True)
    return StackStore(path)


def remove_unfinished(path: Path) -> None:
    """Remove the halves of chunks that killed processes left in a store.

    The run must hold the store's lock. A worker of an earlier run that still writes loses its
    chunk, and its shot stays pending.
    """
    for folder, _, names in os.walk(path):
        for name in names:
            if name.endswith(".partial"):
                Path(folder, name).unlink(missing_ok=True)


def grow_store(
    path: Path, length: int, values: Mapping[str, AnyArray], attributes: Mapping[str, Any]
) -> StackStore:
    """Make room for more shots, pending; a process killed meanwhile leaves the store unchanged.

    The coordinates, `values`, are of all `length` shots.
    """
    try:
        arrays = open_to_write(path)
    except OSError as error:
        raise store_error(path, error) from error
    before = arrays["status"].shape[0]
    new = {name: array[before:] for name, array in values.items()}
    lengthen(path, arrays, length, new, attributes)
    return StackStore(path)


def lengthen(
    path: Path,
    arrays: Mapping[str, Any],
    length: int,
    values: Mapping[str, AnyArray],
    attributes: Mapping[str, Any],
) -> None:
    """Grow a store whose arrays are open; the coordinates, `values`, are of the new shots."""
    longer = [name for name, array in arrays.items() if is_along_shots(array)]
    file = path / "zarr.json"
    try:
        metadata = json.loads(file.read_text(encoding="utf-8"))
        for name in longer:
            array = arrays[name]
            before = array.shape[0]
            # Beyond the end stated in the folder's own copy: nobody sees it yet.
            array.resize((length, *array.shape[1:]))
            if name in values:
                array[length - len(values[name]) :] = values[name]
            elif (
                array.chunks[0] > 1
                and (before - 1) // array.chunks[0] < (length - 1) // (array.chunks[0])
            ):
                array[before:] = array.fill_value  # a file that is not there has been lost
        metadata["attributes"].update(attributes)
        for name in longer:
            metadata["consolidated_metadata"]["metadata"][name]["shape"][0] = length
        # From here on the store is longer.
        with replacing(file, overwrite=True) as draft:
            draft.write_text(json.dumps(reseal(metadata), indent=2), encoding="utf-8")
    except OSError as error:
        raise store_error(path, error) from error


def _write_template(path: Path, contents: Contents) -> None:
    import zarr

    extra = [name for name in contents.coordinates if name not in contents.sizes]
    group = zarr.create_group(
        path,
        zarr_format=3,
        attributes={
            **contents.attributes,
            "format": FORMAT,
            "store_id": secrets.token_hex(8),
            "coordinates": " ".join(extra),
        },
    )
    shot_variables = _shot_variables(contents.sizes["shot"], contents.attributes)
    arrays = {**contents.coordinates, **contents.variables, **shot_variables}
    for name, variable in arrays.items():
        _create_array(group, name, variable, contents.sizes)
    with warnings.catch_warnings():
        # The warning is that other programs may not know this: they read the arrays' own metadata.
        warnings.simplefilter("ignore")
        zarr.consolidate_metadata(path)
    file = path / "zarr.json"
    document = json.loads(file.read_text(encoding="utf-8"))
    fixed = {key: stored_checksum(path / key) for key in fixed_keys(document)}
    document["attributes"][FIXED] = json.dumps(fixed)
    file.write_text(json.dumps(seal(document), indent=2), encoding="utf-8")


def _shot_variables(shots: int, attributes: Mapping[str, Any]) -> dict[str, Variable]:
    """Return the variables that every store has for its shots."""
    status = {
        "units": "1",
        "long_name": "Status of the shot",
        "flag_values": list(range(len(STATUS_NAMES))),
        "flag_meanings": " ".join(STATUS_NAMES),
    }
    report = {"units": "1", "long_name": "Report, or reason for failure (JSON)"}
    variables = {
        "status": Variable(("shot",), np.dtype("int8"), status),
        "report": Variable(("shot",), str, report),
    }
    for column in columns_of(kind_of_shots(attributes)):
        dtype = str if column.kind is str else np.dtype(column.kind)
        fill: AnyArray = np.full(shots, column.fill, dtype=column.dtype)
        variables[column.key] = Variable(("shot",), dtype, column.labels, fill)
    return variables


def _create_array(group: Any, name: str, variable: Variable, sizes: Mapping[str, int]) -> None:
    from zarr.codecs import BloscCodec, Crc32cCodec

    shape = tuple(sizes[dim] for dim in variable.dims)
    chunks = _chunks(variable, shape)
    is_text = variable.dtype is str
    is_float = not is_text and np.dtype(variable.dtype).kind == "f"
    # Fields compress well once their slowly changing bytes are next to each other.
    fields = BloscCodec(cname="zstd", clevel=3, shuffle="shuffle")
    is_plain = is_text or np.prod(chunks) <= _SMALL
    array = group.create_array(
        name,
        shape=shape,
        chunks=chunks,
        dtype=variable.dtype,
        fill_value="" if is_text else np.nan if is_float else 0,
        compressors=[Crc32cCodec()] if is_plain else [fields, Crc32cCodec()],
        dimension_names=variable.dims,
        attributes=dict(variable.attributes),
        config={"write_empty_chunks": True},
    )
    if variable.values is not None:
        array[...] = variable.values


def _chunks(variable: Variable, shape: tuple[int, ...]) -> tuple[int, ...]:
    """Return the shape of a chunk, which is one file."""
    if not variable.along_shots:
        return tuple(max(1, length) for length in shape)
    # Values of the start are in few files, with room for new shots; others in a file for each shot.
    return (1 if variable.values is None else _TOGETHER, *shape[1:])
