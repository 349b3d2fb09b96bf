"""Prepare an image as was chosen: filter it, and estimate its source.

- before pixels are summed: `repaired`
- after it: `filtered`, `estimated`
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from napari_shadowinv.cli._choices import FILTER_CHOICES, KEYWORDS, Choices
from napari_shadowinv.errors import InputError
from napari_shadowinv.io import Radiograph
from napari_shadowinv.preprocessing.filters import remove_hot_pixels
from napari_shadowinv.preprocessing.preparation import Preparation
from napari_shadowinv.preprocessing.recipes import UniformEstimate, without_masked
from napari_shadowinv.preprocessing.sources import uniform_warnings

if TYPE_CHECKING:
    from napari_shadowinv.physics.setup import Setup

__all__ = ["estimated", "filtered", "repaired"]

Plane = NDArray[np.float64]
Mask = NDArray[np.bool_]


def repaired(shot: Radiograph, chosen: Choices) -> Radiograph:
    """Replace hot and dead pixels, while pixels are still those of the detector."""
    if chosen.hot_pixels is None:
        return shot
    with _named(shot):
        image = without_masked(shot.image, shot.mask)
        clean, hot, dead = remove_hot_pixels(image, threshold=chosen.hot_pixels)
    usable = np.ones(image.shape, bool) if shot.mask is None else shot.mask
    counts = (int((pixels & usable).sum()) for pixels in (hot, dead))
    note = "{} hot and {} dead pixels replaced (beyond {:g} standard deviations)".format(
        *counts, chosen.hot_pixels
    )
    return _with(shot, clean, [note], {"hot_pixels": chosen.hot_pixels})


def filtered(shot: Radiograph, chosen: Choices) -> Radiograph:
    """Flatten and blur a shot, or blur its measured source, which nothing may flatten."""
    preparation = Preparation(chosen.filters())
    with _named(shot):
        image = preparation.filtered(shot.image, shot.mask)
    notes = [one.described for one in preparation.filters]
    return _with(shot, image, notes, chosen.given(*FILTER_CHOICES))


def estimated(
    shot: Radiograph, chosen: Choices, bare: Mask | None, setup: Setup | None
) -> tuple[Radiograph | None, tuple[str, ...]]:
    """Guess the source from a shot, with doubts of it; `bare` is True where the object is not."""
    estimate = chosen.estimate()
    doubts: list[str] = []
    if estimate is None or isinstance(estimate, UniformEstimate):
        height, width = shot.image.shape
        doubts.extend(uniform_warnings((height, width), setup))
    if estimate is None:
        return None, tuple(doubts)
    with _named(shot):
        estimate = estimate.placed(setup, shot.image.shape)
        preparation = Preparation((), estimate, bare)
        preparation.check(has_source=False, mask=shot.mask)
        beam = preparation.estimated(shot.image, shot.mask, on_warning=doubts.append)
    recorded = {"source_from": chosen.source_from, **chosen.given(*KEYWORDS)}
    source = _with(Radiograph(beam), beam, [estimate.described], recorded)
    return source, tuple(doubts)


@contextmanager
def _named(shot: Radiograph) -> Iterator[None]:
    """Tell of which file it is that something cannot be done."""
    try:
        yield
    except InputError as error:
        raise InputError(f"{shot.path}: {error}") from error


def _with(
    shot: Radiograph, image: Plane, notes: list[str], recorded: Mapping[str, Any]
) -> Radiograph:
    """The same shot with another image, and word of what was done to it."""
    if not recorded:
        return shot
    metadata = {
        **shot.metadata,
        "notes": (*shot.metadata.get("notes", ()), *notes),
        "preparation": {**shot.metadata.get("preparation", {}), **recorded},
    }
    return replace(shot, image=image, metadata=metadata)
