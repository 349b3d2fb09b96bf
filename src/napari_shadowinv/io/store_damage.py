"""Damage to a store: chunks that are lost, or that do not match the checksum at their end.

Zarr compares each chunk with its CRC-32C when it unpacks it, but reads one that is not there as
empty. So a finished shot writes all its chunks, also empty ones: what is not there has been lost.

- look for damage: `find_damage`
- read values, with one sentence about a damaged file: `read_values`, `as_dask`
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from enum import IntEnum
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from napari_shadowinv._system.safety import as_file_errors
from napari_shadowinv._typing import AnyArray
from napari_shadowinv.errors import FileFormatError

if TYPE_CHECKING:
    import xarray

RECORD = ("status", "report")  # arrays with an entry for each shot that are no fields


class Status(IntEnum):
    """Status of a shot; damage is noticed when a store is opened, and never stored."""

    PENDING = 0
    DONE = 1
    FAILED = 2
    DAMAGED = 3


@dataclass(frozen=True)
class Damage:
    """Damage to a store, and the record of its shots."""

    shots: Mapping[int, str]  # shots that cannot be trusted, with the reason
    files: tuple[str, ...]  # damage to files that belong to no single shot, in words
    statuses: list[int]  # of each shot, damaged or not
    reports: list[str]  # the same, as JSON


def is_along_shots(array: Any) -> bool:
    """Return whether an open Zarr array has a value for each shot."""
    return tuple(array.metadata.dimension_names or ())[:1] == ("shot",)


def fields_of(arrays: Mapping[str, Any]) -> dict[str, Any]:
    """Return the open Zarr arrays with a chunk for each shot, but for its record."""
    return {
        name: array
        for name, array in arrays.items()
        if is_along_shots(array) and array.chunks[0] == 1 and name not in RECORD
    }


def chunk_file(path: Path, array: Any, index: int) -> Path:
    """Return the file of a chunk by its first number; along other axes there is one."""
    numbers = (index, *[0] * (array.ndim - 1))[: array.ndim]
    return Path(path, array.basename, array.metadata.encode_chunk_key(numbers))


@as_file_errors
def read_values(path: Path, values: Any, which: Any = ...) -> AnyArray:
    """Return some stored values; an error names their `path`."""
    return np.asarray(values[which])


class _Chunks:
    """Values of an array as dask reads them, so that an error names the damaged chunk."""

    def __init__(self, path: Path, variable: xarray.Variable) -> None:
        self.path, self.variable = path, variable
        self.shape, self.dtype, self.ndim = variable.shape, variable.dtype, variable.ndim
        # xarray before 2026 reads texts at once.
        self.chunks = variable.encoding.get("chunks", variable.shape)

    def __getitem__(self, key: tuple[Any, ...]) -> AnyArray:
        first = next(iter(key), 0)
        number = (first.start or 0) if isinstance(first, slice) else first
        chunk = number // next(iter(self.chunks), 1)
        return read_values(self.path / "c" / str(chunk), self.variable, key)


def as_dask(path: Path, variable: xarray.Variable) -> xarray.Variable:
    """Return a variable whose values, stored in `path`, dask reads by their chunks."""
    da: Any = import_module("dask.array")
    # Without a name by content: a store that has grown is another one.
    meta = np.empty((0,) * variable.ndim, variable.dtype)
    values = _Chunks(path, variable)
    return variable.copy(
        data=da.from_array(values, chunks=values.chunks, name=False, fancy=False, meta=meta)
    )


def find_damage(
    path: Path, arrays: Mapping[str, Any], *, every_byte: bool, is_copy: bool
) -> Damage:
    """Look for lost or damaged chunks of a store with these open Zarr arrays.

    With `every_byte` all chunks are unpacked, otherwise only the shots' records. Another program
    may have left out the empty chunks of a copy.
    """

    def problem(array: Any, index: int) -> str:
        if not is_copy and not chunk_file(path, array, index).is_file():
            return "is missing"
        return _problem_of_chunk(path, array, index) if every_byte else ""

    shots: dict[int, str] = {}
    statuses, reports = (_record(path, arrays[name], shots) for name in RECORD)
    fields = fields_of(arrays)
    for index in range(len(statuses)):
        if index in shots or statuses[index] not in (Status.DONE, Status.FAILED):
            continue
        problems = {"report": "" if reports[index] else "is missing"}
        if statuses[index] == Status.DONE:
            problems |= {name: problem(array, index) for name, array in fields.items()}
        for name, text in problems.items():
            if text:
                shots[index] = f"its {name} {text}"
    files = []
    for name in sorted(arrays.keys() - fields.keys() - {*RECORD}):
        array = arrays[name]
        for index in range(-(-array.shape[0] // array.chunks[0]) if is_along_shots(array) else 1):
            if text := problem(array, index):
                file = chunk_file(path, array, index).relative_to(path)
                files.append(f"{file.as_posix()} {text}")
    statuses = [Status.DAMAGED if k in shots else each for k, each in enumerate(statuses)]
    return Damage(shots, tuple(files), statuses, reports)


def _record(path: Path, array: Any, damaged: dict[int, str]) -> list[Any]:
    """Return the status or report of each shot; add those that are `damaged`, None here."""
    with suppress(FileFormatError):
        return list(read_values(path, array).tolist())
    values = []
    for index in range(array.shape[0]):
        text = _problem_of_chunk(path, array, index)
        if text:
            damaged[index] = f"its {array.basename} {text}"
        values.append(None if text else np.asarray(array[index]).tolist())
    return values


def _problem_of_chunk(path: Path, array: Any, index: int) -> str:
    """Return how a chunk is damaged, in words; empty if it can be unpacked."""
    first = index * array.chunks[0] if array.ndim else 0
    which = slice(first, first + array.chunks[0]) if array.ndim else ...
    try:
        read_values(path, array, which)
    except FileFormatError as error:
        reason = str(error.__cause__ or error).partition(". ")[0]  # without the two checksums
        return f"is damaged ({reason})"
    return ""
