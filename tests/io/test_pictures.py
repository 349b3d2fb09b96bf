"""PNG, JPEG and BMP: upright, without transparent pixels, and with a word about their gamma."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image, PngImagePlugin

from napari_shadowinv import Recipe, run
from napari_shadowinv.io import read, read_shot
from napari_shadowinv.io.images import read_scan
from napari_shadowinv.pipeline.inversion_run import picture_mask

SHOT = np.random.default_rng(0).integers(1, 255, (24, 32)).astype(np.uint8)
SMOOTH = np.add.outer(3 * np.arange(24), 4 * np.arange(32)).astype(np.uint8)


def turned(orientation: int) -> Image.Exif:
    exif = Image.Exif()
    exif[274] = orientation
    return exif


@pytest.mark.parametrize(
    ("orientation", "seen"),
    [(2, SMOOTH[:, ::-1]), (3, SMOOTH[::-1, ::-1]), (4, SMOOTH[::-1]), (6, np.rot90(SMOOTH, -1))],
)
@pytest.mark.parametrize("suffix", [".png", ".jpg"])
def test_orientation_is_applied(tmp_path: Path, suffix: str, orientation: int, seen: Any) -> None:
    path = tmp_path / f"shot{suffix}"
    Image.fromarray(SMOOTH).save(path, exif=turned(orientation), quality=100)
    shot = read(path)
    np.testing.assert_allclose(shot.image, seen, atol=3 if suffix == ".jpg" else 0)
    assert "turned upright as the file says" in shot.notes


def test_scan_in_colour_is_turned(tmp_path: Path) -> None:
    path = tmp_path / "film.png"
    colours = np.stack([SHOT, SHOT // 2, SHOT // 3], axis=-1)
    Image.fromarray(colours).save(path, exif=turned(8), dpi=(300, 300))
    scan = read_scan(path)
    np.testing.assert_array_equal(scan.pixels, np.rot90(colours))
    assert scan.pixel_size == pytest.approx(25.4e-3 / 300, rel=1e-4)


def table_of_greys(greys: Any) -> Image.Image:
    picture = Image.fromarray(SHOT).convert("P")
    picture.putpalette(np.repeat(greys, 3).astype(np.uint8).tobytes())
    return picture


ALPHA = np.where(SHOT > 100, 255, 0).astype(np.uint8)
CLEAR = {"transparency": int(SHOT[3, 4])}
TRANSPARENT: dict[str, tuple[Image.Image, dict[str, int], Any]] = {
    "grey": (Image.fromarray(SHOT), CLEAR, SHOT[3, 4] != SHOT),
    "16 bits": (Image.fromarray(SHOT.astype(np.uint16)), CLEAR, SHOT[3, 4] != SHOT),
    "table": (table_of_greys(np.arange(256)), CLEAR, SHOT[3, 4] != SHOT),
    "colours": (Image.fromarray(np.stack([SHOT] * 3 + [ALPHA], axis=-1)), {}, ALPHA > 0),
    "grey and alpha": (Image.fromarray(np.stack([SHOT, ALPHA], axis=-1)), {}, ALPHA > 0),
}


@pytest.mark.parametrize("name", TRANSPARENT)
def test_transparent_pixels_are_not_light(tmp_path: Path, name: str) -> None:
    path, (picture, options, opaque) = tmp_path / "shot.png", TRANSPARENT[name]
    picture.save(path, **options)
    shot = read(path)
    np.testing.assert_array_equal(shot.mask, opaque)
    np.testing.assert_array_equal(shot.image[opaque], SHOT[opaque])
    assert any(f"{(~opaque).sum()} pixels without a value" in note for note in shot.notes)


def test_one_bit_and_a_dark_table_of_greys(tmp_path: Path) -> None:
    for suffix in (".png", ".bmp"):
        path = tmp_path / f"shot{suffix}"
        Image.fromarray(SHOT > 100).save(path)
        np.testing.assert_array_equal(read(path).image > 0, SHOT > 100)
        table_of_greys(np.arange(255, -1, -1)).save(path)
        np.testing.assert_array_equal(read(path).image, 255 - SHOT)


def png_info(name: bytes, data: bytes) -> dict[str, PngImagePlugin.PngInfo]:
    info = PngImagePlugin.PngInfo()
    info.add(name, data)
    return {"pnginfo": info}


@pytest.mark.parametrize(
    ("suffix", "options", "expected"),
    [
        (".png", png_info(b"gAMA", struct.pack(">I", 45455)), ["gamma"]),
        (".png", png_info(b"gAMA", struct.pack(">I", 100_000)), []),
        (".png", png_info(b"sRGB", b"\0"), ["gamma"]),
        (".png", png_info(b"tIME", bytes(7)), []),
        (".png", {"icc_profile": b"desc sRGB IEC61966"}, ["gamma"]),
        (".png", {"icc_profile": b"desc Linear grey"}, []),
        (".png", {}, []),
        (".bmp", {}, []),
        (".jpg", {}, ["gamma"]),
    ],
)
def test_pixels_that_are_not_proportional_to_light_get_a_caution(
    tmp_path: Path, suffix: str, options: dict[str, Any], expected: list[str]
) -> None:
    Image.fromarray(SHOT).save(tmp_path / f"shot{suffix}", **options)
    assert [each.code for each in read_shot(tmp_path / f"shot{suffix}").cautions] == expected


def test_mask_for_screens_gives_no_caution_and_its_gaps_are_unusable(tmp_path: Path) -> None:
    mask = np.full(SHOT.shape, 255, np.uint8)
    mask[:4] = 0
    mask[4:6] = 9
    Image.fromarray(mask).save(tmp_path / "mask.png", **png_info(b"sRGB", b"\0"), transparency=9)
    recipe = Recipe(mask=tmp_path / "mask.png", options={"n_sites": 60})
    result = run(recipe, 200.0 + SHOT)
    assert "gamma" not in {caution.code for caution in result.report.cautions}
    np.testing.assert_array_equal(picture_mask(tmp_path / "mask.png"), mask == 255)


@pytest.mark.parametrize(
    ("suffix", "dpi", "size"),
    [(".png", 72, None), (".jpg", 300, None), (".png", 25400 / 6.5, 6.5e-6), (".bmp", 96, None)],
)
def test_size_of_a_pixel_is_offered_unless_it_may_be_a_default(
    tmp_path: Path, suffix: str, dpi: float, size: float | None
) -> None:
    path = tmp_path / f"shot{suffix}"
    Image.fromarray(SHOT).save(path, dpi=(dpi, dpi))
    stated = read_shot(path).metadata.get("geometry", {}).get("detector_pixel_size")
    assert stated == (None if size is None else pytest.approx(size, rel=1e-3))
