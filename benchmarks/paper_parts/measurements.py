"""What the page reports: the sweep over strengths, other structures, a plasma wave."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter
from scipy.optimize import brentq

from napari_shadowinv import Inversion, OpticalSetup, poisson_invert, synthetic_image
from napari_shadowinv.physics import phantoms
from napari_shadowinv.physics.forward import jacobian_determinant
from paper_parts.shots import (
    SETUP,
    SHAPE,
    BoolArray,
    FloatArray,
    field_of,
    noisy,
    retrieved,
    rms,
    seconds_of,
    toroid_truth,
)
from reference import errors

N_NOISES = 5
SWEEP = (10, 17, 24, 30, 40, 60, 80, 97, 120, 145, 170, 194, 217, 240, 265, 290, 315, 340)
PLASMA_SHAPE = (240, 400)
PLASMA_NOISE = 0.02
NOT_DRAWN = "–"


@dataclass(frozen=True)
class SweepRow:
    """Errors of one toroid in per cent, (peak, L2), and the seconds of a noisy image.

    Of the noisy images the mean of the errors, and the range of those of the peak.
    """

    peak: float
    noisy: tuple[float, float]
    noisy_range: tuple[float, float]
    clean: tuple[float, float]
    linear: tuple[float, float]
    seconds: float
    converged: bool


def sweep() -> list[SweepRow]:
    return [sweep_row(float(peak)) for peak in SWEEP]


def sweep_row(peak: float) -> SweepRow:
    truth = toroid_truth(peak)
    image = synthetic_image(truth)
    clean = retrieved(image)
    shots = [retrieved(noisy(image, seed=1000 * k + round(peak))) for k in range(N_NOISES)]
    found = np.array([errors(shot.displacement, truth) for shot in shots])
    linear = -np.array(np.gradient(poisson_invert(image)))
    return SweepRow(
        peak,
        noisy=(float(found[:, 0].mean()), float(found[:, 1].mean())),
        noisy_range=(float(found[:, 0].min()), float(found[:, 0].max())),
        clean=errors(clean.displacement, truth),
        linear=errors(linear, truth),
        seconds=float(np.median([seconds_of(shot) for shot in shots])),
        converged=all(shot.report.converged for shot in [clean, *shots]),
    )


def caustic_onset() -> float:
    """Peak in MG µm beyond which the map of the toroid folds."""
    at_one = toroid_truth(1.0)
    return float(brentq(lambda peak: jacobian_determinant(peak * at_one).min(), 100, 250))


def range_of_accuracy(rows: list[SweepRow], kind: str, limit: float = 10.0) -> float:
    """Peak where the error grows beyond the limit for good, interpolated; inf if nowhere."""
    peaks = [row.peak for row in rows]
    size = [abs(getattr(row, kind)[0]) for row in rows]
    within = [k for k, value in enumerate(size) if value <= limit]
    if not within:
        return 0.0
    k = within[-1]
    if k == len(rows) - 1:
        return float("inf")
    share = (limit - size[k]) / (size[k + 1] - size[k])
    return peaks[k] + share * (peaks[k + 1] - peaks[k])


@dataclass(frozen=True)
class Structure:
    """An object of the paper's Fig. 6 and what was retrieved of it."""

    letter: str
    name: str
    truth: FloatArray
    image: FloatArray
    inversion: Inversion
    open_pixels: BoolArray
    row: int

    @property
    def peak_error(self) -> float:
        """Error of the largest field among the pixels that the beam passes, in per cent."""
        found = field_of(self.inversion.displacement)[self.open_pixels].max()
        return 100 * float(found / field_of(self.truth)[self.open_pixels].max() - 1)

    @property
    def l2_error(self) -> float:
        """L2 error of the displacement in per cent, over the same pixels."""
        difference = (self.inversion.displacement - self.truth)[:, self.open_pixels]
        return 100 * float(
            np.linalg.norm(difference) / np.linalg.norm(self.truth[:, self.open_pixels])
        )

    @property
    def correlation(self) -> float:
        """Correlation of the retrieved with the true cross-section."""
        seen = self.open_pixels[self.row]
        found = field_of(self.inversion.displacement)[self.row, seen]
        return float(np.corrcoef(found, field_of(self.truth)[self.row, seen])[0, 1])

    @property
    def image_difference(self) -> float:
        """Root mean square of re-projection minus image where used, in per cent of the mean."""
        used = self.inversion.mask
        return 100 * rms(self.inversion.residual[used]) / float(self.inversion.source[used].mean())


