"""An HDF5 file's pixels are its own: nothing that lies elsewhere passes for them."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest

from napari_shadowinv.errors import FileFormatError, InputError
from napari_shadowinv.io import read, read_shot

IMAGE = np.random.default_rng(0).normal(100, 10, (20, 24))


def external_link(file: h5py.File, name: str) -> None:
    file[name] = h5py.ExternalLink("other.h5", "image")


def link_to_a_link(file: h5py.File, name: str) -> None:
    file["elsewhere"] = h5py.ExternalLink("other.h5", "/")
    file[name] = h5py.SoftLink("/elsewhere/image")


def raw_storage(file: h5py.File, name: str) -> None:
    file.create_dataset(name, IMAGE.shape, "f8", external=[("other.bin", 0, IMAGE.nbytes)])


def virtual(file: h5py.File, name: str) -> None:
    layout = h5py.VirtualLayout(IMAGE.shape, "f8")
    layout[...] = h5py.VirtualSource("other.h5", "image", IMAGE.shape)
    file.create_virtual_dataset(name, layout)


Place = Callable[[h5py.File, str], None]
ELSEWHERE: tuple[Place, ...] = (external_link, link_to_a_link, raw_storage, virtual)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    with h5py.File(tmp_path / "other.h5", "w") as file:
        file["image"] = IMAGE
    (tmp_path / "other.bin").write_bytes(os.urandom(IMAGE.nbytes))
    return tmp_path


@pytest.mark.parametrize("place", ELSEWHERE)
def test_what_lies_elsewhere_is_refused(folder: Path, place: Place) -> None:
    path = folder / "shot.h5"
    with h5py.File(path, "w") as file:
        file.attrs["object_type"] = "radiograph"
        place(file, "image")
        file["own"] = IMAGE
        file["again"] = h5py.SoftLink("own")
    for variable in (None, "image"):
        with pytest.raises(FileFormatError, match=r"image' itself, but refers to another file"):
            read(path, variable=variable)
    for variable in ("own", "again", "/own"):
        np.testing.assert_array_equal(read_shot(path, variable=variable).image, IMAGE)
    with h5py.File(folder / "shot.mat", "w") as file:
        file["own"] = IMAGE.T
        file["own"].attrs["MATLAB_class"] = np.bytes_(b"double")
        place(file, "shot")
    with pytest.raises(FileFormatError, match="another file"):
        read(folder / "shot.mat", variable="shot")
    loop = folder / "loop.h5"
    with h5py.File(loop, "w") as file:
        file["here"], file["there"] = h5py.SoftLink("/there"), h5py.SoftLink("/here")
        file["gone"] = h5py.ExternalLink("nowhere.h5", "image")
    for name, words in (("here", "too many links"), ("gone", "can't open file")):
        with pytest.raises((FileFormatError, InputError), match=words):
            read(loop, variable=name)
