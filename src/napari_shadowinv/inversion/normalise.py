"""An image and a source made ready for the transport.

- check and normalise: `prepare`; a source alone: `check_source`
- without pixels that carry no light: `mask_unlit`
- only normalise, many images of one source: `flooring_for`
- masked pixels that light reaches: `gaps_in`; where a source is dark: `dark_in`
- the margin of a free boundary, and how many sites: `margin_around`, `number_of_sites`
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike
from scipy import ndimage

from napari_shadowinv._system.machine import physical_memory
from napari_shadowinv._system.progress import Reporter
from napari_shadowinv._system.safety import check_memory
from napari_shadowinv._typing import BoolArray, FloatArray
from napari_shadowinv.cautions import Caution
from napari_shadowinv.errors import InputError
from napari_shadowinv.facts import percent
from napari_shadowinv.options import MAX_DEFAULT_SITES, InversionOptions
from napari_shadowinv.physics.arrays import check_mask, check_plane, check_shape, check_usable
from napari_shadowinv.preprocessing.image_checks import mask_dark, mask_gaps
from napari_shadowinv.preprocessing.pixels import continued

_SMALLEST_SIDE = 4
_LEAST_MARGIN = 4
_MARGIN_SHARE = 0.05  # of the image's shorter side
_BYTES_PER_SITE = 2000  # measured peak of a whole inversion, rounded up
_BYTES_PER_PIXEL, _BYTES_PER_PIXEL_FREE = 180, 320  # measured peak of a large image
_NOTABLE_FLUX_CHANGE = 0.05
_NOTABLE_RAISED = 1e-3  # share of the pixels
_NOTABLE_MASK, _MOSTLY_MASKED = 0.2, 0.8  # of the pixels
_DIMMEST, _BRIGHTEST = 1e-301, 1e301  # sums of a whole image stay within double precision
_SAMPLE_STEP = 97  # pixels
_MAX_ROUNDING = 1e-6  # of the mean: difference by rounding to 32 bits
_DARK = 0.05  # of the mean of a source, behind an obstacle
_WIDEST_GAP = 0.2  # of the image's shorter side
_WIDTHS = 2.0, 4.0  # px, of the splines that continue an image into gaps, and that tell how well


@dataclass(frozen=True)
class Prepared:
    """Image and source, shape (H, W), of the same flux unless the image's is known."""

    # Image clipped where asked for, scaled to the flux of the source; both are continued into
    # `gaps`, and 0 at other masked pixels.
    image: FloatArray
    source: FloatArray
    # As the transport sees them, in units of `unit`: dark and masked pixels at the floor.
    floored_image: FloatArray
    unit: float  # the source's `power_of_two`
    mask: BoolArray  # the pixels that are used
    gaps: BoolArray  # masked pixels that light reaches
    doubt: FloatArray | None  # how far another continuation of the image is from it, in the gaps
    clipped_pixels: int
    floored_pixels: int  # the clipped ones included
    flux_scale: float  # divisor of the image
    cautions: tuple[Caution, ...]

    def in_units(self) -> Prepared:
        """Return the same with image and source also in units of `unit`."""
        return replace(self, image=self.image / self.unit, source=self.source / self.unit)

    @property
    def lit(self) -> BoolArray:
        """Pixels that are used, or gaps."""
        return self.mask | self.gaps


