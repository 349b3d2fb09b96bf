"""Layers of a widget: pickers, their pixels, masks and crops, and new layers to draw on."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from napari.layers import Layer, Shapes
from qtpy.QtCore import Signal

from napari_shadowinv._napari import layer_metadata as about
from napari_shadowinv._napari.form import Kinds, ModelPicker
from napari_shadowinv._napari.jobs import name_of_result
from napari_shadowinv._napari.layer_metadata import (
    data_of,
    kind_of,
    labels_on,
    mapped,
    matrix_between,
)
from napari_shadowinv._napari.viewer_sync import without_proxy
from napari_shadowinv._napari.widgets import _qt as qt
from napari_shadowinv._typing import BoolArray, FloatArray
from napari_shadowinv.cautions import Caution
from napari_shadowinv.errors import InputError
from napari_shadowinv.facts import percent
from napari_shadowinv.io.formats import SCAN_SUFFIXES
from napari_shadowinv.io.images import film_cautions
from napari_shadowinv.physics.arrays import complete_block_means, join_masks
from napari_shadowinv.preprocessing import Crop


def image_of(layer: Any, role: str = "image") -> Any:
    """Return the 2-D array of a grey image, lazy if the layer is; errors mention `role`."""
    data = _grey(layer, role)
    if data.ndim != 2:
        raise InputError(
            f"'{layer.name}' has shape {tuple(data.shape)}, expected one image (y, x): "
            "split the stack (right click on the layer → Split Stack) and choose one shot"
        )
    return data


def stack_of(layer: Any) -> Any:
    """Return the 3-D array (shot, y, x) of grey images, lazy if the layer is."""
    data = _grey(layer, "stack of shots")
    if data.ndim != 3:
        raise InputError(
            f"'{layer.name}' has shape {tuple(data.shape)}, expected a stack (shot, y, x): "
            "choose another layer, or files"
        )
    if isinstance(data, np.ndarray):
        return data
    from dask import array

    # Data on disk are read when a shot is needed.
    return array.asanyarray(data)  # type: ignore[no-untyped-call]


def shown_plane(layer: Any, point: Any) -> Any:
    """Return the plane of an image or stack at a viewer's ``dims.point``."""
    data = data_of(layer)
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
            "film, which darkens with dose, convert it to dose first (Plugins → Shadowinv → Film "
            "pack); if it is linear in fluence, split it (right click on the layer → Split RGB) "
            "and choose one channel"
        )
    return data_of(layer)


def cautions_of(layer: Any) -> tuple[Caution, ...]:
    """Return the warnings of a grey image's reader, or that it looks like scanned film."""
    metadata = about.metadata_of(layer)
    path = str(layer.source.path or "").lower()
    may_be_scan = path.endswith(tuple(SCAN_SUFFIXES)) and isinstance(layer.data, np.ndarray)
    # Other metadata, such as a setup, may come from the user.
    if about.role_of(layer) or not may_be_scan:
        return tuple(metadata.get("cautions", ()))
    return film_cautions(layer.data, None)


def painted_on(layer: Any | None, image: Any) -> BoolArray | None:
    """Return the pixels of an image (None for files) under labels or shapes; None without any."""
    if layer is None:
        return None
    if image is not None:
        _grey(image, "image")
    is_of_labels = kind_of(layer) == "labels"
    if is_of_labels and layer.ndim != 2:
        raise InputError(
            f"the mask '{layer.name}' has shape {tuple(layer.data.shape)}, expected one plane "
            "(y, x): press ✎ to paint labels of the image's size"
        )
    if is_of_labels:
        is_drawn = bool(np.any(layer.data))
        painted = np.asarray(layer.data) != 0 if image is None else labels_on(layer, image)
    elif image is None:
        raise InputError(
            f"the mask '{layer.name}' is drawn as shapes, whose place in files is unknown: "
            "press ✎ to paint labels of the shots' size"
        )
    else:
        is_drawn, painted = bool(len(layer.data)), _pixels_in_shapes(layer, image)
    if not is_drawn:
        return None
    if not painted.any():
        raise InputError(
            f"the mask '{layer.name}' lies beside the image '{image.name}': draw it on the image, "
            "or move it there (layer controls → transform)"
        )
    return painted


def _pixels_in_shapes(layer: Any, image: Any) -> BoolArray:
    shape = tuple(data_of(image).shape[-2:])
    if not len(layer.data):
        return np.zeros(shape, np.bool_)
    on_pixels = Shapes(_corners_in_pixels(layer, image), shape_type=list(layer.shape_type))
    return on_pixels.to_masks(mask_shape=shape).astype(np.bool_).any(axis=0)


def crop_of(layer: Any | None, image: Any) -> Crop | None:
    """Return the crop of an image to the selected shape, or else the last one."""
    if layer is None or not len(layer.data):
        return None
    selected = max(layer.selected_data, default=len(layer.data) - 1)
    corners = _corners_in_pixels(layer, image)[selected]
    least = np.ceil(corners.min(axis=0)).astype(int)
    most = np.floor(corners.max(axis=0)).astype(int) + 1
    y, x = (
        (int(np.clip(a, 0, side)), int(np.clip(b, 0, side)))
        for a, b, side in zip(least, most, image_of(image).shape, strict=True)
    )
    return Crop(y=y, x=x)


