"""An inversion as one labelled dataset, and back.

- label everything, with units: `dataset_from_inversion`
- the same for a field of other origin: `dataset_from_field`
- an inversion with the scatter that noise gives it: `dataset_from_uncertainty`
- the way back: `inversion_from_dataset`, `setup_from_dataset`
- one file for all of it (NetCDF4, ``.shadowinv``): `write_result`, `read_result`
- say which files it was made from: `provenance`
- the names, dimensions and units alone: `variable_labels`; one field: `field_in_si`
"""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from napari_shadowinv import __version__
from napari_shadowinv.errors import InputError
from napari_shadowinv.io.files import text_of
from napari_shadowinv.io.hdf5 import check_arrays, hdf5_in_memory
from napari_shadowinv.io.radiograph import Radiograph
from napari_shadowinv.safety import refusing_damage

if TYPE_CHECKING:
    import xarray

    from napari_shadowinv.error_bars import Uncertainty
    from napari_shadowinv.inversion import Inversion, Report
    from napari_shadowinv.physics.setup import OpticalSetup, ProtonSetup

__all__ = [
    "FORMAT",
    "dataset_from_field",
    "dataset_from_inversion",
    "dataset_from_uncertainty",
    "displacement_from_potential",
    "field_in_si",
    "inversion_from_dataset",
    "provenance",
    "read_result",
    "setup_from_dataset",
    "variable_labels",
    "write_result",
]

FORMAT = "shadowinv result"

_PLANE = ("y", "x")
_VECTORS = ("component", "y", "x")
_SITE_VECTORS = ("site", "component")

# Attribute of Inversion: dimensions, units, long name.
_VARIABLES: dict[str, tuple[tuple[str, ...], str, str]] = {
    "potential": (_PLANE, "px²", "Normalised deflection potential"),
    "displacement": (_VECTORS, "px", "Displacement of the ray through each pixel"),
    "sites": (_SITE_VECTORS, "px", "Positions of the sites"),
    "weights": (("site",), "px²", "Weights of the power diagram"),
    "site_mass": (("site",), "flux", "Source flux in each site's cell"),
    "site_flux": (("site",), "flux", "Image flux in each site's power cell"),
    "site_displacement": (_SITE_VECTORS, "px", "Centroid of each site's cell minus the site"),
    "image": (_PLANE, "flux/px²", "Image, scaled to the flux of the source"),
    "source": (_PLANE, "flux/px²", "Undisturbed beam"),
    "reprojection": (_PLANE, "flux/px²", "Source as displaced by the retrieved field"),
    "residual": (_PLANE, "flux/px²", "Image minus re-projection"),
    "caustic": (_PLANE, "1", "The map folds or its Jacobian is below the threshold"),
    "mask": (_PLANE, "1", "Pixels that were used"),
}


def dataset_from_inversion(
    inversion: Inversion,
    setup: ProtonSetup | OpticalSetup | None = None,
    *,
    attributes: Mapping[str, str] | None = None,
) -> xarray.Dataset:
    """Label everything that an inversion knows.

    Parameters
    ----------
    inversion : Inversion
        The result.
    setup : ProtonSetup or OpticalSetup, optional
        Adds the potential and the line-integrated fields in SI units, and coordinates in
        metres.
    attributes : mapping of str to str, optional
        More attributes, such as those of `provenance`.

    Returns
    -------
    xarray.Dataset
        Dimensions y, x, component ("y", "x") and site. Each variable has ``units`` and
        ``long_name``; options, report and setup are JSON texts in the attributes.
    """
    history = {
        "format": FORMAT,
        "options": inversion.options.model_dump_json(),
        "report": json.dumps(dataclasses.asdict(inversion.report)),
        "image_residual": inversion.report.image_residual,
    }
    dataset = dataset_from_field(
        inversion.displacement,
        inversion.potential,
        setup,
        attributes=history | dict(attributes or {}),
    )
    return dataset.assign(
        {
            name: (dims, getattr(inversion, name), _labels(units, long_name))
            for name, (dims, units, long_name) in _VARIABLES.items()
            if name not in dataset
        }
    )


