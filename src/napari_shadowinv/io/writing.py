"""Write a result or an image, whole or not at all: `write`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeGuard

import numpy as np

from napari_shadowinv._typing import AnyArray
from napari_shadowinv.errors import InputError
from napari_shadowinv.inversion.variables import is_fit, is_pack
from napari_shadowinv.io.files import check_output, replacing
from napari_shadowinv.io.formats import (
    FIT_WRITERS,
    IMAGE_WRITERS,
    PACK_WRITERS,
    RESULT_WRITERS,
    function,
)

if TYPE_CHECKING:
    import xarray

    from napari_shadowinv.fitting import Fit
    from napari_shadowinv.inversion import Inversion
    from napari_shadowinv.inversion.error_bars import Uncertainty
    from napari_shadowinv.physics.setup import Setup

__all__ = ["write"]


def write(
    path: str | Path,
    result: Inversion | Uncertainty | Fit | xarray.Dataset | AnyArray,
    *,
    setup: Setup | None = None,
    overwrite: bool = False,
) -> Path:
    """Write a result or an image in the format that the path's ending names.

    Parameters
    ----------
    path : str or Path
        For a result: ``.shadowinv`` for all of it, ``.h5`` for pradformat, ``.csv`` for the
        sites; for a fit ``.shadowinv``, or ``.h5`` for its field alone. For an image: ``.tif``
        (float32), ``.npy``, ``.png`` (16 bits, its largest value white).
    result : Inversion, Uncertainty, Fit, xarray.Dataset, or ndarray of shape (H, W)
        Result or image to write.
    setup : Setup, optional
        Adds SI units; pradformat needs it. A dataset and a fit bring their own.
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
        If pradformat is asked for without the setup of a particle beam, or a setup is given for
        a fit.

    Examples
    --------
    >>> import tempfile
    >>> folder = Path(tempfile.mkdtemp())
    >>> write(folder / "ones.tif", np.ones((3, 4))).name
    'ones.tif'
    """
    if isinstance(result, np.ndarray):
        check_output(path, overwrite, suffixes=IMAGE_WRITERS)
        with replacing(path, overwrite) as temporary:
            _write_image(temporary, result, setup)
        return Path(path)
    dataset = _as_dataset(result, setup)
    writers = _writers_of(dataset)
    check_output(path, overwrite, suffixes=writers)
    with replacing(path, overwrite) as temporary:
        function(writers[temporary.suffix.lower()])(temporary, dataset)
    return Path(path)


def _writers_of(dataset: xarray.Dataset) -> dict[str, str]:
    if is_pack(dataset.attrs):
        return PACK_WRITERS
    return FIT_WRITERS if is_fit(dataset.attrs) else RESULT_WRITERS


def _as_dataset(
    result: Inversion | Uncertainty | Fit | xarray.Dataset, setup: Setup | None
) -> xarray.Dataset:
    from napari_shadowinv.fitting import Fit

    if _is_dataset(result):
        return result
    if not isinstance(result, Fit):
        return result.to_dataset(setup)
    if setup is not None:
        raise InputError(
            "received a setup for a fit, which has those of its images: give them to fit()"
        )
    return result.to_dataset()


def _is_dataset(result: Any) -> TypeGuard[xarray.Dataset]:
    return hasattr(result, "data_vars")  # without waiting for xarray's import


def _write_image(path: Path, plane: AnyArray, setup: Setup | None) -> None:
    if plane.ndim != 2 or plane.size == 0:
        raise InputError(f"image has shape {plane.shape}: expected (height, width)")
    pixel_size = None if setup is None else setup.object_pixel_size
    function(IMAGE_WRITERS[path.suffix.lower()])(path, plane, pixel_size)
