"""Arrays from layers.

- `image_of`, `stack_of`, `shown_plane`, `mask_of`, `crop_of`
- what speaks against an image: `warnings_of`
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from napari_shadowinv._napari.layer_metadata import mark_of
from napari_shadowinv._napari.widgets._picking import kind_of
from napari_shadowinv.errors import InputError
from napari_shadowinv.io.colours import film_warnings
from napari_shadowinv.io.formats import SCAN_SUFFIXES

__all__ = ["crop_of", "image_of", "mask_of", "shown_plane", "stack_of", "warnings_of"]

Mask = NDArray[np.bool_]


def image_of(layer: Any | None, role: str = "image") -> Any:
    """The 2-D array of an image layer, not read yet if it is lazy.

    Parameters
    ----------
    layer : napari.layers.Image or None
        The layer.
    role : str
        What it is for, for the message.

    Returns
    -------
    array_like, shape (H, W)

    Raises
    ------
    InputError
        If there is no layer, or it is no single grey image.
    """
    data = _grey(layer, role)
    assert layer is not None
    if data.ndim != 2:
        raise InputError(
            f"'{layer.name}' has shape {tuple(data.shape)}, expected one image (y, x): "
            "split the stack (right click on the layer → Split Stack) and choose one shot"
        )
    return data


def stack_of(layer: Any | None) -> Any:
    """The 3-D array (shot, y, x) of an image layer, not read yet if it is lazy.

    Parameters
    ----------
    layer : napari.layers.Image or None
        The layer.

    Returns
    -------
    ndarray or dask.array.Array, shape (shots, H, W)

    Raises
    ------
    InputError
        If there is no layer, or it is no stack of grey images.
    """
    data = _grey(layer, "stack of shots")
    assert layer is not None
    if data.ndim != 3:
        hint = "use 'Invert shot' for a single image, or " if data.ndim == 2 else ""
        raise InputError(
            f"'{layer.name}' has shape {tuple(data.shape)}, expected a stack (shot, y, x): "
            f"{hint}choose another layer, or files"
        )
    if isinstance(data, np.ndarray):
        return data
    from dask import array

    # Whatever reads from a disk stays there until a shot is needed.
    whole = array.asanyarray(data)  # type: ignore[no-untyped-call]
    return whole


def shown_plane(layer: Any, point: Any) -> Any:
    """The plane of an image, or of a stack of them, that is shown now.

    Parameters
    ----------
    layer : napari.layers.Image
        The image.
    point : sequence of float
        Where the viewer is along all axes: its ``dims.point``.

    Returns
    -------
    array_like, shape (H, W)
    """
    data = layer.data[0] if getattr(layer, "multiscale", False) else layer.data
    if data.ndim == 2:
        return data
    at = np.round(layer.world_to_data(point[-layer.ndim :])[:-2]).astype(int)
    return data[tuple(np.clip(at, 0, np.array(data.shape[:-2]) - 1))]


def _grey(layer: Any | None, role: str) -> Any:
    if layer is None:
        raise InputError(
            f"there is no {role} to use: open one (File → Open), drop it on the window, or use a "
            "sample (File → Open Sample)"
        )
    if getattr(layer, "rgb", False):
        raise InputError(
            f"'{layer.name}' is a colour image, expected a greyscale one: if it is a scan of "
            "film, which darkens with dose, convert it to dose first "
            "(napari_shadowinv.preprocessing.film); if it is linear in fluence, "
            "split it (right click on the layer → Split RGB) and choose one channel"
        )
    return layer.data[0] if getattr(layer, "multiscale", False) else layer.data


def warnings_of(layer: Any) -> tuple[str, ...]:
    """What is known against an image: what its reader said, or that it looks like scanned film.

    Parameters
    ----------
    layer : napari.layers.Image
        A grey image; where napari itself has read a picture, its pixels are looked at.

    Returns
    -------
    tuple of str
    """
    known = mark_of(layer)
    path = str(layer.source.path or "").lower()
    if known or not path.endswith(tuple(SCAN_SUFFIXES)) or not isinstance(layer.data, np.ndarray):
        return tuple(known.get("warnings", ()))
    return film_warnings(layer.data, None)


def mask_of(layer: Any | None, image: Any, painted_is_unusable: bool) -> Mask | None:
    """Usable pixels of an image layer, from labels or shapes drawn on it.

    Parameters
    ----------
    layer : napari.layers.Labels or napari.layers.Shapes or None
        What was painted; None, or nothing painted, for no mask.
    image : napari.layers.Image or None
        The image, or the stack of them, that it belongs to; None for files, whose shape is
        not known yet.
    painted_is_unusable : bool
        Whether the paint marks what to leave out, or what to use.

    Returns
    -------
    ndarray of bool, shape (H, W), or None

    Raises
    ------
    InputError
        If labels are not of the image's shape.
    """
    if layer is None:
        return None
    shape = None if image is None else tuple(_grey(image, "image").shape[-2:])
    if kind_of(layer) == "labels":
        painted = np.asarray(layer.data) != 0
        if shape is not None and painted.shape != shape:
            raise InputError(
                f"the mask '{layer.name}' has shape {painted.shape}, the image {shape}: they "
                "must match; create new labels while the image is the only layer"
            )
    else:
        assert shape is not None
        painted = _drawn(layer, image, shape)
    if not painted.any():
        return None
    return ~painted if painted_is_unusable else painted


def crop_of(layer: Any | None, image: Any) -> tuple[slice, slice] | None:
    """The pixels of an image whose centres are within a drawn rectangle.

    Parameters
    ----------
    layer : napari.layers.Shapes or None
        Of several shapes the selected one counts, else the last.
    image : napari.layers.Image
        The image that it is drawn on.

    Returns
    -------
    tuple of slice, or None
        Rows and columns; None if there is no shape.
    """
    if layer is None or not len(layer.data):
        return None
    chosen = max(layer.selected_data, default=len(layer.data) - 1)
    corners = _in_pixels(layer, image)[chosen]
    height, width = image_of(image).shape
    least = np.ceil(corners.min(axis=0)).astype(int)
    most = np.floor(corners.max(axis=0)).astype(int) + 1
    rows, columns = (
        slice(int(np.clip(a, 0, side)), int(np.clip(b, 0, side)))
        for a, b, side in zip(least, most, (height, width), strict=True)
    )
    return rows, columns


def _drawn(layer: Any, image: Any, shape: tuple[int, ...]) -> Mask:
    if not len(layer.data):
        return np.zeros(shape, bool)
    from napari.layers import Shapes

    on_pixels = Shapes(_in_pixels(layer, image), shape_type=list(layer.shape_type))
    masks: Mask = np.asarray(on_pixels.to_masks(mask_shape=shape), dtype=np.bool_)
    return np.asarray(masks.any(axis=0))


def _in_pixels(layer: Any, image: Any) -> list[NDArray[np.float64]]:
    """Corners of shapes in the pixels of an image that may be scaled differently."""
    return [
        np.array([image.world_to_data(layer.data_to_world(corner))[-2:] for corner in shape])
        for shape in layer.data
    ]
