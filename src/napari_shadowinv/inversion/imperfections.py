"""Effects of an instrument that is not exact: `IMPERFECTIONS`, one `Imperfection` for each.

An imperfection changes the flux of the image, or of its source, by a pattern whose size is a
standard deviation of the `Instrument`. The field follows by the linear response of the solved
transport. For random samples (`InstrumentDraws`) each imperfection is removed from the pixels of
the image and of its source, by independent normal numbers; smooth fields by `SmoothField`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.ndimage import gaussian_filter, map_coordinates

from napari_shadowinv._typing import BoolArray, FloatArray
from napari_shadowinv.facts import percent, to_figures
from napari_shadowinv.inversion.normalise import Prepared
from napari_shadowinv.inversion.readout import LinearResponse
from napari_shadowinv.options import BeamPrior, Instrument

_WAVES = 16
_SAMPLES = 8
_STEPS = 96  # along the shorter side, where the object is looked for
_OBJECT = 0.1  # of the largest displacement
_LEAST_BRIGHTNESS = 1e-3  # of the mean, for a logarithm
_SQUARE = np.sqrt(3)  # r.m.s. square of a normal number: blur acts by the square of its width
_VARIANCE = 0.999  # of a smooth field, in its modes
_MAX_MODE_PLACES = 256  # along an axis
_LEAST_TRANSMISSION = 0.05
_LEAST_EXPONENT = 0.05
_STEP = 1e-3  # of a normal number, for a derivative


@dataclass(frozen=True)
class SolvedShot:
    """A shot with its solved transport, of n cells."""

    prepared: Prepared  # in units of the source's power of two
    displacement: FloatArray  # (2, H, W): of the ray through each pixel, px
    response: LinearResponse
    seed: int  # of random patterns

    @property
    def mean(self) -> float:
        """Mean of the image, and of its source."""
        return float(self.prepared.source[self.prepared.mask].mean())

    @cached_property
    def fluxes(self) -> tuple[tuple[FloatArray, FloatArray], ...]:
        """Flux of each cell in the image and in the source, each with its flux in an even one."""
        fluxes = self.response.flux, self.response.level.mass
        areas = self.response.areas(self.prepared.mask)
        return tuple(
            (flux, area * flux.sum() / area.sum()) for flux, area in zip(fluxes, areas, strict=True)
        )

    def flux_of_source(self, changes: FloatArray) -> FloatArray:
        """Return the flux that cells gain by changes of the source, (k, H, W) to (k, n)."""
        return self.balance(self.response.flux_of_source(changes * self.prepared.mask))

    def balance(self, gains: FloatArray) -> FloatArray:
        """Return gains of cells, (k, n), less their sum in proportion to the flux of the cells.

        The image is scaled to the flux of its source.
        """
        flux = self.response.flux
        return np.asarray(gains - gains.sum(axis=1, keepdims=True) * flux / flux.sum())


class SmoothField:
    """Random field on the pixels, whose correlation falls with distance as a Gaussian.

    It is the sum of a few smooth modes times independent normal numbers.

    Parameters
    ----------
    length : float
        Standard deviation of the Gaussian, px.
    weights : ndarray, shape (H, W)
        Weights of the pixels. The weighted mean of each field is 0, its expected square 1.
    share : float, default 0.999
        Of the variance that the modes hold.

    Attributes
    ----------
    count : int
        Number of modes.
    modes : list of ndarray
        Functions of y (n, H) and of x (m, W), whose products are the modes.
    places : ndarray of int, shape (2, count)
        Numbers of both functions of each mode.
    means : ndarray, shape (count,)
        Weighted mean of each product, which is subtracted.
    size : float
        Factor of all modes.
    """

    def __init__(self, length: float, weights: FloatArray, share: float = _VARIANCE) -> None:
        self.modes = [_line_modes(size, length, share) for size in weights.shape]
        weights = weights / weights.sum()
        along_y, along_x = self.modes
        means = along_y @ weights @ along_x.T
        squares = along_y**2 @ weights @ (along_x**2).T - means**2
        order = np.argsort(squares, axis=None)[::-1]
        held = np.cumsum(squares.ravel()[order]) / squares.sum()
        self.count = int(np.searchsorted(held, share)) + 1
        chosen = order[: self.count]
        self.places = np.stack(np.unravel_index(chosen, squares.shape))
        self.means = means.ravel()[chosen]
        self.size = float(1 / np.sqrt(squares.ravel()[chosen].sum()))

    def of(self, numbers: FloatArray) -> FloatArray:
        """Return the field of `count` numbers, shape (H, W)."""
        along_y, along_x = self.modes
        strengths = np.zeros((len(along_y), len(along_x)))
        strengths[tuple(self.places)] = numbers
        field = along_y.T @ strengths @ along_x - self.means @ numbers
        return np.asarray(self.size * field)


def _line_modes(size: int, length: float, share: float) -> FloatArray:
    """Return principal components of a random field along a line of pixels, (k, size)."""
    places = np.linspace(0, size - 1, min(size, _MAX_MODE_PLACES))
    squares = (places[:, None] - places) ** 2
    variances, vectors = np.linalg.eigh(np.exp(-squares / (2 * length**2)))
    variances, vectors = np.maximum(variances[::-1], 0), vectors[:, ::-1]
    held = np.cumsum(variances) / variances.sum()
    count = int(np.searchsorted(held, 1 - (1 - share) / 10)) + 1
    modes = (np.sqrt(variances) * vectors).T[:count]
    return np.array([np.interp(np.arange(size), places, mode) for mode in modes])


@dataclass(frozen=True)
class LitObject:
    """The retrieved object of a shot."""

    displacement: FloatArray  # (2, H, W): of the ray through each pixel, px
    source: FloatArray  # (H, W): 0 where masked
    mask: BoolArray  # (H, W): pixels that are used

    @cached_property
    def object_region(self) -> tuple[FloatArray, float]:
        """Smooth mask of the object, (H, W), and the radius of a disc of its area, px."""
        return _object_region(self.displacement, self.mask, 1)

    @cached_property
    def transmission(self) -> SmoothField:
        """Field with structure of the object's size."""
        _, radius = self.object_region
        return SmoothField(radius, self.source)


