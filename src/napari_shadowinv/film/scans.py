"""Films on the bed of a scanner.

- their corners: `find_films`
- one of them cut out and turned upright: `straighten_film`
- corners from a table and to one: `read_corners`, `write_corners`
- pixels without writing, scratches, cuts and rim: `usable_pixels`; along edges that heat or light
  has darkened: `burnt_edges`

Corners are in px of the scan, (y, x), from the film's top left in the direction of reading, shape
(4, 2); a scan has shape (H, W, 3).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike
from scipy import ndimage

from napari_shadowinv._system.tables import read_rows, write_cells
from napari_shadowinv._system.validation import CheckedModel
from napari_shadowinv._typing import AnyArray, BoolArray, FloatArray
from napari_shadowinv.errors import InputError
from napari_shadowinv.film.calibration import Calibration, checked_scan, net_optical_density
from napari_shadowinv.preprocessing.noise import NORMAL_MAD

_Line = tuple[float, float]  # offset and slope


class _CornerRow(CheckedModel):
    """Corners of a film, in px of its scan."""

    film: str
    y1: float
    x1: float
    y2: float
    x2: float
    y3: float
    x3: float
    y4: float
    x4: float


@dataclass(frozen=True)
class SideFit:
    """Search for films on the bed, and for lines along their sides; lengths in px."""

    brightness: float = 0.75  # of a film, over the bed's, in the film's darkest colour
    least: float = 0.02  # area of a film, of the scan's
    dust: int = 2
    ends: float = 0.08  # of a side, where it does not count: corners are cut and bent
    offset: float = 0.04  # of the film's size, from a side to its border
    reach: float = 6.0  # of the search from a side
    blur: float = 2.0  # of a side
    step: float = 0.5  # of the search
    outlier: float = 0.1  # from its line, at least


@dataclass(frozen=True)
class MarkCheck:
    """Limits of a mark on a film, chosen by the tests of films with writing and without."""

    sampling: int = 8  # px between the samples of the smooth background
    background: int = 13  # samples, side of the median that gives the background
    scatter: int = 25  # samples, side of the median that gives its scatter
    scatters: float = 6.0  # by which a mark differs from the background
    density: float = 0.04  # by which it differs, too, in optical density
    blur: float = 1.0  # px
    area: int = 4  # px
    gap: int = 3  # px, that is closed
    margin: int = 2  # px, by which marks are widened


@dataclass(frozen=True)
class BurnCheck:
    """Limits of a burnt edge; on real EBT3: 1.6 to 40 times the dose, over in 8 to 38 px."""

    depth: int = 40  # px, at most
    cut: int = 3  # px, the outermost, which are partly bed
    length: int = 6  # px
    fall: float = 0.35  # of the logarithm of the dose over that length: a factor of 1.4
    to_inside: float = 3.0  # times the slope further in, so that a beam is not taken for a burn
    rise: float = 0.2  # of the logarithm, everywhere between the edge and the fall
    along: int = 21  # px along the edge, of the median that removes grain and writing
    share: float = 0.3  # of a side: fire follows edges, fronts of the beam cross them
    margin: int = MarkCheck.margin


def find_films(scan: ArrayLike, sides: SideFit = SideFit()) -> list[FloatArray]:
    """Return the corners, (4, 2), of the films on a scan, row by row as one reads.

    The scan, (H, W, 3), has films on a bright bed, none of which touches another, or is smaller
    than a seventh of the scan's sides. Corners are those of straight lines along the sides; chips
    and notches do not count. An `InputError` if there is no film, or the scan has no colours.
    """
    values = checked_scan(scan)
    darkest = values.min(axis=-1)
    dark = darkest < sides.brightness * np.percentile(darkest, 99.0)
    inside = ndimage.binary_opening(dark, np.ones((3, 3)), iterations=sides.dust)
    labels, _ = ndimage.label(inside)
    sizes = np.bincount(labels.ravel())
    boxes = enumerate(ndimage.find_objects(labels), 1)
    films = [(number, box) for number, box in boxes if sizes[number] >= sides.least * dark.size]
    if not films:
        raise InputError(
            "no film was found on the scan: expected films darker than a bright bed around them; "
            "give their corners"
        )
    corners = []
    for number, box in films:
        film = ndimage.binary_fill_holes(labels[box] == number)
        top_left = np.array([part.start for part in box])
        corners.append(_sharpen_corners(values, _fit_rectangle(film, sides) + top_left, sides))
    return _in_reading_order(corners)


def straighten_film(
    scan: ArrayLike, corners: ArrayLike, *, shape: tuple[int, int] | None = None, scale: float = 1.0
) -> AnyArray:
    """Return a film cut out of a scan, (H, W) or (H, W, C), and turned upright.

    Its shape is by default the film's, the scale the side of its pixels in px of the scan. Cubic
    between the scan's pixels, within their range; constant beyond its edge.
    """
    values = np.asarray(scan)
    axes, middle, size = upright(checked_corners(corners))
    height, width = (round(side / scale) for side in size) if shape is None else shape
    y, x = np.mgrid[:height, :width].astype(np.float64)
    steps = scale * np.stack([y - (height - 1) / 2, x - (width - 1) / 2])
    at = middle[:, None, None] + np.einsum("kc,kyx->cyx", axes, steps)
    planes = values[..., None] if values.ndim == 2 else values
    cut = []
    for c in range(planes.shape[-1]):
        plane = planes[..., c].astype(np.float64)
        # Cubic, because linear interpolation would blur film and noise, here more and there less.
        smooth = ndimage.map_coordinates(plane, at, order=3, mode="nearest")
        cut.append(np.clip(smooth, plane.min(), plane.max()))
    return cut[0] if values.ndim == 2 else np.stack(cut, axis=-1)


def common_shape(sizes: ArrayLike) -> tuple[int, int]:
    """Return the common shape for straightened films of sizes (n, 2)."""
    height, width = np.median(np.asarray(sizes, np.float64), axis=0)
    return round(height), round(width)


def checked_corners(corners: ArrayLike) -> FloatArray:
    """Return corners, or raise an `InputError`."""
    places = np.asarray(corners, dtype=np.float64)
    if places.shape != (4, 2) or not np.isfinite(places).all():
        raise InputError(
            f"corners have shape {places.shape}: expected (y, x) of four, from the top left in "
            "the direction of reading"
        )
    sides = np.roll(places, -1, axis=0) - places
    turns = sides[:, 0] * np.roll(sides, -1, axis=0)[:, 1]
    turns -= sides[:, 1] * np.roll(sides, -1, axis=0)[:, 0]
    if not (turns < 0).all():
        raise InputError(
            f"corners {places.round(1).tolist()} do not go around a film in the direction of "
            "reading: expected top left, top right, bottom right, bottom left, each as (y, x)"
        )
    return places


def _fit_rectangle(film: BoolArray, sides: SideFit) -> FloatArray:
    """Return the corners of lines along the four sides of a region."""
    from scipy.spatial import ConvexHull

    border = np.argwhere(film & ~ndimage.binary_erosion(film)).astype(np.float64)
    hull = border[ConvexHull(border).vertices]
    axes = _axes_of_smallest_box(hull)
    for _ in range(2):  # the second time in the direction of the film, not of its hull
        turned = border @ axes.T
        lines = [_fit_side(turned, axis, end, sides) for axis in (0, 1) for end in (0, 1)]
        # From the middle of the border's pixels to their outer edge.
        outward = 0.5 * np.array([[-1, -1], [-1, 1], [1, 1], [1, -1]])
        places = (_intersections(lines) + outward) @ axes
        (axes, _, _) = upright(places)
    return places


def _axes_of_smallest_box(hull: FloatArray) -> FloatArray:
    """Return unit vectors (down, right) along the sides of the smallest box around points."""
    best, box_axes = np.inf, np.eye(2)
    for step in np.diff(hull, axis=0, append=hull[:1]):
        along = step / np.hypot(*step)
        axes = np.stack([along, [-along[1], along[0]]])
        area = np.ptp(hull @ axes.T, axis=0).prod()
        if area < best:
            best, box_axes = area, axes
    down = box_axes[np.argmax(np.abs(box_axes[:, 0]))]
    down = down * np.sign(down[0])
    return np.stack([down, [-down[1], down[0]]])


def _fit_side(border: FloatArray, axis: int, end: int, sides: SideFit) -> _Line:
    """Fit offset and slope of the line along most of the pixels at one end of an axis."""
    low, high = ends = border.min(axis=0), border.max(axis=0)
    along, across = border[:, 1 - axis], border[:, axis]
    size = (high - low)[1 - axis]
    inner = np.abs(along - (low + high)[1 - axis] / 2) < (0.5 - sides.ends) * size
    near = np.abs(across - ends[end][axis]) < sides.offset * max(high - low)
    return _fit_line(along[inner & near], across[inner & near], 0.5)


def _fit_line(along: FloatArray, across: FloatArray, usual: float, most: float = 2.5) -> _Line:
    """Fit a line to points within `most` deviations; those closer than `usual` are no outliers."""
    used = np.ones(along.size, bool)
    slope = offset = 0.0
    for _ in range(8):
        slope, offset = np.polyfit(along[used], across[used], 1)
        away = np.abs(across - offset - slope * along)
        used = away <= max(most * 1.5 * np.median(away), usual)
    return float(offset), float(slope)


def _intersections(lines: Sequence[_Line]) -> FloatArray:
    """Return the corners of a film, from its upper, lower, left and right side."""
    upper, lower, x_low, x_high = lines
    corners = []
    for (a, b), (c, d) in ((upper, x_low), (upper, x_high), (lower, x_high), (lower, x_low)):
        y = (a + b * c) / (1 - b * d)
        corners.append((y, c + d * y))
    return np.array(corners)


def _sharpen_corners(scan: AnyArray, corners: FloatArray, sides: SideFit) -> FloatArray:
    """Refine corners to a part of a pixel, by the share of film in each pixel at the sides."""
    # The border of a mask has steps of a pixel, which average out only along a tilted side.
    axes, middle, size = upright(corners)
    darkest = scan.min(axis=-1).astype(np.float64)
    lines = []
    for axis in (0, 1):
        half = size[axis] / 2
        count = round((1 - 2 * sides.ends) * size[1 - axis])
        along = np.arange(count) - (count - 1) / 2
        for sign in (-1, 1):

            def sample(across: FloatArray) -> FloatArray:
                """Interpolate the scan on lines across the side, from inside outwards."""
                places = np.empty((len(along), across.shape[-1], 2))  # noqa: B023
                places[..., axis] = sign * (half + across)  # noqa: B023
                places[..., 1 - axis] = along[:, None]  # noqa: B023
                at = np.moveaxis(places @ axes + middle, -1, 0)
                return np.asarray(ndimage.map_coordinates(darkest, at, order=1, mode="nearest"))

            edge, clear = _find_edge(sample, sides)
            if clear.mean() < 0.5:
                return corners
            offset, slope = _fit_line(along[clear], edge[clear], sides.outlier)
            lines.append((sign * (half + offset), sign * slope))
    return np.asarray(middle + _intersections(lines) @ axes)


def _find_edge(
    sample: Callable[[FloatArray], FloatArray], sides: SideFit
) -> tuple[FloatArray, BoolArray]:
    """Return where lines cross the edge from film to bed, and which of them do so clearly."""
    across = np.arange(-sides.reach, sides.reach + sides.step, sides.step)
    values = sample(across)
    bed, film = values[:, -1], values[:, 0]
    inside = values < ((bed + film) / 2)[:, None]
    last = inside.shape[1] - 1 - np.argmax(inside[:, ::-1], axis=1)
    clear = (film < sides.brightness * bed) & inside.any(axis=1) & (last < inside.shape[1] - 1)
    about = across[last] + sides.step / 2
    # Pixels are means over their squares: their deficit against the bed gives the edge exactly.
    near = np.arange(-sides.blur, sides.blur + sides.step, sides.step)
    values = sample(about[:, None] + near)
    bed, film = values[:, -1:], values[:, :1]
    clear &= film[:, 0] < sides.brightness * bed[:, 0]
    shares = np.divide(bed - values, bed - film, out=np.zeros_like(values), where=clear[:, None])
    return about - sides.blur + np.trapezoid(shares, dx=sides.step, axis=1), clear


def upright(corners: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return unit vectors (down, right) of a film, its middle, and its height and width."""
    top_left, top_right, bottom_right, bottom_left = corners
    across = (top_right - top_left + bottom_right - bottom_left) / 2
    down = (bottom_left - top_left + bottom_right - top_right) / 2
    # One direction of both, as films are cut at right angles.
    right = across + np.array([-down[1], down[0]])
    right = right / np.hypot(*right)
    axes = np.stack([[right[1], -right[0]], right])
    size = np.array([np.hypot(*down), np.hypot(*across)])
    return axes, corners.mean(axis=0), size


