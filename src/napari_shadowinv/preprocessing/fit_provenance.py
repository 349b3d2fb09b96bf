"""Provenance of a fit, stored with its result: `FitProvenance`, a `FitOrigin` for each image."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Annotated, Any

from pydantic import BeforeValidator, ConfigDict, ValidationError

from napari_shadowinv._system.validation import CheckedModel
from napari_shadowinv.cautions import Caution
from napari_shadowinv.options import Noise
from napari_shadowinv.physics.setup import Setup
from napari_shadowinv.preprocessing.recipe import Origin, Provenance, Recipe

_CONFIG = ConfigDict(frozen=True, extra="forbid", ser_json_inf_nan="strings")
# Characters, of all masks and of the table: HDF5 keeps no attribute longer than 64,000.
_LONGEST_MASKS, _LONGEST_FIDUCIALS = 36_000, 9_000


class FitOrigin(CheckedModel):
    """Origin of an image of a fit, with its setup, noise and other inputs.

    Attributes
    ----------
    image, source : Origin
        The files, or arrays; `source` is None if it was not measured.
    mask, source_mask : int or None
        Places among the masks of the `FitProvenance`.
    setup : Setup or None
        The experiment, with the pixels as recorded.
    strength, brightness, psf, noise
        Values of this image; None where the recipe counts.
    notes : tuple of str
        Notes of the steps.
    warnings : tuple of Caution
        Reasons to doubt the image, its source or its setup.
    """

    model_config = _CONFIG
    image: Origin
    source: Origin | None = None
    mask: int | None = None
    source_mask: int | None = None
    setup: Setup | None = None
    strength: tuple[float, ...] | None = None
    brightness: float | None = None
    psf: float | None = None
    noise: Noise | None = None
    notes: tuple[str, ...] = ()
    warnings: tuple[Annotated[Caution, BeforeValidator(Caution.from_json)], ...] = ()


class FitProvenance(CheckedModel):
    """Provenance of a fit, by which it can be repeated.

    Attributes
    ----------
    version : str
        Of the package.
    recipe : Recipe
        Steps, estimate of the source and choices of the fit; setups and masks are the images'.
    images : tuple of FitOrigin
        The images, in their order.
    masks : tuple of Origin
        All masks of images and sources, each once.
    fiducials : Origin or None
        The table of known displacements.
    fiducial_rows : tuple or None
        Its rows, if they are not too many.
    start : Provenance or None
        The inversion that the fit refines, with the same image, source and masks.
    """

    model_config = _CONFIG
    version: str
    recipe: Recipe
    images: tuple[FitOrigin, ...]
    masks: tuple[Origin, ...] = ()
    fiducials: Origin | None = None
    fiducial_rows: tuple[tuple[float, float, float, float, float], ...] | None = None
    start: Provenance | None = None

    @classmethod
    def of(cls, attributes: Mapping[str, Any]) -> FitProvenance | None:
        """Read the provenance from a dataset's attributes; None if it is missing or unreadable."""
        try:
            return cls.model_validate_json(attributes.get("provenance", ""))
        except ValidationError:
            return None


def short_masks(masks: Iterable[Origin]) -> tuple[Origin, ...]:
    """Return the masks, without pixels where these exceed the room in the file."""
    room, shortened = _LONGEST_MASKS, []
    for mask in masks:
        room -= len(mask.pixels or "")
        shortened.append(mask if room >= 0 else mask.model_copy(update={"pixels": None}))
    return tuple(shortened)


def short_fiducials(rows: Iterable[Iterable[float]]) -> list[list[float]] | None:
    """Return the rows of a table as lists for the file; None if they are too many."""
    listed = [[float(value) for value in row] for row in rows]
    return listed if len(str(listed)) <= _LONGEST_FIDUCIALS else None
