import subprocess
import sys
from pathlib import Path
from typing import Any

import h5py
import imageio.v3 as iio
import numpy as np
import pytest
import tifffile

from helpers.public_data import load_donut, public_file, public_names
from helpers.toroid import noisy_toroid_image, toroid_image
from napari_shadowinv._typing import AnyArray, FloatArray
from napari_shadowinv.errors import FileFormatError, InputError
from napari_shadowinv.io import read, read_dataset, read_shot, read_toml
from napari_shadowinv.io.files import sha256
from napari_shadowinv.io.images import film_cautions
from napari_shadowinv.shot import Shot

RAMP = np.arange(6 * 9).reshape(6, 9)


def colours() -> np.ndarray[Any, Any]:
    return np.stack([RAMP, 2 * RAMP, 3 * RAMP], axis=-1).astype(np.uint8)


@pytest.mark.parametrize("dtype", ["u1", "u2", "u4", "i2", "i4", "f4", "f8", ">u2", ">f4"])
@pytest.mark.parametrize("suffix", [".tif", ".npy"])
def test_values_of_any_depth_come_back(tmp_path: Path, dtype: str, suffix: str) -> None:
    values = (RAMP * 3 - (20 if np.dtype(dtype).kind in "if" else 0)).astype(dtype)
    path = tmp_path / f"shot{suffix}"
    tifffile.imwrite(path, values) if suffix == ".tif" else np.save(path, values)
    radiograph = read_shot(path)
    assert radiograph.image.dtype == np.float64
    np.testing.assert_array_equal(radiograph.image, values)
    assert radiograph.metadata["bits"] == 8 * np.dtype(dtype).itemsize
    assert np.dtype(radiograph.metadata["dtype"]).newbyteorder("=") == np.dtype(dtype).newbyteorder(
        "="
    )
    assert radiograph.metadata["sha256"] == sha256(path)
    assert radiograph.path == path
    assert radiograph.setup is None


@pytest.mark.parametrize(
    ("suffix", "dtype"), [(".png", np.uint8), (".png", np.uint16), (".bmp", np.uint8)]
)
def test_grey_pictures_come_back(tmp_path: Path, suffix: str, dtype: Any) -> None:
    values = (RAMP * (1000 if dtype == np.uint16 else 4)).astype(dtype)
    path = tmp_path / f"shot{suffix}"
    iio.imwrite(path, values)
    radiograph = read_shot(path)
    np.testing.assert_array_equal(radiograph.image, values)
    assert radiograph.metadata["bits"] == 8 * np.dtype(dtype).itemsize


def test_uniform_jpeg_comes_back(tmp_path: Path) -> None:
    path = tmp_path / "shot.jpg"
    iio.imwrite(path, np.full((16, 24), 77, np.uint8))
    np.testing.assert_array_equal(read_shot(path).image, np.full((16, 24), 77.0))


@pytest.mark.parametrize(
    ("channel", "expected"),
    [
        ("red", RAMP),
        ("green", 2 * RAMP),
        ("blue", 3 * RAMP),
        ("mean", 2 * RAMP),
        (2, 3 * RAMP),
        ("1", 2 * RAMP),
    ],
)
@pytest.mark.parametrize("suffix", [".png", ".tif", ".bmp"])
def test_channel_of_colour_image(
    tmp_path: Path, suffix: str, channel: str | int, expected: np.ndarray[Any, Any]
) -> None:
    path = tmp_path / f"film{suffix}"
    iio.imwrite(path, colours())
    np.testing.assert_array_equal(read_shot(path, channel=channel).image, expected)


def test_planar_colour_tiff(tmp_path: Path) -> None:
    path = tmp_path / "film.tif"
    planes = np.moveaxis(colours(), -1, 0)
    tifffile.imwrite(path, planes, photometric="rgb", planarconfig="separate")
    np.testing.assert_array_equal(read_shot(path, channel="blue").image, 3 * RAMP)


def test_colour_needs_a_choice_that_exists(tmp_path: Path) -> None:
    path = tmp_path / "film.png"
    iio.imwrite(path, colours())
    with pytest.raises(
        InputError, match=r'3 channels: .* convert it to dose .* "red", "green", "blue"'
    ):
        read(path)
    for channel in ("purple", 3, "-1"):
        with pytest.raises(InputError, match="no channel"):
            read(path, channel=channel)


