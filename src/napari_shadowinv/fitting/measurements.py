"""The inputs of a fit, checked and in common units: `collect_data`.

- displacement by each field in each image, from the setups: `strengths_of`
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.ndimage import uniform_filter

from napari_shadowinv._system.safety import check_memory
from napari_shadowinv._system.validation import as_model
from napari_shadowinv._typing import AnyArray, BoolArray, FloatArray
from napari_shadowinv.errors import InputError
from napari_shadowinv.facts import percent
from napari_shadowinv.fitting.forward import Scene
from napari_shadowinv.fitting.instrument import imperfect_instrument
from napari_shadowinv.fitting.noise_match import NoiseMatch, match_noise
from napari_shadowinv.fitting.rays import RayModel
from napari_shadowinv.fitting.references import smooth_references
from napari_shadowinv.fitting.shots import (
    NearField,
    Shots,
    common_values,
    list_shots,
    names_of,
    value_of_first,
    values_of,
)
from napari_shadowinv.fitting.unknowns import Fiducials
from napari_shadowinv.instrument.shapes import Around
from napari_shadowinv.inversion.normalise import are_alike, check_source
from napari_shadowinv.options import (
    KINDS_OF_NOISE,
    MAX_STRENGTH,
    UNKNOWN_BEAM_RMS,
    BeamPrior,
    FitOptions,
    Instrument,
)
from napari_shadowinv.physics.arrays import (
    SQUARE_PIXELS,
    as_numbers,
    check_mask,
    check_plane,
    check_shape,
    check_usable,
    plain_array,
    unpack_array,
)
from napari_shadowinv.physics.projection import displacement_ratio
from napari_shadowinv.physics.setup import Setup, deflector_titles
from napari_shadowinv.preprocessing.noise import estimated_noise
from napari_shadowinv.shot import Shot

_LEAST_NOISE = 0.005  # of the beam: what the model itself is off by, about
_LEAST_COUNTS = 1.0


@dataclass(frozen=True)
class FitData:
    """Images in units of their beams, with their instrument, and what is to be fitted to them.

    `scene` has the sides of blocks, and λ and κ if they are given, else 0; the images are its first
    `size` pixels. `units` (L,) are the recorded values of one unit, `brightness` (L,) the
    brightness of each image relative to its source, approximate where it is unknown; `counted` is
    true for Poisson noise. The beam is `assumed` if no source was given, `unknown` if it has none,
    and `common` if its source is the same for all images.
    """

    scene: Scene
    size: tuple[int, int]
    around: Around  # pixels by which beams reach beyond the images along y and x
    units: FloatArray
    brightness: FloatArray
    counted: bool
    single: bool  # one image, or several with the same information
    assumed: bool
    unknown: bool
    common: bool
    fields: tuple[str, ...]
    instrument: Instrument
    options: FitOptions
    beam: BeamPrior
    setups: tuple[Setup, ...] | None
    names: tuple[str, ...] | None  # if the images have any
    start: FloatArray | None  # potential in px² of the first field
    near: NearField | None  # the only start, if there is one
    noise: NoiseMatch
    reference_noise: FloatArray  # (L,), standard deviation of the beams' own, as far as it is left

    def noise_of(self, weights: FloatArray) -> FloatArray:
        """Return the standard deviation of each image's noise, (L,), or (L, H, W) if it varies.

        It is in the unit of the images, NaN where the weights of a scene's pixels are 0.
        """
        height, width = self.size
        weights = weights[:, :height, :width]
        roots = np.sqrt(np.where(weights > 0, weights, np.nan))
        noise = (self.units * np.sqrt(self.noise.expected_chi2))[:, None, None] / roots
        least, largest = (limit(noise, axis=(1, 2)) for limit in (np.nanmin, np.nanmax))
        return noise if (least < largest).any() else np.asarray(least)


def collect_data(
    shots: Shots,
    *,
    fields: Sequence[str] = ("B",),
    instrument: Instrument | None = None,
    options: FitOptions,
) -> FitData:
    """Check the inputs of a fit; see `fit` for their forms."""
    instrument = as_model(Instrument, instrument, "instrument")
    shots = list_shots(shots)
    names = names_of(shots)
    data, recorded, used = _checked_planes(shots, names)
    shape: tuple[int, int] = data.shape[1:]
    unknown = shots[0].beam_unknown
    is_uniform = recorded is None and not unknown
    is_assumed = is_uniform or not all(shot.measured for shot in shots)
    _refuse_ambiguous(shots, options)
    matrix, setups = displacements_of(shots, names, fields)
    recorded, factors, free_brightness = _bright_sources(shots, data, recorded, used)
    _refuse_what_is_given_twice(data, recorded, used, matrix, names)
    noise = _common_noise(values_of(shots, "noise"))
    beams, deviations, match, remaining = _relative_noise(
        data, recorded, used, noise, instrument, names
    )
    units = _means(beams, used)
    in_units = beams / units[:, None, None]
    around, strip = _strips(shape, options)
    fill = [(0, 0), *((0, after - strip["pad"]) for _, after in around)]
    is_common = _are_proportional(beams)
    single = _is_single(matrix)
    prior = _beam_prior(instrument, beams[0], is_assumed=is_assumed, unknown=unknown)
    imperfect = imperfect_instrument(
        instrument,
        prior if unknown or not single or instrument.has_numbers else BeamPrior(),
        in_units,
        np.asarray(used.any(axis=0)),
        around,
        is_common=is_common,
        other_strengths=_other_strengths(setups, fields, matrix),
    )
    # Of a detector that is not linear, an assumed source does not have the image's mean. A beam of
    # another shape, or behind an object that absorbs, does not have its source's.
    absorbs = bool(imperfect.shapes) or instrument.absorption > 0
    is_dimmed = (is_uniform and instrument.gamma > 0) or (not single and absorbs)
    start, near = _start_of(shots, shape)
    smoothness = (options.smoothness or 0.0, 0.0) if near is None else near.smoothness
    scene = Scene(
        images=np.pad(np.where(used, data / units[:, None, None], 0.0), fill),
        weights=np.pad(np.where(used, 1 / np.maximum(deviations, _LEAST_NOISE) ** 2, 0.0), fill),
        strengths=matrix,
        beams=np.pad(in_units, ((0, 0), *around), mode="edge"),
        psf=[_checked_point_spread(names[k], shot.psf, shape) for k, shot in enumerate(shots)],
        smoothness=np.tile(smoothness, (matrix.shape[1], 1)),
        **strip,
        free_brightness=free_brightness or unknown or is_dimmed,
        **_alignment(instrument, options),
        fiducials=_checked_fiducials(value_of_first(shots, "fiducials"), shape),
        threads=options.threads,
        imperfect=imperfect,
    )
    return FitData(
        scene=scene,
        size=shape,
        around=around,
        units=units,
        brightness=factors,
        counted=isinstance(noise, str) and noise == "poisson",
        single=single,
        assumed=is_assumed,
        unknown=unknown,
        common=is_common,
        fields=tuple(fields),
        instrument=instrument,
        options=options,
        beam=prior,
        setups=setups,
        names=names if any(shot.name for shot in shots) else None,
        start=start,
        near=near,
        noise=match,
        reference_noise=remaining,
    )


def displacements_of(
    shots: Sequence[Shot], names: Sequence[str], fields: Sequence[str]
) -> tuple[FloatArray, tuple[Setup, ...] | None]:
    """Return strengths relative to the first image, and the setups from which they follow."""
    check_fields(fields)
    setups, strengths = values_of(shots, "setup"), values_of(shots, "strength")
    if strengths is not None:
        return _relative_strengths(_checked_strengths(strengths, len(fields))), None
    if setups is not None:
        return _relative_strengths(strengths_of(setups, fields, names)), setups
    if len(shots) > 1:
        raise InputError(
            f"received {len(shots)} images and neither strengths nor setups: give the setup of "
            "each image, or how much each is displaced relative to the first"
        )
    return _relative_strengths(np.ones((1, len(fields)))), None


def _other_strengths(
    setups: tuple[Setup, ...] | None, fields: Sequence[str], strengths: FloatArray
) -> FloatArray:
    """Return displacements by an electric field that is equal to a magnetic one in image 1."""
    if setups is None or tuple(fields) != ("B",):
        return strengths
    return strengths_of(setups, ("E",))


def _refuse_ambiguous(shots: Sequence[Shot], options: FitOptions) -> None:
    if len(shots) == 1 and shots[0].beam_unknown and not options.ambiguous:
        raise InputError(
            "received one image and an unknown source: one image cannot tell the beam from the "
            "object; give the source or an image of another energy, or allow an ambiguous fit, "
            "one of many",
            option="fit.options.ambiguous=true",
        )


def _bright_sources(
    shots: Sequence[Shot], data: FloatArray, recorded: FloatArray | None, used: BoolArray
) -> tuple[FloatArray, FloatArray, bool]:
    """Return sources as bright as their images, by which factors, and whether these are fitted."""
    means = _means(data, used)
    brightness = values_of(shots, "brightness") or (1.0,) * len(shots)
    are_free = [isinstance(each, str) for each in brightness]
    if any(are_free) and not all(are_free):
        raise InputError(
            f"brightness is {', '.join(map(repr, brightness))}: expected a number for each image, "
            "or 'free' for all"
        )
    if recorded is None:
        recorded = np.ones(data.shape) * means[:, None, None]
    is_free = all(are_free)
    factors = means / _means(recorded, used) if is_free else np.array(brightness, dtype=np.float64)
    recorded = factors[:, None, None] * recorded
    _refuse_other_units(means / _means(recorded, used), names_of(shots))
    return recorded, factors, is_free


def _beam_prior(
    instrument: Instrument, beam: FloatArray, *, is_assumed: bool, unknown: bool
) -> BeamPrior:
    prior = instrument.beam_of(measured=not is_assumed, source=beam / beam.mean())
    if unknown and not instrument.beam_rms:
        prior = prior.model_copy(update={"rms": UNKNOWN_BEAM_RMS})
    return prior


def _strips(
    shape: tuple[int, int],
    options: FitOptions,
    *,
    usual: int = 16,
    free_share: float = 0.1,
    free_tie: float = 0.3,
) -> tuple[Around, dict[str, Any]]:
    """Return the strips before and after images along y and x, and how a scene holds them.

    A free boundary has a strip of a share of the shorter side, and a µ of its own.
    """
    is_free = options.boundary == "free"
    if is_free:
        usual = max(usual, 8 * round(free_share * min(shape) / 8))
    pad = options.margin or usual
    height, width = shape
    around = (pad, pad + _fill(height, pad)), (pad, pad + _fill(width, pad))
    if not is_free:
        return around, {"pad": pad}
    return around, {"pad": pad, "tie": free_tie, "decay": options.decay_length or pad}


def _is_single(strengths: FloatArray, same: float = 1.08) -> bool:
    """Return whether there is one image, or several with strengths within a factor."""
    spread = np.linalg.norm(strengths, axis=1)
    return len(spread) == 1 or bool(spread.max() < same * spread.min())


def _are_proportional(beams: FloatArray, same: float = 1e-6) -> bool:
    shapes = [beam / beam.mean() for beam in beams]
    return all(np.allclose(beam, shapes[0], rtol=same, atol=0) for beam in shapes[1:])


def _alignment(instrument: Instrument, options: FitOptions) -> dict[str, Any]:
    """Return which of a frame's six numbers are free, and the spread of its shift in px."""
    shift = instrument.registration or 0.0
    if options.align == "none" and shift:
        return {"free_frames": np.ones(6, bool), "shift_spread": shift}
    free = {"none": [False] * 6, "shift": [True, False, False] * 2, "affine": [True] * 6}
    return {"free_frames": np.array(free[options.align]), "shift_spread": options.align_spread}


