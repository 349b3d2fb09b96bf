"""Blur of images by the beam's source and the detector.

- its width in px, from an experiment: `point_spread`
- widths or kernels as a fit takes them: `checked_point_spread`
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from napari_shadowinv._system.arrays import as_numbers
from napari_shadowinv._typing import FloatArray
from napari_shadowinv.errors import InputError
from napari_shadowinv.physics.setup import Setup

__all__ = ["checked_point_spread", "point_spread"]


def point_spread(setup: Setup, source_size: float = 0.0, resolution: float = 0.0) -> float:
    """Return the standard deviation in px by which an image is blurred.

    Parameters
    ----------
    setup : Setup
        The experiment.
    source_size : float, default 0
        Standard deviation of the beam's source in m; a FWHM is 2.355 times as large.
    resolution : float, default 0
        Standard deviation of the detector's point spread in m, at the detector.

    Returns
    -------
    float
        σ in px at the object: a source of size s is seen as s L/l at the detector, all of it
        divided by the magnification.

    Raises
    ------
    InputError
        If a length is negative or not finite.
    """
    for name, length in (("source_size", source_size), ("resolution", resolution)):
        if not 0 <= length < np.inf:
            raise InputError(f"{name} is {length}: expected a length in m, 0 or more")
    magnification = setup.magnification
    width = np.hypot(source_size * (magnification - 1), resolution)
    return float(width / magnification / setup.object_pixel_size)


def checked_point_spread(psf: Any, count: int, size: tuple[int, int]) -> list[float | FloatArray]:
    """Return a standard deviation in px or a normalised kernel for each of `count` images."""
    try:
        alone = np.array(psf, dtype=np.float64).ndim in (0, 2)
    except (TypeError, ValueError):  # widths and kernels, or kernels of several sizes
        alone = not isinstance(psf, Sequence) or isinstance(psf, str)
    each = [psf] * count if alone else list(psf)
    if len(each) != count:
        raise InputError(f"psf has {len(each)} entries: expected one, or one for each of {count}")
    kernels: list[float | FloatArray] = []
    for blur in each:
        values = as_numbers("psf", blur)
        if not values.size or not np.isfinite(values).all() or values.min() < 0:
            raise InputError(f"psf is {blur}: expected a standard deviation in px or a kernel")
        if values.ndim == 0:
            if float(values) > min(size) / 8:
                raise InputError(
                    f"psf is {float(values):g} px: expected less than an eighth of a side"
                )
            kernels.append(float(values))
            continue
        if values.ndim != 2 or not all(side % 2 for side in values.shape) or not values.sum() > 0:
            raise InputError(f"psf has shape {values.shape}: expected a kernel with odd sides")
        kernels.append(values / values.sum())
    return kernels
