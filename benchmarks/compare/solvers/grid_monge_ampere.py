"""Grid Monge-Ampère, the project's own stand-in for PROBLEM and other codes that are no packages.

The parabolic iteration of Sulman, Williams and Russell, Appl. Numer. Math. 61, 298 (2011):
∂u/∂t = log(I(∇u) det ∇∇u / I₀) until u is at rest; ∇u is where a ray lands. Few pixels first, and
from their potential on to twice as many each way.
"""

import os
import time

import numpy as np
import scipy
from scipy.ndimage import map_coordinates, zoom

VERSION = f"SciPy {scipy.__version__}"
_TOLERANCE = 1e-8  # mean square of the logarithm
_PATIENCE = 3000  # steps in which it falls by less than a tenth
_COARSEST = 32  # px


def solve(source: np.ndarray, image: np.ndarray) -> np.ndarray:
    end = time.monotonic() + 0.8 * float(os.environ.get("COMPARE_LIMIT", "inf"))
    phi, factor = np.zeros((1, 1)), 1
    while min(image.shape) // factor > _COARSEST and not any(n % (2 * factor) for n in image.shape):
        factor *= 2
    while factor:
        beam, light = (_blocks(values, factor) for values in (source, image))
        repeat = [n // m for n, m in zip(beam.shape, phi.shape, strict=True)]
        phi = repeat[0] ** 2 * zoom(phi, repeat, order=1, mode="nearest", grid_mode=True)
        phi, shift = _relax(beam, light, phi, end)
        factor //= 2
    return shift


def _blocks(values: np.ndarray, size: int) -> np.ndarray:
    height, width = (n // size for n in values.shape)
    means = values.reshape(height, size, width, size).mean(axis=(1, 3)) / values.mean()
    return np.maximum(means, 1e-3)


def _relax(
    beam: np.ndarray, light: np.ndarray, phi: np.ndarray, end: float
) -> tuple[np.ndarray, np.ndarray]:
    places = np.indices(phi.shape, dtype=float)
    best_error = mark = np.inf
    best, waited = (phi, places), 0
    while best_error > _TOLERANCE and waited < _PATIENCE and time.monotonic() < end:
        p = np.pad(phi, 1, mode="symmetric")  # no ray crosses the border
        shift = np.stack([p[2:, 1:-1] - p[:-2, 1:-1], p[1:-1, 2:] - p[1:-1, :-2]]) / 2
        yy, xx = p[2:, 1:-1] - 2 * phi + p[:-2, 1:-1], p[1:-1, 2:] - 2 * phi + p[1:-1, :-2]
        yx = (p[2:, 2:] - p[2:, :-2] - p[:-2, 2:] + p[:-2, :-2]) / 4
        area = np.maximum((1 + yy) * (1 + xx) - yx**2, 1e-3)
        landed = map_coordinates(light, places + shift, order=1, mode="nearest")
        slope = np.log(landed * area / beam)
        slope -= slope.mean()
        error = float(np.mean(slope**2))
        if error < best_error:
            best, best_error = (phi.copy(), shift), error
        waited += 1
        if error < 0.9 * mark:
            mark, waited = error, 0
        speed = sum(float(np.abs(np.diff(slope, axis=axis)).max()) for axis in (0, 1))
        phi += 0.25 * slope / (1 + speed / max(float(area.min()), 0.1))
    return best