def dataset_from_field(
    displacement: NDArray[np.float64],
    potential: NDArray[np.float64] | None,
    setup: ProtonSetup | OpticalSetup | None,
    *,
    attributes: Mapping[str, Any] | None = None,
) -> xarray.Dataset:
    """Label a displacement and its potential, in pixels and, with a setup, in SI units.

    Parameters
    ----------
    displacement : ndarray, shape (2, H, W)
        Displacement in px, axis order (y, x).
    potential : ndarray, shape (H, W), or None
        Normalised potential in px², where it is known.
    setup : ProtonSetup or OpticalSetup or None
        Adds the fields in SI units, and coordinates in metres.
    attributes : mapping of str to str, optional
        More attributes.

    Returns
    -------
    xarray.Dataset
        Dimensions y, x and component ("y", "x").
    """
    import xarray as xr

    variables: dict[str, Any] = {
        "displacement": (_VECTORS, displacement, _labels(*_VARIABLES["displacement"][1:]))
    }
    if potential is not None:
        variables["potential"] = (_PLANE, potential, _labels(*_VARIABLES["potential"][1:]))
    attrs = {
        "package_version": __version__,
        "created": datetime.now(UTC).isoformat(timespec="seconds"),
        **(attributes or {}),
    }
    if setup is not None:
        variables |= _fields(displacement, potential, setup)
        attrs["setup"] = setup.model_dump_json()
    height, width = displacement.shape[1:]
    return xr.Dataset(variables, coords=_coordinates(height, width, setup), attrs=attrs)


def dataset_from_uncertainty(
    uncertainty: Uncertainty,
    setup: ProtonSetup | OpticalSetup | None = None,
    *,
    attributes: Mapping[str, str] | None = None,
) -> xarray.Dataset:
    """Label an inversion and the scatter of its noisy samples.

    Parameters
    ----------
    uncertainty : Uncertainty
        The result.
    setup : ProtonSetup or OpticalSetup, optional
        Adds the fields and their deviations in SI units, and coordinates in metres.
    attributes : mapping of str to str, optional
        More attributes, such as those of `provenance`.

    Returns
    -------
    xarray.Dataset
        As of `dataset_from_inversion`, with ``potential_mean`` and ``displacement_mean``, and a
        ``…_std`` beside each potential, displacement and field. How the samples were made is a
        JSON text in the attribute ``uncertainty``.
    """
    samples = ("n", "noise", "tolerance", "iterations", "residuals", "converged", "warnings")
    history = json.dumps({name: getattr(uncertainty, name) for name in samples})
    dataset = dataset_from_inversion(
        uncertainty.inversion, setup, attributes={"uncertainty": history, **(attributes or {})}
    )
    means = {
        "potential": uncertainty.potential_mean,
        "displacement": uncertainty.displacement_mean,
    }
    deviations = {
        "potential": uncertainty.potential_std,
        "displacement": uncertainty.displacement_std,
    }
    if setup is not None:
        fields = _fields(deviations["displacement"], deviations["potential"], setup)
        # each is its argument times a number, perhaps negative, perhaps with axes exchanged
        deviations |= {name: np.abs(field[1]) for name, field in fields.items()}

    def beside(name: str, what: str, values: NDArray[np.float64]) -> tuple[Any, ...]:
        field = dataset[name]
        long_name = f"{field.attrs['long_name']}, {what} of noisy samples"
        return field.dims, values, _labels(field.attrs["units"], long_name)

    return dataset.assign(
        {f"{name}_mean": beside(name, "mean", values) for name, values in means.items()}
        | {
            f"{name}_std": beside(name, "standard deviation", values)
            for name, values in deviations.items()
        }
    )


def displacement_from_potential(potential: ArrayLike) -> NDArray[np.float64]:
    """Displacement d = -∇φ by central differences, where a file tells only the potential.

    Parameters
    ----------
    potential : array_like, shape (H, W)
        Normalised potential in px².

    Returns
    -------
    ndarray, shape (2, H, W)
        Displacement in px, axis order (y, x).

    Raises
    ------
    InputError
        If the potential is no plane or too small to have a gradient.

    Examples
    --------
    >>> displacement_from_potential(np.tile(np.arange(4.0) ** 2, (3, 1)))[1, 0, 1:]
    array([-2., -4., -6.])
    """
    plane = np.asarray(potential, dtype=np.float64)
    if plane.ndim != 2 or min(plane.shape) < 3:
        raise InputError(
            f"potential has shape {plane.shape}: expected (height, width), at least 3 pixels "
            "each way"
        )
    return -np.stack([np.gradient(plane, axis=axis, edge_order=2) for axis in (0, 1)])


def _labels(units: str, long_name: str) -> dict[str, str]:
    return {"units": units, "long_name": long_name}


