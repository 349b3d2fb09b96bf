"""Several images of one object, and how well unknowns explain them: `Scene`.

The misfit of images f_l to data I_l with noise σ_l, ½ Σ_l |(f_l - I_l) / σ_l|², and the prior. With
strengths A the potential of image l is ψ_l = Σ_m A_lm φ_m; its rays are traced (`RayModel`), spread
by the instrument and multiplied by its brightness.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, fields
from functools import cached_property, partial
from typing import NamedTuple, TypeVar

import numpy as np
from scipy.ndimage import gaussian_filter
from scipy.sparse import csr_array

from napari_shadowinv._system.machine import available_threads, results_of
from napari_shadowinv._typing import BoolArray, FloatArray, IntArray
from napari_shadowinv.fitting.instrument import EXACT, Imperfect, Part
from napari_shadowinv.fitting.rays import Pulls, RayModel, TracedBeam, at_rest
from napari_shadowinv.fitting.unknowns import Prior, PriorTerms, Unknowns
from napari_shadowinv.instrument.effects import widen, widening

_T = TypeVar("_T")

_SIGMAS = 4.0  # how far Gaussians reach


@dataclass(frozen=True, kw_only=True)
class Scene(PriorTerms):
    """Images, all that is known about how they were made, and the prior, in pixels of one size.

    Of the six numbers of a frame, except the first image's, `free_frames` are unknown. The
    covariance of the numbers of `response_units` is by default as before the images. A `force` is
    subtracted from the objective's derivatives: a random one makes its least a sample of the prior.
    For `pad`, `spacing`, `knot` and `threads` see `RayModel`.
    """

    images: FloatArray  # (L, H, W)
    weights: FloatArray  # (L, H, W), 1 / σ²; zero where a pixel is not used
    strengths: FloatArray  # (L, M), displacement in image l by each field's displacement
    beams: FloatArray  # (L, …), known flux of the beams, as `RayModel.around` returns it
    psf: Sequence[float | FloatArray]  # of each image, standard deviation in px or kernel
    pad: int = 16
    free_brightness: bool = False  # whether that of each image is unknown
    free_frames: BoolArray = field(default_factory=lambda: np.zeros(6, bool))
    blur: float = 0.0  # of residuals, px
    spacing: float = 0.25
    knot: int = 2
    threads: int | None = None
    imperfect: Imperfect = EXACT
    held: frozenset[str] = frozenset()  # imperfections whose numbers do not change
    spread: FloatArray | None = None  # (n, n), root of that covariance
    force: Unknowns | None = None

    @cached_property
    def rays(self) -> RayModel:
        """The rays of all images."""
        beyond = max(_reach(width, self.imperfect.blur) for width in self.psf)
        size = self.images.shape[1], self.images.shape[2]
        return RayModel(size, self.pad, beyond, self.spacing, self.knot, self.threads)

    @cached_property
    def prior(self) -> Prior:
        """The prior of the unknowns."""
        terms = {each.name: getattr(self, each.name) for each in fields(PriorTerms)}
        return Prior(rays=self.rays, strengths=self.strengths[0], **terms)

    def nothing(self) -> Unknowns:
        """Return the unknowns of no object in a beam as known."""
        count, fields = self.strengths.shape
        common, separate = self.imperfect.counts
        return Unknowns(
            potentials=np.zeros((fields, *self.rays.shape)),
            common=np.zeros(common),
            brightness=np.zeros(count),
            frames=np.tile(at_rest(), (count, 1)),
            separate=np.zeros((count, separate)),
        )

    def strengths_with(self, unknowns: Unknowns) -> FloatArray:
        """Return the displacement in image l by each field's, with that by another field."""
        added = self.imperfect.other_strengths
        if added is None:
            return self.strengths
        place = self.imperfect.parts["other_field"].places
        return self.strengths + unknowns.common[place] * added

    def potentials(self, unknowns: Unknowns) -> FloatArray:
        """Return the coefficients of each image's own potential, shape (L, …)."""
        strengths = self.strengths_with(unknowns)
        return _sums_of_fields(strengths, unknowns.potentials)

    def displacement(self, unknowns: Unknowns) -> FloatArray:
        """Return each field's displacement at the pixels, recorded px, shape (M, 2, H, W)."""
        each = [self.rays.displacement(potential) for potential in unknowns.potentials]
        return self.bin * np.stack(each)

    def ray_counts(self, unknowns: Unknowns) -> list[IntArray]:
        """Return how many rays each cell of each image needs; see `RayModel.ray_counts`."""
        return [self.rays.ray_counts(psi) for psi in self.potentials(unknowns)]

    def model(self, unknowns: Unknowns, counts: list[IntArray] | None = None) -> FloatArray:
        """Return the images that the unknowns make, shape (L, H, W), by `ray_counts` or others."""
        shots = enumerate(self._traced(unknowns, counts))
        lit = (self._seen(unknowns, k, traced).image for k, traced in shots)
        return np.stack([np.exp(log) * f for log, f in zip(unknowns.brightness, lit, strict=True)])

    def beam(self, unknowns: Unknowns) -> FloatArray:
        """Return the beam of each image within it, without brightness, shape (L, H, W)."""
        height, width = self.rays.size
        return np.asarray(
            self._lights(unknowns)[:, self.pad : self.pad + height, self.pad : self.pad + width]
        )

    def chi2(self, model: FloatArray) -> FloatArray:
        """Return the mean of ((f - I) / σ)² over each image's used pixels, shape (L,)."""
        misfit = (model - self.images) ** 2 * self.weights
        return np.asarray(misfit.sum(axis=(1, 2)) / (self.weights > 0).sum(axis=(1, 2)))

    def value(self, unknowns: Unknowns, counts: list[IntArray] | None = None) -> float:
        """Return the objective, at fixed numbers of rays if these are given."""
        value, _ = self._priors(unknowns)
        beams = self._traced(unknowns, counts)
        for _, _, residual in self._of_each(partial(self._misfit, unknowns), beams):
            value += float(np.einsum("yx,yx", residual, residual)) / 2
        return value

    def _priors(self, unknowns: Unknowns) -> tuple[float, Unknowns]:
        """The prior's part of the objective, less the force's, and its derivatives."""
        value, slope = self.prior.value_and_slope(unknowns)
        if self.force is None:
            return value, slope
        value -= sum(float(np.sum(a * b)) for a, b in zip(self.force, unknowns, strict=True))
        return value, slope.plus(self.force, -1)

    def _misfit(
        self, unknowns: Unknowns, k: int, traced: TracedBeam
    ) -> tuple[_Seen, FloatArray, FloatArray]:
        """An image as it is seen, its model, and its residual in units of the noise."""
        view = self._seen(unknowns, k, traced)
        model = np.exp(unknowns.brightness[k]) * view.image
        residual = np.sqrt(self.weights[k]) * (model - self.images[k])
        return view, model, blurred(residual, self.blur)

    def value_and_gradient(
        self, unknowns: Unknowns, counts: list[IntArray]
    ) -> tuple[float, Unknowns]:
        """Return the objective at fixed numbers of rays, and its derivatives."""
        value, slope = self._priors(unknowns)
        beams = self._traced(unknowns, counts)
        differentiated = self._of_each(partial(self._pulls, unknowns), beams)
        for k, (of_image, of_brightness, view, scaled, _) in enumerate(differentiated):
            value += of_image
            slope.brightness[k] += of_brightness
            view.effects.add_pulls(slope, k, scaled)
        entering: list[_Entering] = []
        if self._frees_light:
            entering = self._entering(unknowns, [traced.beam for traced in beams])
        pulls = [of_rays for *_, of_rays in differentiated]
        return value, self._with_pulls(slope, unknowns, pulls, entering)

    def _pulls(
        self, unknowns: Unknowns, k: int, traced: TracedBeam
    ) -> tuple[float, float, _Seen, FloatArray, Pulls]:
        """Differentiate an image's part of the objective: by log brightness, image and rays."""
        view, model, residual = self._misfit(unknowns, k, traced)
        pull = np.sqrt(self.weights[k]) * blurred(residual, self.blur)
        scaled = np.exp(unknowns.brightness[k]) * pull
        of_rays = self.rays.gradient(
            traced,
            self._spread_back(k, view.slope * scaled, unknowns),
            of_beam=self._frees_light,
            of_frame=k > 0 and bool(self.free_frames.any()),
        )
        value = float(np.einsum("yx,yx", residual, residual)) / 2
        return value, np.einsum("yx,yx", pull, model), view, scaled, of_rays

    def _of_each(
        self,
        function: Callable[[int, TracedBeam], _T],
        beams: Sequence[TracedBeam],
        most_pixels: int = 1 << 16,
    ) -> list[_T]:
        """Call a function for each image, side by side if these are small and many.

        More than one larger image at a time takes much memory; of few images, the last one would
        leave threads without work.
        """
        threads = available_threads(self.rays.threads)
        is_small = math.prod(self.rays.seen) <= most_pixels
        if not is_small or len(beams) < 2 * threads:
            threads = 1  # here; the kernels have all of them
        return results_of([partial(function, k, traced) for k, traced in enumerate(beams)], threads)

    def linear(
        self, unknowns: Unknowns, counts: list[IntArray] | None = None, *, of_held: bool = False
    ) -> Linear:
        """Return the scene to first order around unknowns; by light that is held only if asked."""
        beams = self._traced(unknowns, counts)
        of_beam = self._frees_light or (of_held and bool(self.imperfect.shapes))
        of_frame = bool(self.free_frames.any())

        def differentiate(k: int, traced: TracedBeam) -> csr_array:
            return self.rays.jacobian(traced, of_beam=of_beam, of_frame=k > 0 and of_frame)

        jacobians = self._of_each(differentiate, beams)
        if not of_beam and not of_frame:
            columns = math.prod(self.rays.shape)
            for jacobian in jacobians:
                jacobian.resize(jacobian.shape[0], columns)
        seen = [self._seen(unknowns, k, traced) for k, traced in enumerate(beams)]
        return Linear(self, unknowns, jacobians, seen)

    @cached_property
    def _is_sharp(self) -> bool:
        """Whether rays count where they land."""
        widths = [isinstance(width, float) and width <= 0 for width in self.psf]
        return all(widths) and not self.imperfect.blur

    @property
    def has_free_numbers(self) -> bool:
        """Whether numbers of the instrument may change."""
        return bool(self.imperfect.keys - self.held)

    @property
    def _frees_light(self) -> bool:
        """Whether the light that enters may change, or depends on the detector."""
        shapes = any(part.key not in self.held for part, _ in self.imperfect.shape_parts())
        return shapes or bool(self.imperfect.responses)

    def response_units(self) -> list[Unknowns]:
        """Return a change by each number on which the response to fields depends: by 1."""
        units = []
        for part, k in self._response_numbers():
            unit = self.nothing().zeros()
            part.of(unit.common, unit.separate[k])[:] = 1
            units.append(unit)
        return units

    def least_numbers(self) -> FloatArray:
        """Return the least value of each number of `response_units`: no image is sharpened."""
        stated = min(self._variance(k) for k in range(len(self.psf)))
        sharpest = -stated / self.imperfect.blur if self.imperfect.blur else -np.inf
        keys = [part.key for part, _ in self._response_numbers()]
        return np.array([sharpest if key == "blur" else -np.inf for key in keys])

    def _response_numbers(self) -> Iterator[tuple[Part, int]]:
        """The imperfection of each number of `response_units`, and its image."""
        for part in self.imperfect.parts.values():
            if part.key in self.imperfect.of_response:
                for k in range(1 if part.is_common else len(self.images)):
                    yield part, k

    def _traced(self, unknowns: Unknowns, counts: list[IntArray] | None) -> list[TracedBeam]:
        """The beam of each image behind its potential."""
        counts = counts or self.ray_counts(unknowns)
        of_each = self.potentials(unknowns), counts, self._lights(unknowns), unknowns.frames
        return list(map(TracedBeam, *of_each))

    def _lights(self, unknowns: Unknowns) -> FloatArray:
        common, separate = unknowns.common, unknowns.separate
        light = [
            self.imperfect.entering(beam, common, numbers)[0]
            for beam, numbers in zip(self.beams, separate, strict=True)
        ]
        return np.stack(light) * np.exp(self.imperfect.shape_changes(common, separate))

    def _seen(self, unknowns: Unknowns, k: int, traced: TracedBeam) -> _Seen:
        imperfect = self.imperfect
        rays = self.rays.image(traced)
        image, slope = self._spread(k, rays, unknowns), np.ones(())
        derivatives: dict[str, FloatArray] = {}
        for part, each, size, number in imperfect.detector(unknowns.common, unknowns.separate[k]):
            image, of_light, of_number = each.record(image, size, number)
            derivatives = {key: of_light * change for key, change in derivatives.items()}
            derivatives[part.key], slope = of_number, np.asarray(of_light * slope)
        if imperfect.blur:
            variance, extra = self._variance(k), imperfect.variance(unknowns.common)
            spread = rays if isinstance(self.psf[k], float) else _spread(rays, self.psf[k])
            wider = self._inner(widening(spread, variance + extra))
            derivatives["blur"] = imperfect.blur * slope * wider
        parts = imperfect.parts.items()
        effects = _Effects((part, derivatives[key]) for key, part in parts if key in derivatives)
        return _Seen(image, slope, effects)

    def _variance(self, k: int) -> float:
        """Variance of a Gaussian point spread that an error of the blur adds to."""
        width = self.psf[k]
        return width**2 if isinstance(width, float) else 0.0

    def _entering(self, unknowns: Unknowns, lights: Sequence[FloatArray]) -> list[_Entering]:
        """The light of each image's beam, and its relative changes by the instrument's numbers."""
        changes = (
            self.imperfect.entering(beam, unknowns.common, numbers)[1]
            for beam, numbers in zip(self.beams, unknowns.separate, strict=True)
        )
        return [
            _Entering(light, _Effects(each)) for light, each in zip(lights, changes, strict=True)
        ]

    def _with_pulls(
        self,
        slope: Unknowns,
        unknowns: Unknowns,
        pulls: Sequence[Pulls],
        entering: Sequence[_Entering],
    ) -> Unknowns:
        """Add derivatives by the rays of each image, and return those by what is free.

        The light that enters is left out where it is known.
        """
        strengths, other = self.strengths_with(unknowns), self.imperfect.other_strengths
        for k, each in enumerate(pulls):
            slope.potentials[:] += strengths[k][:, None, None] * each.potential
            slope.frames[k] += each.frame
            if other is not None:
                along = np.einsum("m,myx,yx->", other[k], unknowns.potentials, each.potential)
                slope.common[self.imperfect.parts["other_field"].places] += along
        if entering:
            of_logarithm = np.stack([each.beam for each in pulls])
            of_logarithm = of_logarithm * np.stack([each.light for each in entering])
            for k, light in enumerate(entering):
                light.effects.add_pulls(slope, k, of_logarithm[k])
            self.imperfect.pull_shapes(of_logarithm, slope.common, slope.separate)
        return self._only_free(slope)

    def _only_free(self, slope: Unknowns) -> Unknowns:
        frames = np.where(self.free_frames, slope.frames, 0.0)
        frames[0] = 0
        brightness = np.where(self.free_brightness, slope.brightness, 0.0)
        return slope._replace(brightness=brightness, frames=frames)

    def _inner(self, image: FloatArray) -> FloatArray:
        inner = self.rays.beyond
        return image[inner:-inner, inner:-inner] if inner else image

    def _spread(self, k: int, image: FloatArray, unknowns: Unknowns) -> FloatArray:
        """Light spread by the instrument, without the strip around the image."""
        width, imperfect = self.psf[k], self.imperfect
        if not (imperfect.blur and isinstance(width, float)):
            image = _spread(image, width)
        if imperfect.blur:
            image = widen(image, self._variance(k) + imperfect.variance(unknowns.common))
        return self._inner(image)

    def _spread_back(self, k: int, pull: FloatArray, unknowns: Unknowns) -> FloatArray:
        width, imperfect = self.psf[k], self.imperfect
        padded = np.pad(pull, self.rays.beyond) if self.rays.beyond else pull
        if imperfect.blur:
            padded = widen(padded, self._variance(k) + imperfect.variance(unknowns.common))
        if not isinstance(width, float):
            return _spread(padded, width[::-1, ::-1])
        return padded if imperfect.blur else _spread(padded, width)


