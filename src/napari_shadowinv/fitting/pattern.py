"""Structure in the residuals of a fit, and its likeliest cause: `Pattern`, `find_pattern`.

- tests of the residuals: `pattern_strength`, `correlation_length`, `blur_score`
- the noise of counts: `lack_of_noise`
- fits with one more unknown: the cause of a pattern, `name_cause`; missing blur, `gain_by_blur`
- the likelihood of a choice of fields: `log_evidence`

χ² hides structure: a beam that is 2 % wrong adds 0.1 to χ² at 5 % noise, spread over the whole
image, and bends the field by tens of per cent. Smoothed, the same residual stands out of white
noise by many standard deviations. Residuals are images minus models over the standard deviation of
the noise in each pixel.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from zlib import crc32

import numpy as np
from scipy.ndimage import gaussian_filter, laplace

from napari_shadowinv._system.machine import available_threads
from napari_shadowinv._system.progress import OnStep, run_in_parallel
from napari_shadowinv._typing import BoolArray, FloatArray
from napari_shadowinv.fitting.conjugate_gradients import SoftModes
from napari_shadowinv.fitting.forward import Scene
from napari_shadowinv.fitting.measurements import NoiseMatch, strengths_of
from napari_shadowinv.fitting.search import SMOOTHNESS_RATIO, Minimum, posterior_of, settle_minimum
from napari_shadowinv.fitting.unknowns import Unknowns
from napari_shadowinv.options import FitOptions
from napari_shadowinv.physics.setup import Setup

_WIDTHS_PX = (2.0, 4.0, 8.0)
_SMALLEST_VARIANCE = 1e-12  # of the noise
_DETAIL_PX, _MOSTLY_USED = 2.0, 0.9  # width of a Gaussian, and its share on used pixels
_NEAR_PX, _FAR_PX = 1, 4  # distances of the pixels that are compared
# White noise has a ratio of 1 ± 0.03 on 64 × 64 px; noise blurred by 0.4 px has 0.84.
_MAX_VARIANCE_RATIO = 0.85


def pattern_strength(residual: FloatArray, used: BoolArray, correlation: float = 0.0) -> float:
    """Return how far a smoothed residual stands out of smoothed noise of its own r.m.s.

    Parameters
    ----------
    residual : ndarray, shape (H, W)
        Image minus model over the standard deviation of the noise in each pixel.
    used : ndarray of bool, shape (H, W)
        The pixels that were fitted.
    correlation : float, default 0
        Standard deviation in px of the Gaussian that has blurred the noise; 0 for white noise.

    Returns
    -------
    float
        Power of the residual smoothed by Gaussians of 2, 4 and 8 px, minus the expected one, in
        standard deviations of that; the largest. White noise gives about 0 ± 1, and less where the
        model has absorbed part of it.
    """
    values = np.where(used, residual, 0.0)
    variance = float((values**2).sum() / max(used.sum(), 1))
    if variance < _SMALLEST_VARIANCE:
        return 0.0
    inside = used.astype(np.float64)
    pixels = inside.sum()
    strengths = []
    for width in _WIDTHS_PX:
        smooth = gaussian_filter(values, width, mode="constant")
        power = float((smooth[used] ** 2).sum()) / variance
        # The kernel's square is a Gaussian, too, narrower by √2.
        density = 1 / (4 * np.pi * width**2)
        near = gaussian_filter(inside, width / np.sqrt(2), mode="constant")
        # Power of correlated noise after the Gaussian over the power of white noise.
        squares = width**2 / (width**2 + correlation**2)
        amplified = max(1.0, 4 * np.pi * correlation**2 * squares)
        expected = amplified * density * float(near[used].sum())
        deviation = amplified * np.sqrt(density * pixels)
        strengths.append((power - expected) / deviation)
    return float(max(strengths))


def correlation_length(residual: FloatArray, used: BoolArray) -> float:
    """Return the standard deviation in px of the Gaussian that has blurred white noise.

    Differences of neighbouring pixels are compared with differences of pixels four apart. Medians
    are taken, so that bright lines that the model misses do not count. 0 if the noise is white.

    Parameters
    ----------
    residual, used : ndarray, shape (H, W)
        As for `pattern_strength`.
    """
    near = _squared_difference(residual, used, _NEAR_PX)
    far = _squared_difference(residual, used, _FAR_PX)
    if not far > 0:
        return 0.0
    ratio = near / far
    if ratio > _MAX_VARIANCE_RATIO:
        return 0.0
    # The correlation of blurred noise at a distance d is exp(-d² / 4c²).
    lengths = np.geomspace(0.2, 20.0, 400)
    ratios = (1 - np.exp(-(_NEAR_PX**2) / (4 * lengths**2))) / (
        1 - np.exp(-(_FAR_PX**2) / (4 * lengths**2))
    )
    return float(np.interp(-ratio, -ratios, lengths))


def noise_amplification(correlation: float) -> float:
    """Return how many times larger correlated noise is than white noise on long waves.

    Noise of one r.m.s. that a Gaussian of c px has blurred has 4πc² times the power of white noise
    there; error bars of a smooth field grow by the root of it.
    """
    return max(1.0, float(np.sqrt(4 * np.pi) * correlation))


def blur_score(residuals: FloatArray, roots: FloatArray, made: FloatArray) -> float:
    """Return how much the residuals look like missing blur, in standard deviations of noise.

    Blur adds the Laplacian of an image to it. The fit has removed the part that fields can imitate
    from the residual, so noise gives less than 1.

    Parameters
    ----------
    residuals : ndarray, shape (L, H, W)
        Image minus model over the standard deviation of the noise.
    roots : ndarray, shape (L, H, W)
        One over that standard deviation, zero where a pixel is not used.
    made : ndarray, shape (L, H, W)
        The model.
    """
    change = roots * np.stack([laplace(image, mode="nearest") for image in made])
    size = float(np.sqrt((change**2).sum()))
    return float((residuals * change).sum()) / size if size > 0 else 0.0


def lack_of_noise(residuals: FloatArray, used: BoolArray) -> tuple[float, float]:
    """Return by how much the variance of white residuals is below 1, and its standard deviation.

    Structure of more than a few pixels, of which a fit absorbs the noise, is left out.

    Parameters
    ----------
    residuals : ndarray, shape (L, H, W)
        Image minus model over the standard deviation of the noise.
    used : ndarray of bool, shape (L, H, W)
        The pixels to use.
    """
    inside = used.astype(np.float64)
    near = np.maximum(gaussian_filter(inside, (0, _DETAIL_PX, _DETAIL_PX), mode="nearest"), 1e-9)
    values = np.where(used, residuals, 0.0)
    details = values - gaussian_filter(values, (0, _DETAIL_PX, _DETAIL_PX), mode="nearest") / near
    # Shares of the variance that the Gaussian takes, and that it returns.
    share = 1 / (2 * np.pi * _DETAIL_PX**2)
    details = details[used & (near > _MOSTLY_USED)] / np.sqrt(1 - 2 * share + share / 2)
    if not details.size:
        return 0.0, np.inf
    return 1 - float((details**2).mean()), float(np.sqrt(2 / details.size))


def _squared_difference(values: FloatArray, used: BoolArray, distance: int) -> float:
    """Squared median of the absolute difference of used pixels so far apart on one axis."""
    differences = []
    for moved, both in ((values, used), (values.T, used.T)):
        pair = both[distance:] & both[:-distance]
        differences.append(np.abs(moved[distance:] - moved[:-distance])[pair])
    joined = np.concatenate(differences)
    return float(np.median(joined)) ** 2 if joined.size else 0.0


SUSPECT_PATTERN = 5.0
"""Standard deviations of a smoothed residual beyond which the model is wrong."""
# Of fits with a right model it is -5 to 2, once 4.2: a deep fold at 30 counts a pixel. With a beam
# that is 2 % off it is 31 and more, with absorption of 5 % 5.4 to 12.6.
_MIN_COUNTS = 5.0  # a pixel
_LACKING = 4.0  # standard deviations


@dataclass(frozen=True)
class Pattern:
    """Structure in the residuals of a fit.

    Attributes
    ----------
    strengths : ndarray, shape (L,)
        Of each image, in standard deviations; see `pattern_strength`.
    correlation : float
        Standard deviation in px of the Gaussian that has blurred the noise; 0 for white noise.
    chi2 : float
        The largest of all images.
    blur_score : float
        See `blur_score`.
    blur_gain : float
        How much a wider point spread lowers the objective; see `gain_by_blur`.
    missing_counts : float
        Share by which the noise is smaller than counts imply, as a dark level of that share
        makes it.
    counts_deviation : float
        Standard deviation of `missing_counts`.
    cause : str
        The likeliest cause, as a clause; "" if none is likely or none was looked for.
    """

    strengths: FloatArray
    correlation: float = 0.0
    chi2: float = 1.0
    blur_score: float = 0.0
    blur_gain: float = 0.0
    missing_counts: float = 0.0
    counts_deviation: float = np.inf
    cause: str = ""

    @property
    def largest(self) -> float:
        """The strongest pattern of all images."""
        return float(self.strengths.max())

    @property
    def is_certain(self) -> bool:
        """Whether the pattern shows that the model is wrong."""
        return self.largest > SUSPECT_PATTERN

    @property
    def lacks_counts(self) -> bool:
        """Whether the noise is certainly smaller than counts would make it."""
        return self.missing_counts > _LACKING * self.counts_deviation


def find_pattern(
    scene: Scene,
    unknowns: Unknowns,
    size: tuple[int, int],
    *,
    is_counted: bool = False,
    correlation: float | None = None,
    noise: NoiseMatch | None = None,
) -> Pattern:
    """Test the residuals of all images, the first `size` pixels of the scene, for structure.

    Of images that `is_counted` calls counts, the noise is tested, too. Their `correlation` in px is
    measured unless it is stated, in the residuals and before, as `noise`.
    """
    height, width = size
    counts = scene.ray_counts(unknowns)
    roots = np.sqrt(scene.weights[:, :height, :width])
    models = scene.model(unknowns, counts)[:, :height, :width]
    residuals = roots * (scene.images[:, :height, :width] - models)
    used = roots > 0
    if correlation is None:
        before = 0.0 if noise is None else noise.correlation
        correlation = max(before, *map(correlation_length, residuals, used))
    strengths = [
        pattern_strength(residual, use, correlation)
        for residual, use in zip(residuals, used, strict=True)
    ]
    chi2 = scene.chi2(unknowns, counts)
    missing, deviation = 0.0, np.inf
    if is_counted and not correlation:
        # The weight of a pixel is one over the variance of its counts in units of the beam.
        missing, deviation = lack_of_noise(residuals, roots * models > np.sqrt(_MIN_COUNTS))
    return Pattern(
        strengths=np.array(strengths),
        correlation=correlation,
        chi2=float((chi2 if noise is None else noise.relative_chi2(chi2)).max()),
        blur_score=blur_score(residuals, roots, models),
        missing_counts=missing,
        counts_deviation=deviation,
    )


# Images that are blurred by 1 px or more are then explained better.
_WIDER_PX, _MUCH_WIDER_PX = 1.5, 3.0
# A free beam lowers Σχ² by at most 19 where the beam was right, by 584 and more where it was off.
_MIN_GAIN = 60.0
_AS_LIKELY = 0.7  # of the largest gain
# Of the excess of Σχ² over the number of pixels; a cause that explains less is doubtful.
_MIN_EXPLAINED_SHARE = 0.5
_BEAM_MODES, _FINE_BEAM_MODES = 8, 20
_BEAM_SPREAD = 0.3
_SHIFT = np.array([True, False, False] * 2)
_STEPS = 12
_PEDESTALS = 0.09, 0.17  # of each image's mean: dark levels of 10 and 20 % of the beam


@dataclass(frozen=True)
class _Rival:
    """A scene with one more unknown, the start of its search, and the cause that it stands for."""

    scene: Scene
    unknowns: Unknowns
    free_numbers: int
    cause: str


def name_cause(
    scene: Scene,
    best: Minimum,
    names: Sequence[str],
    setups: Sequence[Setup] | None,
    on_step: OnStep,
) -> str:
    """Return the likeliest reason why a fit leaves a pattern, as a clause; "" if none is likely.

    Each rival frees or changes one assumption, and is fitted from the best unknowns. The one
    that lowers Σχ² most, beyond one for each of its numbers, is named.

    Parameters
    ----------
    scene, best
        The fit that leaves a pattern.
    names : sequence of str
        The fields.
    setups : sequence of Setup, optional
        The experiment of each image.
    on_step : callable
        Receives the stage and the objective.
    """
    pixels = best.coarsen(scene)
    misfit = pixels.chi2(best.unknowns) - 1
    excess = float((misfit * (pixels.weights > 0).sum(axis=(1, 2))).sum())

    def settle_rival(rival: _Rival, on_step: OnStep) -> tuple[float, str]:
        start = replace(best, unknowns=rival.unknowns, modes=SoftModes())
        end = settle_minimum(
            rival.scene, start, on_step, "rivals", steps=_STEPS, to_beat=best.value, is_rough=True
        )
        return 2 * (best.value - end.value) - rival.free_numbers, rival.cause

    works = [partial(settle_rival, rival) for rival in _rivals(scene, best, names, setups)]
    threads = available_threads(scene.threads)
    gains = sorted(run_in_parallel(works, threads, on_step), reverse=True)
    largest, _ = gains[0]
    if largest < _MIN_GAIN:
        return ""
    is_doubtful = largest < _MIN_EXPLAINED_SHARE * excess
    least = _MIN_GAIN if is_doubtful else _AS_LIKELY * largest
    # Two rivals may have the same cause.
    likely = dict.fromkeys(cause for gain, cause in gains if gain >= least)
    falls = f"Σχ² falls by {largest:.0f}"
    if is_doubtful:
        falls += f", of an excess of {excess:.0f}: something else is wrong, too"
    return f"{', or '.join(list(likely)[:2])} ({falls})"


def gain_by_blur(scene: Scene, best: Minimum, on_step: OnStep) -> float:
    """Return by how much a wider point spread lowers the objective; kernels stay."""
    wider = settle_minimum(_wider(scene, _WIDER_PX), best, on_step, "point spread")
    return best.value - wider.value


def log_evidence(
    scene: Scene, best: Minimum, names: Sequence[str], options: FitOptions, on_step: OnStep
) -> float:
    """Return the log evidence at the likeliest λ and κ, where it depends least on their accuracy.

    Parameters
    ----------
    scene, best
        The fit.
    names : sequence of str
        The fields, whose random probes are the same for all models.
    options : FitOptions
        Its seed, and whether the smoothness was given.
    on_step : callable
        Receives the stage and the objective.
    """
    if options.smoothness is None:
        scene = replace(scene, smoothness=scene.smoothness / SMOOTHNESS_RATIO)
    ended = settle_minimum(scene, best, on_step, "evidence", least_gain=0.1)
    chances = [np.random.default_rng([options.seed, crc32(name.encode())]) for name in names]
    return posterior_of(scene, ended, chances[0], on_step, "evidence").log_evidence(chances)


def _rivals(
    scene: Scene, best: Minimum, names: Sequence[str], setups: Sequence[Setup] | None
) -> Iterator[_Rival]:
    several = len(scene.images) > 1
    if several:
        yield from _with_free_beam(scene, best)
    if several and not scene.free_frames.any():
        shifted = replace(scene, free_frames=_SHIFT)
        cause = (
            "the images are not in register: a shift between them explains them better; align "
            "them by a shift"
        )
        yield _Rival(shifted, best.unknowns, 2 * (len(scene.images) - 1), cause)
    if several and not scene.free_brightness:
        cause = (
            "the brightness of an image differs from its source's: a factor for each image "
            "explains them better; free the brightness"
        )
        yield _Rival(replace(scene, free_brightness=True), best.unknowns, len(scene.images), cause)
    if several and setups and set(names) == {"B"}:
        yield from _with_electric_field(scene, best, setups)
    cause = "the images are blurred by more than the point spread that was given"
    for width in (_WIDER_PX, _MUCH_WIDER_PX):
        yield _Rival(_wider(scene, width), best.unknowns, 0, cause)
    cause = (
        "a constant lies under the images: with less of it they are explained better; subtract "
        "the detector's dark level"
    )
    for pedestal in _PEDESTALS:
        yield _Rival(_without_pedestal(scene, pedestal), best.unknowns, 0, cause)


def _with_free_beam(scene: Scene, best: Minimum) -> Iterator[_Rival]:
    """Beams that differ from the assumed one on long waves, or also on the object's scale."""
    advice = "give a reference of this shot, or fit the beam, as a source that is unknown"
    causes = {
        _BEAM_MODES: f"the beam differs from its source, smoothly over the image; {advice}",
        _FINE_BEAM_MODES: (
            "the object absorbs or scatters, or the beam has finer structure than its source; "
            "give a reference of this shot, or images in which the object absorbs less"
        ),
    }
    for modes, cause in causes.items():
        if modes <= scene.beam_modes:
            continue
        beam = np.pad(best.unknowns.beam, (0, modes - scene.beam_modes))
        freed = replace(scene, beam_modes=modes, beam_spread=_BEAM_SPREAD, free_brightness=True)
        free_numbers = int((freed.prior.beam_weights > 0).sum())
        yield _Rival(freed, best.unknowns._replace(beam=beam), free_numbers, cause)