def _fields(
    displacement: NDArray[np.float64],
    potential: NDArray[np.float64] | None,
    setup: ProtonSetup | OpticalSetup,
) -> dict[str, Any]:
    """Variables that need the experiment's geometry."""
    from napari_shadowinv.physics.setup import ProtonSetup

    vectors = {"deflection_angle": (setup.deflection_angle, "rad", "Deflection angle")}
    planes = {"potential_si": (setup.potential, "m", "Deflection potential")}
    if isinstance(setup, ProtonSetup):
        vectors["path_integrated_b"] = (
            setup.path_integrated_b,
            "T m",
            "Path-integrated magnetic field, assuming purely magnetic deflection",
        )
        vectors["path_integrated_e"] = (
            setup.path_integrated_e,
            "V",
            "Path-integrated electric field, assuming purely electric deflection",
        )
    else:
        planes["line_integrated_log_index"] = (
            setup.line_integrated_log_index,
            "m",
            "Line-integrated logarithm of the refractive index",
        )
        planes["line_integrated_density"] = (
            setup.line_integrated_density,
            "m⁻²",
            "Line-integrated electron density of a thin plasma",
        )
    fields: dict[str, Any] = {
        name: (_VECTORS, convert(displacement), _labels(units, long_name))
        for name, (convert, units, long_name) in vectors.items()
    }
    if potential is not None:
        for name, (convert, units, long_name) in planes.items():
            fields[name] = (_PLANE, convert(potential), _labels(units, long_name))
    return fields


def _coordinates(
    height: int, width: int, setup: ProtonSetup | OpticalSetup | None
) -> dict[str, Any]:
    """Pixel indices, and metres where the pixel's size is known."""
    coords: dict[str, Any] = {
        "component": ("component", ["y", "x"], _labels("1", "Component of a vector"))
    }
    for name, count in (("y", height), ("x", width)):
        index = np.arange(count, dtype=np.float64)
        coords[name] = (name, index, _labels("px", f"{name} in the object plane"))
        if setup is not None:
            metres = index * setup.object_pixel_size
            coords[f"{name}_si"] = (name, metres, _labels("m", f"{name} in the object plane"))
    return coords


def variable_labels(
    setup: ProtonSetup | OpticalSetup | None = None,
) -> dict[str, tuple[tuple[str, ...], dict[str, str]]]:
    """Name every variable of a result, with its dimensions and labels.

    Parameters
    ----------
    setup : ProtonSetup or OpticalSetup, optional
        Adds the fields in SI units.

    Returns
    -------
    dict of str to (tuple of str, dict of str to str)
        Dimensions, and ``units`` and ``long_name``.

    Examples
    --------
    >>> variable_labels()["potential"]
    (('y', 'x'), {'units': 'px²', 'long_name': 'Normalised deflection potential'})
    """
    labels = {
        name: (dims if isinstance(dims, tuple) else (dims,), _labels(units, long_name))
        for name, (dims, units, long_name) in _VARIABLES.items()
    }
    if setup is not None:
        nothing = np.zeros((2, 4, 4))
        fields = _fields(nothing, nothing[0], setup)
        labels |= {name: (dims, dict(attrs)) for name, (dims, _, attrs) in fields.items()}
    return labels


def field_in_si(
    name: str, values: NDArray[Any], setup: ProtonSetup | OpticalSetup
) -> NDArray[np.float64]:
    """Return a field in SI units by its name in a dataset.

    Parameters
    ----------
    name : str
        One of those that `variable_labels` adds for a setup.
    values : ndarray, shape (2, H, W) or (H, W)
        The displacement (px) for vectors, the normalised potential (px²) for planes.
    setup : ProtonSetup or OpticalSetup
        The geometry.

    Returns
    -------
    ndarray, of the shape of `values`
    """
    nothing = np.zeros((2, 4, 4))
    is_vector = values.ndim == 3
    fields = _fields(values, nothing[0], setup) if is_vector else _fields(nothing, values, setup)
    field: NDArray[np.float64] = fields[name][1]
    return field