def _relative_noise(
    data: FloatArray,
    recorded: FloatArray,
    used: BoolArray,
    noise: Any,
    instrument: Instrument,
    names: Sequence[str],
) -> tuple[FloatArray, FloatArray, NoiseMatch, FloatArray]:
    """Return beams that are blurred as far as they may be, and the noise of images less beams.

    The standard deviations are those of pixels in units of the beams; the last are of what is
    left in a pixel of each beam, as recorded.
    """
    # Differences of image and beam contain the noise of both.
    deviations = _deviations(noise, data - recorded if noise is None else data, used, names)
    floors = _LEAST_NOISE * _means(recorded, used)[:, None, None]
    beams, shares = smooth_references(recorded, data, np.maximum(deviations, floors), used)
    remaining = shares[:, None, None] * deviations
    if noise is None:
        deviations = _deviations(None, data - beams, used, names)
    elif not remaining.any():
        remaining += np.array(list(map(estimated_noise, beams, used)))[:, None, None]
    units = _means(beams, used)[:, None, None]
    deviations = np.hypot(deviations, remaining) / units
    _refuse_hopeless_noise(deviations, used, names)
    match = match_noise(
        deviations,
        (data - beams) / units,
        data / units,
        used,
        instrument.noise_correlation,
        is_estimated=noise is None or (isinstance(noise, str) and noise == "proportional"),
    )
    # On long waves, beams are as noisy as they were recorded.
    before, after = (
        np.array(list(map(estimated_noise, (data - each) / units, used)))
        for each in (recorded, beams)
    )
    more = np.maximum(before**2 - after**2, 0.0)
    pixels = match.factors * np.median(deviations**2, axis=(1, 2))
    match = match.with_long_waves(more / np.maximum(pixels, np.finfo(float).tiny))
    deviations = deviations * np.sqrt(match.factors)[:, None, None]
    return beams, deviations, match, np.median(remaining, axis=(1, 2))