def _in_reading_order(films: Sequence[FloatArray]) -> list[FloatArray]:
    """Sort films row by row; films whose middles differ by less than half a height form a row."""
    ordered = sorted(films, key=lambda film: film[:, 0].mean())
    rows: list[list[FloatArray]] = []
    for film in ordered:
        height = np.ptp(film[:, 0])
        if rows and film[:, 0].mean() - rows[-1][0][:, 0].mean() < height / 2:
            rows[-1].append(film)
        else:
            rows.append([film])
    return [film for row in rows for film in sorted(row, key=lambda film: film[:, 1].mean())]


def read_corners(path: str | Path) -> dict[str, FloatArray]:
    """Read a table of corners: film, y1, x1, … y4, x4.

    A `FileFormatError` if the file is no table; an `InputError` if it has other columns, or corners
    do not go around a film.
    """
    corners = {}
    for line, row in read_rows(Path(path), _CornerRow).items():
        name, *places = row.model_dump().values()
        try:
            corners[name] = checked_corners(np.reshape(places, (4, 2)))
        except InputError as error:
            raise error.about(f"{path}, line {line}") from None
    return corners


def write_corners(path: str | Path, films: dict[str, FloatArray]) -> None:
    """Write a table that `read_corners` reads."""
    columns = list(_CornerRow.model_fields)
    rows = [
        dict(zip(columns, [name, *(f"{value:.2f}" for value in np.ravel(corners))], strict=True))
        for name, corners in films.items()
    ]
    write_cells(Path(path), columns, rows)


