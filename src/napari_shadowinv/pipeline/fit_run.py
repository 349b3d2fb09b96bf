"""From several images of one object to its fields by a recipe: `run_fit`.

- the complete inputs of a fit: `collect_fit_inputs`
- images of a table's rows or of flags: `read_row_images`; their setup: `row_setup`
- an inversion refined by a fit that starts from its field: `run_refinement`
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from napari_shadowinv._system.progress import OnProgress, ShouldStop
from napari_shadowinv._typing import FloatArray
from napari_shadowinv.cautions import Caution
from napari_shadowinv.errors import InputError
from napari_shadowinv.fitting import Fit, fit, point_spread
from napari_shadowinv.fitting.measurements import check_fiducials
from napari_shadowinv.fitting.shots import (
    NearField,
    common_values,
    value_of_first,
    values_of,
)
from napari_shadowinv.inversion import Inversion
from napari_shadowinv.inversion.normalise import mask_unlit
from napari_shadowinv.io import read_shot
from napari_shadowinv.io.files import name_of, sha256, text_of
from napari_shadowinv.options import BeamPrior, FitChoices, FitOptions, Instrument
from napari_shadowinv.physics.beam import setup_cautions
from napari_shadowinv.physics.projection import default_deflector
from napari_shadowinv.physics.setup import Setup, beam_quantities, deflector_titles, setup_from_dict
from napari_shadowinv.pipeline.files import setup_from
from napari_shadowinv.pipeline.inversion_run import AnyShot, Inputs, collect_inputs, load_shot
from napari_shadowinv.pipeline.shot_table import ShotRow, fiducials_from
from napari_shadowinv.preprocessing import FIT_STEPS, Recipe, UniformEstimate, estimate_source
from napari_shadowinv.preprocessing.alignment import measure_shift
from napari_shadowinv.preprocessing.image_checks import image_cautions
from napari_shadowinv.provenance import Origin, Provenance, index_masks
from napari_shadowinv.shot import Shot

# Numbers of an image, in rows of a table, shots and provenances.
_SOURCE_AND_UNKNOWN = "the recipe has a source and a fit with an unknown beam: expected one of them"
NUMBERS = ("strength", "brightness", "psf", "noise")


def run_refinement(
    inversion: Inversion,
    setup: Setup | None,
    choices: FitChoices,
    *,
    on_progress: OnProgress | None = None,
    should_stop: ShouldStop | None = None,
) -> Fit:
    """Fit the forward model to the image of an inversion, with its source, mask and pixels.

    Its potential is one of the starts of the fit. Choices are such as `refinement_choices`; the
    source is known, and so is the brightness. The fit has a `provenance` if the inversion has one.
    An `InputError` if the image cannot be fitted.
    """
    errors, instrument = inversion.errors, inversion.instrument
    if errors is not None and errors.beam is not None:
        beam = BeamPrior(rms=errors.beam_variation, length=errors.beam_scale)
        instrument = instrument.with_beam(beam)
    shot = Shot(
        inversion.image,
        setup=setup,
        source=inversion.source,
        mask=inversion.mask,
        start=inversion.potential,
        noise=choices.noise,
        psf=choices.psf,
    )
    result = fit(
        shot,
        fields=choices.fields or usual_fields(None if setup is None else [setup]),
        instrument=instrument,
        options=choices.options,
        on_progress=on_progress,
        should_stop=should_stop,
    )
    before = inversion.provenance
    if before is None:
        return result
    changes = {"setup": None, "instrument": Instrument(), "fit": choices}
    recipe = before.recipe.model_copy(update=changes)
    origin = before.image.model_copy(update={"mask": None, "source_mask": None, "setup": setup})
    provenance = Provenance(kind="fit", recipe=recipe, images=(origin,), start=before)
    return replace(result, provenance=provenance)


def refinement_choices(inversion: Inversion, setup: Setup | None, psf: float = 0.0) -> FitChoices:
    """Return the choices that follow from an inversion: field, boundary and seed."""
    field = "B" if setup is None else setup.deflectors[0].key
    boundary = "free" if inversion.options.boundary == "free" else "fading"
    options = FitOptions(boundary=boundary, seed=inversion.options.seed)
    return FitChoices(fields=(field,), psf=psf, options=options)


@dataclass(frozen=True, eq=False)
class FitInputs:
    """Inputs of a fit: its images after the recipe's steps, and their origin."""

    shots: tuple[Shot, ...]  # with all that is known of them, on one grid of pixels
    provenance: Provenance  # with the recipe

    @property
    def choices(self) -> FitChoices:
        """The recipe's choices, the fields and the kind of beam among them."""
        assert self.provenance.recipe.fit is not None
        return self.provenance.recipe.fit

    @property
    def fields(self) -> tuple[str, ...]:
        """Keys of the fields."""
        assert self.choices.fields is not None
        return self.choices.fields

    @cached_property
    def setups(self) -> tuple[Setup, ...] | None:
        """The setups of all images after the steps; None if there are none."""
        return values_of(self.shots, "setup")

    def run(
        self, on_progress: OnProgress | None = None, should_stop: ShouldStop | None = None
    ) -> Fit:
        """Fit the fields to the images.

        The fit has its setups and its provenance, whose recipe names its fields.
        """
        result = fit(
            self.shots,
            fields=self.fields,
            instrument=self.provenance.recipe.instrument,
            options=self.choices.options,
            on_progress=on_progress,
            should_stop=should_stop,
        )
        names = tuple(field.name for field in result.fields)
        choices = self.choices.model_copy(update={"fields": names, "options": result.options})
        recipe = self.provenance.recipe.model_copy(update={"fit": choices})
        provenance = self.provenance.model_copy(update={"recipe": recipe})
        return replace(result, setups=self.setups or (), provenance=provenance)


