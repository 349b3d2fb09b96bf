"""A source in register with its image: `register_source`; its shift alone: `measure_shift`.

A shift that is left would be taken for a field. Two comparisons show it, each weighted by its
error, and neither by much where an object is:

- *at the borders*, where an object displaces least: the ratio of image and source in square cells
  is the shift's pattern, plus a difference of the beams, smooth over a length, and noise. The size
  of that difference is the likeliest one, no smaller than expected, so that it, and the flanks of
  an object, count as errors.
- *everywhere*, by the finest structure: each part of the image counts by what the shift leaves of
  it, and the error is the scatter of the parts.

Noise has gradients, too, which share nothing with the shift. The source's are therefore
compared with the image's, not with themselves (instrumental variables).

References
----------
J. D. Angrist and J.-S. Pischke, *Mostly Harmless Econometrics* (Princeton, 2009), sections 4.1 and
8.2, for instrumental variables and errors by clusters; C. E. Rasmussen and C. K. I. Williams,
*Gaussian Processes for Machine Learning* (MIT Press, 2006), chapter 5, for the likeliest size.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy import linalg, ndimage

from napari_shadowinv._system.arrays import NORMAL_MAD, check_shape, complete_block_means
from napari_shadowinv._typing import BoolArray, FloatArray
from napari_shadowinv.cautions import Caution
from napari_shadowinv.options import DEFAULT_REGISTRATION, REFERENCE_BEAM, BeamPrior, Instrument
from napari_shadowinv.preprocessing.image_checks import border_ring

_SIDE_PX, _COARSE_SIDE_PX = 384, 64  # of the planes that are compared
_CELLS = 24  # along the longer side
_DEPTHS = 1, 2, 4  # cells, of the borders
_AGREEING_ERRORS = 1.5  # of the shift by a border, for a deeper one to count
# Of the beams over the expected one, and of structure of a quarter of its length.
_DIFFERENCES = (1.0, 0.0), (1.0, 2.0), (1.0, 8.0), (4.0, 0.0), (4.0, 8.0)
_LEAST_NOISE = 1e-5  # of a cell
_LEAST_LIGHT = 0.05  # of the mean
_FINE_PX, _COARSE_PX = 1.0, 4.0
_PARTS = 8  # along each side
_PART_DEVIATIONS = 4.0  # of the finest structure that image and source share
_UNKNOWN_PX = 1e3
# Of a shift by whole pixels: blur over the longer side, least common share of the borders, largest
# misfit over that without it, which is half and more for beams that merely differ.
_COARSE_BLUR, _MIN_OVERLAP, _COARSE_MISFIT = 0.03, 0.5, 0.4
_MAX_STEPS, _LONGEST_STEP_PX = 12, 3.0
_SIGNIFICANT_ERRORS = 4.0
_MIN_SHIFT_PX = 0.05  # interpolation would change more than it mends


class Shift(NamedTuple):
    """Shift of a source to its place in an image, (y, x) in px, with its standard deviations."""

    value: FloatArray
    error: FloatArray

    @property
    def is_significant(self) -> BoolArray:
        """Whether it is above four times its error and 0.05 px, along each axis."""
        limits = np.maximum(_SIGNIFICANT_ERRORS * self.error, _MIN_SHIFT_PX)
        return np.abs(self.value) > limits

    @property
    def significant(self) -> FloatArray:
        """The shift along the axes where it is significant, 0 along others."""
        return np.where(self.is_significant, self.value, 0.0)

    @property
    def text(self) -> str:
        """The shift with its errors, such as "y +2.01 ± 0.10, x -0.96 ± 0.12 px"."""
        (y, x), (y_error, x_error) = self
        return f"y {y:+.2f} ± {y_error:.2f}, x {x:+.2f} ± {x_error:.2f} px"

    def left(self, expected: float) -> float:
        """Return the standard deviation of what is left of it without its significant part, px.

        Parameters
        ----------
        expected : float
            Standard deviation of a shift that was not measured.
        """
        unexplained = np.maximum(np.abs(self.value) - 2 * self.error, 0.0)
        unmoved = np.hypot(np.minimum(self.error, expected), unexplained)
        return float(np.where(self.is_significant, self.error, unmoved).max())


class RegisteredSource(NamedTuple):
    """A source in register with an image.

    Attributes
    ----------
    source : ndarray, shape (H, W)
        Interpolated with cubic splines.
    error : float
        Standard deviation of the shift that is left, px.
    caution : Caution or None
        If the source was moved further than was expected.
    is_assumed : bool
        Whether the error is the usual one, as nobody stated it and nothing shows the shift.
    """

    source: FloatArray
    error: float
    caution: Caution | None = None
    is_assumed: bool = False


def register_source(
    image: FloatArray, source: FloatArray, usable: BoolArray, instrument: Instrument
) -> RegisteredSource:
    """Move a recorded source where it fits its image, if it lies elsewhere beyond doubt.

    A source without structure, or one that is stated to be in register, stays.
    """
    beam = instrument.beam_of(measured=True, source=source)
    expected = DEFAULT_REGISTRATION if instrument.registration is None else instrument.registration
    if not expected or not np.ptp(source[usable]) > 0:
        return RegisteredSource(source, 0.0)
    shift = measure_shift(image, source, usable, beam)
    error = shift.left(expected)
    if not shift.is_significant.any():
        is_assumed = instrument.registration is None and error == expected
        return RegisteredSource(source, error, is_assumed=is_assumed)
    moved = np.where(usable, move(source, shift.significant), 0.0)
    if np.abs(shift.significant).max() < _SIGNIFICANT_ERRORS * expected:
        return RegisteredSource(moved, error)
    text = (
        f"register: the source was moved by {shift.text} to fit the image; what is left of the "
        "shift is in the error. State a registration of 0 if both are on the same pixels"
    )
    return RegisteredSource(moved, error, Caution("register", text))


def move(source: FloatArray, shift: FloatArray) -> FloatArray:
    """Return a source that was shifted by px along y and x; its slopes go on beyond its edges."""
    width = min(int(np.ceil(np.abs(shift).max())) + 2, min(source.shape) - 1)
    padded = np.pad(source, width, mode="reflect", reflect_type="odd")
    inside = np.s_[width:-width, width:-width]
    moved = ndimage.shift(padded, shift, order=3, mode="nearest")[inside]
    return np.asarray(np.maximum(moved, 0.0))


def measure_shift(
    image: FloatArray,
    source: FloatArray,
    mask: BoolArray | None = None,
    beam: BeamPrior = REFERENCE_BEAM,
) -> Shift:
    """Measure the shift of a source to its place in an image.

    Parameters
    ----------
    image, source : ndarray, shape (H, W)
        In any units; their brightness may differ.
    mask : ndarray of bool, shape (H, W), optional
        True at usable pixels.
    beam : BeamPrior
        Expected difference of the beams of image and source.

    Returns
    -------
    Shift
        With errors of 1000 px where nothing shows it.

    Raises
    ------
    InputError
        If the shapes differ.
    """
    image, source = (np.asarray(plane, dtype=np.float64) for plane in (image, source))
    check_shape("the source", source.shape, image.shape, "the image")
    usable = np.ones(image.shape, bool) if mask is None else mask
    block = -(-max(image.shape) // _SIDE_PX)
    whole = complete_block_means(usable, block) > 1 - 1e-9
    planes = (complete_block_means(plane, block) for plane in (image, source))
    if not whole.any():
        return Shift(np.zeros(2), np.full(2, _UNKNOWN_PX))
    shot, reference = (np.where(whole, p / max(p[whole].mean(), 1e-300), 1.0) for p in planes)
    value = _coarse_shift(shot, reference, whole)
    for step in range(_MAX_STEPS):
        moved = (
            ndimage.shift(reference, value, order=3, mode="nearest") if any(value) else reference
        )
        steps = _by_borders(shot, moved, whole, beam), _by_finest(shot, moved, whole)
        weights = [np.linalg.inv(covariance) for _, covariance in steps]
        covariance = np.linalg.inv(sum(weights))
        found = covariance @ sum(w @ move for w, (move, _) in zip(weights, steps, strict=True))
        error = np.sqrt(np.diag(covariance))
        is_settled = (np.abs(found) < (0.1 if step else 2.0) * error).all()
        longest = _LONGEST_STEP_PX / (1 + step)
        value = value + (found if is_settled else np.clip(found, -longest, longest))
        if is_settled or error.max() > _LONGEST_STEP_PX:
            break
    return Shift(block * value, block * error)


def _coarse_shift(shot: FloatArray, source: FloatArray, usable: BoolArray) -> FloatArray:
    """Return the shift at which borders correlate best, in coarse pixels; 0 if none fits better."""
    from skimage.registration import phase_cross_correlation

    block = -(-max(shot.shape) // _COARSE_SIDE_PX)
    border = complete_block_means(usable, block) > 1 - 1e-9
    border &= border_ring(border.shape)
    blur = _COARSE_BLUR * max(border.shape)
    shot, source = (
        ndimage.gaussian_filter(complete_block_means(plane, block), blur)
        for plane in (shot, source)
    )
    if not (np.ptp(shot[border]) > 0 and np.ptp(source[border]) > 0):
        return np.zeros(2)
    correlate: Callable[..., tuple[FloatArray, float, float]] = phase_cross_correlation
    found, *_ = correlate(
        shot, source, reference_mask=border, moving_mask=border, overlap_ratio=_MIN_OVERLAP
    )

    shift = np.asarray(found, dtype=np.float64)
    both = border & ndimage.shift(border, shift, order=0, cval=False)

    def misfit(beam: FloatArray, where: BoolArray) -> float:
        difference = shot[where] / shot[where].mean() - beam[where] / beam[where].mean()
        return float(np.median(np.abs(difference)))

    # Where they overlap, a beam without structure must not fit as well.
    moved = misfit(ndimage.shift(source, shift, order=1), both)
    unmoved = min(misfit(source, border), misfit(np.ones_like(source), both))
    return block * shift if moved < _COARSE_MISFIT * unmoved else np.zeros(2)


Step = tuple[FloatArray, FloatArray]
"""A shift, (2,), and its covariance, (2, 2)."""

_NO_STEP: Step = (np.zeros(2), _UNKNOWN_PX**2 * np.eye(2))


def _by_borders(shot: FloatArray, source: FloatArray, usable: BoolArray, beam: BeamPrior) -> Step:
    """Return the shift by the ratio of image and source near the borders."""
    cell = max(2, -(-max(shot.shape) // _CELLS))
    if min(shot.shape) < 3 * cell:
        return _NO_STEP
    level = complete_block_means(source, cell)
    lit = (complete_block_means(usable, cell) > 1 - 1e-9) & (level > _LEAST_LIGHT)
    level = np.where(lit, level, 1.0)
    ratio = complete_block_means(shot, cell) / level - 1
    patterns = [
        [-complete_block_means(each, cell) / level for each in np.gradient(smooth)]
        for smooth in (ndimage.gaussian_filter(plane, cell / 2) for plane in (source, shot))
    ]
    down, right = np.indices(lit.shape)
    depths = np.minimum(
        np.minimum(down, right), np.minimum(lit.shape[0] - down, lit.shape[1] - right) - 1
    )
    places = np.argwhere(lit & (depths < max(_DEPTHS)))
    places = places[np.argsort(depths[tuple(places.T)], kind="stable")]
    order = tuple(places.T)
    counts = [count for depth in _DEPTHS if (count := int((depths[order] < depth).sum())) > 8]
    if not counts:
        return _NO_STEP
    of_source, of_shot = (
        np.stack([np.ones(len(places)), *(pattern[order] for pattern in both)], axis=1)
        for both in patterns
    )
    columns = np.column_stack([of_source, of_shot, ratio[order]])
    noise = max(_noise_of(ratio, lit), _LEAST_NOISE**2)
    best = _NO_STEP
    for found in _likeliest_shifts(columns, cell / min(shot.shape) * places, counts, noise, beam):
        # Deeper borders show more, until they reach the object.
        allowed = _AGREEING_ERRORS * np.sqrt(np.diag(best[1]))
        if best is _NO_STEP or (np.abs(found[0] - best[0]) < allowed).all():
            best = min(best, found, key=lambda step: float(np.trace(step[1])))
    return best


def _noise_of(ratio: FloatArray, lit: BoolArray) -> float:
    """Return the variance of noise in the outermost cells."""
    finest = (ratio[1:, 1:] - ratio[1:, :-1] - ratio[:-1, 1:] + ratio[:-1, :-1]) / 2
    used = lit[1:, 1:] & lit[1:, :-1] & lit[:-1, 1:] & lit[:-1, :-1]
    used[1:-1, 1:-1] = False
    return float((NORMAL_MAD * np.median(np.abs(finest[used]))) ** 2) if used.any() else 0.0


def _likeliest_shifts(
    columns: FloatArray, places: FloatArray, counts: list[int], noise: float, beam: BeamPrior
) -> list[Step]:
    """Return the shift by the first cells, so many each time.

    By generalised least squares with the likeliest difference of beams. `columns` (n, 7) are three
    patterns of the source, as many of the image, and the ratio of both.
    """
    squares = sum((line[:, None] - line) ** 2 for line in places.T)
    long = np.exp(-squares / (2 * beam.length**2))
    short = long**16  # a quarter of the length
    best, likeliest = [_NO_STEP] * len(counts), [-np.inf] * len(counts)
    for of_beam, of_rest in _DIFFERENCES:
        covariance = beam.rms**2 * (of_beam**2 * long + of_rest**2 * short)
        covariance += noise * np.eye(len(places))
        # Its first rows are the root of the first cells' covariance.
        root = linalg.cholesky(covariance, lower=True, check_finite=False)
        white = linalg.solve_triangular(root, columns, lower=True, check_finite=False)
        logarithms = np.cumsum(np.log(np.diag(root)))
        for k, count in enumerate(counts):
            source, shot, values = white[:count, :3], white[:count, 3:6], white[:count, 6]
            normal, square = source.T @ shot, source.T @ source
            if not (np.linalg.cond(normal) < 1e12 and np.linalg.cond(square) < 1e12):
                continue
            rest = values - source @ np.linalg.solve(square, source.T @ values)
            misfit = float((rest**2).sum())
            evidence = -misfit / 2 - float(logarithms[count - 1])
            if evidence > likeliest[k]:
                likeliest[k], inverse = evidence, np.linalg.inv(normal)
                spread = inverse @ square @ inverse.T * max(1.0, misfit / count)
                best[k] = (inverse @ (source.T @ values))[1:], spread[1:, 1:]
    return best


def _by_finest(shot: FloatArray, source: FloatArray, usable: BoolArray) -> Step:
    """Return the shift by the finest structure, with an error by the scatter of parts."""
    fine, sharp = (
        ndimage.gaussian_filter(plane, _FINE_PX) - ndimage.gaussian_filter(plane, _COARSE_PX)
        for plane in (source, shot)
    )
    inner = ndimage.minimum_filter(usable, 9, mode="constant", cval=False)
    rows, columns = (np.arange(side) * _PARTS // side for side in shot.shape)
    parts = (rows[:, None] * _PARTS + columns)[inner]
    difference = (sharp - fine)[inner]
    slopes, instruments = ([-g[inner] for g in np.gradient(plane)] for plane in (sharp, fine))

    def sums(first: list[FloatArray], second: list[FloatArray]) -> FloatArray:
        """Return sums of products over each part, (parts, first, second)."""
        products = [[np.bincount(parts, a * b, _PARTS**2) for b in second] for a in first]
        return np.moveaxis(np.array(products), 2, 0)

    count = np.bincount(parts, minlength=_PARTS**2)
    is_filled = count > 0
    if is_filled.sum() < _PARTS:
        return _NO_STEP
    normal = sums(instruments, slopes)[is_filled]
    normal = (normal + normal.transpose(0, 2, 1)) / 2
    squares, products = (sums(instruments, each)[is_filled] for each in (instruments, [difference]))
    squared = sums([difference], [difference])[is_filled, 0, 0]
    products, count = products[..., 0], count[is_filled]
    shift = np.zeros(2)
    for _ in range(3):
        explained = 2 * products @ shift - np.einsum("tij,i,j->t", squares, shift, shift)
        weights = count / np.maximum(squared - explained, 1e-12 * count)
        total = np.einsum("t,tij->ij", weights, normal)
        spread = weights[:, None, None] * normal - total / len(count)
        by_chance = np.sqrt((spread**2).sum(axis=0).max())
        if not np.linalg.eigvalsh(total)[0] > _PART_DEVIATIONS * by_chance:
            return _NO_STEP
        shift = np.linalg.solve(total, weights @ products)
    scores = weights[:, None] * (products - normal @ shift)
    inverse = np.linalg.inv(total)
    spread = inverse @ (scores.T @ scores) @ inverse
    return shift, spread * len(count) / (len(count) - 2)
