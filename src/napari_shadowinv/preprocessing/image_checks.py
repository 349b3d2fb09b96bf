"""Checks of an image and its reference for violated assumptions of an inversion.

- all of them, as cautions: `image_cautions`
- of one image: `CheckedImage`, `stray_pixels`
- of an image and its reference: `dark_level`, `is_negative`
- pixels that carry no light, and are masked: `mask_gaps`, `mask_dark`

An image must be linear in the fluence, without offset, and on the same pixels as its reference.
No check changes a value: each sentence states the observation, its effect on the field, and the
step that helps. docs/trust.md lists the errors that no image shows: the offset of an image without
deep shadows, the gamma of a detector.

The limits were chosen with `benchmarks/wrong_inputs.py`, which counts how many wrong inputs are
noticed, and how often right ones cause an alarm.

An offset shows in the noise. The variance of counts is proportional to the signal, so it vanishes
where the signal does (photon transfer). Noise of reading moves that point below the offset, never
above. Noise in proportion to the signal, as from uneven pixels, moves it above; only deep shadows
distinguish it from an offset. A recorded source has the same uneven pixels as the image, so their
common pattern limits such noise, and shadows need not be deep.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy import ndimage

from napari_shadowinv._typing import BoolArray, FloatArray
from napari_shadowinv.cautions import Caution
from napari_shadowinv.facts import percent
from napari_shadowinv.physics.arrays import complete_block_means, order_by_value
from napari_shadowinv.preprocessing.noise import NORMAL_MAD
from napari_shadowinv.preprocessing.pixels import LEAST_LIGHT, complete_blocks, nonnegative_fit

_WINDOW_PX = 4  # side of the squares in which noise is measured
_INDEPENDENT_SHARE = 4 / 9  # of the differences in them, which share pixels


@dataclass(frozen=True)
class DarkCheck:
    """Limits of pixels without light, over the light elsewhere (`benchmarks/wrong_inputs.py`)."""

    sides: tuple[int, int] = (3, 9)  # of the squares for darkness, and for noise, px
    dark: float = 0.03  # without doubt
    dim: float = 0.1  # if the noise exceeds it
    noise: float = 0.8  # of the light, per pixel
    edge: tuple[int, int] = (6, 9)  # px outside a dark region, where a window is lit
    lit: float = 0.3  # there
    # Without a source a beam may fall smoothly, and an object pile up light around a hollow.
    sharp_edge: tuple[int, int] = (2, 4)
    sharply_lit: tuple[float, float] = (0.4, 1.5)


@dataclass(frozen=True)
class DarkLevelCheck:
    """Limits of an offset in the noise (`benchmarks/wrong_inputs.py`); gains are of relative χ²."""

    level: float = LEAST_LIGHT  # least of the offset, and of the dimmest brightness, over the mean
    least_range: float = 1.3  # of brightness
    wide_range: float = 2.0
    gain: float = 8.0  # of one image
    shared_gain: float = 11.0  # of image and source
    narrow_gain: float = 40.0  # of either, if the range is not wide
    free_gain: float = 1.0  # if any noise in proportion to the signal is allowed
    chi2: float = 5.0  # most per degree of freedom
    pattern: float = 2.0  # standard deviations of the uneven pixels that both share


@dataclass(frozen=True, eq=False)
class CheckedImage:
    """An image and the findings of its checks, each computed once."""

    image: FloatArray  # 0 at pixels that are not usable
    usable: BoolArray
    bins: int = 20  # of brightness, in which noise is measured
    left_out: float = 0.05  # share of the brightest pixels there: bright lines are not smooth
    least_noise: float = 1e-4  # of the brightness; less are the bends of an image without noise

    @classmethod
    def of(cls, image: FloatArray, mask: BoolArray | None = None) -> CheckedImage:
        """Return an image without the pixels beyond its mask."""
        usable = np.ones(image.shape, bool) if mask is None else mask
        return cls(image if usable.all() else np.where(usable, image, 0.0), usable)

    @cached_property
    def stray(self) -> BoolArray:
        """The `stray_pixels`, shape (H, W)."""
        return stray_pixels(self.image, self.usable)

    @cached_property
    def saturated(self) -> float:
        """Share of the other pixels on a plateau at the maximum; 0 if there is none."""
        used = self.usable & ~self.stray
        return _saturated(self.image.ravel() if used.all() else self.image[used])

    @cached_property
    def _local(self) -> tuple[FloatArray, FloatArray]:
        """Means of 4 × 4 usable pixels, and differences in which smooth structure cancels."""
        image, usable = self.image, self.usable
        lines = max(1, image.size // 80_000)  # of long images, lines far apart
        last = len(image) - _WINDOW_PX + 1
        first, second, third, fourth = (image[k : last + k : lines] for k in range(_WINDOW_PX))
        steps = second - third
        columns = first + second + third + fourth
        pairs = columns[:, 1:] + columns[:, :-1]
        means = (pairs[:, 2:] + pairs[:, :-2]) / 16
        differences = (steps[:, 1:-2] - steps[:, 2:-1]) / 2
        if usable.all():
            return means.ravel(), differences.ravel()
        inside = sliding_window_view(usable, (_WINDOW_PX, _WINDOW_PX))[::lines].all(axis=(2, 3))
        return means[inside], differences[inside]

    @property
    def brightness(self) -> FloatArray:
        """Mean around each pixel."""
        return self._local[0]

    @cached_property
    def noise_bins(self) -> FloatArray:
        """Brightness, noise and its uncertainty by brightness, shape (3, bins).

        The noise is a standard deviation; its uncertainty is the variance's, divided by the noise.
        """
        brightness, differences = self._local
        order = order_by_value(brightness)
        parts = np.array_split(order[: int((1 - self.left_out) * order.size)], self.bins)
        levels = np.array([brightness[part].mean() for part in parts])
        sizes = (np.abs(differences[part]) for part in parts)
        clipped = (size[size <= _clip_limit(size)] for size in sizes)
        # Normal numbers that are clipped at three deviations have this variance.
        noise = np.sqrt([float((size**2).mean()) / 0.9733 for size in clipped])
        counts = np.array([len(part) for part in parts]) * _INDEPENDENT_SHARE
        return np.array([levels, noise, noise / np.sqrt(counts)])

    @property
    def shows_noise(self) -> bool:
        """Whether it has pixels enough to measure the noise."""
        return min(self.image.shape) >= _WINDOW_PX and self.brightness.size >= 4000

    @cached_property
    def noise_slope(self) -> float:
        """How the noise grows with the brightness, in standard deviations; 0 if not measured.

        Noise of reading, of counting, and of an uneven response do not fall with the light, but
        that of a negative does.
        """
        if not self.shows_noise:
            return 0.0
        levels, noise, uncertainty = self.noise_bins
        is_noise = (noise > 0).all() and np.median(noise) > self.least_noise * levels.mean()
        if not (is_noise and np.ptp(levels) > 0):
            return 0.0
        weights = 1 / (noise * uncertainty)
        levels, variances = (v - np.average(v, weights=weights**2) for v in (levels, noise**2))
        information = float(((levels * weights) ** 2).sum())
        slope = float((levels * variances * weights**2).sum()) / information
        misfit = float((((variances - slope * levels) * weights) ** 2).sum()) / (len(levels) - 2)
        return slope * math.sqrt(information / max(misfit, 1.0))

    @cached_property
    def relative_differences(self) -> FloatArray:
        """Differences over the brightness, clipped."""
        brightness, differences = self._local
        values = differences / np.maximum(brightness, LEAST_LIGHT * abs(float(brightness.mean())))
        limit = _clip_limit(np.abs(values))
        return np.clip(values, -limit, limit)


def _saturated(
    values: FloatArray,
    *,
    pixels: int = 10,  # fewest on the plateau
    share: float = 5e-4,  # least of all pixels
    rise: float = 1.15,  # of the maximum over the median
    below: float = 0.02,  # of the range from median to maximum, that counts as just below
    excess: float = 4.0,  # pixels at the maximum over those just below
) -> float:
    top = float(values.max())
    at_top = int((values == top).sum())
    if at_top < max(pixels, share * values.size):
        return 0.0
    median = float(np.median(values))
    just_below = int((values > top - below * (top - median)).sum()) - at_top
    is_plateau = top > rise * median and at_top > excess * just_below
    return at_top / values.size if is_plateau else 0.0


def mask_gaps(
    plane: FloatArray, mask: BoolArray | None, name: str
) -> tuple[BoolArray | None, list[Caution]]:
    """Mask the pixels that a detector has marked, as gaps between its modules.

    Marks are the largest numbers of an integer type, if no light comes near, and up to three
    negative whole numbers that fill areas. Returns the mask, and a caution if it has changed.
    """
    usable = np.ones(plane.shape, bool) if mask is None else mask
    gaps = _marked_pixels(plane, usable)
    if not gaps.any() or not (usable & ~gaps).any():
        return mask, []
    marks = ", ".join(f"{value:.0f}" for value in np.unique(plane[gaps]))
    text = (
        f"gaps: {int(gaps.sum()):,} pixels of the {name} are {marks}, by which detectors mark gaps "
        "and bad pixels; they were masked, and the field there is only a smooth continuation: give "
        "the detector's mask"
    )
    return usable & ~gaps, [Caution("unlit", text)]


def _marked_pixels(
    plane: FloatArray,
    usable: BoolArray,
    *,
    bits: tuple[int, ...] = (15, 16, 20, 24, 31, 32),  # of types whose three largest are marks
    light: float = 0.5,  # most of all other pixels, over these
    marks: int = 3,  # most negative ones
    filled: float = 0.5,  # least share of the pixels with a negative mark, in squares of 3 px
) -> BoolArray:
    gaps = usable & (plane < 0)
    values = np.unique(plane[gaps])
    is_mark = 0 < len(values) <= marks and (values == np.rint(values)).all()
    squares = ndimage.binary_opening(gaps, np.ones((3, 3))) if is_mark else gaps
    gaps &= bool(is_mark and squares.sum() >= filled * gaps.sum())
    highest = float(plane.max(where=usable, initial=-np.inf))
    if any(-1 <= 2.0**each - highest <= 3 for each in bits):
        top = usable & (plane > highest - 3)
        others = float(plane.max(where=usable & ~top, initial=-np.inf))
        is_area = ndimage.binary_erosion(top, np.ones((2, 2))).any()
        gaps |= top & bool(is_area and -np.inf < others < light * highest)
    return gaps


def mask_dark(
    image: FloatArray, source: FloatArray | None, mask: BoolArray | None
) -> tuple[BoolArray | None, list[Caution]]:
    """Mask the pixels that carry no light, such as the rim of a round window or a beam stop.

    They are dark in the image and in its source, so that a hollow from which an object has
    deflected the light stays. Without a recorded source they reach the border of the image, and no
    light is piled up around them. Returns the mask, and a caution if it has changed.
    """
    usable = np.ones(image.shape, bool) if mask is None else mask
    is_recorded = source is not None and np.ptp(source[usable]) > 0
    dark = _dark_pixels([image] if source is None or not is_recorded else [source, image], usable)
    if not dark.any():
        return mask, []
    where, remedy = "image and source", "give a mask of the lit pixels"
    if not is_recorded:
        where, remedy = "the image up to its border", f"{remedy}, or the recorded source"
    text = (
        f"pixels without light: {int(dark.sum()):,} ({percent(dark.mean())}) are dark in {where}, "
        "as at the rim of a window or behind a beam stop; they were masked, because their noise "
        f"looks like a field, and the field there is only a smooth continuation: {remedy}"
    )
    return usable & ~dark, [Caution("unlit", text)]


def _dark_pixels(
    planes: Sequence[FloatArray], usable: BoolArray, check: DarkCheck = DarkCheck()
) -> BoolArray:
    """Return the pixels that are dark in all planes, the source first if it was recorded."""
    dark, noisy, dim, lights, relative = usable, usable, usable, [], []
    # Quick for most images: no mean is less than the least value.
    if any(plane.min() >= check.dim * plane.max() for plane in planes):
        return np.zeros_like(usable)
    for plane in planes:
        light = _mean_around(plane, usable, check.sides[1])
        bright = light[usable & (light >= plane[usable].mean())]
        if not bright.size or not bright.mean() > 0:
            return np.zeros_like(usable)
        level = float(bright.mean())
        limit = check.dark if len(planes) > 1 else check.dim
        dark = dark & (_mean_around(plane, usable, check.sides[0]) < limit * level)
        noisy = noisy & (light < check.dim * level)
        if noisy.any():
            squares = _mean_around((plane / level) ** 2, usable, check.sides[1])
            noisy &= squares >= (1 + check.noise**2) * (light / level) ** 2
        if not (dark.any() or noisy.any()):
            return dark
        dim = dim & (plane < check.lit * level)
        lights.append(light / level)
        relative.append(plane / level)
    if len(planes) > 1:  # light that an object has moved is no edge of a window
        beam, shot = (_mean_around(plane, dim, check.sides[0]) for plane in relative)
        most, least = np.maximum(*relative), np.minimum(*relative)
        arrived = ndimage.maximum_filter((most >= check.lit) & (least < check.dim), 5)
        dim = dim & (np.abs(shot - beam) < check.dark) & ~arrived
        dark = dark & dim
    square = np.ones((3, 3))
    noisy = ndimage.binary_opening(noisy, square)
    regions, count = ndimage.label(noisy | dark)
    is_dark = np.zeros(count + 1, bool)
    for number, box in enumerate(ndimage.find_objects(regions), 1):
        is_dark[number] = _is_dark_region(regions == number, box, noisy, lights, usable, check)
    core = is_dark[regions]
    if core.any():
        core = ndimage.binary_dilation(core, square, iterations=check.edge[1], mask=dim)
    return np.asarray(core)


def _mean_around(plane: FloatArray, usable: BoolArray, side: int) -> FloatArray:
    """Return means of usable pixels over squares; 0 where there are none."""
    if usable.all():
        return np.asarray(ndimage.uniform_filter(plane, side))
    sums = ndimage.uniform_filter(np.where(usable, plane, 0.0), side)
    share = ndimage.uniform_filter(usable.astype(float), side)
    return np.asarray(np.divide(sums, share, out=np.zeros_like(sums), where=share > 1e-9))


def _is_dark_region(
    region: BoolArray,
    box: tuple[slice, ...],
    noisy: BoolArray,
    lights: Sequence[FloatArray],
    usable: BoolArray,
    check: DarkCheck,
) -> bool:
    """Return whether a region was dark before any deflection, by its noise and its edge."""
    if len(lights) > 1 and noisy[region].mean() > 0.5:
        return True
    least, most = check.edge if len(lights) > 1 else check.sharp_edge
    around = tuple(slice(max(side.start - most, 0), side.stop + most) for side in box)
    distance = ndimage.distance_transform_edt(~region[around])
    ring = usable[around] & (distance > least) & (distance <= most)
    if not ring.any():
        return False
    at_edge = float(np.median(lights[0][around][ring]))
    if len(lights) > 1:
        return at_edge > check.lit
    # Shorter than the image's sides, it could be the object's.
    is_rim = region[1:-1, 1:-1].sum() < region.sum() >= min(region.shape)
    return check.sharply_lit[0] < at_edge < check.sharply_lit[1] and bool(is_rim)


def image_cautions(
    image: FloatArray,
    source: FloatArray | CheckedImage | None = None,
    mask: BoolArray | None = None,
) -> tuple[Caution, ...]:
    """Return a caution for everything in an image and its reference that looks wrong.

    Parameters
    ----------
    image : ndarray, shape (H, W)
        The shot, in any unit.
    source : ndarray, shape (H, W), or CheckedImage, optional
        The beam, if it was measured; an estimate says nothing about the detector. One that many
        images share is checked once if it is a `CheckedImage`, with the same mask.
    mask : ndarray of bool, shape (H, W), optional
        True at usable pixels.

    Returns
    -------
    tuple of Caution
        Empty if nothing looks wrong.
    """
    if isinstance(source, np.ndarray):
        source = CheckedImage.of(source, mask)
    if source is not None and not np.ptp(source.image[source.usable]) > 0:
        source = None  # an assumed beam
    return tuple(_cautions(CheckedImage.of(image, mask), source))


def _cautions(image: CheckedImage, source: CheckedImage | None) -> Iterator[Caution]:
    planes = {"image": image} if source is None else {"image": image, "source": source}
    if dark := dark_level(list(planes.values())):
        yield Caution(
            "dark-level",
            f"dark level: the noise of the image vanishes at {percent(dark)} of its mean instead "
            "of at zero, so the detector's dark level seems to be left in it: the field comes out "
            "too weak, by this share or more; subtract it from image and source",
        )
    for name, plane in planes.items():
        if (share := plane.saturated) > 0:
            yield Caution(
                "saturation",
                f"saturation: {percent(share)} of the {name}'s pixels are at its maximum: bright "
                "lines are cut off there, and the field around them is too weak; mask these "
                "pixels, or record with less exposure",
            )
        if count := int(plane.stray.sum()):
            yield Caution(
                "hot-pixels",
                f"hot pixels: {count} pixel{'s' * (count > 1)} of the {name} differ"
                f"{'s' * (count == 1)} from all neighbours by far more than the noise, and each "
                "bends the field around it; remove the hot pixels",
            )
    if source is None:
        return
    used = image.usable & ~(image.stray | source.stray)
    pair = _pair_in_blocks(image.image, source.image, used)
    if sign := _sign_of_negative(image, source, is_negative(*pair)):
        yield Caution(
            "negative",
            f"negative: {sign}, as in a negative or a scan of film: the field would have the wrong "
            "sign and size; convert the film to dose, or subtract its pixels from those of "
            "unexposed film",
        )
    elif _is_swapped(*pair):
        yield Caution(
            "swapped",
            "swapped: the source has far more structure than the image, so the two seem to be "
            "swapped: the field would have the wrong sign; swap the files",
        )


def _sign_of_negative(
    image: CheckedImage, source: CheckedImage, is_reversed: bool, *, least_fall: float = 4.0
) -> str:
    """Return what shows that an image, or it and its source, is a negative; empty if nothing."""
    if is_reversed:
        return "the image is dark where it should be bright"
    # A modelled or smoothed source has no noise, but bends, which are steepest beside its peak. The
    # fall of the noise with the brightness is in standard deviations.
    falling = -(image.noise_slope + source.noise_slope) / math.sqrt(2)
    if falling > least_fall and image.noise_slope < 0:
        return "image and source are noisier where they are darker"
    if is_lit_around(source.image) and is_lit_around(image.image):
        return "the rims of image and source are brighter than all the beam"
    return ""


def is_lit_around(
    image: FloatArray, *, width: float = 0.05, bright: float = 0.9, middle: float = 0.8
) -> bool:
    """Return whether all four sides, of a width, are as bright as the brightest, the middle darker.

    So is film that is exposed in its middle.
    """
    # Light or particles that are deflected out of the middle make something else brighter.
    rows, columns = image.shape
    rim = max(1, round(width * min(rows, columns)))
    sides = (image[:rim], image[-rim:], image[:, :rim], image[:, -rim:])
    dimmest = min(float(np.median(side)) for side in sides)
    inner = image[rows // 4 : rows - rows // 4, columns // 4 : columns - columns // 4]
    return bool(np.median(inner) < middle * dimmest and bright * np.percentile(image, 99) < dimmest)


def stray_pixels(
    image: FloatArray,
    usable: BoolArray,
    *,
    ratio: float = 1.5,  # of the brightness, to all neighbours
    deviations: float = 10.0,  # of the noise, from all neighbours
    step: float = 0.05,  # of the mean, from the pixel on the left
    difference: float = 0.3,  # of a neighbour from its surroundings, over their brightness
) -> BoolArray:
    """Return the pixels that are far brighter, or darker, than each of their neighbours.

    A quick look for broken pixels; `HotPixelFilter` searches more thoroughly. Pixels with a
    neighbour that is not usable are left out.
    """
    stray = np.zeros(image.shape, bool)
    part = image[:: max(1, image.size // 50_000)]
    mean = float(image.mean() if usable.all() else image[usable].mean())
    if not mean > 0:
        return stray
    bends = part[:, 3:] - 3 * part[:, 2:-1] + 3 * part[:, 1:-2] - part[:, :-3]
    noise = NORMAL_MAD * float(np.median(np.abs(bends))) / math.sqrt(20)
    steps = np.abs(image[1:-1, 1:-1] - image[1:-1, :-2])
    # Few pixels differ enough from the one on their left to be compared with all.
    rows, columns = np.nonzero(steps > max(deviations * noise, step * mean))
    if not rows.size:
        return stray
    rows, columns = rows + 1, columns + 1
    padded = np.pad(image, 1, mode="edge")
    around = sliding_window_view(padded, (5, 5))[rows - 1, columns - 1]
    is_next = np.pad(np.ones((3, 3), bool), 1)
    centre, ring = around[:, 2, 2], around[:, ~is_next]
    is_next[2, 2] = False
    neighbours = around[:, is_next]
    highest, lowest = neighbours.max(axis=1), neighbours.min(axis=1)
    # Noise of counting grows with the brightness.
    limit = deviations * noise * np.sqrt(np.maximum(highest / mean, 1.0))
    is_hot = centre - highest > np.maximum(limit, (ratio - 1) * highest)
    is_dead = (lowest - centre > limit) & (lowest > ratio * centre)
    # A focus lifts its neighbours, too; a broken pixel is alone.
    level = np.median(ring, axis=1)
    most = np.abs(neighbours - level[:, None]).max(axis=1)
    alone = most < limit / 3 + difference * np.abs(level)
    stray[rows, columns] = (is_hot | is_dead) & alone
    if not usable.all():
        stray &= ndimage.binary_erosion(usable, np.ones((3, 3)))
    return stray


def _pair_in_blocks(
    image: FloatArray, source: FloatArray, mask: BoolArray, side: int = 128
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Return image and source in `side` blocks or fewer, of mean 1, and the blocks to use."""
    step = max(1, -(-max(image.shape) // side))
    usable = complete_blocks(mask, step)
    planes = [complete_block_means(plane, step) for plane in (image, source)]
    shot, beam = (plane / max(float(plane[usable].mean()), 1e-300) for plane in planes)
    return shot, beam, usable


def is_negative(
    shot: FloatArray,
    beam: FloatArray,
    usable: BoolArray,
    *,
    least_blocks: int = 16,
    least_contrast: float = 0.01,  # of the structure, over the mean
    correlation: float = -0.4,
) -> bool:
    """Return whether the image is dark at its borders where its beam is bright, both in blocks."""
    ring = usable & border_ring(usable.shape)
    if ring.sum() < least_blocks:
        return False
    # Structure that neighbouring blocks share is free of noise.
    if math.sqrt(max(_neighbour_covariance(beam, beam, ring), 0.0)) < least_contrast:
        return False
    shot, beam = (plane[ring] - plane[ring].mean() for plane in (shot, beam))
    # Not by BLAS, whose threads would wait in circles.
    product = float((shot * beam).sum())
    size = float(np.sqrt((shot**2).sum() * (beam**2).sum()))
    return product / max(size, 1e-300) < correlation


def _is_swapped(
    shot: FloatArray,
    beam: FloatArray,
    usable: BoolArray,
    *,
    least_blocks: int = 16,
    least_contrast: float = 0.01,  # of the structure, over the mean
    detail: int = 9,  # blocks, of the structure of an object
    share: float = 0.75,
) -> bool:
    """Return whether the source contains the structure that the image lacks, both in blocks.

    An object adds to a beam a difference that is not in the beam. That difference is correlated
    with the image (by its variance) and not with the source. For a mere shift of a beam it is half
    and half; where the two are swapped, the source has it all.
    """
    if usable.sum() < least_blocks:
        return False
    difference, beam = (np.where(usable, plane, 0.0) for plane in (shot - beam, beam - 1))
    difference -= ndimage.uniform_filter(difference, detail)
    beam -= ndimage.uniform_filter(beam, detail)
    size = _neighbour_covariance(difference, difference, usable)
    if size < least_contrast**2:
        return False
    return -_neighbour_covariance(difference, beam, usable) > share * size


def border_ring(shape: tuple[int, ...], share: float = 0.2) -> BoolArray:
    """Return the part of an image near its border, where an object displaces least."""
    ring = np.ones(shape, dtype=bool)
    depth = [max(2, round(share * side)) for side in shape]
    ring[depth[0] : -depth[0], depth[1] : -depth[1]] = False
    return ring


def _neighbour_covariance(first: FloatArray, second: FloatArray, usable: BoolArray) -> float:
    pair = usable[:, 1:] & usable[:, :-1]
    if pair.sum() < 2:
        return 0.0
    forth = first[:, 1:][pair], second[:, :-1][pair]
    back = first[:, :-1][pair], second[:, 1:][pair]
    return float(np.mean([((a - a.mean()) * (b - b.mean())).mean() for a, b in (forth, back)]))


def dark_level(planes: Sequence[CheckedImage], check: DarkLevelCheck = DarkLevelCheck()) -> float:
    """Estimate an offset that was left in an image, as a share of its mean, from its noise.

    The recorded beam, if it is given, has an offset of its own, or shares the image's. It is 0
    unless the noise cannot be explained without an offset, by any sum of a constant variance, one
    in proportion to the signal, and one to its square.
    """
    if not all(plane.shows_noise for plane in planes):
        return 0.0
    mean = float(planes[0].brightness.mean())
    if not mean > 0:
        return 0.0
    offsets = [_offset(plane.noise_bins / mean, math.inf, check.gain, check) for plane in planes]
    if len(planes) > 1:
        both = np.concatenate([plane.noise_bins for plane in planes], axis=1) / mean
        # Most relative variance that both may have in common, as by uneven pixels
        product = planes[0].relative_differences * planes[1].relative_differences
        error = float(product.std()) / math.sqrt(_INDEPENDENT_SHARE * len(product))
        pattern = max(float(product.mean()), 0.0) + check.pattern * error
        offsets.append(_offset(both, pattern, check.shared_gain, check))
    return max(offsets)


def _clip_limit(sizes: FloatArray) -> float:
    """Return the largest absolute difference that counts: three standard deviations."""
    return 3 * NORMAL_MAD * float(np.median(sizes))


def _offset(bins: FloatArray, max_pattern: float, min_gain: float, check: DarkLevelCheck) -> float:
    """Return the brightness where the noise vanishes; 0 if zero is as likely.

    `max_pattern` is the largest variance in proportion to the square of the brightness.
    """
    levels, noise, uncertainty = bins
    lowest, highest = float(levels.min()), float(levels.max())
    if not (lowest > check.level and highest >= check.least_range * lowest and (noise > 0).all()):
        return 0.0
    variances, weights = noise**2, 1 / (noise * uncertainty)
    powers = np.stack([np.ones_like(levels), levels, levels**2], axis=1) * weights[:, None]
    weighted = variances * weights
    terms, freely = nonnegative_fit(powers, weighted)
    distance = freely
    if terms[2] > max_pattern:
        distance = nonnegative_fit(powers[:, :2], weighted - max_pattern * powers[:, 2])[1]
    gain, constant = np.polyfit(levels, variances, 1, w=weights)
    if not gain > 0:
        return 0.0
    with_offset = float((((gain * levels + constant) * weights - weighted) ** 2).sum())
    dark = -float(constant / gain)
    chi2 = max(1.0, with_offset / (len(levels) - 2))
    least = (min_gain if highest > check.wide_range * lowest else check.narrow_gain) * chi2
    # Noise in proportion to the signal that differs between shots, as of speckle, has no line.
    explained = chi2 < check.chi2 and freely**2 - with_offset > check.free_gain * chi2
    explained &= distance**2 - with_offset > least
    return dark if explained and dark > check.level else 0.0
