"""Layers on the pixels of an image, by their places in the world as the canvas shows them.

- shapes and points of the world in pixels: `matrix_between`, `mapped`, `pixel_mapper`
- labels as a mask: `labels_on`; a beam, which is never resampled: `source_on`
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.ndimage import affine_transform

from napari_shadowinv._napari.layer_metadata import Frame, data_of, frame_of
from napari_shadowinv._typing import BoolArray, FloatArray
from napari_shadowinv.errors import InputError

_MAX_OFFSET_PX = 0.1  # of a beam from whole pixels


def matrix_between(layer: Any, image: Any) -> FloatArray:
    """Return the matrix from (y, x, 1) in pixels of a layer to those of an image."""
    return np.linalg.inv(_world_matrix(image)) @ _unit_ratios(layer, image) @ _world_matrix(layer)


def mapped(matrix: FloatArray, points: Any) -> FloatArray:
    """Return points (n, 2) after a matrix; of points with more axes the last two count."""
    return np.asarray(points)[:, -2:] @ matrix[:2, :2].T + matrix[:2, 2]


def pixel_mapper(image: Any, drawn: Any) -> Callable[[Any], Any]:
    """Return the function from world points of a drawn layer to an image's pixels."""
    matrix = np.linalg.inv(_world_matrix(image)) @ _unit_ratios(drawn, image)
    return lambda points: mapped(matrix, points)


def labels_on(layer: Any, image: Any) -> BoolArray:
    """Return the pixels of an image whose centres lie on painted labels, or an `InputError`."""
    if frame_of(layer) == frame_of(image) and _shape(layer) != _shape(image):
        raise _mismatch("mask", layer, image)
    to_layer, painted = matrix_between(image, layer), (np.asarray(layer.data) != 0).view(np.uint8)
    on_image = affine_transform(
        painted, to_layer[:2], output_shape=_shape(image), order=0, mode="grid-constant"
    )
    return on_image.astype(np.bool_)


def source_on(layer: Any, data: Any, image: Any) -> Any:
    """Return a beam, or one for each shot, on an image's pixels, or an `InputError`."""
    height, width = _shape(image)
    if frame_of(layer) == frame_of(image) or _is_unplaced(layer, image):
        if _shape(layer) != (height, width):
            raise _mismatch("source", layer, image)
        return data
    matrix = matrix_between(image, layer)
    corners = np.array([[0, 0], [height - 1, 0], [0, width - 1], [height - 1, width - 1]])
    moves = mapped(matrix, corners) - corners
    top, left = np.round(moves[0]).astype(int)
    if np.abs(moves - (top, left)).max() > _MAX_OFFSET_PX:
        raise InputError(
            f"{_sizes('source', layer, image)}: expected pixels that lie on each other; give both "
            "layers the same scale and place (layer controls → transform), or bin one of them"
        )
    below, beyond = data.shape[-2] - top - height, data.shape[-1] - left - width
    if min(top, left, below, beyond) < 0:
        raise InputError(
            f"{_sizes('source', layer, image)}: the source covers only a part of the image; crop "
            "the image, or give both layers the same place (layer controls → transform)"
        )
    return data[..., top : top + height, left : left + width]


def _mismatch(role: str, layer: Any, image: Any) -> InputError:
    """Return the refusal of two sizes at one place: nobody has said which pixels are the same."""
    return InputError(
        f"{_sizes(role, layer, image)}: they must match; crop one of them, or move it to where it "
        "belongs (layer controls → transform)"
    )


def _sizes(role: str, layer: Any, image: Any) -> str:
    return f"the {role} '{layer.name}' has {_size(layer)}, the image '{image.name}' {_size(image)}"


def _size(layer: Any) -> str:
    (height, width), frame = _shape(layer), frame_of(layer)
    dy, dx = (f"{abs(side):.4g}" for side in frame.scale)
    pixel = dx if dx == dy else f"{dx} × {dy}"
    is_in_pixels = frame.units == Frame().units
    place = f"scale {pixel}" if is_in_pixels else f"pixels of {pixel} {layer.units[-1]:~P}"
    return f"{width} × {height} px" + ("" if frame == Frame() else f" ({place})")


def _shape(layer: Any) -> tuple[int, int]:
    height, width = data_of(layer).shape[-2:]
    return height, width


def _world_matrix(layer: Any) -> FloatArray:
    """Return the matrix from the last two axes (y, x, 1) to the world, in the layer's units."""
    leading = np.zeros(layer.ndim - 2)
    points = [layer.data_to_world((*leading, *pixel))[-2:] for pixel in ((0, 0), (1, 0), (0, 1))]
    origin, below, beside = (np.append(point, 1.0) for point in points)
    return np.stack([below - origin, beside - origin, origin], axis=1)


def _unit_ratios(layer: Any, image: Any) -> FloatArray:
    """Return the matrix between the worlds of two layers; pixels and lengths are mixed as drawn."""
    pairs = zip(layer.units[-2:], image.units[-2:], strict=True)
    ratios = [
        (1 * unit).to(other).magnitude if unit.dimensionality == other.dimensionality else 1.0
        for unit, other in pairs
    ]
    return np.diag([*ratios, 1.0])


def _is_unplaced(layer: Any, image: Any) -> bool:
    """Whether only one of two layers has a place in lengths, and the other none at all."""
    units, other_units = layer.units[-1], image.units[-1]
    is_mixed = units.dimensionality != other_units.dimensionality
    return is_mixed and Frame() in (frame_of(layer), frame_of(image))
