"""Unknown numbers of an instrument that is not exact, and their effect on images: `Imperfect`.

All numbers are in standard deviations of the `Instrument`: their prior is normal, with mean 0 and
variance 1. The detector records (f' + …)^(1 + g) + b of the light f' that is spread by the point
spread and by its error; the source is recorded by the same detector.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy.fft import dctn, idctn

from napari_shadowinv._system.arrays import complete_block_means
from napari_shadowinv._typing import BoolArray, FloatArray, IntArray
from napari_shadowinv.facts import percent, with_error
from napari_shadowinv.inversion.imperfections import (
    IMPERFECTIONS,
    BeamExcess,
    LitObject,
    SmoothField,
    motions,
)
from napari_shadowinv.options import BeamPrior, Instrument

if TYPE_CHECKING:
    from napari_shadowinv.fitting.unknowns import Unknowns

DARKEST = 1e-4  # of a beam, for a logarithm
_LEAST_EXPONENT = 0.2
_OF_RESPONSE = frozenset({"gamma", "blur", "background", "other_field"})
# What modes leave out of a beam must be far below the noise of all pixels together.
_FITTED_VARIANCE = 0.99999
_DIMMEST = 1e-2  # of a beam's mean, for a relative change
_NO_CHANGE = np.zeros((1, 1))

Around = tuple[tuple[int, int], tuple[int, int]]


class Part(NamedTuple):
    """Numbers of one imperfection: their places among the common or each image's numbers."""

    key: str
    is_common: bool
    places: slice

    def of(self, common: FloatArray, separate: FloatArray) -> FloatArray:
        """Return a view of its numbers among the common ones and those of one image, or of each."""
        return (common if self.is_common else separate)[..., self.places]


@dataclass(frozen=True, eq=False)
class ProductShapes:
    """Patterns (a_i(y) b_j(x) - c) e(y, x) of a smooth field, without a plane for each.

    `modes` are the functions a (n, H) and b (m, W), `places` (2, k) their numbers i and j for each
    pattern, `means` (k,) the constants c, and e the `envelope` (H, W).
    """

    modes: tuple[FloatArray, FloatArray]
    places: IntArray
    means: FloatArray
    envelope: FloatArray | None = None

    @classmethod
    def of_field(
        cls, field: SmoothField, size: float, around: Around, envelope: FloatArray | None = None
    ) -> ProductShapes:
        """Return the patterns of a smooth field, which go on beyond the image as at its edge."""
        along_y, along_x = (
            np.pad(functions, ((0, 0), beyond), mode="edge")
            for functions, beyond in zip(field.modes, around, strict=True)
        )
        size *= field.size
        outer = None if envelope is None else np.pad(envelope, around)
        return cls((size * along_y, along_x), field.places, size * field.means, outer)

    def __len__(self) -> int:
        return len(self.means)

    def sum(self, numbers: FloatArray) -> FloatArray:
        """Return the sum of the patterns times numbers, shape (H, W)."""
        along_y, along_x = self.modes
        strengths = np.zeros((len(along_y), len(along_x)))
        strengths[tuple(self.places)] = numbers
        lines = np.einsum("nm,mx->nx", strengths, along_x)
        total = np.einsum("ny,nx->yx", along_y, lines) - np.einsum("k,k", self.means, numbers)
        return np.asarray(total if self.envelope is None else self.envelope * total)

    def products(self, image: FloatArray) -> FloatArray:
        """Return the scalar product of an image with each pattern."""
        image = image if self.envelope is None else self.envelope * image
        return np.asarray(self._along(image, self.modes) - image.sum() * self.means)

    def squares(self, weights: FloatArray) -> FloatArray:
        """Return the weighted sum of each pattern's square."""
        if self.envelope is not None:
            weights = self.envelope**2 * weights
        along_y, along_x = self.modes
        squares = self._along(weights, (along_y**2, along_x**2))
        mixed = self._along(weights, self.modes)
        return np.asarray(squares - 2 * self.means * mixed + self.means**2 * weights.sum())

    def cosines(self, lines: Sequence[FloatArray], at: Sequence[FloatArray]) -> FloatArray:
        """Return products of cosines along y and x with each pattern at places, shape (k, n, m)."""
        along_y, along_x = (
            np.array([line @ np.interp(places, np.arange(len(mode)), mode) for mode in modes])
            for line, places, modes in zip(lines, at, self.modes, strict=True)
        )
        rows, columns = self.places
        waves = along_y[rows][:, :, None] * along_x[columns][:, None, :]
        constant = np.multiply.outer(*(line.sum(axis=1) for line in lines))
        return np.asarray(waves - self.means[:, None, None] * constant)

    def coarsen(self, factor: int) -> ProductShapes:
        """Return the patterns in larger pixels."""
        along_y, along_x = (
            functions.reshape(len(functions), -1, factor).mean(axis=2) for functions in self.modes
        )
        envelope = self.envelope
        outer = None if envelope is None else complete_block_means(envelope, factor)
        return ProductShapes((along_y, along_x), self.places, self.means, outer)

    def _along(self, image: FloatArray, modes: tuple[FloatArray, FloatArray]) -> FloatArray:
        along_y, along_x = modes
        lines = np.einsum("ny,yx->nx", along_y, image)
        table = np.einsum("nx,mx->nm", lines, along_x)
        return np.asarray(table[tuple(self.places)])


