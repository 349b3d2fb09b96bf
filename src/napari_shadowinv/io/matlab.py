"""MATLAB's MAT-files, version 5 to 7 (its own layout) and 7.3 (HDF5).

- the one image of a file, or the variable that the user names: `read_mat`
- what there is to choose from: `mat_variables`
- tell MATLAB 7.3 from other HDF5 files: `is_mat73`, `is_other_hdf5`

An image is a numeric array with two rows and two columns at least, so that scalars and
vectors beside it do not count. Fields of structs and entries of cells are not searched.
"""

from __future__ import annotations

from collections.abc import Callable, Container
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from napari_shadowinv._system.safety import refusing_damage
from napari_shadowinv.errors import FileFormatError, InputError
from napari_shadowinv.io.hdf5 import load_dataset, member, members
from napari_shadowinv.io.mat5 import Variable, variables_5

__all__ = ["is_mat73", "is_other_hdf5", "mat_variables", "read_mat"]

_HDF5_OFFSET = 512
# Attributes of pradformat and of .shadowinv, which MATLAB's save does not write.
_FOREIGN_MARKS = {"object_type", "format"}


def _is_foreign(attributes: Container[str]) -> bool:
    # by name: walking all attributes of a damaged file may never end
    return any(mark in attributes for mark in _FOREIGN_MARKS)


@refusing_damage
def is_mat73(path: Path) -> bool:
    """Tell whether an HDF5 file is one of MATLAB's, though it begins as plain HDF5.

    Parameters
    ----------
    path : Path
        A file that begins as HDF5.

    Returns
    -------
    bool
        True if its arrays carry MATLAB's marks and it is no file of pradformat.
    """
    import h5py

    with h5py.File(path, "r") as file:
        marked = any("MATLAB_class" in item.attrs for _, item in members(path, file))
        return marked and not _is_foreign(file.attrs)


@refusing_damage
def is_other_hdf5(path: Path) -> bool:
    """Tell whether a file is HDF5 of another family, though it begins as MATLAB's.

    Parameters
    ----------
    path : Path
        A file that begins with MATLAB's name.

    Returns
    -------
    bool
        True if it carries the marks of pradformat or of a ``.shadowinv`` result.
    """
    import h5py

    if not h5py.is_hdf5(path):
        return False
    with h5py.File(path, "r") as file:
        return _is_foreign(file.attrs)


@refusing_damage
def read_mat(path: Path, variable: str | None = None) -> tuple[NDArray[Any], dict[str, Any]]:
    """Read an image from a MAT-file.

    Parameters
    ----------
    path : Path
        The file.
    variable : str, optional
        Name of the array; not needed if the file holds one image only.

    Returns
    -------
    array : ndarray, shape (H, W)
        The array, rows first as MATLAB shows it, in the file's own dtype.
    metadata : dict
        ``variable``: its name; ``bits``: bits per value.

    Raises
    ------
    FileFormatError
        If the file is damaged or holds no image.
    InputError
        If it holds several and none was named, or the name is not that of an image.
    """
    chosen = _choose(path, mat_variables(path), variable)
    array = chosen.load()
    if array.dtype.kind not in "buif" or array.shape != chosen.shape:
        raise FileFormatError(
            f"{path} holds {chosen} as {array.dtype} values of shape {array.shape}: expected a "
            "plane of whole or real numbers; take its real part or modulus, and save that"
        )
    return array, {"variable": chosen.name, "bits": 8 * array.dtype.itemsize, "geometry": {}}


@refusing_damage
def mat_variables(path: Path) -> list[Variable]:
    """List the variables of a MAT-file, without their values.

    Parameters
    ----------
    path : Path
        The file.

    Returns
    -------
    list of Variable
        In the file's order; `Variable.is_image` tells which could be an image.

    Raises
    ------
    FileFormatError
        If the file is damaged.
    """
    return _variables_73(path) if _is_hdf5(path) else variables_5(path)


def _is_hdf5(path: Path) -> bool:
    with path.open("rb") as file:
        head = file.read(_HDF5_OFFSET + 4)
    return b"\x89HDF" in (head[:4], head[_HDF5_OFFSET:]) or head.startswith(b"MATLAB 7.3")


def _choose(path: Path, variables: list[Variable], name: str | None) -> Variable:
    held = ", ".join(map(str, variables)) or "nothing"
    images = [item for item in variables if item.is_image]
    if name is not None:
        for item in images:
            if item.name == name:
                return item
        raise InputError(f"{path} has no numeric plane {name!r}: it holds {held}")
    if not images:
        raise FileFormatError(
            f"{path} holds {held}: expected a numeric array (height, width); save the image as a "
            "variable of its own"
        )
    if len(images) > 1:
        raise InputError(
            f"{path} holds {len(images)} images: choose one with variable, of "
            f"{', '.join(map(str, images))}"
        )
    return images[0]


def _variables_73(path: Path) -> list[Variable]:
    import h5py

    with h5py.File(path, "r") as file:
        # Names that begin with # are MATLAB's own.
        names = [name for name in file if not name.startswith("#")]
        return [_described(path, name, member(path, file, name)) for name in names]


def _described(path: Path, name: str, item: Any) -> Variable:
    import h5py

    mark = item.attrs.get("MATLAB_class", b"")
    type_name = mark.decode() if isinstance(mark, bytes) else str(mark)
    if not isinstance(item, h5py.Dataset) or "MATLAB_empty" in item.attrs:
        shape: tuple[int, ...] = (0, 0) if isinstance(item, h5py.Dataset) else (1, 1)
        return Variable(name, shape, type_name or "struct", lambda: np.empty(shape))
    if item.dtype.names is not None:
        type_name = f"complex {type_name}".rstrip()
    if not type_name:
        type_name = "double" if item.dtype.kind in "buif" else str(item.dtype)
    # HDF5 counts its axes from the other end than MATLAB does.
    return Variable(name, item.shape[::-1], type_name, _loader_73(path, name))


def _loader_73(path: Path, name: str) -> Callable[[], NDArray[Any]]:
    def load() -> NDArray[Any]:
        import h5py

        with h5py.File(path, "r") as file:
            return load_dataset(path, member(path, file, name)).T

    return load
