"""Write a result or an image, whole or not at all: `write`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeGuard

import numpy as np

from napari_shadowinv._typing import AnyArray
from napari_shadowinv.errors import InputError
from napari_shadowinv.io.files import check_output, replacing
from napari_shadowinv.io.formats import IMAGE_WRITERS, RESULT_WRITERS, function

if TYPE_CHECKING:
    import xarray

    from napari_shadowinv.inversion import Inversion
    from napari_shadowinv.inversion.error_bars import Uncertainty
    from napari_shadowinv.physics.setup import Setup

__all__ = ["write"]


def write(
    path: str | Path,
    result: Inversion | Uncertainty | xarray.Dataset | AnyArray,
    *,
    setup: Setup | None = None,
    overwrite: bool = False,
) -> Path:
    """Write a result or an image in the format that the path's ending names.

    Parameters
    ----------
    path : str or Path
        For a result: ``.shadowinv`` for all of it, ``.h5`` for pradformat, ``.csv`` for the
        sites. For an image: ``.tif`` (float32), ``.npy``, ``.png`` (16 bits, its largest
        value white).
    result : Inversion or Uncertainty or xarray.Dataset or ndarray of shape (H, W)
        What to write.
    setup : Setup, optional
        Adds SI units; pradformat needs it. A dataset brings its own.
    overwrite : bool
        Whether an existing file may be replaced.

    Returns
    -------
    Path

    Raises
    ------
    FileFormatError
        If the file exists and must not be replaced, its folder cannot be written, or the
        ending names no format for this.
    InputError
        If pradformat is asked for without the setup of a particle beam.

    Examples
    --------
    >>> import tempfile
    >>> folder = Path(tempfile.mkdtemp())
    >>> write(folder / "ones.tif", np.ones((3, 4))).name
    'ones.tif'
    """
    suffixes = IMAGE_WRITERS if isinstance(result, np.ndarray) else RESULT_WRITERS
    check_output(path, overwrite, suffixes=suffixes)
    with replacing(path, overwrite) as temporary:
        if isinstance(result, np.ndarray):
            _write_image(temporary, result, setup)
        else:
            dataset = result if _is_dataset(result) else result.to_dataset(setup)
            function(RESULT_WRITERS[temporary.suffix.lower()])(temporary, dataset)
    return Path(path)


def _is_dataset(result: Any) -> TypeGuard[xarray.Dataset]:
    return hasattr(result, "data_vars")  # without waiting for xarray's import


def _write_image(path: Path, plane: AnyArray, setup: Setup | None) -> None:
    if plane.ndim != 2 or plane.size == 0:
        raise InputError(f"image has shape {plane.shape}: expected (height, width)")
    pixel_size = None if setup is None else setup.object_pixel_size
    function(IMAGE_WRITERS[path.suffix.lower()])(path, plane, pixel_size)
