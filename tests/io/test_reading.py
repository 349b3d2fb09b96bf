import struct
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import h5py
import imageio.v3 as iio
import numpy as np
import pytest
import tifffile
from scipy.io import savemat

from helpers.image_files import save_b16, save_mat73, save_spe
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


def save_mat(layout: str) -> Callable[[Path, AnyArray], object]:
    if layout == "7.3":
        return lambda path, values: save_mat73(path, {"shot": values})
    packed = layout == "7"
    return lambda path, values: savemat(path, {"shot": values}, do_compression=packed)


def save_text(**options: str) -> Callable[[Path, AnyArray], object]:
    keywords = {"fmt": "%.17g", "header": "a shot"} | options
    return lambda path, values: np.savetxt(path, values, **keywords)


def frame_of(code: int, footer: bytes) -> Callable[[Path, AnyArray], object]:
    return lambda path, values: save_spe(path, values, code, footer)


FOOTER = b'<SpeFormat version="3.0"/>'
CODES = {"<f4": 0, "<i4": 1, "<i2": 2, "<u2": 3, "<f8": 5, "u1": 6, "<u4": 8}
SEPARATORS = (" ", ",", ", ", "\t", "   ")
# A file's name, how it is written, the types of its values, and the kind of its format.
SAVED: list[tuple[str, Callable[[Path, AnyArray], object], str, str]] = [
    ("shot.tif", tifffile.imwrite, "u1 u2 u4 i2 i4 f4 f8 >u2 >f4", ""),
    ("shot.npy", np.save, "u1 u2 u4 i2 i4 f4 f8 >u2 >f4", "npy"),
    ("shot.png", iio.imwrite, "u1 u2", ""),
    ("shot.bmp", iio.imwrite, "u1", ""),
    *(("shot.b16", partial(save_b16, comment=text), "u2", "b16") for text in (b"", b"17, f/2")),
    *(("shot.tif", partial(save_b16, comment=text), "u2", "b16") for text in (b"", b"17, f/2")),
    *(
        ("shot.spe", frame_of(code, footer), dtype, "spe")
        for dtype, code in CODES.items()
        for footer in (b"", FOOTER)
    ),
    *(("shot.mat", save_mat(each), "u1 u2 u4 i2 i4 i8 f4 f8 ? >u2", "mat") for each in ("5", "7")),
    ("shot.mat", save_mat("7.3"), "u1 u2 u4 i2 i4 i8 f4 f8 ? >u2", "hdf5"),
    *(
        (f"shot{suffix}", save_text(delimiter=each, newline=end), "f8", "text")
        for suffix in (".txt", ".csv", ".dat", ".TXT")
        for each in SEPARATORS
        for end in ("\n", "\r\n")
    ),
]


@pytest.mark.parametrize(("name", "write", "dtypes", "kind"), SAVED)
def test_values_of_any_depth_come_back(
    tmp_path: Path, name: str, write: Any, dtypes: str, kind: str
) -> None:
    for dtype in map(np.dtype, dtypes.split()):
        path = tmp_path / name
        values = RAMP % 7 * 5 if dtype.kind == "b" else RAMP * 3 - 20 * (dtype.kind in "if")
        values = (values / (3 if kind == "text" else 1)).astype(dtype)
        write(path, values)
        radiograph = read_shot(path)
        assert radiograph.image.dtype == np.float64
        np.testing.assert_array_equal(radiograph.image, values)
        assert kind in ("", radiograph.metadata["kind"])
        if kind != "text":
            assert radiograph.metadata["bits"] == 8 * dtype.itemsize
        if name in ("shot.tif", "shot.npy") and not kind.startswith("b16"):
            stored = np.dtype(radiograph.metadata["dtype"])
            assert stored.newbyteorder("=") == dtype.newbyteorder("=")
        assert radiograph.metadata["sha256"] == sha256(path)
        assert radiograph.path == path
        assert radiograph.setup is None


def test_spe_is_known_by_its_marks_or_its_name(tmp_path: Path) -> None:
    pixels = RAMP.astype("<u2")
    assert read_shot(save_spe(tmp_path / "shot.dat", pixels)).image[1, 2] == 11
    assert read_shot(save_spe(tmp_path / "a.SPE", pixels, marked=False)).image[1, 2] == 11
    with pytest.raises(FileFormatError, match="not in a recognised image format"):
        read_shot(save_spe(tmp_path / "shot.xyz", pixels, marked=False))
    for footer, version in ((b"", 2.5), (FOOTER, 3.0)):
        path = save_spe(tmp_path / "shot.spe", pixels, 3, footer)
        assert read_shot(path).metadata["version"] == version


def test_b16_with_the_basic_header_and_jpeg_come_back(tmp_path: Path) -> None:
    path = tmp_path / "shot.b16"
    header = b"PCO-" + struct.pack("<5i", 24 + 108, 24, 9, 6, 0)
    path.write_bytes(header + RAMP.astype("<u2").tobytes())
    np.testing.assert_array_equal(read_shot(path).image, RAMP)
    # The first pixel stands where the extended header would tell a colour camera.
    path.write_bytes(header + (RAMP * 0 + [1, 0, 0] * 3).astype("<u2").tobytes())
    assert read_shot(path).image[0, 0] == 1
    grey = np.full((16, 24), 77, np.uint8)
    iio.imwrite(tmp_path / "shot.jpg", grey)
    np.testing.assert_array_equal(read_shot(tmp_path / "shot.jpg").image, grey)


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
