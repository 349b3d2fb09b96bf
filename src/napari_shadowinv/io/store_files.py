"""Files of a Zarr store, each checked before it is opened: `CheckedStore`.

Zarr itself would wait for ever for a pipe behind a link, and ask for as much memory as the first
bytes of a chunk name, damaged or not.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from zarr.abc.store import ByteRequest
from zarr.core.buffer import Buffer, BufferPrototype
from zarr.storage import LocalStore

from napari_shadowinv._system.safety import check_regular, check_size, small_text
from napari_shadowinv.io.files import check_promise
from napari_shadowinv.io.store_checksums import Layout, check_chunk, check_content, check_seal

_METADATA, _CHUNKS = "zarr.json", "/c/"
# Where the formats of chunks keep the number of texts, and of unpacked bytes.
_TEXTS, _BLOSC = "vlen-utf8", "blosc"


class _Chunk(NamedTuple):
    """Size and codecs of each chunk of an array."""

    values: int
    value_bytes: int
    codecs: tuple[str, ...]


class CheckedStore(LocalStore):
    """Folder that Zarr may only read, and only as far as its files really reach."""

    def __init__(self, root: Path, *, read_only: bool = True) -> None:
        super().__init__(root, read_only=True)
        self._chunks: dict[str, _Chunk] = {}
        self._layout: tuple[Layout | None] | None = None
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
        name, is_chunk, place = key.partition(_CHUNKS)
        if buffer is not None and is_chunk and byte_range is None:
            layout = self._sealed_layout()
            if layout is not None:
                index = int(place.partition("/")[0])
                check_content(layout, key, name, index, buffer.to_bytes())
        return buffer

    def _check(self, key: str) -> None:
        path = self.root / key
        name, is_chunk, place = key.partition(_CHUNKS)
        if is_chunk and (layout := self._sealed_layout()) is not None:
            check_chunk(layout, key, name, int(place.partition("/")[0]))
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

    def _sealed_layout(self) -> Layout | None:
        """Return the layout of the store's checksums, or None without checksums."""
        if self._layout is None:
            file = self.root / _METADATA
            document = _json(file) if file.exists() else {}
            check_seal(file, document)
            self._layout = (Layout.of(self.root, document),)
        return self._layout[0]

    def _metadata(self, name: str) -> dict[str, Any]:
        """Return the description of an array, from the folder's own copy where there is one."""
        consolidated = _json(self.root / _METADATA).get("consolidated_metadata") or {"metadata": {}}
        return consolidated["metadata"].get(name) or _json(self.root / name / _METADATA)

    def _check_chunk(self, path: Path, name: str) -> None:
        if name not in self._chunks:
            self._chunks[name] = _chunk_of(self._metadata(name))
        chunk = self._chunks[name]
        size = chunk.values * chunk.value_bytes
        check_size(path, max(size, path.stat().st_size))
        with path.open("rb") as file:
            head = np.frombuffer(file.read(8).ljust(8, b"\0"), "<u4")
        if _TEXTS in chunk.codecs:
            check_promise(path, "chunk's", int(head[0]), chunk.values)
        elif _BLOSC in chunk.codecs:
            check_promise(path, "chunk's", int(head[1]), size)


def describes_arrays(path: Path) -> bool:
    """Return whether a store's folder has its own copy of the descriptions of its arrays."""
    file = path / _METADATA
    return file.exists() and bool(_json(file).get("consolidated_metadata"))


def _json(path: Path) -> dict[str, Any]:
    return dict(json.loads(small_text(path, "metadata of the store")))


def _chunk_of(content: dict[str, Any]) -> _Chunk:
    shape = content["chunk_grid"]["configuration"]["chunk_shape"]
    kind = content["data_type"]
    if isinstance(kind, dict):
        width = int(kind["configuration"].get("length_bytes", 8))
    else:
        width = 8 if kind == "string" else np.dtype(kind).itemsize
    return _Chunk(math.prod(shape), width, tuple(codec["name"] for codec in content["codecs"]))
