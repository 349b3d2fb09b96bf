"""Power spectra of a field in a window, and their power laws.

- weights of a window without masked pixels: `window_weights`
- the spectrum of the displacement: `RingSpectrum`, `ring_spectrum`
- the exponent of a power law: `fit_exponent`
- random displacements with a spectrum: `random_displacement`
- how an inversion changes the spectrum: `measure_response`

Wavenumbers k are angular, in rad/px. Of the displacement d two spectra are in use, which differ by
a factor 2πk, and their exponents by one: the *ring-summed* P(k), with ∫P dk = ⟨|d|²⟩, and the
*ring-averaged* density P(k)/2πk, with ∫∫ P/2πk dk_x dk_y = ⟨|d|²⟩. Here P is ring-summed unless it
is called a density.

The spectrum of the Laplacian of the potential is divided by the operator's spectrum. The
Laplacian is nearly white where the displacement has a steep spectrum, so that less power leaks from
large structures to small ones at the edge of the window.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import distance_transform_edt
from scipy.optimize import minimize_scalar

from napari_shadowinv._system.progress import Reporter
from napari_shadowinv._typing import BoolArray, FloatArray
from napari_shadowinv.errors import InputError
from napari_shadowinv.inversion import invert
from napari_shadowinv.options import InversionOptions
from napari_shadowinv.physics.forward import synthetic_image

MIN_RINGS = 4  # for a slope


def window_weights(mask: BoolArray, taper: float = 0.05) -> FloatArray:
    """Return weights, (H, W), that rise from 0 at the border and at masked pixels to 1.

    The taper is the share of the shorter side, at each end, over which they rise as a squared sine.
    An `InputError` if the image is smaller than 32 px, or the masked pixels leave nothing.
    """
    side = min(mask.shape)
    if side < 32:
        raise InputError(
            f"the image has {mask.shape[0]} × {mask.shape[1]} px, expected at least 32 px each way "
            "for a spectrum"
        )
    width = max(taper * side, 1.0)
    weights = np.ones(mask.shape)
    for axis, count in enumerate(mask.shape):
        places = np.arange(count) + 0.5
        rise = _rise(np.minimum(places, count - places) / width)
        weights *= rise[:, None] if axis == 0 else rise
    if not mask.all():
        weights *= _rise((distance_transform_edt(mask) - 0.5) / width)
    if not (weights > 0.5).any():
        raise InputError(
            f"masked pixels leave no region as wide as {2 * width:.0f} px, expected a wider one or "
            "a smaller taper"
        )
    return weights


def _rise(share: FloatArray) -> FloatArray:
    return np.asarray(np.sin(np.pi / 2 * np.clip(share, 0.0, 1.0)) ** 2)


@dataclass(frozen=True, eq=False)
class RingSpectrum:
    """Power of the displacement in rings of wavenumbers, shape (n,) each."""

    k: FloatArray  # wavenumbers of the rings, rad/px, multiples of their width
    power: FloatArray  # ring-summed spectrum P, px² for each rad/px
    modes: FloatArray  # independent ones in each ring: fewer than of the grid, by the window

    @property
    def width(self) -> float:
        """Width of a ring in rad/px."""
        return float(self.k[0])

    def rings_between(
        self, ends: tuple[int, int], longest: float | None, shortest: float | None
    ) -> BoolArray:
        """Return the rings from a first to a last one, within wavelengths in px if set."""
        number = np.arange(1, len(self.k) + 1)
        rings = (number >= ends[0]) & (number <= ends[1])
        if longest is not None:
            rings &= self.k >= 2 * np.pi / longest * (1 - 1e-9)
        if shortest is not None:
            rings &= self.k <= 2 * np.pi / shortest * (1 + 1e-9)
        return np.asarray(rings)


def ring_spectrum(potential: FloatArray, weights: FloatArray) -> RingSpectrum:
    """Return the spectrum of the displacement d = -∇φ, φ in px², in a window of weights, (H, W).

    It goes from one wavelength in the shorter side up to 0.9 of the Nyquist frequency.
    """
    plane = np.pad(potential, 1, mode="edge")
    curvature = plane[2:, 1:-1] + plane[:-2, 1:-1] + plane[1:-1, 2:] + plane[1:-1, :-2]
    curvature = curvature - 4 * potential
    norm = float((weights**2).sum())
    mean = float((weights * curvature).sum() / weights.sum())
    modes = np.abs(np.fft.fft2(weights * (curvature - mean))) ** 2 / (norm * potential.size)
    k_y, k_x = (2 * np.pi * np.fft.fftfreq(count) for count in potential.shape)
    k = np.hypot(k_y[:, None], k_x)
    operator = 4 - 2 * np.cos(k_y)[:, None] - 2 * np.cos(k_x)
    operator[0, 0] = 1.0
    of_displacement = modes * k**2 / operator**2
    width = 2 * np.pi / min(potential.shape)
    count = int(0.9 * np.pi / width)
    rings = np.minimum(np.rint(k / width).astype(np.int64), count + 1).ravel()
    size = count + 2
    summed = np.bincount(rings, of_displacement.ravel(), size)[1 : count + 1]
    number = np.bincount(rings, minlength=size)[1 : count + 1]
    # Half of the modes repeat the others, and a window correlates neighbours.
    share = norm**2 / (float((weights**4).sum()) * weights.size)
    at = width * np.arange(1, count + 1)
    # The mean over the modes of a ring, times its exact area, is smoother than their sum.
    power = summed / number * (2 * np.pi * at) * weights.size / (2 * np.pi) ** 2
    return RingSpectrum(at, power, number / 2 * share)


def fit_exponent(
    k: FloatArray, power: FloatArray, modes: FloatArray, bounds: tuple[float, float] = (-12.0, 6.0)
) -> float:
    """Return the exponent of a power law P = A kᵖ, by maximum likelihood.

    The power of each mode is distributed exponentially about its mean (Whittle's likelihood), so
    that rings count by their modes, and a ring with little power does not dominate as it would in a
    fit of logarithms. An `InputError` refuses fewer than 4 rings.

    Examples
    --------
    >>> k = np.arange(1.0, 9.0)
    >>> round(fit_exponent(k, 3 * k**-2.5, np.ones(8)), 3)
    -2.5
    """
    if len(k) < MIN_RINGS:
        raise InputError(
            f"the range of wavenumbers holds {len(k)} rings, expected at least {MIN_RINGS} for a "
            "slope: widen it"
        )
    centre = float(np.exp(np.average(np.log(k), weights=modes)))
    ratio, share = k / centre, modes / modes.sum()

    def amplitude(exponent: float) -> float:
        return max(float(np.sum(share * power * ratio**-exponent)), 1e-300)

    best = minimize_scalar(
        lambda exponent: np.log(amplitude(exponent)) + exponent * np.sum(share * np.log(ratio)),
        bounds=bounds,
        method="bounded",
        options={"xatol": 1e-6},
    )
    return float(best.x)


def random_displacement(
    density: Callable[[FloatArray], FloatArray], shape: tuple[int, int], rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Return potential and displacement of a Gaussian random field, periodic in its shape.

    Its density is the ring-averaged spectrum of the displacement at wavenumbers in rad/px, in px²
    for each (rad/px)².
    """
    k_y, k_x = (2 * np.pi * np.fft.fftfreq(count) for count in shape)
    k = np.hypot(k_y[:, None], k_x)
    k[0, 0] = np.inf
    size = float(np.prod(shape))
    finite = np.isfinite(k)
    of_mode = np.zeros(shape)
    of_mode[finite] = np.maximum(density(k[finite]), 0.0) * (2 * np.pi) ** 2 / size
    noise = np.fft.fft2(rng.normal(size=shape)) * np.sqrt(size)
    waves = noise * np.sqrt(of_mode) / k
    potential = np.fft.ifft2(waves).real
    # Of an even side the highest frequency has no derivative.
    slopes = [np.where(np.abs(each) < np.pi, each, 0.0) for each in (k_y, k_x)]
    steps = (1j * slopes[0][:, None], 1j * slopes[1])
    displacement = -np.stack([np.fft.ifft2(waves * step).real for step in steps])
    return potential, displacement


@dataclass(frozen=True, eq=False)
class SpectralResponse:
    """Spectrum of an inversion relative to the field's, in the rings of a spectrum."""

    ratio: FloatArray  # (n,); retrieved over true power
    spread: FloatArray  # (n,); its logarithm's standard error, by the phantoms' scatter; 0 of one
    contrast: float  # r.m.s. divergence of the displacement of the phantoms


def measure_response(
    spectrum: RingSpectrum,
    weights: FloatArray,
    options: InversionOptions,
    *,
    phantoms: int,
    seed: int,
    report: Reporter,
    corrections: int = 2,
    least: float = 0.05,
) -> SpectralResponse:
    """Measure how an inversion changes a spectrum, on random fields with that spectrum.

    Rays cross, and small structures are lost, the more the stronger the field. Random fields are
    made with the measured spectrum, less its noise, imaged, inverted, and measured in the same
    window, (H, W). As the measured spectrum is too low where power is lost, it is corrected by the
    response of a first field, and again by a second one's, but by no response below `least`, before
    the response is measured on the phantoms. The reporter is called before each field.
    """
    ratio = np.ones(len(spectrum.k))
    spread, contrast = np.zeros(len(spectrum.k)), 0.0
    smooth = _mean_over_rings(spectrum.modes)
    total, done = corrections + phantoms, 0
    for count in (*(1,) * corrections, phantoms):
        # The same random numbers in each pass, so that the passes differ by the spectrum alone.
        rng = np.random.default_rng(seed)
        power = spectrum.power / np.maximum(ratio, least)
        pairs = []
        for _ in range(count):
            report("response", done, total)
            pairs.append(_phantom_spectra(spectrum.k, power, weights, options, rng, report))
            done += 1
        true = np.array([pair[0].power for pair in pairs])
        retrieved = np.array([pair[1].power for pair in pairs])
        contrast = float(np.mean([pair[2] for pair in pairs]))
        logarithms = np.log(np.maximum(retrieved, 1e-300) / np.maximum(true, 1e-300))
        smoothed = logarithms @ smooth.T
        ratio = np.exp(smoothed.mean(axis=0))
        if count > 1:
            spread = smoothed.std(axis=0, ddof=1) / count**0.5
            spread = np.sqrt(smooth @ spread**2)  # itself known from few phantoms
    return SpectralResponse(ratio, spread, contrast)


def _mean_over_rings(modes: FloatArray, share: float = 0.1) -> FloatArray:
    """Return the matrix of means over rings within a share of k, weighted by their modes."""
    numbers = np.arange(1, len(modes) + 1)
    reach = np.maximum(1.0, share * numbers)[:, None]
    smooth = np.where(np.abs(numbers[:, None] - numbers) <= reach, modes, 0.0)
    return np.asarray(smooth / smooth.sum(axis=1, keepdims=True))


def _phantom_spectra(
    k: FloatArray,
    power: FloatArray,
    weights: FloatArray,
    options: InversionOptions,
    rng: np.random.Generator,
    report: Reporter,
    margin: float = 0.15,  # around the random field, over the image's side
) -> tuple[RingSpectrum, RingSpectrum, float]:
    margins = [int(np.ceil(margin * count)) for count in weights.shape]
    height, width = (count + 2 * m for count, m in zip(weights.shape, margins, strict=True))
    inner = tuple(slice(width, -width) for width in margins)
    density = np.maximum(power, 0.0) / (2 * np.pi * k)  # none beyond the rings
    potential, displacement = random_displacement(
        lambda at: np.interp(at, k, density, right=0.0), (height, width), rng
    )
    image = synthetic_image(displacement)[inner]
    source = np.ones(weights.shape)
    inversion = invert(image, source=source, options=options, should_stop=report.should_stop)
    divergence = sum(np.gradient(part, axis=axis) for axis, part in enumerate(displacement))
    contrast = float(np.std(np.asarray(divergence)[inner]))
    true = ring_spectrum(potential[inner], weights)
    return true, ring_spectrum(inversion.potential, weights), contrast