@dataclass(frozen=True, eq=False)
class Shapes:
    """Relative changes of a beam by one standard deviation of each number.

    The change of the beams of all images is common, or each has its own. Those of the first numbers
    are `planes` (n, H, W), those of the others products of functions of y and x.
    """

    key: str
    planes: FloatArray
    products: ProductShapes | None = None
    is_common: bool = True

    def __len__(self) -> int:
        return len(self.planes) + (0 if self.products is None else len(self.products))

    def sum(self, numbers: FloatArray) -> FloatArray:
        """Return the change by numbers, shape (H, W)."""
        of_planes, of_products = np.split(numbers, [len(self.planes)])
        if self.products is None:
            return np.asarray(np.einsum("k,kyx->yx", of_planes, self.planes))
        total = self.products.sum(of_products)
        for number, plane in zip(of_planes, self.planes, strict=True):
            total += number * plane
        return total

    def pull(self, image: FloatArray) -> FloatArray:
        """Return the transpose of `sum` times an image."""
        of_planes = np.einsum("yx,kyx->k", image, self.planes)
        if self.products is None:
            return np.asarray(of_planes)
        return np.append(of_planes, self.products.products(image))

    def squares(self, weights: FloatArray) -> FloatArray:
        """Return the weighted sum of the square of each number's change."""
        of_planes = np.einsum("yx,kyx->k", weights, self.planes**2)
        if self.products is None:
            return np.asarray(of_planes)
        return np.append(of_planes, self.products.squares(weights))

    @property
    def mean_squares(self) -> FloatArray:
        """Mean square of the change by each number."""
        shape = self.planes.shape[1:]
        return self.squares(np.full(shape, 1 / np.prod(shape)))

    def coarsen(self, factor: int) -> Shapes:
        """Return the same in larger pixels."""
        products = None if self.products is None else self.products.coarsen(factor)
        return replace(self, planes=complete_block_means(self.planes, factor), products=products)


