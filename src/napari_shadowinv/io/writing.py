"""Write a result or an image, whole or not at all: `write`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeGuard

import numpy as np

from napari_shadowinv._typing import AnyArray
from napari_shadowinv.errors import InputError
from napari_shadowinv.facts import ResultKind
from napari_shadowinv.io.files import check_output, replacing
from napari_shadowinv.io.formats import (
    IMAGE_WRITERS,
    formats_for,
    function,
    suffixes_for,
)

if TYPE_CHECKING:
    import xarray

    from napari_shadowinv.inversion.error_bars import Uncertainty
    from napari_shadowinv.io.results import AnyResult
    from napari_shadowinv.physics.setup import Setup

__all__ = ["write"]


def write(
    path: str | Path,
    result: AnyResult | Uncertainty | xarray.Dataset | AnyArray,
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
    result : Inversion, Uncertainty, Fit, FilmDoses, xarray.Dataset, or ndarray of shape (H, W)
        Result or image to write.
    setup : Setup, optional
        Adds SI units; pradformat needs it. A dataset, a fit and film doses bring their own.
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
        a fit or film doses.

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
    kind = ResultKind.of(dataset.attrs)
    check_output(path, overwrite, suffixes=suffixes_for(kind))
    with replacing(path, overwrite) as temporary:
        suffix = temporary.suffix.lower()
        (file_format,) = (each for each in formats_for(kind) if suffix in each.suffixes)
        function(file_format.result_writer)(temporary, dataset)
    return Path(path)


def _as_dataset(
    result: AnyResult | Uncertainty | xarray.Dataset, setup: Setup | None
) -> xarray.Dataset:
    if _is_dataset(result):
        return result
    if setup is None:
        return result.to_dataset()
    from napari_shadowinv.inversion import Inversion
    from napari_shadowinv.inversion.error_bars import Uncertainty

    if isinstance(result, Inversion | Uncertainty):
        return result.to_dataset(setup)
    raise InputError(f"received a setup for a {result.kind.noun}, which has its own: leave it out")


def _is_dataset(result: Any) -> TypeGuard[xarray.Dataset]:
    return hasattr(result, "data_vars")  # without waiting for xarray's import


def _write_image(path: Path, plane: AnyArray, setup: Setup | None) -> None:
    if plane.ndim != 2 or plane.size == 0:
        raise InputError(f"image has shape {plane.shape}: expected (height, width)")
    pixel_size = None if setup is None else setup.object_pixel_size
    function(IMAGE_WRITERS[path.suffix.lower()])(path, plane, pixel_size)
