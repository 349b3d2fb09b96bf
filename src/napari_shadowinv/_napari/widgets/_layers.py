"""Layers: which ones a widget works on, what is in them, new ones to draw on."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from qtpy.QtCore import QObject, QSignalBlocker, Signal
from qtpy.QtWidgets import QCheckBox, QWidget

from napari_shadowinv._napari import layer_metadata as about
from napari_shadowinv._napari.frame import frame_of
from napari_shadowinv._napari.widgets._fields import SteadyComboBox
from napari_shadowinv._napari.widgets._forms import labelled, with_button
from napari_shadowinv._napari.widgets._qt import column, notify_errors, while_alive
from napari_shadowinv._typing import BoolArray, FloatArray
from napari_shadowinv.cautions import Caution
from napari_shadowinv.errors import InputError
from napari_shadowinv.io.colours import film_warnings
from napari_shadowinv.io.formats import SCAN_SUFFIXES


def kind_of(layer: Any) -> str:
    """Return a layer's type, such as ``"image"`` or ``"labels"``."""
    # Not by type(): a widget may be handed a proxy, which tells its content's class only here.
    return str(layer.__class__.__name__).lower()


def image_of(layer: Any | None, role: str = "image") -> Any:
    """The 2-D array of a grey image, not read yet if it is lazy; `role` is for the message."""
    data = _grey(layer, role)
    assert layer is not None
    if data.ndim != 2:
        raise InputError(
            f"'{layer.name}' has shape {tuple(data.shape)}, expected one image (y, x): "
            "split the stack (right click on the layer → Split Stack) and choose one shot"
        )
    return data


def stack_of(layer: Any | None) -> Any:
    """The 3-D array (shot, y, x) of grey images, not read yet if it is lazy."""
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
    """The plane of an image, or of a stack of them, shown at a viewer's ``dims.point``."""
    data = _data_of(layer)
    if data.ndim == 2:
        return data
    at = np.round(layer.world_to_data(point[-layer.ndim :])[:-2]).astype(int)
    return data[tuple(np.clip(at, 0, np.array(data.shape[:-2]) - 1))]


def _data_of(layer: Any) -> Any:
    return layer.data[0] if getattr(layer, "multiscale", False) else layer.data


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
            "(napari_shadowinv.film); if it is linear in fluence, "
            "split it (right click on the layer → Split RGB) and choose one channel"
        )
    return _data_of(layer)


def warnings_of(layer: Any) -> tuple[Caution, ...]:
    """What the reader of a grey image said against it, or that it looks like scanned film."""
    known = about.mark_of(layer)
    path = str(layer.source.path or "").lower()
    # What else is known of a layer, such as a setup, may be the user's.
    if (
        about.role_of(layer)
        or not path.endswith(tuple(SCAN_SUFFIXES))
        or not isinstance(layer.data, np.ndarray)
    ):
        return tuple(known.get("warnings", ()))
    return film_warnings(layer.data, None)


def mask_of(layer: Any | None, image: Any, painted_is_unusable: bool) -> BoolArray | None:
    """Usable pixels of an image (None for files) by labels or shapes; None if all are."""
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
    """Rows and columns of an image in the selected, or else the last, of the drawn shapes."""
    if layer is None or not len(layer.data):
        return None
    chosen = max(layer.selected_data, default=len(layer.data) - 1)
    corners = _in_pixels(layer, image)[chosen]
    least = np.ceil(corners.min(axis=0)).astype(int)
    most = np.floor(corners.max(axis=0)).astype(int) + 1
    rows, columns = (
        slice(int(np.clip(a, 0, side)), int(np.clip(b, 0, side)))
        for a, b, side in zip(least, most, image_of(image).shape, strict=True)
    )
    return rows, columns


def _drawn(layer: Any, image: Any, shape: tuple[int, ...]) -> BoolArray:
    if not len(layer.data):
        return np.zeros(shape, bool)
    from napari.layers import Shapes

    on_pixels = Shapes(_in_pixels(layer, image), shape_type=list(layer.shape_type))
    masks: BoolArray = np.asarray(on_pixels.to_masks(mask_shape=shape), dtype=np.bool_)
    return np.asarray(masks.any(axis=0))


def _in_pixels(layer: Any, image: Any) -> list[FloatArray]:
    """Corners of shapes in the pixels of an image that may be scaled differently."""
    return [
        np.array([image.world_to_data(layer.data_to_world(corner))[-2:] for corner in shape])
        for shape in layer.data
    ]


def new_mask(viewer: Any, image: Any, title: str, painted: BoolArray | None = None) -> Any:
    """Add labels of an image's or a stack's size, painted or ready to be; named with `title`."""
    if painted is not None:
        labels = _added(viewer, image, "labels", painted.astype(np.uint8), title)
    else:
        is_stack = image is not None and image.ndim == 3
        shape = (stack_of(image) if is_stack else image_of(image)).shape[-2:]
        labels = _added(viewer, image, "labels", np.zeros(shape, np.uint8), title)
        labels.mode = "paint"
    labels.metadata = about.mark(about.MASK, "")
    return labels


