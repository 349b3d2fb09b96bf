"""Raw frames of cameras: PCO's ``.b16``, and ``.spe`` 2.x and 3.0 of Princeton Instruments.

imageio reads ``.spe``, too, but takes the times between the frames of 3.0 for pixels, and knows
neither doubles nor bytes.

References
----------
pco.edge User Manual, appendix A4, Image File Formats.

Teledyne Princeton Instruments, SPE 3.0 File Format Specification, 4411-0140 (2019).
"""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from napari_shadowinv._system.safety import check_size
from napari_shadowinv._typing import AnyArray
from napari_shadowinv.errors import FileFormatError
from napari_shadowinv.io.files import check_promise

_B16_HEADER, _B16_EXTENDED_HEADER = 24, 128
_SPE_HEADER = 4100
_SPE_FIELDS = np.dtype(
    {
        "names": ["width", "code", "height", "footer", "frames", "version"],
        "formats": ["<u2", "<i2", "<u2", "<u8", "<i4", "<f4"],
        "offsets": [42, 108, 656, 678, 1446, 1992],
        "itemsize": _SPE_HEADER,
    }
)
_SPE_TYPES = {0: "<f4", 1: "<i4", 2: "<i2", 3: "<u2", 5: "<f8", 6: "u1", 8: "<u4"}
_SPE_TIMES = 64  # bytes behind a frame of version 3, at most


def read_b16(path: Path) -> tuple[AnyArray, dict[str, Any]]:
    """Read a frame of a PCO camera: counts as uint16, shape (H, W), and ``bits``."""
    with path.open("rb") as file:
        header = file.read(_B16_EXTENDED_HEADER)
    check_promise(path, "PCO", _B16_HEADER, len(header))
    _, start, width, height, extended = struct.unpack("<5i", header[4:_B16_HEADER])
    if start < _B16_HEADER:
        raise ValueError(f"its PCO header gives its length as {start} bytes")
    is_colour = struct.unpack_from("<i", header, 24)[0] == 1 if len(header) >= 28 else False
    if extended == -1 and start >= _B16_EXTENDED_HEADER and is_colour:
        raise FileFormatError(
            f"{path} comes from a colour camera, whose pixels have different colour filters: "
            "expected a monochrome frame; convert it to a greyscale TIFF"
        )
    return _read_frame(path, "PCO", start, (height, width), np.dtype("<u2")), {"bits": 16}


class _Spe(NamedTuple):
    """Layout of the frames of an SPE file."""

    frames: int
    shape: tuple[int, int]
    dtype: np.dtype[Any]
    stride: int  # bytes from one frame to the next, which may hold times after its pixels
    version: float


def read_spe(path: Path, number: int = 0) -> tuple[AnyArray, dict[str, Any]]:
    """Read a frame in its own dtype, shape (H, W), with ``bits``, ``version``."""
    layout = _spe_layout(path)
    start = _SPE_HEADER + number * layout.stride
    array = _read_frame(path, "SPE", start, layout.shape, layout.dtype)
    return array, {"bits": 8 * array.dtype.itemsize, "version": round(layout.version, 2)}


def count_spe(path: Path) -> int:
    """Return the number of frames."""
    return _spe_layout(path).frames


def _spe_layout(path: Path) -> _Spe:
    with path.open("rb") as file:
        header = file.read(_SPE_HEADER)
    check_promise(path, "SPE", _SPE_HEADER, len(header))
    fields = np.frombuffer(header, _SPE_FIELDS)[0]
    width, height, frames, code, footer = (
        int(fields[name]) for name in ("width", "height", "frames", "code", "footer")
    )
    version = float(fields["version"])
    if code not in _SPE_TYPES:
        raise ValueError(f"its data type is {code}, which no SPE file has")
    dtype = np.dtype(_SPE_TYPES[code])
    stride = size = height * width * dtype.itemsize
    if frames < 1:
        raise ValueError(f"it holds {frames} frames")
    if version >= 3:  # the XML behind all frames begins where they end
        check_promise(path, "SPE", footer, path.stat().st_size)
        stride = (footer - _SPE_HEADER) // frames
        if stride < size:
            raise ValueError("its XML begins within its frames")
        if stride > size + _SPE_TIMES:
            raise FileFormatError(
                f"{path} holds several regions of the sensor in a frame: expected one; export the "
                "region you need as TIFF"
            )
    end = _SPE_HEADER + (frames - 1) * stride + size
    check_promise(path, "SPE", end, path.stat().st_size)
    return _Spe(frames, (height, width), dtype, stride, version)


def _read_frame(
    path: Path, header: str, start: int, shape: tuple[int, int], dtype: np.dtype[Any]
) -> AnyArray:
    height, width = shape
    if min(shape) < 1:
        raise ValueError(f"its {header} header gives a frame of {height}×{width} pixels")
    count = height * width
    check_promise(path, header, start + count * dtype.itemsize, path.stat().st_size)
    check_size(path, 8 * count)
    return np.fromfile(path, dtype, count=count, offset=start).reshape(shape)
