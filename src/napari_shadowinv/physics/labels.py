"""Units, names and places of the pixels as attributes and coordinates of a dataset.

- the attributes of a variable: `label`; of places: `place_label`; the places: `place_coordinates`
- units as figures print them: `display_unit`
- a variable as an array: `numbers_of`

Units are spelled as pint parses them, because napari passes the units of an xarray's coordinates on
to it.
For pint ``px`` is a length, 1/96 inch, and ``flux`` a femtolux.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from napari_shadowinv._typing import AnyArray

if TYPE_CHECKING:
    import xarray

PIXEL = "pixel"
PIXEL_AREA = "pixel**2"
FLUX_DENSITY = "1/pixel**2"
PLANE = ("y", "x")


def label(units: str, long_name: str) -> dict[str, str]:
    """Return the attributes of a variable."""
    return {"units": units, "long_name": long_name}


def place_label(name: str, plane: str = "object plane") -> dict[str, str]:
    """Return the attributes of pixels' places along y or x in metres."""
    return label("m", f"{name} in the {plane}")


def place_coordinates(
    shape: tuple[int, int], pixel_size: float | None, plane: str = "object plane"
) -> dict[str, Any]:
    """Return y and x of the pixels in metres, or their indices if their size is unknown.

    Parameters
    ----------
    shape : tuple of int
        Height and width of the image.
    pixel_size : float or None
        Size of a pixel in that plane, in metres.
    plane : str, optional
        The plane for the long names.
    """
    coordinates: dict[str, Any] = {}
    for name, count in zip(PLANE, shape, strict=True):
        index = np.arange(count, dtype=np.float64)
        if pixel_size is None:
            coordinates[name] = (name, index, label(PIXEL, f"{name} in the {plane}"))
        else:
            coordinates[name] = (name, index * pixel_size, place_label(name, plane))
    return coordinates


def display_unit(units: str) -> str:
    """Return the attribute ``units`` as figures print it: px² for ``pixel**2``."""
    return units.replace("**2", "²").replace("pixel", "px")


def numbers_of(dataset: xarray.Dataset, name: str) -> AnyArray:
    """Return a variable of a result as an array; a `ValueError` if it holds no numbers."""
    values = np.ascontiguousarray(dataset[name].values)
    if values.dtype.kind not in "buif":
        raise ValueError(f"{name} holds {values.dtype} values, expected numbers")
    return values
