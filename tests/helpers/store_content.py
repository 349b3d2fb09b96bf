"""The content of a store, byte by byte."""

from __future__ import annotations

from pathlib import Path


def content(store: Path, *names: str) -> dict[str, bytes]:
    """Return the files with the values of shots."""
    return {
        str(path.relative_to(store)): path.read_bytes()
        for name in names or ("potential", "displacement", "caustic", "status")
        for path in sorted((store / name / "c").rglob("*"))
        if path.is_file()
    }