def run_fit(
    recipe: Recipe,
    shots: Sequence[AnyShot],
    *,
    on_progress: OnProgress | None = None,
    should_stop: ShouldStop | None = None,
) -> Fit:
    """Apply a recipe's steps to several images of one object, and fit its fields to them.

    Parameters
    ----------
    recipe : Recipe
        Steps and options; without a section `fit` the defaults apply.
    shots : sequence of Shot, array_like or path
        The images, of one size after the steps.
    on_progress, should_stop : callable, optional
        As for `napari_shadowinv.fit`.

    Returns
    -------
    Fit
        With its `provenance`, from which it can be reproduced.

    Raises
    ------
    InputError
        If recipe and images do not fit together, or cannot be fitted.
    FileFormatError
        If a file cannot be read.
    InversionCancelled
        If `should_stop` returned true.
    """
    inputs = collect_fit_inputs(recipe, shots, should_stop=should_stop)
    return inputs.run(on_progress=on_progress, should_stop=should_stop)


def collect_fit_inputs(
    recipe: Recipe, shots: Sequence[AnyShot], *, should_stop: ShouldStop | None = None
) -> FitInputs:
    """Collect the inputs of a fit: read files, apply the steps, and fill in defaults."""
    recorded = [shot if isinstance(shot, Shot) else Shot(shot) for shot in shots]
    if not recorded:
        raise InputError("received no image: expected one or several of one object")
    check_fit(recipe)
    names = [_shot_name(shot, k) for k, shot in enumerate(recorded)]
    choices = _with_free_brightness(recipe.fit or FitChoices(), recorded, names)
    recorded = [
        replace(shot, brightness=None) if shot.brightness == "free" else shot for shot in recorded
    ]
    by_default = choices.beam == "unknown"
    flags = [shot.beam_unknown or (by_default and shot.source is None) or None for shot in recorded]
    unknown = common_values(names, flags, "unknown source") is not None
    if unknown and recipe.source is not None:
        raise InputError(_SOURCE_AND_UNKNOWN)
    collected = [
        _collect_image(recipe, shot, name, unknown=unknown)
        for shot, name in zip(recorded, names, strict=True)
    ]
    ready: list[Shot] = []
    for inputs, name in zip(collected, names, strict=True):
        shot = _prepare_image(inputs, name, should_stop)
        if ready and shot.shape != ready[0].shape:
            raise InputError(
                f"{name} has shape {shot.shape}, {names[0]} {ready[0].shape}: expected images of "
                "one size, on the same pixels; crop or bin them first"
            )
        ready.append(shot)
    setups = common_values(names, [shot.setup for shot in ready], "setup")
    fields = choices.fields or usual_fields(setups)
    beam = "unknown" if unknown else "known"
    resolved = choices.model_copy(update={"fields": fields, "beam": beam})
    source = recipe.estimate
    cleared = {"source": source, "mask": None, "source_mask": None, "setup": None, "fit": resolved}
    table, origin = _read_fiducials(value_of_first(recorded, "fiducials"))
    if recipe.dark_file is not None:  # by its name only; the images have its checksum
        recipe = recipe.with_dark_file(Path(name_of(recipe.dark_file)))
    provenance = Provenance(
        kind="fit",
        recipe=recipe.model_copy(update=cleared),
        **_image_origins(recorded, collected, ready),
        fiducials=origin,
        fiducial_rows=None if table is None else table.tolist(),
    )
    complete = [
        _with_choices(shot, recorded[k], choices, names[k], unknown) for k, shot in enumerate(ready)
    ]
    if source is not None:  # an estimate
        complete = [replace(shot, measured=False) for shot in complete]
    complete[0] = replace(complete[0], fiducials=table)
    return FitInputs(tuple(complete), provenance)


