"""A shot, and the steps of a recipe that are no filters.

- an image with its metadata: `Radiograph`
- the base class of all steps: `Step`
- subtract the detector's dark level: `Dark`
- move pixels: `Rotate`, `Crop`, `Bin`
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, TypeVar

import numpy as np
from pydantic import BeforeValidator, Field, PlainSerializer
from pydantic.fields import FieldInfo

from napari_shadowinv._system.arrays import block_sums
from napari_shadowinv._system.validation import CheckedModel
from napari_shadowinv._typing import AnyArray, BoolArray, FloatArray
from napari_shadowinv.cautions import Caution
from napari_shadowinv.errors import InputError
from napari_shadowinv.facts import Summarised

if TYPE_CHECKING:
    from napari_shadowinv._system.progress import ShouldStop
    from napari_shadowinv.physics.setup import Setup


@dataclass(frozen=True, eq=False, repr=False)
class Radiograph(Summarised):
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

    def _summary(self) -> list[str]:
        parts = [str(self.path)] if self.path is not None else []
        parts += [self.setup.probe] if self.setup is not None else []
        parts += [f"with {name}" for name in ("source", "mask") if getattr(self, name) is not None]
        return [", ".join(parts) or "no setup", *(caution.text for caution in self.warnings)]

    def _picture(self) -> FloatArray:
        return self.image

    @property
    def shape(self) -> tuple[int, int]:
        """Shape (H, W) of the image."""
        height, width = self.image.shape
        return height, width

    @property
    def usable(self) -> BoolArray:
        """Pixels that can be used: where the mask is true, or without a mask the finite ones."""
        return np.isfinite(self.image) if self.mask is None else self.mask

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
                lambda plane: block_sums(plane, factor),
                lambda mask: block_sums(mask, factor) == factor**2,
            ),
            setup=None if self.setup is None else bin_setup(self.setup, factor),
            metadata={**self.metadata, "bin": factor * int(self.metadata.get("bin", 1))},
        )
        rows, columns = height % factor, width % factor
        cut = f", {rows} rows and {columns} columns cut off" if rows or columns else ""
        return binned.add_notes(f"binned {factor} × {factor}{cut}")


_MIN_SIDE_PX = 4  # px of a crop
_MIN_DATA_SHARE = 0.999  # of a rotated pixel that must have data


class Choice(CheckedModel):
    """One of several ways to do something, with its parameters."""

    title: ClassVar[str]  # in forms
    key: ClassVar[str]  # the field that names it in files, "step" or "method"
    # The parameter that the command's flag of the same name sets; "" if each has its own flag.
    primary: ClassVar[str] = ""
    # Its order in lists; steps chosen by flags are applied in this order.
    place: ClassVar[int] = 100

    @classmethod
    def name(cls) -> str:
        """Return its name in files, such as ``"low-pass"``."""
        return str(cls.model_fields[cls.key].default)

    @classmethod
    def parameters(cls) -> dict[str, FieldInfo]:
        """Return its fields, without the one that names it."""
        return {name: field for name, field in cls.model_fields.items() if name != cls.key}

    def values(self) -> dict[str, Any]:
        """Return the values of its parameters."""
        return {name: getattr(self, name) for name in self.parameters()}

    def call(self, function: Callable[..., FloatArray], *args: Any, **options: Any) -> FloatArray:
        """Call a function with the parameters, and with those of the options that it takes."""
        parameters = inspect.signature(function).parameters
        if not any(each.kind is each.VAR_KEYWORD for each in parameters.values()):
            options = {name: value for name, value in options.items() if name in parameters}
        return function(*args, **self.values(), **options)

    @property
    def summary(self) -> str:
        """Title and parameters, the same for the same choices."""
        values = (f"{name} {value}" for name, value in self.values().items())
        return ", ".join([self.title, *values])


C = TypeVar("C", bound=Choice)


def choices_of(base: type[C]) -> dict[str, type[C]]:
    """Return the subclasses of a base by name, in the order of `place`."""
    classes = [base]
    for choice in classes:
        classes += choice.__subclasses__()
    choices = sorted((c for c in classes if c.key in c.model_fields), key=lambda c: c.place)
    return {choice.name(): choice for choice in choices}


def degree_field(description: str) -> Any:
    """Return the field of a polynomial's degree."""
    return Field(
        default=2,
        ge=0,
        le=10,
        description=f"Total degree of the polynomial{description}",
        json_schema_extra={"slider": [0, 10]},
    )


def width_field(default: float, description: str, least: float, most: float) -> Any:
    """Return the field of a Gaussian's width, with the range of its slider."""
    return Field(
        default=default,
        gt=0,
        allow_inf_nan=False,
        title="Width (px)",
        description=description,
        json_schema_extra={"slider": [least, most]},
    )


