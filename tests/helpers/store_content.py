"""The content of a store, byte by byte."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

# Values that are new in each run
_ATTRIBUTES = ("created", "store_id")
_ENTRIES = ("seconds", "stages")  # of a shot's report


def content(store: Path, *names: str) -> dict[str, bytes]:
    """Return the files with the values of shots."""
    return {
        str(path.relative_to(store)): path.read_bytes()
        for name in names or ("potential", "displacement", "caustic", "status")
        for path in sorted((store / name / "c").rglob("*"))
        if path.is_file()
    }


def whole_content(store: Path) -> dict[str, Any]:
    """Return every file, without what is new in each run: times and the store's identifier."""
    files: dict[str, Any] = {}
    for path in sorted(filter(Path.is_file, store.rglob("*"))):
        key, raw = path.relative_to(store).as_posix(), path.read_bytes()
        files[key] = raw
        if key == "zarr.json":
            document = json.loads(raw)
            for name in _ATTRIBUTES:
                document["attributes"].pop(name)
            files[key] = json.dumps(document)  # with the order of its entries
        elif key.startswith("report/c/"):
            (length,) = struct.unpack("<I", raw[4:8])
            report = json.loads(raw[8 : 8 + length] or b"{}")
            entries = {k: v for k, v in report.items() if k not in _ENTRIES}
            files[key] = json.dumps(entries)
        elif key.startswith("seconds/c/"):
            files[key] = "times"
    return files