class _Effects(list[tuple[Part, FloatArray]]):
    """Derivatives of an image, or of a beam's logarithm, by the number of each imperfection."""

    def push(self, change: Unknowns, k: int, total: FloatArray) -> FloatArray:
        """Add the change by changes of the numbers of image `k` to a total, and return it."""
        for part, values in self:
            total = total + part.of(change.common, change.separate[k]) * values
        return total

    def add_pulls(self, slope: Unknowns, k: int, pull: FloatArray) -> None:
        """Add the transpose of `push` times a pull."""
        for part, values in self:
            derivatives = part.of(slope.common, slope.separate[k])
            derivatives += np.einsum("yx,yx", pull, values)


class _Entering(NamedTuple):
    """Light of a beam, and effects of numbers on its logarithm."""

    light: FloatArray
    effects: _Effects


class _Seen(NamedTuple):
    """An image without its brightness, the derivative of the response, and effects of numbers."""

    image: FloatArray
    slope: FloatArray
    effects: _Effects


@dataclass(frozen=True)
class Linear:
    """A scene to first order in changes of the unknowns around which it is linear."""

    scene: Scene
    unknowns: Unknowns
    jacobians: list[csr_array]  # without columns of beam and frame if neither is unknown
    seen: list[_Seen]  # images without their brightness, and how they are seen

    def normal_times(self, change: Unknowns) -> Unknowns:
        """Return `pull` of `push` of a change of what is free."""
        scene = self.scene
        if not scene._is_sharp:
            return self.pull(self.push(change))
        count = len(self.jacobians)
        totals, pulls = scene.rays.normal_times(
            self.jacobians,
            self._columns(change),
            *self._weights_and_slopes,
            [self._light_change(change, k) for k in range(count)]
            if self._has_light
            else self._dark,
        )
        slope = self.unknowns.zeros()
        for k in range(count):
            if self._has_light:
                self._add_light_pulls(slope, k, pulls[k])
        return self._with_columns(slope, totals)

    def push(self, change: Unknowns) -> FloatArray:
        """Return the change of all residuals (f - I) / σ, to first order, shape (L, H, W)."""
        scene = self.scene
        changes, columns = np.empty_like(scene.images), self._columns(change)
        for k, (jacobian, seen) in enumerate(zip(self.jacobians, self.seen, strict=True)):
            landed = scene.rays.push(jacobian, columns[k])
            spread = scene._spread(k, landed, self.unknowns)
            image = seen.slope * spread + self._light_change(change, k)
            np.multiply(self._roots[k], image, out=changes[k])
        return changes

    def pull(self, residuals: FloatArray) -> Unknowns:
        """Return the transpose of `push` times residuals."""
        scene = self.scene
        slope, columns = self.unknowns.zeros(), []
        for k, (jacobian, seen) in enumerate(zip(self.jacobians, self.seen, strict=True)):
            pull = self._roots[k] * residuals[k]
            self._add_light_pulls(slope, k, pull)
            back = scene._spread_back(k, seen.slope * pull, self.unknowns)
            columns.append(scene.rays.pull(jacobian, back))
        return self._with_columns(slope, columns)

    def _columns(self, change: Unknowns) -> list[FloatArray]:
        potentials = list(self._potential_changes(change).reshape(len(self.jacobians), -1))
        if not self._has_others:
            return potentials
        shapes = self.scene.imperfect.shape_changes(change.common, change.separate)
        columns = []
        for k, (own, beam) in enumerate(zip(potentials, self._entering, strict=True)):
            of_beam = beam.light * beam.effects.push(change, k, shapes[k % len(shapes)])
            columns.append(np.concatenate([own, of_beam.ravel(), change.frames[k]]))
        return columns

    def _with_columns(self, slope: Unknowns, columns: Sequence[FloatArray]) -> Unknowns:
        scene, (inner, outer) = self.scene, (self.scene.rays.shape, self.scene.beams.shape[1:])
        if not self._has_others:
            pulls = [Pulls(each.reshape(inner), np.zeros(0), np.zeros(6)) for each in columns]
            return scene._with_pulls(slope, self.unknowns, pulls, [])
        size = math.prod(inner)
        pulls = [
            Pulls(each[:size].reshape(inner), each[size:-6].reshape(outer), each[-6:])
            for each in columns
        ]
        return scene._with_pulls(slope, self.unknowns, pulls, self._entering)

    def _light_change(self, change: Unknowns, k: int) -> FloatArray:
        of_brightness = change.brightness[k] * self.seen[k].image
        return np.asarray(of_brightness + self.seen[k].effects.push(change, k, np.zeros(())))

    def _add_light_pulls(self, slope: Unknowns, k: int, pull: FloatArray) -> None:
        slope.brightness[k] = np.einsum("yx,yx", pull, self.seen[k].image)
        self.seen[k].effects.add_pulls(slope, k, pull)

    def _potential_changes(self, change: Unknowns) -> FloatArray:
        imperfect = self.scene.imperfect
        strengths = self.scene.strengths_with(self.unknowns)
        changes = _sums_of_fields(strengths, change.potentials)
        if imperfect.other_strengths is not None:
            share = change.common[imperfect.parts["other_field"].places]
            added = share * imperfect.other_strengths
            changes += _sums_of_fields(added, self.unknowns.potentials)
        return changes

    @property
    def _has_others(self) -> bool:
        """Whether the Jacobians have columns for the beam and the frame."""
        return bool(self.jacobians[0].shape[1] > math.prod(self.scene.rays.shape))

    @cached_property
    def weights_of_others(self) -> FloatArray:
        """1 / s² by the prior of all values but the potentials."""
        return self.scene.prior.flat_weights(self.unknowns)

    @cached_property
    def _entering(self) -> list[_Entering]:
        return self.scene._entering(self.unknowns, list(self.scene._lights(self.unknowns)))

    @cached_property
    def _has_light(self) -> bool:
        """Whether numbers may change that act where an image is seen."""
        has_effects = any(seen.effects for seen in self.seen)
        return self.scene.free_brightness or has_effects

    @cached_property
    def _dark(self) -> list[FloatArray]:
        return [np.zeros(self.scene.rays.seen)] * len(self.jacobians)

    @cached_property
    def _weights_and_slopes(self) -> tuple[list[FloatArray], list[FloatArray]]:
        slopes = [np.full(self.scene.rays.seen, seen.slope) for seen in self.seen]
        return list(self._roots**2), slopes

    @cached_property
    def _roots(self) -> FloatArray:
        """The brightness over the standard deviation of the noise, shape (L, H, W)."""
        return np.sqrt(self.scene.weights) * np.exp(self.unknowns.brightness)[:, None, None]