class Step(Choice):
    """A step applied to a shot before its inversion."""

    key = "step"
    # Does it change where pixels are, and leave their values.
    moves_pixels: ClassVar[bool] = True

    @property
    def flattens(self) -> bool:
        """Whether it removes the beam from the image, so that a measured source no longer fits."""
        return False

    @property
    def smooths(self) -> bool:
        """Whether it reduces pixel noise but keeps low-frequency noise."""
        return False

    def apply(self, shot: Radiograph, should_stop: ShouldStop | None = None) -> Radiograph:
        """Return the shot with the step applied to image, source, masks and setup.

        Raises an `InputError` if it does not apply to this image, and `InversionCancelled` if
        `should_stop`, called repeatedly by slow steps, returned true.
        """
        raise NotImplementedError

    def shape_after(self, shape: tuple[int, int]) -> tuple[int, int]:
        """Return the shape of an image after this step."""
        return shape

    def matrix(self, shape: tuple[int, int]) -> FloatArray:
        """Return the matrix that takes (y, x, 1) after this step to (y, x, 1) before it."""
        return np.eye(3)


def _as_level(value: Any) -> Any:
    """Read a finite number, or else the name of a file."""
    try:
        number = float(value)
    except (TypeError, ValueError):
        return value
    if not math.isfinite(number):
        raise ValueError("expected a finite number of counts, or the name of a file")
    return number


Level = Annotated[float | Path, BeforeValidator(_as_level)]
"""A number of counts, or a file with an image of them."""


class Dark(Step):
    """Subtract the detector's dark level from image and source.

    An image without it is linear in the fluence, as an inversion assumes. Pixels of the source that
    become negative are set to zero; for the image, the inversion's options decide.
    """

    title = "subtract dark level"
    primary = "level"
    place = 5
    moves_pixels = False
    step: Literal["dark"] = "dark"
    level: Level = Field(
        default=0.0,
        description="Counts of the detector without light, or an image of them, which is "
        "subtracted from image and source.",
        json_schema_extra={"metavar": "COUNTS|FILE"},
    )

    @property
    def frame_file(self) -> Path | None:
        """File of the image to subtract; None for a number."""
        return self.level if isinstance(self.level, Path) else None

    def apply(self, shot: Radiograph, should_stop: ShouldStop | None = None) -> Radiograph:
        file = self.frame_file
        dark: Any = self.level if file is None else shot.dark
        name = f"level {dark:g}" if file is None else f"frame {file.name}"
        if dark is None:
            raise InputError(
                f"the dark {name} has not been read: run the recipe, or put the image in the "
                "shot's 'dark'"
            )
        usable = shot.usable
        image = shot.image - dark
        if usable.any() and not image[usable].mean() > 0:
            raise InputError(
                f"the dark {name} is not below the image's mean of "
                f"{shot.image[usable].mean():.4g}: expected the counts without light, in the "
                "units of the image"
            )
        source = None if shot.source is None else np.maximum(shot.source - dark, 0.0)
        return replace(shot, image=image, source=source).add_notes(f"dark {name} subtracted")


class Rotate(Step):
    """Rotate about the image centre; exact for multiples of 90°.

    Other angles interpolate linearly between pixels and keep the image's size; corners without data
    are masked.
    """

    title = "rotate"
    primary = "angle"
    place = 10
    step: Literal["rotate"] = "rotate"
    angle: float = Field(
        default=90.0,
        ge=-360,
        le=360,
        allow_inf_nan=False,
        title="Angle (°)",
        description="Counter-clockwise rotation in degrees, about the image centre.",
    )

    @property
    def _turns(self) -> int | None:
        turns, remainder = divmod(self.angle, 90)
        return None if remainder else int(turns) % 4

    @property
    def smooths(self) -> bool:
        return self._turns is None

    def apply(self, shot: Radiograph, should_stop: ShouldStop | None = None) -> Radiograph:
        turns = self._turns

        def turn(array: AnyArray) -> Any:
            return np.ascontiguousarray(np.rot90(array, turns or 0))

        rotated = self._interpolate(shot) if turns is None else shot.map_planes(turn, turn)
        return rotated.add_notes(f"rotated by {self.angle:g}°")

    def _interpolate(self, shot: Radiograph) -> Radiograph:
        usable = shot.usable
        share = self._move(usable.astype(np.float64))
        mask = share > _MIN_DATA_SHARE

        def values(image: FloatArray) -> FloatArray:
            moved = self._move(np.where(usable, image, 0.0))
            return np.where(mask, moved / np.maximum(share, _MIN_DATA_SHARE), 0.0)

        rotated = shot.map_planes(values, lambda bare: self._move(bare.astype(float)) > 0.5)
        return replace(rotated, mask=mask)

    def _move(self, plane: FloatArray) -> FloatArray:
        from scipy.ndimage import affine_transform

        height, width = plane.shape
        matrix = self.matrix((height, width))
        return np.asarray(affine_transform(plane, matrix[:2, :2], matrix[:2, 2], order=1))

    def shape_after(self, shape: tuple[int, int]) -> tuple[int, int]:
        return shape[::-1] if self._turns in (1, 3) else shape

    def matrix(self, shape: tuple[int, int]) -> FloatArray:
        angle = math.radians(self.angle)
        cos, sin = math.cos(angle), math.sin(angle)
        if self._turns is not None:
            cos, sin = round(cos), round(sin)
        before, after = ((np.array(sides) - 1) / 2 for sides in (shape, self.shape_after(shape)))
        turn = np.array([[cos, sin], [-sin, cos]])
        matrix = np.eye(3)
        matrix[:2, :2], matrix[:2, 2] = turn, before - turn @ after
        return matrix


