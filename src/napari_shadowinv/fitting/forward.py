"""Several images of one object, and how well potentials, beam and frames explain them: `Scene`.

The misfit of images f_l to data I_l with noise σ_l, and what is held against rough potentials, an
uneven beam, and displacement beyond the image's edge:

    ½ Σ_l |(f_l - I_l) / σ_l|² + Σ_m ½ λ_m |∇⁴φ_m|² + ½ µ Σ_pad |∇φ|² + ½ Σ (θ_ij / s_ij)²

Unknowns are the B-spline coefficients of the potentials φ_m of the first image's px², the cosine
coefficients θ of the logarithm of the beam, logarithms of the gains, and frames of the detector.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy.fft import dctn, idctn
from scipy.ndimage import gaussian_filter
from scipy.signal import oaconvolve

from napari_shadowinv._typing import BoolArray, FloatArray, IntArray
from napari_shadowinv.fitting.rays import KNOT, Pulls, RayModel, at_rest

__all__ = ["PAD", "Scene", "Unknowns", "blurred"]

PAD = 16  # px around the image, from which rays may enter
_TIE = 30.0  # µ: what is held against displacement in the pad
_BEAM_SPREAD = 0.3  # of the beam's first cosines, in the logarithm
_GAIN_SPREAD = 1.0
_FRAME_SPREAD = np.array([5.0, 0.05, 0.05, 5.0, 0.05, 0.05])  # px, and shares


class Unknowns(NamedTuple):
    """What a fit looks for; also its derivatives and changes.

    `potentials` (m, …) are coefficients, `beam` (n, n) cosine coefficients, `gains` (l,)
    logarithms, `frames` (l, 6) as of a `RayModel`.
    """

    potentials: FloatArray
    beam: FloatArray
    gains: FloatArray
    frames: FloatArray

    def flat(self) -> FloatArray:
        return np.concatenate([part.ravel() for part in self])

    def like(self, flat: FloatArray) -> Unknowns:
        """Return the same unknowns with the values of a flat array."""
        ends = np.cumsum([part.size for part in self])[:-1]
        parts = np.split(flat, ends)
        return Unknowns(*(new.reshape(old.shape) for new, old in zip(parts, self, strict=True)))

    def plus(self, other: Unknowns) -> Unknowns:
        return Unknowns(*(a + b for a, b in zip(self, other, strict=True)))


@dataclass(frozen=True)
class Scene:
    """Images with all that is known about how they were made, in pixels of one size.

    Attributes
    ----------
    images, weights : ndarray, shape (L, H, W)
        Data, and 1 / σ², zero where a pixel is not used.
    strengths : ndarray, shape (L, M)
        Displacement in image l by each field's displacement.
    beams : ndarray, shape (L, …)
        Known flux of the beams, as `RayModel.around` returns it.
    psf : sequence of float or ndarray
        Standard deviation in px of each image's point spread, or its kernel.
    smoothness : ndarray, shape (M,)
        λ of each field, for potentials in these pixels.
    tie : float
        µ.
    blur : float
        Standard deviation in px by which residuals are blurred.
    beam_modes : int
        Cosines of the beam's logarithm along each axis; 0 if it is known.
    free_gains : bool
        Whether the gains are unknown.
    free_frames : ndarray of bool, shape (6,)
        Which numbers of a frame are unknown, but for the first image.
    bin : int
        Side of a pixel in those of the recorded images.
    """

    images: FloatArray
    weights: FloatArray
    strengths: FloatArray
    beams: FloatArray
    psf: Sequence[float | FloatArray]
    smoothness: FloatArray
    tie: float = _TIE
    blur: float = 0.0
    beam_modes: int = 0
    free_gains: bool = False
    free_frames: BoolArray = field(default_factory=lambda: np.zeros(6, bool))
    spacing: float = 0.25
    bin: int = 1
    threads: int | None = None

    @cached_property
    def rays(self) -> RayModel:
        """The rays of all images."""
        beyond = max(_reach(width) for width in self.psf)
        size = self.images.shape[1], self.images.shape[2]
        return RayModel(size, PAD // self.bin, beyond, self.spacing, self.threads)

    def nothing(self) -> Unknowns:
        """Return the unknowns of no object in a beam as known."""
        count, fields = self.strengths.shape
        modes = (self.beam_modes, self.beam_modes)
        frames = np.tile(at_rest(), (count, 1))
        return Unknowns(
            np.zeros((fields, *self.rays.shape)), np.zeros(modes), np.zeros(count), frames
        )

    def potentials(self, unknowns: Unknowns) -> FloatArray:
        """Return the coefficients of each image's own potential."""
        return np.einsum("lm,myx->lyx", self.strengths, unknowns.potentials)

    def ray_counts(self, unknowns: Unknowns) -> list[IntArray]:
        """Return how many rays each cell of each image needs; see `RayModel.ray_counts`."""
        return [self.rays.ray_counts(psi) for psi in self.potentials(unknowns)]

    def model(self, unknowns: Unknowns, counts: list[IntArray]) -> FloatArray:
        """Return the images that the unknowns make, shape (L, H, W)."""
        shape = self._beam_shape(unknowns)
        return np.stack(
            [
                np.exp(gain) * self._spread(k, self.rays.image(psi, n, self.beams[k] * shape, frame))
                for k, (psi, n, gain, frame) in enumerate(
                    zip(
                        self.potentials(unknowns), counts, unknowns.gains, unknowns.frames,
                        strict=True,
                    )
                )
            ]
        )

    def beam(self, unknowns: Unknowns) -> FloatArray:
        """Return the beam of each image within it, without gain, shape (L, H, W)."""
        pad, (height, width) = self.rays.pad, self.rays.size
        whole = self.beams * self._beam_shape(unknowns)
        return np.asarray(whole[:, pad : pad + height, pad : pad + width])

    def value_and_gradient(
        self, unknowns: Unknowns, counts: list[IntArray]
    ) -> tuple[float, Unknowns]:
        """Return the objective at fixed numbers of rays, and its derivatives."""
        value, slope = self._held_against(unknowns)
        shape = self._beam_shape(unknowns)
        of_shape = np.zeros_like(shape)
        for k, psi in enumerate(self.potentials(unknowns)):
            beam, frame = self.beams[k] * shape, unknowns.frames[k]
            bare = self._spread(k, self.rays.image(psi, counts[k], beam, frame))
            made = np.exp(unknowns.gains[k]) * bare
            root = np.sqrt(self.weights[k])
            residual = blurred(root * (made - self.images[k]), self.blur)
            value += 0.5 * float(np.einsum("yx,yx", residual, residual))
            pull = root * blurred(residual, self.blur)
            slope.gains[k] += np.einsum("yx,yx", pull, made)
            back = self._spread_back(k, np.exp(unknowns.gains[k]) * pull)
            self._add(slope, of_shape, k, self.rays.gradient(psi, counts[k], beam, back, frame))
        slope.beam[:] += self._of_modes(of_shape * shape)
        return value, self._only_free(slope)

    def hessian_times(
        self, unknowns: Unknowns, counts: list[IntArray], change: Unknowns
    ) -> Unknowns:
        """Return the Gauss-Newton Hessian times a change of the unknowns."""
        moved = self._only_free(change)
        return self.pulled(unknowns, counts, self.pushed(unknowns, counts, moved), moved)

    def pushed(self, unknowns: Unknowns, counts: list[IntArray], change: Unknowns) -> FloatArray:
        """Return the change of residuals (f - I) / σ, to first order, shape (L, H, W)."""
        shape = self._beam_shape(unknowns)
        of_shape = shape * self._modes(change.beam)
        changes = []
        for k, psi in enumerate(self.potentials(unknowns)):
            beam, frame = self.beams[k] * shape, unknowns.frames[k]
            by = Pulls(
                np.einsum("m,myx->yx", self.strengths[k], change.potentials),
                self.beams[k] * of_shape,
                change.frames[k],
            )
            bare = self.rays.change(psi, counts[k], beam, by, frame)
            if change.gains[k]:
                bare = bare + change.gains[k] * self.rays.image(psi, counts[k], beam, frame)
            seen = np.exp(unknowns.gains[k]) * self._spread(k, bare)
            changes.append(np.sqrt(self.weights[k]) * seen)
        return np.stack(changes)

    def pulled(
        self,
        unknowns: Unknowns,
        counts: list[IntArray],
        residuals: FloatArray,
        held: Unknowns | None = None,
    ) -> Unknowns:
        """Return `pushed` turned, times residuals; with the slope of the priors at `held`."""
        start = self.nothing()
        zero = start.like(np.zeros(start.flat().size))
        slope = zero if held is None else self._held_against(held, about_rest=False)[1]
        shape = self._beam_shape(unknowns)
        of_shape = np.zeros_like(shape)
        for k, psi in enumerate(self.potentials(unknowns)):
            beam, frame = self.beams[k] * shape, unknowns.frames[k]
            pull = np.exp(unknowns.gains[k]) * np.sqrt(self.weights[k]) * residuals[k]
            back = self._spread_back(k, pull)
            if self.free_gains:
                bare = self.rays.image(psi, counts[k], beam, frame)
                slope.gains[k] += np.einsum("yx,yx", back, bare)
            self._add(slope, of_shape, k, self.rays.gradient(psi, counts[k], beam, back, frame))
        slope.beam[:] += self._of_modes(of_shape * shape)
        return self._only_free(slope)

    def _add(self, slope: Unknowns, of_shape: FloatArray, k: int, pulls: Pulls) -> None:
        slope.potentials[:] += self.strengths[k][:, None, None] * pulls.potential
        of_shape += pulls.beam * self.beams[k]
        slope.frames[k] += pulls.frame

    def _only_free(self, slope: Unknowns) -> Unknowns:
        frames = np.where(self.free_frames, slope.frames, 0.0)
        frames[0] = 0
        return slope._replace(
            gains=slope.gains if self.free_gains else np.zeros_like(slope.gains), frames=frames
        )

    # what is held against unknowns

    def _held_against(
        self, unknowns: Unknowns, *, about_rest: bool = True
    ) -> tuple[float, Unknowns]:
        """Value and slope of all terms but the data's."""
        frames = unknowns.frames - at_rest() if about_rest else unknowns.frames
        waves = dctn(unknowns.potentials, axes=(1, 2), norm="ortho")
        rough = (KNOT * self.smoothness)[:, None, None] * KNOT * self._wave_numbers**4 * waves
        steps_y, steps_x = self._steps(unknowns.potentials)
        of_beam = unknowns.beam * self._beam_weights
        of_gains = unknowns.gains / _GAIN_SPREAD**2
        of_frames = frames / _FRAME_SPREAD**2
        tied = -np.diff(steps_y, axis=1, prepend=0, append=0)
        tied -= np.diff(steps_x, axis=2, prepend=0, append=0)
        slope = Unknowns(
            idctn(rough, axes=(1, 2), norm="ortho") + self.tie * tied,
            of_beam,
            of_gains,
            of_frames,
        )
        value = 0.5 * (
            np.sum(rough * waves)
            + self.tie * (np.sum(steps_y**2) + np.sum(steps_x**2))
            + np.sum(of_beam * unknowns.beam)
            + np.sum(of_gains * unknowns.gains)
            + np.sum(of_frames * frames)
        )
        return float(value), slope

    def roughness(self, unknowns: Unknowns) -> FloatArray:
        """Return |∇⁴φ|² of each field, in these pixels."""
        waves = dctn(unknowns.potentials, axes=(1, 2), norm="ortho")
        return np.asarray(KNOT**2 * (self._wave_numbers**4 * waves**2).sum(axis=(1, 2)))

    @cached_property
    def _wave_numbers(self) -> FloatArray:
        """k² of each cosine of the coefficients, px⁻²."""
        waves = [np.pi * np.arange(n) / (n * KNOT) for n in self.rays.shape]
        return np.asarray(waves[0][:, None] ** 2 + waves[1] ** 2) 

    @cached_property
    def _in_pad(self) -> tuple[BoolArray, BoolArray]:
        """Which steps between coefficients along y and x lie in the pad."""
        inside = [
            (place >= 0) & (place <= side)
            for place, side in (
                (KNOT * (np.arange(n) - 1.0) - self.rays.pad, side)
                for n, side in zip(self.rays.shape, self.rays.size, strict=True)
            )
        ]
        within = inside[0][:, None] & inside[1]
        return ~(within[1:] & within[:-1]), ~(within[:, 1:] & within[:, :-1])

    def _steps(self, potentials: FloatArray) -> tuple[FloatArray, FloatArray]:
        along_y, along_x = self._in_pad
        return np.diff(potentials, axis=1) * along_y, np.diff(potentials, axis=2) * along_x

    # the beam

    @cached_property
    def _cosines(self) -> tuple[FloatArray, FloatArray]:
        lines = []
        for n in self.beams.shape[1:]:
            place = (np.arange(n) + 0.5) / n
            lines.append(np.cos(np.pi * np.arange(self.beam_modes)[:, None] * place))
        return lines[0], lines[1]

    @cached_property
    def _beam_weights(self) -> FloatArray:
        """1 / s_ij², zero for what is no mode."""
        order = np.arange(self.beam_modes)
        square = order[:, None] ** 2 + order**2
        used = (square > 0) & (square < self.beam_modes**2)
        return np.where(used, square / _BEAM_SPREAD**2, 0.0)

    def _modes(self, beam: FloatArray) -> FloatArray:
        if not self.beam_modes:
            return np.zeros(self.beams.shape[1:])
        along_y, along_x = self._cosines
        return np.einsum("iy,ix->yx", along_y, np.einsum("ij,jx->ix", beam, along_x))

    def _beam_shape(self, unknowns: Unknowns) -> FloatArray:
        return np.exp(self._modes(unknowns.beam))

    def _of_modes(self, shape: FloatArray) -> FloatArray:
        if not self.beam_modes:
            return np.zeros((0, 0))
        along_y, along_x = self._cosines
        found = np.einsum("iy,yj->ij", along_y, np.einsum("yx,jx->yj", shape, along_x))
        return np.where(self._beam_weights > 0, found, 0.0)

    # the point spread

    def _spread(self, k: int, image: FloatArray) -> FloatArray:
        return _inner(_spread(image, self.psf[k]), self.rays.beyond)

    def _spread_back(self, k: int, pull: FloatArray) -> FloatArray:
        width = self.psf[k]
        turned = width if isinstance(width, float) else width[::-1, ::-1]
        return _spread(np.pad(pull, self.rays.beyond), turned)


def blurred(image: FloatArray, width: float) -> FloatArray:
    """Return an image blurred by a Gaussian; beyond its edge it is zero."""
    if width <= 0:
        return image
    return np.asarray(gaussian_filter(image, width, mode="constant", truncate=_SIGMAS))


_SIGMAS = 4.0


def _reach(width: float | FloatArray) -> int:
    """How far a point is spread, px."""
    if isinstance(width, float):
        return int(_SIGMAS * width + 0.5)
    return max(width.shape) // 2


def _spread(image: FloatArray, width: float | FloatArray) -> FloatArray:
    if isinstance(width, float):
        return blurred(image, width)
    return np.asarray(oaconvolve(image, width, mode="same"))


def _inner(image: FloatArray, width: int) -> FloatArray:
    return image[width:-width, width:-width] if width else image
