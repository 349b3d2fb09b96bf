"""Writing a store of many shots: create it, add shots to it, write each.

- create a store without shots: `create_store`
- make room for shots, all pending: `grow_store`
- write a shot, or why it failed, also in a worker: `ShotWriter`

The folder's own ``zarr.json`` holds a copy of every array's shape, and who opens the store goes
by that copy. So a store changes its length in one moment: when that one file is replaced.
"""

from __future__ import annotations

import json
import os
import secrets
import shutil
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import zarr
from zarr.codecs import BloscCodec, Crc32cCodec

from napari_shadowinv._system.hidden_files import hidden_name
from napari_shadowinv._system.machine import defer_interrupts
from napari_shadowinv.errors import FileFormatError, RunInterruptedError
from napari_shadowinv.io.files import replacing
from napari_shadowinv.io.store import (
    FORMAT,
    STATUS_NAMES,
    StackStore,
    read_attributes,
)
from napari_shadowinv.io.store_damage import Status, chunk_file, fields_of, is_along_shots

if TYPE_CHECKING:
    import xarray

_OF_SHOTS = ("shot", "name")  # coordinates of the shots
_TOGETHER = 1024  # of their values are one file


@contextmanager
def _as_store_errors(path: Path) -> Iterator[None]:
    """Turn an error of the file system into one with its reason and advice."""
    try:
        yield
    except RunInterruptedError:
        raise
    except OSError as error:
        if isinstance(error, FileNotFoundError) and not (path / "zarr.json").exists():
            raise RunInterruptedError(
                f"{path} was removed or moved while it was being written: put it back and run "
                "again to resume, or start again with another name"
            ) from error
        raise RunInterruptedError(
            f"{path} cannot be written ({error.strerror or error}): free some disk space or check "
            "the folder's permissions, then run again to resume"
        ) from error


@dataclass(frozen=True)
class ShotWriter:
    """Writer of shots into an existing store; it can be sent to a worker."""

    path: Path
    store_id: str  # another store may have taken its place
    shots: int  # it may have had fewer when this process opened it before

    @classmethod
    def of(cls, store: StackStore) -> ShotWriter:
        return cls(store.path, store.attributes.get("store_id", ""), len(store.names))

    def write(
        self,
        index: int,
        arrays: Mapping[str, Any],
        report: Mapping[str, Any],
        status: int = Status.DONE,
    ) -> None:
        """Write a shot and its report; it has its status when this returns, pending if it fails."""
        if read_attributes(self.path).get("store_id", "") != self.store_id:
            raise RunInterruptedError(
                f"{self.path} is missing or is not the store the run started with: all workers "
                "must share one file system, and the store must not be replaced during the run"
            )
        group = self.arrays()
        with _as_store_errors(self.path):
            for name, array in fields_of(group).items():
                if name in arrays or status == Status.DONE:  # one that is not there has been lost
                    values = arrays.get(name, array.fill_value)
                    array[index : index + 1] = np.broadcast_to(values, (1, *array.shape[1:]))
                else:  # without its chunk, it is read as the fill value
                    chunk_file(self.path, array, index).unlink(missing_ok=True)
            group["report"][index : index + 1] = np.array([json.dumps(report)], dtype=object)
            group["status"][index : index + 1] = np.int8(status)

    def reopen(self, index: int) -> None:
        """Mark a shot as pending that is to be done again, and forget its report and fields."""
        group = self.arrays()
        with _as_store_errors(self.path):
            group["status"][index : index + 1] = np.int8(Status.PENDING)
            for name in ("report", *fields_of(group)):
                chunk_file(self.path, group[name], index).unlink(missing_ok=True)

    def arrays(self) -> dict[str, Any]:
        return _open_arrays(self.path, self.store_id, self.shots)


def _open_to_write(path: Path) -> dict[str, Any]:
    # Also chunks that are empty: one that is not there has been lost.
    return {
        name: array.with_config({"write_empty_chunks": True})
        for name, array in zarr.open_group(path, mode="r+").arrays()
    }


@lru_cache(maxsize=4)
def _open_arrays(path: Path, store_id: str, shots: int) -> dict[str, Any]:
    return _open_to_write(path)


