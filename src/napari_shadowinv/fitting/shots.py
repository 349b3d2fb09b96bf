"""Shots of a fit: `list_shots`, and attributes that they have in common.

- a field near which a fit is to end: `NearField`
- width of the point spread in px, from the beam's source and the detector: `point_spread`
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from napari_shadowinv._typing import FloatArray
from napari_shadowinv.errors import InputError
from napari_shadowinv.physics.setup import Setup
from napari_shadowinv.shot import Shot

Shots = Shot | ArrayLike | Sequence[Shot | ArrayLike]


@dataclass(frozen=True, eq=False)
class NearField:
    """A field near the true one, from which alone a fit starts: no alternatives are looked for."""

    potential: FloatArray  # (H, W), px², of the first field
    smoothness: tuple[float, float]  # λ and κ of a similar fit, which are not estimated


def list_shots(shots: Shots) -> list[Shot]:
    """Return the shots of one image or of several; an `InputError` if there is none."""
    images: Any = shots
    is_one = isinstance(images, (Shot, str, Path)) or np.ndim(images) == 2
    listed = [
        image if isinstance(image, Shot) else Shot(image)
        for image in ([images] if is_one else images)
    ]
    if not listed:
        raise InputError("received no image: expected one or several of one object")
    return listed


def names_of(shots: Sequence[Shot]) -> tuple[str, ...]:
    """Return the names of images, or their numbers."""
    return tuple(shot.name or f"image {k + 1}" for k, shot in enumerate(shots))


def common_values(
    names: Sequence[str], values: Sequence[Any], quantity: str
) -> tuple[Any, ...] | None:
    """Return a quantity's value in each image, by their names, or None if none has one.

    An `InputError` if some images have a value and others have none.
    """
    without = [name for name, value in zip(names, values, strict=True) if value is None]
    if len(without) == len(names):
        return None
    if without:
        raise InputError(
            f"{without[0]} has no {quantity}, other images have: expected it for all of them, or "
            "none"
        )
    return tuple(values)


def values_of(shots: Sequence[Shot], attribute: str) -> tuple[Any, ...] | None:
    """Return an attribute of all images, None if none has it; see `common_values`."""
    return common_values(names_of(shots), [getattr(each, attribute) for each in shots], attribute)


def value_of_first(shots: Sequence[Shot], attribute: str) -> Any:
    """Return a value that only the first image may have; an `InputError` if a later one has it."""
    if any(getattr(shot, attribute) is not None for shot in shots[1:]):
        raise InputError(
            f"received {attribute} of a later image: expected them in the first image, whose "
            "pixels are those of the fields"
        )
    return getattr(shots[0], attribute) if shots else None


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
