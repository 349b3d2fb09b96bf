"""Effects of an instrument that is not exact: `EFFECTS`, one `Effect` for each.

An effect is known to a standard deviation of the `Instrument`. Light is absorbed by the object,
lands beside its source, is blurred, and is recorded as f^(1 + g) + b. An effect has

- the change of flux in the cells of an inversion, of which the error budget takes the linear
  response of the field: `Effect.pattern`
- its removal from a recorded shot, by normal numbers, for random samples: `Effect.removal`; that of
  all effects: `InstrumentDraws`
- in a fit, with the derivatives: the record of the light in a pixel, `PixelResponse.record`, and
  the light of a record, `PixelResponse.light`; light that is spread, `widen`; relative changes of
  the light before, `Absorption.shapes`, `Registration.shapes`
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy.fft import dctn, idctn
from scipy.ndimage import gaussian_filter, map_coordinates

from napari_shadowinv._typing import BoolArray, FloatArray
from napari_shadowinv.facts import percent, to_figures
from napari_shadowinv.instrument.shapes import VARIANCE, Shapes, beam_shapes, random_waves
from napari_shadowinv.options import BeamPrior, Instrument

DARKEST = 1e-4
"""Light in units of a beam's mean, for a logarithm."""

_DIMMEST = 1e-3  # of the mean, for a logarithm or a division


@dataclass(frozen=True, kw_only=True)
class LitObject:
    """The retrieved object of a shot, and its source."""

    displacement: FloatArray  # (2, H, W): of the ray through each pixel, px
    source: FloatArray  # (H, W)
    mask: BoolArray  # (H, W): pixels that are used

    def region(self, step: int = 1, edge: float = 0.1) -> tuple[FloatArray, float]:
        """Return a smooth mask of the object on every `step`th pixel, and its radius, px.

        The object ends where rays are displaced by a share `edge` of the largest displacement.
        """
        length = np.hypot(*self.displacement[:, ::step, ::step])
        inside = (length > edge * length.max()) & self.mask[::step, ::step]
        radius = max(step * float(np.sqrt(inside.sum() / np.pi)), 1.0)
        return gaussian_filter(inside.astype(np.float64), radius / 4 / step), radius

    def mean(self, values: FloatArray) -> float:
        """Return the mean of an image or a source over the used pixels."""
        return float(values[self.mask].mean())

    def filled_source(self) -> FloatArray:
        """Return the source with its mean where it is masked."""
        return np.where(self.mask, self.source, self.mean(self.source))


@dataclass(frozen=True, kw_only=True)
class RecordedShot(LitObject):
    """An image and its source in the units of their files, (H, W) each, 0 where masked."""

    image: FloatArray


@dataclass(frozen=True, kw_only=True)
class SolvedShot(LitObject):
    """A shot with its solved transport, of n cells, in units of the source's power of two."""

    sites: FloatArray  # (n, 2), px of the image
    fluxes: tuple[FloatArray, FloatArray]  # of each cell in the image and in the source, (n,)
    areas: tuple[FloatArray, FloatArray]  # of the pixels that are used, (n,)
    diffused: FloatArray  # flux that cells gain where the image diffuses for a time of 1 px², (n,)
    flux_of_source: Callable[[FloatArray], FloatArray]  # of its changes, (k, H, W) to (k, n)
    seed: int  # of random patterns

    def evens(self) -> tuple[FloatArray, FloatArray]:
        """Return the flux of each cell in an even image and in an even source, (n,)."""
        of_image, of_source = (
            area * flux.sum() / area.sum()
            for flux, area in zip(self.fluxes, self.areas, strict=True)
        )
        return of_image, of_source

    def balance(self, gains: FloatArray) -> FloatArray:
        """Return gains of cells, (k, n), less their sum in proportion to the flux of the cells.

        The image is scaled to the flux of its source.
        """
        flux, _ = self.fluxes
        return np.asarray(gains - gains.sum(axis=1, keepdims=True) * flux / flux.sum())


# The shot without an effect, drawn by independent normal numbers.
Removal = Callable[[RecordedShot, FloatArray], RecordedShot]