def prepare(
    image: ArrayLike,
    source: ArrayLike | None,
    options: InversionOptions,
    mask: ArrayLike | None = None,
) -> Prepared:
    """Check an image and its source, and bring them to the same flux unless that is known."""
    shape = check_plane(image, "image", _SMALLEST_SIDE).shape
    check_memory(shape, bytes_per_pixel(options), "an inversion")
    usable = check_mask(mask, shape)
    values = _finite_image(image, "image", usable)
    negative = int(np.count_nonzero(values < 0)) if values.min() < 0 else 0
    if negative and options.negative == "refuse":
        lowest, is_mark = values.min(), len(np.unique(values[values < 0])) == 1
        remedy = "if the detector marks bad pixels so, mask them; " if is_mark else ""
        raise InputError(
            f"image has {negative} negative pixels (lowest {lowest:.4g}), expected none: "
            f"{remedy}if they result from background subtraction, clip them",
            option="options.negative=clip",
        )
    values = _clip_negative(values)
    _check_range(values, "image")
    gaps, doubt = gaps_in(usable, source), None
    lit = usable | gaps
    if gaps.any():
        values, smoother = (into_gaps(values, usable, gaps, width) for width in _WIDTHS)
        doubt = smoother - values
    if source is None:
        beam = np.where(lit, values.sum() / lit.sum(), 0.0)
    else:
        beam = np.array(into_gaps(check_source(source, usable), usable, gaps))
        if are_alike(values, beam, usable):
            raise InputError(
                "the source is the image itself, so the deflection would be zero: give an image "
                "of the beam without the object, or an estimate of it"
            )
    with np.errstate(over="ignore", under="ignore"):
        ratio = float(values.sum() / beam.sum())
    if not _DIMMEST < ratio < _BRIGHTEST:
        raise InputError(
            f"image has {values.sum():.3g} units of flux and source {beam.sum():.3g}: expected a "
            "ratio that double precision can hold; divide each by its mean"
        )
    conserved = options.flux != "known"
    flux_scale = ratio if conserved else 1.0
    values = values / flux_scale
    least = options.floor * values.sum() / lit.sum()
    floored_flux = masked_source(beam, lit, options).sum() if conserved else None
    floored = _raise_to_floor(values, least, floored_flux)
    below = int(np.count_nonzero(usable & (values < least)))
    shadows = int(np.count_nonzero(usable & ~lit_pixels(beam, usable, options)))
    unit = power_of_two(beam)
    floored /= unit
    return Prepared(
        image=values,
        source=beam,
        floored_image=floored,
        unit=unit,
        mask=usable,
        gaps=gaps,
        doubt=None if doubt is None else doubt / flux_scale,
        clipped_pixels=negative,
        floored_pixels=below,
        flux_scale=flux_scale,
        cautions=_cautions(
            ratio if conserved else 1.0, negative, max(below - shadows, 0), usable, options
        ),
    )


def mask_unlit(
    image: ArrayLike, source: ArrayLike | None, mask: ArrayLike | None
) -> tuple[BoolArray | None, list[Caution]]:
    """Mask the pixels without light, by `mask_gaps` and `mask_dark`; the source was recorded."""
    shot = check_plane(image, "image", _SMALLEST_SIDE)
    check_memory(shot.shape, _BYTES_PER_PIXEL, "an inversion")
    usable = check_mask(mask, shot.shape)
    lit: BoolArray | None = None if mask is None else usable
    planes = (
        {"image": shot}
        if source is None
        else {"image": shot, "source": check_plane(source, "source")}
    )
    if any(plane.shape != shot.shape for plane in planes.values()):
        return lit, []  # refused later, as are values that are not finite
    values = {
        name: np.where(usable, plane, 0.0).astype(np.float64) for name, plane in planes.items()
    }
    if not all(np.abs(plane).max() < _BRIGHTEST for plane in values.values()):
        return lit, []
    cautions = []
    for name, plane in values.items():
        lit, gaps = mask_gaps(plane, lit, name)
        cautions += gaps
    lit, dark = mask_dark(values["image"], values.get("source"), lit)
    return lit, [*cautions, *dark]


def dark_in(source: FloatArray, mask: BoolArray) -> BoolArray:
    """Return the masked pixels, (H, W), where a source is dark; values that mark pixels are not."""
    with np.errstate(invalid="ignore"):
        dark = (source >= 0) & (source < _DARK * source[mask].mean())
    return np.asarray(~mask & dark)


def gaps_in(mask: BoolArray, source: ArrayLike | None) -> BoolArray:
    """Return the masked pixels, (H, W), of gaps between used ones that light of the source reaches.

    Image and source are continued into them: without their light, all that an object sends across
    their edges would seem to be missing. Wider parts, and what lies beyond the used pixels, such as
    the outside of a round window, stay empty.
    """
    if mask.all():
        return np.zeros_like(mask)
    side = math.ceil(_WIDEST_GAP * min(mask.shape))
    padded = np.pad(mask, side, mode="edge").view(np.uint8)
    closed: BoolArray = ndimage.grey_closing(padded, (side, side)).view(bool)
    gaps = closed[side:-side, side:-side] & ~mask
    return gaps if source is None else gaps & ~dark_in(np.asarray(source), mask)