def new_crop(viewer: Any, image: Any, part: tuple[slice, slice]) -> Any:
    """Add shapes with a rectangle around rows and columns of an image."""
    shapes = new_shapes(viewer, image, "crop", "pan_zoom")
    (top, bottom), (left, right) = ((one.start - 0.5, one.stop - 0.5) for one in part)
    shapes.add_rectangles(np.array([[top, left], [top, right], [bottom, right], [bottom, left]]))
    return shapes


def new_shapes(viewer: Any, image: Any, title: str, mode: str) -> Any:
    """Add empty shapes with a tool such as ``"add_rectangle"``; their name ends with `title`."""
    shapes = _added(viewer, image, "shapes", None, title, ndim=2)
    shapes.current_face_color = "transparent"
    shapes.current_edge_color = "yellow"
    shapes.current_edge_width = max(image.data.shape[-2:]) / 200
    shapes.mode = mode
    return shapes


def _added(viewer: Any, image: Any, kind: str, data: Any, title: str, **keywords: Any) -> Any:
    from napari.layers import Layer

    keywords["name"] = title
    if image is not None:  # files, whose images are no layers
        keywords |= {"name": f"{image.name} {title}", **frame_of(image).keywords()}
    layer = Layer.create(data, keywords, kind)
    viewer.layers.append(layer)
    viewer.layers.selection.active = layer
    return layer


_BLOCK_PX = 8
_MORE_STRUCTURE = 2.0  # as a ratio


class LayerPicker(SteadyComboBox):
    """A combo box of layers; `none` stands for no layer, without it the latest is chosen."""

    picked = Signal()

    def __init__(
        self,
        viewer: Any,
        kinds: tuple[str, ...],
        tip: str,
        none: str = "",
        suits: Callable[[Any], bool] = lambda _: True,
    ) -> None:
        super().__init__()
        self._viewer, self._kinds, self._none, self._suits = viewer, kinds, none, suits
        self.offered: list[Any] = []
        self.setToolTip(tip)
        self.fill()
        self.currentIndexChanged.connect(lambda _: self.picked.emit())
        for emitter in (viewer.layers.events.inserted, viewer.layers.events.removed):
            while_alive(self, emitter, self.fill)
        for layer in viewer.layers:
            while_alive(self, layer.events.name, self.fill)
        while_alive(self, viewer.layers.events.inserted, self._on_insertion)

    @property
    def layer(self) -> Any | None:
        index = self.currentIndex() - bool(self._none)
        return self.offered[index] if 0 <= index < len(self.offered) else None

    @layer.setter
    def layer(self, layer: Any | None) -> None:
        if layer is None:
            self.setCurrentIndex(0 if self._none else -1)
        elif layer in self.offered:
            self.setCurrentIndex(self.offered.index(layer) + bool(self._none))

    def _on_insertion(self, event: Any) -> None:
        while_alive(self, event.value.events.name, self.fill)

    def fill(self, event: Any = None) -> None:
        """Offer what the viewer has now; what is chosen stays while it is there."""
        before = self.layer
        offered = [
            layer
            for layer in self._viewer.layers
            if kind_of(layer) in self._kinds and self._suits(layer)
        ]
        with QSignalBlocker(self):
            self.clear()
            self.offered = offered
            if self._none:
                self.addItem(self._none)
            for layer in offered:
                self.addItem(layer.name)
            if before in offered:
                self.layer = before
            elif not self._none and offered:
                self.layer = offered[-1]
        if self.layer is not before:
            self.picked.emit()


class ShotPicker(LayerPicker):
    """A picker of the layer that is a shot.

    Until the user chooses one, it prefers an image with structure to one without: a reference
    that was opened first is no shot.
    """

    def __init__(self, viewer: Any) -> None:
        self.is_chosen = False
        super().__init__(
            viewer, ("image",), "The shot: a greyscale image layer.", suits=about.may_be_shot
        )
        self.activated.connect(self._choose)

    def _choose(self, _: int = 0) -> None:
        self.is_chosen = True

    def _on_insertion(self, event: Any) -> None:
        super()._on_insertion(event)
        chosen, new = self.layer, event.value
        if self.is_chosen or chosen is None or new is chosen or new not in self.offered:
            return
        if _structure(new) > _MORE_STRUCTURE * _structure(chosen) > 0:
            self.layer = new