class Effect:
    """A quantity of the instrument that is known to a standard deviation only."""

    key: str  # name in `Instrument`, and in texts
    unit: str = "%"  # of the standard deviation in texts
    tested: float = 0.0  # deviation whose effect every budget states; 0 if it takes too long
    is_even: bool = False  # whether the effect grows with the square of its number
    count: int = 1  # of normal numbers that draw it, unless `removal` has another

    def pattern(self, shot: SolvedShot, size: float) -> FloatArray:
        """Return k independent changes of the cells' flux for a standard deviation, (k, n).

        They have the mean square of the effect.
        """
        raise NotImplementedError

    def remove(self, shot: RecordedShot, numbers: FloatArray, size: float) -> RecordedShot:
        """Return the shot without the effect of numbers times a standard deviation."""
        raise NotImplementedError

    def removal(self, lit: LitObject, size: float) -> tuple[int, Removal]:
        """Return how many normal numbers draw the effect on an object, and `remove` by them."""
        return self.count, partial(self.remove, size=size)

    def name(self, size: float) -> str:
        """Return the name with the size, such as "background, 5 %"."""
        return f"{self.key}, {to_figures(self.factor * size)} {self.unit}".rstrip()

    @property
    def factor(self) -> float:
        """Factor from the standard deviation to the number in its text."""
        return 100 if self.unit == "%" else 1

    def stated(self, instrument: Instrument) -> float:
        """Return the standard deviation in an instrument."""
        return float(getattr(instrument, self.key) or 0.0)


Derived = tuple[FloatArray, FloatArray | float, FloatArray]
"""Values behind a response, and their derivatives by the values before it and by its number."""


class PixelResponse(Effect):
    """An effect by which a detector records the light of each pixel, in units of a beam's mean.

    In a fit its number, in standard deviations of `size`, is common to all images, or each has its
    own.
    """

    is_common: bool

    def record(self, light: FloatArray, size: float, number: float) -> Derived:
        """Return the recorded values, and their derivatives by the light and by the number."""
        raise NotImplementedError

    def light(self, recorded: FloatArray, size: float, number: float) -> Derived:
        """Return the light of recorded values, and the derivatives of its logarithm.

        By the logarithm of the values, and by the number.
        """
        raise NotImplementedError


class Background(PixelResponse):
    """A constant under the image and its source: one detector has recorded both."""

    key = "background"
    tested = 0.05
    is_common = False

    def record(self, light: FloatArray, size: float, number: float) -> Derived:
        return light + size * number, 1.0, np.full(light.shape, size)

    def light(self, recorded: FloatArray, size: float, number: float) -> Derived:
        light = recorded - size * number
        is_lit, light = light > DARKEST, np.maximum(light, DARKEST)
        return light, is_lit * recorded / light, np.where(is_lit, -size / light, 0.0)

    def pattern(self, shot: SolvedShot, size: float) -> FloatArray:
        of_image, of_source = map(np.subtract, shot.evens(), shot.fluxes)
        return shot.balance(size * (of_image - of_source)[None])

    def remove(self, shot: RecordedShot, numbers: FloatArray, size: float) -> RecordedShot:
        means = shot.mean(shot.image), shot.mean(shot.source)
        image, source = (
            values - size * numbers[0] * mean
            for values, mean in zip((shot.image, shot.source), means, strict=True)
        )
        # A level above the darkest pixels leaves them dark; the image is floored with its noise.
        source = np.where(shot.mask, np.maximum(source, _DIMMEST * means[1]), source)
        return replace(shot, image=image, source=source)


