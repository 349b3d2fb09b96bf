"""Where the undisturbed beam comes from: `SourcePicker`."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from napari_shadowinv._napari.layer_metadata import (
    SOURCE,
    mark_of,
    may_be_source,
    result_of,
    role_of,
    source_of,
)
from napari_shadowinv._napari.widgets._base import PathEdit
from napari_shadowinv._napari.widgets._forms import RowPicker, kinds_of, labelled
from napari_shadowinv._napari.widgets._picking import LayerPicker
from napari_shadowinv._napari.widgets._reading import image_of
from napari_shadowinv.errors import InputError
from napari_shadowinv.preprocessing import ESTIMATES, Estimate, check_masks

__all__ = ["SourcePicker"]

_OWN, _LAYER, _FILE = "own", "layer", "file"
# Estimates that do not look at the shot, so that no mask can mislead them.
_BLIND = ("uniform", "isotropic")


class SourcePicker(RowPicker):
    """Uniform, a layer, a file, what came with the shot, or an estimate from it.

    Signals
    -------
    changed
        Another source, or another parameter of its estimate.
    """

    def __init__(self, viewer: Any) -> None:
        self._image: Any = None
        self._before_own = "uniform"
        self.layers = LayerPicker(viewer, ("image",), none="choose a layer", suits=self._offers)
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
                _OWN: ("the one supplied with the shot", None),
                **kinds,
            },
            "The beam without the object: ideally a measured reference image, otherwise uniform "
            "or estimated from the shot itself.",
            {_LAYER: labelled("", self.layers), _FILE: labelled("", self.file)},
        )
        self.layers.picked.connect(self.changed)
        self.file.changed.connect(self.changed)

    @property
    def is_guessed(self) -> bool:
        """Whether it is an estimate from the shot, which a mask can keep from the object."""
        return self.picker.kind in ESTIMATES and self.picker.kind not in _BLIND

    @property
    def described(self) -> str:
        """Where the source comes from."""
        kind = self.picker.kind
        if kind == _LAYER and self.layers.layer is not None:
            return f"layer '{self.layers.layer.name}'"
        if kind == _FILE:
            return f"file {Path(self.file.path).name}"
        if kind == _OWN:
            return "came with the shot"
        model = self.picker.model()
        assert isinstance(model, Estimate)
        return f"estimate: {model.described}" if self.is_guessed else model.described

    def source(self, image_layer: Any) -> ArrayLike | Path | Estimate:
        """The chosen source of an image layer, as a job takes it.

        Raises
        ------
        InputError
            If there is none of the chosen kind.
        """
        kind = self.picker.kind
        if kind == _LAYER:
            return image_of(self._chosen(), "source image")
        if kind == _FILE:
            if not self.file.path:
                raise InputError("no source file is selected: choose one, or choose another source")
            return Path(self.file.path)
        if kind == _OWN:
            own = source_of(image_layer)
            if own is None:
                raise InputError(
                    f"'{image_layer.name}' has no source of its own: choose another kind of source"
                )
            return own
        model = self.picker.model()
        assert isinstance(model, Estimate)
        return model

    def _chosen(self) -> Any:
        if self.layers.layer is None:
            raise InputError(
                "no source layer is selected: choose one below 'a layer', or choose another source"
            )
        return self.layers.layer

    def check(self, mask: NDArray[np.bool_] | None) -> None:
        """Refuse a mask over what the chosen layer was estimated without.

        Raises
        ------
        InputError
            If the object, hidden from the estimate, would be left out of the inversion, too.
        """
        layer = self.layers.layer if self.picker.kind == _LAYER else None
        bare = None if layer is None else mark_of(layer).get("source_mask")
        if bare is not None and mask is not None and bare.shape == mask.shape:
            check_masks(mask, bare)

    def state(self) -> dict[str, Any]:
        """What is kept: layers and files belong to a session."""
        kept = self.picker.state()
        kind = self._before_own if kept["kind"] == _OWN else kept["kind"]
        return {**kept, "kind": "uniform" if kind in (_LAYER, _FILE) else kind}

    def restore(self, state: Mapping[str, Any]) -> None:
        """Show what `state` has returned."""
        self.picker.restore(state)

    def follow(self, image_layer: Any) -> None:
        """Take the source that came with an image, or leave that of another image."""
        self._image = image_layer
        self.layers.fill()
        if image_layer is not None and source_of(image_layer) is not None:
            if self.picker.kind != _OWN:
                self._before_own = self.picker.kind
            self.picker.set_kind(_OWN)
        elif self.picker.kind == _OWN:
            self.picker.set_kind(self._before_own)

    def _offers(self, layer: Any) -> bool:
        # An image is not its own source: it would differ from it nowhere.
        return layer != self._image and may_be_source(layer)

    def _on_kind(self) -> None:
        if self.picker.kind == _LAYER and self.layers.layer is None:
            self.layers.layer = self._only_source()
        super()._on_kind()

    def _only_source(self) -> Any | None:
        """The layer that is known to be a source and fits the image, if there is just one.

        The source of a result does not count: it is what some other run made of one.
        """
        shape = None if self._image is None else tuple(self._image.data.shape[-2:])
        known = [
            layer
            for layer in self.layers.offered
            if role_of(layer) == SOURCE
            and result_of(layer) is None
            and tuple(layer.data.shape[-2:]) == shape
        ]
        return known[0] if len(known) == 1 else None