def _as_range(value: Any) -> Any:
    """Read ``"10:200"``, as typed on a command line."""
    if not isinstance(value, str):
        return value
    first, colon, last = value.partition(":")
    try:
        if colon:
            return int(first or 0), int(last) if last.strip() else None
    except ValueError:
        pass
    raise ValueError("expected the first pixel and the one after the last, such as 10:200")


def _as_text(range_: tuple[int, int | None]) -> str:
    first, last = range_
    return f"{first}:{'' if last is None else last}"


Range = Annotated[
    tuple[Annotated[int, Field(ge=0)], Annotated[int, Field(ge=0)] | None],
    BeforeValidator(_as_range),
    PlainSerializer(_as_text, when_used="json"),  # TOML has no None
]
"""First pixel, and the one after the last; None for the end of the image."""


class Crop(Step):
    """Keep a rectangle of the image."""

    title = "crop"
    place = 20
    step: Literal["crop"] = "crop"
    y: Range = Field(
        default=(0, None),
        title="Rows (px)",
        description="First row and the row after the last, such as 10:200. Default: all.",
    )
    x: Range = Field(
        default=(0, None),
        title="Columns (px)",
        description="First column and the column after the last, such as 10:200. Default: all.",
    )

    def slices(self, shape: tuple[int, int]) -> tuple[slice, slice]:
        """Return the rows and columns of an image inside the crop; at least 4 × 4 pixels."""
        rows, columns = (
            slice(*slice(*part).indices(side))
            for part, side in zip((self.y, self.x), shape, strict=True)
        )
        height, width = rows.stop - rows.start, columns.stop - columns.start
        if min(height, width) < _MIN_SIDE_PX:
            raise InputError(
                f"the crop contains {max(width, 0)} × {max(height, 0)} pixels of the image, "
                f"expected at least {_MIN_SIDE_PX} × {_MIN_SIDE_PX}: choose a larger rectangle"
            )
        return rows, columns

    def apply(self, shot: Radiograph, should_stop: ShouldStop | None = None) -> Radiograph:
        rows, columns = self.slices(shot.shape)

        def cut(array: AnyArray) -> Any:
            return np.ascontiguousarray(array[rows, columns])

        return shot.map_planes(cut, cut).add_notes(
            f"cropped to rows {rows.start}:{rows.stop}, columns {columns.start}:{columns.stop}"
        )

    def shape_after(self, shape: tuple[int, int]) -> tuple[int, int]:
        rows, columns = self.slices(shape)
        return rows.stop - rows.start, columns.stop - columns.start

    def matrix(self, shape: tuple[int, int]) -> FloatArray:
        matrix = np.eye(3)
        matrix[:2, 2] = [part.start for part in self.slices(shape)]
        return matrix


class Bin(Step):
    """Sum blocks of pixels."""

    title = "bin"
    primary = "factor"
    place = 40
    step: Literal["bin"] = "bin"
    factor: int = Field(
        default=2,
        ge=1,
        le=1000,
        description="Sum blocks of N×N pixels; the setup's pixel size grows with them.",
        json_schema_extra={"metavar": "N"},
    )

    def apply(self, shot: Radiograph, should_stop: ShouldStop | None = None) -> Radiograph:
        return shot.bin_pixels(self.factor)

    def shape_after(self, shape: tuple[int, int]) -> tuple[int, int]:
        height, width = shape
        return height // self.factor, width // self.factor

    def matrix(self, shape: tuple[int, int]) -> FloatArray:
        matrix = np.diag([self.factor, self.factor, 1.0])
        matrix[:2, 2] = (self.factor - 1) / 2
        return matrix
