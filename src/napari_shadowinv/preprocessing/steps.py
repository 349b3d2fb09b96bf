"""The steps of a recipe that are no filters.

- the base class of all steps: `Step`
- subtract the detector's dark level: `Dark`
- move pixels: `Rotate`, `Crop`, `Bin`
"""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, TypeVar

import numpy as np
from pydantic import BeforeValidator, Field, PlainSerializer
from pydantic.fields import FieldInfo

from napari_shadowinv._system.validation import CheckedModel
from napari_shadowinv._typing import AnyArray, FloatArray
from napari_shadowinv.errors import InputError
from napari_shadowinv.shot import Shot

if TYPE_CHECKING:
    from napari_shadowinv._system.progress import ShouldStop


class Choice(CheckedModel):
    """One of several ways to do something, with its parameters."""

    title: ClassVar[str]  # in forms
    key: ClassVar[str]  # the field that names it in files, "step" or "method"
    # The parameter that needs no name in a text, such as "bin 4"; "" if all do.
    primary: ClassVar[str] = ""
    # Its order in lists; steps chosen by texts are applied in this order.
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

    def apply(self, shot: Shot, should_stop: ShouldStop | None = None) -> Shot:
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


Level = Annotated[float | Path, Field(union_mode="left_to_right")]
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
    )

    @property
    def frame_file(self) -> Path | None:
        """File of the image to subtract; None for a number."""
        return self.level if isinstance(self.level, Path) else None

    def apply(self, shot: Shot, should_stop: ShouldStop | None = None) -> Shot:
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
    """Rotate by a multiple of 90° about the image centre."""

    title = "rotate"
    primary = "angle"
    place = 10
    step: Literal["rotate"] = "rotate"
    angle: int = Field(
        default=90,
        ge=-360,
        le=360,
        multiple_of=90,
        title="Angle (°)",
        description="Counter-clockwise rotation in degrees, a multiple of 90.",
    )

    def apply(self, shot: Shot, should_stop: ShouldStop | None = None) -> Shot:
        def turn(array: AnyArray) -> Any:
            return np.ascontiguousarray(np.rot90(array, self.angle // 90))

        return shot.map_planes(turn, turn).add_notes(f"rotated by {self.angle}°")

    def shape_after(self, shape: tuple[int, int]) -> tuple[int, int]:
        return shape[::-1] if self.angle % 180 else shape

    def matrix(self, shape: tuple[int, int]) -> FloatArray:
        angle = math.radians(self.angle)
        cos, sin = round(math.cos(angle)), round(math.sin(angle))
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
        if min(height, width) < 4:
            raise InputError(
                f"the crop contains {max(width, 0)} × {max(height, 0)} pixels of the image, "
                "expected at least 4 × 4: choose a larger rectangle"
            )
        return rows, columns

    def apply(self, shot: Shot, should_stop: ShouldStop | None = None) -> Shot:
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
    )

    def apply(self, shot: Shot, should_stop: ShouldStop | None = None) -> Shot:
        return shot.bin_pixels(self.factor)

    def shape_after(self, shape: tuple[int, int]) -> tuple[int, int]:
        height, width = shape
        return height // self.factor, width // self.factor

    def matrix(self, shape: tuple[int, int]) -> FloatArray:
        matrix = np.diag([self.factor, self.factor, 1.0])
        matrix[:2, 2] = (self.factor - 1) / 2
        return matrix