@dataclass(frozen=True)
class RecordedShot:
    """An image and its source in the units of their files, (H, W) each, 0 where masked."""

    image: FloatArray
    source: FloatArray
    scene: LitObject

    def mean(self, values: FloatArray) -> float:
        """Return the mean of image or source over the used pixels."""
        return float(values[self.scene.mask].mean())


# k independent changes of the cells' flux, (k, n), for a standard deviation, with the mean square
# of the imperfection.
Pattern = Callable[[SolvedShot, float], FloatArray]
# The shot without the imperfection of a standard deviation, drawn by independent normal numbers.
Change = Callable[[RecordedShot, float, FloatArray], RecordedShot]


@dataclass(frozen=True)
class Imperfection:
    """A quantity of the instrument that is known to a standard deviation only."""

    key: str  # name in `Instrument`
    title: str  # in texts
    unit: str  # unit of the standard deviation in texts
    tested: float  # standard deviation whose effect every budget states; 0 if it takes too long
    pattern: Pattern
    change: Change
    count: Callable[[LitObject], int] = lambda scene: 1  # of the numbers that a change takes
    is_even: bool = False  # whether the imperfection grows with the square of its number

    def name(self, size: float) -> str:
        """Return the title with the size, such as "background, 5 %"."""
        return f"{self.title}, {to_figures(self.factor * size)} {self.unit}".rstrip()

    @property
    def factor(self) -> float:
        """Factor from the standard deviation to the number in its text."""
        return 100 if self.unit == "%" else 1

    def stated(self, instrument: Instrument) -> float:
        """Return the standard deviation in an instrument."""
        return float(getattr(instrument, self.key) or 0.0)


def random_waves(
    places: FloatArray, length: float, count: int, rng: np.random.Generator
) -> FloatArray:
    """Return random smooth fields at places (n, 2), (count, n), with a mean square near 8."""
    fields = np.empty((count, len(places)))
    for field in fields:
        waves = rng.normal(size=(2, _WAVES)) / length
        phases = rng.uniform(0, 2 * np.pi, _WAVES)
        field[:] = np.cos((places @ waves + phases).astype(np.float32)).sum(axis=1)
    return fields


def _background(shot: SolvedShot, share: float) -> FloatArray:
    """A constant under the image and its source: one detector has recorded both."""
    of_image, of_source = (even - flux for flux, even in shot.fluxes)
    return shot.balance(share * (of_image - of_source)[None])


def _response(shot: SolvedShot, gamma: float) -> FloatArray:
    """An exponent of the image and of its source: one detector has recorded both."""
    changes = []
    for flux, even in shot.fluxes:
        brightness = flux / np.maximum(even, _LEAST_BRIGHTNESS * flux.mean())
        changes.append(flux * np.log(np.maximum(brightness, _LEAST_BRIGHTNESS)))
    of_image, of_source = changes
    return shot.balance(gamma * (of_image - of_source)[None])


def _blur(shot: SolvedShot, width: float) -> FloatArray:
    """Diffusion of flux between neighbouring cells, over half the square of the width."""
    diffused = shot.response.diffusion()
    return shot.balance((_SQUARE * width**2 / 2 * diffused)[None])


def _registration(shot: SolvedShot, shift: float) -> FloatArray:
    """Shifts along y and x, a turn and a change of scale, as large at the corners."""
    source = np.where(shot.prepared.mask, shot.prepared.source, shot.mean)
    return shot.flux_of_source(2 * shift * motions(source))


