"""Scans of CR-39, written here byte by byte as the description in `cpsa` tells."""

import struct
import tracemalloc
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from helpers.command_line import done
from napari_shadowinv.errors import FileFormatError, InputError
from napari_shadowinv.io import read, read_shot, read_tracks

PIXEL = 0.5  # µm; a frame of 800 × 400 px is 400 × 200 µm
WIDTH, HEIGHT = 800, 400
# diameter (0.01 px), eccentricity, contrast, mean contrast, x, y
Track = tuple[int, int, int, int, int, int]
Frame = tuple[int, int, list[Track]]  # column, row, tracks
ROUND: Track = (1000, 5, 20, 21, 100, 50)


def frame_bytes(number: int, frame: Frame, pitch: float = 1.0) -> bytes:
    column, row, tracks = frame
    # The stage's x grows from column to column, y falls from row to row, in 0.1 µm.
    x = round(30_000 + pitch * 4000 * column)
    y = round(90_000 - pitch * 2000 * row)
    head = struct.pack("<10i", number, x, y, len(tracks), 7, 8, 9, 55, column, row)
    kinds = "hBBBhh"
    values = zip(*tracks, strict=True)
    return head + b"".join(
        struct.pack(f"<{len(tracks)}{kind}", *column)
        for kind, column in zip(kinds, values, strict=False)
    )


def save(
    path: Path, shape: tuple[int, int], frames: Iterable[Frame], pitch: float = 1.0, **header: Any
) -> Path:
    fields = {"version": -104, "columns": shape[0], "rows": shape[1], "bins": 0, "pixel": PIXEL,
              "per_bin": 0.5, "border": 85, "contrast": 75, "eccentricity": 40, "moments": 2,
              "width": WIDTH, "height": HEIGHT, **header}  # fmt: skip
    content = b"".join(frame_bytes(n, frame, pitch) for n, frame in enumerate(frames, 1))
    trailer = struct.pack("<i", -1) + b"Scan of shot 17\n\xb5m"
    path.write_bytes(struct.pack("<4i2f6i", *fields.values()) + content + trailer)
    return path


def snake(columns: int, rows: int, tracks: Callable[[int, int], list[Track]]) -> list[Frame]:
    """Frames in the order in which a stage moves, every second row backwards."""
    return [
        (column, row, tracks(column, row))
        for row in range(rows)
        for column in (range(columns) if row % 2 == 0 else range(columns - 1, -1, -1))
    ]


@pytest.fixture
def scan(tmp_path: Path) -> Path:
    """Six by six frames with ten tracks each, at random, of three kinds."""
    rng = np.random.default_rng(3)

    def tracks(column: int, row: int) -> list[Track]:
        kinds = [(600, 3, 10), (1400, 3, 10), (1400, 30, 60)]
        return [
            (*kinds[i % 3], 0, int(rng.integers(1, WIDTH)), int(rng.integers(1, HEIGHT)))
            for i in range(12)
        ]

    return save(tmp_path / "scan.cpsa", (6, 6), snake(6, 6, tracks))


def test_a_track_has_the_place_and_the_size_that_its_bytes_tell(tmp_path: Path) -> None:
    tracks = [ROUND, (640, 40, 99, 98, 0, HEIGHT)]
    path = save(tmp_path / "a.cpsa", (2, 2), snake(2, 2, lambda c, r: tracks * (c > r)))
    read = read_tracks(path)
    assert len(read) == 2
    np.testing.assert_allclose(read.size, (400e-6, 800e-6))
    # The upper right frame: x counts from its right edge to the left, y from its lower edge up.
    np.testing.assert_allclose(read.x, [800e-6 - 100 * 0.5e-6, 800e-6], atol=1e-12)
    np.testing.assert_allclose(read.y, [200e-6 - 50 * 0.5e-6, 0.0], atol=1e-12)
    np.testing.assert_allclose(read.diameter, [10 * PIXEL, 6.4 * PIXEL], rtol=1e-6)
    np.testing.assert_array_equal(read.eccentricity, [5, 40])
    np.testing.assert_array_equal(read.contrast, [20, 99])


