"""Where an image lies in napari's world: `Frame`.

- from a setup: `frame_for`; from a layer that is there already: `frame_of`
- give a layer the pixel size of a setup: `place`
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from napari_shadowinv.physics.setup import Setup

__all__ = ["Frame", "frame_for", "frame_of", "place"]

Matrix = tuple[tuple[float, ...], ...]

_MICROMETRES_PER_METRE = 1e6
# Up to here a length in µm has four digits at most.
_LONGEST_IN_MICROMETRES = 10_000.0


@dataclass(frozen=True)
class Frame:
    """Pixel size, position and unit of a plane's axes (y, x).

    Attributes
    ----------
    scale : tuple of float
        Sides of a pixel, in `units`.
    translate : tuple of float
        Position of the centre of pixel (0, 0), in `units`.
    units : tuple of str
        Unit of each axis, as pint knows them: ``"um"``, ``"mm"`` or ``"pixel"``.
    rotate : tuple of tuple of float
        Rotation matrix, as of a camera that was turned.
    shear : float
        Slant of the rows.
    affine : tuple of tuple of float
        What is done to the place after all that: a homogeneous 3 × 3 matrix.
    """

    scale: tuple[float, float] = (1.0, 1.0)
    translate: tuple[float, float] = (0.0, 0.0)
    units: tuple[str, str] = ("pixel", "pixel")
    rotate: Matrix = ((1.0, 0.0), (0.0, 1.0))
    shear: float = 0.0
    affine: Matrix = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))

    def cropped(self, y: int, x: int) -> Frame:
        """Return the frame of a part that begins at pixel (y, x)."""
        slanted = np.array([[1.0, self.shear], [0.0, 1.0]]) * self.scale
        shift = np.array(self.rotate) @ slanted @ [y, x]
        origin = self.translate + shift
        return replace(self, translate=(float(origin[0]), float(origin[1])))

    def keywords(self, *, stacked: bool = False) -> dict[str, Any]:
        """Return the keywords that place a layer.

        Parameters
        ----------
        stacked : bool
            Whether an axis of shots comes first.

        Returns
        -------
        dict
            ``scale``, ``translate``, ``units``, ``axis_labels``; ``rotate``, ``shear`` and
            ``affine`` where a frame is not upright.
        """
        first: tuple[tuple[Any, ...], ...] = (
            ((1.0,), (0.0,), ("pixel",), ("shot",)) if stacked else ((), (), (), ())
        )
        own = (self.scale, self.translate, self.units, ("y", "x"))
        names = ("scale", "translate", "units", "axis_labels")
        placed = {name: one + two for name, one, two in zip(names, first, own, strict=True)}
        return placed | self._tilt(stacked)

    def _tilt(self, stacked: bool) -> dict[str, Any]:
        upright = Frame()
        tilt: dict[str, Any] = {}
        if self.rotate != upright.rotate:
            tilt["rotate"] = _with_shots(self.rotate, stacked)
        if self.shear != upright.shear:
            tilt["shear"] = [0.0, 0.0, self.shear] if stacked else [self.shear]
        if self.affine != upright.affine:
            tilt["affine"] = _with_shots(self.affine, stacked)
        return tilt


def frame_for(
    shape: Sequence[int],
    setup: Setup | None,
    *,
    scale: Sequence[float] | None = None,
    translate: Sequence[float] | None = None,
    units: Sequence[str] | None = None,
) -> Frame:
    """Choose the frame of an image.

    Parameters
    ----------
    shape : sequence of int
        Shape of the image; its last two numbers count.
    setup : Setup or None
        Gives the pixel's size in the object plane; without it, lengths are pixels.
    scale, translate, units : sequence, optional
        Taken instead, where given; axis order (y, x).

    Returns
    -------
    Frame
        In µm, in mm where the image is larger than 1 cm, or in pixels.
    """
    frame = Frame()
    if setup is not None:
        pixel, unit = setup.object_pixel_size * _MICROMETRES_PER_METRE, "um"
        if max(shape[-2:]) * pixel > _LONGEST_IN_MICROMETRES:
            pixel, unit = pixel * 1e-3, "mm"
        frame = Frame(scale=(pixel, pixel), units=(unit, unit))
    given = {"scale": scale, "translate": translate, "units": units}
    changes: dict[str, Any] = {
        name: tuple(value)[-2:] for name, value in given.items() if value is not None
    }
    return replace(frame, **changes)


def frame_of(layer: Any) -> Frame:
    """Return the frame of a layer's last two axes."""
    return Frame(
        scale=tuple(float(value) for value in layer.scale[-2:]),  # type: ignore[arg-type]
        translate=tuple(float(value) for value in layer.translate[-2:]),  # type: ignore[arg-type]
        units=tuple(str(unit) for unit in layer.units[-2:]),  # type: ignore[arg-type]
        rotate=_matrix(layer.rotate[-2:, -2:]),
        shear=float(layer.shear[-1]),
        affine=_matrix(layer.affine.affine_matrix[-3:, -3:]),
    )


def _matrix(values: NDArray[np.float64]) -> Matrix:
    return tuple(tuple(float(value) for value in row) for row in values)


def _with_shots(matrix: Matrix, stacked: bool) -> NDArray[np.float64]:
    """A matrix of the axes y and x that leaves an axis of shots before them alone."""
    if not stacked:
        return np.array(matrix)
    whole = np.eye(len(matrix) + 1)
    whole[1:, 1:] = matrix
    return whole


def place(layer: Any, setup: Setup) -> None:
    """Give a layer the pixel size that a setup tells, so that it fits to its result.

    Parameters
    ----------
    layer : napari.layers.Layer
        An image, whose last two axes are y and x.
    setup : Setup
        The experiment.
    """
    frame = frame_for(layer.data.shape, setup)
    labels = layer.axis_labels
    layer.scale = (*layer.scale[:-2], *frame.scale)
    layer.units = (*layer.units[:-2], *frame.units)
    layer.axis_labels = (*labels[:-2], "y", "x")
