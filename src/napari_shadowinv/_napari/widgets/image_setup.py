"""The setup of an image, stored with its layer: `ImageSetup`."""

from __future__ import annotations

from typing import Any

from napari_shadowinv._napari import form as forms
from napari_shadowinv._napari import layer_metadata as about
from napari_shadowinv._napari.widgets import _qt as qt
from napari_shadowinv._napari.widgets._inputs import SetupPicker
from napari_shadowinv._napari.widgets._layers import LayerPicker
from napari_shadowinv._napari.widgets._results import place_together
from napari_shadowinv.errors import InputError


class ImageSetup(qt.Docked):
    """Choose an image, enter its setup, and press Apply: all widgets then use the setup."""

    def __init__(self, viewer: Any) -> None:
        super().__init__()
        self.viewer = viewer
        self.image = LayerPicker(
            viewer,
            "Layer of an image, or of a stack of shots with a common setup.",
            suits=lambda layer: not about.belongs_to_result(layer),
        )
        self.setup = SetupPicker(until_run=True)
        self.status = forms.WrappingLabel()
        self.apply_button = qt.push_button(
            "Apply", "Store the setup with the image, and show the image at its scale.", self.apply
        )
        self._keeper = qt.StateKeeper(self, "image-setup", self.setup.state)
        image = forms.labelled("Image", self.image)
        self.area, _ = qt.scrolling_column(self, image, self.setup, self.apply_button, self.status)
        self._keeper.restore(self.setup.restore)
        self.image.picked.connect(self._follow)
        self.setup.changed.connect(self._keeper.changed)
        self._follow()

    @qt.notify_errors
    def choose(self, layer: Any) -> None:
        """Show the setup of a layer, or raise an `InputError` if it can have none."""
        if not any(layer is offered for offered in self.image.offered):
            raise InputError(
                f"layer '{layer.name}' is no image, or part of a result, which has its setup "
                "already: select an image"
                if layer is not None
                else "no layer is selected: select an image in the layer list"
            )
        self.image.layer = layer

    @qt.notify_errors
    def apply(self) -> None:
        """Store the setup with the image; place all images of its size."""
        layer: Any = self.image.layer
        if layer is None:
            raise InputError("there is no image: open one (File → Open), or a sample")
        setup = self.setup.setup()
        self.setup.keep()
        about.store_setup(layer, setup, self.setup.origin)
        if setup is None:
            self.status.show_text(f"'{layer.name}' has no setup now", "")
            return
        place_together(self.viewer, layer, setup, ())
        self.status.show_text(f"'{layer.name}' has this setup now", "")

    def show_problem(self, text: str) -> None:
        """Show a problem until another image is chosen."""
        self.status.show_text(text, forms.PROBLEM_STYLE)

    def _follow(self) -> None:
        self.status.show_text("", "")
        self.setup.follow(self.image.layer, store=False)
