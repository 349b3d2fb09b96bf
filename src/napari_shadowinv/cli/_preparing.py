"""Prepare an image as was chosen: filter it, and estimate its source.

- before pixels are summed: `repaired`
- after it: `filtered`, `estimated`
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from napari_shadowinv import filters, sources
from napari_shadowinv.cli._preparation import KEYWORDS, Estimate, Preparation
from napari_shadowinv.errors import InputError
from napari_shadowinv.io import Radiograph

__all__ = ["estimated", "filtered", "repaired"]

Plane = NDArray[np.float64]
Mask = NDArray[np.bool_]

_FUNCTIONS: dict[Estimate, Callable[..., Plane]] = {
    "uniform": sources.uniform_source,
    "gaussian": sources.gaussian_source,
    "polynomial": sources.polynomial_source,
    "low-pass": sources.low_pass_source,
    "total-variation": sources.total_variation_source,
    "interpolated": sources.interpolated_source,
}


def repaired(shot: Radiograph, chosen: Preparation) -> Radiograph:
    """Replace hot and dead pixels, while pixels are still those of the detector."""
    if chosen.hot_pixels is None:
        return shot
    found: list[Mask] = []

    def repair(image: Plane) -> Plane:
        clean, hot, dead = filters.remove_hot_pixels(image, threshold=chosen.hot_pixels or 0)
        found.extend((hot, dead))
        return clean

    image = _apply(shot, repair)
    usable = np.ones(image.shape, bool) if shot.mask is None else shot.mask
    hot, dead = (int((pixels & usable).sum()) for pixels in found)
    note = f"{hot} hot and {dead} dead pixels replaced (beyond {chosen.hot_pixels:g} deviations)"
    return _with(shot, image, note, {"hot_pixels": chosen.hot_pixels})


def filtered(shot: Radiograph, chosen: Preparation, *, is_source: bool = False) -> Radiograph:
    """Flatten and blur a shot; a measured source is only blurred, as much as its shot."""
    if chosen.background_degree is not None and not is_source:
        degree, usable = chosen.background_degree, shot.mask
        image = _apply(shot, lambda image: filters.remove_background(image, degree, mask=usable))
        note = f"divided by a polynomial of degree {degree}"
        shot = _with(shot, image, note, {"background_degree": degree})
    if chosen.high_pass is not None and not is_source:
        width = chosen.high_pass
        image = _apply(shot, lambda image: filters.high_pass(image, width))
        shot = _with(shot, image, f"high pass of {width:g} px", {"high_pass": width})
    if chosen.low_pass is not None:
        blur = chosen.low_pass
        image = _apply(shot, lambda image: filters.low_pass(image, blur))
        shot = _with(shot, image, f"low pass of {blur:g} px", {"low_pass": blur})
    return shot


def estimated(shot: Radiograph, chosen: Preparation, bare: Mask | None) -> Radiograph | None:
    """Guess the source from a shot; `bare` is True where the object is not."""
    if chosen.source_from is None:
        return None
    parameters = {
        name: getattr(chosen, name) for name in KEYWORDS if getattr(chosen, name) is not None
    }
    usable = _both(shot.mask, bare)
    keywords = {KEYWORDS[name][0]: value for name, value in parameters.items()}
    try:
        beam = _FUNCTIONS[chosen.source_from](shot.image, mask=usable, **keywords)
    except InputError as error:
        raise InputError(f"{shot.path}: {error}") from error
    details = "".join(f", {KEYWORDS[name][0]} {value:g}" for name, value in parameters.items())
    recorded = {"source_from": chosen.source_from, **parameters}
    return _with(Radiograph(beam), beam, f"{chosen.source_from}{details}", recorded)


def _both(first: Mask | None, second: Mask | None) -> Mask | None:
    if first is None or second is None:
        return second if first is None else first
    return first & second


def _apply(shot: Radiograph, change: Callable[[Plane], Plane]) -> Plane:
    """Filter an image whose masked pixels, which may hold anything, must not leak out."""
    image = shot.image
    try:
        if shot.mask is not None and not shot.mask.all():
            image = np.where(shot.mask, image, sources.interpolated_source(image, shot.mask))
        return change(image)
    except InputError as error:
        raise InputError(f"{shot.path}: {error}") from error


def _with(shot: Radiograph, image: Plane, note: str, recorded: Mapping[str, Any]) -> Radiograph:
    """The same shot with another image, and word of what was done to it."""
    metadata = {
        **shot.metadata,
        "notes": (*shot.metadata.get("notes", ()), note),
        "preparation": {**shot.metadata.get("preparation", {}), **recorded},
    }
    return replace(shot, image=image, metadata=metadata)