class Gamma(PixelResponse):
    """An exponent of the image and of its source: one detector has recorded both."""

    key = "gamma"
    unit = ""
    tested = 0.05
    is_common = True

    @staticmethod
    def exponent(change: float, least: float = 0.2) -> float:
        """Return the exponent of the response, which is 1 if linear."""
        return max(1 + change, least)

    def record(self, light: FloatArray, size: float, number: float) -> Derived:
        exponent, light = self.exponent(size * number), np.maximum(light, DARKEST)
        power = light ** (exponent - 1)
        recorded = light * power
        return recorded, exponent * power, size * recorded * np.log(light)

    def light(self, recorded: FloatArray, size: float, number: float) -> Derived:
        exponent, recorded = self.exponent(size * number), np.maximum(recorded, DARKEST)
        light = recorded ** (1 / exponent)
        return light, 1 / exponent, -size / exponent**2 * np.log(recorded)

    def pattern(self, shot: SolvedShot, size: float) -> FloatArray:
        def respond(flux: FloatArray, even: FloatArray) -> FloatArray:
            brightness = flux / np.maximum(even, _DIMMEST * flux.mean())
            return np.asarray(flux * np.log(np.maximum(brightness, _DIMMEST)))

        of_image, of_source = map(respond, shot.fluxes, shot.evens())
        return shot.balance(size * (of_image - of_source)[None])

    def remove(self, shot: RecordedShot, numbers: FloatArray, size: float) -> RecordedShot:
        def linearise(values: FloatArray) -> FloatArray:
            power = np.maximum(values, 0) ** (1 / self.exponent(size * numbers[0]))
            # In the units of before, so that noise can be added.
            return np.asarray(power * (shot.mean(values) / shot.mean(power)))

        return replace(shot, image=linearise(shot.image), source=linearise(shot.source))


class Blur(Effect):
    """Diffusion of flux between neighbouring cells, over half the square of the width."""

    key = "blur"
    unit = "px"
    tested = 1.0
    is_even = True

    def pattern(self, shot: SolvedShot, size: float) -> FloatArray:
        # The root mean square of a normal number's square is √3.
        return shot.balance((np.sqrt(3) * size**2 / 2 * shot.diffused)[None])

    def remove(self, shot: RecordedShot, numbers: FloatArray, size: float) -> RecordedShot:
        mask = shot.mask

        def blurred(values: FloatArray) -> FloatArray:
            values = np.where(mask, values, 0.0)
            return np.asarray(gaussian_filter(values, size * abs(numbers[0]), mode="nearest"))

        # 1 / g of a wave that a blur leaves a share g of is 1 + (1 - g) + (1 - g)² + …
        used = np.maximum(blurred(mask.astype(np.float64)), _DIMMEST)
        once = shot.image - blurred(shot.image) / used
        return replace(shot, image=shot.image + 2 * once - blurred(once) / used)


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