def _sums_of_fields(strengths: FloatArray, fields: FloatArray) -> FloatArray:
    """Σ_m A_lm φ_m, (L, …); of one field in a fifth of the time of `einsum`."""
    sums = np.multiply.outer(strengths[:, 0], fields[0])
    for m in range(1, len(fields)):
        sums += np.multiply.outer(strengths[:, m], fields[m])
    return np.asarray(sums)


def blurred(image: FloatArray, width: float) -> FloatArray:
    """Return an image blurred by a Gaussian; beyond its edge it is zero."""
    if width <= 0:
        return image
    return np.asarray(gaussian_filter(image, width, mode="constant", truncate=_SIGMAS))


def _spread(image: FloatArray, width: float | FloatArray) -> FloatArray:
    if isinstance(width, float):
        return blurred(image, width)
    from scipy.signal import oaconvolve  # brings scipy.stats: a third of a second

    return np.asarray(oaconvolve(image, width, mode="same"))


def _reach(width: float | FloatArray, blur: float) -> int:
    """How far a point is spread, px, with an error of its variance."""
    if isinstance(width, float):
        return int(_SIGMAS * np.sqrt(width**2 + 2 * blur) + 0.5)
    return int(max(width.shape)) // 2 + int(_SIGMAS * np.sqrt(2 * blur) + 0.5)
