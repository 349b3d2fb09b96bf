"""Films of one pack aligned with each other.

- by the structure that they share, or by their edges: `register`; which way round they were
  scanned: `check_orientation`
- by marks that go through all of them: `poses_by_fiducials`
- the corners of a film after it was moved: `move_corners`

Films are cut and stacked by hand, so their edges determine their places within some pixels only.
The fine structure of the beam, which several films share, determines them within one. Holes
pierced through the assembled pack, or the ends of a cut, are at the same place on each film,
independent of the beam.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy import fft, ndimage
from scipy.optimize import isotonic_regression

from napari_shadowinv._system.progress import Reporter
from napari_shadowinv._typing import AnyArray, BoolArray, FloatArray
from napari_shadowinv.errors import InputError
from napari_shadowinv.film.scans import upright
from napari_shadowinv.physics.arrays import block_sums
from napari_shadowinv.preprocessing.noise import NORMAL_MAD

EDGE_ERROR_PX = 3.0  # standard deviation of a film's place by its edges
# Ways in which a film may lie, as flips of its rows and columns.
_WAYS_AROUND = {
    (True, True): "upside down: give its layer turned = 180",
    (False, True): "mirrored left to right: give its layer mirrored = true",
    (True, False): "mirrored top to bottom: give its layer mirrored = true, turned = 180",
}


@dataclass(frozen=True)
class TextureMatch:
    """How films are compared by their fine structure; chosen by ``benchmarks/film_pack.py``."""

    fine_blur: float = 2.0  # px; structure between these two sizes is compared
    coarse_blur: float = 12.0
    sampling: int = 2  # px to a sample, so few that no structure is lost
    margin: int = 30  # px; edges are burnt, and belong to the film, not to the beam
    reach: int = 12  # samples, of films from where their edges are
    neighbours: int = 2  # films before and behind that one is compared with
    parts: tuple[int, int] = (3, 5)  # along y and x, which must agree
    known_share: float = 0.99  # of usable pixels around a place that counts
    usable_share: float = 0.5  # of a part that counts
    correlation: float = 0.3  # of films, and of a part, that show the same
    agreeing_share: float = 0.6  # of the parts
    max_distance: float = 5.0  # px, at which parts that are further away count
    least_error: float = 0.1  # px, of a shift

    def disagreement(
        self, reference: FloatArray, moved: FloatArray, both: BoolArray, slopes: list[FloatArray]
    ) -> float | None:
        """Error of a shift by how far parts of the films are from it, or None if too few agree."""
        n_parts, away, weights = 0, [], []
        sides = zip(reference.shape, self.parts, strict=True)
        for places in product(*(np.array_split(np.arange(side), count) for side, count in sides)):
            part = np.ix_(*places)
            counts = both[part]
            if counts.mean() < self.usable_share:
                continue
            n_parts += 1
            fixed_part, moved_part = reference[part][counts], moved[part][counts]
            size = np.sqrt((fixed_part @ fixed_part) * (moved_part @ moved_part))
            if size == 0 or fixed_part @ moved_part < self.correlation * size:
                continue
            gain = (fixed_part @ moved_part) / (moved_part @ moved_part)
            design = gain * np.stack([slope[part][counts] for slope in slopes], axis=1)
            step = np.linalg.lstsq(design, fixed_part - gain * moved_part, rcond=None)[0]
            distance = np.clip(self.sampling * step, -self.max_distance, self.max_distance)
            away.append((distance**2).mean())
            weights.append((design**2).sum())
        if len(away) < max(2, self.agreeing_share * n_parts):
            return None
        return float(np.sqrt(np.average(away, weights=weights) / len(away)))


class Poses(NamedTuple):
    """How films lie against where their edges are."""

    shifts: FloatArray  # (n, 2), displacement (y, x) of their content, px
    turns: FloatArray  # (n,), the same as an angle about the middle in rad, from y towards x
    # (n,), standard deviation of a shift in px, against the film that it is best compared with, and
    # how far that moved it from its edges (r.m.s. along an axis)
    errors: FloatArray
    by_images: BoolArray  # (n,), whether neighbours share its structure; else only its edges count
    # How far the comparisons of films, or their fiducials, contradict each other: r.m.s. along an
    # axis in px, NaN if none can.
    closure: float

    @classmethod
    def by_edges(cls, count: int) -> Poses:
        """Return the poses of films by their edges alone."""
        return cls(
            np.zeros((count, 2)),
            np.zeros(count),
            np.full(count, EDGE_ERROR_PX),
            np.zeros(count, dtype=bool),
            float("nan"),
        )


class _Film(NamedTuple):
    image: FloatArray
    usable: BoolArray
    level: FloatArray  # smoothed, on the pixels that are compared
    texture: FloatArray  # fine structure there
    counts: BoolArray  # where the texture is known

    @classmethod
    def of(cls, image: FloatArray, usable: BoolArray, match: TextureMatch) -> _Film:
        """Return a film with its smooth and its fine structure, on fewer pixels."""
        weight = usable.astype(np.float64)
        filled = np.where(usable, image, 0.0)

        def smooth(size: float) -> tuple[FloatArray, FloatArray]:
            share = ndimage.gaussian_filter(weight, size)
            return ndimage.gaussian_filter(filled, size) / np.maximum(share, 1e-6), share

        (fine, share), (coarse, _) = smooth(match.fine_blur), smooth(match.coarse_blur)
        inner = np.zeros_like(usable)
        margin = min(match.margin, min(image.shape) // 8)
        inner[margin:-margin, margin:-margin] = True
        counts = inner & usable & (share > 0.9)
        few = 2 * (slice(match.sampling // 2, None, match.sampling),)
        texture = np.where(counts, fine - coarse, 0.0)
        return cls(image, usable, fine[few], texture[few], counts[few])

    def with_dose_of(self, other: _Film, match: TextureMatch, *, steps: int = 24) -> _Film:
        """Return the film with its dose mapped to another's by a monotone function.

        A kink of the calibration table shows as a line of equal dose, which moves with the dose.
        """
        both = self.counts & other.counts
        if both.sum() < steps**2:
            return self
        order = np.argsort(self.level[both])
        levels, values = (
            np.array([part.mean() for part in np.array_split(plane[both][order], steps)])
            for plane in (self.level, other.level)
        )
        values = isotonic_regression(values).x
        levels, starts = np.unique(levels, return_index=True)
        values = values[starts]
        if len(levels) < 2:
            return self
        mapped = np.asarray(np.interp(self.image, levels, values))
        # It goes on straight beyond its ends, where it would otherwise have kinks.
        slopes = np.diff(values) / np.diff(levels)
        mapped += slopes[0] * np.minimum(self.image - levels[0], 0.0)
        mapped += slopes[-1] * np.maximum(self.image - levels[-1], 0.0)
        return _Film.of(mapped, self.usable, match)


class _Pair(NamedTuple):
    first: int
    second: int
    shift: FloatArray
    turn: float
    error: float  # of the shift along one axis
    turn_error: float


@dataclass(frozen=True)
class MoveLimits:
    """How far a comparison may move films; chosen by ``benchmarks/film_pack.py``.

    Of corners, over the error of both films' edges: less if no third film of their kind confirms
    it, because the beam may have moved. A triangle of comparisons may stay open by the larger gap.
    Fields displace the structure by different amounts, too: of films with exact edges, by which
    fields came out 4 to 6 % wrong, images shifted by less than `from_edges` made it 10 to 17 %.
    """

    confirmed: float = 4.0
    alone: float = 2.5
    gap_errors: float = 3.0
    gap: float = 1.0  # px
    turn_error: float = 0.005  # rad, of a film's direction by its edges
    turns: float = 3.0  # times that of two films: sides of half a thousand pixels exclude more
    from_edges: float = 1.5  # px

    def credible(
        self, pairs: list[_Pair], edges: FloatArray, kinds: list[Hashable], shape: tuple[int, ...]
    ) -> list[_Pair]:
        """Comparisons that the edges of both films do not exclude."""
        credible = []
        to_corner = float(np.hypot(shape[0], shape[1])) / 2
        for pair in pairs:
            move = np.hypot(*pair.shift) + abs(pair.turn) * to_corner
            factor = self.confirmed if self._is_confirmed(pair, pairs, kinds) else self.alone
            is_within = move < factor * np.hypot(edges[pair.first], edges[pair.second])
            if is_within and abs(pair.turn) < self.turns * np.sqrt(2) * self.turn_error:
                credible.append(pair)
        return credible

    def _is_confirmed(self, pair: _Pair, pairs: list[_Pair], kinds: list[Hashable]) -> bool:
        """Whether comparisons of both films with a third one of their kind agree with a pair."""
        by_films: dict[tuple[int, int], tuple[FloatArray, float]] = {}
        for item in pairs:
            by_films[item.first, item.second] = item.shift, item.error
            by_films[item.second, item.first] = -item.shift, item.error
        for third, kind in enumerate(kinds):
            onwards, back = by_films.get((pair.first, third)), by_films.get((third, pair.second))
            is_alike = kind == kinds[pair.first] == kinds[pair.second]
            if not is_alike or onwards is None or back is None:
                continue
            gap = np.abs(onwards[0] + back[0] - pair.shift).max()
            error = np.sqrt(onwards[1] ** 2 + back[1] ** 2 + pair.error**2)
            if gap < max(self.gap, self.gap_errors * error):
                return True
        return False


def register(
    images: ArrayLike,
    usable: ArrayLike,
    *,
    spread: float | ArrayLike = EDGE_ERROR_PX,
    kinds: Sequence[Hashable] | None = None,
    match: TextureMatch = TextureMatch(),
    limits: MoveLimits = MoveLimits(),
    report: Reporter | None = None,
) -> Poses:
    """Align films by the structure that they share.

    Each film is compared with the next two: shift and turn by least squares on the fine structure,
    which must agree all over the film. Before, the dose of one film is mapped to the other's dose
    by a monotone function, so that lines of equal dose, such as kinks of a calibration table, are
    not structure. A comparison is refused if it turns films more than three times the error of
    their edges, or moves a corner by more than 2.5 times that error; 4 times, if comparisons with a
    third film of the same kind agree. Comparisons and edges together give the poses, each weighted
    by its error. Where no comparison is further than 1.5 px from the edges, edges count alone:
    fields displace the structure by different amounts, which looks like a shift. For the same
    reason the error of a film that was moved is no smaller than its move.

    The images, (n, H, W), are logarithms of the dose, upright, and `usable` where it is known. The
    spread is the standard deviation in px of a film's place by edges or marks. Films of one of the
    kinds, by default all, were cut alike, so that the edges of one are as far off as the edges of
    another. An `InputError` if shapes do not fit.
    """
    values, is_usable = np.asarray(images, np.float64), np.asarray(usable, bool)
    if values.ndim != 3 or is_usable.shape != values.shape:
        raise InputError(
            f"images have shape {values.shape}, masks {is_usable.shape}: expected both as "
            "(films, height, width)"
        )
    report = report or Reporter(None, None)
    edges = np.broadcast_to(np.asarray(spread, np.float64), len(values))
    alike: list[Hashable] = [None] * len(values) if kinds is None else list(kinds)
    films = [_Film.of(*planes, match) for planes in zip(values, is_usable, strict=True)]
    compared = []
    for first in range(len(films)):
        report("register", first, len(films))
        for second in range(first + 1, min(first + 1 + match.neighbours, len(films))):
            if (pair := _compare(first, second, films, match)) is not None:
                compared.append(pair)
    pairs = limits.credible(compared, edges, alike, values.shape[1:])
    poses = _fit_poses(pairs, edges, limits.turn_error)
    for k in np.flatnonzero(~poses.by_images):
        # Edges are as far off as those of films of the same kind that can be compared.
        peers = [j for j in np.flatnonzero(poses.by_images) if alike[j] == alike[k]]
        if peers:
            by_peers = np.sqrt(np.mean(poses.shifts[peers] ** 2))
            poses.errors[k] = max(poses.errors[k], by_peers)
    if not pairs or max(np.abs(pair.shift).max() for pair in pairs) > limits.from_edges:
        # What films show agrees to tenths of a pixel also where fields or the beam move it.
        moves = np.sqrt(np.mean(poses.shifts**2, axis=1))
        return poses._replace(errors=np.hypot(poses.errors, np.where(poses.by_images, moves, 0.0)))
    return poses._replace(
        shifts=np.zeros_like(poses.shifts),
        turns=np.zeros_like(poses.turns),
        errors=np.where(poses.by_images, limits.from_edges / 2, poses.errors),
    )


def move_corners(corners: ArrayLike, shift: ArrayLike, turn: float, scale: float) -> FloatArray:
    """Return corners of a film, moved and turned by its pose, which is in px of `scale`."""
    places = np.asarray(corners, np.float64)
    axes, middle, _ = upright(places)
    around = (places - middle) @ axes.T @ _rotation(turn)
    return np.asarray(middle + (around + scale * np.asarray(shift)) @ axes)


def check_orientation(
    images: ArrayLike,
    usable: ArrayLike,
    names: Sequence[str],
    *,
    block: int = 8,
    correlation: float = 0.7,
    deficit_ratio: float = 0.35,
) -> None:
    """Reject films that lie another way round than most films do, and name all of them.

    Neighbours must show the same large structure, turned or mirrored: where the films show too
    little, or their structure is symmetric, they are not rejected. Means over `block` px are
    compared. Turned over, a film must correlate better than `correlation`, with a deficit from 1
    below `deficit_ratio` of its deficit as it lies. The `InputError` says how each film was
    scanned.
    """
    # Large structure in few pixels, and how much of each of them is known.
    planes = []
    for image, mask in zip(np.asarray(images), np.asarray(usable), strict=True):
        counts = block_sums(mask, block)
        sums = block_sums(np.where(mask, image, 0.0), block)
        planes.append(np.stack([sums / np.maximum(counts, 1.0), counts / block**2]))
    flips = [(False, False)]  # of the rows and columns, so that films lie as the first
    clues = {}
    for number in range(1, len(planes)):
        before, film = (_flip(planes[k], flips[-1]) for k in (number - 1, number))
        as_is = _greatest_correlation(before, film)
        turned = {flip: _greatest_correlation(before, _flip(film, flip)) for flip in _WAYS_AROUND}
        best = max(turned, key=lambda flip: turned[flip])
        is_better = 1 - turned[best] < deficit_ratio * (1 - as_is)
        if is_better and turned[best] > correlation:
            clues[number] = f"correlation {as_is:.3f}, turned over {turned[best]:.3f}"
            rows, columns = flips[-1]
            flips.append((rows != best[0], columns != best[1]))
        else:
            flips.append(flips[-1])
    if not clues:
        return
    usual = max(flips, key=flips.count)
    ways = {
        number: _WAYS_AROUND[flip[0] != usual[0], flip[1] != usual[1]]
        for number, flip in enumerate(flips)
        if flip != usual
    }
    (first, way), *further = ways.items()
    clue = clues.get(first) or clues[min(clues)]
    neighbour = names[first - 1 if first else first + 1]
    if not further:
        subject = "one of them" if len(names) == 2 else "it"
        raise InputError(
            f"{names[first]} does not lie as {neighbour} does ({clue}): {subject} was scanned {way}"
        )
    raise InputError(
        f"{len(ways)} films do not lie as the others do ({clue}): "
        + "; ".join(f"{names[number]} was scanned {way}" for number, way in ways.items())
    )


def _flip(planes: FloatArray, flip: tuple[bool, bool]) -> FloatArray:
    return planes[:, :: -1 if flip[0] else 1, :: -1 if flip[1] else 1]


def _compare(first: int, second: int, films: list[_Film], match: TextureMatch) -> _Pair | None:
    """Pose of the second film against the first, or None if they do not show the same."""
    reference, reference_mask = films[first].texture, films[first].counts
    film = films[second].with_dose_of(films[first], match)
    shift, correlation = _coarse_shift(films[first], film, match.reach)
    if correlation < match.correlation:
        return None
    pose = np.array([*shift, 0.0])
    planes = [film.texture, film.counts.astype(np.float64), *np.gradient(film.texture)]
    y, x = _from_middle(reference.shape)
    for _ in range(25):
        moved, share, *slopes = _move(pose, planes)
        both = reference_mask & (share > match.known_share)
        c, s = np.cos(pose[2]), np.sin(pose[2])
        turning = slopes[0] * (-s * y - c * x) + slopes[1] * (c * y - s * x)
        design = np.stack([slope[both] for slope in (*slopes, turning)], axis=1)
        power = moved[both] @ moved[both]
        if not (power > 0 and (gain := (moved[both] @ reference[both]) / power) > 0):
            return None
        residual = reference[both] - gain * moved[both]
        usual = NORMAL_MAD * np.median(np.abs(residual)) + 1e-300
        weight = 1 / (1 + (residual / (2 * usual)) ** 2)
        normal = gain * design.T @ (weight[:, None] * design)
        step = np.linalg.lstsq(normal, design.T @ (weight * residual), rcond=None)[0]
        pose += step
        if np.abs(pose[:2]).max() > 2 * match.reach or abs(pose[2]) > 0.05:
            return None
        if np.abs(step[:2]).max() < 1e-3:
            break
    moved, share, *slopes = _move(pose, planes)
    both = reference_mask & (share > match.known_share)
    error = match.disagreement(reference, moved, both, slopes)
    if error is None:
        return None
    shift_error = max(match.least_error, error)
    # How much worse a turn is told follows from where the structure is.
    spread = np.diag(np.linalg.inv(normal)).copy()
    turn_error = shift_error / match.sampling * np.sqrt(spread[2] / spread[:2].mean())
    return _Pair(
        first, second, match.sampling * pose[:2], float(pose[2]), shift_error, float(turn_error)
    )


def _from_middle(shape: tuple[int, ...]) -> tuple[FloatArray, FloatArray]:
    y, x = np.indices(shape, dtype=np.float64)
    return y - (shape[0] - 1) / 2, x - (shape[1] - 1) / 2


def _move(pose: FloatArray, planes: list[FloatArray]) -> list[FloatArray]:
    """Planes of the second film as they lie on the first."""
    y, x = _from_middle(planes[0].shape)
    c, s = np.cos(pose[2]), np.sin(pose[2])
    at = [c * y - s * x - y[0, 0] + pose[0], s * y + c * x - x[0, 0] + pose[1]]
    return [ndimage.map_coordinates(plane, at, order=1) for plane in planes]


def _coarse_shift(first: _Film, second: _Film, reach: int) -> tuple[FloatArray, float]:
    """Whole pixels by which the second film correlates best, each counting where it is known."""
    sides = first.texture.shape
    shape = tuple(fft.next_fast_len(side + reach, real=True) for side in sides)

    def products(left: AnyArray, right: AnyArray) -> FloatArray:
        spectra = [fft.rfft2(plane.astype(np.float64), shape) for plane in (left, right)]
        return np.asarray(fft.irfft2(np.conj(spectra[0]) * spectra[1], shape))

    squares, moved_squares = first.texture**2, second.texture**2
    common = products(first.texture, second.texture)
    powers = products(squares, second.counts) * products(first.counts, moved_squares)
    least = 0.05 * float(squares.sum() * moved_squares.sum())
    alike = common / np.sqrt(np.maximum(powers, max(least, 1e-300)))
    near = np.arange(-reach, reach + 1)
    window = alike[np.ix_(near, near)]
    place = np.unravel_index(int(np.argmax(window)), window.shape)
    return near[list(place)].astype(np.float64), float(window[place])


def _fit_poses(pairs: list[_Pair], edges: FloatArray, turn_error: float) -> Poses:
    """The poses that comparisons and edges together make likeliest."""
    count = len(edges)
    normal, sides = np.diag(1 / np.square(edges)), np.zeros((count, 2))
    turns, turned = np.eye(count) / turn_error**2, np.zeros(count)
    is_compared = np.zeros(count, dtype=bool)
    for pair in pairs:
        difference = np.zeros(count)
        films = [pair.first, pair.second]
        difference[films] = -1.0, 1.0
        is_compared[films] = True
        both = np.outer(difference, difference)
        normal += both / pair.error**2
        sides += difference[:, None] * pair.shift / pair.error**2
        turns += both / pair.turn_error**2
        turned += difference * pair.turn / pair.turn_error**2
    covariance = np.linalg.inv(normal)
    variance = np.diag(covariance)
    between = variance[:, None] + variance - 2 * covariance + np.diag(np.full(count, np.inf))
    shifts = np.asarray(covariance @ sides)
    apart = [shifts[pair.second] - shifts[pair.first] - pair.shift for pair in pairs]
    closes = len(pairs) > is_compared.sum() - 1 if pairs else False
    return Poses(
        shifts,
        np.asarray(np.linalg.solve(turns, turned)),
        np.sqrt(between.min(axis=1) if count > 1 else variance),
        is_compared,
        float(np.sqrt(np.mean(np.square(apart)))) if closes else float("nan"),
    )


def _greatest_correlation(first: FloatArray, second: FloatArray, *, steps: int = 1) -> float:
    """Of two images with their known shares, over shifts by a few pixels."""
    greatest = -1.0
    for shift in product(range(-steps, steps + 1), repeat=2):
        on_first = tuple(slice(max(0, step) or None, min(0, step) or None) for step in shift)
        on_second = tuple(slice(max(0, -step) or None, min(0, -step) or None) for step in shift)
        (fixed, fixed_share), (moved, moved_share) = first[:, *on_first], second[:, *on_second]
        both = (fixed_share > 0.5) & (moved_share > 0.5)
        if both.sum() < both.size / 4:
            continue
        fixed_part, moved_part = fixed[both], moved[both]
        if np.ptp(fixed_part) > 0 and np.ptp(moved_part) > 0:
            greatest = max(greatest, float(np.corrcoef(fixed_part, moved_part)[0, 1]))
    return greatest


Points = Mapping[str, ArrayLike]


def poses_by_fiducials(
    points: Sequence[Points],
    corners: ArrayLike,
    scales: ArrayLike,
    names: Sequence[str],
    *,
    mark_error: float = 0.3,
    max_misfit: float = 10.0,
) -> Poses:
    """Find the poses of films by marks that are at the same place on each.

    One mark on a film determines its shift, two or more also its turn. A film without marks is
    aligned by its edges. Films are aligned to the mean of all, so a mark on one film has no effect.

    Each film has its marks by name, (y, x) in px of its scan, its corners, (4, 2), and a scale: px
    of its scan in a px of the images, which magnify with the depth in the pack. As marks are read
    off a scan, they err by `mark_error` px at least; further than `max_misfit` px from its place by
    the other marks, a mark has a wrong name. This is an `InputError`, as is no mark on two films.
    """
    film_marks = []  # px down and right from the film's middle
    for marks, film in zip(points, np.asarray(corners, np.float64), strict=True):
        axes, middle, _ = upright(film)
        places = {name: np.asarray(place, np.float64) - middle for name, place in marks.items()}
        film_marks.append({name: place @ axes.T for name, place in places.items()})
    counts = Counter(name for marks in film_marks for name in marks)
    shared = {name for name, count in counts.items() if count > 1}
    if not shared:
        raise InputError(
            "fiducials: no mark is on two films or more: give the marks that go through the pack "
            "the same name on each film"
        )
    film_marks = [
        {name: marks[name] for name in sorted(shared & marks.keys())} for marks in film_marks
    ]
    count = len(film_marks)
    shifts, turns = np.zeros((count, 2)), np.zeros(count)
    marked = [k for k in range(count) if film_marks[k]]
    for _ in range(50):
        common = _mean_places(film_marks, shifts, turns)
        for k in marked:
            shifts[k], turns[k] = _fit_rigid(film_marks[k], common)
        # The edges of all films determine their common position.
        shifts[marked] -= shifts[marked].mean(axis=0)
        turns[marked] -= turns[marked].mean()
    common = _mean_places(film_marks, shifts, turns)
    misfits = []
    for marks, shift, turn in zip(film_marks, shifts, turns, strict=True):
        away = (place - shift - common[name] @ _rotation(turn) for name, place in marks.items())
        misfits.append(np.array([np.hypot(*distance) for distance in away]))
    for name, misfit in zip(names, misfits, strict=True):
        if misfit.size and misfit.max() > max_misfit:
            raise InputError(
                f"fiducials: a mark on {name} is {misfit.max():.0f} px from its place by the marks "
                "of all films: correct its name or its place"
            )
    # Degrees of freedom left by the marks' common places and each film's pose.
    poses = [len(marks) and min(3, 1 + len(marks)) for marks in film_marks]
    spare = 2 * sum(map(len, film_marks)) - 2 * len(shared) - sum(poses) + max(poses)
    every = np.concatenate(misfits)
    closure = float(np.sqrt((every**2).sum() / spare)) if spare > 0 else float("nan")
    error = float(np.fmax(mark_error, closure))
    errors = [error / np.sqrt(len(marks)) if marks else EDGE_ERROR_PX for marks in film_marks]
    shifts /= np.asarray(scales, np.float64)[:, None]
    return Poses(shifts, turns, np.array(errors), np.zeros(count, dtype=bool), closure)


def _rotation(turn: float) -> FloatArray:
    c, s = np.cos(turn), np.sin(turn)
    return np.array([[c, s], [-s, c]])


def _mean_places(
    film_marks: list[dict[str, FloatArray]], shifts: FloatArray, turns: FloatArray
) -> dict[str, FloatArray]:
    """Return the mean place of each mark on aligned films."""
    brought: dict[str, list[FloatArray]] = {}
    for marks, shift, turn in zip(film_marks, shifts, turns, strict=True):
        for name, place in marks.items():
            brought.setdefault(name, []).append((place - shift) @ _rotation(turn).T)
    return {name: np.mean(places, axis=0) for name, places in brought.items()}


def _fit_rigid(
    marks: dict[str, FloatArray], common: dict[str, FloatArray]
) -> tuple[FloatArray, float]:
    """Fit the shift and turn from the common places to a film's marks, by least squares."""
    on_film = np.array(list(marks.values()))
    expected = np.array([common[name] for name in marks])
    common_away, film_away = (places - places.mean(axis=0) for places in (expected, on_film))
    across = common_away[:, 0] * film_away[:, 1] - common_away[:, 1] * film_away[:, 0]
    turn = float(np.arctan2(across.sum(), (common_away * film_away).sum()))  # 0 for one mark
    return (on_film - expected @ _rotation(turn)).mean(axis=0), turn
