"""OTT, entropic transport on the grid of the pixels (Sinkhorn with ε-scaling), ε = 1 px²."""

import jax
import numpy as np
import ott
from ott.geometry import epsilon_scheduler, grid
from ott.problems.linear import linear_problem
from ott.solvers.linear import sinkhorn

VERSION = ott.__version__
_REGULARISATION = 1.0  # px²
jax.config.update("jax_enable_x64", True)


def solve(source: np.ndarray, image: np.ndarray) -> np.ndarray:
    beam = np.maximum(source, 1e-3 * source.mean()).ravel()
    light = np.maximum(image, 1e-3 * image.mean()).ravel()
    axes = [np.arange(length, dtype=float) for length in image.shape]
    schedule = epsilon_scheduler.Epsilon(_REGULARISATION, init=100.0, decay=0.9)
    plane = grid.Grid(x=axes, epsilon=schedule)
    problem = linear_problem.LinearProblem(plane, a=beam / beam.sum(), b=light / light.sum())
    output = sinkhorn.Sinkhorn(threshold=1e-4, max_iterations=2000)(problem)
    places = np.indices(image.shape, dtype=float).reshape(2, -1)
    landed = np.stack([np.asarray(output.apply(row, axis=1)) for row in places])
    mass = np.asarray(output.apply(np.ones(image.size), axis=1))
    return (landed / mass - places).reshape(2, *image.shape)
