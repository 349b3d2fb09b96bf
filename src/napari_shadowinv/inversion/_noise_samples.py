"""Random samples of an image with noise: `noise_of`."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike
from scipy import ndimage

from napari_shadowinv._system.arrays import plain_array, unpack_array
from napari_shadowinv._typing import AnyArray, BoolArray, FloatArray
from napari_shadowinv.errors import InputError

__all__ = ["Draw", "noise_of"]

Draw = Callable[[np.random.Generator, float], FloatArray]
"""Returns a noisy image, with noise that a Gaussian of some standard deviation (px) correlates."""

_BLUR_REACH = 4.0  # standard deviations
_MOST_QUANTA = 1e18  # numpy draws no larger Poisson numbers


def noise_of(
    image: ArrayLike, noise: object, units_per_quantum: float | None, mask: ArrayLike | None
) -> tuple[Draw, str]:
    """Return a function that draws a noisy image, and a text that describes the noise."""
    values = np.asarray(unpack_array(image, "image")[0])
    if values.dtype.kind not in "buif":
        raise InputError(f"image has values of type {values.dtype}, expected real numbers")
    usable = np.isfinite(values)
    if mask is not None and np.shape(mask) == values.shape:
        usable &= np.asarray(mask, dtype=bool)
    values = np.where(usable, values, 0.0)
    if isinstance(noise, str):
        if noise != "poisson":
            raise InputError(
                f"noise is {noise!r}, expected 'poisson', a standard deviation or an array of them"
            )
        return _poisson(values, units_per_quantum)
    if units_per_quantum is not None:
        raise InputError(
            f"units_per_quantum is {units_per_quantum!r} and noise a standard deviation: "
            "units_per_quantum belongs to noise='poisson'"
        )
    return _gaussian(values, np.asarray(plain_array(noise, "noise")), usable)


def _poisson(values: FloatArray, units_per_quantum: float | None) -> tuple[Draw, str]:
    if units_per_quantum is None:
        if np.any(values != np.rint(values)):
            raise InputError(
                "image has values that are not whole numbers, so they are not counts: give the "
                "units_per_quantum (image units per detected quantum), or the noise as a standard "
                "deviation"
            )
        units_per_quantum = 1.0
    if not (np.isreal(units_per_quantum) and 0 < units_per_quantum < np.inf):
        raise InputError(
            f"units_per_quantum is {units_per_quantum!r}, expected a positive number: image units"
        )
    quanta = np.maximum(values, 0) / units_per_quantum
    if quanta.max(initial=0) > _MOST_QUANTA:
        raise InputError(
            f"units_per_quantum is {units_per_quantum:g} and the brightest pixel {values.max():g}: "
            f"that is more than {_MOST_QUANTA:g} quanta in a pixel, expected fewer: check the unit"
        )
    # A blur leaves the counting noise of many pixels as it was.
    text = f"Poisson, {units_per_quantum:g} per quantum"
    return lambda rng, blur: units_per_quantum * rng.poisson(quanta), text


def _gaussian(values: FloatArray, sigma: AnyArray, usable: BoolArray) -> tuple[Draw, str]:
    if sigma.dtype.kind not in "uif":
        raise InputError(
            f"noise has values of type {sigma.dtype}, expected 'poisson', a standard deviation "
            "or an array of them"
        )
    if sigma.ndim > 0 and sigma.shape != values.shape:
        raise InputError(
            f"noise has shape {sigma.shape}, image {values.shape}: they must match, or give one "
            "number for all pixels"
        )
    deviation = np.where(usable, sigma, 0.0)
    if not (np.isfinite(deviation).all() and (deviation >= 0).all() and deviation.any()):
        raise InputError(
            "noise is zero everywhere, or somewhere negative or not finite: expected standard "
            "deviations in the image's units"
        )
    described = f"Gaussian, {sigma:g}" if sigma.ndim == 0 else "Gaussian, pixel by pixel"
    return lambda rng, blur: values + deviation * _normal(rng, values.shape, blur), described


def _normal(rng: np.random.Generator, shape: tuple[int, ...], blur: float) -> FloatArray:
    """Normal noise of deviation 1, correlated as by a Gaussian blur (px)."""
    if not blur > 0:
        return rng.normal(size=shape)
    reach = math.ceil(_BLUR_REACH * blur)
    kernel = np.exp(-(np.arange(-reach, reach + 1) ** 2) / (2 * blur**2))
    kernel /= np.sqrt((kernel**2).sum())
    noise: FloatArray = rng.normal(size=[side + 2 * reach for side in shape])
    for axis in (0, 1):
        noise = ndimage.correlate1d(noise, kernel, axis)
    return noise[reach:-reach, reach:-reach]