def check_fields(fields: Sequence[str]) -> None:
    """Raise an `InputError` if fields are unknown or there are none, or one twice."""
    titles = deflector_titles()
    if not fields or len(set(fields)) < len(fields) or not titles.keys() >= set(fields):
        raise InputError(f"fields are {list(fields)}: expected some of {', '.join(titles)}")


def strengths_of(
    setups: Sequence[Setup], fields: Sequence[str], names: Sequence[str] | None = None
) -> FloatArray:
    """Return the displacement by each field in each image relative to the first, shape (L, M).

    Fields are keys of `deflector_titles`. An `InputError`, with names or else numbers of the
    images, if a field does not bend the beam, or pixels at the object differ.
    """
    first, titles = setups[0], deflector_titles()
    for k, setup in enumerate(setups):
        ratio = setup.object_pixel_size / first.object_pixel_size
        if abs(ratio - 1) > 1e-6:
            name = names[k] if names else f"image {k + 1}"
            raise InputError(
                f"{name} has pixels of {setup.object_pixel_size * 1e6:.6g} µm at the "
                f"object, the first of {first.object_pixel_size * 1e6:.6g} µm: bring all images "
                "to the same pixels first"
            )
    return np.array(
        [
            [displacement_ratio(first, setup, deflector=titles[field]) for field in fields]
            for setup in setups
        ]
    )