class Absorption(Effect):
    """Smooth variations of the transmission where the object displaces rays."""

    key = "absorption"
    tested = 0.01

    def pattern(
        self, shot: SolvedShot, size: float, samples: int = 8, steps: int = 96
    ) -> FloatArray:
        """Look for the object in `steps` along the shorter side, and draw random samples."""
        sites, mass = shot.sites, shot.fluxes[1]
        step = max(min(shot.mask.shape) // steps, 1)
        envelope, radius = shot.region(step)
        rows, columns = (
            np.clip(np.rint(line / step).astype(np.int64), 0, side - 1)
            for line, side in zip(sites.T, envelope.shape, strict=True)
        )
        fields = random_waves(sites, radius, samples, np.random.default_rng(shot.seed))
        fields *= envelope[rows, columns]
        fields -= (fields @ mass / mass.sum())[:, None]
        return np.asarray(size * mass * fields)

    def removal(self, lit: LitObject, size: float) -> tuple[int, Removal]:
        shapes = self.shapes(lit, size)
        return len(shapes), partial(_with_excess, shapes=shapes)

    def shapes(self, lit: LitObject, size: float, share: float = VARIANCE) -> Shapes:
        """Return the relative changes of a beam, with a `share` of their variance."""
        envelope, radius = lit.region()
        smooth = Shapes.of_length(self.key, radius, lit.source, size, share)
        return replace(smooth, envelope=envelope)


class Registration(Effect):
    """Shifts along y and x, a turn and a change of scale, as large at the corners."""

    key = "registration"
    unit = "px"
    count = 4

    def pattern(self, shot: SolvedShot, size: float) -> FloatArray:
        # The mean over the four is that of all together if each is twice as large.
        changes = 2 * size * motions(shot.filled_source())
        return shot.balance(shot.flux_of_source(changes * shot.mask))

    def remove(self, shot: RecordedShot, numbers: FloatArray, size: float) -> RecordedShot:
        source = shot.filled_source()
        if np.ptp(source) == 0:
            return shot
        places = np.indices(source.shape, dtype=np.float64)
        places += motion(places, source.shape, -size * numbers)
        moved = map_coordinates(source, places, order=3, mode="nearest")
        return replace(shot, source=np.maximum(moved, 0))

    def shapes(self, source: FloatArray, size: float, dimmest: float = 1e-2) -> Shapes:
        """Return the relative changes of a source whose mean is 1."""
        source = np.maximum(source, dimmest)
        return Shapes.of_planes(self.key, size * motions(source) / source)


def motion(places: FloatArray, shape: tuple[int, ...], numbers: FloatArray) -> FloatArray:
    """Return how places (y, x), px, move in an image of a shape.

    By shifts along y and x, a turn and a change of scale, in px, the latter two at the corners.
    """
    y, x = _from_centre(places[0], places[1], shape)
    down, right, turn, scale = numbers
    return np.stack([down + turn * x + scale * y, right - turn * y + scale * x])


def _from_centre(
    rows: FloatArray, columns: FloatArray, shape: tuple[int, ...]
) -> tuple[FloatArray, FloatArray]:
    """Return places relative to the centre of an image, in units of the corners' distance."""
    height, width = shape
    corner = np.hypot(height, width) / 2
    return (rows - (height - 1) / 2) / corner, (columns - (width - 1) / 2) / corner


def motions(image: FloatArray) -> FloatArray:
    """Return changes of an image by each number of `motion`, 1 px each, (4, H, W)."""
    down, right = np.gradient(image)
    height, width = image.shape
    y, x = _from_centre(
        np.arange(height, dtype=np.float64)[:, None],
        np.arange(width, dtype=np.float64),
        image.shape,
    )
    return np.stack([down, right, down * x - right * y, down * y + right * x])


EFFECTS: tuple[Effect, ...] = (Background(), Gamma(), Blur(), Absorption(), Registration())
"""Quantities of the instrument with their effects on an image, from the detector to the light."""

RESPONSES = tuple(each for each in reversed(EFFECTS) if isinstance(each, PixelResponse))
"""Effects on the light of each pixel, in the order of the light."""


def _with_excess(
    shot: RecordedShot, numbers: FloatArray, shapes: Shapes, least: float = 0.05
) -> RecordedShot:
    """Give the source the relative excess of light that the image has, at `least` some light."""
    return replace(shot, source=shot.source * np.maximum(1 + shapes.sum(numbers), least))


class InstrumentDraws:
    """Random effects of an instrument on a recorded shot, by independent normal numbers.

    The `recorded` shot is without them; `names` are effects with their sizes; numbers for which
    `is_even` (count,) is true act by their square.
    """

    def __init__(self, shot: RecordedShot, instrument: Instrument, beam: BeamPrior) -> None:
        self.recorded, self._other_field = shot, instrument.other_field
        names, even = [], [False]  # the first number is that of the other field
        if self._other_field:
            names.append(f"other field, {percent(self._other_field)}")
        self._parts: list[tuple[Removal, slice]] = []

        def add(name: str, count: int, removal: Removal, *, is_even: bool = False) -> None:
            self._parts.append((removal, slice(len(even), len(even) + count)))
            even.extend([is_even] * count)
            names.append(name)

        if beam.rms:
            shapes = beam_shapes(beam, shot.source)
            add(f"beam, {percent(beam.rms)}", len(shapes), partial(_with_excess, shapes=shapes))
        # From the light to the detector, which adds its background last.
        for each in reversed(EFFECTS):
            if size := each.stated(instrument):
                add(each.name(size), *each.removal(shot, size), is_even=each.is_even)
        self.names, self.count, self.is_even = tuple(names), len(even), np.array(even)

    def shot(self, numbers: FloatArray) -> RecordedShot:
        """Return the shot without the effects of `count` numbers, the last of them first."""
        shot = self.recorded
        for removal, places in reversed(self._parts):
            shot = removal(shot, numbers[places])
        return shot

    def scale(self, numbers: FloatArray) -> FloatArray:
        """Return the field's relative change without the other one, for numbers (..., count)."""
        return np.asarray(-self._other_field * numbers[..., 0])

    def steps(self, small: float = 1e-3) -> Iterator[tuple[int, float, RecordedShot]]:
        """Yield place and size of a step for each number, with the shot without it.

        Numbers whose square acts make a step of 1, others a `small` one.
        """
        for place in range(1, self.count):
            step = 1.0 if self.is_even[place] else small
            numbers = np.zeros(self.count)
            numbers[place] = step
            yield place, step, self.shot(numbers)
