"""Write results and images, each file whole or not at all.

- a result (``.shadowinv``, pradformat ``.h5``, sites as ``.csv``) or an image (``.tif``,
  ``.npy``, ``.png``): `write`
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from napari_shadowinv.errors import InputError
from napari_shadowinv.inversion.labels import setup_from_dataset
from napari_shadowinv.inversion.result import provenance_of
from napari_shadowinv.io.arrays import write_npy
from napari_shadowinv.io.dataset import write_result
from napari_shadowinv.io.files import check_output, replacing
from napari_shadowinv.io.images import write_png, write_tiff
from napari_shadowinv.io.pradformat import write_pradformat

if TYPE_CHECKING:
    import xarray

    from napari_shadowinv.inversion import Inversion
    from napari_shadowinv.inversion.error_bars import Uncertainty
    from napari_shadowinv.physics.setup import Setup

__all__ = ["IMAGE_SUFFIXES", "RESULT_SUFFIXES", "write"]

RESULT_SUFFIXES = (".shadowinv", ".h5", ".hdf5", ".csv")
IMAGE_SUFFIXES = (".tif", ".tiff", ".npy", ".png")

_SITE_COLUMNS = "y_px,x_px,weight_px2,mass,flux,displacement_y_px,displacement_x_px"


def write(
    path: str | Path,
    result: Inversion | Uncertainty | xarray.Dataset | NDArray[Any],
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
        The file.

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
    is_image = isinstance(result, np.ndarray)
    check_output(path, overwrite, suffixes=IMAGE_SUFFIXES if is_image else RESULT_SUFFIXES)
    with replacing(path, overwrite) as temporary:
        if isinstance(result, np.ndarray):
            _write_image(temporary, result, setup)
        else:
            _write_result(temporary, _dataset(result, setup))
    return Path(path)


def _dataset(
    result: Inversion | Uncertainty | xarray.Dataset,
    setup: Setup | None,
) -> xarray.Dataset:
    import xarray as xr

    return result if isinstance(result, xr.Dataset) else result.to_dataset(setup)


def _write_result(path: Path, dataset: xarray.Dataset) -> None:
    if path.suffix.lower() == ".shadowinv":
        write_result(path, dataset)
    elif path.suffix.lower() == ".csv":
        _write_sites(path, dataset)
    else:
        _require(dataset, ("displacement", "potential"))
        write_pradformat(
            path,
            dataset["displacement"].values,
            dataset["potential"].values,
            setup_from_dataset(dataset),
            provenance=provenance_of(dataset),
        )


def _write_sites(path: Path, dataset: xarray.Dataset) -> None:
    names = ("sites", "weights", "site_mass", "site_flux", "site_displacement")
    _require(dataset, names)
    columns = np.column_stack([dataset[name].values for name in names])
    np.savetxt(path, columns, delimiter=",", header=_SITE_COLUMNS, comments="", fmt="%.17g")


def _require(dataset: xarray.Dataset, names: tuple[str, ...]) -> None:
    missing = [name for name in names if name not in dataset.variables]
    if missing:
        raise InputError(
            f"dataset has no {', '.join(map(repr, missing))}: expected the result of an inversion"
        )


def _write_image(path: Path, plane: NDArray[Any], setup: Setup | None) -> None:
    if plane.ndim != 2 or plane.size == 0:
        raise InputError(f"image has shape {plane.shape}: expected (height, width)")
    if path.suffix.lower() == ".npy":
        write_npy(path, plane)
    elif path.suffix.lower() == ".png":
        write_png(path, plane)
    else:
        write_tiff(path, plane, None if setup is None else setup.object_pixel_size)
