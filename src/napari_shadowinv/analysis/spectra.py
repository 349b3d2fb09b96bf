"""The spectrum of a turbulent field, from its line integrals: `TurbulenceSpectrum`.

The spectrum P(k) of the line integrals b = ∫B dz is *ring-summed*: ∫P dk = ⟨|b|²⟩. For isotropic,
homogeneous turbulence over a path l_z much longer than its correlation length, the energy spectrum
follows from it [1]_:

====================  ==============================  ==========================
field                 E(k)                            normalisation
====================  ==============================  ==========================
magnetic, solenoidal  k P(k) / (π l_z)                ∫E dk = ⟨|B|²⟩ / 2
electric, a gradient  k P(k) / (2π l_z)               ∫E dk = ⟨|E|²⟩ / 2
electron density      k P(k) / (π l_z)                ∫E dk = ⟨δn²⟩
====================  ==============================  ==========================

The factors hold for the ring-summed spectrum. With the ring-averaged density P/2πk it is
E = 2 k² times the density / l_z, so a spectrum E ∝ k^(-5/3) has P ∝ k^(-8/3), which is -2.67, and a
density ∝ k^(-11/3).

References
----------
.. [1] A. F. A. Bott et al., "Proton imaging of stochastic magnetic fields", J. Plasma Phys. 83,
   905830614 (2017).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import ClassVar, Literal, Self

import numpy as np
from pydantic import Field, model_validator
from scipy.ndimage import label

from napari_shadowinv._system.progress import Reporter
from napari_shadowinv._system.validation import CombinationError
from napari_shadowinv._typing import BoolArray, FloatArray
from napari_shadowinv.analysis.frame import FieldFrame
from napari_shadowinv.analysis.power_spectra import (
    MIN_RINGS,
    RingSpectrum,
    fit_exponent,
    measure_response,
    ring_spectrum,
    window_weights,
)
from napari_shadowinv.analysis.product import Coordinate, FieldNoise, Measurand, Product, Values
from napari_shadowinv.cautions import Caution
from napari_shadowinv.errors import InputError
from napari_shadowinv.facts import Fact, Level, to_figures
from napari_shadowinv.inversion.error_bars import Quantity
from napari_shadowinv.options import InversionOptions
from napari_shadowinv.physics.beam import length_text, number_field
from napari_shadowinv.physics.units import PIXEL

_B, _E, _N = "path_integrated_b", "path_integrated_e", "line_integrated_density"
_PLANES = (_N, "line_integrated_log_index")
_ENERGY_FACTORS = {_B: math.pi, _E: 2 * math.pi, _N: math.pi}
_RMS_FACTORS = {_B: 2.0, _E: 2.0, _N: 1.0}  # ⟨|B|²⟩ over ∫E dk
_SYMBOLS = {_B: ("T", "Magnetic field"), _E: ("V/m", "Electric field"), _N: ("m⁻³", "Density")}


@dataclass(frozen=True)
class TrustedRings:
    """Limits of rings; `benchmarks/spectra.py` measures slopes and bands by them."""

    contrast: float = 1.0  # most for a slope from one image
    raw_contrast: float = 0.8  # the same as the inversion returns it, which is less
    first: int = 3  # three wavelengths in the window
    noise: float = 0.25  # of the power
    response: tuple[float, float] = (0.5, 2.0)
    response_spread: float = 0.25
    nyquist: float = 0.5  # wavenumber over the Nyquist frequency
    spacings: float = 4.0  # of the sites in a wavelength


@dataclass(frozen=True, eq=False)
class CorrectedSpectrum:
    """Power of a field, of n rings, without the noise, over the response of the inversion."""

    rings: RingSpectrum  # as retrieved
    noise: FloatArray  # (n,), its power; like the next two empty if they are not known
    response: FloatArray  # (n,), retrieved over true power
    spread: FloatArray  # (n,), standard error of the response
    resolution: float  # spacing of the sites in px; 0 without sites
    limits: TrustedRings

    @property
    def signal(self) -> FloatArray:
        """Power without the noise."""
        return self.rings.power - (self.noise if self.noise.size else 0.0)

    @property
    def power(self) -> FloatArray:
        """Power without the noise, over the response where it is measured."""
        if not self.response.size:
            return self.signal
        low, high = self.limits.response
        return np.asarray(self.signal / np.clip(self.response, low / 2, 2 * high))

    @property
    def contrast(self) -> float:
        """R.m.s. divergence of the displacement."""
        power = np.where(self.resolved, self.power, 0.0)
        return float(np.sqrt(max((power * self.rings.k**2).sum(), 0.0) * self.rings.width))

    @property
    def resolved(self) -> BoolArray:
        """The rings above the noise and within the resolution."""
        k, limits = self.rings.k, self.limits
        rings = k <= limits.nyquist * np.pi
        if self.resolution:
            rings &= k <= 2 * np.pi / (limits.spacings * self.resolution)
        if self.noise.size:
            rings &= self.noise <= limits.noise * self.rings.power
        return np.asarray(rings)

    @property
    def trusted(self) -> BoolArray:
        """The rings whose response is near 1, too: the longest range without a gap."""
        rings = self.resolved
        if self.response.size:
            low, high = self.limits.response
            rings &= (self.response >= low) & (self.response <= high)
        if self.spread.size:
            rings &= self.spread <= self.limits.response_spread
        rings[: self.limits.first - 1] = False
        return _longest_run(rings)

    def power_in(self, window: RingSpectrum) -> FloatArray:
        """Return the power of a part of the image, corrected as in the whole image."""
        power = window.power
        if self.noise.size:
            power = power - np.interp(window.k, self.rings.k, self.noise)
        if self.response.size:
            power = power / np.interp(window.k, self.rings.k, self.response)
        return np.asarray(power)


class TurbulenceSpectrum(Product):
    """Power spectrum of the field, its slope, and energy spectrum and r.m.s. field of turbulence.

    The mean power of the noise is subtracted, and the loss by the inversion, measured on random
    fields with the same spectrum, is corrected. Slope and r.m.s. field belong to the range of
    wavenumbers that can be trusted.
    """

    title = "turbulence spectrum"
    place = 70
    fields: ClassVar = ("displacement", "deflection_angle", *_PLANES, _E, _B)
    reference: ClassVar = "A. F. A. Bott et al., J. Plasma Phys. 83, 905830614 (2017)"
    subtracts_noise: ClassVar = True
    curves: ClassVar = ("power", "noise")
    lengths: ClassVar = ("correlation_length",)
    is_logarithmic: ClassVar = True
    limits: ClassVar = TrustedRings()
    product: Literal["spectrum"] = "spectrum"
    path_length: float | None = number_field(
        "Path length (m)",
        "Length l_z of the turbulence along the beam in m: gives the energy spectrum and the "
        "r.m.s. field. Default: unknown.",
        None,
        gt=0,
    )
    correlation_length: float | None = number_field(
        "Correlation length (m)",
        "Correlation length of the field in m, for the r.m.s. field from ⟨|b|²⟩ alone. "
        "Default: that of the spectrum, (π/2) ∫E/k dk / ∫E dk.",
        None,
        gt=0,
    )
    longest: float | None = number_field(
        "Longest wavelength (px)",
        "Longest wavelength of the range of slope and r.m.s. field, in px. Default: a third of "
        "the window.",
        None,
        gt=0,
    )
    shortest: float | None = number_field(
        "Shortest wavelength (px)",
        "Shortest wavelength of that range, in px. Default: where noise, resolution or the "
        "response of the inversion end what can be trusted.",
        None,
        gt=0,
    )
    slope: bool = Field(
        default=True,
        description="Whether to fit a power law; refused where rays cross too often for one image.",
    )
    taper: float = Field(
        default=0.125,
        gt=0,
        le=0.5,
        description="Share of the shorter side over which the window rises, at each end.",
    )
    phantoms: int = Field(
        default=2,
        ge=0,
        le=50,
        description="Number of random fields on which the response of the inversion is measured. "
        "0: no correction.",
    )
    phantom_seed: int = Field(
        default=0, ge=0, title="Seed of the phantoms", description="Seed of the random fields."
    )
    noise_power: tuple[float, ...] = Field(
        default=(),
        title="Power of the noise",
        description="Mean ring-summed power by noise. Default: measured.",
        json_schema_extra={"hidden": True},
    )
    response: tuple[float, ...] = Field(
        default=(),
        description="Retrieved over true power of each ring. Default: measured.",
        json_schema_extra={"hidden": True},
    )
    response_spread: tuple[float, ...] = Field(
        default=(),
        title="Spread of the response",
        description="Standard error of the response. Default: measured.",
        json_schema_extra={"hidden": True},
    )
    rings: tuple[int, int] | None = Field(
        default=None,
        description="First and last ring of the trusted range. Default: measured.",
        json_schema_extra={"hidden": True},
    )
    resolution: float = Field(
        default=0.0,
        ge=0,
        title="Resolution (px)",
        description="Spacing of the sites in px; 0 without sites. Default: that of the inversion.",
        json_schema_extra={"hidden": True},
    )

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        longest, shortest = self.longest, self.shortest
        if longest is not None and shortest is not None and longest <= shortest:
            raise CombinationError(
                f"{{longest}} is {longest:g} px and {{shortest}} {shortest:g} px, "
                "expected the longest wavelength to be the longer one"
            )
        if self.correlation_length is not None and self.path_length is None:
            raise CombinationError(
                "{correlation_length} is set without {path_length}, expected both for a r.m.s. "
                "field"
            )
        return self

    def check(self, frame: FieldFrame) -> None:
        super().check(frame)
        if self.path_length is not None and frame.unit.field not in _ENERGY_FACTORS:
            raise InputError(
                "a path length is set, but an energy spectrum is defined for a magnetic or "
                "electric field or a density only, and the field is in "
                f"{frame.unit.symbol}: choose another unit, or no path length"
            )
        window_weights(frame.mask, self.taper)

    def adapt(self, potential: FloatArray, noise: FieldNoise | None, frame: FieldFrame) -> Self:
        weights = window_weights(frame.mask, self.taper)
        spectrum = ring_spectrum(potential, weights)
        changes: dict[str, object] = {}
        if noise is not None and not self.noise_power and len(noise.potentials):
            draws = [ring_spectrum(change, weights).power for change in noise.potentials]
            changes["noise_power"] = tuple(map(float, np.mean(draws, axis=0)))
        if noise is not None and noise.spacing and not self.resolution:
            changes["resolution"] = float(noise.spacing)
        product = self.model_copy(update=changes)
        is_inversion, phantom_contrast = product.resolution > 0, 0.0
        if self.phantoms and is_inversion and not self.response:
            less_noise = RingSpectrum(spectrum.k, product._correct(spectrum).signal, spectrum.modes)
            response = measure_response(
                less_noise,
                weights,
                _with_sites(round(potential.size / product.resolution**2), noise),
                phantoms=self.phantoms,
                seed=self.phantom_seed,
                report=Reporter() if noise is None else noise.report,
            )
            phantom_contrast = response.contrast
            changes["response"] = tuple(map(float, response.ratio))
            changes["response_spread"] = tuple(map(float, response.spread))
            product = self.model_copy(update=changes)
        contrast = max(product._correct(spectrum).contrast, phantom_contrast)
        most = self.limits.contrast if product.response else self.limits.raw_contrast
        if self.slope and is_inversion:
            _check_contrast(contrast, most)
        trusted = np.flatnonzero(product._correct(spectrum).trusted) + 1
        ends = (int(trusted[0]), int(trusted[-1])) if len(trusted) else (0, 0)
        product = product.model_copy(update={"rings": ends})
        if self.slope:
            _check_rings(int(product._range(spectrum).sum()), product.resolution)
        return product

    def _correct(self, spectrum: RingSpectrum) -> CorrectedSpectrum:
        return CorrectedSpectrum(
            spectrum,
            noise=np.array(self.noise_power),
            response=np.array(self.response),
            spread=np.array(self.response_spread),
            resolution=self.resolution,
            limits=self.limits,
        )

    def _range(self, spectrum: RingSpectrum) -> BoolArray:
        assert self.rings is not None  # by `adapt`
        return spectrum.rings_between(self.rings, self.longest, self.shortest)

    def variables(self, frame: FieldFrame) -> dict[str, Measurand]:
        dims, unit, name = ("k",), frame.si_unit, frame.long_name.lower()
        length = frame.length_unit
        squared = f"({unit})²"
        variables = {
            "power": Measurand(dims, f"{squared} {length}", f"Ring-summed spectrum P(k), {name}"),
            "density": Measurand(
                dims, f"{squared} {length}²", f"Ring-averaged density P(k)/2πk, {name}"
            ),
            "trusted": Measurand(dims, "1", "Whether the ring is in the range of the slope"),
            "rms": Measurand((), unit, f"{frame.long_name}, r.m.s. in the range"),
            "contrast": Measurand((), "1", "Contrast, r.m.s. divergence of the displacement"),
            "correlation_length": Measurand(
                (), length, "Correlation length in the range, (π/2) ∫E/k dk / ∫E dk"
            ),
        }
        if self.noise_power:
            variables["noise"] = Measurand(
                dims, f"{squared} {length}", "Ring-summed spectrum of the noise"
            )
        if self.response:
            variables["ratio"] = Measurand(
                dims, "1", "Response of the inversion, retrieved over true power"
            )
        if self.slope:
            variables["slope_power"] = Measurand((), "1", "Slope of the ring-summed spectrum P(k)")
            variables["slope"] = Measurand((), "1", "Slope of the energy spectrum E(k) ∝ k P(k)")
        if self.path_length is not None:
            symbol, title = _SYMBOLS[frame.unit.field]
            variables["energy"] = Measurand(
                dims, f"({symbol})² {length}", f"{title}, energy spectrum E(k)"
            )
            variables["rms_field"] = Measurand(
                (), symbol, f"{title}, r.m.s., by ∫E dk over the path length"
            )
            variables["rms_by_correlation"] = Measurand(
                (), symbol, f"{title}, r.m.s., by path and correlation length"
            )
        return variables

    def coordinates(self, frame: FieldFrame) -> dict[str, Coordinate]:
        k = _without_power(frame, self.taper).k
        unit = "rad/m" if frame.setup is not None else f"rad/{PIXEL}"
        return {"k": Coordinate(k / frame.pixel, unit, "Wavenumber k = 2π / wavelength")}

    def measure(self, potential: FloatArray, displacement: FloatArray, frame: FieldFrame) -> Values:
        spectrum = ring_spectrum(potential, window_weights(frame.mask, self.taper))
        return self._measure(spectrum, frame)

    def _measure(self, spectrum: RingSpectrum, frame: FieldFrame) -> Values:
        rings = self._range(spectrum)
        k, width = spectrum.k / frame.pixel, spectrum.width / frame.pixel
        corrected = self._correct(spectrum)
        power = _in_si(spectrum, corrected.power, frame)
        total = max(float(power[rings].sum()) * width, 0.0)
        weighted = max(float((k * power)[rings].sum()) * width, 0.0)
        correlation = math.pi / 2 * total / weighted if weighted else math.nan
        values = {
            "power": power,
            "density": power / (2 * np.pi * k),
            "trusted": rings.astype(np.float64),
            "rms": np.asarray(math.sqrt(total)),
            "contrast": np.asarray(corrected.contrast),
            "correlation_length": np.asarray(correlation),
        }
        if self.slope:
            exponent = fit_exponent(k[rings], power[rings], spectrum.modes[rings])
            values["slope_power"] = np.asarray(exponent)
            values["slope"] = np.asarray(exponent + 1)
        if self.path_length is not None:
            length = self.correlation_length or correlation
            field, path = frame.unit.field, self.path_length
            values["energy"] = k * power / (_ENERGY_FACTORS[field] * path)
            values |= _rms_fields(field, path, length, total, weighted)
        return values

    def constants(self, frame: FieldFrame) -> Values:
        constants = {}
        if self.noise_power:
            noise_power = np.array(self.noise_power)
            constants["noise"] = _in_si(_without_power(frame, self.taper), noise_power, frame)
        if self.response:
            constants["ratio"] = np.array(self.response)
        return constants

    def systematic(
        self, potential: FloatArray, displacement: FloatArray, frame: FieldFrame
    ) -> Values:
        """Return the errors by the finite number of structures in the window, and the response."""
        weights = window_weights(frame.mask, self.taper)
        spectrum = ring_spectrum(potential, weights)
        values, rings = self._measure(spectrum, frame), self._range(spectrum)
        share = 1 / np.sqrt(spectrum.modes)
        if self.response_spread:
            share = np.hypot(share, np.array(self.response_spread))
        of_rings = (name for name in ("power", "density", "energy") if name in values)
        errors: Values = {name: np.abs(values[name]) * share for name in of_rings}
        power = values["power"][rings]
        for name, order in (("rms", 0), ("rms_field", 1), ("rms_by_correlation", 0)):
            if name in values and power.sum() > 0:
                part = spectrum.k[rings] ** order * power
                relative = np.linalg.norm(part * share[rings]) / part.sum() / 2
                errors[name] = np.abs(values[name]) * relative
        if self.slope:
            error = np.asarray(_slope_error(potential, self._correct(spectrum), rings, frame.mask))
            errors |= {"slope": error, "slope_power": error}
        return errors

    def facts(self, quantities: Mapping[str, Quantity], frame: FieldFrame) -> Iterator[Fact]:
        arrays = {name for name, each in self.variables(frame).items() if each.dims}
        yield from (fact for fact in super().facts(quantities, frame) if fact.key not in arrays)
        rings = np.flatnonzero(quantities["trusted"].value)
        k = self.coordinates(frame)["k"]
        if len(rings):
            text_of = "{:.3g} px".format if frame.setup is None else length_text
            low, high = (text_of(float(length)) for length in 2 * np.pi / k.values[rings[[-1, 0]]])
            yield Fact("range", "Trusted range", f"wavelengths of {low} to {high}")
        else:
            yield Fact("range", "Trusted range", "none", Level.DOUBTFUL)

    def cautions(self, quantities: Mapping[str, Quantity], frame: FieldFrame) -> Iterator[Caution]:
        contrast, most = float(quantities["contrast"].value), self.limits.contrast
        if contrast > most and self.resolution:
            yield Caution(
                "folds",
                f"the contrast is {to_figures(contrast)}, above {most:g}: rays cross so "
                "often that the spectrum of one image is too weak, and its slope wrong; fit "
                "several images",
            )
        if self.resolution and not self.response:
            yield Caution(
                "accuracy",
                "the loss of small structures by the inversion is not corrected, which makes a "
                "spectrum too steep; choose one phantom or more",
            )

    def remarks(self, frame: FieldFrame) -> Iterator[str]:
        yield (
            "P(k) is summed over rings, so that its integral over k is the mean square; the "
            "density is averaged over rings, and its slope is less by one."
        )
        if self.path_length is not None:
            yield (
                f"E(k) assumes isotropic, homogeneous turbulence over a path of "
                f"{1e3 * self.path_length:.4g} mm, much longer than its correlation length; the "
                "r.m.s. field is that of the trusted range."
            )
        yield (
            "Bands of slope and r.m.s. field hold the scatter between parts of the image, as the "
            "window has a finite number of structures."
        )


def _with_sites(count: int, noise: FieldNoise | None) -> InversionOptions:
    """Return options by which phantoms are inverted with as many sites as the field."""
    if noise is not None and noise.of_pixels:
        # An accuracy out of reach leads to a site in each pixel.
        return InversionOptions(noise_level=1e-3, accuracy=1e-9)
    return InversionOptions(noise_level=1e-3, n_sites=max(count, 16))


def _without_power(frame: FieldFrame, taper: float) -> RingSpectrum:
    """Return the rings of the window, without power."""
    return ring_spectrum(np.zeros(frame.shape), window_weights(frame.mask, taper))


def _check_contrast(contrast: float, most: float) -> None:
    """Refuse a slope from an image in which rays cross too often."""
    if contrast > most:
        raise InputError(
            f"the contrast of the image is {to_figures(contrast)}, expected at most {most:g} "
            "for a slope from one image: rays cross so often that the inversion returns a "
            "false one; fit several images, or ask for the spectrum without a slope"
        )


def _check_rings(count: int, resolution: float) -> None:
    if count < MIN_RINGS:
        raise InputError(
            f"the range has {count} trusted rings of wavenumbers, expected at least "
            f"{MIN_RINGS} for a slope: noise, a spacing of the sites of "
            f"{to_figures(resolution)} px and crossed rays end the range; ask for the "
            "spectrum without a slope"
        )


def _rms_fields(
    field: str, path: float, length: float, total: float, weighted: float
) -> dict[str, FloatArray]:
    """Return the r.m.s. field by its spectrum, and by a correlation length.

    `total` and `weighted` are the integrals of the power and of k times it; ⟨B²⟩ = ⟨|b|²⟩ / (l_z ℓ)
    is the same with the correlation length of the spectrum.
    """
    factor = _RMS_FACTORS[field] / (_ENERGY_FACTORS[field] * path)
    by_length = factor * math.pi / 2 * total / length
    return {
        "rms_field": np.asarray(math.sqrt(factor * weighted)),
        "rms_by_correlation": np.asarray(math.sqrt(by_length) if by_length >= 0 else math.nan),
    }


def _in_si(spectrum: RingSpectrum, power: FloatArray, frame: FieldFrame) -> FloatArray:
    """Convert the power of the displacement, for rad/px, to the field's, for rad/m."""
    # The field by a displacement of 1 px; of a plane, by a potential of 1 px · m instead.
    scale = float(np.abs(frame.field(np.ones(1), np.ones((2, 1)))).max())
    if frame.unit.field not in _PLANES:
        return np.asarray(scale**2 * frame.pixel * power)
    in_si = (scale / frame.pixel) ** 2 * frame.pixel * power
    return np.asarray(in_si / (spectrum.k / frame.pixel) ** 2)