@dataclass(frozen=True, eq=False)
class Imperfect:
    """Standard deviations of what an instrument does to an image, in pixels of one size.

    Attributes
    ----------
    gamma : float
        Of the exponent of the response; 0 for a linear one.
    blur : float
        Of the variance of the point spread along each axis, px².
    background : float
        Of the constant that each image has, in units of its beam's mean.
    other_strengths : ndarray, shape (L, M), or None
        Of the displacement by another field, as shares of that by each field in the first image.
    shapes : tuple of Shapes
        Changes of the beams, of the shape of a scene's beams.
    """

    gamma: float = 0.0
    blur: float = 0.0
    background: float = 0.0
    other_strengths: FloatArray | None = None
    shapes: tuple[Shapes, ...] = ()

    @cached_property
    def parts(self) -> tuple[Part, ...]:
        """All imperfections, with the places of their numbers."""
        sizes = [
            ("gamma", True, int(self.gamma > 0)),
            ("blur", True, int(self.blur > 0)),
            ("other_field", True, int(self.other_strengths is not None)),
            ("background", False, int(self.background > 0)),
            *((each.key, each.is_common, len(each)) for each in self.shapes),
        ]
        parts, ends = [], {True: 0, False: 0}
        for key, is_common, size in sizes:
            begin, ends[is_common] = ends[is_common], ends[is_common] + size
            if size:
                parts.append(Part(key, is_common, slice(begin, ends[is_common])))
        return tuple(parts)

    @property
    def counts(self) -> tuple[int, int]:
        """How many numbers are common, and how many each image has."""
        common, separate = (
            max((part.places.stop for part in self.parts if part.is_common is kind), default=0)
            for kind in (True, False)
        )
        return common, separate

    @property
    def keys(self) -> frozenset[str]:
        """The imperfections."""
        return frozenset(part.key for part in self.parts)

    @property
    def of_response(self) -> frozenset[str]:
        """The imperfections that change how images respond to a field, not the light before it."""
        return self.keys & _OF_RESPONSE

    @property
    def resembles_fields(self) -> bool:
        """Whether fields can replace numbers nearly: beams of each image, but not a common one."""
        return bool(self.of_response) or "beam_between" in self.keys

    def only(self, images: list[int]) -> Imperfect:
        """Return what concerns some of the images."""
        if self.other_strengths is None:
            return self
        return replace(self, other_strengths=self.other_strengths[images])

    def coarsen(self, factor: int) -> Imperfect:
        """Return the same in larger pixels."""
        shapes = tuple(each.coarsen(factor) for each in self.shapes)
        return replace(self, blur=self.blur / factor**2, shapes=shapes)

    def adapt(self, unknowns: Unknowns, before: Imperfect) -> Unknowns:
        """Return unknowns with as many numbers; those that `before` has not are 0."""
        common, separate = self.counts
        adapted = unknowns._replace(
            common=np.zeros(common), separate=np.zeros((len(unknowns.separate), separate))
        )
        places = {part.key: part for part in before.parts}
        for part in self.parts:
            numbers = part.of(adapted.common, adapted.separate)
            if part.key not in places:
                continue
            known = places[part.key].of(unknowns.common, unknowns.separate)
            if known.shape == numbers.shape:
                numbers[...] = known * before.size(part.key) / self.size(part.key)
        return adapted

    def size(self, key: str) -> float:
        """Return the r.m.s. change of a beam by an imperfection; 1 if it does not change it."""
        squares = [each.mean_squares.sum() for each in self.shapes if each.key == key]
        return float(np.sqrt(sum(squares))) or 1.0

    def _change(self, key: str, numbers: FloatArray) -> float:
        """The change by the one number of an imperfection, among the numbers of its kind."""
        size: float = getattr(self, key)
        return size * float(numbers[self.place(key)][0]) if size else 0.0

    def exponent(self, common: FloatArray) -> float:
        """Return the exponent of the response."""
        return max(1 + self._change("gamma", common), _LEAST_EXPONENT)

    def variance(self, common: FloatArray) -> float:
        """Return what adds to the variance of the point spread, px²."""
        return self._change("blur", common)

    def offset(self, separate: FloatArray) -> float:
        """Return the constant of an image, in units of its beam's mean."""
        return self._change("background", separate)

    def entering(self, beam: FloatArray, common: FloatArray, separate: FloatArray) -> FloatArray:
        """Return the light of a beam as recorded, without what the detector did to it."""
        if not (self.gamma or self.background):
            return beam
        light = np.maximum(beam - self.offset(separate), DARKEST)
        return np.asarray(light ** (1 / self.exponent(common)))

    def entering_changes(
        self, beam: FloatArray, common: FloatArray, separate: FloatArray
    ) -> Iterator[tuple[Part, FloatArray]]:
        """Yield the derivatives of the logarithm of `entering`, each by one number."""
        if not (self.gamma or self.background):
            return
        light = beam - self.offset(separate)
        exponent, is_lit = self.exponent(common), light > DARKEST
        light = np.maximum(light, DARKEST)
        for part in self.parts:
            if part.key == "gamma":
                yield part, -self.gamma / exponent**2 * np.log(light)
            elif part.key == "background":
                yield part, np.where(is_lit, -self.background / (exponent * light), 0.0)

    def shape_changes(self, common: FloatArray, separate: FloatArray) -> FloatArray:
        """Return the shapes times their numbers, for each image or all, (L, H, W) or (1, …)."""
        rows = separate[:1] if all(each.is_common for each in self.shapes) else separate
        changes = (
            sum((each.sum(part.of(common, row)) for part, each in self.shape_parts()), _NO_CHANGE)
            for row in rows
        )
        return np.stack(list(changes))

    def pull_shapes(self, pulls: FloatArray, common: FloatArray, separate: FloatArray) -> None:
        """Add the transpose of `shape_changes` times pulls to derivatives by the numbers."""
        for part, each in self.shape_parts():
            rows = np.atleast_2d(part.of(common, separate))
            totals = pulls.sum(axis=0, keepdims=True) if part.is_common else pulls
            for row, pull in zip(rows, totals, strict=True):
                row += each.pull(pull)

    def shape_parts(self) -> Iterator[tuple[Part, Shapes]]:
        """Yield the changes of beams, with the places of their numbers."""
        places = {part.key: part for part in self.parts}
        return ((places[each.key], each) for each in self.shapes if each.key in places)

    def place(self, key: str) -> slice | None:
        """Return the places of an imperfection's numbers; None if it is exact."""
        return next((part.places for part in self.parts if part.key == key), None)


