"""From coarse pixels to fine ones: `coarser`, `finer`, `descend`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from scipy.fft import dctn, idctn

from napari_shadowinv._typing import FloatArray
from napari_shadowinv.fitting.forward import (
    _BEAM_SPREAD,
    _FRAME_SPREAD,
    _GAIN_SPREAD,
    Scene,
    Unknowns,
)
from napari_shadowinv.fitting.minimise import minimise
from napari_shadowinv.fitting.rays import KNOT, at_rest


class Preconditioner:
    """Changes of the unknowns for which the Hessian is about the identity."""

    def __init__(self, scene: Scene) -> None:
        squares = scene._wave_numbers
        fields = scene.strengths.shape[1]
        matrix = np.zeros((*squares.shape, fields, fields))
        for strengths, weights, psf in zip(scene.strengths, scene.weights, scene.psf, strict=True):
            width = psf if isinstance(psf, float) else 0.0
            seen = np.exp(-squares * (scene.blur**2 + width**2))
            # An unsmoothed square: the source is about 1.
            of_data = weights.mean() * squares**2 * seen
            matrix += of_data[..., None, None] * np.outer(strengths, strengths)
        lowest = (np.pi / (max(scene.rays.shape) * KNOT)) ** 2
        held = scene.smoothness * (squares**4)[..., None]
        held = held + (scene.tie * (0.2 * squares + lowest))[..., None]
        matrix += held[..., None] * np.eye(fields)
        self._inverse = np.linalg.inv(np.linalg.cholesky(KNOT**2 * matrix))
        data = sum(float(weights.sum()) for weights in scene.weights)
        self._beam = 1 / np.sqrt(np.where(scene._beam_weights > 0, scene._beam_weights + data / 4, np.inf)) if scene.beam_modes else np.zeros((0, 0))
        each = scene.weights.sum(axis=(1, 2))
        self._gains = np.where(scene.free_gains, 1 / np.sqrt(each + 1 / _GAIN_SPREAD**2), 0.0)
        side = max(scene.rays.size) / 4
        scale = np.array([1, side, side, 1, side, side]) ** 2
        roots = np.sqrt(0.02 * each[:, None] * scale + 1 / _FRAME_SPREAD**2)
        self._frames = np.where(scene.free_frames, 1 / roots, 0.0)
        self._frames[0] = 0

    def times(self, scaled: Unknowns) -> Unknowns:
        waves = np.einsum("yxnm,nyx->myx", self._inverse, scaled.potentials)
        return Unknowns(
            idctn(waves, axes=(1, 2), norm="ortho"),
            self._beam * scaled.beam,
            self._gains * scaled.gains,
            self._frames * scaled.frames,
        )

    def turned(self, slope: Unknowns) -> Unknowns:
        waves = dctn(slope.potentials, axes=(1, 2), norm="ortho")
        return Unknowns(
            np.einsum("yxnm,myx->nyx", self._inverse, waves),
            self._beam * slope.beam,
            self._gains * slope.gains,
            self._frames * slope.frames,
        )


def descend(scene, start, *, iterations=100, tolerance=1e-7, renewals=2, after_step=None):
    pre = Preconditioner(scene)
    unknowns, steps, value = start, 0, np.inf
    for k in range(renewals):
        counts = scene.ray_counts(unknowns)
        base = unknowns

        def objective(flat):
            value, slope = scene.value_and_gradient(base.plus(pre.times(base.like(flat))), counts)
            return value, pre.turned(slope).flat()

        flat, value, taken = minimise(
            objective, np.zeros(base.flat().size), iterations=iterations - steps,
            tolerance=tolerance, after_step=after_step)
        unknowns = base.plus(pre.times(base.like(flat)))
        steps += taken
        if steps >= iterations: break
    return unknowns, value, steps


def binned(values, factor):
    l, h, w = values.shape
    return values.reshape(l, h // factor, factor, w // factor, factor).sum(axis=(2, 4))


def coarser(scene, factor):
    used = scene.weights > 0
    count = binned(used.astype(float), factor)
    seen = np.maximum(count, 1)
    images = binned(np.where(used, scene.images, 0), factor) / seen
    variance = binned(np.where(used, 1 / np.where(used, scene.weights, 1), 0), factor) / seen**2
    weights = np.where(count >= factor**2 / 2, 1 / np.where(variance > 0, variance, 1), 0)
    return replace(
        scene, images=images, weights=weights, beams=binned(scene.beams, factor) / factor**2,
        psf=[p / factor for p in scene.psf], smoothness=scene.smoothness / factor**2,
        tie=scene.tie * factor**4, bin=scene.bin * factor)


def finer(unknowns):
    """The same potentials on knots twice as dense, in pixels half as wide."""
    c = unknowns.potentials
    for axis in (1, 2):
        c = np.moveaxis(c, axis, 0)
        n = 2 * (len(c) - 3) + 3
        out = np.empty((n, *c.shape[1:]))
        # knot i of the coarse at fine 2(i-1)+1
        out[1::2] = (c[:-2] + 6 * c[1:-1] + c[2:]) / 8
        out[0::2] = (c[:-1] + c[1:]) / 2
        c = np.moveaxis(out, 0, axis)
    frames = unknowns.frames.copy()
    frames[:, [0, 3]] *= 2
    return unknowns._replace(potentials=4 * c, frames=frames)