def _slope_error(
    potential: FloatArray,
    corrected: CorrectedSpectrum,
    rings: BoolArray,
    mask: BoolArray,
    parts: int = 3,
) -> float:
    """Return the standard error of the slope, by its scatter over parts of 64 px or more."""
    spectrum = corrected.rings
    k_range = spectrum.k[rings][[0, -1]]
    size = [count // 2 for count in potential.shape]
    slopes, modes = [], 0.0
    steps = [np.linspace(0, count - side, parts).astype(int)
             for count, side in zip(potential.shape, size, strict=True)]  # fmt: skip
    for row, column in itertools.product(*steps):
        part = np.s_[row : row + size[0], column : column + size[1]]
        if min(size) < 64 or not mask[part].all():
            continue
        window = ring_spectrum(potential[part], window_weights(mask[part], 0.5))
        inside = (window.k >= k_range[0]) & (window.k <= k_range[1])
        inside[: corrected.limits.first - 1] = False
        if inside.sum() < MIN_RINGS:
            continue
        power = corrected.power_in(window)
        slopes.append(fit_exponent(window.k[inside], power[inside], window.modes[inside]))
        modes = float(window.modes[inside].sum())
    # Of an exponent by maximum likelihood, for Gaussian modes
    logarithm, weights = np.log(spectrum.k[rings]), spectrum.modes[rings]
    mean = np.average(logarithm, weights=weights)
    expected = float(1 / np.sqrt(np.sum(weights * (logarithm - mean) ** 2)))
    if len(slopes) < parts:
        return expected
    # The parts hold fewer modes than the window as a whole.
    ratio = modes / float(weights.sum())
    return max(float(np.std(slopes, ddof=1)) * math.sqrt(ratio), expected)


def _longest_run(rings: BoolArray) -> BoolArray:
    runs, count = label(rings)
    longest = 1 + int(np.bincount(runs)[1:].argmax()) if count else -1
    return np.asarray(runs == longest)
