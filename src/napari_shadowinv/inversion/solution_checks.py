"""Signs that a solution must not be trusted, although the solver converged.

- the difference of re-projection and image: `image_residual`
- whether more sites would reduce it: `is_coarse`
- the cautions about a solution: `find_cautions`
- the verdicts that follow from them: `DECISIVE`

Each sign was chosen to be absent in images whose field is known to be right and to appear where it
is wrong; `docs/trust.md` lists them with advice. The limits, and the measurements on either side of
them (200 × 200 px and the reference images):

- **The picture does not fit.** Away from bright lines, where pixels are too coarse for any
  re-projection, the residual of a noisy image has no pattern: its correlation between pixels up
  to four apart is 0.09 to 0.28 (Gaussian noise of 1 to 50 %, counts of 1 to 1000 per pixel).
  Chequerboards and stripes of 1 to 4 pixels (2:1 to 1000:1) have 0.8 to 1.0, too few sites for
  an image 0.6 to 0.7; the limit is 0.5. Clean images can pass it with residuals of a few
  tenths of a per cent, so a residual of at least 5 % is asked for, too: those images have 0.1 to
  3 %, patterns 14 to 100 %. Random dark and bright pixels are indistinguishable from noise.
- **Too few sites for the image.** Over squares of 16 px the mean square of the residual, over that
  of the noise, is at most 1.3 in 98 % of the squares with one site per pixel, and 1.2 to 1.4 with
  a quarter of them for the toroids of 97 and 194 MG µm with noise; 2.6 to 4 where bright rims look
  grainy (four toroids, donut). The limit is 2.25; 4 % of the local brightness are invisible.
- **No deflection.** White noise of relative deviation s displaces by ∇∇⁻² of itself: the mean
  square is s² Σ 1/k² / N over all N - 1 waves of the image. Pure noise gave 0.83 to 1.24 times
  that displacement, as it should with the scatter of so few long waves; fields whose own
  displacement is twice the noise's gave 2.0 to 2.2 times. The limit is five deviations of the
  mean square: 1.4 times on a square image, more on a long one.
- **Deep folds.** The solution squeezes the area between two caustics into a strip. At its rim the
  Jacobian grows smoothly where caustics have only just formed and jumps where the fold is deep.
  The share of the strip's pixels below 0.7 that are below 0.4 is at most 0.70 up to 1.1 times the
  strength at which caustics begin (0.47 to 0.66 for the phantoms, the toroid of 194 MG µm and the
  donut; 0.73 for a radius of 10 px); 0.76 to 0.80 for rings at 1.2, 0.79 to 0.93 at 1.3 to 1.5;
  0.69 to 0.72 for focusing spots at 1.2, 0.72 at 1.3 and 0.74 to 0.90 beyond. At twice the
  strength the jump of a ring is at 0.6 to 1, hence the same with 0.85 and 0.6. A crescent has
  shallow tips: around its widest place, within twice the half-width, the shares are up to 0.79
  and 0.83 without deep folds, 0.86 to 0.95 and 0.87 to 0.98 with.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import numpy as np
from scipy import ndimage

from napari_shadowinv._system.machine import available_threads, begin, in_ranges
from napari_shadowinv._typing import AnyArray, BoolArray, FloatArray
from napari_shadowinv.cautions import Caution
from napari_shadowinv.facts import Verdict, percent, to_figures
from napari_shadowinv.geometry.compiler import kernel
from napari_shadowinv.inversion.noise import ImageNoise
from napari_shadowinv.inversion.normalise import Prepared
from napari_shadowinv.options import InversionOptions
from napari_shadowinv.physics.edge import LARGER_FIELD

_BRIGHT = 3.0  # times the source: a bright line, too fine for the pixels
_LAGS = ((0, 1), (1, 0), (1, 1), (1, -1), (0, 2), (2, 0), (0, 4), (4, 0))
_ROUNDING = 1e-6  # px, where image and source are the same


@dataclass(frozen=True)
class CoarseCheck:
    """Where more sites would follow the image better; limits as measured above."""

    above_noise: float = 1.5**2  # mean square in a square, of noise and invisible residual
    invisible: float = 0.04  # of the brightness
    square: int = 16  # px
    share_of_square: float = 0.5  # of its pixels that count
    squares_below: float = 0.98  # share of the squares
    pixels_per_thread: int = 1 << 16  # fewer are not worth a thread


@dataclass(frozen=True)
class FoldCheck:
    """When folds are deep; limits as measured above."""

    caustic: float = 0.2  # Jacobian; independent of the user's option
    # Two Jacobians, and the largest shares below the first: of all strips, and where one is widest.
    strips: tuple[tuple[float, ...], ...] = ((0.4, 0.7, 0.72, 0.84), (0.6, 0.85, 0.8, 0.87))
    least_strip: float = 0.003  # of the pixels
    least_caustic: float = 0.01  # of a strip
    enough_pixels: int = 300  # of a side, to resolve the width of a strip


DECISIVE = {
    "not-converged": (Verdict.UNCERTAIN, "do not trust the field"),
    "misfit": (Verdict.MISFIT, "check source, mask and point spread"),
    "negative": (Verdict.UNCERTAIN, "invert its grey values, or keep it as it is"),
    "no-deflection": (Verdict.UNCERTAIN, "average more shots"),
    "folds": (Verdict.AMBIGUOUS, "fit images at two energies"),
    "edge": (Verdict.EDGE, LARGER_FIELD),
    "masked-peak": (Verdict.UNCERTAIN, "unmask what is sound"),
    "correlated-noise": (Verdict.UNCERTAIN, "give the noise level"),
}
"""Cautions that decide the verdict, the gravest first, and a remedy for each."""


def image_residual(image: FloatArray, reprojection: FloatArray, mask: BoolArray) -> float:
    """Return the r.m.s. difference of re-projection and image over the mean, inside the mask."""
    difference = (image - reprojection)[mask]
    return float(np.sqrt(np.mean(difference**2)) / image[mask].mean())


def find_cautions(
    prepared: Prepared,
    noise: ImageNoise,
    displacement: FloatArray,
    reprojection: FloatArray,
    jacobian: FloatArray,
    n_sites: int,
    options: InversionOptions,
    *,
    is_dark: BoolArray | bool = False,
) -> tuple[Caution, ...]:
    """Return the reasons to doubt a converged solution; empty if there are none.

    Masked pixels that `is_dark` in a recorded source hide no field: no ray starts there.
    """
    misfit_at_end = begin(partial(_misfit, prepared, reprojection, n_sites), options.threads)
    square = np.einsum("cyx,cyx->yx", displacement, displacement)
    mask = prepared.mask
    rms = float(np.sqrt(square[mask].mean()))
    folds, masked_peak = _deep_folds(jacobian, mask), _peak_at_mask(displacement, mask | is_dark)
    misfit = misfit_at_end()
    # Where the finest structure is a pattern, it is no measure of noise.
    no_deflection = "" if misfit else _no_deflection(noise, rms)
    if no_deflection:
        return (Caution("no-deflection", no_deflection),)
    texts = {
        "misfit": misfit,
        "folds": folds,
        "correlated-noise": _far_correlation(noise),
        "masked-peak": masked_peak,
    }
    return tuple(Caution(code, text) for code, text in texts.items() if text)


class _Planes(NamedTuple):
    """An image and its re-projection, as kernels compare them."""

    image: FloatArray
    reprojection: FloatArray
    source: FloatArray
    mask: BoolArray
    mean: float  # of the source where it is used

    @classmethod
    def of(cls, prepared: Prepared, reprojection: FloatArray) -> _Planes:
        # The source is 0 elsewhere.
        mean = float(prepared.source.sum() / np.count_nonzero(prepared.lit))
        return cls(prepared.image, reprojection, prepared.source, prepared.mask, mean)


def is_coarse(
    prepared: Prepared,
    reprojection: FloatArray,
    noise: ImageNoise,
    threads: int | None = None,
    check: CoarseCheck = CoarseCheck(),
) -> bool:
    """Return whether the re-projection misses structures that noise does not hide.

    That is the case if the residual exceeds the noise in some squares away from bright lines.
    """
    shape = prepared.mask.shape
    side = min(check.square, *shape)
    excess, share = np.empty((2, shape[0] // side, shape[1] // side))
    hidden = noise.variance_terms + np.array([1e-12, 0.0, check.invisible**2])
    sums = _Planes.of(prepared, reprojection), side, hidden, excess, share
    smallest = max(1, check.pixels_per_thread // (side * shape[1]))
    in_ranges(_average_squares, len(excess), available_threads(threads), *sums, smallest=smallest)
    is_measured = share > check.share_of_square
    if not is_measured.any():
        return False
    ratio = np.quantile(excess[is_measured] / share[is_measured], check.squares_below)
    return bool(ratio > check.above_noise)


@kernel
def _is_off_lines(y: int, x: int, planes: _Planes) -> bool:
    """Return whether a pixel is used and the mean of those around it is no bright line."""
    if not planes.mask[y, x]:
        return False
    height, width = planes.mask.shape
    total = 0.0
    for row in (max(y - 1, 0), y, min(y + 1, height - 1)):
        for column in (max(x - 1, 0), x, min(x + 1, width - 1)):
            total += planes.image[row, column]
    return bool(total <= 9 * _BRIGHT * max(planes.source[y, x], planes.mean))


@kernel
def _average_squares(
    start: int,
    stop: int,
    planes: _Planes,
    side: int,
    hidden: FloatArray,
    excess: FloatArray,
    share: FloatArray,
) -> None:
    """Average residual² over the hidden variance in rows of squares; find the share off lines.

    The hidden variance, of noise and invisible residuals, is a polynomial of the brightness.
    """
    image, reprojection, mean = planes.image, planes.reprojection, planes.mean
    for i in range(start, stop):
        for j in range(excess.shape[1]):
            total, count = 0.0, 0
            for y in range(side * i, side * (i + 1)):
                for x in range(side * j, side * (j + 1)):
                    if _is_off_lines(y, x, planes):
                        residual = (image[y, x] - reprojection[y, x]) / mean
                        bright = max(image[y, x], reprojection[y, x]) / mean
                        variance = hidden[0] + bright * (hidden[1] + bright * hidden[2])
                        total += residual * residual / variance
                        count += 1
            excess[i, j], share[i, j] = total / (side * side), count / (side * side)


@kernel
def _subtract_off_lines(planes: _Planes, residual: FloatArray) -> int:
    """Fill a plane with image minus re-projection, 0 at bright lines; count the other pixels."""
    count = 0
    for y in range(residual.shape[0]):
        for x in range(residual.shape[1]):
            is_counted = _is_off_lines(y, x, planes)
            difference = planes.image[y, x] - planes.reprojection[y, x]
            residual[y, x] = difference if is_counted else 0.0
            count += is_counted
    return count


def _misfit(
    prepared: Prepared,
    reprojection: FloatArray,
    n_sites: int,
    *,
    notable: float = 0.05,
    pattern: float = 0.5,
) -> str:
    """Describe a pattern in the image that the re-projection misses.

    Its residual is `notable`, and pixels up to four apart are correlated by `pattern`.
    """
    mask, planes = prepared.mask, _Planes.of(prepared, reprojection)
    mean, residual = planes.mean, np.empty(mask.shape)
    count = _subtract_off_lines(planes, residual)
    share = float(np.sqrt(np.einsum("yx,yx->", residual, residual) / max(count, 1)) / mean)
    if share < notable:
        return ""
    # A few hot pixels are no pattern.
    np.clip(residual, -5 * share * mean, 5 * share * mean, out=residual)
    if max(abs(_correlation(residual, *lag)) for lag in _LAGS) < pattern:
        return ""
    advice = "use more sites"
    if n_sites >= mask.sum():
        advice = (
            "the image has structure on the scale of its pixels, so smooth it or record it "
            "with smaller pixels"
        )
    return (
        "the picture does not fit: the re-projection misses a pattern in the image, by "
        f"{percent(share)} of the mean (r.m.s.); do not trust the field: {advice}"
    )


def _correlation(values: FloatArray, down: int, right: int) -> float:
    """Return the correlation of pixels with pixels `down` rows and `right` columns further."""
    height, width = values.shape
    x_start = max(-right, 0)
    first = values[: height - down, x_start : width - max(right, 0)]
    second = values[down:, x_start + right : width - max(right, 0) + right]
    # Not by BLAS, which would start threads of its own.
    return float((first * second).sum() / (values**2).sum())


def _no_deflection(noise: ImageNoise, rms: float) -> str:
    usual, most = noise.displacements(noise.typical)
    if rms > max(most, _ROUNDING):
        return ""
    return (
        f"no deflection found: the displacement of {to_figures(rms)} px (r.m.s.) is no larger than "
        f"the {to_figures(usual)} px expected from the image's noise of {percent(noise.typical)} "
        "per pixel; average shots, or bin or smooth the image, before interpreting the field"
    )


def _far_correlation(noise: ImageNoise) -> str:
    if not noise.is_correlated_far:
        return ""
    return (
        "correlated noise: calm parts of the image vary over 4 px and more, all alike, as noise "
        "does that is correlated over 3 px or more, or the texture of a beam: the error by noise "
        "is too small; compare several shots, and use images that were not smoothed or resampled"
    )


def mark_caustics(
    jacobian: FloatArray, mask: BoolArray, n_sites: int, threshold: float
) -> BoolArray:
    """Mark the pixels where rays cross or nearly cross, of those in a mask, (H, W).

    Wherever the field compresses the beam, noise takes single pixels below the threshold, an
    `InversionOptions.caustic_jacobian`. A region below it is a caustic if its Jacobian averaged
    over the spacing of the sites, the resolution of the map, falls below the threshold, too.
    """
    below = (jacobian < threshold) & mask
    if not below.any():
        return np.asarray(below)
    spacing_px = max(1.0, math.sqrt(jacobian.size / n_sites))
    averaged = ndimage.gaussian_filter(jacobian, spacing_px, mode="nearest")
    regions, _ = ndimage.label(below, structure=np.ones((3, 3)))
    caustics = np.unique(regions[below & (averaged < threshold)])
    marked: BoolArray = np.isin(regions, caustics) & below
    return marked


def _deep_folds(jacobian: FloatArray, mask: BoolArray, check: FoldCheck = FoldCheck()) -> str:
    """Describe caustics far beyond their onset, by the rim of the strip between them."""
    if not (jacobian < check.caustic)[mask].any():
        return ""
    step = max(1, min(mask.shape) // check.enough_pixels)
    used = mask[::step, ::step]
    jacobian = np.where(used, jacobian[::step, ::step], np.inf)
    strips_below = partial(_strips, jacobian, check.least_strip * float(used.sum()), check)
    if not any(
        _share_of_strips(jacobian, inner, *strips_below(outer)) > of_all
        or _share_where_widest(jacobian, inner, outer, *strips_below(inner)) > of_widest
        for inner, outer, of_all, of_widest in check.strips
    ):
        return ""
    return (
        "rays cross: folds look deeper than 10 % beyond the first caustic, where the field comes "
        "out too weak: 3–5 % off (L2) at 1.2 times the strength at which caustics begin, 9–14 % "
        "at 1.5, 20–29 % at 2"
    )


def _strips(
    jacobian: FloatArray, least: float, check: FoldCheck, outer: float
) -> tuple[AnyArray, AnyArray]:
    """Label regions with the Jacobian below `outer`; return also the labels with caustics."""
    labels, count = ndimage.label(jacobian < outer)
    sizes = np.bincount(labels.ravel(), minlength=count + 1)
    caustics = np.bincount(labels[jacobian < check.caustic], minlength=count + 1)
    return labels, np.flatnonzero((sizes >= least) & (caustics >= check.least_caustic * sizes))


def _share_of_strips(
    jacobian: FloatArray, inner: float, labels: AnyArray, strip_labels: AnyArray
) -> float:
    strips = jacobian[np.isin(labels, strip_labels)]
    return float((strips < inner).sum() / max(strips.size, 1))


def _share_where_widest(
    jacobian: FloatArray, inner: float, outer: float, labels: AnyArray, strip_labels: AnyArray
) -> float:
    """Return the share around the widest place of a strip: the tips of a crescent are shallow."""
    boxes = ndimage.find_objects(labels)
    largest = 0.0
    for label in strip_labels:
        box = boxes[label - 1]
        depth = ndimage.distance_transform_edt(np.pad(labels[box] == label, 1))
        row, column = np.unravel_index(depth.argmax(), depth.shape)
        y = np.arange(jacobian.shape[0])[:, None] - (box[0].start + row - 1)
        x = np.arange(jacobian.shape[1]) - (box[1].start + column - 1)
        near = jacobian[y**2 + x**2 <= (2 * depth.max()) ** 2]
        largest = max(largest, float((near < inner).sum() / (near < outer).sum()))
    return largest


def _peak_at_mask(
    displacement: FloatArray, mask: BoolArray, *, hole: int = 3, reach: float = 0.02
) -> str:
    """Describe a peak of the field next to masked pixels or under them.

    Masked squares of `hole` px matter, and pixels within `reach` of the shorter side.
    """
    if mask.all():
        return ""
    holes = ndimage.binary_opening(~mask, np.ones((hole, hole)))
    length = np.hypot(*displacement)
    peak = float(length[mask].max())
    if not holes.any() or not peak > _ROUNDING:
        return ""
    pixels = max(2, round(reach * min(mask.shape)))
    near = ndimage.binary_dilation(holes, iterations=pixels)
    under = float(length[holes].max())
    if under <= peak and not (near & mask & (length >= peak)).any():
        return ""
    return (
        "the peak of the field lies at masked pixels, where the field is only a smooth "
        f"continuation (up to {to_figures(under)} px under the mask, {to_figures(peak)} px "
        "outside): the true peak may be hidden, and the value given is that of the unmasked "
        "pixels; use a smaller mask"
    )