@pytest.mark.parametrize("alpha", [False, True])
def test_equal_channels_are_grey(tmp_path: Path, alpha: bool) -> None:
    planes = [RAMP] * 3 + [np.full_like(RAMP, 200)] * alpha
    path = tmp_path / "grey.png"
    iio.imwrite(path, np.stack(planes, axis=-1).astype(np.uint8))
    np.testing.assert_array_equal(read_shot(path).image, RAMP)


def test_name_may_lie(tmp_path: Path) -> None:
    path = tmp_path / "shot.png"
    tifffile.imwrite(path, RAMP.astype(np.uint16))
    radiograph = read_shot(path)
    assert radiograph.metadata["kind"] == "tiff"
    np.testing.assert_array_equal(radiograph.image, RAMP)


def test_compressed_tiff_with_wrong_bytes_is_named(tmp_path: Path) -> None:
    path = tmp_path / "shot.tif"
    tifffile.imwrite(path, RAMP.astype(np.uint16), compression="zlib")
    content = bytearray(path.read_bytes())
    with tifffile.TiffFile(path) as tiff:
        page = tiff.pages.first
        start, count = page.dataoffsets[0], page.databytecounts[0]
    content[start : start + count] = bytes(count)
    path.write_bytes(content)
    with pytest.raises(FileFormatError, match="damaged"):
        read(path)


def test_sixteen_bit_colour_png_is_refused(tmp_path: Path) -> None:
    import struct
    import zlib

    def chunk(name: bytes, data: bytes) -> bytes:
        body = name + data
        return struct.pack(">I", len(data)) + body + struct.pack(">I", zlib.crc32(body))

    rows = b"".join(b"\0" + bytes(range(24)) for _ in range(4))
    header = struct.pack(">IIBBBBB", 4, 4, 16, 2, 0, 0, 0)
    path = tmp_path / "film.png"
    path.write_bytes(
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", header)
        + chunk(b"IDAT", zlib.compress(rows))
        + chunk(b"IEND", b"")
    )
    with pytest.raises(FileFormatError, match="16 bits per channel"):
        read(path, channel="red")


def test_npy_of_objects_or_other_shape_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "shot.npy"
    np.save(path, np.array([{"a": 1}], dtype=object), allow_pickle=True)
    with pytest.raises(FileFormatError, match="Python objects"):
        read(path)
    np.save(path, np.zeros((2, 6, 3)))
    with pytest.raises(FileFormatError, match=r"shape \(2, 6, 3\), as of pictures in colour"):
        read(path)
    np.save(path, np.zeros((6, 9), complex))
    with pytest.raises(FileFormatError, match="complex128"):
        read(path)


def test_only_image_of_hdf5_needs_no_name(tmp_path: Path) -> None:
    path = tmp_path / "other.h5"
    with h5py.File(path, "w") as file:
        file["time"], file["data"] = np.arange(6.0), RAMP
        file["entry/pixel_mask"] = np.zeros((6, 9), np.uint32)
        file.attrs["object_type"] = "fields"
    np.testing.assert_array_equal(read(path).image, RAMP)
    with h5py.File(path, "a") as file:
        file["beam"] = RAMP
    with pytest.raises(FileFormatError, match=r"has 2 images: expected one.* as other\.h5::"):
        read(path)
    with h5py.File(path, "a") as file:
        del file["beam"], file["data"]
        file["data"] = RAMP * 1j
    with pytest.raises(FileFormatError, match=r"has no image: .*'data' \(6×9, complex\)"):
        read(path)


def test_any_hdf5_gives_the_array_that_is_named(tmp_path: Path) -> None:
    path = tmp_path / "run.h5"
    with h5py.File(path, "w") as file:
        file["time"] = np.arange(4.0)
        file["shots/3/image"] = RAMP
        file["shots/beam"] = (RAMP + 1).astype(np.uint16)
        file["note"] = "film 3"
        file["stack"] = np.zeros((2, 6, 9))
    with pytest.raises(FileFormatError, match=r"has 3 images: .* 'shots/beam' \(6×9 uint16\)"):
        read(path)
    for name, expected in (("shots/3/image", RAMP), ("shots/beam", RAMP + 1)):
        radiograph = read_shot(path, variable=name)
        np.testing.assert_array_equal(radiograph.image, expected)
        assert radiograph.metadata["variable"] == name
    for wrong, nearest in (("shots/bean", "shots/beam"), ("shots/3/imag", "shots/3/image")):
        with pytest.raises(InputError, match=f"no array '{wrong}': did you mean '{nearest}'"):
            read(path, variable=wrong)
    with pytest.raises(InputError, match="holds 'note' as text"):
        read(path, variable="note")
    with pytest.raises(FileFormatError, match=r"holds 2 frames: expected one image"):
        read_shot(path, variable="stack")
    path.write_bytes(path.read_bytes()[:-2000])
    with pytest.raises(FileFormatError, match="could not be read"):
        read(path, variable="shots/3/image")


