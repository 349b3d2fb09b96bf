"""Scans of film in colour: `read_scan`."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

from napari_shadowinv._system.safety import as_file_errors
from napari_shadowinv._typing import AnyArray
from napari_shadowinv.errors import InputError
from napari_shadowinv.io.files import sha256
from napari_shadowinv.io.formats import format_of

__all__ = ["Scan", "read_scan"]

_TO_METRES = {2: 0.0254, 3: 0.01}  # by TIFF's unit of resolution


class Scan(NamedTuple):
    """A colour scan: pixels of shape (H, W, 3), their size in m if it is known, its checksum."""

    pixels: AnyArray
    pixel_size: float | None
    checksum: str


@as_file_errors
def read_scan(path: Path) -> Scan:
    """Read a colour scan of film in its own dtype.

    Raises
    ------
    FileFormatError
        If the file is missing or cannot be read.
    InputError
        If it has no colours.
    """
    file_format = format_of(path)
    content = file_format.read(path) if file_format.is_scan else None
    if not isinstance(content, tuple) or content[0].ndim != 3 or content[0].shape[-1] not in (3, 4):
        raise InputError(f"{path} is no picture in colour: expected a scan in red, green and blue")
    return Scan(content[0][..., :3], _pixel_size(path), sha256(path))


def _pixel_size(path: Path) -> float | None:
    """Return the pixel size by a TIFF's resolution; scanners set none in other formats."""
    import tifffile

    try:
        with tifffile.TiffFile(path) as tiff:
            tags = tiff.pages[0].aspage().tags
            count, per = tags["XResolution"].value
            unit = _TO_METRES[int(tags["ResolutionUnit"].value)]
    except (tifffile.TiffFileError, KeyError):
        return None
    return unit * per / count if count > 0 and count / per > 1 else None
