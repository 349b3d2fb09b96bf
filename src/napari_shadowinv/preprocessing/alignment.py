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
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy import linalg, ndimage

from napari_shadowinv._typing import BoolArray, FloatArray
from napari_shadowinv.cautions import Caution
from napari_shadowinv.options import DEFAULT_REGISTRATION, REFERENCE_BEAM, BeamPrior, Instrument
from napari_shadowinv.physics.arrays import check_shape, complete_block_means
from napari_shadowinv.preprocessing.image_checks import border_ring
from napari_shadowinv.preprocessing.noise import NORMAL_MAD, finest_differences
from napari_shadowinv.preprocessing.pixels import LEAST_LIGHT, complete_blocks


@dataclass(frozen=True)
class ShiftSearch:
    """How a shift is searched for, as tests/preprocessing/test_alignment.py needs it."""

    side: int = 384  # most blocks of pixels along the longer side that are compared
    steps: int = 12
    longest: float = 3.0  # first step at most, in blocks; later ones are shorter
    coarse_side: int = 64  # the same, for a shift by whole blocks
    blur: float = 0.03  # of these, over the longer side
    overlap: float = 0.5  # of their borders
    misfit: float = 0.4  # over that without a shift, half and more for beams that merely differ
    cells: int = 24  # along the longer side, for the borders
    depths: tuple[int, ...] = (1, 2, 4)  # of the borders, in cells
    agreeing: float = 1.5  # errors of the shift by a border, for a deeper one to count
    # Of the beams over the expected one, and of structure of a quarter of its length
    differences: tuple[tuple[float, float], ...] = ((1, 0), (1, 2), (1, 8), (4, 0), (4, 8))
    blurs: tuple[float, float] = (1.0, 4.0)  # px, between which structure is the finest
    parts: int = 8  # along each side, for the finest structure
    deviations: float = 4.0  # of structure that image and source share


