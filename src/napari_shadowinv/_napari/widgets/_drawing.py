"""New layers to paint or draw on, that lie on an image: `new_mask`, `new_shapes`."""

from __future__ import annotations

from typing import Any

import numpy as np

from napari_shadowinv._napari.frame import frame_of
from napari_shadowinv._napari.layer_metadata import MASK, mark
from napari_shadowinv._napari.widgets._reading import image_of, stack_of

__all__ = ["new_mask", "new_shapes"]


def new_mask(viewer: Any, image: Any, title: str = "mask") -> Any:
    """Add labels of an image's size, ready to paint.

    Parameters
    ----------
    viewer : napari.Viewer
        Where to add them.
    image : napari.layers.Image or None
        The image, or the stack, to be masked.
    title : str
        What it is for; the layer's name ends with it.

    Returns
    -------
    napari.layers.Labels

    Raises
    ------
    InputError
        If there is no image, or it is in colour.
    """
    shape = (image_of(image) if image is None or image.ndim != 3 else stack_of(image)).shape[-2:]
    labels = _added(viewer, image, "labels", np.zeros(shape, np.uint8), title)
    labels.metadata = mark(MASK, "")
    labels.mode = "paint"
    return labels


def new_shapes(viewer: Any, image: Any, title: str, mode: str) -> Any:
    """Add empty shapes, ready to draw.

    Parameters
    ----------
    viewer : napari.Viewer
        Where to add them.
    image : napari.layers.Image
        What they lie on.
    title : str
        What they are for; the layer's name ends with it.
    mode : str
        The tool to begin with, such as ``"add_rectangle"``.

    Returns
    -------
    napari.layers.Shapes
    """
    shapes = _added(viewer, image, "shapes", None, title)
    shapes.current_face_color = "transparent"
    shapes.current_edge_color = "yellow"
    shapes.current_edge_width = max(image.data.shape[-2:]) / 200
    shapes.mode = mode
    return shapes


def _added(viewer: Any, image: Any, kind: str, data: Any, title: str) -> Any:
    from napari.layers import Layer

    keywords = {"name": f"{image.name} {title}", **frame_of(image).keywords()}
    if data is None:
        keywords["ndim"] = 2
    layer = Layer.create(data, keywords, kind)
    viewer.layers.append(layer)
    viewer.layers.selection.active = layer
    return layer
