"""Checksums of a store, so that no damage to its files is read as data.

Each chunk ends with its CRC-32C, which Zarr checks when it unpacks the chunk. Lost and exchanged
files are noticed by checksums in other files: the report of a shot holds the shot's place in the
store, its name and the checksums of its chunks, the folder's ``zarr.json`` holds its own SHA-256
and the checksums of chunks that belong to no shot.

- note them: `seal`, `reseal`, `note_shot`
- compare them: `check_seal`, `check_chunk`, `check_content`, `find_damage`

Stores without a seal, copied by another program, are not checked.

`CheckedStore` checks each file of a Zarr store before it is opened: Zarr itself would wait for
ever for a pipe behind a link, and ask for as much memory as the first bytes of a chunk name,
damaged or not.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import struct
import time
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from enum import IntEnum
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import google_crc32c
import numpy as np
from zarr.abc.store import ByteRequest
from zarr.core.buffer import Buffer, BufferPrototype
from zarr.storage import LocalStore

from napari_shadowinv._system.safety import check_regular, check_size, small_text
from napari_shadowinv.errors import FileFormatError
from napari_shadowinv.io.files import check_promise
from napari_shadowinv.io.shot_columns import PREFIX

_METADATA, _CHUNKS = "zarr.json", "/c/"
# Where the formats of chunks keep the number of texts, and of unpacked bytes.
_TEXTS, _BLOSC = "vlen-utf8", "blosc"


class CheckedStore(LocalStore):
    """Folder that Zarr may only read, and only as far as its files really reach."""

    def __init__(self, root: Path, *, read_only: bool = True) -> None:
        super().__init__(root, read_only=True)
        self._chunks: dict[str, tuple[int, int, tuple[str, ...]]] = {}  # as of `_chunk_of`
        # Distinguishes this store from the shorter one before it grew, where dask keeps both.
        self._opened = time.time_ns()

    async def get(
        self,
        key: str,
        prototype: BufferPrototype | None = None,
        byte_range: ByteRequest | None = None,
    ) -> Buffer | None:
        self._check(key)
        return self._intact(key, await super().get(key, prototype, byte_range), byte_range)

    def get_sync(
        self,
        key: str,
        *,
        prototype: BufferPrototype | None = None,
        byte_range: ByteRequest | None = None,
    ) -> Buffer | None:
        self._check(key)
        buffer = super().get_sync(key, prototype=prototype, byte_range=byte_range)
        return self._intact(key, buffer, byte_range)

    async def get_partial_values(
        self, prototype: BufferPrototype, key_ranges: Iterable[tuple[str, ByteRequest | None]]
    ) -> list[Buffer | None]:
        ranges = list(key_ranges)
        for key, _ in ranges:
            self._check(key)
        return await super().get_partial_values(prototype, ranges)

    def _intact(
        self, key: str, buffer: Buffer | None, byte_range: ByteRequest | None
    ) -> Buffer | None:
        """Return the bytes read from a chunk once they have matched its checksum."""
        is_chunk = _CHUNKS in key and byte_range is None
        if buffer is not None and is_chunk and self._layout is not None:
            check_content(self._layout, key, buffer.to_bytes())
        return buffer

    def _check(self, key: str) -> None:
        path = self.root / key
        name, is_chunk, _ = key.partition(_CHUNKS)
        if is_chunk and self._layout is not None:
            check_chunk(self._layout, key)
        if path.is_dir() or not path.exists():
            return
        check_regular(path, "a file of the store")
        if key == _METADATA:
            check_seal(path, _json(path))
        elif path.name == _METADATA:
            small_text(path, "metadata of the store")
        elif is_chunk:
            self._check_chunk(path, name)
        else:
            check_size(path, path.stat().st_size)

    @cached_property
    def _layout(self) -> Layout | None:
        """The layout of the store's checksums, or None without checksums."""
        file = self.root / _METADATA
        document = _json(file) if file.exists() else {}
        check_seal(file, document)
        return Layout.of(self.root, document)

    def _metadata(self, name: str) -> dict[str, Any]:
        """Return the description of an array, from the folder's own copy where there is one."""
        consolidated = _json(self.root / _METADATA).get("consolidated_metadata") or {"metadata": {}}
        return consolidated["metadata"].get(name) or _json(self.root / name / _METADATA)

    def _check_chunk(self, path: Path, name: str) -> None:
        if name not in self._chunks:
            self._chunks[name] = _chunk_of(self._metadata(name))
        values, size, codecs = self._chunks[name]
        check_size(path, max(size, path.stat().st_size))
        with path.open("rb") as file:
            head = np.frombuffer(file.read(8).ljust(8, b"\0"), "<u4")
        if _TEXTS in codecs:
            check_promise(path, "chunk's", int(head[0]), values)
        elif _BLOSC in codecs:
            check_promise(path, "chunk's", int(head[1]), size)


