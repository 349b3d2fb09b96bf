"""Provenance of a result, by which it can be repeated: `Provenance`.

- an image of it with all its inputs: `ImageOrigin`; a mask: `MaskOrigin`; another file: `Origin`
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeAlias

import numpy as np
from pydantic import BeforeValidator, Field, ValidationError, model_validator

from napari_shadowinv import __version__
from napari_shadowinv._system.validation import CheckedModel
from napari_shadowinv._typing import BoolArray
from napari_shadowinv.cautions import Caution
from napari_shadowinv.errors import InputError
from napari_shadowinv.film.pack import Pack
from napari_shadowinv.options import Noise
from napari_shadowinv.physics.arrays import checksum
from napari_shadowinv.physics.setup import Setup
from napari_shadowinv.preprocessing.recipe import Recipe

if TYPE_CHECKING:
    import xarray

_MASKS = ("mask", "source_mask")
_MASK_NAME = "input_mask_{}"  # of a dataset's variable, by the index of the mask

MaskVariable: TypeAlias = tuple[tuple[str, ...], BoolArray | None, dict[str, str]]


class Origin(CheckedModel):
    """Origin of an image or a table."""

    file: str = ""  # name without its folder, "" like the checksum if it was an array
    sha256: str = ""
    variable: str | None = None  # taken from the file, as the colour channel
    channel: str | int | None = None
    shape: tuple[int, int] | None = None  # as recorded


class MaskOrigin(Origin):
    """Origin of a mask."""

    checksum: str = ""  # SHA-256 of its pixels
    # An array beside the provenance; None where that is missing.
    pixels: Any = Field(None, exclude=True, repr=False)

    @classmethod
    def of(cls, mask: BoolArray) -> MaskOrigin:
        """Return the origin of an array."""
        return cls(checksum=checksum(mask), pixels=mask)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, MaskOrigin) and self.model_dump() == other.model_dump()

    def __hash__(self) -> int:
        return hash(self.checksum)

    def mask(self) -> BoolArray:
        """Return the mask; an `InputError` if it is missing or damaged."""
        if self.pixels is None or checksum(self.pixels) != self.checksum:
            raise InputError("the mask stored in the result is damaged: give the mask again")
        mask: BoolArray = self.pixels
        return mask


class ImageOrigin(Origin):
    """Origin of an image of a result, with its source, masks, setup and numbers.

    A number of None is the recipe's.
    """

    source: Origin | None = None  # undisturbed beam, if it was measured
    dark: Origin | None = None
    mask: int | None = None  # like the next, its index in `Provenance.masks`
    source_mask: int | None = None
    setup: Setup | None = None  # with the pixels as recorded; None where the recipe's applies
    strength: tuple[float, ...] | None = None
    brightness: float | None = None  # an image to invert was divided by it
    psf: float | None = None
    noise: Noise | None = None
    measured: bool = True  # whether the source of an image of a fit was recorded
    notes: tuple[str, ...] = ()  # of the steps, for people
    # Reasons to doubt an image of a fit, its source or its setup.
    cautions: tuple[Annotated[Caution, BeforeValidator(Caution.from_json)], ...] = ()


class Provenance(CheckedModel):
    """Provenance of a result, by which it can be repeated."""

    kind: Literal["inversion", "fit", "film pack"]
    version: str = __version__  # of the package
    recipe: Recipe = Recipe()  # steps, estimate of the source and options; masks are the images'
    images: tuple[ImageOrigin, ...] = ()  # in their order; the scans of a film pack
    # Of all images and sources, each once; their pixels are variables of the dataset.
    masks: tuple[MaskOrigin, ...] = ()
    setup: Setup | None = None  # geometry of the pixels of an inversion
    fiducials: Origin | None = None  # the table of known displacements, and its rows
    fiducial_rows: tuple[tuple[float, float, float, float, float], ...] | None = None
    # The inversion that a fit refines, with the same image, source and masks.
    start: Provenance | None = None
    pack: Pack | None = None

    @model_validator(mode="after")
    def _check_parts(self) -> Provenance:
        if self.kind == "film pack" and self.pack is None:
            raise ValueError("expected the film pack")
        if self.kind != "film pack" and not self.images:
            raise ValueError("expected at least one image")
        if self.start is not None and self.start.start is not None:
            raise ValueError("expected an inversion as the start")
        indices = [getattr(image, name) for image in self.images for name in _MASKS]
        if not {index for index in indices if index is not None} <= {*range(len(self.masks))}:
            raise ValueError("expected the index of a mask")
        return self

    @classmethod
    def of(
        cls, attributes: Mapping[str, Any], variables: Mapping[Any, Any] | None = None
    ) -> Provenance | None:
        """Read the provenance from the attributes of a dataset or the report of a shot.

        The dataset's variables have the pixels of the masks. None if it is missing or unreadable.
        """
        content = attributes.get("provenance", "")
        try:
            text = content if isinstance(content, str) else json.dumps(content)
            return cls.model_validate_json(text).with_pixels(variables or {})
        except (ValidationError, RecursionError):
            return None

    def to_json(self) -> str:
        """Return the provenance as `of` reads it."""
        return self.model_dump_json(exclude_none=True)

    @property
    def image(self) -> ImageOrigin:
        """The first image, the only one of an inversion."""
        return self.images[0]

    def mask_of(self, index: int | None) -> MaskOrigin | None:
        """Return the mask at an index, if there is one."""
        return None if index is None else self.masks[index]

    def with_image(self, **entries: Any) -> Provenance:
        """Return a changed copy: entries of its first image."""
        first = self.image.model_copy(update=entries)
        return self.model_copy(update={"images": (first, *self.images[1:])})

    @property
    def mask_variables(self) -> dict[str, MaskVariable]:
        """The masks as variables of a dataset."""
        return mask_variables([mask.pixels for mask in (self.start or self).masks])

    def added_to(self, dataset: xarray.Dataset) -> xarray.Dataset:
        """Return a dataset with this in its attributes, and with its masks."""
        present = {k: each for k, each in self.mask_variables.items() if each[1] is not None}
        return dataset.assign(present).assign_attrs(provenance=self.to_json())

    def with_pixels(self, variables: Mapping[Any, Any]) -> Provenance:
        """Return a copy whose masks have the pixels that the variables hold."""
        masks = [
            mask.model_copy(update={"pixels": _pixels_in(variables, _MASK_NAME.format(k))})
            for k, mask in enumerate(self.masks)
        ]
        start = self.start and self.start.with_pixels(variables)
        return self.model_copy(update={"masks": tuple(masks), "start": start})


def mask_variables(masks: Sequence[BoolArray | None], *along: str) -> dict[str, MaskVariable]:
    """Return masks by the names of their variables; `along` are dimensions before y and x."""
    labels = {"units": "1", "long_name": "Usable pixels of an input, as recorded"}
    return {
        _MASK_NAME.format(k): ((*along, f"input_y_{k}", f"input_x_{k}"), mask, labels)
        for k, mask in enumerate(masks)
    }


def _pixels_in(variables: Mapping[Any, Any], name: str) -> BoolArray | None:
    return np.asarray(variables[name]).astype(bool) if name in variables else None


def index_masks(
    images: Sequence[ImageOrigin], masks: Iterable[Sequence[MaskOrigin | None]]
) -> dict[str, Any]:
    """Return the entries `images` and `masks` of a provenance, with each mask once.

    For each image there is a pair of its mask and its source mask.
    """
    pairs = list(masks)
    unique = tuple(dict.fromkeys(mask for pair in pairs for mask in pair if mask is not None))
    indices: dict[MaskOrigin | None, int] = {mask: index for index, mask in enumerate(unique)}
    indexed = [
        image.model_copy(update={n: indices.get(m) for n, m in zip(_MASKS, pair, strict=True)})
        for image, pair in zip(images, pairs, strict=True)
    ]
    return {"images": tuple(indexed), "masks": unique}
