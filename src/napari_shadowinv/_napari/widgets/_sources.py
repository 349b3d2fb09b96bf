"""Where the undisturbed beam comes from: `SourcePicker`."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from numpy.typing import ArrayLike

from napari_shadowinv._napari.marks import source_of
from napari_shadowinv._napari.widgets._base import PathEdit
from napari_shadowinv._napari.widgets._forms import RowPicker, kinds_of, labelled
from napari_shadowinv._napari.widgets._picking import LayerPicker
from napari_shadowinv._napari.widgets._reading import image_of
from napari_shadowinv.errors import InputError
from napari_shadowinv.recipes import ESTIMATES, Estimate

__all__ = ["SourcePicker"]

_OWN, _LAYER, _FILE = "own", "layer", "file"


class SourcePicker(RowPicker):
    """Uniform, a layer, a file, what came with the shot, or an estimate from it.

    Signals
    -------
    changed
        Another source, or another parameter of its estimate.
    """

    def __init__(self, viewer: Any) -> None:
        self.layers = LayerPicker(viewer, ("image",))
        self.layers.setToolTip("Image layer of the undisturbed beam.")
        self.file = PathEdit("Image of the undisturbed beam")
        kinds = kinds_of(ESTIMATES, "estimate: ")
        _, uniform = kinds.pop("uniform")
        super().__init__(
            "Source",
            {
                "uniform": ("uniform", uniform),
                _LAYER: ("a layer", None),
                _FILE: ("a file", None),
                _OWN: ("the one that came with the shot", None),
                **kinds,
            },
            "The beam without the object. Best is a measured reference image; without one "
            "it is uniform, or estimated from the shot itself.",
            {_LAYER: labelled("", self.layers), _FILE: labelled("", self.file)},
        )
        self.layers.picked.connect(self.changed)
        self.file.changed.connect(self.changed)

    def source(self, image_layer: Any) -> ArrayLike | Path | Estimate:
        """The chosen source of an image layer, as a job takes it.

        Raises
        ------
        InputError
            If there is none of the chosen kind.
        """
        kind = self.picker.kind
        if kind == _LAYER:
            return image_of(self.layers.layer, "source image")
        if kind == _FILE:
            if not self.file.path:
                raise InputError("no file of the source is given: choose one, or another source")
            return Path(self.file.path)
        if kind == _OWN:
            own = source_of(image_layer)
            if own is None:
                raise InputError(
                    f"no source came with '{image_layer.name}': choose another kind of source"
                )
            return own
        model = self.picker.model()
        assert isinstance(model, Estimate)
        return model

    def state(self) -> dict[str, Any]:
        """What is kept: layers and files belong to a session."""
        kept = self.picker.state()
        return {**kept, "kind": "uniform"} if kept["kind"] in (_LAYER, _FILE, _OWN) else kept

    def restore(self, state: Mapping[str, Any]) -> None:
        """Show what `state` has returned."""
        self.picker.restore(state)

    def follow(self, image_layer: Any) -> None:
        """Take the source that came with an image, or leave that of another image."""
        if source_of(image_layer) is not None:
            self.picker.set_kind(_OWN)
        elif self.picker.kind == _OWN:
            self.picker.set_kind("uniform")