def _corners_in_pixels(layer: Any, image: Any) -> list[FloatArray]:
    """Return the corners of shapes in the pixels of an image, which may have another scale."""
    matrix = matrix_between(layer, image)
    return [mapped(matrix, shape) for shape in layer.data]


def new_mask(viewer: Any, image: Any, title: str, painted: BoolArray | None = None) -> Any:
    """Add labels of the size of an image or stack, painted or empty, with a title."""
    if painted is not None:
        labels = _add_layer(viewer, image, "labels", painted.astype(np.uint8), title)
    else:
        is_stack = image is not None and image.ndim == 3
        shape = (stack_of(image) if is_stack else image_of(image)).shape[-2:]
        labels = _add_layer(viewer, image, "labels", np.zeros(shape, np.uint8), title)
        labels.mode = "paint"
    labels.metadata = about.metadata_for(about.MASK, "")
    return labels


def new_crop(viewer: Any, image: Any, region: tuple[slice, slice]) -> Any:
    """Add shapes with a rectangle around rows and columns of an image."""
    shapes = new_shapes(viewer, image, "crop", "pan_zoom")
    (top, bottom), (x_low, x_high) = ((axis.start - 0.5, axis.stop - 0.5) for axis in region)
    corners = [[top, x_low], [top, x_high], [bottom, x_high], [bottom, x_low]]
    shapes.add_rectangles(np.array(corners))
    return shapes


def new_shapes(viewer: Any, image: Any, title: str, mode: str) -> Any:
    """Add empty shapes with a title, in a mode such as ``"add_rectangle"``."""
    shapes = _add_layer(viewer, image, "shapes", None, title, ndim=2)
    shapes.current_face_color = "transparent"
    shapes.current_edge_color = "yellow"
    shapes.current_edge_width = max(image.data.shape[-2:]) / 200
    shapes.mode = mode
    return shapes


def _add_layer(viewer: Any, image: Any, kind: str, data: Any, title: str, **keywords: Any) -> Any:
    keywords["name"] = title
    if image is not None:  # None for files
        name = about.layer_name(title, name_of_result(image))
        keywords |= {"name": name, **about.frame_of(image).keywords()}
    layer = Layer.create(data, keywords, kind)
    viewer.layers.append(layer)
    viewer.layers.selection.active = layer
    return layer


_BLOCK_PX = 8
_MIN_STRUCTURE_RATIO, _MIN_RATIO_OF_PAIR = 2.0, 1.2


LAYER = "layer"
"""The kind of a choice that is a layer."""


class LayerPicker(ModelPicker):
    """A choice of a viewer's layers, of the types `kinds` and if they suit, or of other `entries`.

    `none` is the entry for no layer. Without it, the latest layer is selected until one is chosen.
    """

    edited = Signal()  # the data of the selected layer have changed

    def __init__(
        self,
        viewer: Any,
        tip: str,
        none: str = "",
        suits: Callable[[Any], bool] = lambda _: True,
        *,
        kinds: tuple[str, ...] = ("image",),
        label: str | None = None,
        entries: Kinds | None = None,
    ) -> None:
        self._viewer, self._types, self._none = without_proxy(viewer), kinds, none
        self._suits = suits
        entries = entries or {"": (none or "none yet", None), LAYER: ("", None)}
        super().__init__(label, entries, tip)
        qt.while_alive(self, viewer.layers, ("inserted", "removed"), self.fill)
        qt.layers_while_alive(self, viewer.layers, "name", self.fill)
        qt.layers_while_alive(self, viewer.layers, ("data", "paint"), self._on_edit)

    @property
    def offered(self) -> list[Any]:
        """The layers to choose from."""
        layers = [layer for layer in self._viewer.layers if kind_of(layer) in self._types]
        return [layer for layer in layers if self._suits(layer)]

    @property
    def layer(self) -> Any | None:
        """The selected layer; None for no layer, or for another kind."""
        value = self.choice.value
        return None if isinstance(value, str) else value

    @layer.setter
    def layer(self, layer: Any | None) -> None:
        self.set_kind("" if layer is None else layer)

    @property
    def kind(self) -> str:
        return super().kind if self.layer is None else LAYER

    def _entries(self, kind: str) -> list[tuple[str, Any]]:
        if kind == LAYER:
            # The box has one entry for each title.
            taken = {title for title, _ in self._kinds.values()}
            return [
                (f"layer {layer.name}" if layer.name in taken else layer.name, layer)
                for layer in self.offered
            ]
        return super()._entries(kind) if kind or self._none or not self.offered else []

    def _preferred(self, before: Any) -> Sequence[Any]:
        default = () if self._none else reversed(self.offered)
        return self.chosen, before, *default, *self._kinds

    def _on_edit(self, event: Any) -> None:
        if event.source is self.layer:
            self.edited.emit()


