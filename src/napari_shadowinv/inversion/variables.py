"""Names, units and dimensions of a result's variables; fields as labelled datasets.

- label a field, with units: `dataset_from_field`
- the names, dimensions and units alone: `variable_labels`
- the setup that a dataset was made with: `setup_from_dataset`
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

from napari_shadowinv import __version__
from napari_shadowinv._system.safety import as_input_errors
from napari_shadowinv._typing import FloatArray
from napari_shadowinv.physics.arrays import PLANE, VECTOR
from napari_shadowinv.physics.units import (
    FLUX_DENSITY,
    PIXEL,
    PIXEL_AREA,
    label,
    vector_coordinates,
)

if TYPE_CHECKING:
    import xarray

    from napari_shadowinv.physics.beam import SIField
    from napari_shadowinv.physics.setup import Setup

_FLUX = "1"

_SITE_VECTORS = ("site", "component")

# Of an inversion: dimensions, units, long name.
VARIABLES: dict[str, tuple[tuple[str, ...], str, str]] = {
    "potential": (PLANE, PIXEL_AREA, "Normalised deflection potential"),
    "displacement": (VECTOR, PIXEL, "Displacement of the ray through each pixel"),
    "sites": (_SITE_VECTORS, PIXEL, "Positions of the sites"),
    "weights": (("site",), PIXEL_AREA, "Weights of the power diagram"),
    "site_mass": (("site",), _FLUX, "Source flux in each site's cell"),
    "site_flux": (("site",), _FLUX, "Image flux in each site's power cell"),
    "site_displacement": (_SITE_VECTORS, PIXEL, "Centroid of each site's cell minus the site"),
    "image": (PLANE, FLUX_DENSITY, "Image, scaled to the flux of the source"),
    "source": (PLANE, FLUX_DENSITY, "Undisturbed beam"),
    "reprojection": (PLANE, FLUX_DENSITY, "Source as displaced by the retrieved field"),
    "residual": (PLANE, FLUX_DENSITY, "Image minus re-projection"),
    "caustic": (PLANE, "1", "The map folds or its Jacobian is below the threshold"),
    "mask": (PLANE, "1", "Pixels that were used"),
}

DISPLACEMENT_STD = (
    VECTOR,
    PIXEL,
    f"{VARIABLES['displacement'][2]}, standard deviation of noisy samples",
)
"""Variable of an inversion whose samples have been drawn."""

_DEVIATION = "Standard deviation of the displacement"
_CHANGES = "Random changes of the potential as large as its error"
FIT_VARIABLES = {
    "displacement_uncertainty": (VECTOR, PIXEL, _DEVIATION),
    "potential_samples": (("sample", "y", "x"), PIXEL_AREA, _CHANGES),
}
"""Variables of a fitted field in addition to potential and displacement."""


def dataset_from_field(
    displacement: FloatArray,
    potential: FloatArray | None,
    setup: Setup | None,
    *,
    attributes: Mapping[str, Any] | None = None,
) -> xarray.Dataset:
    """Label a displacement (px) and potential (px²); a setup adds fields and metres in SI units."""
    import xarray as xr

    variables: dict[str, Any] = {
        "displacement": (VECTOR, displacement, label(*VARIABLES["displacement"][1:]))
    }
    if potential is not None:
        variables["potential"] = (PLANE, potential, label(*VARIABLES["potential"][1:]))
    attrs = {
        "package_version": __version__,
        "created": datetime.now(UTC).isoformat(timespec="seconds"),
        **(attributes or {}),
    }
    if setup is not None:
        for field in _vectors_first(setup):
            dims, values = (VECTOR, displacement) if field.is_vector else (PLANE, potential)
            if values is not None:
                converted = setup.field_in_si(field.name, values)
                variables[field.name] = dims, converted, label(field.unit, field.long_name)
        attrs["setup"] = setup.model_dump_json()
    size = None if setup is None else setup.object_pixel_size
    coordinates = vector_coordinates(displacement.shape[1:], size)
    return xr.Dataset(variables, coords=coordinates, attrs=attrs)


Labels = dict[str, tuple[tuple[str, ...], dict[str, str]]]
"""Dimensions and attributes of variables by their names."""


def variable_labels(setup: Setup | None = None) -> Labels:
    """Return dimensions, ``units`` and ``long_name`` of every variable of a result by its name."""
    labels = {
        name: (dims, label(unit, long_name)) for name, (dims, unit, long_name) in VARIABLES.items()
    }
    for field in () if setup is None else _vectors_first(setup):
        dims = VECTOR if field.is_vector else PLANE
        labels[field.name] = dims, label(field.unit, field.long_name)
    return labels


def belongs(variable: object, field: str) -> bool:
    """Return whether a variable makes sense for a field: ∫E dz of a magnetic one does not."""
    from napari_shadowinv.physics.setup import SETUPS

    fields = (part for kind in SETUPS.values() for part in kind.si_fields)
    return all(part.deflector in ("", field) for part in fields if part.name == variable)


def setup_from_dataset(dataset: xarray.Dataset) -> Setup | None:
    """Return the setup that a dataset of `Inversion.to_dataset` was made with, if there was one.

    Where shots of a stack have different setups, a dataset of one shot returns the shot's setup and
    a dataset of all returns the first one.
    """
    from napari_shadowinv.physics.setup import setup_from_dict

    shot_setup = dataset.get("setup")  # of each shot, in a stack of which one is chosen
    text = dataset.attrs.get("setup", "")
    if shot_setup is not None and not shot_setup.ndim:
        text = str(shot_setup.values)
    with as_input_errors("the dataset's setup"):
        return setup_from_dict(json.loads(text), "the dataset's setup") if text else None


SETUPS_LABEL = {"units": "1", "long_name": "Setup of the shot (JSON)"}
"""Attributes of the variable ``setup`` of a stack whose shots have setups of their own."""


def _vectors_first(setup: Setup) -> list[SIField]:
    return sorted(setup.si_fields, key=lambda field: not field.is_vector)
