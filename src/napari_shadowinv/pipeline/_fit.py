"""From several images of one object to its fields by a recipe: `run_fit`, `run_comparison`.

- one image, with what is known about it: `FitShot`
- what a recipe's fit is made of, complete: `gathered_fit`
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from napari_shadowinv import __version__
from napari_shadowinv._system.progress import OnProgress, ShouldStop
from napari_shadowinv._typing import AnyArray, FloatArray
from napari_shadowinv.cautions import Caution
from napari_shadowinv.errors import InputError
from napari_shadowinv.fitting import Fit, compare, fit, point_spread
from napari_shadowinv.inversion.budget import ASSUMED_VARIATION
from napari_shadowinv.io.files import sha256, text_of
from napari_shadowinv.options import FIELDS, FitChoices, FitOptions, KindOfNoise
from napari_shadowinv.physics.projection import default_deflector
from napari_shadowinv.physics.setup import Setup, setup_warnings
from napari_shadowinv.pipeline._run import Inputs, Shot, gathered, radiograph_of
from napari_shadowinv.pipeline.shot_table import fiducials_from
from napari_shadowinv.preprocessing import (
    FIT_STEPS,
    Estimate,
    FitOrigin,
    FitProvenance,
    Origin,
    Radiograph,
    Recipe,
    UniformEstimate,
    estimated_source,
)
from napari_shadowinv.preprocessing.fit_provenance import short_fiducials, short_masks
from napari_shadowinv.preprocessing.image_checks import image_warnings

__all__ = [
    "COMPARED",
    "FitInputs",
    "FitShot",
    "check_fit",
    "gathered_fit",
    "run_comparison",
    "run_fit",
    "usual_fields",
]

COMPARED = (("B",), ("E",), ("B", "E"))
"""The choices of fields that `run_comparison` compares."""


@dataclass(frozen=True, eq=False)
class FitShot:
    """One image of a fit; what is None follows from the recipe, or from the image's file.

    Attributes
    ----------
    image : Radiograph, array_like of shape (H, W), or path
        As recorded.
    setup : Setup, optional
        Its experiment.
    source : as `image`, or "unknown", optional
        The undisturbed beam; unknown in all images or in none.
    mask, source_mask : array_like of bool or path, optional
        True where a pixel can be used, and where the object is not; files are 0 elsewhere.
    strength : tuple of float, optional
        Displacement by each field relative to the first image, in place of what the setups say.
    gain : float, optional
        How many times brighter than its source the image is.
    psf : float, optional
        Standard deviation of the point spread in px after all steps.
    noise : float, "poisson" or "proportional", optional
        Standard deviation in a pixel after all steps, that of counts, or a share of each pixel.
    """

    image: Shot
    setup: Setup | None = None
    source: Shot | Literal["unknown"] | None = None
    mask: ArrayLike | Path | None = None
    source_mask: ArrayLike | Path | None = None
    strength: tuple[float, ...] | None = None
    gain: float | None = None
    psf: float | None = None
    noise: KindOfNoise | float | None = None

    @property
    def beam_unknown(self) -> bool:
        """Whether its beam is to be fitted."""
        return isinstance(self.source, str) and self.source == "unknown"


@dataclass(frozen=True, eq=False)
class FitInputs:
    """What a fit is made of.

    Attributes
    ----------
    given : tuple of FitShot
        The images as recorded.
    shots : tuple of Radiograph
        The images after the recipe's steps, with setup, source and mask, on one grid of pixels.
    names : tuple of str
        What messages call them.
    provenance : FitProvenance
        Where all of it came from, and the recipe.
    fiducials : ndarray or None
        Known displacements in the first image.
    """

    given: tuple[FitShot, ...]
    shots: tuple[Radiograph, ...]
    names: tuple[str, ...]
    provenance: FitProvenance
    fiducials: FloatArray | None

    @property
    def choices(self) -> FitChoices:
        """The recipe's choices, the fields and the kind of beam among them."""
        assert self.provenance.recipe.fit is not None
        return self.provenance.recipe.fit

    @cached_property
    def setups(self) -> tuple[Setup, ...] | None:
        """The setups of all images after the steps; None if there are none."""
        return _of_all(self.names, [shot.setup for shot in self.shots], "setup")

    def only(self, numbers: Sequence[int]) -> FitInputs:
        """Return what a fit of some of the images is made of, in this order; no fiducials."""
        images = tuple(self.provenance.images[k] for k in numbers)
        return FitInputs(
            tuple(self.given[k] for k in numbers),
            tuple(self.shots[k] for k in numbers),
            tuple(self.names[k] for k in numbers),
            self.provenance.model_copy(update={"images": images}),
            None,
        )

    @property
    def options(self) -> FitOptions:
        """The options; of a beam that is estimated from its image the variation is assumed."""
        options, estimate = self.choices.options, self.provenance.recipe.estimate
        is_estimated = estimate is not None and self.choices.beam == "known"
        if options.beam_variation is not None or not is_estimated:
            return options
        return options.model_copy(update={"beam_variation": ASSUMED_VARIATION})

    @property
    def keywords(self) -> dict[str, Any]:
        """What `fit` and `compare` take of it, fields and options not among it."""
        strengths = _of_all(self.names, [one.strength for one in self.given], "strength")
        if strengths is not None and len(set(map(len, strengths))) > 1:
            raise InputError(
                f"strengths have {', '.join(str(len(one)) for one in strengths)} numbers: expected "
                "one for each field in all images"
            )
        factors = _of_all(self.names, [one.gain for one in self.given], "gain")
        if factors is not None and self.choices.gains == "free":
            raise InputError("received gains, and that they are free: expected one of them")
        known = {
            "images": np.stack([shot.image for shot in self.shots]),
            "strengths": strengths,
            # The strengths that were given count, wherever they come from.
            "setups": self.setups if strengths is None else None,
            "source": self._source(),
            "noise": self._noise(),
            "psf": [self._spread(k) for k in range(len(self.shots))],
            "mask": self._mask(),
            "gains": self.choices.gains if factors is None else factors,
            "fiducials": self.fiducials,
            "names": self.names,
        }
        return {name: value for name, value in known.items() if value is not None}

    def told(self, found: Fit) -> Fit:
        """Return a fit with its setups and its provenance; its fields are those of the recipe."""
        names, options = tuple(field.name for field in found.fields), found.options
        choices = self.choices.model_copy(update={"fields": names, "options": options})
        recipe = self.provenance.recipe.model_copy(update={"fit": choices})
        provenance = self.provenance.model_copy(update={"recipe": recipe})
        return replace(found, setups=self.setups or (), provenance=provenance)

    def _source(self) -> Any:
        if self.choices.beam == "unknown":
            return "unknown"
        beams = _of_all(self.names, [shot.source for shot in self.shots], "source")
        return None if beams is None else np.stack(beams)

    def _noise(self) -> Any:
        usual = self.choices.noise
        each = [usual if one.noise is None else one.noise for one in self.given]
        known = _of_all(self.names, each, "noise")
        if known is None:
            return None
        kinds = {repr(one) if isinstance(one, str) else "a number" for one in known}
        if len(kinds) > 1:
            raise InputError(
                f"noise is {' in some images and '.join(sorted(kinds))} in others: give the same "
                "for all, or numbers"
            )
        return known[0] if isinstance(known[0], str) else known

    def _spread(self, k: int) -> float:
        """Standard deviation of an image's point spread in px."""
        choices, setup, own = self.choices, self.shots[k].setup, self.given[k].psf
        if own is not None or (choices.source_size is None and choices.resolution is None):
            return own if own is not None else choices.psf or 0.0
        if setup is None:
            raise InputError(
                f"{self.names[k]} has no setup, and source size and resolution are in m: give the "
                "setup (--setup), or the point spread in px (--psf)"
            )
        return point_spread(setup, choices.source_size or 0.0, choices.resolution or 0.0)

    def _mask(self) -> AnyArray | None:
        masks = [shot.mask for shot in self.shots]
        if all(mask is None for mask in masks):
            return None
        shape = self.shots[0].shape
        return np.stack([np.ones(shape, bool) if mask is None else mask for mask in masks])


