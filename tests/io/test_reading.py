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
    ("name", "values"),
    [
        ("shot.png", (4 * RAMP).astype(np.uint8)),
        ("shot.png", (1000 * RAMP).astype(np.uint16)),
        ("shot.bmp", (4 * RAMP).astype(np.uint8)),
        ("shot.jpg", np.full((16, 24), 77, np.uint8)),
    ],
)
def test_grey_pictures_come_back(tmp_path: Path, name: str, values: AnyArray) -> None:
    iio.imwrite(tmp_path / name, values)
    radiograph = read_shot(tmp_path / name)
    np.testing.assert_array_equal(radiograph.image, values)
    assert radiograph.metadata["bits"] == 8 * values.dtype.itemsize


@pytest.mark.parametrize(
    ("channel", "factor"),
    [("red", 1), ("green", 2), ("blue", 3), ("mean", 2), (2, 3), ("1", 2)],
)
@pytest.mark.parametrize("suffix", [".png", ".tif", ".bmp"])
def test_channel_of_colour_image(
    tmp_path: Path, suffix: str, channel: str | int, factor: int
) -> None:
    path = tmp_path / f"film{suffix}"
    iio.imwrite(path, colours())
    np.testing.assert_array_equal(read_shot(path, channel=channel).image, factor * RAMP)
    if suffix == ".tif":
        planes = np.moveaxis(colours(), -1, 0)
        tifffile.imwrite(path, planes, photometric="rgb", planarconfig="separate")
        np.testing.assert_array_equal(read_shot(path, channel=channel).image, factor * RAMP)


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


RUN = {
    "time": np.arange(4.0),
    "shots/3/image": RAMP,
    "shots/beam": (RAMP + 1).astype(np.uint16),
    "note": "film 3",
    "stack": np.zeros((2, 6, 9)),
    "entry/pixel_mask": np.zeros((6, 9), np.uint32),
}


@pytest.mark.parametrize(
    ("left_out", "name", "expected"),
    [
        (["stack", "shots/beam"], None, RAMP),
        ([], "shots/3/image", RAMP),
        ([], "shots/beam", RAMP + 1),
        (["shots/beam"], None, r"has 2 images: expected one.* as run\.h5::"),
        ([], None, r"has 3 images: .* 'shots/beam' \(6×9 uint16\)"),
        (["stack", "shots/beam", "shots/3/image"], None, r"has no image: .*'wave' \(6×9, complex"),
        ([], "shots/bean", "no array 'shots/bean': did you mean 'shots/beam'"),
        ([], "shots/3/imag", "no array 'shots/3/imag': did you mean 'shots/3/image'"),
        ([], "note", "holds 'note' as text"),
        ([], "stack", "holds 2 frames: expected one image"),
    ],
)
def test_hdf5_gives_its_only_image_or_the_array_that_is_named(
    tmp_path: Path, left_out: list[str], name: str | None, expected: str | AnyArray
) -> None:
    path = tmp_path / "run.h5"
    with h5py.File(path, "w") as file:
        file.attrs["object_type"] = "fields"
        file["wave"] = RAMP * 1j
        for key in RUN.keys() - set(left_out):
            file[key] = RUN[key]
    if isinstance(expected, str):
        with pytest.raises((FileFormatError, InputError), match=expected):
            read_shot(path, variable=name)
        return
    shot = read_shot(path, variable=name)
    np.testing.assert_array_equal(shot.image, expected)
    assert shot.metadata["variable"] == name or name is None
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
