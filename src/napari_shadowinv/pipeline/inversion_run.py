"""From a shot to its field by a recipe: `run`.

- the complete inputs of a recipe: `collect_inputs`
- the inversion of a shot after the steps: `run_prepared`
- the sites and sources that a window reuses between runs: `Cache`
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from napari_shadowinv._system.progress import OnProgress, Reporter, ShouldStop
from napari_shadowinv._system.safety import check_memory
from napari_shadowinv._system.validation import as_model
from napari_shadowinv._typing import BoolArray, FloatArray
from napari_shadowinv.cautions import Caution
from napari_shadowinv.errors import InputError
from napari_shadowinv.inversion import Inversion, invert, plan_sites
from napari_shadowinv.inversion.compilation import ensure_compiled
from napari_shadowinv.inversion.normalise import check_source, mask_unlit, prepare
from napari_shadowinv.io import read_shot
from napari_shadowinv.io.files import join_address, sha256, split_address, text_of
from napari_shadowinv.options import InversionOptions
from napari_shadowinv.physics.arrays import (
    check_plane,
    check_shape,
    check_spacing,
    check_usable,
    join_masks,
    unpack_array,
)
from napari_shadowinv.physics.beam import deflection_cautions, setup_cautions
from napari_shadowinv.pipeline.remaining_beam import after_steps
from napari_shadowinv.preprocessing import (
    Estimate,
    MeasuredSource,
    Recipe,
    UniformEstimate,
    estimate_source,
    uniform_cautions,
    with_prior_of,
)
from napari_shadowinv.preprocessing.estimates import IsotropicEstimate
from napari_shadowinv.provenance import ImageOrigin, MaskOrigin, Origin, Provenance, index_masks
from napari_shadowinv.shot import Shot
from napari_shadowinv.transport.sites import SitePlan


@dataclass
class Cache:
    """Sites of the last run, for the next one with the same beam."""

    hits: int = 0  # how often sites were used again
    _plan: tuple[str, FloatArray, BoolArray, SitePlan] | None = field(default=None, repr=False)
    _solved: tuple[SitePlan, Inversion] | None = field(default=None, repr=False)

    def plan(
        self,
        source: FloatArray,
        mask: BoolArray | None,
        options: InversionOptions,
        on_progress: OnProgress | None = None,
        should_stop: ShouldStop | None = None,
        *,
        measured: bool = True,
    ) -> SitePlan:
        """Return the sites for a source, computed only if anything about them has changed."""
        key = f"{options.site_key()}{measured}"
        usable = np.ones(source.shape, bool) if mask is None else mask
        if self._plan is not None:
            last_key, last_source, last_usable, plan = self._plan
            is_same = key == last_key and _is_close(source, last_source)
            if is_same and np.array_equal(usable, last_usable):
                self.hits += 1
                return plan
        plan = plan_sites(
            source,
            options,
            mask=mask,
            measured=measured,
            on_progress=on_progress,
            should_stop=should_stop,
        )
        # At once: a run that was cancelled may still be about to do the same.
        self._plan = key, source, usable, plan
        return plan

    def last_inversion(self, plan: SitePlan) -> Inversion | None:
        """Return the last inversion passed to `keep`, if it has these sites."""
        solved = self._solved
        return solved[1] if solved is not None and solved[0] is plan else None

    def keep(self, plan: SitePlan, inversion: Inversion) -> None:
        """Store an inversion with these sites as start of the next one."""
        self._solved = plan, inversion


def _is_close(first: FloatArray, second: FloatArray) -> bool:
    # A filter keeps the mean of a uniform source to rounding only.
    return first.shape == second.shape and bool(np.allclose(first, second, rtol=1e-9, atol=0))


PREVIEW_SITES = 5_000
_BYTES_PER_PIXEL = 24  # of an image and copies that steps make; an inversion needs more

AnyShot = Shot | ArrayLike | str | Path


@dataclass(frozen=True, eq=False)
class Inputs:
    """Inputs of a recipe, from which an inversion can be repeated."""

    recipe: Recipe  # with the setup and the kind of source of this shot
    shot: Shot  # as recorded, with its source and masks
    provenance: Provenance  # origin of all of them

    def estimate_for(self, shot: Shot) -> Estimate | None:
        """Return the estimate of the source of a shot after the steps; None if it is measured."""
        estimate, recorded = self.recipe.estimate, self.shot.shape
        return estimate and estimate.adapt_to(shot.setup, recorded, self.recipe.matrix(recorded))


def run(
    recipe: Recipe,
    shot: AnyShot,
    *,
    on_progress: OnProgress | None = None,
    should_stop: ShouldStop | None = None,
    cache: Cache | None = None,
    preview: bool = False,
) -> Inversion:
    """Apply a recipe to a shot.

    Parameters
    ----------
    recipe : Recipe
        Steps and options.
    shot : Shot, array_like of shape (H, W), or path
        The image, with its attributes. What is given with the shot precedes the recipe's setup and
        source, and these the setup in the image's file; a pixel is used where the masks of both are
        true.
    on_progress, should_stop : callable, optional
        As for `napari_shadowinv.invert`.
    cache : Cache, optional
        Sites of earlier runs.
    preview : bool, default False
        Be quick rather than exact: few sites, and an estimate from merged pixels.

    Returns
    -------
    Inversion
        With its `provenance`, from which it can be reproduced.

    Raises
    ------
    InputError
        If recipe and shot do not fit together, or the shot cannot be inverted.
    FileFormatError
        If a file cannot be read.
    InversionCancelled
        If `should_stop` returned true.

    Examples
    --------
    >>> import numpy as np
    >>> from napari_shadowinv.preprocessing import Bin, Recipe
    >>> inversion = run(Recipe(steps=(Bin(factor=2),)), np.ones((16, 16)))
    >>> inversion.image.shape
    (8, 8)
    """
    recipe = as_model(Recipe, recipe, "recipe")
    report = Reporter(on_progress, should_stop)
    clock = time.perf_counter()
    report("prepare", 0, None, "image and source")
    try:
        inputs = collect_inputs(recipe, shot)
        inputs.recipe.check(inputs.shot)
        of_fits = ("strength", "psf", "noise", "fiducials", "start")
        if unused := [name for name in of_fits if getattr(inputs.shot, name) is not None]:
            text = f"the shot has {', '.join(unused)}, which only fits use: fit the image to use it"
            cautions = (*inputs.shot.cautions, Caution("file", text))
            inputs = replace(inputs, shot=replace(inputs.shot, cautions=cautions))
        return run_prepared(
            inputs,
            inputs.recipe.prepare(inputs.shot, should_stop),
            on_progress=on_progress,
            should_stop=should_stop,
            cache=cache,
            preview=preview,
            began=clock,
        )
    except InputError as error:
        if not isinstance(shot, Shot) or shot.path is None:
            raise
        raise error.about(shot.path) from error


def run_prepared(
    inputs: Inputs,
    shot: Shot,
    *,
    on_progress: OnProgress | None = None,
    should_stop: ShouldStop | None = None,
    cache: Cache | None = None,
    preview: bool = False,
    began: float | None = None,
) -> Inversion:
    """Invert a shot after the recipe's steps, otherwise as `run`.

    The inputs have the shot as recorded; the work began at a value of `time.perf_counter`, now by
    default.
    """
    report = Reporter(on_progress, should_stop)
    cache = Cache() if cache is None else cache
    options = inputs.recipe.options
    if preview:
        fewer = min(options.n_sites or PREVIEW_SITES, PREVIEW_SITES)
        options = options.model_copy(update={"n_sites": fewer})
    seconds: dict[str, float] = {}
    clock = time.perf_counter() if began is None else began
    report("prepare", 0, None)
    mask, doubts = mask_unlit(shot.image, shot.source, shot.mask)
    shot = replace(shot, mask=mask)
    # Before an estimate is made, and before sites are spread: mistakes are reported at once.
    if shot.source is None:
        prepare(shot.image, None, options, shot.mask)
    source = _source(inputs, shot, report, doubts, preview=preview)
    instrument, estimate = inputs.recipe.instrument, inputs.recipe.estimate
    measured = estimate is None and shot.measured
    if estimate is not None:
        instrument = with_prior_of(estimate, shot, instrument, should_stop)
    flattens = any(step.flattens for step in inputs.recipe.steps)
    is_fitted = not isinstance(estimate, UniformEstimate | IsotropicEstimate | None)
    is_fitted &= instrument.beam_rms is None  # else the number is that of the estimate
    has_prior = instrument.beam_of(measured=False).components is not None
    if (flattens or is_fitted) and not (has_prior or preview):
        source_of = partial(_remaining_source, inputs, should_stop=should_stop)
        with suppress(InputError):  # an estimate may refuse a changed image
            instrument = after_steps(
                instrument, inputs.recipe, inputs.shot, source_of, measured=measured
            )
    report("prepare", 0, None)
    prepare(shot.image, source, options, shot.mask)
    seconds["source"] = time.perf_counter() - clock
    ensure_compiled(on_progress, should_stop)
    clock = time.perf_counter()
    plan = cache.plan(source, shot.mask, options, on_progress, should_stop, measured=measured)
    seconds["sites"] = time.perf_counter() - clock
    inversion = invert(
        shot.image,
        plan=plan,
        options=options,
        instrument=instrument,
        # The final result must not depend on earlier previews.
        start=cache.last_inversion(plan) if preview else None,
        on_progress=on_progress,
        should_stop=should_stop,
    )
    if preview:
        cache.keep(plan, inversion)
    spent = inversion.report.seconds
    seconds |= {stage: spent[stage] + seconds.get(stage, 0.0) for stage in spent}
    notes = (*shot.notes, "previewed") if preview else shot.notes
    recipe = inputs.provenance.recipe.model_copy(update={"options": options})
    provenance = inputs.provenance.with_image(notes=notes).model_copy(
        update={"setup": shot.setup, "recipe": recipe}
    )
    report_in_all = replace(inversion.report, seconds=seconds)
    inversion = replace(inversion, report=report_in_all, setup=shot.setup, provenance=provenance)
    if shot.setup is not None:
        doubts += setup_cautions(shot.setup, shot.shape, shot.metadata)
        doubts += deflection_cautions(shot.setup, inversion.displacement)
    return inversion.with_cautions(dict.fromkeys((*doubts, *shot.cautions)))


def _source(
    inputs: Inputs,
    shot: Shot,
    report: Reporter,
    doubts: list[Caution],
    *,
    preview: bool,
) -> FloatArray:
    if isinstance(inputs.recipe.estimate, UniformEstimate):
        recorded = inputs.shot.shape
        matrix = inputs.recipe.matrix(recorded)
        doubts.extend(uniform_cautions(shot.setup, shot.shape, recorded, matrix))
    if shot.source is not None:
        usable = np.ones(shot.shape, bool) if shot.mask is None else shot.mask
        check_source(shot.source, usable)
        return np.asarray(shot.source, dtype=np.float64)
    estimate = inputs.estimate_for(shot)
    assert estimate is not None
    report("source", 0, None, estimate.title)
    return estimate_source(estimate, shot, report.should_stop, doubts.append)


def _remaining_source(inputs: Inputs, shot: Shot, should_stop: ShouldStop | None) -> FloatArray:
    """Return the source of a shot with another beam; flat if its error is stated."""
    is_stated = inputs.recipe.instrument.beam_rms is not None
    estimate = None if is_stated else inputs.estimate_for(shot)
    if estimate is None:
        return np.ones(shot.shape)
    return estimate_source(estimate, shot, should_stop, lambda caution: None)


def collect_inputs(recipe: Recipe, shot: AnyShot) -> Inputs:
    """Collect the inputs of a recipe: read files, and fill in defaults of the shot."""
    entered = shot if isinstance(shot, Shot) else Shot(shot)
    loaded = load_shot(entered, "the image")
    setup = loaded.given_setup or recipe.setup or loaded.setup
    beam = _beam_of(recipe, loaded)
    if setup is not None:
        check_spacing(entered.image, "the image", setup.pixel_sizes)
        check_spacing(entered.source, "the source", setup.pixel_sizes)
    # A mask's file precedes the recipe's; of arrays, both hold.
    is_file = isinstance(loaded.mask, (str, Path))
    usable = _mask([loaded.mask, None if is_file else recipe.mask], "mask", loaded.shape)
    usable = _without_gaps(usable, loaded, beam)
    bare = _mask((loaded.source_mask, recipe.source_mask), "source mask", loaded.shape)
    kind = recipe.source
    if kind is None:
        kind = UniformEstimate() if beam is None else MeasuredSource()
    elif isinstance(kind, MeasuredSource):
        kind = MeasuredSource()
    resolved = recipe.model_copy(
        update={"source": kind, "mask": None, "source_mask": None, "setup": setup}
    )
    dark = _dark_frame(recipe, loaded)
    if dark is not None:
        origin = _origin(dark)
        resolved = resolved.with_dark_file(join_address(origin.file, origin.variable))
    factor = None if isinstance(loaded.brightness, str) else loaded.brightness
    origin = ImageOrigin(
        **dict(_origin(loaded)),
        source=None if beam is None else _origin(beam),
        dark=None if dark is None else _origin(dark),
        brightness=factor,
        measured=loaded.measured,
    )
    masks = index_masks([origin], [(usable, bare)])
    provenance = Provenance(kind="inversion", recipe=resolved, **masks)
    complete = replace(
        loaded,
        image=loaded.image if factor is None else loaded.image / factor,
        brightness=None,
        source=None if beam is None else beam.image,
        setup=resolved.setup,
        cautions=(*loaded.cautions, *(() if beam is None else beam.cautions)),
        mask=None if usable is None else usable.pixels,
        source_mask=None if bare is None else bare.pixels,
        dark=None if dark is None else dark.image,
    )
    return Inputs(resolved, complete, provenance)


def load_shot(shot: AnyShot, name: str) -> Shot:
    """Return a shot with its image in memory, and with the other contents of its file."""
    entered = shot if isinstance(shot, Shot) else Shot(shot)
    if isinstance(entered.image, (str, Path)):
        return entered.completed_by(read_shot(Path(entered.image)))
    return replace(entered, image=plane_of(unpack_array(entered.image, name), name))


def _beam_of(recipe: Recipe, shot: Shot) -> Shot | None:
    """Return the source of a shot, or the recipe's."""
    if shot.beam_unknown:
        raise InputError(
            "the source is 'unknown', which only a fit can find: give an image of it, or none"
        )
    kind = recipe.source
    if shot.source is not None:
        return load_shot(shot.source, "the source")
    if isinstance(kind, MeasuredSource) and (file := _source_file(kind, shot)) is not None:
        # The channel is that of both.
        channel = shot.metadata.get("channel")
        return read_shot(file, channel=channel, variable=kind.variable)
    return None