def run_fit(
    recipe: Recipe,
    shots: Sequence[FitShot | Shot],
    *,
    fiducials: ArrayLike | Path | None = None,
    names: Sequence[str] | None = None,
    on_progress: OnProgress | None = None,
    should_stop: ShouldStop | None = None,
) -> Fit:
    """Take a recipe's steps with several images of one object, and fit its fields to them.

    Parameters
    ----------
    recipe : Recipe
        What is to be done; without a section `fit` its defaults count.
    shots : sequence of FitShot, Radiograph, array_like or path
        The images, of one size after the steps.
    fiducials : array_like of shape (n, 5), or path of a table, optional
        As for `napari_shadowinv.fit`, in pixels after the steps.
    names : sequence of str, optional
        What messages call the images. Default: their files, or their numbers.
    on_progress, should_stop : callable, optional
        As for `napari_shadowinv.fit`.

    Returns
    -------
    Fit
        With its `provenance`, by which it can be made again.

    Raises
    ------
    InputError
        If recipe and images do not fit together, or cannot be fitted.
    FileFormatError
        If a file cannot be read.
    InversionCancelled
        If `should_stop` returned true.
    """
    inputs = gathered_fit(recipe, shots, fiducials=fiducials, names=names, should_stop=should_stop)
    found = fit(
        **inputs.keywords,
        fields=inputs.choices.fields or ("B",),
        options=inputs.options,
        on_progress=on_progress,
        should_stop=should_stop,
    )
    return inputs.told(found)