# Whole words of a name: 'ref_3', 'shotBeam', but not 'refraction'.
_BEAM_NAME = re.compile(
    r"(?<![a-z])(ref|reference|beam|flat|flat.?field|source|bg|background|blank)s?(?![a-z])"
)
_DARK_NAME = re.compile(r"(?<![a-z])darks?(?![a-z])")


def likely_beam(image: Any, offered: Sequence[Any]) -> Any | None:
    """Return the only offered layer that may be an image's beam, by its size, name and structure.

    An image of a result has the result's own. Without a name, the beam is the smoother of two
    images, and much smoother if both are numbered in one series.
    """
    if (result := about.result_of(image)) is not None:
        recorded = [layer for layer in offered if about.result_of(layer) is result]
        return next((layer for layer in recorded if about.role_of(layer) == about.SOURCE), None)
    fitting = [
        layer
        for layer in offered
        if layer is not image
        and not (about.belongs_to_result(layer) or layer.rgb)
        and not about.is_estimate(layer)
        and layer.ndim == 2
        and layer.data.shape == tuple(data_of(image).shape[-2:])
        and not _has_word(layer, _DARK_NAME)
        # 'shot high-pass' is a filtered copy, while napari itself adds ' [1]'.
        and (_is_beam(layer) or not re.match(rf"{re.escape(image.name)} [^\[]", layer.name))
    ]
    beams = [layer for layer in fitting if _is_beam(layer)]
    if len(beams or fitting) != 1:
        return None
    (beam,) = beams or fitting
    is_of_series = re.sub(r"\d", "", beam.name) == re.sub(r"\d", "", image.name)
    return beam if beams or is_rather_shot(image, beam, is_pair=not is_of_series) else None


def is_rather_shot(layer: Any, other: Any, *, is_pair: bool = False) -> bool:
    """Whether of two images a layer is the one with an object; a pair may differ less."""
    is_aside, other_is_aside = (
        _is_beam(each) or _has_word(each, _DARK_NAME) for each in (layer, other)
    )
    if is_aside != other_is_aside:
        return other_is_aside
    is_pair &= layer.data.shape == other.data.shape
    ratio = _MIN_RATIO_OF_PAIR if is_pair else _MIN_STRUCTURE_RATIO
    return _structure(layer) > ratio * _structure(other)


def _is_beam(layer: Any) -> bool:
    return about.role_of(layer) == about.SOURCE or _has_word(layer, _BEAM_NAME)


def _has_word(layer: Any, words: re.Pattern[str]) -> bool:
    return bool(words.search(re.sub(r"(?<=[a-z])(?=[A-Z])", "_", layer.name).lower()))


def _structure(layer: Any) -> float:
    """Return the relative r.m.s. of structures between noise and the beam's shape; or NaN."""
    data = layer.data
    if not isinstance(data, np.ndarray) or data.ndim != 2 or min(data.shape) < 4 * _BLOCK_PX:
        return np.nan
    means = complete_block_means(data, _BLOCK_PX)
    mean = means.mean()
    if not np.isfinite(mean) or mean <= 0:
        return np.nan
    y, x = np.mgrid[-1 : 1 : means.shape[0] * 1j, -1 : 1 : means.shape[1] * 1j].reshape(2, -1)
    beam = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=1)
    smooth = beam @ np.linalg.lstsq(beam, means.ravel(), rcond=None)[0]
    return float(np.std(means.ravel() - smooth) / mean)


class MaskPicker(LayerPicker):
    """A layer of painted pixels, which are not used, for the image that `image` returns."""

    def __init__(
        self, viewer: Any, image: Callable[[], Any], tip: str, title: str = "Mask"
    ) -> None:
        kinds = "labels", "shapes"
        super().__init__(viewer, tip, "none", about.may_be_mask, kinds=kinds, label=title)
        self._image, self.title = image, title
        self.add_button("✎", f"Paint a {title.lower()}.", self.paint)

    def usable(self, image: Any) -> BoolArray | None:
        """Return the usable pixels of an image layer, of a stack's planes, or of files (None)."""
        painted = painted_on(self.layer, image)
        unpainted = None if painted is None else ~painted
        return join_masks(unpainted, None if image is None else about.usable_of(image))

    def summary(self, image: Any) -> str:
        """Return the layer's name and the share of excluded pixels; empty if there are none."""
        usable = self.usable(image)
        if usable is None:
            return ""
        is_supplied = image is not None and about.usable_of(image) is not None
        names = [] if self.layer is None else [f"layer '{self.layer.name}'"]
        names += ["the film's mask"] if is_supplied else []
        return f"{' and '.join(names)}, excludes {percent(1 - usable.mean())} of the pixels"

    def follow(self, image: Any) -> None:
        """Select the mask that came with an image's file, if there is one."""
        path = about.metadata_of(image).get("path")
        for layer in self._viewer.layers if path else ():
            metadata = about.metadata_of(layer)
            if metadata.get("role") == about.MASK and metadata.get("path") == path:
                self.layer = layer

    @qt.notify_errors
    def paint(self) -> None:
        self.layer = new_mask(self._viewer, self._image(), self.title.lower())