def _with_electric_field(scene: Scene, best: Minimum, setups: Sequence[Setup]) -> Iterator[_Rival]:
    strengths = strengths_of(setups, ("B", "E"), len(setups))
    strengths = strengths / strengths[0]
    if np.linalg.matrix_rank(strengths, tol=0.02) < 2:
        return
    both = replace(scene, strengths=strengths, smoothness=np.tile(scene.smoothness, (2, 1)))
    potentials = np.concatenate([best.unknowns.potentials, 0 * best.unknowns.potentials])
    # Of an added field the smoothness lets through about as many numbers as waves of 16 px.
    free_numbers = scene.images[0].size // 64
    cause = "an electric field deflects beside the magnetic one; fit both fields, B and E"
    yield _Rival(both, best.unknowns._replace(potentials=potentials), free_numbers, cause)


def _wider(scene: Scene, added: float) -> Scene:
    widths = [
        float(np.hypot(width, added)) if isinstance(width, float) else width for width in scene.psf
    ]
    return replace(scene, psf=widths)


def _without_pedestal(scene: Scene, pedestal: float) -> Scene:
    """The images less a constant, brought back to their mean; so is their noise."""
    share = 1 - pedestal
    means = scene.images.sum(axis=(1, 2)) / np.maximum((scene.images != 0).sum(axis=(1, 2)), 1)
    images = (scene.images - pedestal * means[:, None, None]) / share
    return replace(scene, images=images, weights=scene.weights * share**2)