def _dark_frame(recipe: Recipe, shot: Shot) -> Shot | None:
    file = recipe.dark_file
    if shot.dark is not None:
        raise InputError(
            "the shot has a dark frame, which a result cannot repeat: name its file in the "
            "step dark"
        )
    if file is None:
        return None
    frame = read_shot(file)
    check_shape(f"{file}: the dark frame", frame.shape, shot.shape)
    bad = int((~np.isfinite(frame.image)).sum())
    if bad:
        raise InputError(f"{file}: the dark frame has {bad} pixels that are NaN or infinite")
    return frame


def _source_file(kind: MeasuredSource, shot: Shot) -> Path | None:
    return kind.file if kind.file is not None or kind.variable is None else shot.path


def _mask(
    masks: Sequence[ArrayLike | Path | None], name: str, shape: tuple[int, int]
) -> MaskOrigin | None:
    """Return where all masks are true, with the file if there is only one, which is a file."""
    listed: list[Any] = [mask for mask in masks if mask is not None]
    if not listed:
        return None
    planes = [_pixels(mask, name) for mask in listed]
    for mask, pixels in zip(listed, planes, strict=True):
        is_file = isinstance(mask, (str, Path))
        check_shape(f"{mask}: {name}" if is_file else name, pixels.shape, shape)
    joined = MaskOrigin.of(join_masks(*planes))
    if len(listed) > 1 or not isinstance(listed[0], (str, Path)):
        return joined
    path, variable = split_address(listed[0])
    from_file = {"file": text_of(path.name), "variable": variable, "sha256": sha256(path)}
    return joined.model_copy(update=from_file)


