"""A measured image with its metadata: `Radiograph`."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from napari_shadowinv._typing import AnyArray, BoolArray, FloatArray
from napari_shadowinv.cautions import Caution
from napari_shadowinv.errors import InputError

if TYPE_CHECKING:
    from napari_shadowinv.physics.setup import Setup


@dataclass(frozen=True, eq=False)
class Radiograph:
    """One image, ready to be inverted.

    Attributes
    ----------
    image : ndarray of float64, shape (H, W)
        Intensity or counts, ``[y, x]``, as stored.
    setup, path : optional
        The geometry, where the file contains all of it; the file of the image.
    metadata : mapping
        Other facts from the file: ``kind``, ``dtype``, ``bits``, ``sha256``, and for pradformat
        ``geometry``, the part of the setup in the file.
    source : ndarray, shape (H, W), or None
        The undisturbed beam.
    mask, source_mask : ndarray of bool, shape (H, W), or None
        True where a pixel can be used; where it shows the bare beam, for an estimate of the source.
    warnings : tuple of Caution
        Reasons to doubt the content of the file.
    dark : ndarray, shape (H, W), or None
        Image of the detector without light, for a step `Dark` with a file.
    """

    image: FloatArray
    setup: Setup | None = None
    path: Path | None = None
    metadata: Mapping[str, Any] = field(default_factory=dict)
    source: FloatArray | None = None
    mask: BoolArray | None = None
    source_mask: BoolArray | None = None
    warnings: tuple[Caution, ...] = ()
    dark: FloatArray | None = None

    @property
    def shape(self) -> tuple[int, int]:
        """Shape (H, W) of the image."""
        height, width = self.image.shape
        return height, width

    @property
    def notes(self) -> tuple[str, ...]:
        """Notes on the steps applied so far, for people."""
        return tuple(self.metadata.get("notes", ()))

    def add_notes(self, *notes: str) -> Radiograph:
        """Return the same with more notes."""
        return replace(self, metadata={**self.metadata, "notes": (*self.notes, *notes)})

    def map_planes(
        self, values: Callable[[FloatArray], FloatArray], masks: Callable[[BoolArray], BoolArray]
    ) -> Radiograph:
        """Return the same with a function applied to image and source, another to the masks."""
        return replace(
            self,
            image=values(self.image),
            source=None if self.source is None else values(self.source),
            dark=None if self.dark is None else values(self.dark),
            mask=None if self.mask is None else masks(self.mask),
            source_mask=None if self.source_mask is None else masks(self.source_mask),
        )

    def bin_pixels(self, factor: int) -> Radiograph:
        """Sum blocks of `factor` × `factor` pixels; the setup's pixel grows with them.

        Rows and columns that fill no block are cut off at the end. A block can be used if all its
        pixels can. The metadata's ``bin`` is the factor. An `InputError` if `factor` is less
        than 1 or leaves less than 2×2 blocks.

        Examples
        --------
        >>> Radiograph(np.ones((5, 6))).bin_pixels(2).image
        array([[4., 4., 4.], [4., 4., 4.]])
        """
        from napari_shadowinv.physics.setup import bin_setup

        height, width = self.image.shape
        if min(height, width) < 2:
            raise InputError(
                f"{'image' if self.path is None else self.path} has {height}×{width} pixels: "
                "expected at least two rows and two columns"
            )
        if factor < 1 or min(height, width) // factor < 2:
            raise InputError(
                f"cannot bin {height}×{width} pixels by {factor}: expected a whole number from "
                f"1 to {min(height, width) // 2}"
            )
        if factor == 1:
            return self
        binned = replace(
            self.map_planes(
                lambda plane: _blocks(plane, factor).sum(axis=(1, 3)),
                lambda mask: np.asarray(_blocks(mask, factor).all(axis=(1, 3))),
            ),
            setup=None if self.setup is None else bin_setup(self.setup, factor),
            metadata={**self.metadata, "bin": factor * int(self.metadata.get("bin", 1))},
        )
        rows, columns = height % factor, width % factor
        cut = f", {rows} rows and {columns} columns cut off" if rows or columns else ""
        return binned.add_notes(f"binned {factor} × {factor}{cut}")


def _blocks(array: AnyArray, factor: int) -> AnyArray:
    rows, columns = (n // factor for n in array.shape)
    cropped = array[: rows * factor, : columns * factor]
    return cropped.reshape(rows, factor, columns, factor)
