"""Numpy's own files: `read_npy`, `write_npy`. Pickled objects are refused."""

from __future__ import annotations

from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from napari_shadowinv._system.safety import check_size, refusing_damage
from napari_shadowinv.errors import FileFormatError

__all__ = ["read_npy", "write_npy"]


@refusing_damage
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
    # Mapped first: a header that promises too much then fails before memory is asked for.
    try:
        mapped = np.load(path, allow_pickle=False, mmap_mode="r")
    except ValueError as error:
        if "Python objects" not in str(error):
            raise
        raise FileFormatError(
            f"{path} contains Python objects: expected an array of numbers; save it again with "
            "array.astype(float)"
        ) from error
    check_size(path, mapped.size * max(8, mapped.dtype.itemsize))
    array = np.array(mapped)
    if array.dtype.kind not in "buif":
        raise FileFormatError(
            f"{path} holds {array.dtype} values: expected whole or real numbers; convert them"
        )
    return array


def write_npy(path: Path, array: NDArray[Any]) -> None:
    """Write an array as it is."""
    content = BytesIO()
    np.save(content, array, allow_pickle=False)
    # Numpy does not tell why it cannot write to a file.
    path.write_bytes(content.getbuffer())