def usable_pixels(
    film: ArrayLike,
    calibration: Calibration,
    *,
    background: Sequence[float] | ArrayLike | None = None,
    rim: int = 6,
    marks: MarkCheck = MarkCheck(),
) -> BoolArray:
    """Return the pixels, (H, W), of an upright film, (H, W, 3), whose dose can be trusted.

    The darkening of exposed film in blue follows from its darkening in red. At ink, scratches,
    notches, dust and burnt edges, the blue differs from its surroundings. A scratch that only
    removes part of the active layer looks like less dose, a grey mark on nearly black film like
    more. The background is the pixel of unexposed film, by default the calibration's; the rim in px
    along the edges does not count. An `InputError` if the film has no colours, or the rim leaves
    nothing of it.
    """
    values = checked_scan(film)
    if not 0 <= 2 * rim < min(values.shape[:2]):
        raise InputError(
            f"the rim is {rim} px on a film of {values.shape[0]} × {values.shape[1]} px: expected "
            "a few px"
        )
    unexposed = np.asarray(calibration.background if background is None else background, float)
    red, blue = (
        net_optical_density(np.maximum(values, 1), unexposed, channel)
        for channel in ("red", "blue")
    )
    table = np.log10(unexposed / calibration.pixels[np.argsort(calibration.doses)])
    expected = np.interp(red, np.maximum.accumulate(table[:, 0]), table[:, 2])
    excess = ndimage.gaussian_filter(blue - expected, marks.blur)
    first, step = marks.sampling // 2, marks.sampling
    samples = excess[first::step, first::step]
    usual = ndimage.median_filter(samples, marks.background, mode="nearest")
    scatter = ndimage.median_filter(np.abs(samples - usual), marks.scatter, mode="nearest")
    least = _resample(marks.scatters * NORMAL_MAD * scatter, excess, step)
    away = np.abs(excess - _resample(usual, excess, step))
    marked = away > np.maximum(least, marks.density)
    labels, _ = ndimage.label(marked)
    marked &= np.bincount(labels.ravel())[labels] >= marks.area
    disc = ndimage.iterate_structure(ndimage.generate_binary_structure(2, 1), marks.gap)
    border = 2 * marks.gap
    closed = ndimage.binary_closing(np.pad(marked, border), disc)[border:-border, border:-border]
    usable = ~ndimage.binary_dilation(closed, iterations=marks.margin)
    for view in (usable, usable[::-1], usable.T, usable.T[::-1]):
        view[:rim] = False
    return np.asarray(usable)