def describes_arrays(path: Path) -> bool:
    """Return whether a store's folder has its own copy of the descriptions of its arrays."""
    file = path / _METADATA
    return file.exists() and bool(_json(file).get("consolidated_metadata"))


def _json(path: Path) -> dict[str, Any]:
    return dict(json.loads(small_text(path, "metadata of the store")))


def _chunk_of(content: dict[str, Any]) -> tuple[int, int, tuple[str, ...]]:
    """Return the numbers of values and bytes, and the codecs, of each chunk of an array."""
    values = math.prod(content["chunk_grid"]["configuration"]["chunk_shape"])
    kind = content["data_type"]
    if isinstance(kind, dict):
        width = int(kind["configuration"].get("length_bytes", 8))
    else:
        width = 8 if kind == "string" else np.dtype(kind).itemsize
    return values, values * width, tuple(codec["name"] for codec in content["codecs"])


SEAL = "metadata_sha256"  # attribute: checksum of the folder's description
FIXED = "chunk_checksums"  # attribute: checksums of chunks that belong to no shot (JSON)
CHUNKS = "chunks"  # in a shot's report: checksums of its chunks, None of those that are not there
LABELS = "labels"  # in a shot's report: its name and its other labels
PLACE = "place"  # in a shot's report: the store's identifier and the shot's number in it
_CODEC = "crc32c"
_CRC_BYTES = 4
Report = dict[str, Any]

_UNREADABLE = OSError, ValueError, TypeError, struct.error
_READS = 3  # of a shot that another process may be writing again
RECORD = ("status", "report")  # arrays with an entry for each shot that are no fields


class Status(IntEnum):
    """Status of a shot; damage is noticed when a store is opened, and never stored.

    A skipped shot came to a watched folder while another was inverted, and is as empty as a pending
    one.
    """

    PENDING = 0
    DONE = 1
    FAILED = 2
    DAMAGED = 3
    SKIPPED = 4


def seal(document: dict[str, Any]) -> dict[str, Any]:
    """Return the description of a store with its checksum."""
    attributes = {k: v for k, v in document["attributes"].items() if k != SEAL}
    content = {**document, "attributes": attributes}
    text = json.dumps(content, sort_keys=True, separators=(",", ":"))
    checksum = hashlib.sha256(text.encode()).hexdigest()
    return {**document, "attributes": {**attributes, SEAL: checksum}}


def reseal(document: dict[str, Any]) -> dict[str, Any]:
    """Return the changed description of a store with its new checksum, if it had one."""
    return seal(document) if is_sealed(document) else document


def is_sealed(document: Mapping[str, Any]) -> bool:
    """Return whether a store has checksums."""
    return SEAL in document.get("attributes", {})


def check_seal(path: Path, document: dict[str, Any]) -> None:
    """Refuse a description of a store that has changed since it was written."""
    if is_sealed(document) and seal(document)["attributes"][SEAL] != document["attributes"][SEAL]:
        raise FileFormatError(
            f"{path} is damaged: its content does not match its checksum; copy the store again, or "
            "repeat the run with overwriting"
        )