def _checked_planes(
    shots: Sequence[Shot],
    names: Sequence[str],
    *,
    smallest: int = 32,
    bytes_of: tuple[int, int] = (2000, 600),
) -> tuple[FloatArray, FloatArray | None, BoolArray]:
    """Return images, sources if there are any, and usable pixels, each of shape (L, H, W).

    `bytes_of` are the memory that a fit takes for a pixel, and for a pixel of each image.
    """
    common_values(names, [shot.beam_unknown or None for shot in shots], "unknown source")
    sources = common_values(names, [None if s.beam_unknown else s.source for s in shots], "source")
    images: list[AnyArray] = []
    masks: list[BoolArray] = []
    needed = bytes_of[0] + len(shots) * bytes_of[1]
    for shot, name in zip(shots, names, strict=True):
        images.append(check_plane(unpack_array(shot.image, name), name, smallest))
        check_memory(images[0].shape, needed, "a fit")
        check_shape(name, images[-1].shape, images[0].shape, names[0])
        try:
            masks.append(check_mask(unpack_array(shot.mask, "mask"), images[0].shape))
        except InputError as error:
            raise error.about(name) from error
    data = np.array(images, dtype=np.float64)
    beams = None
    if sources is not None:
        checked = [check_source(unpack_array(source, "source")) for source in sources]
        for source in checked:
            check_shape("source", source.shape, data.shape[1:])
        beams = np.array(checked)
    used = np.array(masks)
    for name, image, plane in zip(names, data, used, strict=True):
        bad = int((~np.isfinite(image) & plane).sum())
        if bad:
            raise InputError(
                f"{name} has {bad} pixels that are NaN or infinite, expected finite numbers: mask "
                "them"
            )
        if plane.mean() < 0.05:
            check_usable(plane, f"mask of {name}")
            raise InputError(
                f"{name} has {percent(plane.mean())} of its pixels in use: unmask some"
            )
        if not image[plane].mean() > 0:
            raise InputError(f"{name} has no flux: expected a beam; check its background")
    return data, beams, used


def _common_noise(noises: Sequence[Any] | None) -> Any:
    """Return the kind of noise of all images, their standard deviations, or None."""
    if noises is None:
        return None
    kinds = {repr(noise) if isinstance(noise, str) else "a number" for noise in noises}
    if len(kinds) > 1:
        raise InputError(
            f"noise is {' in some images and '.join(sorted(kinds))} in others: give the same "
            "for all, or numbers"
        )
    return noises[0] if isinstance(noises[0], str) else noises