def create_store(path: Path, empty: xarray.Dataset, *, overwrite: bool = False) -> StackStore:
    """Create a store of a dataset without shots; it appears completely or not at all.

    The run must hold the store's lock.
    """
    if path.exists() and not overwrite:
        raise FileFormatError(f"{path} exists: resume it, overwrite it, or choose another name")
    new, old = hidden_name(path, ".new"), hidden_name(path, ".old")
    for leftover in (new, old):  # by a killed process
        shutil.rmtree(leftover, ignore_errors=True)
    try:
        with _as_store_errors(path):
            # Zarr writes in a thread of its own, which would go on behind our back.
            with defer_interrupts():
                _write_template(new, empty)
            if path.exists():
                os.replace(path, old)
            os.replace(new, path)
            shutil.rmtree(old, ignore_errors=True)
    finally:
        shutil.rmtree(new, ignore_errors=True)
    return StackStore(path)


def remove_unfinished(path: Path) -> None:
    """Remove the halves of chunks and of its description that killed processes left in a store.

    The run must hold the store's lock. A worker of an earlier run that still writes loses its
    chunk, and its shot stays pending.
    """
    for folder, _, names in os.walk(path):
        for name in names:
            if name.endswith(".partial") or name.startswith(".zarr.json."):
                Path(folder, name).unlink(missing_ok=True)


def grow_store(path: Path, names: Sequence[str]) -> None:
    """Make room for more shots, pending; a process killed meanwhile leaves the store unchanged."""
    # The store is longer once its description is replaced.
    with _as_store_errors(path), _changing_description(path) as metadata:
        arrays = _open_to_write(path)
        longer = [name for name, array in arrays.items() if is_along_shots(array)]
        before = metadata["consolidated_metadata"]["metadata"]["status"]["shape"][0]
        length = before + len(names)
        for name in longer:
            array = arrays[name]
            # Beyond the end stated in the folder's own copy: nobody sees it yet.
            if array.shape[0] < length:
                array.resize((length, *array.shape[1:]))
            metadata["consolidated_metadata"]["metadata"][name]["shape"][0] = length
        arrays["shot"][before:length] = np.arange(before, length)
        arrays["name"][before:length] = np.array(names, np.dtypes.StringDType())


@contextmanager
def _changing_description(path: Path) -> Iterator[dict[str, Any]]:
    """Yield the description of a store, and replace it when the block ends well."""
    document = json.loads((path / "zarr.json").read_text(encoding="utf-8"))
    yield document
    with replacing(path / "zarr.json", overwrite=True) as draft:
        # Without indentation, which takes ten times as long, for each shot of a watched folder.
        draft.write_text(json.dumps(document), encoding="utf-8")


def _write_template(path: Path, empty: xarray.Dataset) -> None:
    status = {
        "units": "1",
        "long_name": "Status of the shot",
        "flag_values": list(range(len(STATUS_NAMES))),
        "flag_meanings": " ".join(STATUS_NAMES),
    }
    report = {"units": "1", "long_name": "Report, or reason for failure (JSON)"}
    record = {
        "status": ("shot", np.empty(0, np.int8), status),
        "report": ("shot", np.empty(0, np.dtypes.StringDType()), report),
    }
    identity = {"format": FORMAT, "store_id": secrets.token_hex(8)}
    template = empty.assign(record).assign_attrs(identity)
    encoding = {name: _encoding(str(name), each) for name, each in template.variables.items()}
    with warnings.catch_warnings():
        # The warning is that other programs may not know this: they read the arrays' own metadata.
        warnings.simplefilter("ignore")
        template.to_zarr(path, zarr_format=3, consolidated=True, encoding=encoding)


def _encoding(name: str, variable: xarray.Variable, small: int = 64) -> dict[str, Any]:
    """Return how an array is stored; `small` chunks are not worth compressing."""
    # A chunk is one file. Names and numbers of the shots are in few files, with room for new ones;
    # other values along the shots in a file for each.
    first = [_TOGETHER if name in _OF_SHOTS else 1] if variable.dims[:1] == ("shot",) else []
    chunks = (*first, *(max(1, length) for length in variable.shape[len(first) :]))
    is_plain = variable.dtype.kind == "T" or np.prod(chunks) <= small
    # Fields compress well once their slowly changing bytes are next to each other.
    fields = BloscCodec(cname="zstd", clevel=3, shuffle="shuffle")
    return {
        "chunks": chunks,
        "compressors": [Crc32cCodec()] if is_plain else [fields, Crc32cCodec()],
        "write_empty_chunks": True,
        "_FillValue": None,
        **({"fill_value": np.nan} if variable.dtype.kind == "f" else {}),
        **({"dtype": bool} if variable.dtype.kind == "b" else {}),
    }
