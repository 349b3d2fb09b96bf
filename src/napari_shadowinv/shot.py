"""An image and all that is known of it: `Shot`; several of one object: `shots_of`."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from napari_shadowinv._typing import BoolArray, FloatArray
from napari_shadowinv.cautions import Caution
from napari_shadowinv.errors import InputError
from napari_shadowinv.facts import Summarised
from napari_shadowinv.physics.arrays import as_numbers, block_sums

if TYPE_CHECKING:
    from napari_shadowinv.options import Noise
    from napari_shadowinv.physics.setup import Setup

# Others come from the user, and precede those of the image's file.
_OF_FILE = ("image", "path", "metadata", "cautions", "setup_in_file")


@dataclass(frozen=True, eq=False, repr=False)
class Shot(Summarised):
    """An image and all that is known of it.

    Attributes of None follow from the recipe, or from the image's file.

    Attributes
    ----------
    image : ndarray, shape (H, W), or path
        Intensity or counts, ``[y, x]``, as stored. A recipe reads paths; functions on arrays take
        none.
    setup : Setup, optional
        Its experiment.
    source : ndarray, shape (H, W), Shot, path or "unknown", optional
        The undisturbed beam; only a fit takes an unknown one, in all images or in none.
    mask, source_mask : ndarray of bool, shape (H, W), or path, optional
        True where a pixel can be used; where it shows the bare beam, for an estimate of the source.
        Files are 0 elsewhere.
    dark : ndarray, shape (H, W), optional
        Image of the detector without light, for a step `Dark` with a file.
    strength : float or tuple of float, optional
        Displacement by each field relative to the first image of a fit. Default: from the setups.
    brightness : float or "free", optional
        How many times brighter than its source the image is; "free" to fit it, of all images.
    psf : float or ndarray, optional
        Standard deviation of the point spread in px, after all steps, or a kernel with odd sides.
        See `point_spread`.
    noise : float, ndarray of shape (H, W), "poisson" or "proportional", optional
        Standard deviation in a pixel after all steps; or "poisson" if the image has counts; or
        "proportional" if it is a share of each pixel, as on film, which is estimated. Default:
        estimated.
    fiducials : array_like of shape (n, 5), or path of a table, optional
        Known displacements, in the first image of a fit only: rows of y, x, dy, dx and their σ, in
        px after all steps.
    start : array_like of shape (H, W), or NearField, optional
        A potential in px² to start a fit from, of the first field, in the first image only. A fit
        starts from other fields, too, unless it is a `NearField`.
    name : str, optional
        Its name in messages. Default: its file or its number.
    measured : bool, default True
        Whether the source was recorded, not estimated from the image.
    path : path, optional
        The file of the image.
    metadata : mapping
        Other facts from the file: ``kind``, ``dtype``, ``bits``, ``sha256``, and for pradformat
        ``geometry``, the part of the setup in the file.
    cautions : tuple of Caution
        Reasons to doubt the content of the file.
    setup_in_file : Setup, optional
        The setup in the image's file, which a recipe's precedes; a setup that was given precedes
        both.

    Examples
    --------
    >>> shot = Shot(np.ones((64, 64)), strength=0.6, name="14.7 MeV")
    """

    image: Any
    setup: Setup | None = None
    source: Any = None
    mask: Any = None
    source_mask: Any = None
    dark: FloatArray | None = None
    strength: Any = None
    brightness: Any = None
    psf: Any = None
    noise: Noise | Any = None
    fiducials: Any = None
    start: Any = None
    name: str | None = None
    measured: bool = True
    path: Path | None = None
    metadata: Mapping[str, Any] = field(default_factory=dict)
    cautions: tuple[Caution, ...] = ()
    setup_in_file: Setup | None = None

    def __post_init__(self) -> None:
        if self.setup is not None and not hasattr(self.setup, "pixel_sizes"):
            raise InputError(f"setup is {self.setup!r:.60}: expected that of an experiment")
        if self.strength is not None:
            strengths = as_numbers("strength", self.strength).ravel()
            if not strengths.size or not np.isfinite(strengths).all():
                raise InputError(
                    f"strength is {self.strength}: expected a finite number, or one for each field"
                )
            object.__setattr__(self, "strength", tuple(strengths.tolist()))
        factor = self.brightness
        if factor is not None and not (isinstance(factor, str) and factor == "free"):
            number = np.nan if isinstance(factor, str) else as_numbers("brightness", factor)
            if np.ndim(number) or not 0 < number < np.inf:
                raise InputError(
                    f"brightness is {factor!r}: expected a positive number, or 'free' to fit it"
                )

    def _summary(self) -> list[str]:
        parts = [str(self.path)] if self.path is not None else []
        parts += [self.setup.probe] if self.setup is not None else []
        parts += [f"with {name}" for name in ("source", "mask") if getattr(self, name) is not None]
        return [", ".join(parts) or "no setup", *(caution.text for caution in self.cautions)]

    @property
    def shape(self) -> tuple[int, int]:
        """Shape (H, W) of the image."""
        if np.ndim(self.image) != 2:
            raise InputError(
                f"the shot's image is {self.image!r:.60}: read it first, or give a plane"
            )
        height, width = np.shape(self.image)
        return height, width

    @property
    def usable(self) -> BoolArray:
        """Pixels that can be used: where the mask is true, or without a mask the finite ones."""
        return np.asarray(np.isfinite(self.image) if self.mask is None else self.mask)

    @property
    def beam_unknown(self) -> bool:
        """Whether its beam is to be fitted."""
        return isinstance(self.source, str) and self.source == "unknown"

    @property
    def given_setup(self) -> Setup | None:
        """The setup, unless it came in the image's file."""
        return None if self.setup is self.setup_in_file else self.setup

    def completed_by(self, recorded: Shot) -> Shot:
        """Return the shot as read from its file, with all that is known beside the file."""
        values = {name: value for name, value in vars(self).items() if name not in _OF_FILE}
        changes = {name: value for name, value in values.items() if value is not None}
        return replace(recorded, **changes)

    @property
    def notes(self) -> tuple[str, ...]:
        """Notes on the steps applied so far, for people."""
        return tuple(self.metadata.get("notes", ()))

    def add_notes(self, *notes: str) -> Shot:
        """Return the same with more notes."""
        return replace(self, metadata={**self.metadata, "notes": (*self.notes, *notes)})

    def map_planes(
        self, values: Callable[[FloatArray], FloatArray], masks: Callable[[BoolArray], BoolArray]
    ) -> Shot:
        """Return the same with a function applied to image and source, another to the masks."""
        return replace(
            self,
            image=values(self.image),
            source=None if self.source is None else values(self.source),
            dark=None if self.dark is None else values(self.dark),
            mask=None if self.mask is None else masks(self.mask),
            source_mask=None if self.source_mask is None else masks(self.source_mask),
        )

    def bin_pixels(self, factor: int) -> Shot:
        """Sum blocks of `factor` × `factor` pixels; the setup's pixel grows with them.

        Rows and columns that fill no block are cut off at the end. A block can be used if all its
        pixels can. The metadata's ``bin`` is the factor. An `InputError` if `factor` is less
        than 1 or leaves less than 2×2 blocks.

        Examples
        --------
        >>> Shot(np.ones((5, 6))).bin_pixels(2).image
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
        merged = self.map_planes(
            lambda plane: block_sums(plane, factor),
            lambda mask: block_sums(mask, factor) == factor**2,
        )
        setup = None if self.setup is None else bin_setup(self.setup, factor)
        binned = replace(
            merged,
            setup=setup,
            setup_in_file=None if self.given_setup else setup,
            metadata={**self.metadata, "bin": factor * int(self.metadata.get("bin", 1))},
        )
        rows, columns = height % factor, width % factor
        cut = f", {rows} rows and {columns} columns cut off" if rows or columns else ""
        return binned.add_notes(f"binned {factor} × {factor}{cut}")


def shots_of(images: Any, **values: Any) -> list[Shot]:
    """Return shots of one object.

    Parameters
    ----------
    images : sequence of array_like, or ndarray of shape (L, H, W) or (H, W)
    **values
        Attributes of the shots: a list, a tuple or an array of one or three dimensions has a value
        for each, anything else is for all.

    Raises
    ------
    InputError
        If there are other numbers of images and of values.

    Examples
    --------
    >>> [shot.strength for shot in shots_of(np.ones((2, 64, 64)), strength=[1, 0.6])]
    [(1.0,), (0.6,)]
    """
    planes = [images] if isinstance(images, np.ndarray) and images.ndim == 2 else list(images)
    of_each: list[dict[str, Any]] = [{} for _ in planes]
    for name, value in values.items():
        is_each = isinstance(value, (list, tuple)) or np.ndim(value) in (1, 3)
        entries: Sequence[Any] = value if is_each else [value] * len(planes)
        if len(entries) != len(planes):
            raise InputError(
                f"received {len(planes)} images and {len(entries)} values of {name}: expected one "
                "for each"
            )
        for attributes, entry in zip(of_each, entries, strict=True):
            attributes[name] = entry
    return [Shot(plane, **attributes) for plane, attributes in zip(planes, of_each, strict=True)]
