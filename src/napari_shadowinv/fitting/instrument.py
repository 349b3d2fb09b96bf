"""Unknown numbers of an instrument that is not exact, and their effect on images: `Imperfect`.

All numbers are in standard deviations of the `Instrument`: their prior is normal, with mean 0 and
variance 1. The light that is spread by the point spread and by its error is recorded by a detector,
which has recorded the source as well.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from napari_shadowinv._typing import BoolArray, FloatArray
from napari_shadowinv.facts import percent, with_error
from napari_shadowinv.instrument.effects import EFFECTS, RESPONSES, PixelResponse, Registration
from napari_shadowinv.instrument.shapes import Around, Shapes, beam_shapes, shapes_between
from napari_shadowinv.options import BeamPrior, Instrument

if TYPE_CHECKING:
    from napari_shadowinv.fitting.unknowns import Unknowns

_OF_RESPONSE = frozenset({"blur", "other_field", *(each.key for each in RESPONSES)})
# What shapes leave out of a beam must be far below the noise of all pixels together.
FITTED_VARIANCE = 0.99999
_NO_CHANGE = np.zeros((1, 1))


class Part(NamedTuple):
    """Numbers of one imperfection: their places among the common or each image's numbers."""

    key: str
    is_common: bool
    places: slice

    def of(self, common: FloatArray, separate: FloatArray) -> FloatArray:
        """Return a view of its numbers among common ones and the ones of an image, or of each."""
        return (common if self.is_common else separate)[..., self.places]


@dataclass(frozen=True, eq=False)
class Imperfect:
    """Standard deviations of what an instrument does to an image, in pixels of one size.

    Another field displaces by `other_strengths` (L, M), as shares of the displacement by each field
    in the first image.
    """

    responses: dict[str, float] = field(default_factory=dict)  # keys of `RESPONSES`
    blur: float = 0.0  # of the variance of the point spread along each axis, px²
    other_strengths: FloatArray | None = None
    shapes: tuple[Shapes, ...] = ()  # changes of a scene's beams

    @cached_property
    def parts(self) -> dict[str, Part]:
        """All imperfections by their keys, with the places of their numbers."""
        sizes = [
            *((each.key, each.is_common, int(each.key in self.responses)) for each in RESPONSES),
            ("blur", True, int(self.blur > 0)),
            ("other_field", True, int(self.other_strengths is not None)),
        ]
        sizes.sort(key=lambda each: not each[1])
        sizes += ((each.key, each.is_common, len(each)) for each in self.shapes)
        parts, ends = dict[str, Part](), {True: 0, False: 0}
        for key, is_common, size in sizes:
            begin, ends[is_common] = ends[is_common], ends[is_common] + size
            if size:
                parts[key] = Part(key, is_common, slice(begin, ends[is_common]))
        return parts

    @property
    def counts(self) -> tuple[int, int]:
        """How many numbers are common, and how many each image has."""
        parts = self.parts.values()
        common, separate = (
            max((part.places.stop for part in parts if part.is_common is kind), default=0)
            for kind in (True, False)
        )
        return common, separate

    @property
    def keys(self) -> frozenset[str]:
        """The imperfections."""
        return frozenset(self.parts)

    @property
    def of_response(self) -> frozenset[str]:
        """The imperfections that change how images respond to a field, not the light before it."""
        return self.keys & _OF_RESPONSE

    @property
    def resembles_fields(self) -> bool:
        """Whether fields can replace numbers nearly: beams of each image, but not a common one."""
        return bool(self.of_response) or "beam_between" in self.keys

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
        for key in self.keys & before.keys:
            numbers = self.parts[key].of(adapted.common, adapted.separate)
            known = before.parts[key].of(unknowns.common, unknowns.separate)
            if known.shape == numbers.shape:
                numbers[...] = known * before.size(key) / self.size(key)
        return adapted

    def size(self, key: str) -> float:
        """Return the r.m.s. change of a beam by an imperfection; 1 if it does not change it."""
        squares = [each.mean_squares.sum() for each in self.shapes if each.key == key]
        return float(np.sqrt(sum(squares))) or 1.0

    def variance(self, common: FloatArray) -> float:
        """Return what adds to the variance of the point spread, px²."""
        return self.blur * float(common[self.parts["blur"].places][0]) if self.blur else 0.0

    def detector(
        self, common: FloatArray, separate: FloatArray
    ) -> Iterator[tuple[Part, PixelResponse, float, float]]:
        """Yield each response of an image in the order of the light, with its size and number."""
        for each in RESPONSES:
            if part := self.parts.get(each.key):
                number = float(part.of(common, separate)[0])
                yield part, each, self.responses[each.key], number

    def entering(
        self, beam: FloatArray, common: FloatArray, separate: FloatArray
    ) -> tuple[FloatArray, list[tuple[Part, FloatArray]]]:
        """Return the light of a recorded beam, without the effects of the detector.

        With the derivatives of its logarithm, each by one number.
        """
        light, changes = beam, list[tuple[Part, FloatArray]]()
        for part, each, size, number in reversed(list(self.detector(common, separate))):
            light, of_recorded, of_number = each.light(light, size, number)
            before = ((other, of_recorded * change) for other, change in changes)
            changes = [(part, of_number), *before]
        return light, changes

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
        return ((self.parts[each.key], each) for each in self.shapes if each.key in self.parts)


EXACT = Imperfect()

ASSUMED = frozenset(each.key for each in RESPONSES)
"""Imperfections that errors include, of their tested sizes, where no detector was stated."""

TITLES = {each.key: each.key for each in EFFECTS} | {
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
    units = {"blur": imperfect.blur, **imperfect.responses}
    shapes = {each.key: each for each in imperfect.shapes}
    report = {}
    for part in imperfect.parts.values():
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

    The prior of the `beam` is for the difference of beams and `sources` (L, H, W), which are
    recorded or assumed, in units of their means; `is_common` if all images have the same. In the
    `used` pixels (H, W) the variation of beams has its r.m.s.; the scene's beams reach `around` px
    beyond the images. `other_strengths` (L, M) is for another field that is equal to each field in
    the first image.
    """
    shapes = []
    if beam.rms:
        shapes.append(replace(beam_shapes(beam, used, FITTED_VARIANCE), is_common=is_common))
    if beam.between and len(sources) > 1:
        shapes.append(shapes_between(beam, used, FITTED_VARIANCE))
    if instrument.registration and is_common:
        motions = Registration().shapes(sources[0], instrument.registration)
        if np.any(motions.planes):
            shapes.append(motions)
    return Imperfect(
        {each.key: size for each in RESPONSES if (size := each.stated(instrument))},
        blur=instrument.blur**2,
        other_strengths=(
            instrument.other_field * other_strengths
            if instrument.other_field and other_strengths is not None
            else None
        ),
        shapes=tuple(each.pad(around) for each in shapes),
    )