@dataclass(frozen=True)
class Layout:
    """The arrays of a store with checksums, by how their chunks are noted."""

    root: Path
    store_id: str
    arrays: Mapping[str, Mapping[str, Any]] = field(repr=False)
    fixed: Mapping[str, str]  # checksums of chunks that belong to no shot

    @classmethod
    def of(cls, root: Path, document: Mapping[str, Any]) -> Layout | None:
        """Return the layout of a store, or None for a store without checksums."""
        if not is_sealed(document):
            return None
        arrays, attributes = document["consolidated_metadata"]["metadata"], document["attributes"]
        return cls(root, attributes["store_id"], arrays, json.loads(attributes[FIXED]))

    @classmethod
    def of_open(cls, root: Path, store_id: str, arrays: Mapping[str, Any]) -> Layout:
        """Return the layout of open Zarr arrays, of a store with or without checksums."""
        described = {name: array.metadata.to_dict() for name, array in arrays.items()}
        return cls(root, store_id, described, {})

    @cached_property
    def shots(self) -> int:
        return int(self.arrays["status"]["shape"][0])

    @cached_property
    def _lengths(self) -> dict[str, int]:
        """Number of shots in a chunk of each array with values of shots."""
        return {
            name: int(array["chunk_grid"]["configuration"]["chunk_shape"][0])
            for name, array in self.arrays.items()
            if _has_shots(array)
        }

    @cached_property
    def of_each_shot(self) -> tuple[str, ...]:
        """Arrays with a chunk for each shot, but for its record."""
        lengths = self._lengths.items()
        return tuple(name for name, length in lengths if length == 1 and name not in RECORD)

    @cached_property
    def of_many_shots(self) -> dict[str, int]:
        """Number of shots in a chunk of each array with the values of many."""
        return {name: length for name, length in self._lengths.items() if length > 1}

    def key(self, name: str, index: int) -> str:
        """Return the key of a chunk by its first number; along other axes there is one."""
        return "/".join([name, "c", str(index), *["0"] * (len(self.arrays[name]["shape"]) - 1)])


def _has_shots(description: Mapping[str, Any]) -> bool:
    return bool((description.get("dimension_names") or [None])[0] == "shot")


def fixed_keys(document: Mapping[str, Any]) -> Iterator[str]:
    """Yield the keys of chunks that belong to no shot; such an array has one."""
    for name, array in document["consolidated_metadata"]["metadata"].items():
        if not _has_shots(array) and array["node_type"] == "array":
            yield "/".join([name, "c", *["0"] * len(array["shape"])])


def is_along_shots(array: Any) -> bool:
    """Return whether an open Zarr array has a value for each shot."""
    return tuple(array.metadata.dimension_names or ())[:1] == ("shot",)


def chunk_file(root: Path, array: Any, index: int) -> Path:
    """Return the file of a shot's chunk of an open Zarr array."""
    key = array.metadata.encode_chunk_key((index, *[0] * (array.ndim - 1)))
    return Path(root, array.basename, key)


def note_shot(
    layout: Layout, arrays: Mapping[str, Any], index: int, copied: Collection[str]
) -> dict[str, Any]:
    """Return a shot's place, labels and the checksums of its written chunks, for its report.

    Arrays that are `copied` from reports are no labels.
    """
    label_names = (name for name in layout.of_many_shots if name not in copied)
    labels = {name: np.asarray(arrays[name][index]).tolist() for name in label_names}
    chunks = {}
    for name in layout.of_each_shot:
        if all(codec["name"] != _CODEC for codec in layout.arrays[name]["codecs"]):
            return {}  # its chunks do not end with their checksums
        chunks[name] = stored_checksum(chunk_file(layout.root, arrays[name], index))
    return {CHUNKS: chunks, LABELS: labels, PLACE: [layout.store_id, index]}


def stored_checksum(file: Path) -> str | None:
    """Return the checksum at the end of a chunk, None where there is no chunk."""
    try:
        check_regular(file, "a file of the store")
        with file.open("rb") as chunk:
            size = chunk.seek(0, os.SEEK_END)
            chunk.seek(max(0, size - _CRC_BYTES))
            return chunk.read().hex()
    except (FileFormatError, FileNotFoundError):
        if os.path.lexists(file):
            raise
        return None


