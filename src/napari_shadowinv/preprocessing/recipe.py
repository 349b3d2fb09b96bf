"""All steps from a shot to its field, as one model: `Recipe`.

- all steps, by name: `STEPS`; only filters: `FILTERS`; steps allowed before a fit: `FIT_STEPS`;
  estimates of the source: `ESTIMATES`
"""

from __future__ import annotations

from dataclasses import replace
from functools import reduce
from operator import or_
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
from pydantic import Field

from napari_shadowinv._system.progress import ShouldStop
from napari_shadowinv._system.validation import CheckedModel
from napari_shadowinv._typing import BoolArray, FloatArray
from napari_shadowinv.cautions import Caution, OnCaution, warn_of
from napari_shadowinv.errors import InputError
from napari_shadowinv.facts import percent
from napari_shadowinv.options import FitChoices, Instrument, InversionOptions
from napari_shadowinv.physics.arrays import check_shape
from napari_shadowinv.physics.setup import Setup
from napari_shadowinv.preprocessing.estimates import Estimate
from napari_shadowinv.preprocessing.filters import Filter, HotPixelFilter
from napari_shadowinv.preprocessing.steps import Choice, Dark, Step, choices_of
from napari_shadowinv.shot import Shot

_MIN_VISIBLE_SHARE = 0.1  # of an object under the source mask, for the inversion to see it
_MIN_OBJECT_PIXELS = 10  # pixels
_MAX_FALL = 10.0  # times below the dimmest pixel seen


class MeasuredSource(Choice):
    """An image of the beam without the object."""

    title = "measured"
    key = "method"
    method: Literal["measured"] = "measured"
    file: Path | None = Field(
        default=None, title="File", description="Image of the undisturbed beam."
    )
    variable: str | None = Field(
        default=None, title="Array", description="Name of the array in a file with several."
    )


# All choices defined in the modules imported here are steps, or sources, of a recipe.
STEPS = choices_of(Step)
FILTERS = {name: step for name, step in STEPS.items() if issubclass(step, Filter)}
# Filters that blur or flatten would change the data that the forward model is fitted to.
FIT_STEPS = {
    name: step
    for name, step in STEPS.items()
    if name not in FILTERS or issubclass(step, HotPixelFilter)
}
ESTIMATES = choices_of(Estimate)

if TYPE_CHECKING:
    AnyStep = Step
    AnySource = MeasuredSource | Estimate
else:
    AnyStep = Annotated[reduce(or_, STEPS.values()), Field(discriminator="step")]
    AnySource = Annotated[
        reduce(or_, ESTIMATES.values(), MeasuredSource), Field(discriminator="method")
    ]


class Recipe(CheckedModel):
    """All steps from the image of a shot to its field.

    Raises
    ------
    InputError
        If a value is out of range or a name is unknown.

    Examples
    --------
    >>> recipe = Recipe(steps=[{"step": "bin", "factor": 2}, {"step": "low-pass", "width": 1.5}])
    >>> Recipe.model_validate_json(recipe.model_dump_json()) == recipe
    True
    """

    steps: tuple[AnyStep, ...] = Field(
        default=(), description="What is done to the image first, in this order."
    )
    source: AnySource | None = Field(
        default=None,
        description="The undisturbed beam. Default: as measured if there is one, else uniform.",
    )
    source_mask: Path | None = Field(
        default=None, description="Image of the same size, 0 where the object covers the beam."
    )
    mask: Path | None = Field(
        default=None, description="Image of the same size, 0 at unusable pixels."
    )
    setup: Setup | None = Field(
        default=None, description="The experimental geometry, for results in SI units."
    )
    instrument: Instrument = Field(
        default=Instrument(),
        description="How well beam, detector and alignment are known, for the errors.",
    )
    options: InversionOptions = Field(
        default=InversionOptions(), description="Options of the inversion."
    )
    fit: FitChoices | None = Field(
        default=None,
        description="Choices of a fit of the forward model, for those that fit and do not invert.",
    )

    @property
    def dark_file(self) -> Path | None:
        """File of the dark frame to subtract; an `InputError` if there are several."""
        files = {step.frame_file for step in self.steps if isinstance(step, Dark)} - {None}
        if len(files) > 1:
            raise InputError(f"got {len(files)} dark frames, expected one: average them first")
        return files.pop() if files else None

    def with_dark_file(self, file: Path) -> Recipe:
        """Return the recipe with its dark frame in another file."""
        steps = tuple(
            Dark(level=file) if isinstance(step, Dark) and step.frame_file else step
            for step in self.steps
        )
        return self.model_copy(update={"steps": steps})

    @property
    def estimate(self) -> Estimate | None:
        """Estimate of the source; None if it is measured, or uniform by default."""
        return self.source if isinstance(self.source, Estimate) else None

    def shape_after(self, shape: tuple[int, int]) -> tuple[int, int]:
        """Return the shape after all steps, for an image of a shape."""
        for step in self.steps:
            shape = step.shape_after(shape)
        return shape

    def matrix(self, shape: tuple[int, int]) -> FloatArray:
        """Return the matrix from (y, x, 1) after all steps to (y, x, 1) in an image of a shape."""
        matrix = np.eye(3)
        for step in self.steps:
            matrix = matrix @ step.matrix(shape)
            shape = step.shape_after(shape)
        return matrix

    def move(self, shot: Shot) -> Shot:
        """Return a shot after only the steps that move pixels, such as for its masks."""
        for step in self.steps:
            if step.moves_pixels:
                shot = step.apply(shot)
        return shot

    def check(self, shot: Shot) -> None:
        """Reject choices that contradict each other, or the shot, before any work is done.

        An `InputError` if arrays differ in shape, there is an uneven source though the image is
        flattened, or any source though it is estimated, no source mask for an estimate that needs
        one, or the mask hides the object, too.
        """
        for name in ("source", "mask", "source_mask"):
            array = getattr(shot, name)
            if array is not None:
                check_shape(name.replace("_", " "), array.shape, shot.shape)
        if shot.source is not None:
            if self.estimate is not None:
                raise InputError(
                    f"got a measured source and the estimate '{self.estimate.title}': choose one "
                    "of them"
                )
            is_flat = np.ptp(shot.source) == 0
            for step in self.steps:
                if step.flattens and not is_flat:
                    raise InputError(
                        f"got a source and the filter {step.summary}, which would flatten the "
                        "image but not the source: leave the filter out, or choose the source "
                        "'uniform'"
                    )
        elif isinstance(self.source, MeasuredSource):
            raise InputError("the recipe asks for a measured source, but none is given: give one")
        if self.estimate is not None:
            if self.estimate.needs_mask and shot.source_mask is None:
                raise InputError(
                    f"got the estimate '{self.estimate.title}' without a source mask, which "
                    "hides the object from the estimate but not from the inversion: give one"
                )
            check_masks(shot.mask, shot.source_mask)
        if shot.source_mask is not None and not (self.estimate and self.estimate.uses_mask):
            raise InputError(
                "got a source mask but no source estimate to use it: leave the mask out, or "
                "choose an estimate"
            )

    def prepare(self, shot: Shot, should_stop: ShouldStop | None = None) -> Shot:
        """Return a shot, with its source and masks, after all steps; see `Step.apply`.

        Gaps of the detector are masked before the steps, which would change their values.
        """
        from napari_shadowinv.preprocessing.image_checks import mask_gaps  # imports scipy.fft

        for plane, name in ((shot.image, "image"), (shot.source, "source")):
            if plane is not None:
                mask, doubts = mask_gaps(plane, shot.mask, name)
                shot = replace(shot, mask=mask, cautions=(*shot.cautions, *doubts))
        for step in self.steps:
            shot = step.apply(shot, should_stop)
        return shot


