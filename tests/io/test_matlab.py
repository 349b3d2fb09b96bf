import struct
from pathlib import Path

import h5py
import numpy as np
import pytest
from scipy.io import savemat

from helpers.image_files import save_mat73
from napari_shadowinv.errors import FileFormatError, InputError
from napari_shadowinv.io import read_shot

RAMP = np.arange(6 * 9).reshape(6, 9)


def save(path: Path, layout: str, arrays: dict[str, np.ndarray], **foreign: object) -> Path:
    """Write as a version of MATLAB does; version 7.3 cannot be given foreign variables here."""
    if layout == "7.3":
        return save_mat73(path, arrays)
    savemat(path, {**foreign, **arrays}, do_compression=layout == "7")
    return path


@pytest.mark.parametrize("layout", ["5", "7", "7.3"])
def test_only_images_are_candidates_of_which_one_is_chosen(tmp_path: Path, layout: str) -> None:
    arrays = {"a": np.ones((1, 1)), "b": np.ones((1, 9)), "c": np.ones((4, 5, 3), np.uint8)}
    arrays["shot"] = RAMP * 0.5
    foreign = {"note": "film 3", "s": {"x": RAMP}, "cell": np.array([1, "a"], dtype=object)}
    path = save(tmp_path / "shot.mat", layout, arrays, **foreign)
    shot = read_shot(path)
    np.testing.assert_array_equal(shot.image, RAMP / 2)
    assert shot.metadata["variable"] == "shot"
    save(path, layout, {**arrays, "beam": np.ones((4, 5), np.uint16)})
    with pytest.raises((InputError, FileFormatError), match="2 images: expected one, or") as error:
        read_shot(path)
    assert f"'shot' (6×9 {'float64' if layout == '7.3' else 'double'})" in str(error.value)
    assert "'beam' (4×5 uint16)" in str(error.value)
    np.testing.assert_array_equal(read_shot(path, variable="beam").image, np.ones((4, 5)))
    with pytest.raises(InputError, match=r"has no .* 'Shot': .*it holds "):
        read_shot(path, variable="Shot")


def test_variables_and_cells_beside_an_image_of_73_do_not_change_it(tmp_path: Path) -> None:
    offset = {name: np.full((1, 1), 7.0) for name in ("offset", "shot_scaling_factor")}
    for beside in (offset, {"#refs#/a": RAMP * 1.0}):
        path = save_mat73(tmp_path / "shot.mat", {"shot": RAMP * 0.5, **beside})
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
