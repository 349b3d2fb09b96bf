"""POT, exact transport between pixels by the network simplex; mean landing place of each pixel."""

import numpy as np
import ot

VERSION = ot.__version__


def solve(source: np.ndarray, image: np.ndarray) -> np.ndarray:
    places = np.indices(image.shape, dtype=float).reshape(2, -1).T.copy()
    lit, seen = source.ravel() > 0, image.ravel() > 0
    start, end = places[lit], places[seen]
    a, b = source.ravel()[lit], image.ravel()[seen]
    a, b = a / a.sum(), b / b.sum()
    plan = ot.emd(a, b, ot.dist(start, end), numItermax=100_000_000)
    shift = np.full(places.shape, np.nan)
    shift[lit] = plan @ end / plan.sum(axis=1)[:, None] - start
    return shift.T.reshape(2, *image.shape)
