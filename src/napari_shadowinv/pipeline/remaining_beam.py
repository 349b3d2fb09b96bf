"""Remains of an uneven beam after steps and source estimate, and their loss of the object.

- an instrument that knows it: `after_steps`

A high-pass filter, a divided background or a polynomial source removes a part of an uneven beam.
What is left, as random beams show that go through the same steps, is the beam's error. The object
has structure of the same scales, which is lost with it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Literal

import numpy as np

from napari_shadowinv._typing import FloatArray
from napari_shadowinv.instrument.shapes import Shapes
from napari_shadowinv.options import BeamComponents, BeamPrior, Instrument
from napari_shadowinv.physics.arrays import block_means
from napari_shadowinv.preprocessing import Recipe
from napari_shadowinv.shot import Shot

_BEAMS = 4
_BLOCKS = 64  # along the longer side
_DIMMEST = 0.05  # of the mean, for a ratio


def after_steps(
    instrument: Instrument,
    recipe: Recipe,
    recorded: Shot,
    source_of: Callable[[Shot], FloatArray],
    *,
    measured: bool = False,
) -> Instrument:
    """Return an instrument with the beam's error after a recipe's steps and source estimate.

    The beam before them is the instrument's, stated or assumed. The steps are applied to the
    recorded shot with other beams, whose sources, (H, W), `source_of` estimates.

    Notes
    -----
    Structure r that they remove is the beam's or the object's. How much an object like this one
    loses, L (r.m.s.), is seen where it is shifted; b is their loss of the beam, by the prior, or by
    r if that is more. Then the object has lost r L² / (L² + b²), with a variance of
    L² b² / (L² + b²). An exact beam has b = 0, so that r is the loss.
    """
    beam = instrument.beam_of(measured=measured, source=recorded.source)
    flattening, moving = (
        recipe.model_copy(
            update={"steps": tuple(step for step in recipe.steps if step.flattens is flattens)}
        )
        for flattens in (True, False)
    )

    def flatten(shot: Shot, by: Recipe = recipe) -> FloatArray:
        """Return the image after all steps over its source, with a mean of 1; 0 where masked."""
        ready = by.prepare(shot)
        ratio = ready.image / np.maximum(source_of(ready), 1e-300)
        return _normalise(ratio, ready)

    def move(shot: Shot) -> FloatArray:
        ready = moving.prepare(shot)
        return _normalise(ready.image, ready)

    usual, raw = flatten(recorded), move(recorded)
    left, removed = [], []
    for unevenness in _random_beams(recorded.shape, beam) if beam.rms else ():
        uneven = replace(recorded, image=recorded.image * (1 + unevenness))
        left.append(_change(usual, flatten(uneven)))
        removed.append(_change(raw, move(uneven)) - left[-1])
    patterns = [pattern / np.sqrt(_BEAMS) for pattern in left]
    if recorded.source_mask is None:  # else the estimate has not seen the object
        taken = _change(raw, usual)
        lost = []
        for shift in ((1, 1), (1, -1)):
            steps = [sign * side // 4 for sign, side in zip(shift, usual.shape, strict=True)]
            shifted = np.roll(usual, steps, (0, 1))
            lost.append(_change(shifted, flatten(Shot(shifted, setup=recorded.setup), flattening)))
        of_object, of_beam = (
            float(np.mean(np.square(each))) if each else 0.0 for each in (lost, removed)
        )
        if beam.rms:
            of_beam = max(of_beam, float((taken**2).mean()) - of_object)
        share = of_object / max(of_object + of_beam, 1e-300) if of_beam else 1.0
        patterns.append(share * taken)
        patterns += [np.sqrt((1 - share) / len(lost)) * pattern for pattern in lost]
    rms = float(np.sqrt(np.square(patterns).sum(axis=0).mean()))
    height, width = usual.shape
    basis: Literal["assumed", "stated", "filtered"] = "filtered"
    if beam.rms:
        basis = "assumed" if instrument.beam_rms is None else "stated"
    components = BeamComponents(
        np.array(patterns),
        -(-max(height, width) // _BLOCKS),
        (height, width),
        rest=0.0,
        basis=basis,
    )
    prior = BeamPrior(rms=min(rms, 0.99), length=beam.length).with_components(components)
    return instrument.with_beam(prior)


def _normalise(image: FloatArray, shot: Shot) -> FloatArray:
    values = image if shot.mask is None else np.where(shot.mask, image, 0.0)
    return np.asarray(values / values.mean())


def _change(first: FloatArray, second: FloatArray) -> FloatArray:
    """Return the relative change from one image to another in blocks; its mean is 0."""
    block = -(-max(first.shape) // _BLOCKS)
    before, after = block_means(first, block), block_means(second, block)
    is_lit = np.minimum(before, after) > _DIMMEST
    ratio = np.where(is_lit, after, 1.0) / np.where(is_lit, before, 1.0)
    return np.asarray(ratio / ratio.mean() - 1)


def _random_beams(shape: tuple[int, int], beam: BeamPrior) -> list[FloatArray]:
    rng = np.random.default_rng(0)
    shapes = Shapes.of_length("beam", beam.length * min(shape), np.ones(shape))
    fields = [shapes.sum(rng.normal(size=len(shapes))) for _ in range(_BEAMS)]
    return [beam.rms * field / field.std() for field in fields]