def _read_chunk(file: Path) -> bytes | None:
    """Return the bytes of a chunk without their checksum, None where there is no chunk."""
    if stored_checksum(file) is None:
        return None
    check_size(file, file.stat().st_size)
    raw = file.read_bytes()
    if not _is_intact(raw):
        raise FileFormatError("its content does not match its checksum")
    return raw[:-_CRC_BYTES]


def _is_intact(raw: bytes) -> bool:
    content, checksum = raw[:-_CRC_BYTES], raw[-_CRC_BYTES:]
    return struct.pack("<I", google_crc32c.value(content)) == checksum


def _read_status(root: Path, index: int) -> int:
    content = _read_chunk(root / "status" / "c" / str(index))
    return content[0] if content else 0


def _read_report(root: Path, index: int) -> dict[str, Any]:
    """Return the report of a shot, empty where there is none."""
    content = _read_chunk(root / "report" / "c" / str(index)) or bytes(8)
    count, length = struct.unpack("<II", content[:8])
    if count > 1 or length > len(content) - 8:
        raise FileFormatError(f"its header implies {max(count, length)} bytes or texts")
    return dict(json.loads(content[8 : 8 + length] or b"{}"))


def check_chunk(layout: Layout, key: str) -> None:
    """Refuse a chunk that is lost or was exchanged; the `FileFormatError` names a damaged shot."""
    name, index = _name_and_index(key)
    problem = ""
    if name in layout.of_each_shot:
        problem, _ = _check_again(partial(_inspect_shot, layout, index, (name,)))
    elif name not in RECORD:
        problem = _chunk_problem(layout, key, every_byte=False)
    if problem:
        raise _damage_error(layout, key, problem)


def check_content(layout: Layout, key: str, raw: bytes) -> None:
    """Refuse a chunk, `raw`, that has changed since it was written; otherwise as `check_chunk`."""
    if not _is_intact(raw):
        name, _ = _name_and_index(key)
        damaged = f"its {name}" if name in layout.of_each_shot else key
        problem = f"{damaged} is damaged (its content does not match its checksum)"
        raise _damage_error(layout, key, problem)


def _name_and_index(key: str) -> tuple[str, int]:
    """Return the array of a chunk, and the first of the chunk's numbers."""
    name, _, place = key.partition(_CHUNKS)
    return name, int(place.partition("/")[0])


def _damage_error(layout: Layout, key: str, problem: str) -> FileFormatError:
    name, index = _name_and_index(key)
    advice = "resume its run, or copy the store again"
    if name in layout.of_each_shot:
        label = f"shot {index}"
        with suppress(OSError, ValueError, KeyError, TypeError):
            label = f"{label} ({_read_report(layout.root, index)[LABELS]['name']})"
        problem, advice = f"{label}: {problem}", "resume its run to invert it again"
    return FileFormatError(f"{layout.root} is damaged: {problem}; {advice}")


def _check_again(inspect: Callable[[], tuple[str, Report]]) -> tuple[str, Report]:
    """Repeat a check that fails, because the shot may be being written at this moment."""
    problem, report = inspect()
    for _ in range(_READS - 1):
        if problem:
            problem, report = inspect()
    return problem, report


def _inspect_shot(
    layout: Layout, index: int, names: Sequence[str], every_byte: bool = False
) -> tuple[str, Report]:
    """Describe the damage to a shot that has ended, empty if there is none; return its report."""
    part = "report"  # that is read, for the message
    try:
        report = _read_report(layout.root, index)
        if CHUNKS not in report:
            part = "status"
            status = _read_status(layout.root, index)
            lacks = status == Status.DONE or (status == Status.FAILED and "reason" not in report)
            return "its report is missing" if lacks else "", report
        if report.get(PLACE) != [layout.store_id, index]:
            return "its report was written for another shot", report
        for part in names:
            file = layout.root / layout.key(part, index)
            if stored_checksum(file) != report[CHUNKS].get(part):
                state = "not the one that was written" if file.exists() else "missing"
                return f"its {part} is {state}", report
            if every_byte:
                _read_chunk(file)
    except _UNREADABLE as error:
        return f"its {part} is damaged ({error})", {}
    return "", report