def _structure(layer: Any) -> float:
    """Return the relative r.m.s. of structures between noise and the beam's shape; 0 if unknown."""
    data = layer.data
    if not isinstance(data, np.ndarray) or data.ndim != 2 or min(data.shape) < 4 * _BLOCK_PX:
        return 0.0
    height, width = (side // _BLOCK_PX * _BLOCK_PX for side in data.shape)
    blocks = data[:height, :width].reshape(height // _BLOCK_PX, _BLOCK_PX, -1, _BLOCK_PX)
    means = blocks.mean(axis=(1, 3), dtype=np.float64)
    mean = means.mean()
    if not np.isfinite(mean) or mean <= 0:
        return 0.0
    y, x = np.mgrid[-1 : 1 : means.shape[0] * 1j, -1 : 1 : means.shape[1] * 1j].reshape(2, -1)
    beam = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=1)
    fitted = beam @ np.linalg.lstsq(beam, means.ravel(), rcond=None)[0]
    return float(np.std(means.ravel() - fitted) / mean)


# By the mask's title: what paint marks, and what that means.
_PAINT = {
    "Mask": (
        "unusable",
        "Checked: painted pixels are excluded (handwriting, dead pixels). Unchecked: only painted "
        "pixels are used. Set opaque obstacles to zero in the source instead.",
    ),
    "Source mask": (
        "object",
        "Checked: the source is estimated from the pixels that are not painted. Unchecked: from "
        "those that are.",
    ),
}


class MaskPicker(QWidget):
    """A layer that is painted on, and what the paint means; it is for what `image` returns."""

    picked = Signal()
    changed = Signal()

    def __init__(
        self,
        viewer: Any,
        image: Callable[[], Any],
        kinds: tuple[str, ...],
        tip: str,
        title: str = "Mask",
    ) -> None:
        super().__init__()
        self._viewer, self._image, self.title = viewer, image, title
        self.layers = LayerPicker(viewer, kinds, f"<qt>{tip}</qt>", "none", about.may_be_mask)
        hides, meaning = _PAINT[title]
        self.painted_is_unusable = QCheckBox(f"painted = {hides}")
        self.painted_is_unusable.setChecked(True)
        self.painted_is_unusable.setToolTip(f"<qt>{meaning}</qt>")
        column(
            self,
            labelled(title, with_button(self.layers, "✎", f"Paint a {title.lower()}.", self.paint)),
            labelled("", self.painted_is_unusable),
        )
        self.layers.picked.connect(self.picked)
        self.layers.picked.connect(self.changed)
        self.painted_is_unusable.toggled.connect(self.changed)

    @property
    def layer(self) -> Any | None:
        return self.layers.layer

    @layer.setter
    def layer(self, layer: Any | None) -> None:
        self.layers.layer = layer

    def usable(self, image: Any) -> BoolArray | None:
        """Usable pixels of an image layer, or of each image of a stack or of files (None)."""
        painted = mask_of(self.layer, image, self.painted_is_unusable.isChecked())
        own = None if image is None else about.usable_of(image)
        if painted is None or own is None:
            return own if painted is None else painted
        return painted & own

    def described(self, image: Any) -> str:
        """Which layer it is, and how much it leaves out; empty for none, or nothing painted."""
        usable = self.usable(image)
        if usable is None:
            return ""
        own = image is not None and about.usable_of(image) is not None
        names = [] if self.layer is None else [f"layer '{self.layer.name}'"]
        names += ["the film's own"] if own else []
        return f"{' and '.join(names)}, excludes {1 - usable.mean():.1%} of the pixels"

    def follow(self, image: Any) -> None:
        """Choose the mask that came with an image's file, if one did."""
        path = about.mark_of(image).get("path")
        for layer in self._viewer.layers:
            if (
                path
                and about.role_of(layer) == about.MASK
                and about.mark_of(layer).get("path") == path
            ):
                self.layer = layer
                self.painted_is_unusable.setChecked(True)

    def state(self) -> bool:
        """What is kept: layers belong to a session."""
        return bool(self.painted_is_unusable.isChecked())

    def restore(self, state: Any) -> None:
        self.painted_is_unusable.setChecked(bool(state))

    @notify_errors
    def paint(self) -> None:
        self.layer = new_mask(self._viewer, self._image(), self.title.lower())


class LayerWatch(QObject):
    """Tells when something is painted, drawn or replaced in the layers that are chosen."""

    edited = Signal()

    def __init__(self, parent: QObject, pickers: Sequence[LayerPicker | MaskPicker]) -> None:
        super().__init__(parent)
        self._pickers = pickers
        self._watched: list[Any] = []
        for picker in pickers:
            picker.picked.connect(self._watch)
        self._watch()

    def _watch(self) -> None:
        for layer in [picker.layer for picker in self._pickers]:
            if layer is None or any(layer is known for known in self._watched):
                continue
            self._watched.append(layer)
            for name in ("data", "paint"):
                if hasattr(layer.events, name):
                    while_alive(self, getattr(layer.events, name), self._on_event)

    def _on_event(self, event: Any) -> None:
        if any(event.source is picker.layer for picker in self._pickers):
            self.edited.emit()
