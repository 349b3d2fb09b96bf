"""Provenance of a result, by which it can be repeated: `Provenance`.

- an image of it with all its inputs: `ImageOrigin`; a mask: `MaskOrigin`; another file: `Origin`
"""

from __future__ import annotations

import base64
import json
import zlib
from collections.abc import Iterable, Mapping, Sequence
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BeforeValidator, ValidationError, model_validator

from napari_shadowinv import __version__
from napari_shadowinv._system.validation import CheckedModel
from napari_shadowinv._typing import BoolArray
from napari_shadowinv.cautions import Caution
from napari_shadowinv.errors import InputError
from napari_shadowinv.film.pack import Pack
from napari_shadowinv.options import Noise
from napari_shadowinv.physics.setup import Setup
from napari_shadowinv.preprocessing.recipe import Recipe

# Characters of a mask, of a table and of the whole: HDF5 keeps no attribute longer than 64,000.
_MAX_MASK, _MAX_FIDUCIALS, _MAX_TEXT = 48_000, 9_000, 54_000
_MASKS = ("mask", "source_mask")


class Origin(CheckedModel):
    """Origin of an image or a table.

    Attributes
    ----------
    file, sha256 : str
        Name of the file, without its folder, and its checksum; "" if it was an array.
    variable, channel : str or int or None
        Array and colour channel taken from the file.
    shape : tuple of int or None
        Shape as recorded.
    """

    file: str = ""
    sha256: str = ""
    variable: str | None = None
    channel: str | int | None = None
    shape: tuple[int, int] | None = None


class MaskOrigin(Origin):
    """Origin of a mask, with its `pixels`, packed, unless it is too complicated."""

    pixels: str | None = None

    @classmethod
    def of(cls, mask: BoolArray) -> MaskOrigin:
        """Pack a mask, unless it is too complicated for the file."""
        packed = base64.b85encode(zlib.compress(np.packbits(mask).tobytes(), 9)).decode()
        height, width = mask.shape
        return cls(pixels=packed if len(packed) <= _MAX_MASK else None, shape=(height, width))

    def mask(self) -> BoolArray | None:
        """Unpack a mask."""
        if self.pixels is None or self.shape is None:
            return None
        size = self.shape[0] * self.shape[1]
        try:
            bits = zlib.decompressobj().decompress(base64.b85decode(self.pixels), size // 8 + 8)
        except (ValueError, zlib.error):
            bits = b""
        if min(self.shape) < 1 or len(bits) != -(-size // 8):
            raise InputError("the mask stored in the result is damaged: give the mask again")
        packed = np.frombuffer(bits, np.uint8)
        return np.unpackbits(packed, count=size).reshape(self.shape).astype(bool)


class ImageOrigin(Origin):
    """Origin of an image of a result, with its source, masks, setup and numbers.

    Attributes
    ----------
    source, dark : Origin or None
        Undisturbed beam and dark frame, if they were measured.
    mask, source_mask : int or None
        Indices of the masks in `Provenance.masks`.
    setup : Setup or None
        The experiment, with the pixels as recorded; None where the recipe's applies.
    strength, brightness, psf, noise
        Values of this image; None where the recipe counts. An image to invert was divided by its
        brightness.
    measured : bool
        Whether the source of an image of a fit was recorded, as `Shot.measured`.
    notes : tuple of str
        Notes of the steps, for people.
    warnings : tuple of Caution
        Reasons to doubt an image of a fit, its source or its setup.
    """

    source: Origin | None = None
    dark: Origin | None = None
    mask: int | None = None
    source_mask: int | None = None
    setup: Setup | None = None
    strength: tuple[float, ...] | None = None
    brightness: float | None = None
    psf: float | None = None
    noise: Noise | None = None
    measured: bool = True
    notes: tuple[str, ...] = ()
    warnings: tuple[Annotated[Caution, BeforeValidator(Caution.from_json)], ...] = ()


class Provenance(CheckedModel):
    """Provenance of a result, by which it can be repeated.

    Attributes
    ----------
    kind : {"inversion", "fit", "film pack"}
        Kind of the result.
    version : str
        Version of the package.
    recipe : Recipe
        Steps, estimate of the source and options; masks are the images'.
    images : tuple of ImageOrigin
        The images, in their order; the scans of a film pack.
    masks : tuple of MaskOrigin
        All masks of images and sources, each once.
    setup : Setup or None
        Geometry of the pixels of an inversion.
    fiducials : Origin or None
        The table of known displacements.
    fiducial_rows : tuple or None
        Its rows, if they are not too many.
    start : Provenance or None
        The inversion that a fit refines, with the same image, source and masks.
    pack : Pack or None
        The film pack.
    """

    kind: Literal["inversion", "fit", "film pack"]
    version: str = __version__
    recipe: Recipe = Recipe()
    images: tuple[ImageOrigin, ...] = ()
    masks: tuple[MaskOrigin, ...] = ()
    setup: Setup | None = None
    fiducials: Origin | None = None
    fiducial_rows: tuple[tuple[float, float, float, float, float], ...] | None = None
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
    def of(cls, attributes: Mapping[str, Any]) -> Provenance | None:
        """Read the provenance from the attributes of a dataset or the report of a shot.

        None if it is missing or unreadable.
        """
        content = attributes.get("provenance", "")
        try:
            text = content if isinstance(content, str) else json.dumps(content)
            return cls.model_validate_json(text)
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

    def shorten(self) -> Provenance:
        """Return it without the pixels of masks and the rows of a table that exceed the file."""
        rows = self.fiducial_rows
        if rows is not None and len(str(rows)) > _MAX_FIDUCIALS:
            rows = None
        bare = self.model_copy(update={"fiducial_rows": rows, "masks": ()})
        room, masks = _MAX_TEXT - len(bare.to_json()), []
        for mask in self.masks:
            room -= len(mask.pixels or "")
            masks.append(mask if room >= 0 else mask.model_copy(update={"pixels": None}))
        return bare.model_copy(update={"masks": tuple(masks)})


def index_masks(
    images: Sequence[ImageOrigin], masks: Iterable[Sequence[MaskOrigin | None]]
) -> dict[str, Any]:
    """Return the entries `images` and `masks` of a provenance, with each mask once.

    Parameters
    ----------
    images : sequence of ImageOrigin
    masks : sequence of pairs of MaskOrigin or None
        Mask and source mask of each image.
    """
    pairs = list(masks)
    unique = tuple(dict.fromkeys(mask for pair in pairs for mask in pair if mask is not None))
    indices: dict[MaskOrigin | None, int] = {mask: index for index, mask in enumerate(unique)}
    indexed = [
        image.model_copy(update={n: indices.get(m) for n, m in zip(_MASKS, pair, strict=True)})
        for image, pair in zip(images, pairs, strict=True)
    ]
    return {"images": tuple(indexed), "masks": unique}