@dataclass(frozen=True, eq=False)
class Shift:
    """Shift of a source to its place in an image, (y, x) in px, with its standard deviations."""

    value: FloatArray
    error: FloatArray
    errors: float = 4.0  # above which it is significant
    least: float = 0.05  # px, below which interpolation would change more than it mends

    @property
    def is_significant(self) -> BoolArray:
        """Whether it is above four times its error and 0.05 px, along each axis."""
        return np.abs(self.value) > np.maximum(self.errors * self.error, self.least)

    @property
    def significant(self) -> FloatArray:
        """The shift along the axes where it is significant, 0 along others."""
        return np.where(self.is_significant, self.value, 0.0)

    @property
    def text(self) -> str:
        """The shift with its errors, such as "y +2.01 ± 0.10, x -0.96 ± 0.12 px"."""
        (y, x), (y_error, x_error) = self.value, self.error
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
    """A source in register with an image, interpolated with cubic splines.

    `error` is the standard deviation of the shift that is left, px, and assumed (`is_assumed`) if
    nobody stated it and nothing shows the shift. The caution says that the source was moved further
    than was expected.
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
    if _is_white(source, usable):
        return RegisteredSource(source, expected, is_assumed=instrument.registration is None)
    shift = measure_shift(image, source, usable, beam)
    error = shift.left(expected)
    if not shift.is_significant.any():
        is_assumed = instrument.registration is None and error == expected
        return RegisteredSource(source, error, is_assumed=is_assumed)
    moved = np.where(usable, move(source, shift.significant), 0.0)
    if np.abs(shift.significant).max() < shift.errors * expected:
        return RegisteredSource(moved, error)
    text = (
        f"register: the source was moved by {shift.text} to fit the image; what is left of the "
        "shift is in the error. State a registration of 0 if both are on the same pixels"
    )
    return RegisteredSource(moved, error, Caution("register", text))


def _is_white(
    plane: FloatArray, usable: BoolArray, *, deviations: float = 5.0, least: int = 50
) -> bool:
    """Return whether means over blocks, of a least number, scatter as for white noise."""
    relative, side = plane / plane[usable].mean(), 2
    variance = float(relative[usable].var())
    while (full := complete_blocks(usable, side)).sum() > least:
        share = float(complete_block_means(relative, side)[full].var()) * side**2 / variance
        if abs(share - 1) > deviations * np.sqrt(2 / full.sum()):
            return False
        side *= 2
    return side > 2


def move(source: FloatArray, shift: FloatArray) -> FloatArray:
    """Return a source that was shifted by px along y and x; its slopes go on beyond its edges."""
    width = min(int(np.ceil(np.abs(shift).max())) + 2, min(source.shape) - 1)
    padded = np.pad(source, width, mode="reflect", reflect_type="odd")
    inside = np.s_[width:-width, width:-width]
    moved = ndimage.shift(padded, shift, mode="mirror")
    return np.asarray(np.maximum(moved[inside], 0.0))


def measure_shift(
    image: FloatArray,
    source: FloatArray,
    mask: BoolArray | None = None,
    beam: BeamPrior = REFERENCE_BEAM,
    search: ShiftSearch = ShiftSearch(),
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
    search : ShiftSearch

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
    block = -(-max(image.shape) // search.side)
    complete = complete_blocks(usable, block)
    planes = (complete_block_means(plane, block) for plane in (image, source))
    if not complete.any():
        return Shift(np.zeros(2), np.full(2, 1e3))
    shot, reference = (np.where(complete, p / max(p[complete].mean(), 1e-300), 1.0) for p in planes)
    value = _coarse_shift(shot, reference, complete, search)
    fixed = _Structure.of(shot, search)
    for step in range(search.steps):
        moved = _Structure.of(ndimage.shift(reference, value, mode="mirror"), search)
        both = fixed, moved, complete
        steps = _by_borders(*both, beam, search), _by_finest(*both, search)
        weights = [np.linalg.inv(covariance) for _, covariance in steps]
        covariance = np.linalg.inv(sum(weights))
        change = covariance @ sum(w @ move for w, (move, _) in zip(weights, steps, strict=True))
        error = np.sqrt(np.diag(covariance))
        is_settled = (np.abs(change) < (1.0 if step else 2.0) * error).all()
        longest = search.longest / (1 + step)
        value = value + (change if is_settled else np.clip(change, -longest, longest))
        if is_settled or error.max() > search.longest:
            break
    return Shift(block * value, block * error)


def _coarse_shift(
    shot: FloatArray, source: FloatArray, usable: BoolArray, search: ShiftSearch
) -> FloatArray:
    """Return the shift at which borders correlate best, in coarse pixels; 0 if none fits better."""
    from skimage.registration import phase_cross_correlation

    block = -(-max(shot.shape) // search.coarse_side)
    border = complete_blocks(usable, block)
    border &= border_ring(border.shape)
    shot, source = (
        ndimage.gaussian_filter(complete_block_means(plane, block), search.blur * max(border.shape))
        for plane in (shot, source)
    )
    if not (np.ptp(shot[border]) > 0 and np.ptp(source[border]) > 0):
        return np.zeros(2)
    correlate: Callable[..., tuple[FloatArray, float, float]] = phase_cross_correlation
    found_shift, *_ = correlate(
        shot, source, reference_mask=border, moving_mask=border, overlap_ratio=search.overlap
    )

    shift = np.asarray(found_shift, dtype=np.float64)
    both = border & ndimage.shift(border, shift, order=0, cval=False)

    def misfit(beam: FloatArray, where: BoolArray) -> float:
        difference = shot[where] / shot[where].mean() - beam[where] / beam[where].mean()
        return float(np.median(np.abs(difference)))

    # Where they overlap, a beam without structure must not fit as well.
    moved = misfit(ndimage.shift(source, shift, order=1), both)
    unmoved = min(misfit(source, border), misfit(np.ones_like(source), both))
    return block * shift if moved < search.misfit * unmoved else np.zeros(2)


Step = tuple[FloatArray, FloatArray]
"""A shift, (2,), and its covariance, (2, 2)."""

_NO_STEP: Step = (np.zeros(2), 1e6 * np.eye(2))


@dataclass(frozen=True, eq=False)
class _Structure:
    """Structure by which an image and a source are compared.

    `levels` and `slopes` are means over square cells, of the plane and its smoothed gradient,
    (2, h, w); `finest` is the structure between two widths.
    """

    cell: int
    levels: FloatArray
    slopes: FloatArray
    finest: FloatArray

    @classmethod
    def of(cls, plane: FloatArray, search: ShiftSearch) -> _Structure:
        cell = max(2, -(-max(plane.shape) // search.cells))
        smooth = ndimage.gaussian_filter(plane, cell / 2)
        slopes = np.stack([complete_block_means(each, cell) for each in np.gradient(smooth)])
        fine, coarse = (ndimage.gaussian_filter(plane, width) for width in search.blurs)
        return cls(cell, complete_block_means(plane, cell), slopes, fine - coarse)


def _by_borders(
    shot: _Structure, source: _Structure, usable: BoolArray, beam: BeamPrior, search: ShiftSearch
) -> Step:
    """Return the shift by the ratio of image and source near the borders."""
    cell = shot.cell
    if min(usable.shape) < 3 * cell:
        return _NO_STEP
    lit = complete_blocks(usable, cell) & (source.levels > LEAST_LIGHT)
    level = np.where(lit, source.levels, 1.0)
    ratio = shot.levels / level - 1
    patterns = [-each.slopes / level for each in (source, shot)]
    down, right = np.indices(lit.shape)
    depths = np.minimum(
        np.minimum(down, right), np.minimum(lit.shape[0] - down, lit.shape[1] - right) - 1
    )
    places = np.argwhere(lit & (depths < max(search.depths)))
    places = places[np.argsort(depths[tuple(places.T)], kind="stable")]
    order = tuple(places.T)
    counts = [count for depth in search.depths if (count := int((depths[order] < depth).sum())) > 8]
    if not counts:
        return _NO_STEP
    of_source, of_shot = (
        np.stack([np.ones(len(places)), *(pattern[order] for pattern in both)], axis=1)
        for both in patterns
    )
    columns = np.column_stack([of_source, of_shot, ratio[order]])
    noise = max(_noise_of(ratio, lit), 1e-5**2)
    best = _NO_STEP
    places = cell / min(usable.shape) * places
    shifts = _likeliest_shifts(columns, places, counts, noise, beam, search)
    for step in shifts:
        # Deeper borders show more, until they reach the object.
        allowed = search.agreeing * np.sqrt(np.diag(best[1]))
        if best is _NO_STEP or (np.abs(step[0] - best[0]) < allowed).all():
            best = min(best, step, key=lambda each: float(np.trace(each[1])))
    return best


def _noise_of(ratio: FloatArray, lit: BoolArray) -> float:
    """Return the variance of noise in the outermost cells."""
    used = lit[1:, 1:] & lit[1:, :-1] & lit[:-1, 1:] & lit[:-1, :-1]
    used[1:-1, 1:-1] = False
    return float(NORMAL_MAD * np.median(finest_differences(ratio, used))) ** 2


def _likeliest_shifts(
    columns: FloatArray,
    places: FloatArray,
    counts: list[int],
    noise: float,
    beam: BeamPrior,
    search: ShiftSearch,
) -> list[Step]:
    """Return the shifts by increasing numbers of the first cells.

    By generalised least squares with the likeliest difference of beams. `columns` (n, 7) are three
    patterns of the source, as many of the image, and the ratio of both.
    """
    squares = sum((line[:, None] - line) ** 2 for line in places.T)
    long, short = (np.exp(squares / (-2 * length**2)) for length in (beam.length, beam.length / 4))
    best, likeliest = [_NO_STEP] * len(counts), [-np.inf] * len(counts)
    for of_beam, of_rest in search.differences:
        covariance = (beam.rms * of_beam) ** 2 * long
        covariance += (beam.rms * of_rest) ** 2 * short
        covariance.flat[:: len(places) + 1] += noise
        # Its first rows are the root of the first cells' covariance.
        root = linalg.cholesky(covariance, lower=True, check_finite=False)
        white = linalg.solve_triangular(root, columns, lower=True, check_finite=False)
        logarithms = np.cumsum(np.log(np.diag(root)))
        for k, count in enumerate(counts):
            source, shot, values = white[:count, :3], white[:count, 3:6], white[:count, 6]
            normal, square = source.T @ shot, source.T @ source
            if not (np.linalg.cond(normal) < 1e12 and np.linalg.cond(square) < 1e12):
                continue
            residual = values - source @ np.linalg.solve(square, source.T @ values)
            misfit = float((residual**2).sum())
            evidence = -misfit / 2 - float(logarithms[count - 1])
            if evidence > likeliest[k]:
                likeliest[k], inverse = evidence, np.linalg.inv(normal)
                spread = inverse @ square @ inverse.T * max(1.0, misfit / count)
                best[k] = (inverse @ (source.T @ values))[1:], spread[1:, 1:]
    return best


def _by_finest(
    shot: _Structure, source: _Structure, usable: BoolArray, search: ShiftSearch
) -> Step:
    """Return the shift by the finest structure, with an error by the scatter of parts."""
    side = search.parts
    fine, sharp = source.finest, shot.finest
    inner = ndimage.minimum_filter(usable, 9, mode="constant", cval=False)
    rows, columns = (np.arange(count) * side // count for count in usable.shape)
    parts = (rows[:, None] * side + columns)[inner]
    difference = (sharp - fine)[inner][None]
    slopes, instruments = (-np.array(np.gradient(plane))[:, inner] for plane in (sharp, fine))

    def sums(first: FloatArray, second: FloatArray) -> FloatArray:
        """Return sums of products over each part, (parts, first, second)."""
        products = [[np.bincount(parts, a * b, side**2) for b in second] for a in first]
        return np.moveaxis(np.array(products), 2, 0)

    count = np.bincount(parts, minlength=side**2)
    is_filled = count > 0
    if is_filled.sum() < side:
        return _NO_STEP
    normal = sums(instruments, slopes)[is_filled]
    normal = (normal + normal.transpose(0, 2, 1)) / 2
    squares, products = (sums(instruments, each)[is_filled] for each in (instruments, difference))
    squared = sums(difference, difference)[is_filled, 0, 0]
    products, count = products[..., 0], count[is_filled]
    shift = np.zeros(2)
    for _ in range(3):
        explained = 2 * products @ shift - np.einsum("tij,i,j->t", squares, shift, shift)
        weights = count / np.maximum(squared - explained, 1e-12 * count)
        total = np.einsum("t,tij->ij", weights, normal)
        spread = weights[:, None, None] * normal - total / len(count)
        by_chance = np.sqrt((spread**2).sum(axis=0).max())
        if not np.linalg.eigvalsh(total)[0] > search.deviations * by_chance:
            return _NO_STEP
        shift = np.linalg.solve(total, weights @ products)
    scores = weights[:, None] * (products - normal @ shift)
    inverse = np.linalg.inv(total)
    spread = inverse @ (scores.T @ scores) @ inverse
    return shift, spread * len(count) / (len(count) - 2)
