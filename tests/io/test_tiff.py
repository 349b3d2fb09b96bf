"""TIFFs of other programs: every frame, upright, with the values that the file means."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
from PIL import Image, TiffImagePlugin

from napari_shadowinv.errors import FileFormatError, InputError
from napari_shadowinv.io import read, read_shot
from napari_shadowinv.io.images import read_scan

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


def test_unnamed_compression_and_photometric_are_numbers(path: Path) -> None:
    write_bare(path, SHOT, compression=60123, photometric=1)
    with pytest.raises(FileFormatError, match=r"60123.* or in a form that needs another reader"):
        read(path)
    write_bare(path, SHOT, photometric=60124)
    with pytest.raises(FileFormatError, match="photometric kind 60124"):
        read(path)


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


@pytest.mark.parametrize("codec", ["zstd", "lzw", "lzma", "packbits", "deflate"])
def test_codecs_without_loss_give_the_pixels(path: Path, codec: str) -> None:
    tifffile.imwrite(path, SHOT, compression=codec)
    np.testing.assert_array_equal(read(path).image, SHOT)


# Frames


def frames_of(path: Path) -> Any:
    return read(path).image.compute().data


@pytest.mark.parametrize(
    "options",
    [
        {"imagej": True, "truncate": True},
        {"imagej": True},
        {"truncate": True},
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
    tifffile.imwrite(path, stack, imagej=True, metadata={"axes": "TZCYX"}, truncate=True)
    np.testing.assert_array_equal(frames_of(path), stack.reshape(-1, 4, 5))


def test_frames_in_colour_need_a_channel(path: Path) -> None:
    stack = np.stack([STACK, STACK + 1, STACK + 2], axis=-1)
    tifffile.imwrite(path, stack, photometric="rgb")
    with pytest.raises(InputError, match="3 channels"):
        read(path)
    np.testing.assert_array_equal(read(path, channel="green").image, STACK + 1)


@pytest.mark.parametrize("kept", [1.0 / 3, 0.6, 0.99])
@pytest.mark.parametrize("options", [{"imagej": True}, {"metadata": None}, {}])
@pytest.mark.parametrize("truncate", [False, True])
def test_stack_that_ends_too_soon_is_refused(
    path: Path, options: dict[str, Any], truncate: bool, kept: float
) -> None:
    if truncate and options.get("metadata", 1) is None:
        pytest.skip("such a file states one frame only")
    tifffile.imwrite(path, STACK, photometric="minisblack", truncate=truncate, **options)
    path.write_bytes(path.read_bytes()[: int(kept * path.stat().st_size)])
    with pytest.raises(FileFormatError, match=r"truncated|incomplete"):
        read(path)


def test_thumbnails_pyramids_and_labels_are_no_shots(path: Path) -> None:
    with tifffile.TiffWriter(path) as tiff:
        for frame in STACK:
            tiff.write(frame, subifds=1, photometric="minisblack", metadata=None)
            tiff.write(frame[::2, ::2], subfiletype=1, metadata=None)
        tiff.write(SMALL, subfiletype=1, metadata=None)
    np.testing.assert_array_equal(frames_of(path), STACK)


def test_small_page_without_a_mark_is_left_out_with_a_caution(path: Path) -> None:
    with tifffile.TiffWriter(path) as tiff:
        tiff.write(SHOT, metadata=None)
        tiff.write(SMALL, metadata=None)
    shot = read(path)
    np.testing.assert_array_equal(shot.image, SHOT)
    assert [caution.code for caution in shot.cautions] == ["file"]
    assert "6×8" in shot.cautions[0].text


def test_pictures_of_similar_size_are_refused(path: Path) -> None:
    with tifffile.TiffWriter(path) as tiff:
        tiff.write(SHOT, metadata=None)
        tiff.write(SHOT[:20], metadata=None)
    with pytest.raises(FileFormatError, match=r"24×32 and of 20×32 pixels: expected shots of one"):
        read(path)


def test_pages_of_one_size_and_different_depth_are_all_shots(path: Path) -> None:
    with tifffile.TiffWriter(path) as tiff:
        tiff.write(SHOT, metadata=None)
        tiff.write((SHOT // 16).astype(np.uint8), metadata=None)
    np.testing.assert_array_equal(frames_of(path), [SHOT, SHOT // 16])


def test_page_with_a_mask_is_no_shot(path: Path) -> None:
    with tifffile.TiffWriter(path) as tiff:
        tiff.write(SHOT, metadata=None)
        tiff.write(SHOT > 2000, subfiletype=2, metadata=None)
    with tifffile.TiffFile(path, mode="r+") as tiff:
        tiff.pages[1].tags[254].overwrite(4)
    np.testing.assert_array_equal(read(path).image, SHOT)


# Orientation

SEEN = {
    1: SHOT, 2: SHOT[:, ::-1], 3: SHOT[::-1, ::-1], 4: SHOT[::-1],
    5: SHOT.T, 6: np.rot90(SHOT, -1), 7: SHOT[::-1, ::-1].T, 8: np.rot90(SHOT),
}  # fmt: skip


@pytest.mark.parametrize("orientation", SEEN)
def test_orientation_is_applied_whatever_the_compression(path: Path, orientation: int) -> None:
    tag = (274, "H", 1, orientation, True)
    for compression in (None, "zlib"):
        tifffile.imwrite(path, SHOT, extratags=[tag], compression=compression)
        np.testing.assert_array_equal(read(path).image, SEEN[orientation])
    tags = TiffImagePlugin.ImageFileDirectory_v2()
    tags[274] = orientation
    Image.fromarray(SHOT).save(path, compression="tiff_lzw", tiffinfo=tags)
    shot = read(path)
    np.testing.assert_array_equal(shot.image, SEEN[orientation])
    assert any("turned" in note for note in shot.notes) == (orientation != 1)


def test_orientation_of_frames_and_scans(path: Path) -> None:
    tag = [(274, "H", 1, 8, True)]
    tifffile.imwrite(path, STACK, photometric="minisblack", extratags=tag, metadata=None)
    np.testing.assert_array_equal(frames_of(path), [np.rot90(frame) for frame in STACK])
    colours = np.stack([SHOT, SHOT + 1, SHOT + 2], axis=-1)
    tifffile.imwrite(path, colours, photometric="rgb", extratags=tag, resolution=(300, 300))
    scan = read_scan(path)
    np.testing.assert_array_equal(scan.pixels, np.rot90(colours))
    assert scan.pixel_size == pytest.approx(25.4e-3 / 300)


# Values


def test_pixels_without_data_are_left_out(path: Path) -> None:
    stored = SHOT.copy()
    stored[2:5, 7] = 65535
    tifffile.imwrite(path, stored, extratags=[(42113, "s", 0, "65535", True)], metadata=None)
    shot = read(path)
    np.testing.assert_array_equal(shot.usable, stored != 65535)
    assert any("3 pixels" in note for note in shot.notes)


def test_white_is_zero_is_turned_round(path: Path) -> None:
    usable = SHOT > 2000
    tifffile.imwrite(path, ~usable, photometric="miniswhite")
    np.testing.assert_array_equal(read(path).image > 0, usable)
    tifffile.imwrite(path, SHOT, photometric="miniswhite")
    np.testing.assert_array_equal(read(path).image, 65535 - SHOT)


@pytest.mark.parametrize("dtype", ["i2", "f4"])
def test_white_is_zero_without_a_black_is_refused(path: Path, dtype: str) -> None:
    tifffile.imwrite(path, SHOT.astype(dtype), photometric="miniswhite")
    with pytest.raises(FileFormatError, match="0 is white"):
        read(path)


def test_imagej_shows_inverted_greys_and_colours_only(path: Path) -> None:
    grey = (SHOT // 16).astype(np.uint8)
    table = np.random.default_rng(1).integers(0, 65535, (3, 256)).astype(np.uint16)
    for options in ({"photometric": "miniswhite"}, {"photometric": "palette", "colormap": table}):
        text = "ImageJ=1.54f\nunit=micron\n"
        tifffile.imwrite(path, grey, description=text, metadata=None, **options)
        np.testing.assert_array_equal(read(path).image, grey)


@pytest.mark.parametrize("dtype", [np.uint8, np.bool_])
def test_table_of_greys_is_looked_up(path: Path, dtype: type) -> None:
    bits = 1 if dtype is np.bool_ else 8
    indices = (SHOT % 2).astype(np.uint8)
    table = np.zeros((3, 2**bits), np.uint16)
    table[:, :2] = [7000, 300]
    tifffile.imwrite(path, indices, photometric="palette", colormap=np.resize(table, (3, 256)))
    if bits == 1:
        Image.fromarray(indices == 1).save(path)
        np.testing.assert_array_equal(read(path).image, indices)
        return
    table = np.resize(table, (3, 256))
    np.testing.assert_array_equal(read(path).image, table[0][indices])


def test_imagej_calibration_is_applied(path: Path) -> None:
    signed = SHOT.astype(int) - 1000
    text = "ImageJ=1.54f\ncf=0\nc0=-32768.0\nc1=1.0\nvunit=Gray Value\n"
    tifffile.imwrite(
        path, (signed + 32768).astype(np.uint16), description=text, metadata=None,
        photometric="minisblack",
    )  # fmt: skip
    shot = read(path)
    np.testing.assert_array_equal(shot.image, signed)
    assert "calibrated by ImageJ" in shot.notes[0]


@pytest.mark.parametrize(("lines", "expected"), [
    ("cf=1\nc0=1\nc1=2\nc2=0.5\n", 1 + 2 * SHOT + 0.5 * SHOT.astype(float) ** 2),
    ("cf=20\n", SHOT),
    ("", SHOT),
])  # fmt: skip
def test_imagej_polynomial(path: Path, lines: str, expected: Any) -> None:
    tifffile.imwrite(path, SHOT, description=f"ImageJ=1.54f\n{lines}", metadata=None)
    np.testing.assert_allclose(read(path).image, expected)


@pytest.mark.parametrize("function", [4, 8, 21, 22])
def test_other_imagej_calibrations_are_refused(path: Path, function: int) -> None:
    text = f"ImageJ=1.54f\ncf={function}\nc0=1\nc1=2\nvunit=OD\n"
    tifffile.imwrite(path, SHOT, description=text, metadata=None)
    with pytest.raises(FileFormatError, match=rf"calibration function {function} .*'OD'"):
        read(path)


@pytest.mark.parametrize(("tag", "power"), [(2, 2), (128, 1)])
def test_gel_values_are_powers(path: Path, tag: int, power: int) -> None:
    scale = (33446, "2I", 1, (1, 400), True)
    for extra in ([scale], []):
        tags = [(33445, "I", 1, tag, True), *extra]
        tifffile.imwrite(path, SHOT, extratags=tags, metadata=None)
        expected = SHOT.astype(float) ** power / (400 if extra else 1)
        np.testing.assert_allclose(read(path).image, expected)


def test_transparent_pixels_are_not_light(path: Path) -> None:
    alpha = np.where(SHOT > 2000, 65535, 0).astype(np.uint16)
    pixels, kinds = np.stack([SHOT, alpha], axis=-1), ["unassalpha"]
    tifffile.imwrite(path, pixels, photometric="minisblack", extrasamples=kinds)
    shot = read(path)
    np.testing.assert_array_equal(shot.usable, alpha > 0)
    np.testing.assert_array_equal(shot.image[alpha > 0], SHOT[alpha > 0])


@pytest.mark.parametrize(
    ("photometric", "name"), [("cfa", "CFA"), ("linear_raw", "LINEAR_RAW"), ("cielab", "CIELAB")]
)
def test_pixels_that_are_no_measure_of_light_are_refused(
    path: Path, photometric: str, name: str
) -> None:
    is_grey = photometric != "cielab"
    array = SHOT if is_grey else np.stack([SHOT // 16] * 3, axis=-1).astype(np.uint8)
    write_bare(path, array.reshape(24, -1), photometric={"cfa": 32803, "linear_raw": 34892}.get(
        photometric, 8
    ))  # fmt: skip
    with pytest.raises(FileFormatError, match=f"photometric kind {name}"):
        read(path)


def test_complex_pixels_are_refused(path: Path) -> None:
    tifffile.imwrite(path, SHOT.astype(np.complex64))
    with pytest.raises(FileFormatError, match="COMPLEXIEEEFP"):
        read(path)


def test_colour_profile_is_a_caution_unless_it_is_linear(path: Path) -> None:
    for name, codes in ((b"sRGB IEC61966-2.1", ["gamma"]), (b"Linear grey", [])):
        profile = (34675, "B", len(name), name, True)
        tifffile.imwrite(path, SHOT, extratags=[profile])
        assert [caution.code for caution in read(path).cautions] == codes


def test_grey_jpeg_in_a_tiff_is_not_linear(path: Path) -> None:
    image = np.full((16, 16), 80, np.uint8)
    tifffile.imwrite(path, image, compression="jpeg", photometric="minisblack")
    assert [caution.code for caution in read(path).cautions] == ["gamma"]
    tifffile.imwrite(path, image, compression="jpeg2000", photometric="minisblack")
    assert read(path).cautions == ()


# Size of the pixels


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"resolution": (1000, 2000), "resolutionunit": "CENTIMETER"}, "10 µm wide and 5 µm high"),
        (
            {
                "ome": True,
                "metadata": {"PhysicalSizeX": 5.0, "PhysicalSizeY": 5.0, "PhysicalSizeYUnit": "nm"},
            },
            "5 µm wide and 0.005 µm high",
        ),
    ],
)
def test_pixels_that_are_not_square_are_a_caution(
    path: Path, options: dict[str, Any], words: str
) -> None:
    tifffile.imwrite(path, SHOT, **options)
    (caution,) = read(path).cautions
    assert words in caution.text
    assert size_in(path) is None


def size_in(path: Path) -> float | None:
    return read_shot(path).metadata.get("geometry", {}).get("detector_pixel_size")


@pytest.mark.parametrize(
    ("options", "size"),
    [
        ({"resolution": (72, 72), "resolutionunit": "INCH"}, None),
        ({"resolution": (96, 96), "resolutionunit": "INCH"}, None),
        ({"resolution": (300, 300), "resolutionunit": "INCH"}, None),
        ({"resolution": (28.35, 28.35), "resolutionunit": "CENTIMETER"}, None),
        ({"resolution": (1, 1), "resolutionunit": "NONE"}, None),
        ({"resolution": (0.2, 0.2), "resolutionunit": "NONE"}, None),
        ({"resolution": (1e4 / 6.5, 1e4 / 6.5), "resolutionunit": "CENTIMETER"}, 6.5e-6),
        ({"resolution": (25400 / 6.5, 25400 / 6.5), "resolutionunit": "INCH"}, 6.5e-6),
        ({"resolution": (1 / 6.5, 1 / 6.5), "imagej": True, "metadata": {"unit": "um"}}, 6.5e-6),
        ({"resolution": (5, 5), "imagej": True, "metadata": {"unit": "mm"}}, 2e-4),
        ({"resolution": (1, 1), "imagej": True, "metadata": {"unit": "um"}}, None),
        ({"resolution": (72, 72), "imagej": True, "metadata": {"unit": "inch"}}, None),
        ({"resolution": (5, 5), "imagej": True, "metadata": {"unit": "pixel"}}, None),
        ({"ome": True, "metadata": {"PhysicalSizeX": 6.5, "PhysicalSizeY": 6.5}}, 6.5e-6),
        (
            {"ome": True, "metadata": {"PhysicalSizeX": 6.5, "PhysicalSizeY": 0.0065,
             "PhysicalSizeYUnit": "mm"}},
            6.5e-6,
        ),
        (
            {
                "ome": True,
                "metadata": {
                    "PhysicalSizeX": 0.02, "PhysicalSizeXUnit": "mm",
                    "PhysicalSizeY": 0.02, "PhysicalSizeYUnit": "mm",
                },
            },
            2e-5,
        ),
    ],
)  # fmt: skip
def test_size_of_a_pixel_is_offered_unless_it_may_be_a_default(
    path: Path, options: dict[str, Any], size: float | None
) -> None:
    tifffile.imwrite(path, SHOT, **options)
    assert size_in(path) == (None if size is None else pytest.approx(size, rel=1e-4))