def _pixels(mask: Any, name: str) -> Any:
    if isinstance(mask, (str, Path)):
        return picture_mask(Path(mask), name)
    pixels = np.asarray(unpack_array(mask, name))
    if pixels.dtype != np.bool_:
        raise InputError(
            f"{name} has values of type {pixels.dtype}, expected booleans: compare it with "
            "a number, as in mask > 0"
        )
    check_usable(pixels, name)
    return pixels


def _without_gaps(mask: MaskOrigin | None, *images: Shot | None) -> MaskOrigin | None:
    """Remove pixels without a value in files from a mask."""
    masked = (image for image in images if image is not None and image.mask is not None)
    masks = [~np.isnan(image.image) for image in masked]
    pixels = join_masks(mask and mask.pixels, *masks)
    if pixels is None or (mask is not None and np.array_equal(pixels, mask.pixels)):
        return mask
    return MaskOrigin.of(pixels)


def picture_mask(path: Path, name: str = "mask") -> BoolArray:
    """Read a mask from a picture that is 0, or transparent, at unusable pixels."""
    image = read_shot(path, channel="mean").image
    mask: BoolArray = np.nan_to_num(image) != 0
    check_usable(mask, f"{path}: {name}")
    return mask


def plane_of(values: Any, name: str) -> FloatArray:
    """Return an image as floats; an `InputError` if it is none."""
    array = check_plane(values, name)
    check_memory(array.shape, _BYTES_PER_PIXEL, "an image")
    return array.astype(np.float64)


def _origin(image: Shot) -> Origin:
    metadata = image.metadata
    return Origin(
        file="" if image.path is None else text_of(image.path.name),
        sha256=str(metadata.get("sha256", "")),
        variable=metadata.get("variable"),
        channel=metadata.get("channel"),
        shape=image.shape,
    )