def structures() -> list[Structure]:
    scenes: tuple[tuple[str, Callable[..., phantoms.Phantom], float], ...] = (
        ("four toroids", phantoms.four_toroids, 0.67),
        ("two cos² ellipses", phantoms.cosine_ellipses, 0.37),
        ("two focusing ellipses", phantoms.focusing_pair, 0.5),
        ("opposite directions", phantoms.opposite_pair, 0.5),
    )
    found = []
    for letter, (name, scene, share) in zip("abcd", scenes, strict=True):
        truth = scene(SHAPE, SETUP).displacement
        image = noisy(synthetic_image(truth), seed=ord(letter))
        everywhere = np.ones(SHAPE, dtype=bool)
        row = round(share * SHAPE[0])
        found.append(Structure(letter, name, truth, image, retrieved(image), everywhere, row))
    return [*found, *coaxial_structures()]


def coaxial_structures() -> list[Structure]:
    """The coaxial line, its shadow ignored, or put into the source."""
    phantom, obstructed = phantoms.coaxial_line(SHAPE, SETUP)
    shadow = np.where(obstructed, 0.0, 1.0)
    clean = synthetic_image(phantom.displacement, shadow)
    image = noisy(clean, seed=ord("e"))
    uniform, seen = np.ones(SHAPE), ~obstructed
    cases = (
        ("e", "coaxial line, uniform source, no mask", image, uniform, None),
        ("e′", "coaxial line, its shadow in the source", image, shadow, None),
        (NOT_DRAWN, "the same, noise-free", clean, shadow, None),
    )
    truth, row = phantom.displacement, SHAPE[0] // 2
    return [
        Structure(letter, name, truth, shot, retrieved(shot, source, mask), seen, row)
        for letter, name, shot, source, mask in cases
    ]


@dataclass(frozen=True)
class Wave:
    """Line-integrated modulation ∫Δn/n₀ dz in µm: true and retrieved."""

    image: FloatArray
    noisy_image: FloatArray
    true: FloatArray
    clean: FloatArray
    noisy: FloatArray
    filtered: FloatArray
    first_order_error: float
    seconds: float

    def axis_error(self, found: FloatArray) -> tuple[float, float]:
        """Largest and root mean square error along the axis, per cent of the true peak."""
        row = self.true.shape[0] // 2
        error = found[row] - self.true[row]
        scale = 100 / float(np.abs(self.true[row]).max())
        return scale * float(np.abs(error).max()), scale * rms(error)

    def peak_error(self, found: FloatArray) -> float:
        row = self.true.shape[0] // 2
        return 100 * float(np.abs(found[row]).max() / np.abs(self.true[row]).max() - 1)


def plasma_wave() -> Wave:
    setup = OpticalSetup.example()
    density = 1.65e25
    phantom = phantoms.wakefield(PLASMA_SHAPE, setup, density=density)
    image = synthetic_image(phantom.displacement)
    with_noise = noisy(image, seed=810, share=PLASMA_NOISE)

    def modulation(potential: FloatArray) -> FloatArray:
        return setup.relative_density_modulation(potential, density) * 1e6

    of_noisy = retrieved(with_noise)
    noisy_modulation = modulation(of_noisy.potential)
    # As in the paper: slow variations are the noise's, the wave is fast.
    scale = phantoms.plasma_wavelength(density) / setup.object_pixel_size
    return Wave(
        image,
        with_noise,
        modulation(phantom.potential),
        modulation(retrieved(image).potential),
        noisy_modulation,
        noisy_modulation - gaussian_filter(noisy_modulation, scale, mode="nearest"),
        100 * density / setup.critical_density,
        seconds_of(of_noisy),
    )