EXACT = Imperfect()

ASSUMED = frozenset({"background", "gamma"})
"""Imperfections that errors include, of their tested sizes, where no detector was stated."""

TITLES = {each.key: each.title for each in IMPERFECTIONS} | {
    "beam": "beam",
    "beam_between": "beam between energies",
    "other_field": "other field",
    "noise": "noise",
    "edge": "edge",
}
"""Names of the parts of an error in texts."""


def numbers_in_units(
    imperfect: Imperfect, unknowns: Unknowns, changes: Sequence[Unknowns]
) -> dict[str, list[list[float]]]:
    """Return an instrument's numbers with their standard deviations by random changes.

    In the units of the `Instrument`: errors of gamma and of the background of each image, px² of
    variance for the blur, the r.m.s. of the numbers' shapes for beams and transmission.
    """
    units = {"gamma": imperfect.gamma, "blur": imperfect.blur, "background": imperfect.background}
    shapes = {each.key: each for each in imperfect.shapes}
    report = {}
    for part in imperfect.parts:
        values, *spread = (
            np.atleast_2d(part.of(each.common, each.separate)) for each in (unknowns, *changes)
        )
        deviation = np.sqrt(np.mean(np.square(spread), axis=0)) if spread else values * np.nan
        if part.key in shapes:
            squares = shapes[part.key].mean_squares
            rows = [np.sqrt((each**2 * squares).sum(axis=1)) for each in (values, deviation)]
        else:
            rows = [units.get(part.key, 1.0) * each[:, 0] for each in (values, deviation)]
        report[part.key] = np.stack(rows, axis=1).tolist()
    return report


def number_text(key: str, rows: Sequence[Sequence[float]]) -> str:
    """Describe the numbers of one imperfection, as `numbers_in_units` returns them."""
    if key == "gamma":
        return f"gamma {with_error(1 + rows[0][0], rows[0][1])}"
    if key == "blur":
        return f"variance of the point spread {with_error(rows[0][0], rows[0][1], '+')} px²"
    if key in ("background", "other_field"):
        listed = ", ".join(with_error(100 * value, 100 * error) for value, error in rows)
        return f"{TITLES[key]} {listed} %"
    size = np.sqrt(np.mean([row[0] ** 2 for row in rows]))
    return f"{TITLES[key]} {percent(size)} (r.m.s.)"


