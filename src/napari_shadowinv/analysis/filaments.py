"""Size, spacing and strength of filaments, from the autocorrelation of the field: `Filaments`.

The autocorrelation belongs to the field, not to the image: bright lines of an image are where rays
are gathered, so their spacing is the size of filaments rather than the spacing of these [1]_.

A filament whose potential is a Gaussian of radius a across it has a displacement across with the
autocorrelation ∝ (1 - x²/2a²) exp(-x²/4a²), whether it is long or round. So the first zero is at
x = √2 a. Regularly spaced filaments have a further maximum at their spacing; filaments at random
places have none, and no spacing is stated for them.

References
----------
.. [1] J. Levesque et al., "Characterizing filamentary magnetic structures in counter-streaming
   plasmas by Fourier analysis of proton images", arXiv:1910.04070.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import ClassVar, Literal, Self

import numpy as np
from pydantic import Field
from scipy.optimize import brentq

from napari_shadowinv._typing import FloatArray
from napari_shadowinv.analysis.frame import FieldFrame
from napari_shadowinv.analysis.paths import first_below, interpolate_cubic
from napari_shadowinv.analysis.power_spectra import window_weights
from napari_shadowinv.analysis.product import Coordinate, FieldNoise, Measurand, Product, Values
from napari_shadowinv.cautions import Caution
from napari_shadowinv.errors import InputError
from napari_shadowinv.facts import Fact, to_figures
from napari_shadowinv.inversion.error_bars import Quantity
from napari_shadowinv.physics.beam import displacement_from_potential

_FWHM = 2 * math.sqrt(2 * math.log(2))


def field_autocorrelation(component: FloatArray, weights: FloatArray) -> FloatArray:
    """Return the autocorrelation of a component, (H, W), of the field, 1 at no lag.

    Its shape is (2h + 1, 2w + 1), by lags from -h to h along y and -w to w along x, with h and w 40
    % of the sides. Each lag is divided by the overlap of the pixels' weights, (H, W), 0 where
    masked.
    """
    mean = float((weights * component).sum() / weights.sum())
    shape = [2 * count for count in component.shape]
    waves = np.fft.rfft2(weights * (component - mean), shape)
    overlap = np.fft.irfft2(np.abs(np.fft.rfft2(weights, shape)) ** 2, shape)
    products = np.fft.irfft2(np.abs(waves) ** 2, shape)
    lags = _largest_lags(component.shape)
    rows, columns = (np.arange(-lag, lag + 1) for lag in lags)
    at = np.ix_(rows, columns)
    covariance = products[at] / np.maximum(overlap[at], 1e-9 * overlap[0, 0])
    variance = float(covariance[lags[0], lags[1]])
    return np.asarray(covariance / variance if variance > 0 else np.zeros_like(covariance))


def _largest_lags(shape: tuple[int, ...], share: float = 0.4) -> list[int]:
    """Return the largest lags along y and x in px."""
    return [int(share * count) for count in shape]


class Filaments(Product):
    """Radius, spacing and strength of filaments, by the autocorrelation of the field across them.

    The radius belongs to a Gaussian potential; the spacing is stated only where the
    autocorrelation has a further maximum above its scatter.
    """

    title = "filaments"
    place = 75
    reference: ClassVar = "J. Levesque et al., arXiv:1910.04070"
    curves: ClassVar = ("autocorrelation", "along")
    lengths: ClassVar = ("radius", "width", "spacing")
    reading: ClassVar = (
        "Size and spacing are those of the field; the bright lines of the image are spaced by "
        "the size of filaments (Levesque et al.), and their number along the beam is unknown.",
        "No spacing is stated (NaN) where the autocorrelation has no further maximum above "
        "the scatter of structures at random places.",
    )
    product: Literal["filaments"] = "filaments"
    angle: float | None = Field(
        default=None,
        ge=-180,
        le=180,
        title="Angle (°)",
        description="Direction of the filaments in degrees, from the x axis towards y (clockwise "
        "in the image). Default: the direction along which the field varies least.",
    )

    def check(self, frame: FieldFrame) -> None:
        super().check(frame)
        window_weights(frame.mask)

    def adapt(self, potential: FloatArray, noise: FieldNoise | None, frame: FieldFrame) -> Self:
        if self.angle is not None:
            return self
        displacement = displacement_from_potential(potential)
        angle = _direction(displacement, window_weights(frame.mask))
        return self.model_copy(update={"angle": angle})

    def _lags(self, frame: FieldFrame, step: float = 0.25) -> FloatArray:
        return np.arange(0.0, min(_largest_lags(frame.shape)) - 1, step)

    def variables(self, frame: FieldFrame) -> dict[str, Measurand]:
        dims, length, unit = ("lag",), frame.length_unit, frame.si_unit
        return {
            "autocorrelation": Measurand(
                dims, "1", "Autocorrelation of the field across filaments"
            ),
            "along": Measurand(dims, "1", "Autocorrelation of that component along the filaments"),
            "radius": Measurand((), length, "Radius of a filament's Gaussian potential"),
            "width": Measurand((), length, "Width of a filament's potential at half its height"),
            "spacing": Measurand((), length, "Spacing of the filaments"),
            "order": Measurand((), "1", "Autocorrelation at the spacing"),
            "elongation": Measurand((), "1", "Length of filaments over their width"),
            "rms": Measurand((), unit, f"{frame.long_name} of the filaments, r.m.s."),
            "peak": Measurand((), unit, f"{frame.long_name} of the filaments, strongest per cent"),
        }

    def coordinates(self, frame: FieldFrame) -> dict[str, Coordinate]:
        return {"lag": Coordinate.in_plane(self._lags(frame), frame, "Lag")}

    def measure(self, potential: FloatArray, displacement: FloatArray, frame: FieldFrame) -> Values:
        weights = window_weights(frame.mask)
        assert self.angle is not None  # by `adapt`
        radians = math.radians(self.angle)
        across = np.array([math.cos(radians), -math.sin(radians)])
        component = np.tensordot(across, displacement, axes=1)
        plane = field_autocorrelation(component, weights)
        lags = self._lags(frame)
        correlation = _along(plane, across, lags)
        along = _along(plane, np.array([-across[1], across[0]]), lags)
        zero = first_below(lags, correlation, 0.0)
        length, half = _reach(along, lags), _reach(correlation, lags)
        least = _least_maximum(weights, zero / math.sqrt(2), length)
        spacing, order = _next_maximum(correlation, lags, least)
        radius = _radius(zero, spacing)
        field = frame.field(potential, displacement)
        strength = np.hypot(*field) if field.ndim == 3 else np.abs(field - np.median(field))
        used = strength[frame.mask]
        return {
            "autocorrelation": correlation,
            "along": along,
            "radius": np.asarray(frame.length(radius)),
            "width": np.asarray(frame.length(_FWHM * radius)),
            "spacing": np.asarray(frame.length(spacing)),
            "order": np.asarray(order),
            # Of a round Gaussian the reaches of the autocorrelation have this ratio.
            "elongation": np.asarray(length / half / 1.88),
            "rms": np.asarray(math.sqrt(float((used**2).mean()))),
            "peak": np.asarray(np.percentile(used, 99)),
        }

    def refine(
        self, quantities: dict[str, Quantity], error: float = 0.2, least: float = 0.9
    ) -> dict[str, Quantity]:
        """Keep the spacing only if nearly all samples, a least share, confirm it to an error."""
        value, samples = quantities["spacing"].value, quantities["spacing"].samples
        if not len(samples):
            return quantities
        is_confirmed = np.abs(samples / value - 1) < error
        if is_confirmed.mean() < least:
            nothing = Quantity(np.asarray(math.nan), np.full_like(samples, math.nan))
            return quantities | {"spacing": nothing, "order": nothing}
        confirmed = np.where(is_confirmed, samples, samples[is_confirmed].mean())
        return quantities | {"spacing": Quantity(value, confirmed)}

    def facts(self, quantities: Mapping[str, Quantity], frame: FieldFrame) -> list[Fact]:
        return [fact for fact in super().facts(quantities, frame) if fact.key not in self.curves]

    def cautions(
        self, quantities: Mapping[str, Quantity], frame: FieldFrame, *, elongation: float = 1.3
    ) -> Iterator[Caution]:
        if not np.isfinite(quantities["radius"].value):
            yield Caution(
                "edge",
                "the autocorrelation does not fall to zero within 40 % of the image: the "
                "structures are too large for it, and have no size here",
            )
        elif float(quantities["elongation"].value) < elongation:
            yield Caution(
                "misfit",
                f"structures are only {to_figures(float(quantities['elongation'].value))} times as "
                "long as wide: they are blobs rather than filaments, and their direction means "
                "nothing",
            )
        spacing, radius = (float(quantities[name].value) for name in ("spacing", "radius"))
        if _is_wave(math.sqrt(2) * radius, spacing):
            yield Caution(
                "accuracy",
                "the filaments nearly merge into a wave, whose first zero does not depend on their "
                "size: the radius is a lower limit",
            )


def _direction(displacement: FloatArray, weights: FloatArray) -> float:
    """Return the angle of the filaments in degrees."""
    y, x = displacement - (weights * displacement).sum(axis=(1, 2), keepdims=True) / weights.sum()
    yy, xx, yx = (float((weights * each).sum()) for each in (y * y, x * x, y * x))
    if not yy + xx > 0:
        raise InputError("the field is zero everywhere, expected one with filaments")
    # The displacement is strongest across filaments.
    across = math.degrees(0.5 * math.atan2(2 * yx, xx - yy))
    return across + 90 if across <= 0 else across - 90


def _along(plane: FloatArray, direction: FloatArray, lags: FloatArray) -> FloatArray:
    centre = (np.array(plane.shape) - 1) / 2
    points = centre + lags[:, None] * direction
    size = np.array(plane.shape) - 1
    inside = ((points >= 0) & (points <= size)).all(axis=1)
    values = interpolate_cubic(plane, np.clip(points, 0, size))
    return np.asarray(np.where(inside, values, np.nan))


def _reach(values: FloatArray, lags: FloatArray) -> float:
    """Return the lag at which values fall below ½; the largest lag if they do not."""
    lag = first_below(lags, values, 0.5)
    return lag if np.isfinite(lag) else float(lags[-1])


def _least_maximum(weights: FloatArray, radius: float, length: float, errors: float = 3.0) -> float:
    """Return some errors of the autocorrelation by the scatter of structures at random places."""
    if not np.isfinite(radius):
        return errors
    count = float(weights.sum()) / max(4 * radius * max(length, radius), 1.0)
    return errors / math.sqrt(max(count, 1.0))


def _is_wave(zero: float, spacing: float, margin: float = 0.003) -> bool:
    """Return whether the first zero belongs to a sine wave, at a quarter of the spacing."""
    return abs(zero / spacing - 0.25) < margin


def _radius(zero: float, spacing: float, neighbours: int = 3, merged: float = 3.6) -> float:
    """Return the radius that belongs to the first zero, with neighbours at multiples of a spacing.

    Close neighbours move the zero inwards; of filaments that merge into a sine wave, with the zero
    at a quarter of the spacing, `merged` radii, it is the lower limit that a lone filament would
    have.
    """
    alone = zero / math.sqrt(2)
    if not np.isfinite(spacing):
        return alone
    offsets = zero - spacing * np.arange(-neighbours, neighbours + 1)

    def total(radius: float) -> float:
        squares = (offsets / (2 * radius)) ** 2
        return float(np.sum((1 - 2 * squares) * np.exp(-squares)))

    if _is_wave(zero, spacing) or total(alone) * total(spacing / merged) >= 0:
        return alone
    return float(brentq(total, alone, spacing / merged))


def _next_maximum(
    values: FloatArray, lags: FloatArray, least: float, margin: float = 0.1
) -> tuple[float, float]:
    """Return lag and height of the first maximum beyond the first zero.

    It is above `least`, or its multiple is (within a margin): the second neighbours of bent
    filaments may by chance be aligned better than the first.
    """
    inner = values[1:-1]
    peaks = 1 + np.flatnonzero((inner >= values[:-2]) & (inner > values[2:]) & (inner > 0))
    peaks = peaks[np.cumsum(values < 0)[peaks] > 0]
    high = peaks[values[peaks] > least]
    if not len(high):
        return math.nan, math.nan
    multiple = lags[high[0]] / lags[peaks]
    is_spacing = np.abs(multiple - np.round(multiple)) < margin * np.round(multiple)
    peak = peaks[np.flatnonzero(is_spacing)[0]]
    # The top of the parabola through three values
    before, top, after = (float(value) for value in values[peak - 1 : peak + 2])
    shift = (after - before) / (2 * (2 * top - before - after))
    step = float(lags[peak] - lags[peak - 1])
    return float(lags[peak]) + shift * step, top + shift * (after - before) / 4
