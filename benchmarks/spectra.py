"""Slopes and r.m.s. fields of turbulence from one image: two tables, printed as Markdown.

    python benchmarks/spectra.py [--size 400] [--seeds 1] [--coverage-seeds 20]

Random fields with the line integrals of solenoidal turbulence, E(k) ∝ kˢ between 5 and 0.09 times
as many waves in the image as it has pixels, with 250 counts a pixel. Light crosses the edges of the
image, as the field goes on beyond them.

Accuracy: slope and B_rms against the same numbers of the true field in the same window (what noise
and inversion change), and the slope against the exponent that the field was made with (which the
finite number of waves changes, too).
Coverage: how often the band of 68 % holds that exponent and that B_rms.
"""

from __future__ import annotations

import argparse
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from napari_shadowinv import ProtonSetup, invert, synthetic_image
from napari_shadowinv.analysis import analyse
from napari_shadowinv.analysis.power_spectra import (
    fit_exponent,
    random_displacement,
    ring_spectrum,
    window_weights,
)
from napari_shadowinv.analysis.spectra import TurbulenceSpectrum
from napari_shadowinv.inversion import Inversion

COUNTS = 250.0
PATH_M = 1e-3
TAPER = 0.125
SLOPES = {"−5/3": -5 / 3, "−2": -2.0, "−11/3": -11 / 3}
CONTRASTS = (0.2, 0.5, 0.8)
SETUP = ProtonSetup(
    energy=14.7, source_object_distance=1e-2, object_image_distance=0.3, pixel_size=5e-6
)

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Turbulence:
    """A random field in an image: its potential in px², and B_rms of its range in T."""

    image: Array
    potential: Array
    slope: float
    amplitude: float  # of the ring-averaged density of the displacement
    size: int

    @property
    def ends(self) -> tuple[float, float]:
        """Waves in the image at the ends of the range in which the slope is fitted."""
        return 6.5, 0.09 * self.size - 2.5

    @classmethod
    def of(cls, size: int, slope: float, contrast: float, seed: int) -> Turbulence:
        unit, whole = 2 * math.pi / size, int(1.3 * size)

        def density(k: Array) -> Array:
            is_inside = (k > 4.5 * unit) & (k < (0.09 * size + 0.5) * unit)
            return np.where(is_inside, (k / unit) ** (slope - 2), 0.0)

        # The ring-summed power of the divergence, with E ∝ k P.
        at = np.linspace(4.5, 0.09 * size + 0.5, 2000) * unit
        divergence = np.trapezoid(2 * np.pi * at**3 * (at / unit) ** (slope - 2), at)
        amplitude = contrast**2 / float(divergence)
        potential, displacement = random_displacement(
            lambda k: amplitude * density(k), (whole, whole), np.random.default_rng(seed)
        )
        inner = slice((whole - size) // 2, (whole - size) // 2 + size)
        image = COUNTS * synthetic_image(displacement)[inner, inner]
        counts = np.random.default_rng(seed + 1000).poisson(image).astype(np.float64)
        return cls(counts, potential[inner, inner], slope, amplitude, size)

    def invert(self) -> Inversion:
        return invert(self.image, source=np.full(self.image.shape, COUNTS))

    def product(self, phantoms: int = 2) -> TurbulenceSpectrum:
        longest, shortest = (self.size / waves for waves in self.ends)
        return TurbulenceSpectrum(
            path_length=PATH_M, longest=longest, shortest=shortest, taper=TAPER, phantoms=phantoms
        )

    def numbers_in_window(self) -> tuple[float, float]:
        """Slope and B_rms of the true field, by the same window."""
        spectrum = ring_spectrum(
            self.potential, window_weights(np.ones_like(self.image) > 0, TAPER)
        )
        unit = 2 * math.pi / self.size
        rings = (spectrum.k >= self.ends[0] * unit) & (spectrum.k <= self.ends[1] * unit)
        k, power = spectrum.k[rings], spectrum.power[rings]
        slope = fit_exponent(k, k * power, spectrum.modes[rings])
        return slope, self._b_rms(float(np.sum(k * power)) * spectrum.width)

    def designed_b_rms(self) -> float:
        """B_rms by the spectrum that the field was made with, in the rings of the range."""
        unit = 2 * math.pi / self.size
        first, last = math.ceil(self.ends[0]), math.floor(self.ends[1])
        k = np.arange(first, last + 1) * unit
        power = 2 * math.pi * k * self.amplitude * (k / unit) ** (self.slope - 2)
        return self._b_rms(float(np.sum(k * power)) * unit)

    def _b_rms(self, weighted: float) -> float:
        """⟨B²⟩ = 2 ∫E dk = 2/(π l_z) ∫ k P dk, with b in T m and k in rad/m."""
        field = float(np.abs(SETUP.path_integrated_b(np.ones((2, 1)))).max())
        return field * math.sqrt(2 * weighted / (math.pi * PATH_M * SETUP.object_pixel_size))


def accuracy_row(size: int, name: str, contrast: float, seed: int) -> str:
    field = Turbulence.of(size, SLOPES[name], contrast, seed)
    inversion = field.invert()
    (raw,) = analyse(inversion, field.product(0).model_copy(update={"slope": False}),
                     setup=SETUP, samples=20)  # fmt: skip
    (result,) = analyse(inversion, field.product(), setup=SETUP, samples=20)
    slope, b_rms = field.numbers_in_window()
    value = float(result["slope"].value)
    ratio = float(result["rms_field"].value) / b_rms - 1
    uncorrected = float(raw["rms_field"].value) / b_rms - 1
    low, high = result.band("slope") or (math.nan, math.nan)
    return (
        f"| {name} | {contrast} | {value:.2f} | {value - slope:+.3f} | {value - field.slope:+.3f} "
        f"| {(high - low) / 2:.3f} | {100 * ratio:+.1f} | {100 * uncorrected:+.1f} |"
    )


def coverage_row(size: int, name: str, contrast: float, seeds: int) -> str:
    inside = {"slope": 0, "rms_field": 0}
    for seed in range(seeds):
        field = Turbulence.of(size, SLOPES[name], contrast, seed)
        (result,) = analyse(field.invert(), field.product(1), setup=SETUP, samples=40)
        truth = {"slope": field.slope, "rms_field": field.designed_b_rms()}
        for number, value in truth.items():
            low, high = result.band(number) or (math.nan, math.nan)
            inside[number] += bool(low < value < high)
    shares = " | ".join(f"{100 * count / seeds:.0f}" for count in inside.values())
    return f"| {name} | {contrast} | {size} | {shares} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--size", type=int, default=400)
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--coverage-seeds", type=int, default=20)
    parser.add_argument("--coverage-size", type=int, default=200)
    arguments = parser.parse_args()
    print("| E(k) | contrast | slope | less that of the window | less the exponent | band, ± "
          "| B_rms, % | without correction, % |")  # fmt: skip
    print("|---|---|---|---|---|---|---|---|")
    for seed in range(arguments.seeds):
        for name in SLOPES:
            for contrast in CONTRASTS:
                print(accuracy_row(arguments.size, name, contrast, seed), flush=True)
    print("\n| E(k) | contrast | size, px | band holds the slope, % | B_rms, % |")
    print("|---|---|---|---|---|")
    for name in ("−5/3", "−11/3") if arguments.coverage_seeds else ():
        print(
            coverage_row(arguments.coverage_size, name, 0.3, arguments.coverage_seeds), flush=True
        )


if __name__ == "__main__":
    main()
