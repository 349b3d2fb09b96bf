"""Pictures: upright, without transparent pixels, with their gamma and the size of a pixel."""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
from PIL import Image, PngImagePlugin, TiffImagePlugin

from napari_shadowinv import Recipe, run
from napari_shadowinv.io import read, read_shot
from napari_shadowinv.io.images import read_scan
from napari_shadowinv.pipeline.inversion_run import picture_mask

SHOT = np.random.default_rng(0).integers(1, 255, (24, 32)).astype(np.uint8)
SMOOTH = np.add.outer(3 * np.arange(24), 4 * np.arange(32)).astype(np.uint8)
COLOURS = np.stack([SHOT, SHOT // 2, SHOT // 3], axis=-1)

# Orientation


def by_exif(path: Path, pixels: Any, orientation: int) -> None:
    exif = Image.Exif()
    exif[274] = orientation
    Image.fromarray(pixels).save(path, exif=exif, quality=100, dpi=(300, 300))


def by_lzw(path: Path, pixels: Any, orientation: int) -> None:
    tags = TiffImagePlugin.ImageFileDirectory_v2()
    tags[274] = orientation
    Image.fromarray(pixels).save(path, compression="tiff_lzw", tiffinfo=tags)


def by_tag(compression: str | None) -> Callable[[Path, Any, int], None]:
    def write(path: Path, pixels: Any, orientation: int) -> None:
        options = {"compression": compression, "resolution": (300, 300), "metadata": None}
        options["photometric"] = "rgb" if pixels.shape[-1] == 3 else "minisblack"
        tifffile.imwrite(path, pixels, extratags=[(274, "H", 1, orientation, True)], **options)

    return write


TURNED: dict[str, tuple[str, Callable[[Path, Any, int], None]]] = {
    "PNG": (".png", by_exif),
    "JPEG": (".jpg", by_exif),
    "TIFF": (".tif", by_tag(None)),
    "packed TIFF": (".tif", by_tag("zlib")),
    "TIFF of Pillow": (".tif", by_lzw),
}
SEEN: dict[int, Callable[[Any], Any]] = {
    **{1: lambda a: a, 2: lambda a: a[:, ::-1], 3: lambda a: a[::-1, ::-1], 4: lambda a: a[::-1]},
    **{5: lambda a: a.T, 6: lambda a: np.rot90(a, -1), 7: lambda a: a[::-1, ::-1].T, 8: np.rot90},
}


@pytest.mark.parametrize("orientation", SEEN)
@pytest.mark.parametrize("name", TURNED)
def test_orientation_is_applied(tmp_path: Path, name: str, orientation: int) -> None:
    suffix, write = TURNED[name]
    path = tmp_path / f"shot{suffix}"
    write(path, SMOOTH, orientation)
    shot = read(path)
    tolerance = 3 if suffix == ".jpg" else 0
    np.testing.assert_allclose(shot.image, SEEN[orientation](SMOOTH), atol=tolerance)
    assert ("turned upright as the file says" in shot.notes) == (orientation != 1)


@pytest.mark.parametrize("name", ["PNG", "TIFF"])
def test_scans_and_frames_are_turned(tmp_path: Path, name: str) -> None:
    suffix, write = TURNED[name]
    path = tmp_path / f"film{suffix}"
    write(path, COLOURS, 8)
    scan = read_scan(path)
    np.testing.assert_array_equal(scan.pixels, np.rot90(COLOURS))
    assert scan.pixel_size == pytest.approx(25.4e-3 / 300, rel=1e-4)
    if name == "TIFF":
        write(path, np.stack([SHOT, SHOT + 1]), 8)
        np.testing.assert_array_equal(read(path).image, [np.rot90(SHOT), np.rot90(SHOT + 1)])


# Values


def table_of_greys(greys: Any) -> Image.Image:
    picture = Image.fromarray(SHOT).convert("P")
    picture.putpalette(np.repeat(list(greys), 3).astype(np.uint8).tobytes())
    return picture


ALPHA = np.where(SHOT > 100, 255, 0).astype(np.uint8)
CLEAR = {"transparency": int(SHOT[3, 4])}
WITH_ALPHA = np.stack([SHOT, ALPHA], axis=-1)
TRANSPARENT: dict[str, tuple[Callable[[Path], Any], Any]] = {
    "grey": (lambda path: Image.fromarray(SHOT).save(path, **CLEAR), SHOT[3, 4] != SHOT),
    "16 bits": (
        lambda path: Image.fromarray(SHOT.astype(np.uint16)).save(path, **CLEAR),
        SHOT[3, 4] != SHOT,
    ),
    "table": (lambda path: table_of_greys(range(256)).save(path, **CLEAR), SHOT[3, 4] != SHOT),
    "colours": (
        lambda path: Image.fromarray(np.stack([SHOT] * 3 + [ALPHA], axis=-1)).save(path),
        ALPHA > 0,
    ),
    "grey and alpha": (lambda path: Image.fromarray(WITH_ALPHA).save(path), ALPHA > 0),
    "TIFF": (
        lambda path: tifffile.imwrite(
            path, WITH_ALPHA, photometric="minisblack", extrasamples=["unassalpha"]
        ),
        ALPHA > 0,
    ),
}


@pytest.mark.parametrize("name", TRANSPARENT)
def test_transparent_pixels_are_not_light(tmp_path: Path, name: str) -> None:
    write, opaque = TRANSPARENT[name]
    path = tmp_path / ("shot.tif" if name.startswith("TIFF") else "shot.png")
    write(path)
    shot = read(path)
    np.testing.assert_array_equal(shot.mask, opaque)
    np.testing.assert_array_equal(shot.image[opaque], SHOT[opaque])
    assert any(f"{(~opaque).sum()} pixels without a value" in note for note in shot.notes)


def test_one_bit_and_a_dark_table_of_greys(tmp_path: Path) -> None:
    for suffix in (".png", ".bmp", ".tif"):
        path = tmp_path / f"shot{suffix}"
        Image.fromarray(SHOT > 100).save(path)
        np.testing.assert_array_equal(read(path).image > 0, SHOT > 100)
        table_of_greys(range(255, -1, -1)).save(path)
        if suffix != ".tif":
            np.testing.assert_array_equal(read(path).image, 255 - SHOT)


def png_info(name: bytes, data: bytes) -> dict[str, PngImagePlugin.PngInfo]:
    info = PngImagePlugin.PngInfo()
    info.add(name, data)
    return {"pnginfo": info}


def profile(name: bytes) -> dict[str, Any]:
    return {"extratags": [(34675, "B", len(name), name, True)]}


@pytest.mark.parametrize(
    ("suffix", "options", "is_doubted"),
    [
        (".png", png_info(b"gAMA", struct.pack(">I", 45455)), True),
        (".png", png_info(b"gAMA", struct.pack(">I", 100_000)), False),
        (".png", png_info(b"sRGB", b"\0"), True),
        (".png", png_info(b"tIME", bytes(7)), False),
        (".png", {"icc_profile": b"desc sRGB IEC61966"}, True),
        (".png", {"icc_profile": b"desc Linear grey"}, False),
        (".png", {}, False),
        (".bmp", {}, False),
        (".jpg", {}, True),
        (".tif", profile(b"sRGB IEC61966-2.1"), True),
        (".tif", profile(b"Linear grey"), False),
        (".tif", {"compression": "jpeg", "photometric": "minisblack"}, True),
        (".tif", {"compression": "jpeg2000", "photometric": "minisblack"}, False),
    ],
)
def test_pixels_that_are_not_proportional_to_light_get_a_caution(
    tmp_path: Path, suffix: str, options: dict[str, Any], is_doubted: bool
) -> None:
    path = tmp_path / f"shot{suffix}"
    if suffix == ".tif":
        tifffile.imwrite(path, np.full((16, 16), 80, np.uint8), **options)
    else:
        Image.fromarray(SHOT).save(path, **options)
    assert [each.code for each in read_shot(path).cautions] == ["gamma"] * is_doubted


def test_mask_for_screens_gives_no_caution_and_its_gaps_are_unusable(tmp_path: Path) -> None:
    mask = np.full(SHOT.shape, 255, np.uint8)
    mask[:4] = 0
    mask[4:6] = 9
    Image.fromarray(mask).save(tmp_path / "mask.png", **png_info(b"sRGB", b"\0"), transparency=9)
    recipe = Recipe(mask=tmp_path / "mask.png", options={"n_sites": 60})
    result = run(recipe, 200.0 + SHOT)
    assert "gamma" not in {caution.code for caution in result.report.cautions}
    np.testing.assert_array_equal(picture_mask(tmp_path / "mask.png"), mask == 255)


# Size of the pixels

SIZES: list[tuple[str, dict[str, Any], float | None]] = [
    (".png", {"dpi": (72, 72)}, None), (".jpg", {"dpi": (300, 300)}, None),
    (".png", {"dpi": (25400 / 6.5, 25400 / 6.5)}, 6.5e-6), (".bmp", {"dpi": (96, 96)}, None),
    *((".tif", {"resolution": (dots, dots), "resolutionunit": unit}, size) for dots, unit, size in (
        (72, "INCH", None), (96, "INCH", None), (300, "INCH", None), (28.35, "CENTIMETER", None),
        (1, "NONE", None), (0.2, "NONE", None), (1e4 / 6.5, "CENTIMETER", 6.5e-6),
        (25400 / 6.5, "INCH", 6.5e-6),
    )),
    *((".tif", {"resolution": (n, n), "imagej": True, "metadata": {"unit": unit}}, size)
      for n, unit, size in ((1 / 6.5, "um", 6.5e-6), (5, "mm", 2e-4), (1, "um", None),
                            (72, "inch", None), (5, "pixel", None))),
]  # fmt: skip


def size_in(path: Path) -> float | None:
    return read_shot(path).metadata.get("geometry", {}).get("detector_pixel_size")


@pytest.mark.parametrize(("suffix", "options", "size"), SIZES)
def test_size_of_a_pixel_is_offered_unless_it_may_be_a_default(
    tmp_path: Path, suffix: str, options: dict[str, Any], size: float | None
) -> None:
    path = tmp_path / f"shot{suffix}"
    if suffix == ".tif":
        tifffile.imwrite(path, SHOT, **options)
    else:
        Image.fromarray(SHOT).save(path, **options)
    assert size_in(path) == (None if size is None else pytest.approx(size, rel=1e-3))


def test_pixels_that_are_not_square_are_a_caution(tmp_path: Path) -> None:
    path = tmp_path / "shot.tif"
    tifffile.imwrite(path, SHOT, resolution=(1000, 2000), resolutionunit="CENTIMETER")
    (caution,) = read(path).cautions
    assert "10 µm wide and 5 µm high" in caution.text
    assert size_in(path) is None
