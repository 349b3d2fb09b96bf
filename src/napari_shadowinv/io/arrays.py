"""Numpy's own files: `read_npy`, `write_npy`. Pickled objects are refused."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from napari_shadowinv.errors import FileFormatError

__all__ = ["read_npy", "write_npy"]


def read_npy(path: Path) -> NDArray[Any]:
    """Read an array of real numbers.

    Parameters
    ----------
    path : Path
        An NPY file.

    Returns
    -------
    ndarray
        The array, any shape, in the file's own dtype.

    Raises
    ------
    FileFormatError
        If it is damaged or holds anything but real numbers.
    """
    try:
        # Mapped first: a header that promises too much then fails before memory is asked for.
        array = np.array(np.load(path, allow_pickle=False, mmap_mode="r"))
    except (ValueError, EOFError, OSError, SyntaxError) as error:
        if "Python objects" in str(error):
            raise FileFormatError(
                f"{path} holds Python objects: expected an array of numbers; "
                "save it again with array.astype(float)"
            ) from None
        raise FileFormatError(
            f"{path} begins as NPY but is damaged or cut short: expected a complete array; "
            "copy or save it again"
        ) from error
    if array.dtype.kind not in "buif":
        raise FileFormatError(
            f"{path} holds {array.dtype} values: expected whole or real numbers; convert them"
        )
    return array


def write_npy(path: Path, array: NDArray[Any]) -> None:
    """Write an array as it is."""
    with path.open("wb") as file:
        np.save(file, array, allow_pickle=False)
