"""Features of the sites, and the shapes of their cells."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from napari_shadowinv._typing import FloatArray
from napari_shadowinv.errors import InputError

if TYPE_CHECKING:
    import xarray

    from napari_shadowinv.inversion import Inversion

Cells = tuple[list[FloatArray], NDArray[np.intp]]

_MAX_CELLS = 5_000


def site_features(dataset: xarray.Dataset) -> dict[str, FloatArray]:
    """Return weight (px²), mass (flux), displacement (px) and flux residual of each site."""
    mass = dataset["site_mass"].values
    return {
        "weight": dataset["weights"].values,
        "mass": mass,
        "displacement": np.hypot(*dataset["site_displacement"].values.T),
        # Excess of the cell's flux in the image, relative to the mass.
        "flux residual": dataset["site_flux"].values / mass - 1,
    }


def power_cells(inversion: Inversion) -> Cells:
    """Return corners (y, x) of the final non-empty cells, clipped to the image, and their sites."""
    count = len(inversion.sites)
    if count > _MAX_CELLS:
        raise InputError(
            f"the result has {count:,} sites: power cells can be shown for up to {_MAX_CELLS:,} "
            "sites; invert with fewer sites to show the cells"
        )
    from napari_shadowinv.geometry.density import Density
    from napari_shadowinv.geometry.power_diagram import PowerDiagram
    from napari_shadowinv.geometry.triangulation import RegularTriangulation
    from napari_shadowinv.inversion.normalise import margin_around

    options, shape = inversion.options, inversion.potential.shape
    margin = margin_around(shape, options) if options.boundary == "free" else 0
    # The cells do not depend on the density.
    uniform = Density.from_image(np.ones([side + 2 * margin for side in shape]))
    triangulation = RegularTriangulation(
        inversion.sites + margin, inversion.weights, region=uniform.region
    )
    diagram = PowerDiagram(triangulation, uniform, threads=options.threads)
    polygons = [_clip(diagram.cell(site) - margin, *shape) for site in range(count)]
    nonempty = np.flatnonzero([len(polygon) > 2 for polygon in polygons])
    return [polygons[site] for site in nonempty], nonempty


def _clip(corners: FloatArray, height: int, width: int) -> FloatArray:
    """Clip a convex polygon to the image, one side after the other."""
    sides = ((0, -1, 0.5), (0, 1, height - 0.5), (1, -1, 0.5), (1, 1, width - 0.5))
    for axis, sign, limit in sides:
        if not len(corners):
            break
        inside = limit - sign * corners[:, axis]
        vertices = []
        for k in range(len(corners)):
            before, after = inside[k - 1], inside[k]
            if (before >= 0) != (after >= 0):
                share = before / (before - after)
                vertices.append(corners[k - 1] + share * (corners[k] - corners[k - 1]))
            if after >= 0:
                vertices.append(corners[k])
        corners = np.array(vertices).reshape(-1, 2)
    return corners
