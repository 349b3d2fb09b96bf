"""Frames of files that hold many: each is read alone, and missing ones are not zeros."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest
import tifffile
from scipy.io import savemat

from helpers.image_files import save_spe
from napari_shadowinv import FileFormatError, InputError, read
from napari_shadowinv.io import hdf5, read_shot
from napari_shadowinv.io.frames import FileFrame, find_frames, images_in, left_out_of
from napari_shadowinv.io.read_write import read_frame

CUBE = np.arange(2 * 3 * 5 * 7, dtype=np.uint16).reshape(2, 3, 5, 7)


@pytest.fixture
def nexus(tmp_path: Path) -> Path:
    """A NeXus file as a detector writes it, with a chunk for each frame."""
    path = tmp_path / "run_12.nxs"
    with h5py.File(path, "w") as file:
        data = file.create_dataset("entry/data/data", data=CUBE, chunks=(1, 1, 5, 7))
        file["entry/single"] = CUBE[:1, :1]
        file["entry/times"] = np.arange(6.0)
        file.attrs["default"], file["entry"].attrs["default"] = "entry", np.bytes_("data")
        data.parent.attrs["signal"] = "data"
    return path


@pytest.fixture
def loaded(monkeypatch) -> list[int]:
    """Number of values of each part of an HDF5 file that is loaded."""
    sizes: list[int] = []
    getitem = h5py.Dataset.__getitem__

    def logged(dataset, *args, **kwargs):
        values = getitem(dataset, *args, **kwargs)
        sizes.append(np.size(values))
        return values

    monkeypatch.setattr(h5py.Dataset, "__getitem__", logged)
    return sizes


@pytest.mark.parametrize("name", ["/entry/data/data", "entry/data", "/", ""])
def test_address_names_an_array_or_a_default_of_nexus(nexus, name):
    frames = read(f"{nexus}::{name}")
    assert frames.image.dims == ("shot", "y", "x")
    np.testing.assert_array_equal(frames.image, CUBE.reshape(6, 5, 7))
    assert list(frames.name.values) == [f"run_12.nxs[{i},{j}]" for i in (0, 1) for j in (0, 1, 2)]


def test_only_computed_and_chosen_frames_are_loaded(nexus, loaded):
    frames = read(f"{nexus}::/entry/data/data")
    assert loaded == [35]
    frames.image[2:4].compute()
    assert loaded == [35] * 3
    shot = read(f"{nexus}::/entry/data/data[1,2]")
    assert loaded == [35] * 4
    assert shot.metadata["variable"] == "/entry/data/data[1,2]"
    for frame in (shot, read_shot(nexus, variable="/entry/data/data[1,2]")):
        np.testing.assert_array_equal(frame.image, CUBE[1, 2])
    # Leading axes of length one are one image.
    assert read(f"{nexus}::/entry/single").image.shape == (5, 7)


def test_wrong_names_and_indices_are_refused(nexus):
    listed = r"\? it holds 'entry/data/data'"
    for name, words in (
        ("entry/data/data[1]", r"frames from \[0,0\] to \[1,2\]"),
        ("entry/data/data[1,3]", r"frames from \[0,0\] to \[1,2\]"),
        ("entry/datum", rf"has no array 'entry/datum': did you mean 'entry/data/data'{listed}"),
        ("entry/times", r"with shape \(6,\): expected an image"),
    ):
        with pytest.raises((InputError, FileFormatError), match=words):
            read(f"{nexus}::{name}")
    with pytest.raises(FileFormatError, match=r"6 frames: .* such as 'entry/data/data\[0,0\]'"):
        read_shot(nexus, variable="entry/data/data")
    with h5py.File(nexus, "r+") as file:
        file["entry"].attrs["default"] = "/entry"  # a default in a circle
    with pytest.raises(InputError, match=r"has no array '/': it holds .*'entry/data/data'"):
        read(f"{nexus}::/")


def test_frame_that_is_not_written_yet_is_refused(tmp_path):
    path = tmp_path / "growing.h5"
    with h5py.File(path, "w") as file:
        data = file.create_dataset("data", (4, 8, 8), "u2", chunks=(1, 4, 8))
        data[:2] = 7
        data[2, :4] = 7
        file.create_dataset("never", (4, 8, 8), "u2")
    assert read_frame(FileFrame(path, "data[1]", 1, "data")).image.min() == 7
    for number, name in ((2, "data"), (3, "data"), (0, "never")):
        with pytest.raises(FileFormatError, match=f"does not hold frame {number} of '/{name}' yet"):
            read_frame(FileFrame(path, name, number, name))


def test_filter_that_is_not_installed_is_named(tmp_path, monkeypatch):
    path = tmp_path / "packed.h5"
    with h5py.File(path, "w") as file:
        layout = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
        layout.set_chunk((1, 8, 8))
        layout.set_filter(32008, h5py.h5z.FLAG_OPTIONAL)
        space = h5py.h5s.create_simple((2, 8, 8))
        h5py.h5d.create(file.id, b"data", h5py.h5t.NATIVE_UINT16, space, layout)
        for number in range(2):
            file["data"].id.write_direct_chunk((number, 0, 0), bytes(64))
    monkeypatch.setattr(hdf5, "import_module", _missing)
    with pytest.raises(FileFormatError, match=r"not installed \(32008\): install .* hdf5plugin"):
        read(f"{path}::data")


def _missing(name: str) -> None:
    raise ImportError(name)


def test_tiff_folder_and_pattern_give_lazy_frames(tmp_path):
    planes = CUBE.reshape(6, 5, 7)
    folder = tmp_path / "shots"
    folder.mkdir()
    for number, plane in enumerate(planes):
        tifffile.imwrite(folder / f"shot_{number + 5}.tif", plane)
    film = tmp_path / "film.tif"
    tifffile.imwrite(film, planes, photometric="minisblack")
    for path, name in ((film, "film.tif[4]"), (folder, "shot_9.tif"), (folder / "*", "shot_9.tif")):
        frames = read(path)
        assert str(frames.name[4].values) == name
        np.testing.assert_array_equal(frames.image, planes)


def test_frame_of_another_size_is_named(tmp_path):
    for number, side in enumerate((5, 6)):
        np.save(tmp_path / f"shot_{number}.npy", np.ones((5, side)))
    with pytest.raises(
        FileFormatError, match=r"shot_1.npy has 5 × 6 pixels, the first frame 5 × 5"
    ):
        read(tmp_path).image.compute()


def test_unreadable_file_among_many_is_a_frame(tmp_path, nexus):
    (tmp_path / "run_13.nxs").write_bytes(nexus.read_bytes()[:900])
    names = [frame.name for frame in find_frames(f"{tmp_path}/*.nxs::/entry/data/data")]
    assert len(names) == 7
    assert names[-1] == "run_13.nxs"


@pytest.mark.parametrize("name", ["a.spe", "a.npy", "a.mat", "a.h5", "a.nc", "a.tif"])
def test_burst_in_one_file_is_a_stack(tmp_path, name):
    path, planes = tmp_path / name, CUBE.reshape(6, 5, 7)
    if path.suffix == ".spe":
        # Eight bytes of times follow each frame.
        body = np.pad(planes.reshape(6, -1).view(np.uint8), ((0, 0), (0, 8)))
        save_spe(path, body, footer=b"<SpeFormat/>", frames=6, height=5, width=7)
    elif path.suffix == ".npy":
        np.save(path, planes)
    elif path.suffix == ".tif":
        tifffile.imwrite(path, planes, photometric="minisblack")
    elif path.suffix == ".mat":
        savemat(path, {"burst": np.moveaxis(planes, 0, -1)})
    else:
        with h5py.File(path, "w") as file:
            file["entry/instrument/detector/data"] = planes
    frames = read(path)
    np.testing.assert_array_equal(frames.image, planes)
    assert str(frames.name[4].values) == f"{name}[4]"
    with pytest.raises(FileFormatError, match="holds 6 frames"):
        read_shot(path)


def test_frame_of_a_matlab_stack_has_an_address(tmp_path):
    path = tmp_path / "shots.mat"
    savemat(path, {"burst": np.moveaxis(CUBE, (0, 1), (2, 3)), "beam": CUBE[0, 0]})
    np.testing.assert_array_equal(read(f"{path}::/burst[1,2]").image, CUBE[1, 2])
    np.testing.assert_array_equal(read(f"{path}::beam").image, CUBE[0, 0])
    with pytest.raises(InputError, match=r"no 'burst\[2,0\]': it holds frames .* to \[1,2\]"):
        read(f"{path}::burst[2,0]")


def test_arrays_of_a_deep_file_are_counted_and_loops_end(tmp_path):
    path = tmp_path / "deep.h5"
    with h5py.File(path, "w") as file:
        for number in range(20):
            file[f"a/b/c/d/shot_{number:02d}/image"] = CUBE[0, 0]
        file["a/b/again"] = file["a"]
        file["a/same"] = file["a/b/c/d/shot_00/image"]
        file.create_dataset("elsewhere", (2, 2), "f8", external=[("other.bin", 0, 32)])
    with pytest.raises(InputError) as error:
        read(f"{path}::a/b/c/d/shot_17/imge")
    assert "did you mean 'a/b/c/d/shot_17/image'? it holds" in str(error.value)
    assert str(error.value).endswith("and 13 more")


def test_why_arrays_are_no_images(tmp_path):
    path = tmp_path / "none.h5"
    with h5py.File(path, "w") as file:
        file["field"] = CUBE[0, 0] * 1j
        file["table"] = np.zeros((2, 2), [("a", "f4")])
        file["names"] = np.full((2, 2), b"a")
        file.create_dataset("elsewhere", (2, 2), "f8", external=[("other.bin", 0, 32)])
        file["times"] = np.arange(3.0)
    with pytest.raises(FileFormatError, match="has no image") as error:
        read(path)
    for words in ("complex", "compound", "text", "in another file"):
        assert words in str(error.value)
    assert "times" not in str(error.value)


@pytest.mark.parametrize(
    ("path", "words"),
    [
        ("::/entry/data", "names an array without its file"),
        ("", "an empty text"),
    ],
)
def test_what_is_no_path_is_called_what_it_is(path, words):
    with pytest.raises(InputError, match=words):
        read(path)


def test_brackets_in_the_name_of_a_folder_are_no_pattern(tmp_path):
    for name in ("run[3]", "run3"):
        (tmp_path / name).mkdir()
        np.save(tmp_path / name / f"{name}.npy", CUBE[0, 0])
    found = [frame.path.name for frame in find_frames(tmp_path / "run[3]" / "*.npy")]
    assert found == ["run[3].npy"]
    (tmp_path / "run[3]").rename(tmp_path / "run4")
    found = [frame.path.name for frame in find_frames(tmp_path / "run[3]" / "*.npy")]
    assert found == ["run3.npy"]


def test_case_and_spelling_of_endings_are_alike(tmp_path):
    names = ["shot_1.tif", "SHOT_2.TIF", "shot_3.Tiff"]
    for name in (*names, "shot_4.png", "notes.txt", "log.csv"):
        (tmp_path / name).touch()
    assert [frame.name for frame in find_frames(tmp_path / "*.[tT]if*")] == [names[0], names[2]]
    assert [path.name for path in images_in(tmp_path)] == names
    assert left_out_of(tmp_path) == "1 .csv, 1 .png, 1 .txt"
