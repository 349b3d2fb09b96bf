"""Names, units and dimensions of what a result holds; fields as labelled datasets.

- label a field, with units: `dataset_from_field`
- the names, dimensions and units alone: `variable_labels`; one field: `field_in_si`
- the setup that a dataset was made with: `setup_from_dataset`
- the gradient of a potential: `displacement_from_potential`
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from napari_shadowinv import __version__
from napari_shadowinv.errors import InputError

if TYPE_CHECKING:
    import xarray

    from napari_shadowinv.physics.setup import Setup

__all__ = [
    "FORMAT",
    "VARIABLES",
    "dataset_from_field",
    "displacement_from_potential",
    "field_in_si",
    "label",
    "setup_from_dataset",
    "variable_labels",
]

FORMAT = "shadowinv result"

_PLANE = ("y", "x")
_VECTORS = ("component", "y", "x")
_SITE_VECTORS = ("site", "component")

# Attribute of Inversion: dimensions, units, long name.
VARIABLES: dict[str, tuple[tuple[str, ...], str, str]] = {
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


def dataset_from_field(
    displacement: NDArray[np.float64],
    potential: NDArray[np.float64] | None,
    setup: Setup | None,
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
    setup : Setup or None
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
        "displacement": (_VECTORS, displacement, label(*VARIABLES["displacement"][1:]))
    }
    if potential is not None:
        variables["potential"] = (_PLANE, potential, label(*VARIABLES["potential"][1:]))
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


def variable_labels(
    setup: Setup | None = None,
) -> dict[str, tuple[tuple[str, ...], dict[str, str]]]:
    """Name every variable of a result, with its dimensions and labels.

    Parameters
    ----------
    setup : Setup, optional
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
        name: (dims if isinstance(dims, tuple) else (dims,), label(units, long_name))
        for name, (dims, units, long_name) in VARIABLES.items()
    }
    if setup is not None:
        nothing = np.zeros((2, 4, 4))
        fields = _fields(nothing, nothing[0], setup)
        labels |= {name: (dims, dict(attrs)) for name, (dims, _, attrs) in fields.items()}
    return labels


def field_in_si(name: str, values: NDArray[Any], setup: Setup) -> NDArray[np.float64]:
    """Return a field in SI units by its name in a dataset.

    Parameters
    ----------
    name : str
        One of those that `variable_labels` adds for a setup.
    values : ndarray, shape (2, H, W) or (H, W)
        The displacement (px) for vectors, the normalised potential (px²) for planes.
    setup : Setup
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


def setup_from_dataset(dataset: xarray.Dataset) -> Setup | None:
    """Return the setup that a dataset was made with.

    Parameters
    ----------
    dataset : xarray.Dataset
        As `Inversion.to_dataset` returns it.

    Returns
    -------
    Setup or None
        None if it was made without.
    """
    from napari_shadowinv.physics.setup import setup_from_dict

    if "setup" not in dataset.attrs:
        return None
    return setup_from_dict(json.loads(dataset.attrs["setup"]), "the dataset's setup")


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


def label(units: str, long_name: str) -> dict[str, str]:
    """Return the attributes of a variable."""
    return {"units": units, "long_name": long_name}


def _fields(
    displacement: NDArray[np.float64],
    potential: NDArray[np.float64] | None,
    setup: Setup,
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
        name: (_VECTORS, convert(displacement), label(units, long_name))
        for name, (convert, units, long_name) in vectors.items()
    }
    if potential is not None:
        for name, (convert, units, long_name) in planes.items():
            fields[name] = (_PLANE, convert(potential), label(units, long_name))
    return fields


def _coordinates(height: int, width: int, setup: Setup | None) -> dict[str, Any]:
    """Pixel indices, and metres where the pixel's size is known."""
    coords: dict[str, Any] = {
        "component": ("component", ["y", "x"], label("1", "Component of a vector"))
    }
    for name, count in (("y", height), ("x", width)):
        index = np.arange(count, dtype=np.float64)
        coords[name] = (name, index, label("px", f"{name} in the object plane"))
        if setup is not None:
            metres = index * setup.object_pixel_size
            coords[f"{name}_si"] = (name, metres, label("m", f"{name} in the object plane"))
    return coords