def run_comparison(
    recipe: Recipe,
    shots: Sequence[FitShot | Shot],
    *,
    fiducials: ArrayLike | Path | None = None,
    on_progress: OnProgress | None = None,
    should_stop: ShouldStop | None = None,
) -> tuple[Fit, ...]:
    """Fit B alone, E alone and both, otherwise as `run_fit`; the likeliest comes first."""
    inputs = gathered_fit(recipe, shots, fiducials=fiducials, should_stop=should_stop)
    found = compare(
        **inputs.keywords,
        choices=COMPARED,
        options=inputs.options,
        on_progress=on_progress,
        should_stop=should_stop,
    )
    return tuple(map(inputs.told, found))


def gathered_fit(
    recipe: Recipe,
    shots: Sequence[FitShot | Shot],
    *,
    fiducials: ArrayLike | Path | None = None,
    names: Sequence[str] | None = None,
    should_stop: ShouldStop | None = None,
) -> FitInputs:
    """Bring together what a fit is made of: read files, take the steps, fill in what follows."""
    given = tuple(one if isinstance(one, FitShot) else FitShot(one) for one in shots)
    if not given:
        raise InputError("received no image: expected one or several of one object")
    choices = recipe.fit or FitChoices()
    check_fit(recipe)
    names = names or tuple(_name(one, k) for k, one in enumerate(given))
    unknown = _beam_is_unknown(choices, given, names)
    gathering = [
        _gathered(recipe, one, name, unknown=unknown)
        for one, name in zip(given, names, strict=True)
    ]
    ready: list[Radiograph] = []
    for inputs, name in zip(gathering, names, strict=True):
        shot = _prepared(inputs, name, should_stop)
        if ready and shot.shape != ready[0].shape:
            raise InputError(
                f"{name} has shape {shot.shape}, {names[0]} {ready[0].shape}: expected images of "
                "one size, on the same pixels; crop or bin them first"
            )
        ready.append(shot)
    setups = _of_all(names, [shot.setup for shot in ready], "setup")
    fields = choices.fields or usual_fields(setups)
    beam = "unknown" if unknown else "known"
    resolved = choices.model_copy(update={"fields": fields, "beam": beam})
    source = recipe.estimate
    cleared = {"source": source, "mask": None, "source_mask": None, "setup": None, "fit": resolved}
    table, origin = _fiducials(fiducials)
    provenance = _provenance(recipe.model_copy(update=cleared), given, gathering, ready)
    rows = None if table is None else short_fiducials(table)
    told = {"fiducials": origin, "fiducial_rows": rows}
    kept = FitProvenance.model_validate({**dict(provenance), **told})
    return FitInputs(given, tuple(ready), tuple(names), kept, table)


def check_fit(recipe: Recipe) -> None:
    """Reject with an `InputError` what no fit can do, before any image is read."""
    for step in recipe.steps:
        if step.name() not in FIT_STEPS:
            raise InputError(
                f"the recipe has the step {step.described}, which changes what the forward model "
                f"is fitted to: leave it out; expected some of {', '.join(FIT_STEPS)}"
            )
    if recipe.fit is not None and recipe.fit.beam == "unknown" and recipe.source is not None:
        raise InputError(
            "the recipe has a source and a fit with an unknown beam: expected one of them"
        )


def _name(shot: FitShot, k: int) -> str:
    image = shot.image
    path = image.path if isinstance(image, Radiograph) else image
    return str(path) if isinstance(path, (str, Path)) else f"image {k + 1}"


def _beam_is_unknown(choices: FitChoices, given: Sequence[FitShot], names: Sequence[str]) -> bool:
    """Whether a beam is fitted: said of all images, or by the recipe of those without a source."""
    usual = choices.beam == "unknown"
    asked = [one.beam_unknown or (usual and one.source is None) or None for one in given]
    return _of_all(names, asked, "unknown source") is not None


