"""Placement of images in napari's world: `Frame`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from napari_shadowinv._typing import FloatArray

if TYPE_CHECKING:
    from napari_shadowinv.physics.setup import Setup

Matrix = tuple[tuple[float, ...], ...]

_MAX_LENGTH_UM = 10_000.0  # longer sides are in mm


@dataclass(frozen=True)
class Frame:
    """Pixel size, position (of the centre of pixel (0, 0)) and unit of a plane's axes (y, x)."""

    scale: tuple[float, float] = (1.0, 1.0)
    translate: tuple[float, float] = (0.0, 0.0)
    units: tuple[str, str] = ("pixel", "pixel")
    # A rotation matrix, a shear of the rows, and then a homogeneous matrix.
    rotate: Matrix = ((1.0, 0.0), (0.0, 1.0))
    shear: float = 0.0
    affine: Matrix = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))

    def beneath(self, matrix: FloatArray) -> Frame:
        """Return the frame of a derived image; `matrix` maps its (y, x, 1) to (y, x, 1) here."""
        sheared = np.array([[1.0, self.shear], [0.0, 1.0]]) * self.scale
        pixels = np.array(self.rotate) @ sheared
        y, x = (float(value) for value in self.translate + pixels @ matrix[:2, 2])
        translated = replace(self, translate=(y, x))
        factor = float(matrix[0, 0])
        if np.array_equal(matrix[:2, :2], factor * np.eye(2)):
            return replace(translated, scale=(factor * self.scale[0], factor * self.scale[1]))
        rotate, upright = np.linalg.qr(pixels @ matrix[:2, :2])
        # napari's order: first the scale, which alone may mirror, then the shear.
        signs = np.sign(upright[0, 0]) * np.array([1.0, np.round(np.linalg.det(rotate))])
        rotate, upright = rotate * signs, signs[:, None] * upright
        return replace(
            translated,
            scale=(float(upright[0, 0]), float(upright[1, 1])),
            shear=float(upright[0, 1] / upright[1, 1]),
            rotate=matrix_of(rotate),
        )

    def keywords(self, *, stacked: bool = False) -> dict[str, Any]:
        """Return the keywords that place a layer; `stacked` if an axis of shots comes first."""
        keywords: dict[str, Any] = {
            "scale": (1.0, *self.scale) if stacked else self.scale,
            "translate": (0.0, *self.translate) if stacked else self.translate,
            "units": ("pixel", *self.units) if stacked else self.units,
            "axis_labels": ("shot", "y", "x") if stacked else ("y", "x"),
        }
        upright = Frame()
        if self.rotate != upright.rotate:
            keywords["rotate"] = _with_shots(self.rotate, stacked)
        if self.shear != upright.shear:
            keywords["shear"] = [0.0, 0.0, self.shear] if stacked else [self.shear]
        if self.affine != upright.affine:
            keywords["affine"] = _with_shots(self.affine, stacked)
        return keywords


def frame_for(
    shape: Sequence[int],
    setup: Setup | None,
    *,
    scale: Sequence[float] | None = None,
    translate: Sequence[float] | None = None,
    units: Sequence[str] | None = None,
    pixel_size: float | None = None,
) -> Frame:
    """Choose a frame in µm, in mm above 1 cm, or in pixels; other arguments take precedence.

    `pixel_size` (m) is used without a setup.
    """
    frame = Frame()
    side = pixel_size if setup is None else setup.object_pixel_size
    if side is not None:
        pixel, unit = side * 1e6, "um"
        if max(shape[-2:]) * pixel > _MAX_LENGTH_UM:
            pixel, unit = pixel * 1e-3, "mm"
        frame = Frame(scale=(pixel, pixel), units=(unit, unit))
    overrides = {"scale": scale, "translate": translate, "units": units}
    changes: dict[str, Any] = {
        name: tuple(value)[-2:] for name, value in overrides.items() if value is not None
    }
    return replace(frame, **changes)


def frame_of(layer: Any) -> Frame:
    """Return the frame of a layer's last two axes."""
    return Frame(
        scale=tuple(float(value) for value in layer.scale[-2:]),  # type: ignore[arg-type]
        translate=tuple(float(value) for value in layer.translate[-2:]),  # type: ignore[arg-type]
        units=tuple(str(unit) for unit in layer.units[-2:]),  # type: ignore[arg-type]
        rotate=matrix_of(layer.rotate[-2:, -2:]),
        shear=float(layer.shear[-1]),
        affine=matrix_of(layer.affine.affine_matrix[-3:, -3:]),
    )


def matrix_of(values: Any) -> Matrix:
    """Return the rows of a matrix as tuples, which can be compared."""
    return tuple(tuple(float(value) for value in row) for row in values)


def _with_shots(matrix: Matrix, stacked: bool) -> FloatArray:
    """Extend a matrix of the axes y and x by an unchanged first axis of shots."""
    if not stacked:
        return np.array(matrix)
    extended = np.eye(len(matrix) + 1)
    extended[1:, 1:] = matrix
    return extended


def place_image(layer: Any, setup: Setup) -> None:
    """Set the pixel size of an image, whose last axes are y and x, from a setup."""
    frame = frame_for(layer.data.shape, setup)
    layer.scale = (*layer.scale[:-2], *frame.scale)
    layer.units = (*layer.units[:-2], *frame.units)
    layer.axis_labels = (*layer.axis_labels[:-2], "y", "x")