def motions(image: FloatArray) -> FloatArray:
    """Return changes of an image by shifts along y and x, a turn and a scale, by 1 px each."""
    along_y, along_x = np.gradient(image)
    y, x = (
        (indices - (side - 1) / 2) / (np.hypot(*image.shape) / 2)
        for indices, side in zip(np.indices(image.shape), image.shape, strict=True)
    )
    patterns = [along_y, along_x, along_y * x - along_x * y, along_y * y + along_x * x]
    return np.stack(patterns)


def _absorption(shot: SolvedShot, rms: float) -> FloatArray:
    """Smooth variations of the transmission where the object displaces rays."""
    response, sites = shot.response, shot.response.sites
    step = max(min(shot.prepared.mask.shape) // _STEPS, 1)
    envelope, radius = _object_region(shot.displacement, shot.prepared.mask, step)
    rows, columns = (
        np.clip(np.rint(line / step).astype(np.int64), 0, side - 1)
        for line, side in zip(sites.T, envelope.shape, strict=True)
    )
    rng = np.random.default_rng(shot.seed)
    fields = random_waves(sites, radius, _SAMPLES, rng) * envelope[rows, columns]
    fields *= np.sqrt(2 / _WAVES)
    mass = response.level.mass
    fields -= (fields @ mass / mass.sum())[:, None]
    return np.asarray(rms * mass * fields)


def _object_region(
    displacement: FloatArray, mask: BoolArray, step: int
) -> tuple[FloatArray, float]:
    """Return a smooth mask of the object on every `step`th pixel, and its radius, px."""
    length = np.hypot(*displacement[:, ::step, ::step])
    inside = (length > _OBJECT * length.max()) & mask[::step, ::step]
    radius = max(step * float(np.sqrt(inside.sum() / np.pi)), 1.0)
    return gaussian_filter(inside.astype(np.float64), radius / 4 / step), radius


def _remove_background(shot: RecordedShot, share: float, numbers: FloatArray) -> RecordedShot:
    means = shot.mean(shot.image), shot.mean(shot.source)
    image, source = (
        values - share * numbers[0] * mean
        for values, mean in zip((shot.image, shot.source), means, strict=True)
    )
    # A level above the darkest pixels leaves them dark; those of the image are floored with noise.
    source = np.where(shot.scene.mask, np.maximum(source, _LEAST_BRIGHTNESS * means[1]), source)
    return replace(shot, image=image, source=source)


def _linearise(shot: RecordedShot, gamma: float, numbers: FloatArray) -> RecordedShot:
    exponent = 1 / max(1 + gamma * numbers[0], _LEAST_EXPONENT)

    def respond(values: FloatArray) -> FloatArray:
        # In the units of before, so that noise can be added.
        power = np.maximum(values, 0) ** exponent
        return np.asarray(power * (shot.mean(values) / shot.mean(power)))

    return replace(shot, image=respond(shot.image), source=respond(shot.source))


def _sharpen(shot: RecordedShot, width: float, numbers: FloatArray) -> RecordedShot:
    mask = shot.scene.mask

    def blurred(values: FloatArray) -> FloatArray:
        values = np.where(mask, values, 0.0)
        return np.asarray(gaussian_filter(values, width * abs(numbers[0]), mode="nearest"))

    # 1 / g of a wave that a blur leaves a share g of is 1 + (1 - g) + (1 - g)² + …
    used = np.maximum(blurred(mask.astype(np.float64)), _LEAST_BRIGHTNESS)
    once = shot.image - blurred(shot.image) / used
    return replace(shot, image=shot.image + 2 * once - blurred(once) / used)


def _restore_absorbed(shot: RecordedShot, rms: float, numbers: FloatArray) -> RecordedShot:
    envelope, _ = shot.scene.object_region
    return _with_excess(shot, rms * envelope * shot.scene.transmission.of(numbers))


def _with_excess(shot: RecordedShot, excess: FloatArray) -> RecordedShot:
    """Give the source the relative excess of light that the image has."""
    return replace(shot, source=shot.source * np.maximum(1 + excess, _LEAST_TRANSMISSION))


def _move(shot: RecordedShot, shift: float, numbers: FloatArray) -> RecordedShot:
    source = np.where(shot.scene.mask, shot.source, shot.mean(shot.source))
    if np.ptp(source) == 0:
        return shot
    indices = np.indices(source.shape, dtype=np.float64)
    y, x = (
        (along - (side - 1) / 2) / (np.hypot(*source.shape) / 2)
        for along, side in zip(indices, source.shape, strict=True)
    )
    down, right, turn, scale = -shift * numbers
    indices[0] += down + turn * x + scale * y
    indices[1] += right - turn * y + scale * x
    moved = map_coordinates(source, indices, order=3, mode="nearest")
    return replace(shot, source=np.maximum(moved, 0))


IMPERFECTIONS: tuple[Imperfection, ...] = (
    Imperfection("background", "background", "%", 0.05, _background, _remove_background),
    Imperfection("gamma", "gamma", "", 0.05, _response, _linearise),
    Imperfection("blur", "blur", "px", 1.0, _blur, _sharpen, is_even=True),
    Imperfection(
        "absorption",
        "absorption",
        "%",
        0.01,
        _absorption,
        _restore_absorbed,
        count=lambda scene: scene.transmission.count,
    ),
    Imperfection("registration", "registration", "px", 0.0, _registration, _move, lambda scene: 4),
)
"""Quantities of the instrument with their effects on an image, in the order of the budget."""


class BeamExcess:
    """Relative differences of beams from their source: shapes of a prior, and smooth fields.

    Attributes
    ----------
    count : int
        Number of independent normal numbers.
    shapes : ndarray, shape (n, H, W)
        Shapes of the prior, of the first numbers.
    rest : SmoothField
        Of the other numbers, times `rest_share`.
    """

    def __init__(self, beam: BeamPrior, source: FloatArray, share: float = _VARIANCE) -> None:
        self.rest = SmoothField(beam.length * min(source.shape), source, share)
        self.rest_share, self.shapes = 1.0, np.empty((0, *source.shape))
        if beam.components is not None:
            block = beam.components.block
            places = (np.indices(source.shape) + 0.5) / block - 0.5
            self.shapes = np.array(
                [
                    map_coordinates(pattern / beam.rms, places, order=1, mode="nearest")
                    for pattern in beam.components.patterns
                ]
            ).reshape(-1, *source.shape)
            self.rest_share = beam.components.rest / beam.rms
        self.count = len(self.shapes) + self.rest.count

    def of(self, numbers: FloatArray) -> FloatArray:
        """Return the difference of `count` numbers, (H, W), whose r.m.s. is about 1."""
        of_shapes, of_rest = np.split(numbers, [len(self.shapes)])
        excess = self.rest_share * self.rest.of(of_rest)
        return np.asarray(excess + np.tensordot(of_shapes, self.shapes, 1))

    def change(self, shot: RecordedShot, rms: float, numbers: FloatArray) -> RecordedShot:
        """Return the shot with the source that a beam of an r.m.s. difference is."""
        return _with_excess(shot, rms * self.of(numbers))


class InstrumentDraws:
    """Random imperfections of a recorded shot, by independent normal numbers.

    Attributes
    ----------
    recorded : RecordedShot
        The shot without them.
    names : tuple of str
        Imperfections with their sizes.
    count : int
        Number of normal numbers.
    is_even : ndarray of bool, shape (count,)
        Numbers whose square acts.
    """

    def __init__(self, shot: RecordedShot, instrument: Instrument, beam: BeamPrior) -> None:
        self.recorded, self._other_field = shot, instrument.other_field
        names, even = [], [False]  # the first number is that of the other field
        if self._other_field:
            names.append(f"other field, {percent(self._other_field)}")
        self._parts: list[tuple[Change, float, slice]] = []

        def add(change: Change, size: float, count: int, name: str, is_even: bool) -> None:
            self._parts.append((change, size, slice(len(even), len(even) + count)))
            even.extend([is_even] * count)
            names.append(name)

        if beam.rms:
            excess = BeamExcess(beam, shot.scene.source)
            add(excess.change, beam.rms, excess.count, f"beam, {percent(beam.rms)}", False)
        # From the light to the detector, which adds its background last.
        for each in reversed(IMPERFECTIONS):
            if size := each.stated(instrument):
                count = each.count(shot.scene)
                add(each.change, size, count, each.name(size), each.is_even)
        self.names, self.count, self.is_even = tuple(names), len(even), np.array(even)

    def shot(self, numbers: FloatArray) -> RecordedShot:
        """Return the shot without the imperfections of `count` numbers, the last of them first."""
        shot = self.recorded
        for change, size, places in reversed(self._parts):
            shot = change(shot, size, numbers[places])
        return shot

    def scale(self, numbers: FloatArray) -> FloatArray:
        """Return the field's relative change without the other one, for numbers (..., count)."""
        return np.asarray(-self._other_field * numbers[..., 0])

    def steps(self) -> Iterator[tuple[int, float, RecordedShot]]:
        """Yield place and size of a step for each number, with the shot without it.

        Numbers whose square acts make a step of 1, others a small one.
        """
        for place in range(1, self.count):
            step = 1.0 if self.is_even[place] else _STEP
            numbers = np.zeros(self.count)
            numbers[place] = step
            yield place, step, self.shot(numbers)