def test_frames_lie_where_their_places_say(tmp_path: Path) -> None:
    frames = snake(4, 3, lambda c, r: [ROUND] * (1 + c + 10 * r))
    image = read_tracks(save(tmp_path / "a.cpsa", (4, 3), frames)).image(200).counts
    counts = image.reshape(3, 1, 4, 2).sum(axis=(1, 3))
    np.testing.assert_array_equal(counts, 1 + np.arange(4) + 10 * np.arange(3)[:, None])
    # 100 px of 800 from the right edge.
    np.testing.assert_array_equal(image[:, ::2], 0)


def test_a_usual_bin_holds_fifty_tracks_and_gaps_are_reported(scan: Path, tmp_path: Path) -> None:
    shot = read_shot(scan)
    assert shot.image.shape == (2, 4)
    assert shot.image.sum() == 432  # 54 in each
    assert shot.metadata["geometry"]["detector_pixel_size"] == pytest.approx(600e-6)
    frames = snake(4, 4, lambda c, r: [ROUND])
    assert "all 432 tracks are counted" in shot.cautions[0].text
    path = save(tmp_path / "a.cpsa", (4, 4), frames, pitch=1.2)
    assert "overlap or leave gaps" in str(read_shot(path).cautions)


WRONG_HEADERS: list[dict[str, float]] = [
    {"version": 104}, {"columns": 0}, {"rows": -1}, {"columns": 2**31 - 1, "rows": 2**31 - 1},
    {"columns": 500, "rows": 1000}, {"columns": 7}, {"pixel": float("nan")}, {"pixel": -1.0},
    {"width": 0}, {"columns": 9, "rows": 4},
]  # fmt: skip


@pytest.mark.parametrize("header", WRONG_HEADERS)
def test_headers_that_cannot_be_are_refused(tmp_path: Path, header: Any) -> None:
    path = save(tmp_path / "a.cpsa", (6, 6), snake(6, 6, lambda c, r: [ROUND]), **header)
    tracemalloc.start()
    with pytest.raises(FileFormatError, match="damaged"):
        read(path)
    assert tracemalloc.get_traced_memory()[1] < 1_000_000
    tracemalloc.stop()


def test_a_file_cut_anywhere_is_refused(tmp_path: Path, scan: Path) -> None:
    content = scan.read_bytes()
    end = len(content) - len(struct.pack("<i", -1) + b"Scan of shot 17\n\xb5m")
    cut = tmp_path / "cut.cpsa"
    for length in (1, 47, 48, 60, 88, 95, end // 2, end - 1):
        cut.write_bytes(content[:length])
        with pytest.raises(FileFormatError, match="truncated"):
            read_tracks(cut)
    cut.write_bytes(content[:end])  # the trailer is not needed
    assert len(read_tracks(cut)) == 432


def test_frames_twice_or_with_too_many_tracks_are_refused(tmp_path: Path) -> None:
    path = save(tmp_path / "a.cpsa", (2, 2), [(0, 0, []), (1, 0, []), (1, 0, []), (0, 1, [])])
    with pytest.raises(FileFormatError, match="frame 3 is at column 1, row 0"):
        read_tracks(path)
    good = bytearray(save(path, (2, 2), snake(2, 2, lambda c, r: [])).read_bytes())
    for hits, words in ((-1, "with -1 tracks"), (2**31 - 1, "implies")):
        struct.pack_into("<i", good, 48 + 12, hits)
        path.write_bytes(good)
        with pytest.raises(FileFormatError, match=words):
            read_tracks(path)


def test_what_is_too_large_empty_or_no_scan_is_refused(
    scan: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "a.npy"
    np.save(path, np.ones((4, 4)))
    with pytest.raises(InputError, match="neither a MATLAB nor an HDF5 file"):
        read(path, variable="bin=3")
    empty = save(tmp_path / "none.cpsa", (2, 2), snake(2, 2, lambda c, r: []))
    with pytest.raises(InputError, match="no track lies within the ranges"):
        read(empty)
    monkeypatch.setenv("SHADOWINV_MAX_GB", "1e-6")
    with pytest.raises(FileFormatError, match="expands to"):
        read_tracks(scan)


def test_the_command_describes_a_scan(scan: Path) -> None:
    report = done("info", scan)
    for words in ("432 tracks counted in bins of 600 µm", "detector pixel size"):
        assert words in report
