"""From the weights of the sites to a smooth potential everywhere.

In the optimum the image of site i lies at r_i - ½ ∇w, so half the weights are the
normalised deflection potential at the sites, and minus the displacements of the cells'
centroids are, nearly, its gradients. A C¹ surface through both serves the read-out at
the pixels and the start of a finer level.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from napari_shadowinv.geometry.interpolation import (
    CloughTocher,
    fit_gradients,
)
from napari_shadowinv.transport.sites import Level

__all__ = ["potential_surface"]

Array = NDArray[np.float64]


def potential_surface(
    level: Level,
    weights: Array,
    displacement: Array,
    *,
    sweeps: int = 1,
    threads: int | None = None,
) -> CloughTocher:
    """Lay a C¹ surface through the potential at the sites.

    No flux crosses the border of the image, so the potential is level across it, and its
    mirror image continues it smoothly.

    Parameters
    ----------
    level : Level
        The sites.
    weights : ndarray, shape (n,)
        Their weights, px².
    displacement : ndarray, shape (n, 2)
        Displacement of each site, px; see `LevelSolution`.
    sweeps : int
        Sweeps of the gradient fit (see `fit_gradients`).
    threads : int, optional
        Threads of the evaluation.

    Returns
    -------
    CloughTocher
        The potential (px²) and its gradient at any point of the image.
    """
    mirrored = level.mirrored
    potential = 0.5 * weights
    gradient = fit_gradients(level.triangulation, potential, -displacement, sweeps)
    return CloughTocher(
        mirrored.triangulation,
        potential[mirrored.origin],
        mirrored.sense * gradient[mirrored.origin],
        threads=threads,
    )
