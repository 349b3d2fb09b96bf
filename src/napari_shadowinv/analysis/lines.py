"""Values of a field along a line or path: `LineProfile`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import AfterValidator, Field

from napari_shadowinv._typing import FloatArray
from napari_shadowinv.analysis.frame import FieldFrame
from napari_shadowinv.analysis.paths import (
    interpolate_cubic,
    is_inside,
    mean_inside,
    path_directions,
    sample_path,
    sample_strip,
)
from napari_shadowinv.analysis.product import Coordinate, Measurand, Product, Values, mask_cautions
from napari_shadowinv.cautions import Caution
from napari_shadowinv.inversion.error_bars import Quantity
from napari_shadowinv.physics.beam import number_field


def _checked_path(path: Any) -> Any:
    if len(path) < 2:
        raise ValueError("expected at least two points (y, x) in px")
    points = np.asarray(path, dtype=np.float64)
    if not np.isfinite(points).all():
        raise ValueError("expected finite numbers: (y, x) in px")
    if not np.hypot(*np.diff(points, axis=0).T).sum() > 0:
        raise ValueError("expected a line with a length: two different points (y, x) in px")
    return path


Path = Annotated[
    tuple[tuple[float, float], ...], Field(max_length=10_000), AfterValidator(_checked_path)
]
"""Corners (y, x) of a line or path in px."""


def path_field(description: str) -> Any:
    """Return the field of a line or path."""
    return Field(
        title="Path (px)", description=description, json_schema_extra={"metavar": "Y,X Y,X …"}
    )


class LineProfile(Product):
    """Field and image along a line or path, averaged over a width.

    The normal points to the right of the line's direction as the image is shown, with y downwards.
    """

    title = "profile along a line"
    primary = "path"
    place = 10
    curves = ("value", "along", "normal")  # the components show the magnitude, too
    recorded = ("intensity",)
    product: Literal["profile"] = "profile"
    path: Path = path_field("Corners of the line or path, (y, x) in px.")
    width: float = number_field(
        "Width (px)",
        "Width of the strip across the line over which values are averaged, in px. 0: values "
        "on the line.",
        0.0,
        ge=0,
    )

    def check(self, frame: FieldFrame) -> None:
        super().check(frame)
        frame.check_points(np.array(self.path), "the path")

    @property
    def _distance(self) -> FloatArray:
        return sample_path(self.path)[1]

    def variables(self, frame: FieldFrame) -> dict[str, Measurand]:
        name, dims, unit = frame.long_name, ("distance",), frame.si_unit
        if not frame.is_vector:
            variables = {"value": Measurand(dims, unit, name)}
        else:
            variables = {
                "magnitude": Measurand(dims, unit, f"{name}, magnitude"),
                "along": Measurand(
                    dims, unit, f"{name}, component along the line", "component along"
                ),
                "normal": Measurand(
                    dims, unit, f"{name}, component to the right of the line", "component across"
                ),
            }
        if frame.image is not None:
            variables["intensity"] = Measurand(dims, "1", "Intensity of the image")
        return variables

    def coordinates(self, frame: FieldFrame) -> dict[str, Coordinate]:
        return {"distance": Coordinate.in_plane(self._distance, frame, "Distance along the line")}

    def measure(self, potential: FloatArray, displacement: FloatArray, frame: FieldFrame) -> Values:
        field = frame.field(potential, displacement)
        if not frame.is_vector:
            return {"value": self._mean_across(field)}
        along = path_directions(self.path, self._distance)
        components = np.stack([self._mean_across(plane) for plane in field], axis=1)
        right = np.stack([along[:, 1], -along[:, 0]], axis=1)
        return {
            "magnitude": np.hypot(*components.T),
            "along": (components * along).sum(axis=1),
            "normal": (components * right).sum(axis=1),
        }

    def refine(self, quantities: dict[str, Quantity]) -> dict[str, Quantity]:
        """Give the magnitude the error of the component along the field: it is never negative."""
        if "magnitude" not in quantities:
            return quantities
        magnitude, along, normal = (quantities[key] for key in ("magnitude", "along", "normal"))
        size = np.maximum(magnitude.value, np.finfo(float).tiny)
        changes = [part.value * (part.samples - part.value) for part in (along, normal)]
        samples = magnitude.value + (changes[0] + changes[1]) / size
        # A band reaches as far below the value as samples are above it.
        samples = np.minimum(samples, 2 * magnitude.value)
        return quantities | {"magnitude": Quantity(magnitude.value, samples)}

    def constants(self, frame: FieldFrame) -> Values:
        if frame.image is None:
            return {}
        return {"intensity": self._mean_across(np.asarray(frame.image, dtype=np.float64))}

    def _mean_across(self, plane: FloatArray) -> FloatArray:
        points = sample_strip(self.path, self._distance, self.width)
        clipped = np.clip(points, -0.5, np.array(plane.shape) - 0.5)
        return mean_inside(interpolate_cubic(plane, clipped), is_inside(points, plane.shape))

    def cautions(self, quantities: Mapping[str, Quantity], frame: FieldFrame) -> list[Caution]:
        return mask_cautions(sample_path(self.path)[0], frame, "the line")
