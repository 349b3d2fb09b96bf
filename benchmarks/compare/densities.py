"""Ten classes of densities on a square, after the definitions of DOTmark.

Schrieber, Schuhmacher and Gottschlich, *DOTmark: a benchmark for discrete optimal transport*, IEEE
Access 5, 271 (2017), arXiv:1610.03368. Eight classes are computed here; two are pictures in
DOTmark and are other pictures here, of scikit-image. All are averages of 512×512 values over the
pixels of an image.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit

Array = NDArray[np.float64]

FINEST = 512
CLASSES = {
    "WhiteNoise": "independent uniform values",
    "GRFrough": "Gaussian random field, Matérn covariance, smoothness 0.25, range 0.05",
    "GRFmoderate": "the same, smoothness 1, range 0.15",
    "GRFsmooth": "the same, smoothness 2.5, range 0.3",
    "LogGRF": "exponential of a Gaussian random field, smoothness 0.5, range 0.4",
    "LogitGRF": "logistic function of the same, smoothness 4.5, range 0.1, variance 4",
    "CauchyDensity": "bivariate Cauchy density with a random centre and scatter",
    "Shapes": "bright ellipses, rings and polygons on a dark ground",
    "ClassicImages": "a photograph (scikit-image's `camera`)",
    "MicroscopyImages": "a micrograph (scikit-image's `cell`)",
}


def gaussian_field(rng: np.random.Generator, smoothness: float, reach: float) -> Array:
    """Sample of a Gaussian random field of variance 1 with a Matérn covariance.

    It is a part of a torus of twice the side, so that opposite borders are independent.
    """
    n = 2 * FINEST
    wave = np.fft.fftfreq(n, 2 / n)
    squared = (2 * np.pi) ** 2 * np.add.outer(wave**2, wave**2)
    amplitude = (1 / reach**2 + squared) ** (-(smoothness + 1) / 2)
    field = np.fft.ifft2(np.fft.fft2(rng.normal(size=(n, n))) * amplitude).real
    return np.asarray(field[:FINEST, :FINEST] / np.sqrt((amplitude**2).mean()))


def cauchy(rng: np.random.Generator) -> Array:
    axis = (np.arange(FINEST) + 0.5) / FINEST
    centre = rng.uniform(0.3, 0.7, size=2)
    factor = rng.normal(size=(2, 2)) * 0.1
    scatter = factor @ factor.T + 0.01 * np.eye(2)
    y, x = (axis - centre[0])[:, None], (axis - centre[1])[None, :]
    (yy, yx), (_, xx) = np.linalg.inv(scatter)
    return np.asarray((1 + yy * y**2 + 2 * yx * y * x + xx * x**2) ** -1.5)


def shapes(rng: np.random.Generator) -> Array:
    """Bright shapes, one in each quarter of the square: ellipse, ring, triangle, rectangle."""
    axis = (np.arange(FINEST) + 0.5) / FINEST
    image = np.zeros((FINEST, FINEST))
    for number, (row, column) in enumerate(
        ((0.27, 0.27), (0.27, 0.73), (0.73, 0.27), (0.73, 0.73))
    ):
        angle = rng.uniform(0, np.pi)
        y, x = (axis - row)[:, None], (axis - column)[None, :]
        u, v = y * np.cos(angle) + x * np.sin(angle), x * np.cos(angle) - y * np.sin(angle)
        r = np.hypot(u, v / rng.uniform(0.5, 1))
        inside = [
            r < 0.19,
            (r > 0.09) & (r < 0.19),
            (u > -0.1) & (u + 1.7 * np.abs(v) < 0.19),
            (np.abs(u) < 0.17) & (np.abs(v) < 0.11),
        ][number]
        image[inside] = 1
    return image


def picture(name: str) -> Array:
    """Middle of a picture of scikit-image, reduced to the finest pixels."""
    from skimage import data
    from skimage.transform import resize

    values = np.asarray(getattr(data, name)(), dtype=np.float64)
    side = min(values.shape)
    top, left = ((length - side) // 2 for length in values.shape)
    square = values[top : top + side, left : left + side]
    return np.asarray(resize(square, (FINEST, FINEST), anti_aliasing=True))


def finest_density(name: str, seed: int = 0) -> Array:
    rng = np.random.default_rng([seed, list(CLASSES).index(name)])
    match name:
        case "WhiteNoise":
            values = rng.uniform(size=(FINEST, FINEST))
        case "GRFrough":
            values = gaussian_field(rng, 0.25, 0.05)
        case "GRFmoderate":
            values = gaussian_field(rng, 1, 0.15)
        case "GRFsmooth":
            values = gaussian_field(rng, 2.5, 0.3)
        case "LogGRF":
            values = np.exp(gaussian_field(rng, 0.5, 0.4))
        case "LogitGRF":
            values = expit(2 * gaussian_field(rng, 4.5, 0.1))
        case "CauchyDensity":
            values = cauchy(rng)
        case "Shapes":
            values = shapes(rng)
        case "ClassicImages":
            values = picture("camera")
        case _:
            values = picture("cell")
    return np.asarray(values - min(values.min(), 0))


def density(name: str, n: int, seed: int = 0) -> Array:
    """Density of a class on n×n pixels with a mean of 1."""
    if name == "WhiteNoise":  # its mean over pixels would be uniform
        values = np.random.default_rng([seed, n]).uniform(size=(n, n))
    else:
        block = FINEST // n
        values = finest_density(name, seed).reshape(n, block, n, block).mean(axis=(1, 3))
    return np.asarray(values / values.mean())
