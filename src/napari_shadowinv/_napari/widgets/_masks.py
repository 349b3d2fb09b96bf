"""Which pixels to leave out: `MaskPicker`."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from qtpy.QtCore import Signal
from qtpy.QtWidgets import QCheckBox, QVBoxLayout, QWidget

from napari_shadowinv._napari.layer_metadata import MASK, mark_of, may_be_mask, role_of
from napari_shadowinv._napari.widgets._base import with_button
from napari_shadowinv._napari.widgets._drawing import new_mask
from napari_shadowinv._napari.widgets._forms import labelled
from napari_shadowinv._napari.widgets._notifications import notify_errors
from napari_shadowinv._napari.widgets._picking import LayerPicker
from napari_shadowinv._napari.widgets._reading import Mask, mask_of

__all__ = ["MaskPicker"]


class MaskPicker(QWidget):
    """A layer that is painted on, and what the paint means.

    Parameters
    ----------
    viewer : napari.Viewer
        Its layers are offered.
    image : callable
        Returns the image layer that a new mask is for.
    kinds : tuple of str
        Layer types that may be a mask.
    tip : str
        What is to be marked.
    title : str
        What it is called in the window; names of new layers end with it.

    Signals
    -------
    picked
        Another layer, or none, is chosen.
    changed
        As well, or the paint means something else.
    """

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
        self._viewer, self._image, self._title = viewer, image, title
        self.layers = LayerPicker(viewer, kinds, none="none", suits=may_be_mask)
        self.layers.setToolTip(f"<qt>{tip}</qt>")
        self.painted_is_unusable = QCheckBox("painted = unusable")
        self.painted_is_unusable.setChecked(True)
        self.painted_is_unusable.setToolTip(
            "<qt>Checked: painted pixels are excluded (handwriting, dead pixels). Unchecked: "
            "only painted pixels are used. Set opaque obstacles to zero in the source "
            "instead.</qt>"
        )
        column = QVBoxLayout(self)
        column.setContentsMargins(0, 0, 0, 0)
        for row in (
            labelled(title, with_button(self.layers, "✎", f"Paint a {title.lower()}.", self.paint)),
            labelled("", self.painted_is_unusable),
        ):
            column.addWidget(row)
        self.layers.picked.connect(self.picked)
        self.layers.picked.connect(self.changed)
        self.painted_is_unusable.toggled.connect(self.changed)

    @property
    def layer(self) -> Any | None:
        """The chosen layer."""
        return self.layers.layer

    @layer.setter
    def layer(self, layer: Any | None) -> None:
        self.layers.layer = layer

    def usable(self, image: Any) -> Mask | None:
        """Usable pixels of an image layer, or of each image of a stack or of files (None).

        Raises
        ------
        InputError
            If the mask is not of the image's shape.
        """
        return mask_of(self.layer, image, self.painted_is_unusable.isChecked())

    def described(self, image: Any) -> str:
        """Which layer it is, and how much it leaves out; empty for none, or nothing painted.

        Parameters and errors are those of `usable`.
        """
        usable = self.usable(image)
        if usable is None or self.layer is None:
            return ""
        return f"layer '{self.layer.name}', excludes {1 - usable.mean():.1%} of the pixels"

    def follow(self, image: Any) -> None:
        """Choose the mask that came with an image's file, if one did."""
        path = mark_of(image).get("path")
        for layer in self._viewer.layers:
            if path and role_of(layer) == MASK and mark_of(layer).get("path") == path:
                self.layer = layer
                self.painted_is_unusable.setChecked(True)

    def state(self) -> bool:
        """What is kept: layers belong to a session."""
        return bool(self.painted_is_unusable.isChecked())

    def restore(self, state: Any) -> None:
        """Show what `state` has returned."""
        self.painted_is_unusable.setChecked(bool(state))

    @notify_errors
    def paint(self) -> None:
        """Add an empty mask and choose it."""
        self.layer = new_mask(self._viewer, self._image(), self._title.lower())
