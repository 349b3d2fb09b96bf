"""Several images of one object, and how well unknowns explain them: `Scene`.

The misfit of images f_l to data I_l with noise σ_l, ½ Σ_l |(f_l - I_l) / σ_l|², and the prior. With
strengths A the potential of image l is ψ_l = Σ_m A_lm φ_m; its rays are traced (`RayModel`), spread
by the instrument and multiplied by its brightness.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from scipy.ndimage import gaussian_filter
from scipy.signal import oaconvolve
from scipy.sparse import csc_array, csr_array

from napari_shadowinv._typing import BoolArray, FloatArray, IntArray
from napari_shadowinv.fitting.rays import RayModel, at_rest
from napari_shadowinv.fitting.unknowns import AdditiveBlock, Fiducials, Prior, Unknowns

__all__ = ["Linear", "Scene", "blurred"]

_SIGMAS = 4.0  # how far Gaussians reach


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
    smoothness, tie, decay, beam_modes, beam_spread, fiducials
        See `Prior`; smoothness has the shape (M, 2).
    pad : int
        Width in px of the strip around the image from which rays may enter.
    free_brightness : bool
        Whether the brightness of each image is unknown.
    free_frames : ndarray of bool, shape (6,)
        Which numbers of a frame are unknown, but for the first image.
    shift_spread : float
        See `Prior`.
    blur : float
        Standard deviation in px by which residuals are blurred.
    spacing : float
        See `RayModel`.
    bin : int
        Side of a pixel in recorded pixels.
    threads : int or None
        Number of threads. Default: all cores. It does not affect the result.
    added : tuple of AdditiveBlock
        Unknown light that adds to each image.
    """

    images: FloatArray
    weights: FloatArray
    strengths: FloatArray
    beams: FloatArray
    psf: Sequence[float | FloatArray]
    smoothness: FloatArray
    tie: float = 30.0
    decay: float = np.inf
    pad: int = 16
    beam_modes: int = 0
    beam_spread: float = 0.3
    free_brightness: bool = False
    free_frames: BoolArray = field(default_factory=lambda: np.zeros(6, bool))
    shift_spread: float = 5.0
    fiducials: Fiducials | None = None
    blur: float = 0.0
    spacing: float = 0.25
    bin: int = 1
    threads: int | None = None
    added: tuple[AdditiveBlock, ...] = ()

    def only(self, numbers: Sequence[int]) -> Scene:
        """Return some of the images, in this order; fields stay in the same unit."""
        chosen = list(numbers)
        return replace(
            self,
            images=self.images[chosen],
            weights=self.weights[chosen],
            strengths=self.strengths[chosen],
            beams=self.beams[chosen],
            psf=[self.psf[k] for k in chosen],
        )

    @cached_property
    def rays(self) -> RayModel:
        """The rays of all images."""
        beyond = max(_reach(width) for width in self.psf)
        size = self.images.shape[1], self.images.shape[2]
        return RayModel(size, self.pad, beyond, self.spacing, self.threads)

    @cached_property
    def prior(self) -> Prior:
        """The prior of the unknowns."""
        return Prior(
            rays=self.rays,
            strengths=self.strengths[0],
            smoothness=self.smoothness,
            tie=self.tie,
            decay=self.decay,
            beam_modes=self.beam_modes,
            beam_spread=self.beam_spread,
            fiducials=self.fiducials,
            bin=self.bin,
            shift_spread=self.shift_spread,
            added=self.added,
        )

    def nothing(self) -> Unknowns:
        """Return the unknowns of no object in a beam as known."""
        count, fields = self.strengths.shape
        return Unknowns(
            np.zeros((fields, *self.rays.shape)),
            np.zeros((self.beam_modes, self.beam_modes)),
            np.zeros(count),
            np.tile(at_rest(), (count, 1)),
            tuple(np.zeros((count, len(block.spreads()))) for block in self.added),
        )

    def potentials(self, unknowns: Unknowns) -> FloatArray:
        """Return the coefficients of each image's own potential, shape (L, …)."""
        return np.asarray(np.einsum("lm,myx->lyx", self.strengths, unknowns.potentials))

    def ray_counts(self, unknowns: Unknowns) -> list[IntArray]:
        """Return how many rays each cell of each image needs; see `RayModel.ray_counts`."""
        return [self.rays.ray_counts(psi) for psi in self.potentials(unknowns)]

    def model(self, unknowns: Unknowns, counts: list[IntArray]) -> FloatArray:
        """Return the images that the unknowns make, shape (L, H, W)."""
        lit = (self._lit(unknowns, shot) for shot in self._shots(unknowns, counts))
        return np.stack([np.exp(log) * f for log, f in zip(unknowns.brightness, lit, strict=True)])

    def beam(self, unknowns: Unknowns) -> FloatArray:
        """Return the beam of each image within it, without brightness, shape (L, H, W)."""
        height, width = self.rays.size
        beams = self.beams * self._beam_shape(unknowns)
        return np.asarray(beams[:, self.pad : self.pad + height, self.pad : self.pad + width])

    def chi2(self, unknowns: Unknowns, counts: list[IntArray]) -> FloatArray:
        """Return the mean of ((f - I) / σ)² over each image's used pixels, shape (L,)."""
        misfit = (self.model(unknowns, counts) - self.images) ** 2 * self.weights
        return np.asarray(misfit.sum(axis=(1, 2)) / (self.weights > 0).sum(axis=(1, 2)))

    def value_and_gradient(
        self, unknowns: Unknowns, counts: list[IntArray]
    ) -> tuple[float, Unknowns]:
        """Return the objective at fixed numbers of rays, and its derivatives."""
        value, slope = self.prior.value_and_slope(unknowns)
        of_shape = np.zeros(self.beams.shape[1:])
        for shot in self._shots(unknowns, counts):
            k, root = shot[0], np.sqrt(self.weights[shot[0]])
            model = np.exp(unknowns.brightness[k]) * self._lit(unknowns, shot)
            residual = blurred(root * (model - self.images[k]), self.blur)
            value += float(np.einsum("yx,yx", residual, residual)) / 2
            pull = root * blurred(residual, self.blur)
            slope.brightness[k] += np.einsum("yx,yx", pull, model)
            self._add_pulls(slope, of_shape, unknowns, shot, pull)
        slope.beam[:] += self._of_modes(of_shape * self._beam_shape(unknowns))
        return value, self._only_free(slope)

    def with_free_beam(self, modes: int, variation: float) -> Scene:
        """Return the scene with an unknown beam that differs from the known one by an r.m.s."""
        order = np.arange(modes)
        square = order[:, None] ** 2 + order**2
        used = (square > 0) & (square < modes**2)
        # Mean square of cos cos, and of cos alone.
        means = np.where((order[:, None] > 0) & (order > 0), 0.25, 0.5)
        total = np.sqrt((means / np.maximum(square, 1))[used].sum())
        return replace(self, beam_modes=modes, beam_spread=float(variation / total))

    def beam_changes(self, change: Unknowns) -> FloatArray:
        """Return the change of each image's beam as a share of it, for beams at their sources."""
        return np.broadcast_to(self._modes(change.beam), self.beams.shape)

    def changed_by_beams(
        self, unknowns: Unknowns, counts: list[IntArray], variations: FloatArray
    ) -> FloatArray:
        """Return the change of all residuals by changes of the beams, shape (L, H, W).

        `variations` are shares of the beams; an image is linear in its beam.
        """
        changes = np.empty_like(self.images)
        for k, psi, count, beam, frame in self._shots(unknowns, counts):
            bare = self._bare(k, psi, count, variations[k] * beam, frame)
            changes[k] = np.sqrt(self.weights[k]) * np.exp(unknowns.brightness[k]) * bare
        return changes

    def linear(self, unknowns: Unknowns, counts: list[IntArray]) -> Linear:
        """Return the scene to first order around unknowns."""
        shots = list(self._shots(unknowns, counts))
        of_beam, of_frame = bool(self.beam_modes), bool(self.free_frames.any())
        jacobians = [
            self.rays.jacobian(*shot[1:], of_beam=of_beam, of_frame=shot[0] > 0 and of_frame)
            for shot in shots
        ]
        if not of_beam and not of_frame:
            columns = math.prod(self.rays.shape)
            for jacobian in jacobians:
                jacobian.resize(jacobian.shape[0], columns)
        return Linear(self, unknowns, jacobians, [self._lit(unknowns, shot) for shot in shots])

    def _shots(self, unknowns: Unknowns, counts: list[IntArray]) -> Iterator[_Shot]:
        shape = self._beam_shape(unknowns)
        for k, psi in enumerate(self.potentials(unknowns)):
            yield k, psi, counts[k], self.beams[k] * shape, unknowns.frames[k]

    def _bare(
        self, k: int, psi: FloatArray, counts: IntArray, beam: FloatArray, frame: FloatArray
    ) -> FloatArray:
        """The light of an image's rays, without its brightness."""
        return self._spread(k, self.rays.image(psi, counts, beam, frame))

    def _lit(self, unknowns: Unknowns, shot: _Shot) -> FloatArray:
        """An image without its brightness: the light of its rays, and what adds to it."""
        return self._with_added(unknowns, shot[0], self._bare(*shot))

    def _with_added(self, unknowns: Unknowns, k: int, image: FloatArray) -> FloatArray:
        for block, coefficients in zip(self.added, unknowns.added, strict=True):
            image = image + block.image(coefficients[k], self.rays.size)
        return image

    def _add_light_pulls(self, slope: Unknowns, k: int, pull: FloatArray) -> None:
        for block, derivatives in zip(self.added, slope.added, strict=True):
            derivatives[k] += block.pull(pull)

    def _add_pulls(
        self,
        slope: Unknowns,
        of_shape: FloatArray,
        unknowns: Unknowns,
        shot: _Shot,
        pull: FloatArray,
    ) -> None:
        k, psi, counts, beam, frame = shot
        scaled = np.exp(unknowns.brightness[k]) * pull
        self._add_light_pulls(slope, k, scaled)
        back = self._spread_back(k, scaled)
        pulls = self.rays.gradient(
            psi,
            counts,
            beam,
            back,
            frame,
            of_beam=bool(self.beam_modes),
            of_frame=k > 0 and bool(self.free_frames.any()),
        )
        slope.potentials[:] += self.strengths[k][:, None, None] * pulls.potential
        of_shape += pulls.beam * self.beams[k]
        slope.frames[k] += pulls.frame

    def _only_free(self, slope: Unknowns) -> Unknowns:
        frames = np.where(self.free_frames, slope.frames, 0.0)
        frames[0] = 0
        return slope._replace(
            beam=np.where(self._free_modes, slope.beam, 0.0),
            brightness=slope.brightness
            if self.free_brightness
            else np.zeros_like(slope.brightness),
            frames=frames,
        )

    @cached_property
    def _free_modes(self) -> BoolArray:
        return np.asarray(self.prior.beam_weights > 0)

    @cached_property
    def _cosines(self) -> tuple[FloatArray, FloatArray]:
        orders = np.arange(self.beam_modes)[:, None]
        along_y, along_x = (
            np.cos(np.pi * orders * (np.arange(n) + 0.5) / n) for n in self.beams.shape[1:]
        )
        return along_y, along_x

    def _modes(self, beam: FloatArray) -> FloatArray:
        along_y, along_x = self._cosines
        return np.asarray(np.einsum("iy,ix->yx", along_y, np.einsum("ij,jx->ix", beam, along_x)))

    def _of_modes(self, shape: FloatArray) -> FloatArray:
        along_y, along_x = self._cosines
        return np.asarray(np.einsum("iy,yj->ij", along_y, np.einsum("yx,jx->yj", shape, along_x)))

    def _beam_shape(self, unknowns: Unknowns) -> FloatArray:
        return np.exp(self._modes(unknowns.beam))

    def _spread(self, k: int, image: FloatArray) -> FloatArray:
        inner = self.rays.beyond
        spread = _spread(image, self.psf[k])
        return spread[inner:-inner, inner:-inner] if inner else spread

    def _spread_back(self, k: int, pull: FloatArray) -> FloatArray:
        width = self.psf[k]
        turned = width if isinstance(width, float) else width[::-1, ::-1]
        padded = np.pad(pull, self.rays.beyond) if self.rays.beyond else pull
        return _spread(padded, turned)