def test_image_is_no_result(tmp_path: Path) -> None:
    path = tmp_path / "shot.npy"
    np.save(path, RAMP)
    with pytest.raises(FileFormatError, match="is an image: expected the result"):
        read_dataset(path)


def test_toml_mistakes_name_file_and_line(tmp_path: Path) -> None:
    path = tmp_path / "setup.toml"
    path.write_text("energy = 14.7\nkind = \n")
    with pytest.raises(InputError, match=r"setup\.toml is not valid TOML: .*line 2"):
        read_toml(path)
    with pytest.raises(FileFormatError, match="does not exist"):
        read_toml(tmp_path / "nowhere.toml")


def test_bins_sum_counts_and_widen_pixels(proton_setup: Any) -> None:
    mask = np.ones((6, 9), bool)
    mask[0, 0] = False
    shot = Shot(RAMP.astype(float), setup=proton_setup, mask=mask, source=np.ones((6, 9)))
    binned = shot.bin_pixels(2)
    assert binned.image.shape == (3, 4)
    assert binned.image.sum() == RAMP[:6, :8].sum()
    assert binned.image[1, 2] == RAMP[2:4, 4:6].sum()
    assert binned.mask is not None
    assert np.argwhere(~binned.mask).tolist() == [[0, 0]]
    assert binned.source is not None
    assert (binned.source == 4).all()
    assert binned.setup is not None
    assert binned.setup.object_pixel_size == 2 * proton_setup.object_pixel_size
    assert binned.notes == ("binned 2 × 2, 0 rows and 1 columns cut off",)
    with pytest.raises(InputError, match="from 1 to 3"):
        shot.bin_pixels(4)


def test_import_is_light() -> None:
    heavy = [
        "numba",
        "matplotlib",
        "xarray",
        "h5py",
        "tifffile",
        "imageio",
        "scipy",
        "napari",
        "dask",
    ]
    code = "import sys; from napari_shadowinv.io import read, write; "
    code += f"print([m for m in {heavy!r} if m in sys.modules])"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert result.stdout.strip() == "[]", result.stderr


def test_real_film_scan() -> None:
    path = public_file("rcf/RCF_18H.tif")
    with pytest.raises(InputError, match="colour image with 3 channels"):
        read(path)
    red = read_shot(path, channel="red")
    assert red.image.shape == (548, 1022)
    assert red.metadata["bits"] == 16
    np.testing.assert_array_equal(red.image, tifffile.imread(path)[..., 0])
    assert "wrong sign unless it is converted to dose first" in red.cautions[0].text


@pytest.mark.parametrize("name", public_names("rcf", ".tif"))
def test_real_films_get_the_film_warning(name: str) -> None:
    scan = tifffile.imread(public_file(name))
    for grey in (scan[..., 0], scan[..., 2], (scan[..., 1] // 257).astype(np.uint8)):
        assert film_cautions(grey, None)


def as_scan(image: FloatArray) -> AnyArray:
    return np.clip(image / image.max() * 65535, 0, None).astype(np.uint16)


@pytest.mark.parametrize("peak", [24, 97, 194])  # the last is nearly empty in the middle
def test_the_toroid_gets_no_film_warning(peak: int) -> None:
    for image in (toroid_image(peak), noisy_toroid_image(peak)):
        assert not film_cautions(as_scan(image), None)


def test_the_donut_gets_no_film_warning() -> None:
    assert not film_cautions(as_scan(load_donut()[0]), None)


def test_real_shadowgram(burner: list[Path]) -> None:
    assert not any(read_shot(path).cautions for path in burner)
    radiograph = read_shot(burner[0])
    assert radiograph.image.shape == (928, 1152)
    assert np.percentile(radiograph.image, 0.1) >= 54
    assert abs(radiograph.image.mean() - 76.5) < 0.1
