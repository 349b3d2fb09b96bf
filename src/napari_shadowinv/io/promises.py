"""What a header promises against what its file can hold.

A damaged length must be refused before memory is asked for.

- compare the two: `check_promise`
- the values of an HDF5 dataset, if they are there: `load_dataset`
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from napari_shadowinv.errors import FileFormatError

__all__ = ["DEFLATE_RATIO", "check_promise", "load_dataset"]

# The most that zlib can pack into one byte, a little rounded up.
DEFLATE_RATIO = 1040


def check_promise(path: Path, header: str, promised: int, held: int) -> None:
    """Refuse a file whose header promises more than it holds, before memory is asked for.

    Parameters
    ----------
    path : Path
        The file.
    header : str
        Name of the format, for the message.
    promised : int
        Bytes that the header tells.
    held : int
        Bytes that can be there at most.

    Raises
    ------
    FileFormatError
        If `promised` is more than `held`.
    """
    if promised > held:
        raise FileFormatError(
            f"{path} is damaged or cut short: its {header} header promises {promised} bytes, but "
            f"{held} at most are there; copy it again"
        )


def load_dataset(path: Path, dataset: Any) -> NDArray[Any]:
    """Return the values of an HDF5 dataset that the file really holds.

    Parameters
    ----------
    path : Path
        The file, for the message.
    dataset : h5py.Dataset
        The dataset. HDF5 would fill what was never written with zeros.

    Returns
    -------
    ndarray
        Its values.

    Raises
    ------
    FileFormatError
        If its shape promises more than is stored.
    """
    stored = int(dataset.id.get_storage_size())
    is_packed = dataset.id.get_create_plist().get_nfilters() > 0
    check_promise(path, "HDF5", dataset.nbytes, DEFLATE_RATIO * stored if is_packed else stored)
    return np.asarray(dataset[()])
