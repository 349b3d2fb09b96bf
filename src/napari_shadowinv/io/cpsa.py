"""Scans of etched CR-39, ``.cpsa``: tracks found frame by frame by a microscope.

- all tracks of a scan: `read_tracks`
- an image of them: `read_image`

All numbers are little-endian. A header of 48 bytes holds 4 int32, 2 float32, 6 int32: the
version (negative), the numbers of frames along x and y, a number of bins (unused), the width of
a pixel in µm, pixels per bin (unused), limits of border, contrast and eccentricity, the number
of moments, and a frame's width and height in pixels. Each frame, in any order, has 10 int32: its
number, the stage's x and y at its middle in 0.1 µm, the number n of its tracks, three numbers on
rejected ones, the focus, and its place along x and y from 0. Then follow, each for all tracks,
their diameters (int16, 0.01 px), eccentricities, contrasts and mean contrasts (a byte each), and
pixels x and y (int16), x counted from the frame's right edge and y from its lower one. After the
last frame stand -1 and a text, which are not read. The readers below agree on this; another of
the second's author (python-cr39-reader) counts x from the left edge.

The image shows the stage's x to the right and its y upwards, so that the first frame of a scan,
with places 0 and 0, is at the top left.

References
----------
Heuer, P. cr39py, https://github.com/pheuer/cr39py (``scan/cpsa.py``).

Lahmann, B. CR39_Reader, https://github.com/PSFC-HEDP/CR39_Reader (``ScanData.java``).
"""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np

from napari_shadowinv._system.safety import as_file_errors, check_regular, check_size
from napari_shadowinv._typing import AnyArray, FloatArray
from napari_shadowinv.cautions import Caution
from napari_shadowinv.film.tracks import Tracks
from napari_shadowinv.io.files import check_promise

_HEADER, _FRAME, _TRACK = struct.Struct("<4i2f6i"), struct.Struct("<10i"), 9


@as_file_errors
def read_tracks(path: Path) -> Tracks:
    """Read all tracks of a scan.

    Parameters
    ----------
    path : str or Path
        ``.cpsa`` file.

    Returns
    -------
    Tracks
        In the order of the file; places from the top left corner of the scanned area.

    Raises
    ------
    FileFormatError
        If the file is missing, truncated, or has numbers that no scan has.
    """
    return _read_scan(path)[0]


def read_image(path: Path) -> tuple[AnyArray, dict[str, Any]]:
    """Count all tracks of a scan in bins, uint32, shape (H, W), with its ``geometry``."""
    tracks, cautions = _read_scan(path)
    counts, _, bin_ = tracks.image()
    text = (
        f"all {len(tracks)} tracks are counted, whatever their diameter, contrast and "
        "eccentricity, and not all need be of the beam: choose some in Python, as by "
        "read_tracks(path).select(diameter=(4, 12)).image(300)"
    )
    return counts, {
        "bits": 32,
        "geometry": {"detector_pixel_size": bin_ * 1e-6},
        "notes": (f"{len(tracks)} tracks counted in bins of {bin_:.5g} µm",),
        "cautions": (*cautions, Caution("tracks", text)),
    }


def _read_scan(path: Path) -> tuple[Tracks, tuple[Caution, ...]]:
    check_regular(path, "a CR-39 scan, .cpsa")
    check_size(path, 10 * path.stat().st_size)  # its bytes and the arrays of its tracks
    data = path.read_bytes()
    shape, pixel, frame_size = _read_header(path, data)
    frames = _read_frames(path, data, shape)
    hits = frames[:, 3]
    ends = np.concatenate([[0], np.cumsum(hits)])
    columns = {"d": "<i2", "e": "u1", "c": "u1", "mean": "u1", "x": "<i2", "y": "<i2"}
    fields = {name: np.empty(ends[-1], kind) for name, kind in columns.items()}
    for place, first, last in zip(frames[:, 0], ends[:-1], ends[1:], strict=True):
        for name, kind in columns.items() if last > first else ():
            fields[name][first:last] = np.frombuffer(data, kind, last - first, place)
            place += (last - first) * np.dtype(kind).itemsize
    middles = frames[:, 1:3] * 1e-7  # m, of steps of the stage
    x_left, y_bottom = middles.min(axis=0) - frame_size / 2
    x_right, y_top = middles.max(axis=0) + frame_size / 2
    x = np.repeat(middles[:, 0] + frame_size[0] / 2 - x_left, hits) - fields["x"] * (pixel * 1e-6)
    y = np.repeat(y_top - middles[:, 1] + frame_size[1] / 2, hits) - fields["y"] * (pixel * 1e-6)
    diameter = fields["d"] * np.float32(0.01 * pixel)
    width, height = x_right - x_left, y_top - y_bottom
    tracks = Tracks(y, x, diameter, fields["c"], fields["e"], (height, width))
    return tracks, _pitch_cautions(shape, np.array([width, height]), frame_size)


def _read_header(
    path: Path, data: bytes, *, widest_pixel: float = 100.0, most_frames: int = 500_000
) -> tuple[tuple[int, int], float, FloatArray]:
    """Return the frames along x and y, a pixel's width (µm), and a frame's size in x, y (m).

    Usual scans have pixels of 0.3 µm and some ten thousand frames.
    """
    check_promise(path, "CPSA", _HEADER.size, len(data))
    version, columns, rows, _, pixel, _, _, _, _, _, width, height = _HEADER.unpack_from(data)
    is_scan = version < 0 < min(columns, rows, width, height) and 0 < pixel <= widest_pixel
    if not is_scan or columns * rows > most_frames:
        raise ValueError(
            f"version {version}, {columns} × {rows} frames of {width} × {height} pixels of "
            f"{pixel:g} µm are of no scan"
        )
    check_promise(path, "CPSA", _HEADER.size + columns * rows * _FRAME.size, len(data))
    return (columns, rows), pixel, np.array([width, height]) * (pixel * 1e-6)


def _read_frames(path: Path, data: bytes, shape: tuple[int, int]) -> AnyArray:
    """Return a row for each frame: offset of its tracks, x and y of its middle, track count."""
    columns, rows = shape
    frames = np.empty((columns * rows, 4), np.int64)
    filled = np.zeros((columns, rows), bool)
    at = _HEADER.size
    for number in range(columns * rows):
        check_promise(path, f"frame {number + 1}", at + _FRAME.size, len(data))
        _, x, y, hits, _, _, _, _, column, row = _FRAME.unpack_from(data, at)
        if hits < 0 or not (0 <= column < columns and 0 <= row < rows) or filled[column, row]:
            raise ValueError(
                f"frame {number + 1} is at column {column}, row {row} with {hits} tracks"
            )
        filled[column, row] = True
        at += _FRAME.size
        frames[number] = at, x, y, hits
        at += _TRACK * hits
        check_promise(path, f"frame {number + 1}", at, len(data))
    return frames


def _pitch_cautions(
    shape: tuple[int, int], extent: FloatArray, frame_size: FloatArray, tolerance: float = 0.02
) -> tuple[Caution, ...]:
    """Warn of frames with gaps between them, or that overlap, by a share of the scanned area."""
    ratios = extent / (np.array(shape) * frame_size)
    if (np.abs(ratios - 1) <= tolerance).all():
        return ()
    text = (
        f"the scanned area is {ratios[0]:.3g} times as wide and {ratios[1]:.3g} times as high as "
        "its frames put side by side: they overlap or leave gaps, which show in the image"
    )
    return (Caution("tracks", text),)
