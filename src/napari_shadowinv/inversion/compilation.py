"""The compiler's work, done once after an installation.

- compile before an inversion that a user waits for: `ensure_compiled`
- the share of a second process: `compile_rest`
"""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np

from napari_shadowinv._system.progress import OnProgress, Reporter, ShouldStop
from napari_shadowinv.inversion.machine_code import compilation_frequency, is_compiled

_NODES = 300  # enough for a multigrid


def ensure_compiled(
    on_progress: OnProgress | None = None, should_stop: ShouldStop | None = None
) -> None:
    """Compile all kernels before the first inversion, unless an earlier run has."""
    if is_compiled():
        return
    from napari_shadowinv.geometry.density import Density
    from napari_shadowinv.geometry.power_diagram import PowerDiagram
    from napari_shadowinv.geometry.triangulation import RegularTriangulation, hilbert_order
    from napari_shadowinv.inversion import invert
    from napari_shadowinv.transport.linear import LaplacianSolver

    Reporter(on_progress, should_stop)("compile", 0, None, compilation_frequency())
    y, x = np.indices((64, 64)) / 64  # enough sites for every kernel to be used
    uneven = np.exp(-4 * (y + x))
    invert(uneven * (1 + y * x), source=uneven, should_stop=should_stop)
    # Kernels that only large networks need, with blocks on two levels:
    sites = np.random.default_rng(0).uniform(0, 19, (_NODES, 2))
    triangulation = RegularTriangulation(sites[hilbert_order(sites)])
    diagram = PowerDiagram(triangulation, Density.from_image(np.ones((20, 20))))
    LaplacianSolver(diagram.laplacian(), nodes_per_block=_NODES // 10).solve(diagram.masses)


def compile_rest() -> None:
    """Compile the kernels that an inversion uses after its triangulation, the last ones first."""
    from scipy.spatial import Delaunay

    from napari_shadowinv.geometry.density import Density
    from napari_shadowinv.geometry.interpolation import CloughTocher, fit_gradients
    from napari_shadowinv.geometry.power_diagram import PowerDiagram
    from napari_shadowinv.physics.forward import jacobian_determinant, synthetic_image
    from napari_shadowinv.transport.linear import LaplacianSolver

    synthetic_image(np.zeros((2, 8, 8)), np.ones((8, 8)))
    jacobian_determinant(np.zeros((2, 8, 8)))
    sites = np.random.default_rng(0).uniform(0, 19, (_NODES, 2))
    ghosts = 1e3 * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    points = np.concatenate([sites, ghosts])
    mesh = Delaunay(points)
    arrays = {
        "points": points,
        "weights": np.zeros(len(points)),
        "vertices": mesh.simplices.astype(np.int32),
        "neighbors": mesh.neighbors.astype(np.int32),
    }
    t, k = np.nonzero(arrays["neighbors"] > np.arange(len(mesh.neighbors))[:, None])
    ends = [arrays["vertices"][t, (k + shift) % 3] for shift in (1, 2)]
    edges = (
        np.stack(ends, axis=1),
        np.stack([t, arrays["neighbors"][t, k]], axis=1).astype(np.int32),
    )
    for array in (*arrays.values(), *edges):
        array.flags.writeable = False  # as those of a triangulation, which is another type
    triangulation: Any = SimpleNamespace(sites=arrays["points"][:-4], edges=edges, **arrays)
    values = sites.sum(axis=1)
    gradients = fit_gradients(triangulation, values, np.ones_like(sites))
    surface = CloughTocher(triangulation, values, gradients)
    surface(sites)
    surface.at_pixels((20, 20))
    density = Density.from_image(np.ones((20, 20)))
    _ = PowerDiagram(triangulation, density, with_moments=True).centroids
    diagram = PowerDiagram(triangulation, density)
    LaplacianSolver(diagram.laplacian()).solve(diagram.masses)