def _with_free_brightness(
    choices: FitChoices, shots: Sequence[Shot], names: Sequence[str]
) -> FitChoices:
    """Return choices with the brightness of shots, which a result can repeat; refuse arrays."""
    for shot, name in zip(shots, names, strict=True):
        for key in ("noise", "psf", "start"):
            value = getattr(shot, key)
            if np.ndim(value) or isinstance(value, NearField):
                raise InputError(
                    f"{name} has an array as its {key}, which a result cannot repeat: pass the "
                    "shots to fit" + (", or give a number" if key != "start" else "")
                )
    free = common_values(
        names, [shot.brightness == "free" or None for shot in shots], "free brightness"
    )
    return choices if free is None else choices.model_copy(update={"brightness": "free"})


def _with_choices(
    shot: Shot, recorded: Shot, choices: FitChoices, name: str, unknown: bool
) -> Shot:
    """Return a shot after the steps with its own attributes, or else those for all images."""
    psf = shot.psf
    if psf is None and (choices.source_size is not None or choices.resolution is not None):
        if shot.setup is None:
            raise InputError(
                f"{name} has no setup, and source size and resolution are in m: give the setup, or "
                "the point spread in px",
                option="fit.psf",
            )
        psf = point_spread(shot.setup, choices.source_size or 0.0, choices.resolution or 0.0)
    free = "free" if choices.brightness == "free" else None
    return replace(
        shot,
        source="unknown" if unknown else shot.source,
        brightness=free if recorded.brightness is None else recorded.brightness,
        psf=choices.psf if psf is None else psf,
        noise=choices.noise if shot.noise is None else shot.noise,
        name=name,
    )


def check_fit(recipe: Recipe) -> None:
    """Raise an `InputError` if the recipe does not suit a fit, before any image is read."""
    for step in recipe.steps:
        if step.name() not in FIT_STEPS:
            raise InputError(
                f"the recipe has the step {step.summary}, which changes what the forward model "
                f"is fitted to: leave it out; expected some of {', '.join(FIT_STEPS)}"
            )
    if recipe.fit is not None and recipe.fit.beam == "unknown" and recipe.source is not None:
        raise InputError(_SOURCE_AND_UNKNOWN)


def _shot_name(shot: Shot, k: int) -> str:
    path = shot.image if isinstance(shot.image, (str, Path)) else shot.path
    return shot.name or (f"image {k + 1}" if path is None else str(path))


def _collect_image(recipe: Recipe, shot: Shot, name: str, *, unknown: bool) -> Inputs:
    """Collect an image as recorded, with its source and masks; its brightness is fitted."""
    changes = {"setup": shot.setup or recipe.setup, "fit": None}
    shot = replace(shot, source=None if shot.beam_unknown else shot.source, brightness=None)
    try:
        if unknown:
            shot = replace(load_shot(shot, "the image"), source=None)
        inputs = collect_inputs(recipe.model_copy(update=changes), shot)
        inputs.recipe.check(inputs.shot)
    except InputError as error:
        raise InputError(f"{name}: {error}") from error
    return inputs


