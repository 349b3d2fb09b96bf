import struct
from pathlib import Path

import h5py
import numpy as np
import pytest
from scipy.io import savemat

from helpers.image_files import save_mat73
from napari_shadowinv.errors import FileFormatError, InputError
from napari_shadowinv.io import read_shot
from napari_shadowinv.io.files import sha256

RAMP = np.arange(6 * 9).reshape(6, 9)


@pytest.mark.parametrize("dtype", ["u1", "u2", "u4", "i2", "i4", "i8", "f4", "f8", "?", ">u2"])
@pytest.mark.parametrize("layout", ["5", "7", "7.3"])
def test_array_comes_back(tmp_path: Path, layout: str, dtype: str) -> None:
    path = tmp_path / "shot.mat"
    values = (RAMP % 7 * 5).astype(dtype)
    if layout == "7.3":
        save_mat73(path, {"shot": values})
    else:
        savemat(path, {"shot": values}, do_compression=layout == "7")
    radiograph = read_shot(path)
    np.testing.assert_array_equal(radiograph.image, values)
    assert radiograph.image.dtype == np.float64
    assert radiograph.metadata["variable"] == "shot"
    assert radiograph.metadata["kind"] == ("hdf5" if layout == "7.3" else "mat")
    assert radiograph.metadata["bits"] == 8 * np.dtype(dtype).itemsize
    assert radiograph.metadata["sha256"] == sha256(path)


@pytest.mark.parametrize("layout", ["5", "7", "7.3"])
def test_scalars_vectors_and_colours_are_no_candidates(tmp_path: Path, layout: str) -> None:
    path = tmp_path / "shot.mat"
    arrays = {"a": np.ones((1, 1)), "b": np.ones((1, 9)), "c": np.ones((4, 5, 3), np.uint8)}
    arrays["shot"] = RAMP * 0.5
    if layout == "7.3":
        save_mat73(path, arrays)
    else:
        foreign = {"note": "film 3", "s": {"x": RAMP}, "cell": np.array([1, "a"], dtype=object)}
        savemat(path, {**foreign, **arrays}, do_compression=layout == "7")
    np.testing.assert_array_equal(read_shot(path).image, RAMP / 2)


@pytest.mark.parametrize("layout", ["5", "7", "7.3"])
def test_several_candidates_are_listed_and_chosen(tmp_path: Path, layout: str) -> None:
    path = tmp_path / "shot.mat"
    arrays = {"shot": RAMP * 0.5, "beam": np.ones((4, 5), np.uint16), "z": np.ones((1, 3))}
    if layout == "7.3":
        save_mat73(path, arrays)
    else:
        savemat(path, arrays, do_compression=layout == "7")
    with pytest.raises((InputError, FileFormatError), match="2 images: expected one, or") as error:
        read_shot(path)
    assert f"'shot' (6×9 {'float64' if layout == '7.3' else 'double'})" in str(error.value)
    assert "'beam' (4×5 uint16)" in str(error.value)
    np.testing.assert_array_equal(read_shot(path, variable="beam").image, np.ones((4, 5)))
    with pytest.raises(InputError, match=r"has no .* 'Shot': .*it holds "):
        read_shot(path, variable="Shot")


def test_variables_beside_an_image_of_73_do_not_change_it(tmp_path: Path) -> None:
    offset = {name: np.full((1, 1), 7.0) for name in ("offset", "shot_scaling_factor")}
    path = save_mat73(tmp_path / "shot.mat", {"shot": RAMP * 0.5, **offset})
    np.testing.assert_array_equal(read_shot(path).image, RAMP / 2)


def test_cells_of_73_are_no_candidates(tmp_path: Path) -> None:
    path = save_mat73(tmp_path / "shot.mat", {"#refs#/a": RAMP * 1.0, "shot": RAMP * 0.5})
    np.testing.assert_array_equal(read_shot(path).image, RAMP / 2)


def test_variable_of_another_kind_is_refused(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", RAMP)
    with pytest.raises(InputError, match="is neither a MATLAB nor an HDF5 file"):
        read_shot(tmp_path / "a.npy", variable="shot")


def test_long_names_and_many_zeros_come_back(tmp_path: Path) -> None:
    path = tmp_path / "shot.mat"
    name = "a" * 31
    savemat(path, {name: np.zeros((2000, 1000))}, do_compression=True)
    assert path.stat().st_size < 20_000
    assert read_shot(path, variable=name).image.shape == (2000, 1000)


def test_big_endian_file_comes_back(tmp_path: Path) -> None:
    def element(kind: int, content: bytes) -> bytes:
        return struct.pack(">II", kind, len(content)) + content.ljust(-(-len(content) // 8) * 8)

    body = element(6, struct.pack(">II", 6, 0)) + element(5, struct.pack(">ii", 6, 9))
    # A short name shares its tag; doubles that are whole are kept in two bytes.
    body += struct.pack(">HH4s", 4, 1, b"shot") + element(4, RAMP.T.astype(">u2").tobytes())
    path = tmp_path / "shot.mat"
    path.write_bytes(b"MATLAB 5.0 MAT-file".ljust(124) + b"\x01\x00MI" + element(14, body))
    radiograph = read_shot(path)
    np.testing.assert_array_equal(radiograph.image, RAMP)
    assert radiograph.metadata["bits"] == 64


def test_matlab_marks_turn_an_array_of_plain_hdf5(tmp_path: Path) -> None:
    path = save_mat73(tmp_path / "shot.h5", {"shot": RAMP.astype(float)}, userblock=0)
    radiograph = read_shot(path)
    assert radiograph.metadata["kind"] == "hdf5"
    np.testing.assert_array_equal(radiograph.image, RAMP)


@pytest.mark.parametrize("userblock", [0, 512])
def test_pradformat_stays_pradformat(tmp_path: Path, userblock: int) -> None:
    path = save_mat73(tmp_path / "shot.mat", {"image": RAMP.astype(float)}, userblock)
    head = path.read_bytes()[:userblock]
    with h5py.File(path, "a") as file:
        file.attrs["object_type"] = "radiograph"
        file.attrs["pixel_width"] = 1e-4
    assert path.read_bytes()[:userblock] == head
    radiograph = read_shot(path)
    assert radiograph.metadata["kind"] == "pradformat"
    # pradformat stores rows first.
    np.testing.assert_array_equal(radiograph.image, RAMP.T)
