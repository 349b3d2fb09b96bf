"""PNG, JPEG and BMP: upright, without transparent pixels, and with a word about their gamma."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image, PngImagePlugin

from napari_shadowinv import Recipe, run
from napari_shadowinv.errors import FileFormatError
from napari_shadowinv.io import read, read_shot
from napari_shadowinv.io.images import read_scan
from napari_shadowinv.pipeline.inversion_run import picture_mask

SHOT = np.random.default_rng(0).integers(1, 255, (24, 32)).astype(np.uint8)
SMOOTH = np.add.outer(3 * np.arange(24), 4 * np.arange(32)).astype(np.uint8)


def turned(orientation: int) -> Image.Exif:
    exif = Image.Exif()
    exif[274] = orientation
    return exif


def codes(path: Path) -> list[str]:
    return [caution.code for caution in read_shot(path).cautions]


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


def write_grey(path: Path, **options: Any) -> np.ndarray[Any, Any]:
    Image.fromarray(SHOT).save(path, transparency=int(SHOT[3, 4]), **options)
    return np.not_equal(SHOT, SHOT[3, 4])


def write_sixteen_bits(path: Path) -> np.ndarray[Any, Any]:
    Image.fromarray(SHOT.astype(np.uint16)).save(path, transparency=int(SHOT[3, 4]))
    return np.not_equal(SHOT, SHOT[3, 4])


def write_alpha(path: Path) -> np.ndarray[Any, Any]:
    alpha = np.where(SHOT > 100, 255, 0).astype(np.uint8)
    Image.fromarray(np.stack([SHOT] * 3 + [alpha], axis=-1)).save(path)
    return alpha > 0


def write_grey_and_alpha(path: Path) -> np.ndarray[Any, Any]:
    alpha = np.where(SHOT > 100, 255, 0).astype(np.uint8)
    Image.fromarray(np.stack([SHOT, alpha], axis=-1)).save(path)
    return alpha > 0


def write_table(path: Path) -> np.ndarray[Any, Any]:
    picture = Image.fromarray(SHOT).convert("P")
    picture.putpalette(np.repeat(np.arange(256), 3).astype(np.uint8).tobytes())
    picture.save(path, transparency=int(SHOT[3, 4]))
    return np.not_equal(SHOT, SHOT[3, 4])


@pytest.mark.parametrize(
    "write", [write_grey, write_sixteen_bits, write_alpha, write_grey_and_alpha, write_table]
)
def test_transparent_pixels_are_not_light(tmp_path: Path, write: Any) -> None:
    path = tmp_path / "shot.png"
    opaque = write(path)
    shot = read(path)
    np.testing.assert_array_equal(shot.usable, opaque)
    np.testing.assert_array_equal(shot.image[opaque], SHOT[opaque])
    assert any(f"{(~opaque).sum()} pixels without a value" in note for note in shot.notes)


def test_one_bit_and_a_dark_table_of_greys(tmp_path: Path) -> None:
    for suffix in (".png", ".bmp"):
        path = tmp_path / f"shot{suffix}"
        Image.fromarray(SHOT > 100).save(path)
        np.testing.assert_array_equal(read(path).image > 0, SHOT > 100)
        negative = Image.fromarray(SHOT).convert("P")
        negative.putpalette(np.repeat(np.arange(255, -1, -1), 3).astype(np.uint8).tobytes())
        negative.save(path)
        np.testing.assert_array_equal(read(path).image, 255 - SHOT)


def test_pixels_of_ink_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "shot.jpg"
    Image.fromarray(np.stack([SHOT] * 4, axis=-1), "CMYK").save(path)
    with pytest.raises(FileFormatError, match="kind CMYK"):
        read(path)


def write_png(path: Path, name: bytes, data: bytes) -> None:
    info = PngImagePlugin.PngInfo()
    info.add(name, data)
    Image.fromarray(SHOT).save(path, pnginfo=info)


@pytest.mark.parametrize(
    ("name", "data", "expected"),
    [
        (b"gAMA", struct.pack(">I", 45455), ["gamma"]),
        (b"gAMA", struct.pack(">I", 100_000), []),
        (b"sRGB", b"\0", ["gamma"]),
        (b"tIME", bytes(7), []),
    ],
)
def test_png_for_screens_gets_a_caution(
    tmp_path: Path, name: bytes, data: bytes, expected: list[str]
) -> None:
    path = tmp_path / "shot.png"
    write_png(path, name, data)
    assert codes(path) == expected


def test_png_with_a_colour_profile_gets_a_caution_unless_it_is_linear(tmp_path: Path) -> None:
    path = tmp_path / "shot.png"
    for profile, expected in ((b"desc sRGB IEC61966", ["gamma"]), (b"desc Linear grey", [])):
        Image.fromarray(SHOT).save(path, icc_profile=profile)
        assert codes(path) == expected


def test_jpeg_gets_a_caution_and_bmp_none(tmp_path: Path) -> None:
    for suffix, expected in ((".jpg", ["gamma"]), (".bmp", []), (".png", [])):
        path = tmp_path / f"shot{suffix}"
        Image.fromarray(SHOT).save(path)
        assert codes(path) == expected


def test_mask_for_screens_gives_no_caution_and_its_gaps_are_unusable(tmp_path: Path) -> None:
    mask = np.full(SHOT.shape, 255, np.uint8)
    mask[:4] = 0
    mask[4:6] = 9
    info = PngImagePlugin.PngInfo()
    info.add(b"sRGB", b"\0")
    Image.fromarray(mask).save(tmp_path / "mask.png", pnginfo=info, transparency=9)
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
