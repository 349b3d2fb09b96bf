"""Arrays of numpy, ``.npy``: `read_npy`, an image `read_npy_plane`, `write_npy`."""

from __future__ import annotations

from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from napari_shadowinv._system.safety import as_file_errors, check_size
from napari_shadowinv._typing import AnyArray
from napari_shadowinv.errors import FileFormatError


@as_file_errors
def read_npy(path: Path) -> AnyArray:
    """Read an array of real numbers, of any shape and in its own dtype."""
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


def read_npy_plane(path: Path) -> tuple[AnyArray, dict[str, Any]]:
    """Read an image; arrays of other shapes are refused."""
    array = read_npy(path)
    if array.ndim != 2 or array.size == 0:
        raise FileFormatError(
            f"{path} holds an array of shape {array.shape}: expected an image of shape "
            "(height, width); save one plane of it"
        )
    return array, {}


def write_npy(path: Path, array: AnyArray, pixel_size: float | None = None) -> None:
    """Write an array as it is; the format does not keep the size of a pixel."""
    content = BytesIO()
    np.save(content, array, allow_pickle=False)
    # numpy gives no reason when it cannot write to a file.
    path.write_bytes(content.getvalue())
