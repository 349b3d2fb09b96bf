"""Closed outlines of regions and contours: `Outlined`, with a circle, a rectangle or a polygon."""

from __future__ import annotations

from functools import lru_cache
from typing import Annotated, Any

import numpy as np
from pydantic import AfterValidator, Field, model_validator

from napari_shadowinv._system.validation import CombinationError
from napari_shadowinv._typing import BoolArray, FloatArray
from napari_shadowinv.analysis.frame import FieldFrame
from napari_shadowinv.analysis.paths import circle_path
from napari_shadowinv.analysis.product import Product
from napari_shadowinv.physics.beam import number_field

Point = tuple[float, float]


def _checked_corners(corners: Any) -> Any:
    if corners is None:
        return None
    if not np.isfinite(np.asarray(corners, dtype=np.float64)).all():
        raise ValueError("expected finite numbers: (y, x) in px")
    return corners


class Outlined(Product):
    """A product of a closed outline: a circle, a rectangle, or a polygon of corners."""

    center: Annotated[Point | None, AfterValidator(_checked_corners)] = Field(
        default=None,
        title="Centre (px)",
        description="Centre (y, x) of a circle, in px.",
        json_schema_extra={"metavar": "Y,X"},
    )
    radius: float | None = number_field("Radius (px)", "Radius of the circle, in px.", None, gt=0)
    rectangle: Annotated[tuple[Point, Point] | None, AfterValidator(_checked_corners)] = Field(
        default=None,
        title="Rectangle (px)",
        description="Two opposite corners (y, x) of a rectangle, in px.",
        json_schema_extra={"metavar": "Y,X Y,X"},
    )
    path: Annotated[tuple[Point, ...] | None, AfterValidator(_checked_corners)] = Field(
        default=None,
        min_length=3,
        max_length=2000,
        title="Path (px)",
        description="Corners (y, x) of a polygon, in px; the last is joined to the first.",
        json_schema_extra={"metavar": "Y,X Y,X …"},
    )

    @model_validator(mode="after")
    def _check_outline(self) -> Outlined:
        if (self.center is None) != (self.radius is None):
            raise CombinationError(
                "received only one of {center} and {radius}, expected both for a circle"
            )
        shapes = [self.center, self.rectangle, self.path]
        if sum(shape is not None for shape in shapes) != 1:
            raise CombinationError(
                "expected one outline: {center} and {radius} of a circle, {rectangle}, or {path}"
            )
        if self.path is not None and crosses_itself(self.outline):
            raise CombinationError(
                "the {path} crosses itself, so the area inside is not defined: expected a polygon "
                "whose sides do not meet"
            )
        if self.center is None:
            y, x = self.outline.T
            area = abs(float((y[:-1] * x[1:] - y[1:] * x[:-1]).sum())) / 2
            if not area > 0:
                raise CombinationError("the outline has no area, expected corners that enclose one")
        return self

    @property
    def outline(self) -> FloatArray:
        """Corners (n, 2) of the closed outline in px, in the sense from x to y."""
        if self.center is not None and self.radius is not None:
            return circle_path(self.center, self.radius)
        if self.rectangle is not None:
            (y0, x0), (y1, x1) = self.rectangle
            corners = np.array([(y0, x0), (y0, x1), (y1, x1), (y1, x0)])
        else:
            corners = np.array(self.path, dtype=np.float64)
            if len(corners) > 1 and (corners[0] == corners[-1]).all():
                corners = corners[:-1]
        y, x = np.vstack([corners, corners[:1]]).T
        if (x[:-1] * y[1:] - x[1:] * y[:-1]).sum() < 0:
            corners = corners[::-1]
        return np.vstack([corners, corners[:1]])

    def check(self, frame: FieldFrame) -> None:
        super().check(frame)
        ends = np.stack([self.outline.min(axis=0), self.outline.max(axis=0)])
        if self.center is not None and self.radius is not None:
            ends = np.array(self.center) + np.array([[-self.radius], [self.radius]])
        frame.check_points(ends, "the outline")

    def pixels_inside(self, frame: FieldFrame) -> BoolArray:
        """Return the pixels whose centres are inside, shape (H, W)."""
        corners = tuple(map(tuple, self.outline.tolist()))
        return _pixels_inside(frame.shape, corners)


@lru_cache(maxsize=32)
def _pixels_inside(shape: tuple[int, int], corners: tuple[tuple[float, ...], ...]) -> BoolArray:
    from skimage.draw import polygon2mask

    inside: BoolArray = polygon2mask(shape, np.array(corners))  # type: ignore[no-untyped-call]
    return inside


def crosses_itself(outline: FloatArray) -> bool:
    """Return whether sides of a closed outline (n, 2) meet other than at common corners."""
    start, side = outline[:-1], np.diff(outline, axis=0)
    count = len(start)
    gap = start[None] - start[:, None]  # from the start of side i to that of side k
    cross = _cross(side[:, None], side[None])
    with np.errstate(divide="ignore", invalid="ignore"):
        along = _cross(gap, side[None]) / cross
        across = _cross(gap, side[:, None]) / cross
    meets = (along > 0) & (along < 1) & (across > 0) & (across < 1)
    i, k = np.indices((count, count))
    neighbours = (np.abs(i - k) <= 1) | (np.abs(i - k) == count - 1)
    return bool((meets & ~neighbours).any())


def _cross(a: FloatArray, b: FloatArray) -> FloatArray:
    return np.asarray(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])