def _checked_strengths(strengths: Sequence[tuple[float, ...]], count: int) -> FloatArray:
    """Return strengths of images that have one for each field, shape (L, M)."""
    if set(map(len, strengths)) != {count}:
        raise InputError(
            f"strengths are {', '.join(map(str, strengths))} for {count} field{'s' * (count > 1)}: "
            "expected one number for each field in all images"
        )
    return np.array(strengths)


def _relative_strengths(matrix: FloatArray) -> FloatArray:
    """Return strengths relative to the first image; refuse ones that determine no field."""
    if not matrix[0].all():
        raise InputError(
            f"strengths of the first image are {matrix[0].tolist()}: all fields must act in it"
        )
    if matrix.shape[1] > 1 and np.linalg.matrix_rank(matrix, tol=0.02) < matrix.shape[1]:
        raise InputError(
            f"{matrix.shape[1]} fields cannot be distinguished by images of these energies: "
            "expected strengths that differ between the fields; give more energies or one field"
        )
    # All in units of the first image's.
    with np.errstate(over="ignore"):
        relative = np.asarray(matrix / matrix[0])
    if not np.abs(relative).max() <= MAX_STRENGTH:
        raise InputError(
            f"strengths are up to {np.abs(relative).max():.3g} times those of the first image: "
            f"expected at most {MAX_STRENGTH:g}; check the energies"
        )
    return relative


def _refuse_what_is_given_twice(
    data: FloatArray,
    beams: FloatArray,
    used: BoolArray,
    strengths: FloatArray,
    names: Sequence[str],
) -> None:
    for k, (image, beam, use) in enumerate(zip(data, beams, used, strict=True)):
        if strengths[k].any() and are_alike(image, beam, use):
            raise InputError(
                f"the source is {names[k]} itself, so that nothing would have deflected: give "
                "an image of the beam without the object"
            )
        for earlier in range(k):
            if are_alike(image, data[earlier], use & used[earlier]):
                raise InputError(
                    f"{names[earlier]} and {names[k]} are the same: give each image once"
                )


def _means(planes: FloatArray, used: BoolArray) -> FloatArray:
    return np.array([plane[use].mean() for plane, use in zip(planes, used, strict=True)])


def _fill(side: int, pad: int, block: int = 8, most: float = 0.03, prime: int = 19) -> int:
    """Return how many pixels to add to a side, for whole blocks and fast transforms.

    Pixels of the first stages are half a block wide. Lengths with a larger prime factor are avoided
    where that adds at most a share of the side: transforms of 251 or 307 numbers take five times as
    long as of 255 and 315.
    """
    least = -side % block
    for fill in range(least, least + int(most * side) + 1, block):
        if _largest_prime_factor(RayModel((side + fill, side + fill), pad).shape[0]) <= prime:
            return fill
    return least


def _largest_prime_factor(number: int) -> int:
    factor = 2
    while factor * factor <= number:
        if number % factor:
            factor += 1
        else:
            number //= factor
    return number


def _refuse_other_units(brightness: FloatArray, names: Sequence[str], most: float = 3.0) -> None:
    for name, ratio in zip(names, brightness, strict=True):
        if not 1 / most < ratio < most:
            raise InputError(
                f"{name} is {ratio:.3g} times as bright as its source: expected the same units; "
                "state the brightness, or let it be free"
            )


def _deviations(noise: Any, data: FloatArray, used: BoolArray, names: Sequence[str]) -> FloatArray:
    if isinstance(noise, str):
        if noise not in KINDS_OF_NOISE:
            raise InputError(
                f"noise is {noise!r}: expected {' or '.join(map(repr, KINDS_OF_NOISE))}, standard "
                "deviations or None"
            )
        means = np.stack(list(map(_smoothed, data, used)))
        if noise == "proportional":
            shares = np.array(list(map(estimated_noise, data / means, used)))
            return shares[:, None, None] * means
        if (data[used] < 0).any():
            raise InputError("images have negative pixels, so they are no counts: give the noise")
        return np.asarray(np.sqrt(np.maximum(means, _LEAST_COUNTS)))
    if noise is None:
        levels = np.array(list(map(estimated_noise, data, used)))
        return np.asarray(np.ones(data.shape) * levels[:, None, None])
    planes = []
    for name, each in zip(names, noise, strict=True):
        sigma = as_numbers(f"noise of {name}", each)
        if not sigma.size or not np.isfinite(sigma).all() or sigma.min() <= 0:
            raise InputError(f"noise of {name} is not positive: expected standard deviations")
        if sigma.shape not in ((), data.shape[1:]):
            raise InputError(
                f"noise of {name} has shape {sigma.shape}: expected one number, or an array like "
                "the image"
            )
        planes.append(np.broadcast_to(sigma, data.shape[1:]))
    return np.array(planes)


