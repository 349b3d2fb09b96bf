"""An image and a source made ready for the transport.

- check and normalise: `prepare`
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from napari_shadowinv.errors import InputError
from napari_shadowinv.memory import physical_memory
from napari_shadowinv.options import MAX_DEFAULT_SITES, InversionOptions

__all__ = ["Prepared", "checked_source", "number_of_sites", "prepare"]

Array = NDArray[np.float64]

_SMALLEST_SIDE = 4
_BYTES_PER_SITE = 2000  # measured peak of a whole inversion, rounded up
_NOTABLE_FLUX_CHANGE = 0.05


@dataclass(frozen=True)
class Prepared:
    """An image and a source of the same flux.

    Attributes
    ----------
    image : ndarray, shape (H, W)
        Clipped where asked for, scaled to the flux of the source.
    source : ndarray, shape (H, W)
        The undisturbed beam.
    floored : ndarray, shape (H, W)
        `image` with every pixel at or above the floor, of the same flux.
    clipped_pixels, floored_pixels : int
        How many pixels were negative, and how many, these included, below the floor.
    warnings : tuple of str
        What the user should know.
    """

    image: Array
    source: Array
    floored: Array
    clipped_pixels: int
    floored_pixels: int
    warnings: tuple[str, ...]


def prepare(image: ArrayLike, source: ArrayLike | None, options: InversionOptions) -> Prepared:
    """Check an image and its source, and bring them to the same flux.

    Parameters
    ----------
    image : array_like, shape (H, W)
        The shot; counts or any linear measure of fluence.
    source : array_like, shape (H, W), optional
        The undisturbed beam; uniform if None.
    options : InversionOptions
        Its `floor` and `negative` are used.

    Returns
    -------
    Prepared

    Raises
    ------
    InputError
        If an array cannot be an image of a beam: wrong shape, not a number, negative, zero.
    """
    values = _finite_image(image, "image")
    negative = int((values < 0).sum())
    if negative and options.negative == "refuse":
        raise InputError(
            f"image has {negative} negative pixels (least {values.min():.4g}), expected none: "
            "if they are left over from background subtraction, ask for them to be clipped "
            "(negative='clip', or --clip-negative on the command line)"
        )
    values = np.maximum(values, 0)
    if not values.any():
        raise InputError(
            "image has no positive pixel, expected a beam: check the file and its background"
        )
    beam = np.full(values.shape, values.mean()) if source is None else checked_source(source)
    if beam.shape != values.shape:
        raise InputError(f"source has shape {beam.shape}, image {values.shape}: they must match")
    ratio = float(values.sum() / beam.sum())
    values = values / ratio
    least = options.floor * values.mean()
    floored = np.maximum(values, least)
    below = int((values < least).sum())
    return Prepared(
        image=values,
        source=beam,
        floored=floored * (beam.sum() / floored.sum()),
        clipped_pixels=negative,
        floored_pixels=below,
        warnings=_warnings(ratio, negative, below, values.size),
    )


def _warnings(ratio: float, clipped: int, floored: int, size: int) -> tuple[str, ...]:
    warnings = []
    if abs(ratio - 1) > _NOTABLE_FLUX_CHANGE:
        warnings.append(
            f"the image's flux is {ratio:.3g} times the source's; it was scaled to match"
        )
    if clipped:
        warnings.append(f"{clipped} negative pixels ({clipped / size:.2%}) were set to zero")
    dark = floored - clipped
    if dark > 0:
        warnings.append(
            f"{dark} dark pixels ({dark / size:.2%}) were raised to the floor; "
            "the field inside dark areas is not reliable"
        )
    return tuple(warnings)


def checked_source(source: ArrayLike) -> Array:
    """Return a source as floats, or raise an `InputError` that says what is wrong with it."""
    beam = _finite_image(source, "source")
    if (beam < 0).any():
        raise InputError(
            f"source has {int((beam < 0).sum())} negative pixels, expected none: "
            "clip or smooth it first"
        )
    if not beam.any():
        raise InputError("source is zero everywhere, expected the undisturbed beam")
    return beam


def _finite_image(values: ArrayLike, name: str) -> Array:
    array = np.asarray(values)
    if array.ndim != 2:
        raise InputError(
            f"{name} has shape {array.shape}, expected two dimensions (y, x): "
            "choose one channel or one shot"
        )
    if min(array.shape) < _SMALLEST_SIDE:
        raise InputError(
            f"{name} has shape {array.shape}, expected at least "
            f"{_SMALLEST_SIDE} × {_SMALLEST_SIDE} pixels"
        )
    if array.dtype.kind not in "buif":
        raise InputError(f"{name} has values of type {array.dtype}, expected real numbers")
    array = np.array(array, dtype=np.float64)
    bad = int((~np.isfinite(array)).sum())
    if bad:
        raise InputError(
            f"{name} has {bad} pixels that are NaN or infinite, expected none: "
            "replace them, for instance by the median of their neighbours"
        )
    return array


def number_of_sites(shape: tuple[int, int], options: InversionOptions) -> int:
    """Return the sites to use for an image, or say why there cannot be so many.

    Raises
    ------
    InputError
        If they would not fit in memory.
    """
    wanted = options.n_sites
    n_sites = min(shape[0] * shape[1], MAX_DEFAULT_SITES) if wanted is None else wanted
    memory = physical_memory()
    if memory is not None and n_sites * _BYTES_PER_SITE > memory:
        raise InputError(
            f"{n_sites:,} sites need about {n_sites * _BYTES_PER_SITE / 1e9:.3g} GB, this "
            f"machine has {memory / 1e9:.3g} GB: use at most {memory // _BYTES_PER_SITE:,} sites"
        )
    return n_sites
