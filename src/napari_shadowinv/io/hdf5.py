"""Any HDF5 file, for its arrays by name.

- the array that the user names: `read_hdf5`
- what there is to choose from: `held_arrays`
- open it, for a module that knows its layout: `opened_hdf5`

Files of layouts that are known, pradformat and ``.shadowinv``, need no name.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from napari_shadowinv.errors import FileFormatError, InputError
from napari_shadowinv.io.promises import load_dataset

__all__ = ["held_arrays", "opened_hdf5", "read_hdf5"]

# Whoever has more than that to choose from knows what is in the file.
_MOST_LISTED = 30


@contextmanager
def opened_hdf5(path: Path) -> Iterator[Any]:
    """Open a file to read; whatever h5py stumbles over in the block is damage to the file.

    Parameters
    ----------
    path : Path
        An HDF5 file.

    Yields
    ------
    h5py.File

    Raises
    ------
    FileFormatError
        If the file is damaged.
    """
    import h5py

    try:
        with h5py.File(path, "r") as file:
            yield file
    except FileFormatError:
        raise
    except (OSError, RuntimeError, KeyError, ValueError, TypeError, AttributeError) as error:
        raise FileFormatError(
            f"{path} begins as HDF5 but is damaged or cut short: expected a complete file; "
            "copy it again"
        ) from error


def read_hdf5(path: Path, name: str) -> NDArray[Any]:
    """Read one array.

    Parameters
    ----------
    path : Path
        An HDF5 file.
    name : str
        The dataset, with the names of the groups that it is in: ``"shots/3/image"``.

    Returns
    -------
    ndarray
        The array as it is stored.

    Raises
    ------
    FileFormatError
        If the file is damaged.
    InputError
        If there is no such array of numbers; the message lists those that there are.
    """
    import h5py

    with opened_hdf5(path) as file:
        item = file.get(name)
        if isinstance(item, h5py.Dataset) and _is_numeric(item):
            return load_dataset(path, item)
        held = ", ".join(_listed(file)) or "none"
    raise InputError(f"{path} has no array {name!r}: it holds {held}")


def held_arrays(path: Path) -> list[str]:
    """Name the images that a file holds, each with its shape and type.

    Parameters
    ----------
    path : Path
        An HDF5 file.

    Returns
    -------
    list of str
        Such as ``"'shot' (480×640 uint16)"``; groups inside groups are not searched, and a
        long list is cut.

    Raises
    ------
    FileFormatError
        If the file is damaged.
    """
    with opened_hdf5(path) as file:
        return _listed(file)


def _listed(file: Any) -> list[str]:
    found = [
        f"{name!r} ({'×'.join(map(str, item.shape))} {item.dtype})"
        for name, item in itertools.islice(_items(file), 10 * _MOST_LISTED)
        if _is_numeric(item) and item.ndim in (2, 3)
    ]
    return found if len(found) <= _MOST_LISTED else [*found[:_MOST_LISTED], "…"]


def _items(file: Any) -> Iterator[tuple[str, Any]]:
    """Datasets of the file and of its groups."""
    import h5py

    for name, item in file.items():
        if isinstance(item, h5py.Dataset):
            yield name, item
        elif isinstance(item, h5py.Group):
            for inner, member in item.items():
                if isinstance(member, h5py.Dataset):
                    yield f"{name}/{inner}", member


def _is_numeric(item: Any) -> bool:
    return bool(np.dtype(item.dtype).kind in "buif" and item.shape)