def _refuse_hopeless_noise(
    deviations: FloatArray, used: BoolArray, names: Sequence[str], most: float = 1e6
) -> None:
    """Refuse noise, relative to the beam, that hides any image; single pixels may have it."""
    for name, plane, use in zip(names, deviations, used, strict=True):
        if (least := float(plane[use].min())) > most:
            raise InputError(
                f"{name}: the noise is {least:.3g} times the beam or more: expected standard "
                "deviations in the unit of the image"
            )


def _smoothed(
    image: FloatArray, used: BoolArray, width: int = 5, darkest: float = 1e-3
) -> FloatArray:
    """Means over the used pixels around each, at least a fraction of the overall mean."""
    sums = uniform_filter(np.where(used, image, 0.0), width)
    means = np.divide(
        sums, uniform_filter(used.astype(np.float64), width), out=sums * 0, where=used
    )
    return np.asarray(np.maximum(means, darkest * image[used].mean()))


def _start_of(
    shots: Sequence[Shot], size: tuple[int, int]
) -> tuple[FloatArray | None, NearField | None]:
    """Return the potential to start from, and the field that is the only start, if there is one."""
    start = value_of_first(shots, "start")
    near = start if isinstance(start, NearField) else None
    start = near.potential if near else start
    if start is None:
        return None, None
    potential = as_numbers("start", plain_array(start, "start", unit=SQUARE_PIXELS))
    if potential.shape != size or not np.isfinite(potential).all():
        raise InputError(
            f"start has shape {potential.shape}: expected a finite potential in px² of the "
            f"images' shape {size}"
        )
    return potential, near


def check_fiducials(fiducials: ArrayLike) -> FloatArray:
    """Return fiducials as rows of y, x, dy, dx and their σ in px, or raise an `InputError`."""
    table = as_numbers("fiducials", fiducials)
    if table.ndim != 2 or table.shape[1] != 5 or not np.isfinite(table).all():
        raise InputError(
            f"fiducials have shape {table.shape}: expected rows of y, x, dy, dx, σ in px"
        )
    return table


def _checked_fiducials(
    fiducials: ArrayLike | None, size: tuple[int, int], least_error: float = 1e-6
) -> Fiducials | None:
    if fiducials is None:
        return None
    table = check_fiducials(fiducials)
    places, displacements, errors = table[:, :2], table[:, 2:4], table[:, 4]
    if ((places < -0.5) | (places > np.array(size) - 0.5)).any() or not (errors > 0).all():
        raise InputError("fiducials lie outside the image or have no positive σ: check their rows")
    if np.abs(displacements).max(initial=0.0) > max(size) or errors.min(initial=1.0) < least_error:
        raise InputError(
            f"fiducials are displaced by more than the image's {max(size)} px, or have a σ below "
            f"{least_error:g} px: check their rows"
        )
    # A pixel's centre is at its index; the rays count from the image's corner.
    return Fiducials(places + 0.5, displacements, errors)


def _checked_point_spread(name: str, psf: Any, size: tuple[int, int]) -> float | FloatArray:
    """Return a standard deviation in px, 0 for None, or a normalised kernel."""
    values = as_numbers(f"psf of {name}", 0.0 if psf is None else psf)
    if not values.size or not np.isfinite(values).all() or values.min() < 0:
        raise InputError(f"psf of {name} is {psf}: expected a standard deviation in px or a kernel")
    if values.ndim == 0:
        if float(values) > min(size) / 8:
            raise InputError(
                f"psf of {name} is {float(values):g} px: expected less than an eighth of a side"
            )
        return float(values)
    if values.ndim != 2 or not all(side % 2 for side in values.shape) or not values.sum() > 0:
        raise InputError(
            f"psf of {name} has shape {values.shape}: expected a kernel with odd sides"
        )
    return np.asarray(values / values.sum())