@dataclass(frozen=True)
class Linear:
    """A scene to first order in changes of unknowns.

    Attributes
    ----------
    scene, unknowns
        The scene and the unknowns around which it is linear.
    jacobians : list of csr_array
        As `RayModel.jacobian` returns them, for each image; without the beam's and the frame's
        columns if neither is unknown.
    bare : list of ndarray
        The images without their brightness.
    """

    scene: Scene
    unknowns: Unknowns
    jacobians: list[csr_array]
    bare: list[FloatArray]

    def hessian_times(self, change: Unknowns) -> Unknowns:
        """Return the Gauss-Newton Hessian times a change of the unknowns."""
        free = self.scene._only_free(change)
        pulled = self.pull(self.push(free))
        return self.scene._only_free(self.scene.prior.times(free)).plus(pulled)

    def push(self, change: Unknowns) -> FloatArray:
        """Return the change of all residuals (f - I) / σ, to first order, shape (L, H, W)."""
        scene = self.scene
        potentials = scene.potentials(change)
        if self._has_others:
            of_shape = self._beam_shape * scene._modes(change.beam)
        changes = np.empty_like(scene.images)
        for k, jacobian in enumerate(self.jacobians):
            columns = potentials[k].ravel()
            if self._has_others:
                of_beam = scene.beams[k] * of_shape
                columns = np.concatenate([columns, of_beam.ravel(), change.frames[k]])
            landed = (jacobian @ columns).reshape(scene.rays.seen)
            bare = scene._spread(k, landed) + change.brightness[k] * self.bare[k]
            bare = scene._with_added(change, k, bare)
            np.multiply(self._roots[k], bare, out=changes[k])
        return changes

    def pull(self, residuals: FloatArray) -> Unknowns:
        """Return the transpose of `push` times residuals."""
        scene = self.scene
        slope = self.unknowns.zeros()
        of_shape = np.zeros(scene.beams.shape[1:])
        for k, transposed in enumerate(self._transposed):
            pull = self._roots[k] * residuals[k]
            slope.brightness[k] = np.einsum("yx,yx", pull, self.bare[k])
            scene._add_light_pulls(slope, k, pull)
            columns = transposed @ scene._spread_back(k, pull).ravel()
            of_potential, of_instrument = np.split(columns, [math.prod(scene.rays.shape)])
            psi = of_potential.reshape(scene.rays.shape)
            slope.potentials[:] += scene.strengths[k][:, None, None] * psi
            if self._has_others:
                of_shape += of_instrument[:-6].reshape(of_shape.shape) * scene.beams[k]
                slope.frames[k] = of_instrument[-6:]
        if self._has_others:
            slope.beam[:] = scene._of_modes(of_shape * self._beam_shape)
        return scene._only_free(slope)

    @property
    def _has_others(self) -> bool:
        """Whether the Jacobians have columns for the beam and the frame."""
        return bool(self.jacobians[0].shape[1] > math.prod(self.scene.rays.shape))

    @cached_property
    def _transposed(self) -> list[csc_array]:
        return [jacobian.T for jacobian in self.jacobians]

    @cached_property
    def _beam_shape(self) -> FloatArray:
        return self.scene._beam_shape(self.unknowns)

    @cached_property
    def _roots(self) -> FloatArray:
        """The brightness over the standard deviation of the noise, shape (L, H, W)."""
        return np.sqrt(self.scene.weights) * np.exp(self.unknowns.brightness)[:, None, None]


_Shot = tuple[int, FloatArray, IntArray, FloatArray, FloatArray]  # number, ψ, rays, beam, frame


def blurred(image: FloatArray, width: float) -> FloatArray:
    """Return an image blurred by a Gaussian; beyond its edge it is zero."""
    if width <= 0:
        return image
    return np.asarray(gaussian_filter(image, width, mode="constant", truncate=_SIGMAS))


def _spread(image: FloatArray, width: float | FloatArray) -> FloatArray:
    if isinstance(width, float):
        return blurred(image, width)
    return np.asarray(oaconvolve(image, width, mode="same"))


def _reach(width: float | FloatArray) -> int:
    """How far a point is spread, px."""
    if isinstance(width, float):
        return int(_SIGMAS * width + 0.5)
    return int(max(width.shape)) // 2