def burnt_edges(dose: ArrayLike, *, burn: BurnCheck = BurnCheck()) -> BoolArray:
    """Return the pixels along burnt edges of an upright film, which look like dose, (H, W).

    Heat and light darken a film as protons do, so colours do not show it. But the dose then falls
    steeply from the edge inwards, along a good part of a side, and hardly any more further in.
    """
    logarithm = np.log(np.asarray(dose, np.float64))
    burnt = np.zeros(logarithm.shape, dtype=bool)
    for turns in range(4):
        # A view: marks on it are marks on the film.
        side = np.rot90(burnt, turns)
        side |= _burnt_top(np.rot90(logarithm, turns), burn)
    return burnt


def _burnt_top(logarithm: FloatArray, burn: BurnCheck) -> BoolArray:
    """Mark the burnt pixels along the upper side."""
    height = len(logarithm)
    reach = min(burn.depth, height // 6)
    burnt = np.zeros(logarithm.shape, dtype=bool)
    if reach <= burn.cut or height < reach + 4 * burn.length:
        return burnt
    top = logarithm[burn.cut : reach + 4 * burn.length]
    smooth = ndimage.median_filter(top, (3, burn.along), mode="nearest")
    depths = np.arange(reach - burn.cut)
    outside, inside, beyond = (smooth[depths + n * burn.length] for n in (0, 1, 3))
    fall = outside - inside
    is_steep = fall > np.maximum(burn.fall, burn.to_inside * (inside - beyond) / 2)
    is_higher = np.minimum.accumulate(outside, axis=0) > inside + burn.rise
    ends = np.where(is_steep & is_higher, depths[:, None] + 1, 0).max(axis=0)
    if (ends > 0).mean() < burn.share:
        return burnt
    # Under a bright beam the fall is hidden: there the burn is as deep as elsewhere on this side.
    ends = np.where(ends > 0, ends, np.median(ends[ends > 0]))
    ends = ndimage.maximum_filter1d(ends + burn.cut + burn.length + burn.margin, burn.along)
    return np.asarray(np.arange(height)[:, None] < ends)


def _resample(samples: FloatArray, image: FloatArray, step: int) -> FloatArray:
    places = np.mgrid[: image.shape[0], : image.shape[1]] / step - 0.5
    return np.asarray(ndimage.map_coordinates(samples, places, order=1, mode="nearest"))