def _gathered(recipe: Recipe, given: FitShot, name: str, *, unknown: bool) -> Inputs:
    """An image as recorded, with its source and masks."""
    image: Any = given.image
    source: Any = None if given.beam_unknown else given.source
    masks = {"mask": given.mask, "source_mask": given.source_mask}
    files = {key: Path(one) for key, one in masks.items() if isinstance(one, (str, Path))}
    arrays: Any = {key: one for key, one in masks.items() if one is not None and key not in files}
    own = recipe.model_copy(update={**files, "setup": given.setup or recipe.setup, "fit": None})
    try:
        if unknown and isinstance(image, (Radiograph, str, Path)):
            image = replace(radiograph_of(image, "the image"), source=None)
        inputs = gathered(own, image, source=source, **arrays)
        inputs.recipe.check(inputs.shot)
    except InputError as error:
        raise InputError(f"{name}: {error}") from error
    return inputs


def _prepared(inputs: Inputs, name: str, should_stop: ShouldStop | None) -> Radiograph:
    """An image after the steps, with its source if that is estimated."""
    try:
        shot = inputs.prepared(should_stop)
        doubts = image_warnings(shot.image, shot.source, shot.mask)
        if shot.setup is not None:
            doubts += setup_warnings(shot.setup, shot.shape)
        shot = replace(shot, warnings=(*shot.warnings, *doubts))
        estimate = inputs.recipe.estimate
        if estimate is None or isinstance(estimate, UniformEstimate):
            return shot
        return _with_estimate(inputs, shot, estimate, should_stop)
    except InputError as error:
        raise InputError(f"{name}: {error}") from error


def _with_estimate(
    inputs: Inputs, shot: Radiograph, estimate: Estimate, should_stop: ShouldStop | None
) -> Radiograph:
    recorded = inputs.shot.shape
    placed = estimate.placed(shot.setup, recorded, inputs.recipe.matrix(recorded))
    doubts: list[Caution] = []
    source = estimated_source(placed, shot, should_stop, doubts.append)
    return replace(shot, source=source, warnings=(*shot.warnings, *doubts))


def usual_fields(setups: Sequence[Setup] | None) -> tuple[str, ...]:
    """Return the field that usually bends such beams."""
    if not setups:
        return ("B",)
    names = {deflector: name for name, deflector in FIELDS.items()}
    try:
        (usual,) = {names[default_deflector(setups[0], setup)] for setup in setups}
    except InputError as error:
        raise InputError(f"{error}; name it with --fields, of {', '.join(FIELDS)}") from error
    return (usual,)


def _fiducials(given: ArrayLike | Path | None) -> tuple[FloatArray | None, Origin | None]:
    if given is None:
        return None, None
    if isinstance(given, Path):
        origin = Origin(file=text_of(given.name), sha256=sha256(given))
        return np.array(fiducials_from(given)), origin
    return np.array(given, dtype=np.float64), Origin()


def _provenance(
    recipe: Recipe,
    given: Sequence[FitShot],
    gathering: Sequence[Inputs],
    ready: Sequence[Radiograph],
) -> FitProvenance:
    masks: list[Origin] = []

    def place(mask: Origin | None) -> int | None:
        if mask is None:
            return None
        if mask not in masks:
            masks.append(mask)
        return masks.index(mask)

    images = tuple(
        FitOrigin(
            image=inputs.provenance.image,
            source=inputs.provenance.source,
            mask=place(inputs.provenance.mask),
            source_mask=place(inputs.provenance.source_mask),
            setup=inputs.shot.setup,
            strength=one.strength,
            gain=one.gain,
            psf=one.psf,
            noise=one.noise,
            notes=shot.notes,
            warnings=shot.warnings,
        )
        for one, inputs, shot in zip(given, gathering, ready, strict=True)
    )
    return FitProvenance(
        version=__version__, recipe=recipe, images=images, masks=short_masks(masks)
    )


def _of_all(names: Sequence[str], values: Sequence[Any], what: str) -> tuple[Any, ...] | None:
    """What all images have; None if none has it."""
    without = [name for name, value in zip(names, values, strict=True) if value is None]
    if len(without) == len(names):
        return None
    if without:
        raise InputError(
            f"{without[0]} has no {what}, other images have: expected it for all of them, or none"
        )
    return tuple(values)
