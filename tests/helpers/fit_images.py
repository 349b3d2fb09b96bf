"""Images made without the package: rays at random places, counted where they land."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import fields
from typing import Any

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from napari_shadowinv._typing import FloatArray
from napari_shadowinv.fitting import Fit, _fit, fit
from napari_shadowinv.fitting.forward import Linear
from napari_shadowinv.fitting.unknowns import Unknowns
from napari_shadowinv.shot import Shot, shots_of

__all__ = [
    "Displacement",
    "bump",
    "counted",
    "distance",
    "fit_images",
    "hessian_times",
    "noisy",
    "of_each",
    "on_pixels",
    "together",
    "without_causes",
]

_PARTS = 4  # of a pixel, each way, in which light is spread
_STRIP = 16  # lines of rays that are traced at once: few enough for the processor's cache

Displacement = Callable[[FloatArray, FloatArray], FloatArray]
"""Of the rays that start at y and x: an array (2, …), all in px."""


def bump(
    slope: float, width: float, middle: tuple[float, float], tall: float = 1.0
) -> Displacement:
    """A potential with a Gaussian's shape, `tall` times as long along y as along x.

    In the middle the displacement along x grows by `slope` a px: rays meet from -1 downwards, and
    from 2.24 upwards, where they fold into a ring.
    """

    def displaced(y: FloatArray, x: FloatArray) -> FloatArray:
        v, u = (y - middle[0]) / tall, x - middle[1]
        return slope * np.exp(-(v**2 + u**2) / 2 / width**2) * np.stack([v / tall, u])

    return displaced


def together(*parts: Displacement) -> Displacement:
    """The sum of several."""
    return lambda y, x: np.sum([part(y, x) for part in parts], axis=0)


def on_pixels(displacement: Displacement, shape: tuple[int, int]) -> FloatArray:
    """A displacement at the pixels' centres."""
    return displacement(*np.indices(shape).astype(float))


def counted(
    displacement: Displacement,
    shape: tuple[int, int],
    *,
    beam: Callable[[FloatArray, FloatArray], FloatArray] | None = None,
    blur: float = 0.0,
    frame: tuple[float, ...] = (0, 1, 0, 0, 0, 1),
    rays: int = 20,
    margin: int = 16,
) -> FloatArray:
    """The flux in each square pixel; `rays`² start in each, and in those of a margin around.

    `blur` is the standard deviation in px of a Gaussian point spread, `frame` where the detector
    sees what lands at (y, x), px from the image's middle.
    """
    rng = np.random.default_rng(0)
    lines = [np.arange(-margin * rays, (side + margin) * rays) for side in shape]
    offsets = [rng.random((lines[0].size, lines[1].size)) for _ in shape]
    # Parts of pixels, also around the image: from there light is spread into it.
    beyond, parts = (int(5 * blur) + 1, _PARTS) if blur else (0, 1)
    height, width = ((side + 2 * beyond) * parts for side in shape)
    total = np.zeros(height * width)
    for first in range(0, lines[0].size, _STRIP):
        strip = slice(first, first + _STRIP)
        y = (lines[0][strip, None] + offsets[0][strip]) / rays - 0.5
        x = (lines[1] + offsets[1][strip]) / rays - 0.5
        flux = None if beam is None else beam(y, x)
        y, x = np.stack([y, x]) + displacement(y, x)
        y, x = y - (shape[0] - 1) / 2, x - (shape[1] - 1) / 2
        y, x = frame[0] + frame[1] * y + frame[2] * x, frame[3] + frame[4] * y + frame[5] * x
        rows = np.floor(parts * y + height / 2).astype(int)
        columns = np.floor(parts * x + width / 2).astype(int)
        inside = (rows >= 0) & (rows < height) & (columns >= 0) & (columns < width)
        places = rows[inside] * width + columns[inside]
        weights = None if flux is None else flux[inside]
        total += np.bincount(places, weights, minlength=height * width)
    total = total.reshape(height, width)
    spread = gaussian_filter(total / rays**2, parts * blur)
    pixels = spread.reshape(height // parts, parts, width // parts, parts).sum(axis=(1, 3))
    return np.asarray(pixels[beyond : beyond + shape[0], beyond : beyond + shape[1]])


def noisy(images: FloatArray | list[FloatArray], sigma: float, seed: int = 7) -> FloatArray:
    """Images with normal noise."""
    planes = np.stack(images)
    return np.asarray(planes + np.random.default_rng(seed).normal(0, sigma, planes.shape))


def distance(found: FloatArray, truth: FloatArray) -> float:
    """How far one displacement is from another, as a share of that."""
    return float(np.linalg.norm(found - truth) / np.linalg.norm(truth))


def of_each(shots: Sequence[Shot], attribute: str) -> list[Any]:
    """What is known of each image."""
    return [getattr(shot, attribute) for shot in shots]


def hessian_times(linear: Linear, change: Unknowns) -> Unknowns:
    """Return the Gauss-Newton Hessian of a scene times a change of the unknowns."""
    only_free = linear.scene._only_free
    free = only_free(change)
    return only_free(linear.scene.prior.times(free)).plus(linear.normal_times(free))


@contextmanager
def without_causes() -> Iterator[None]:
    """Seek no causes of a misfit in fits: for fixtures that several tests share."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(_fit, "_with_cause", lambda data, minima, pattern, on_step: pattern)
        yield


def fit_images(images: Any, **keywords: Any) -> Fit:
    """Fit images with what is known of each, and with further keywords of a fit."""
    names = {each.name for each in fields(Shot)} & keywords.keys()
    attributes = {name: keywords.pop(name) for name in names}
    return fit(shots_of(images, **attributes), **keywords)