def widen(image: FloatArray, variance: float) -> FloatArray:
    """Return an image spread by a Gaussian of a variance in px², mirrored at its edges."""
    if variance <= 0:
        return image
    return _filter(image, np.exp(-variance / 2 * _wave_numbers(image.shape)))


def widening(image: FloatArray, variance: float) -> FloatArray:
    """Return the derivative of `widen` by the variance; both are their own transposes."""
    squares = _wave_numbers(image.shape)
    return _filter(image, -squares / 2 * np.exp(-max(variance, 0.0) / 2 * squares))


def _filter(image: FloatArray, transfer: FloatArray) -> FloatArray:
    return np.asarray(idctn(dctn(image, norm="ortho") * transfer, norm="ortho"))


def _wave_numbers(shape: tuple[int, ...]) -> FloatArray:
    waves = [np.pi * np.arange(n) / n for n in shape]
    return np.asarray(waves[0][:, None] ** 2 + waves[1] ** 2)


def imperfect_instrument(
    instrument: Instrument,
    beam: BeamPrior,
    sources: FloatArray,
    used: BoolArray,
    around: Around,
    *,
    is_common: bool,
    other_strengths: FloatArray | None,
) -> Imperfect:
    """Return the standard deviations of an instrument's numbers for the images of a fit.

    Parameters
    ----------
    beam : BeamPrior
        Of the difference of beams and sources.
    sources : ndarray, shape (L, H, W)
        Recorded or assumed, in units of their means; `is_common` if that of all images is the same.
    used : ndarray of bool, shape (H, W)
        Pixels in which the variation of beams has its r.m.s.
    around : pairs of int
        Pixels by which the scene's beams reach beyond the images.
    other_strengths : ndarray, shape (L, M), or None
        Of the displacement by another field, if one was equal to each field in the first image.
    """
    shapes = []
    if beam.rms:
        shapes.append(replace(beam_shapes(beam, used, around), is_common=is_common))
    if beam.between and len(sources) > 1:
        shapes.append(beam_shapes(beam, used, around, between=True))
    if instrument.registration and is_common:
        source = np.maximum(sources[0], _DIMMEST)
        planes = instrument.registration * motions(source) / source
        if np.any(planes):
            planes = np.pad(planes, ((0, 0), *around), mode="edge")
            shapes.append(Shapes("registration", planes))
    return Imperfect(
        gamma=instrument.gamma,
        blur=instrument.blur**2,
        background=instrument.background,
        other_strengths=(
            instrument.other_field * other_strengths
            if instrument.other_field and other_strengths is not None
            else None
        ),
        shapes=tuple(shapes),
    )


def beam_shapes(
    beam: BeamPrior, used: BoolArray, around: Around, *, between: bool = False
) -> Shapes:
    """Return the differences of beams and sources, or those of each image's beam `between` all."""
    weights = used.astype(np.float64)
    if between:
        smooth = SmoothField(beam.length * min(weights.shape), weights, _FITTED_VARIANCE)
        rest = ProductShapes.of_field(smooth, beam.between, around)
        return Shapes("beam_between", _no_planes(rest), rest, is_common=False)
    excess = BeamExcess(beam, weights, _FITTED_VARIANCE)
    planes = np.pad(beam.rms * excess.shapes, ((0, 0), *around), mode="edge")
    rest = ProductShapes.of_field(excess.rest, beam.rms * excess.rest_share, around)
    return Shapes("beam", planes, rest)


def absorption_shapes(
    rms: float, displacement: FloatArray, used: BoolArray, around: Around
) -> Shapes:
    """Return the transmission of an object with a displacement in px, (2, H, W)."""
    scene = LitObject(displacement, used.astype(np.float64), used)
    envelope, radius = scene.object_region
    smooth = SmoothField(radius, scene.source, _FITTED_VARIANCE)
    products = ProductShapes.of_field(smooth, rms, around, envelope)
    return Shapes("absorption", _no_planes(products), products)


def _no_planes(products: ProductShapes) -> FloatArray:
    return np.empty((0, *(functions.shape[1] for functions in products.modes)))
