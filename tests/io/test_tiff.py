"""TIFFs of other programs: every frame, upright, with the values that the file means."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile

from napari_shadowinv.errors import InputError
from napari_shadowinv.io import read

SHOT = np.random.default_rng(0).integers(1, 4000, (24, 32)).astype(np.uint16)
STACK = np.stack([SHOT, SHOT + 1, SHOT + 2])
SMALL = np.full((6, 8), 9, np.uint16)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "shot.tif"


def write_bare(path: Path, array: Any, **tags: int) -> None:
    """Write a TIFF with the tags that cannot be missing, and those that are wanted."""
    numbers = {"bits": 258, "compression": 259, "photometric": 262, "unit": 296, "planar": 284}
    content = array.astype(array.dtype.newbyteorder(">")).tobytes()
    entries = {256: array.shape[1], 257: array.shape[0], 279: len(content)}
    entries |= {258: 8 * array.dtype.itemsize} | {numbers[name]: tags[name] for name in tags}
    entries[273] = 8 + 2 + 12 * (len(entries) + 1) + 4
    head = b"MM\0*" + struct.pack(">IH", 8, len(entries))
    for number, value in sorted(entries.items()):
        is_long = number in (273, 279)
        head += struct.pack(">HHI", number, 4 if is_long else 3, 1)
        head += struct.pack(">I", value) if is_long else struct.pack(">HH", value, 0)
    path.write_bytes(head + struct.pack(">I", 0) + content)


# What need not be stated


@pytest.mark.parametrize("tags", [{}, {"photometric": 1}, {"compression": 1}, {"unit": 99}])
def test_missing_or_unnamed_tags_are_the_formats_defaults(path: Path, tags: dict[str, int]) -> None:
    write_bare(path, SHOT, **tags)
    np.testing.assert_array_equal(read(path).image, SHOT)


def test_twelve_bits_are_unpacked(path: Path) -> None:
    pairs = SHOT.reshape(-1, 2).astype(np.uint32)
    words = (pairs[:, 0] << 12) | pairs[:, 1]
    packed = np.stack([words >> 16, words >> 8, words], axis=1).astype(np.uint8)
    write_bare(path, SHOT, bits=12, photometric=1)
    content = path.read_bytes()
    path.write_bytes(content[: -SHOT.nbytes] + packed.tobytes().ljust(SHOT.nbytes, b"\0"))
    shot = read(path)
    np.testing.assert_array_equal(shot.image, SHOT)
    assert shot.metadata["bits"] == 12


# Frames


def frames_of(path: Path) -> Any:
    return read(path).image.compute().data


@pytest.mark.parametrize(
    "options",
    [
        {"imagej": True},
        {"metadata": {"axes": "TYX"}, "ome": True},
        {"metadata": {"axes": "ZYX"}, "imagej": True, "bigtiff": False},
        {"compression": "zlib", "metadata": None},
        {"bigtiff": True, "byteorder": ">"},
    ],
)
def test_all_frames_of_a_stack_are_shots(path: Path, options: dict[str, Any]) -> None:
    tifffile.imwrite(path, STACK, photometric="minisblack", **options)
    np.testing.assert_array_equal(frames_of(path), STACK)


def test_axes_of_time_depth_and_channel_count_together(path: Path) -> None:
    stack = np.arange(2 * 3 * 2 * 4 * 5, dtype=np.uint16).reshape(2, 3, 2, 4, 5)
    tifffile.imwrite(path, stack, imagej=True, metadata={"axes": "TZCYX"})
    np.testing.assert_array_equal(frames_of(path), stack.reshape(-1, 4, 5))


def test_frames_in_colour_need_a_channel(path: Path) -> None:
    stack = np.stack([STACK, STACK + 1, STACK + 2], axis=-1)
    tifffile.imwrite(path, stack, photometric="rgb")
    with pytest.raises(InputError, match="3 channels"):
        read(path)
    np.testing.assert_array_equal(read(path, channel="green").image, STACK + 1)


def test_thumbnails_pyramids_and_labels_are_no_shots(path: Path) -> None:
    with tifffile.TiffWriter(path) as tiff:
        for frame in STACK:
            tiff.write(frame, subifds=1, photometric="minisblack", metadata=None)
            tiff.write(frame[::2, ::2], subfiletype=1, metadata=None)
        tiff.write(SMALL, subfiletype=1, metadata=None)
    np.testing.assert_array_equal(frames_of(path), STACK)


def test_pages_of_one_size_are_shots_and_a_mask_or_a_small_one_is_not(path: Path) -> None:
    def write(*pages: Any, **last: int) -> Any:
        with tifffile.TiffWriter(path) as tiff:
            for page in pages:
                tiff.write(page, metadata=None, **(last if page is pages[-1] else {}))
        return read(path)

    shot = write(SHOT, SMALL)
    np.testing.assert_array_equal(shot.image, SHOT)
    assert [caution.code for caution in shot.cautions] == ["file"]
    assert "6×8" in shot.cautions[0].text
    write(SHOT, (SHOT // 16).astype(np.uint8))
    np.testing.assert_array_equal(frames_of(path), [SHOT, SHOT // 16])
    write(SHOT, SHOT > 2000, subfiletype=2)
    with tifffile.TiffFile(path, mode="r+") as tiff:
        tiff.pages[1].tags[254].overwrite(4)
    np.testing.assert_array_equal(read(path).image, SHOT)


# Values


def imagej(lines: str) -> dict[str, Any]:
    return {"description": f"ImageJ=1.54f\n{lines}", "metadata": None}


GREY = (SHOT // 16).astype(np.uint8)
TABLE = np.random.default_rng(1).integers(0, 65535, 256).astype(np.uint16)
PALETTE = {"photometric": "palette", "colormap": np.stack([TABLE] * 3)}
WHITE = {"photometric": "miniswhite"}
SIGNED = SHOT.astype(int) - 1000
OFFSET = imagej("cf=0\nc0=-32768.0\nc1=1.0\nvunit=Gray Value\n") | {"photometric": "minisblack"}
CURVE = imagej("cf=1\nc0=1\nc1=2\nc2=0.5\n")
SCALE = (33446, "2I", 1, (1, 400), True)

# What a program stores, how, and what it means.
VALUES: dict[str, tuple[Any, dict[str, Any], Any]] = {
    **{
        codec: (SHOT, {"compression": codec}, SHOT)
        for codec in ("zstd", "lzw", "lzma", "packbits", "deflate")
    },
    "white is zero": (SHOT, WHITE, 65535 - SHOT),
    "white is false": (SHOT > 2000, WHITE, SHOT <= 2000),
    "table of greys": (GREY, PALETTE, TABLE[GREY]),
    # ImageJ shows inverted greys and colours only.
    "ImageJ, inverted": (GREY, WHITE | imagej("unit=micron\n"), GREY),
    "ImageJ, in colours": (GREY, PALETTE | imagej("unit=micron\n"), GREY),
    "ImageJ, signed": ((SIGNED + 32768).astype(np.uint16), OFFSET, SIGNED),
    "ImageJ, polynomial": (SHOT, CURVE, 1 + 2 * SHOT + 0.5 * SHOT.astype(float) ** 2),
    "ImageJ, no function": (SHOT, imagej("cf=20\n"), SHOT),
    "ImageJ, nothing": (SHOT, imagej(""), SHOT),
    **{
        f"gel, {kind}, {len(scale)}": (
            SHOT,
            {"extratags": [(33445, "I", 1, kind, True), *scale], "metadata": None},
            SHOT.astype(float) ** power / (400 if scale else 1),
        )
        for kind, power in ((2, 2), (128, 1))
        for scale in ([SCALE], [])
    },
}


@pytest.mark.parametrize("name", VALUES)
def test_values_are_those_that_the_file_means(path: Path, name: str) -> None:
    stored, options, meant = VALUES[name]
    tifffile.imwrite(path, stored, **options)
    shot = read(path)
    np.testing.assert_allclose(shot.image, meant)
    assert any("calibrated by ImageJ" in note for note in shot.notes) == ("c0" in str(options))