def _prepare_image(inputs: Inputs, name: str, should_stop: ShouldStop | None) -> Shot:
    try:
        shot = inputs.recipe.prepare(inputs.shot, should_stop)
        source = shot.source
        mask, doubts = mask_unlit(shot.image, source, shot.mask)
        shot = replace(shot, mask=mask)
        doubts += image_cautions(shot.image, source, shot.mask)
        if source is not None:
            shift = measure_shift(shot.image, source, shot.mask)
            if shift.is_significant.any():
                text = f"register: the source must be moved by {shift.text}: align it before a fit"
                doubts.append(Caution("register", text))
        if shot.setup is not None:
            doubts += setup_cautions(shot.setup, shot.shape, shot.metadata)
        estimate = inputs.estimate_for(shot)
        if estimate is not None and not isinstance(estimate, UniformEstimate):
            source = estimate_source(estimate, shot, should_stop, doubts.append)
        return replace(shot, source=source, cautions=(*shot.cautions, *doubts))
    except InputError as error:
        raise InputError(f"{name}: {error}") from error


def usual_fields(setups: Sequence[Setup] | None) -> tuple[str, ...]:
    """Return the field that usually deflects such beams."""
    if not setups:
        return ("B",)
    names = {title: key for key, title in deflector_titles().items()}
    try:
        (usual,) = {names[default_deflector(setups[0], setup)] for setup in setups}
    except InputError as error:
        raise InputError(f"{error}; choose the fields, of {', '.join(names.values())}") from error
    return (usual,)


def _read_fiducials(fiducials: ArrayLike | Path | None) -> tuple[FloatArray | None, Origin | None]:
    if fiducials is None:
        return None, None
    if isinstance(fiducials, (str, Path)):
        fiducials = Path(fiducials)
        origin = Origin(file=text_of(fiducials.name), sha256=sha256(fiducials))
        return np.array(fiducials_from(fiducials)), origin
    return check_fiducials(fiducials), Origin()


def _image_origins(
    recorded: Sequence[Shot], collected: Sequence[Inputs], ready: Sequence[Shot]
) -> dict[str, Any]:
    origins, masks = [], []
    for row, inputs, shot in zip(recorded, collected, ready, strict=True):
        before = inputs.provenance
        entries: dict[str, Any] = {name: getattr(row, name) for name in (*NUMBERS, "measured")}
        entries["setup"] = inputs.shot.setup
        entries |= {"notes": shot.notes, "cautions": shot.cautions}
        origins.append(before.image.model_copy(update=entries))
        masks.append(list(map(before.mask_of, (before.image.mask, before.image.source_mask))))
    return index_masks(origins, masks)


def read_row_images(
    rows: Sequence[ShotRow], recipe: Recipe, *, channel: str | int | None = None
) -> tuple[Shot, ...]:
    """Read the images of rows, whose energies or wavelengths complete the setups.

    The recipe's setup applies to images without one; `channel` is the part of each file to read,
    and of its source.
    """
    images = []
    for row in rows:
        recorded = read_shot(row.file, channel=channel)
        source: Any = row.source
        if isinstance(source, Path):
            source = read_shot(source, channel=channel)
        numbers = {name: getattr(row, name) for name in NUMBERS}
        described = Shot(row.file, row_setup(row, recorded, recipe), source, row.mask, **numbers)
        images.append(described.completed_by(recorded))
    return tuple(images)


def row_setup(row: ShotRow, shot: Shot, recipe: Recipe) -> Setup | None:
    """Return the setup of an image from its row, the recipe, or its file, in this order.

    An `InputError` is raised if the row has an energy or a wavelength, no strength, and there is no
    setup to complete it. With a strength, an energy without a setup is a name of the image.
    """
    changes = row.beam
    if row.setup is not None:
        return setup_from(row.setup, shot.metadata.get("geometry"), changes)
    setup = recipe.setup or shot.setup
    if setup is not None:
        return setup_from_dict({**setup.model_dump(), **changes}, str(row.file))
    if not changes or row.strength is not None:
        return None
    nouns = " and ".join(beam_quantities()[name].noun for name in changes)
    article = "an" if nouns[0] in "aeiou" else "a"
    raise InputError(
        f"{row.file} has {article} {nouns} of {row.beam_text} and no setup: give the rest of the "
        "geometry as a setup",
        option="setup",
    )
