"""MultiScaleOT, entropic transport between pixels (sparse multi-scale Sinkhorn), ε = 1 px²."""

from importlib.metadata import version

import MultiScaleOT
import numpy as np
from scipy.sparse import csr_matrix

VERSION = version("MultiScaleOT")
_REGULARISATION = 1.0  # px²


def solve(source: np.ndarray, image: np.ndarray) -> np.ndarray:
    depth = int(np.log2(min(image.shape)))
    pair = (np.maximum(values, 1e-3 * values.mean()) for values in (source, image))
    x, y = (MultiScaleOT.TMultiScaleSetupGrid(values / values.sum(), depth) for values in pair)
    cost = MultiScaleOT.THierarchicalCostFunctionProvider_SquaredEuclidean(x, y)
    schedule = MultiScaleOT.TEpsScalingHandler()
    schedule.setupGeometricMultiLayerB(x.getNLayers(), _REGULARISATION, 4.0, 2, 0)
    solver = MultiScaleOT.TSinkhornSolverStandard(schedule, 1, depth, 1e-4, x, y, cost)
    if status := solver.initialize() or solver.solve():
        raise RuntimeError(f"the solver ended with status {status}")
    plan = csr_matrix(solver.getKernelCSRDataTuple(), shape=(image.size, image.size))
    places = np.indices(image.shape, dtype=float).reshape(2, -1).T
    landed = plan @ places / np.asarray(plan.sum(axis=1))
    return (landed - places).T.reshape(2, *image.shape)
