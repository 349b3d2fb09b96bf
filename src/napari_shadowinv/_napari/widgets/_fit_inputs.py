"""Inputs of a fit other than its images: `BeamPicker`, `ChoiceBox`, `fields_of`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from qtpy.QtCore import QSignalBlocker

from napari_shadowinv._napari import layer_metadata as about
from napari_shadowinv._napari.shots import source_of_shot
from napari_shadowinv._napari.widgets import _forms as forms
from napari_shadowinv._napari.widgets import _layers as layers
from napari_shadowinv._napari.widgets._editors import SteadyComboBox
from napari_shadowinv.errors import InputError
from napari_shadowinv.options import FIELDS
from napari_shadowinv.physics.setup import SETUPS
from napari_shadowinv.preprocessing import Estimate, MeasuredSource, Radiograph, UniformEstimate

_UNIFORM, _LAYER, UNKNOWN = "uniform", "layer", "unknown"
_TITLES = {
    "B": "magnetic field (B)",
    "E": "electric field (E)",
    "plasma": "plasma (phase ∝ λ²)",
    "phase": "refractive index (phase)",
}
BOTH = " and "
NOISES = {
    "": "estimated from each image",
    "poisson": "Poisson counts",
    "proportional": "proportional to each pixel (film)",
}


class BeamPicker(forms.RowPicker):
    """The undisturbed beam: uniform, a layer, or unknown."""

    def __init__(self, viewer: Any) -> None:
        tip = "Image layer of the undisturbed beam, or a stack with one for each image."
        self.layers = layers.LayerPicker(
            viewer, ("image",), tip, "choose a layer", about.may_be_source
        )
        super().__init__(
            "Source",
            {
                _UNIFORM: ("uniform", None),
                _LAYER: ("a layer", None),
                UNKNOWN: ("unknown (fit it)", None),
            },
            "The beam without the object. An unknown beam is fitted as a smooth beam, the same in "
            "all images except for its brightness.",
            {_LAYER: forms.labelled("", self.layers)},
        )
        self.layers.picked.connect(self.changed)

    @property
    def layer(self) -> Any | None:
        """The selected layer; None for another kind of source."""
        return self.layers.layer if self.picker.kind == _LAYER else None

    @property
    def summary(self) -> str:
        if self.layer is not None:
            return f"layer '{self.layer.name}'"
        return "fitted" if self.picker.kind == UNKNOWN else "uniform"

    def chosen(self) -> UniformEstimate | MeasuredSource | None:
        """Return the source as a recipe describes it; None if it is fitted."""
        if self.picker.kind == UNKNOWN:
            return None
        return MeasuredSource() if self.picker.kind == _LAYER else UniformEstimate()

    def measured(self, shots: Sequence[Radiograph]) -> list[Radiograph | None]:
        """Return the measured source of each image, or raise an `InputError`."""
        if self.picker.kind != _LAYER:
            return [None] * len(shots)
        layer = self.layer
        if layer is None:
            raise InputError(
                "no source layer is selected: choose a layer below 'a layer', or another kind of "
                "source"
            )
        if layer.ndim != 3:
            image = layers.image_of(layer, "source")
            return [source_of_shot(layer, image, shot) for shot in shots]
        planes = layers.stack_of(layer)
        if len(planes) != len(shots):
            raise InputError(
                f"'{layer.name}' has {len(planes)} sources for {len(shots)} images: expected one "
                "source for each image, or one for all"
            )
        return [
            source_of_shot(layer, plane, shot, k)
            for k, (plane, shot) in enumerate(zip(planes, shots, strict=True))
        ]

    def show(self, source: Estimate | MeasuredSource | None, beam: str) -> None:
        """Show the source of a recipe; None for uniform, unless the beam is unknown."""
        kind = _LAYER if isinstance(source, MeasuredSource) else _UNIFORM
        self.picker.set_kind(UNKNOWN if beam == "unknown" else kind)

    def state(self) -> str:
        """Return the kind; layers belong to a session."""
        kind = self.picker.kind
        return _UNIFORM if kind == _LAYER else kind

    def restore(self, state: Any) -> None:
        self.picker.set_kind(str(state))


class ChoiceBox(SteadyComboBox):
    """A choice that is saved between sessions."""

    def __init__(self, choices: dict[str, str], tip: str) -> None:
        super().__init__()
        self._selected: Any = None
        self.setToolTip(f"<qt>{tip}</qt>")
        self.offer(choices)
        self.activated.connect(self._on_choice)

    def offer(self, choices: dict[str, str]) -> None:
        """Replace the choices, titles by key; the selected key stays if it is offered."""
        with QSignalBlocker(self):
            self.clear()
            for key, title in choices.items():
                self.addItem(title, key)
            self.setCurrentIndex(max(self.findData(self._selected), 0))

    def state(self) -> str:
        return str(self.currentData())

    def restore(self, state: Any) -> None:
        """Select a key, now or once it is offered."""
        self._selected = state
        index = self.findData(state)
        if index >= 0:
            self.setCurrentIndex(index)

    def _on_choice(self) -> None:
        self._selected = self.currentData()


def fields_of(kind: str) -> dict[str, str]:
    """Return the fields that can deflect in a kind of setup, titles by key."""
    if kind not in SETUPS:
        return {"B": "one field, in pixels"}
    keys = [key for key, deflector in FIELDS.items() if deflector in SETUPS[kind].deflectors]
    choices = {key: _TITLES[key] for key in keys}
    return choices | ({BOTH.join(keys): BOTH.join(keys)} if len(keys) > 1 else {})


def field_key(fields: Sequence[str]) -> str:
    return BOTH.join(key for key in FIELDS if key in fields)