def _inspect_ended(
    layout: Layout, index: int, names: Sequence[str], every_byte: bool
) -> tuple[str, Report]:
    """As `_inspect_shot`, but find nothing in a shot that has not ended."""
    try:
        if _read_status(layout.root, index) not in (Status.DONE, Status.FAILED):
            return "", {}
    except _UNREADABLE as error:
        return f"its status is damaged ({error})", {}
    return _inspect_shot(layout, index, names, every_byte)


def _chunk_problem(layout: Layout, key: str, every_byte: bool) -> str:
    """Describe the damage to a chunk that belongs to no single shot; empty if there is none."""
    file = layout.root / key
    try:
        checksum = stored_checksum(file)
        if checksum is None:
            return f"{key} is missing"
        if checksum != layout.fixed.get(key, checksum):
            return f"{key} is not the file that was written"
        if every_byte:
            _read_chunk(file)
    except OSError as error:
        return f"{key} is damaged ({error})"
    return ""


@dataclass(frozen=True)
class Damage:
    """Damage to a store."""

    # Shots that have ended and cannot be trusted, with the reason.
    shots: dict[int, str] = field(default_factory=dict)
    files: tuple[str, ...] = ()  # damage to files that belong to no single shot, in words
    keys: frozenset[str] = frozenset()  # of damaged chunks among them
    # Values in the report of each sound shot that has ended, by the arrays that repeat them.
    noted: dict[int, dict[str, Any]] = field(default_factory=dict)


def find_damage(layout: Layout, *, every_byte: bool = False) -> Damage:
    """Look for files of a store that are lost, exchanged or damaged.

    With `every_byte` all files are read, otherwise only reports and the checksums of chunks.
    """
    names = layout.of_each_shot
    shots: dict[int, str] = {}
    noted: dict[int, dict[str, Any]] = {}
    for index in range(layout.shots):
        problem, report = _check_again(partial(_inspect_ended, layout, index, names, every_byte))
        if problem:
            shots[index] = problem
        elif report:
            values = {**report, **report.get(LABELS, {})}
            repeated = [k for k in values if k in layout.of_many_shots or k.startswith(PREFIX)]
            noted[index] = {key: values[key] for key in repeated}
    keys: list[str] = []
    for name, length in layout.of_many_shots.items():
        keys += [layout.key(name, index) for index in range(-(-layout.shots // length))]
    keys.extend(layout.fixed)
    damaged = {key: text for key in keys if (text := _chunk_problem(layout, key, every_byte))}
    problems = [*damaged.values()]
    if every_byte:
        problems += filter(None, (_description_problem(layout, name) for name in layout.arrays))
    return Damage(shots, tuple(problems), frozenset(damaged), noted)


def _description_problem(layout: Layout, name: str) -> str:
    """Compare an array's own description, by which some programs go, with the folder's copy."""
    file = layout.root / name / "zarr.json"
    expected = dict(layout.arrays[name])
    try:
        metadata = json.loads(small_text(file, "metadata of an array"))
        # A process that was killed while the store grew may have changed the length.
        metadata["shape"] = [*expected["shape"][:1], *metadata["shape"][1:]]
        is_intact = _as_comparable_text(metadata) == _as_comparable_text(expected)
        return "" if is_intact else f"{name}/zarr.json is damaged"
    except (OSError, ValueError, KeyError, TypeError):
        return f"{name}/zarr.json is damaged or missing"


def _as_comparable_text(description: Mapping[str, Any]) -> str:
    """Return a description as text, without empty entries, which are optional."""
    filled = {key: value for key, value in description.items() if value not in (None, {}, [])}
    return json.dumps(filled, sort_keys=True)
