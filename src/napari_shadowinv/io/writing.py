"""Write a result or an image, whole or not at all: `write`.

A result becomes one NetCDF4 file, ``.shadowinv``, or a table of its sites.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeGuard

import numpy as np

from napari_shadowinv._typing import AnyArray
from napari_shadowinv.errors import InputError
from napari_shadowinv.facts import ResultKind
from napari_shadowinv.inversion.variables import update_labels
from napari_shadowinv.io.files import check_output, replacing
from napari_shadowinv.io.formats import (
    IMAGE_WRITERS,
    formats_for,
    function,
    suffixes_for,
)
from napari_shadowinv.io.hdf5 import check_arrays, check_hdf5_seal, hdf5_in_memory

if TYPE_CHECKING:
    import xarray

    from napari_shadowinv.inversion.error_bars import Uncertainty
    from napari_shadowinv.io.results import AnyResult
    from napari_shadowinv.physics.setup import Setup

__all__ = [
    "write",
]


_SITE_COLUMNS = "y_px,x_px,weight_px2,mass,flux,displacement_y_px,displacement_x_px"


def write_result(path: Path, dataset: xarray.Dataset) -> None:
    """Write a dataset as NetCDF4, moderately compressed and with checksums."""
    import h5netcdf
    from xarray.backends import H5NetCDFStore

    encoding: dict[str, dict[str, Any]] = {}
    for name, variable in dataset.variables.items():
        packed = {"zlib": True, "shuffle": True, "complevel": 4} if variable.size > 64 else {}
        kind = variable.dtype.kind
        if kind in "fiub":
            # What the index loses is read as NaN, not as 0.
            fill = {"_FillValue": np.nan if kind == "f" else None}
            checked = {"fletcher32": True} if variable.ndim else {}
            encoding[str(name)] = {**packed, **checked, **fill}
    # A field that was read from a file of another format still says so.
    marked = dataset.assign_attrs(format=ResultKind.of(dataset.attrs).value)
    # From this version of the format on, the file's own structures have checksums.
    with (
        hdf5_in_memory(path, seal=True) as content,
        h5netcdf.File(content, "w", libver=("v110", "v110")) as file,
    ):
        marked.dump_to_store(H5NetCDFStore(file), encoding=encoding)


def read_result(path: Path) -> xarray.Dataset:
    """Read a dataset that `write_result` wrote, all of it into memory."""
    import xarray as xr

    check_hdf5_seal(path)
    check_arrays(path)
    # Nothing in it is a time, whatever its units look like.
    return update_labels(xr.load_dataset(path, engine="h5netcdf", decode_times=False))


def write_sites(path: Path, dataset: xarray.Dataset) -> None:
    """Write the sites of a result as comma-separated values, one in each row."""
    names = ("sites", "weights", "site_mass", "site_flux", "site_displacement")
    require(dataset, names)
    columns = np.column_stack([dataset[name].values for name in names])
    np.savetxt(path, columns, delimiter=",", header=_SITE_COLUMNS, comments="", fmt="%.17g")


def require(dataset: xarray.Dataset, names: tuple[str, ...]) -> None:
    """Refuse a dataset without some variables."""
    missing = [name for name in names if name not in dataset.variables]
    if missing:
        raise InputError(
            f"dataset has no {', '.join(map(repr, missing))}: expected the result of an inversion"
        )


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