def into_gaps(
    values: FloatArray, mask: BoolArray, gaps: BoolArray, width: float = _WIDTHS[-1]
) -> FloatArray:
    """Return values, 0 where masked, continued into gaps by a spline of a width, not negative."""
    if not gaps.any():
        return values
    smooth = continued(values, mask, Reporter(None, None), width, rtol=1e-4)
    return np.where(gaps, np.maximum(smooth, 0.0), values)


def lit_pixels(source: FloatArray, mask: BoolArray, options: InversionOptions) -> BoolArray:
    """Return the used pixels from which rays start: a source behind an obstacle is dark there."""
    return np.asarray(mask & (source > options.floor * source[mask].mean()))


def flooring_for(
    source: FloatArray, options: InversionOptions, mask: BoolArray | None
) -> Callable[[FloatArray], FloatArray]:
    """Return a function from an image to the `floored_image` of `prepare`, for one source and mask.

    It clips images instead of checking them; quantities of the source are computed once.
    """
    usable = np.ones(source.shape, bool) if mask is None else mask
    gaps = gaps_in(usable, source)
    lit = usable | gaps
    beam = into_gaps(check_source(source, usable), usable, gaps)
    flux, count, unit = beam.sum(), lit.sum(), power_of_two(beam)
    conserved = options.flux != "known"
    floored_flux = masked_source(beam, lit, options).sum() if conserved else None

    def apply_floor(image: FloatArray) -> FloatArray:
        values = _clip_negative(np.where(usable, image, 0.0))
        values = into_gaps(values, usable, gaps, _WIDTHS[0])
        if conserved:
            values /= values.sum() / flux
        return _raise_to_floor(values, options.floor * values.sum() / count, floored_flux) / unit

    return apply_floor


def are_alike(first: FloatArray, second: FloatArray, usable: BoolArray) -> bool:
    """Return whether images with structure are the same but for a factor and 32-bit rounding."""
    if not usable.any():
        return False
    used = [values.ravel() if usable.all() else values[usable] for values in (first, second)]
    means = [values.mean() for values in used]
    if min(means) <= 0:
        return False
    for step in (_SAMPLE_STEP, 1):  # images that differ do so in a few samples already
        relative = [values[::step] / mean for values, mean in zip(used, means, strict=True)]
        if not np.abs(relative[1] - relative[0]).max() <= _MAX_ROUNDING:
            return False
    return bool(np.ptp(relative[1]) > 2 * _MAX_ROUNDING)


def _clip_negative(values: FloatArray) -> FloatArray:
    """Clip an image, refusing one without positive pixels."""
    if values.min() < 0:
        values = np.maximum(values, 0)
    if not values.max() > 0:
        raise InputError(
            "image has no positive pixel, expected a beam: check the file and its background"
        )
    return values


def _raise_to_floor(values: FloatArray, least: float, flux: float | None) -> FloatArray:
    floored = np.maximum(values, least)
    if flux is not None:
        # The floor has added to image and source, not alike.
        floored *= flux / floored.sum()
    return floored


def power_of_two(source: FloatArray) -> float:
    """Return the power of two next below the brightest pixel: dividing by it rounds nothing."""
    return float(2.0 ** np.floor(np.log2(source.max())))


def masked_source(
    source: FloatArray, mask: BoolArray | None, options: InversionOptions
) -> FloatArray:
    """Return a source with its masked pixels at the floor, so that cells fill the image."""
    if mask is None or mask.all():
        return source
    return np.where(mask, source, options.floor * source[mask].mean())