def check_masks(mask: BoolArray | None, bare: BoolArray | None) -> None:
    """Refuse with an `InputError` a mask that hides nearly all of the object, ``~bare``."""
    if mask is None or bare is None or bare.all():
        return
    from scipy.ndimage import label

    # Place by place: a source mask may hide a wide border of unusable pixels, too.
    places, count = label(~bare, np.ones((3, 3)))
    hidden = np.bincount(places.ravel(), minlength=count + 1)[1:]
    visible = np.bincount(places[mask], minlength=count + 1)[1:]
    # Stray pixels are no object, unless there is nothing else.
    objects = hidden >= min(_MIN_OBJECT_PIXELS, hidden.max())
    hidden, visible = hidden[objects], visible[objects]
    if (visible < _MIN_VISIBLE_SHARE * hidden).all():
        raise InputError(
            f"the mask hides {percent(1 - visible.sum() / hidden.sum())} of what the source mask "
            "hides, so the object would be excluded from the inversion: use the mask for "
            "unusable pixels only and the source mask for the object; if the object itself is "
            "unusable, leave the source mask out, as estimates ignore masked pixels anyway"
        )


def estimate_source(
    estimate: Estimate,
    shot: Shot,
    should_stop: ShouldStop | None = None,
    on_caution: OnCaution | None = None,
) -> FloatArray:
    """Estimate the source of a shot after its steps, from the pixels that neither mask hides."""
    beam, usable = _for_estimate(shot)
    source = estimate.source(beam, usable, should_stop, on_caution)
    bare = shot.source_mask
    if bare is None:
        return source
    around, object_ = (bare, ~bare) if shot.mask is None else (bare & shot.mask, ~bare & shot.mask)
    if object_.any() and source[object_].min() < beam[around].min() / _MAX_FALL:
        text = (
            f"the estimated source falls to {source[object_].min():.3g} under the source mask, "
            f"while the image is at least {beam[around].min():.3g} elsewhere: compare it with "
            "another estimate"
        )
        (on_caution or warn_of)(Caution("source", text))
    return source


def with_prior_of(
    estimate: Estimate,
    shot: Shot,
    instrument: Instrument,
    should_stop: ShouldStop | None = None,
) -> Instrument:
    """Return an instrument with the error of an estimated source, unless another is stated."""
    if "beam_rms" in instrument.stated:
        return instrument
    prior = estimate.beam_prior(*_for_estimate(shot), should_stop)
    return instrument if prior is None else instrument.with_beam(prior)


def _for_estimate(shot: Shot) -> tuple[FloatArray, BoolArray | None]:
    """Return the image without negative pixels, 0 where it is masked, and the usable pixels."""
    masks = [mask for mask in (shot.mask, shot.source_mask) if mask is not None]
    usable = np.logical_and.reduce(masks) if masks else None
    image = shot.image if shot.mask is None else np.where(shot.mask, shot.image, 0)
    return np.maximum(image, 0), usable