def provenance(shot: Radiograph | None, source: Radiograph | None = None) -> dict[str, str]:
    """Say which files a result was made from.

    Parameters
    ----------
    shot : Radiograph or None
        The image.
    source : Radiograph or None
        The undisturbed beam.

    Returns
    -------
    dict of str to str
        ``input_file``, ``input_sha256``, ``source_file``, ``source_sha256``, as far as known, and
        what was done before the inversion as JSON, ``input_preparation`` and
        ``source_preparation``.
    """
    found: dict[str, str] = {}
    for role, radiograph in (("input", shot), ("source", source)):
        if radiograph is not None and radiograph.metadata.get("preparation"):
            found[f"{role}_preparation"] = json.dumps(radiograph.metadata["preparation"])
        if radiograph is not None and radiograph.path is not None:
            found[f"{role}_file"] = text_of(radiograph.path.name)
            if "sha256" in radiograph.metadata:
                found[f"{role}_sha256"] = str(radiograph.metadata["sha256"])
    return found


def inversion_from_dataset(dataset: xarray.Dataset) -> Inversion:
    """Rebuild an inversion from its dataset.

    Parameters
    ----------
    dataset : xarray.Dataset
        As `dataset_from_inversion` makes it.

    Returns
    -------
    Inversion
        Equal to the one that the dataset was made from.

    Raises
    ------
    InputError
        If a variable or attribute is missing.
    """
    from napari_shadowinv.inversion import Inversion
    from napari_shadowinv.options import InversionOptions
    from napari_shadowinv.trust import image_residual

    missing = [name for name in _VARIABLES if name not in dataset.variables]
    missing += [name for name in ("options", "report") if name not in dataset.attrs]
    if missing:
        raise InputError(
            f"dataset has no {', '.join(map(repr, missing))}: expected the result of an inversion"
        )
    arrays = {name: np.ascontiguousarray(dataset[name].values) for name in _VARIABLES}
    report = _report(json.loads(dataset.attrs["report"]))
    if math.isnan(report.image_residual):  # a file of an older version
        told = image_residual(arrays["image"], arrays["reprojection"], arrays["mask"])
        report = dataclasses.replace(report, image_residual=told)
    return Inversion(
        **arrays,
        report=report,
        options=InversionOptions.model_validate_json(dataset.attrs["options"]),
    )


def _report(content: dict[str, Any]) -> Report:
    from napari_shadowinv.inversion import Report

    known = {field.name for field in dataclasses.fields(Report)}
    return Report(**{name: _tuples(value) for name, value in content.items() if name in known})


def _tuples(value: Any) -> Any:
    # JSON knows lists only.
    return tuple(_tuples(item) for item in value) if isinstance(value, list) else value


def setup_from_dataset(dataset: xarray.Dataset) -> ProtonSetup | OpticalSetup | None:
    """Return the setup that a dataset was made with.

    Parameters
    ----------
    dataset : xarray.Dataset
        As `dataset_from_inversion` makes it.

    Returns
    -------
    ProtonSetup or OpticalSetup or None
        None if it was made without.
    """
    from napari_shadowinv.physics.setup import setup_from_dict

    if "setup" not in dataset.attrs:
        return None
    return setup_from_dict(json.loads(dataset.attrs["setup"]), "the dataset's setup")


def write_result(path: Path, dataset: xarray.Dataset) -> None:
    """Write a dataset as NetCDF4, moderately compressed.

    Parameters
    ----------
    path : Path
        The file.
    dataset : xarray.Dataset
        What to write.

    Raises
    ------
    OSError
        If there is no room for it.
    """
    import h5netcdf
    from xarray.backends import H5NetCDFStore

    encoding: dict[str, dict[str, Any]] = {}
    for name, variable in dataset.variables.items():
        numeric = variable.dtype.kind in "fiub"
        packed = {"zlib": True, "shuffle": True, "complevel": 4} if variable.size > 64 else {}
        if numeric:
            encoding[str(name)] = {**packed, "_FillValue": None}
    # A field that was read from a file of another format still says so.
    marked = dataset.assign_attrs(format=FORMAT)
    with hdf5_in_memory(path) as content, h5netcdf.File(content, "w") as file:
        marked.dump_to_store(H5NetCDFStore(file), encoding=encoding)


@refusing_damage
def read_result(path: Path) -> xarray.Dataset:
    """Read a dataset that `write_result` wrote, all of it into memory.

    Parameters
    ----------
    path : Path
        A ``.shadowinv`` file.

    Returns
    -------
    xarray.Dataset
        The same variables, coordinates and attributes.

    Raises
    ------
    FileFormatError
        If the file is damaged.
    """
    import xarray as xr

    check_arrays(path)
    # Nothing in it is a time, whatever its units look like.
    return xr.load_dataset(path, engine="h5netcdf", decode_times=False)