def _cautions(
    ratio: float, clipped: int, floored: int, usable: BoolArray, options: InversionOptions
) -> tuple[Caution, ...]:
    cautions = []
    size = int(usable.sum())
    if abs(ratio - 1) > _NOTABLE_FLUX_CHANGE:
        text = (
            f"the image's flux is {ratio:.3g} times the source's; it was scaled to match, which is "
            "right after another exposure, and wrong if a dark level was left in one of them, if "
            "one is a negative, or if light was lost in the object or past the edge"
        )
        cautions.append(Caution("flux", text))
    if clipped > _NOTABLE_RAISED * size:
        text = f"negative pixels set to zero: {clipped} ({percent(clipped / size)})"
        cautions.append(Caution("negative-pixels", text))
    dark = floored - clipped  # but for as many as the source has
    if dark > _NOTABLE_RAISED * size:
        text = (
            f"dark pixels raised to the floor: {dark} ({percent(dark / size)}); "
            "the field inside dark areas is not reliable"
        )
        cautions.append(Caution("dark-pixels", text))
    excluded = 1 - float(usable.mean())
    if excluded >= _NOTABLE_MASK:
        text = (
            f"the mask excludes {percent(excluded)} of the pixels: the field there is only a "
            "smooth continuation. To hide the object from a source estimate, use a source mask "
            "instead"
        )
        if excluded > _MOSTLY_MASKED:
            text += "; in NeXus pixel masks 0 is usable: invert such a mask"
        cautions.append(Caution("mask", text))
    return tuple(cautions)


def check_source(source: ArrayLike, mask: BoolArray | None = None) -> FloatArray:
    """Return a source as floats, 0 where masked, perhaps without a copy, or raise `InputError`."""
    shape = check_plane(source, "source", _SMALLEST_SIDE).shape
    if mask is not None:
        check_shape("source", shape, mask.shape)
        check_usable(mask)
    beam = _finite_image(source, "source", np.ones(shape, bool) if mask is None else mask)
    if beam.min() < 0:
        raise InputError(
            f"source has {int((beam < 0).sum())} negative pixels, expected none: "
            "clip or smooth it first"
        )
    if not beam.any():
        raise InputError("source is zero everywhere, expected the undisturbed beam")
    _check_range(beam, "source")
    return beam


def _check_range(values: FloatArray, name: str) -> None:
    peak = float(values.max())
    if not _DIMMEST < peak < _BRIGHTEST:
        raise InputError(
            f"{name} has a brightest pixel of {peak:.3g}, expected one between {_DIMMEST:g} and "
            f"{_BRIGHTEST:g}: divide it by its mean"
        )


def _finite_image(values: ArrayLike, name: str, mask: BoolArray) -> FloatArray:
    used = values if mask.all() else np.where(mask, values, 0.0)
    array = np.ascontiguousarray(used, dtype=np.float64)
    with np.errstate(over="ignore", invalid="ignore"):
        is_finite = np.isfinite(array.sum()) or np.isfinite(array).all()
    if not is_finite:
        bad = int((~np.isfinite(array)).sum())
        raise InputError(
            f"{name} has {bad} pixels that are NaN or infinite, expected none: mask them, or "
            "replace them, for example by the median of their neighbours"
        )
    return array


def margin_around(shape: tuple[int, ...], options: InversionOptions) -> int:
    """Return the pixels beyond each edge that sites cover where the boundary is free."""
    if options.margin is None:
        return max(_LEAST_MARGIN, round(_MARGIN_SHARE * min(shape)))
    if options.margin > max(shape):
        raise InputError(
            f"margin is {options.margin:,} px for an image of {shape[0]} × {shape[1]} px, "
            f"expected at most {max(shape)} px: make it about as wide as the object"
        )
    return options.margin


def bytes_per_pixel(options: InversionOptions) -> float:
    """Return the memory of an inversion per pixel, without its sites."""
    return _BYTES_PER_PIXEL_FREE if options.boundary == "free" else _BYTES_PER_PIXEL


def number_of_sites(shape: tuple[int, int], options: InversionOptions) -> int:
    """Return the maximum number of sites; an `InputError` if they do not fit in memory."""
    stated = options.n_sites
    n_sites = min(shape[0] * shape[1], MAX_DEFAULT_SITES) if stated is None else stated
    memory = physical_memory()
    if memory is not None and n_sites * _BYTES_PER_SITE > memory:
        raise InputError(
            f"{n_sites:,} sites need about {n_sites * _BYTES_PER_SITE / 1e9:.3g} GB, this "
            f"machine has {memory / 1e9:.3g} GB: use at most {memory // _BYTES_PER_SITE:,} sites"
        )
    return n_sites
