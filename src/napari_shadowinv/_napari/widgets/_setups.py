"""The experiment's geometry: `SetupPicker`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from qtpy.QtCore import QSignalBlocker, Signal
from qtpy.QtWidgets import QVBoxLayout, QWidget

from napari_shadowinv._napari.layer_metadata import CAME_WITH, keep_setup, setup_of, setup_origin_of
from napari_shadowinv._napari.widgets._forms import ModelPicker, kinds_of, wrapping_label
from napari_shadowinv._napari.widgets._toml import TomlButtons
from napari_shadowinv.errors import InputError
from napari_shadowinv.physics.setup import SETUPS, Setup, setup_from_dict

__all__ = ["SetupPicker"]

_NONE = "none"
_CHANGED = ", changed by hand"
_EARLIER = ", in an earlier session"


@dataclass(frozen=True)
class _Given:
    """What a form holds, and where that comes from."""

    values: dict[str, Any]
    origin: str


class SetupPicker(QWidget):
    """No setup or one of a kind, with buttons for TOML files.

    A setup belongs to an image: it is kept with the image's layer, and another image without
    one starts with none. What the user has typed or loaded for one image is in the form when
    he chooses its kind for the next, in the next session too; a line tells where
    it comes from. What came with a file is never handed on.

    Signals
    -------
    changed
        Another setup.
    """

    changed = Signal()

    def __init__(self) -> None:
        super().__init__()
        self._layer: Any = None
        self._name, self._keeps = "", True
        self._own: dict[str, _Given] = {}
        self._shown: dict[str, _Given] = {}
        self.picker = ModelPicker(
            "Setup", {_NONE: ("none: results in pixels", None), **kinds_of(SETUPS)}
        )
        self.picker.choice.setToolTip(
            "<qt>With a setup the results are in SI units; lengths can be entered as 1.3 mm or "
            "0.0013.</qt>"
        )
        self.note = wrapping_label()
        self.files = TomlButtons("setup", self._to_save, self._take)
        column = QVBoxLayout(self)
        column.setContentsMargins(0, 0, 0, 0)
        for widget in (self.picker, self.note, self.files):
            column.addWidget(widget)
        self._state = self.picker.state()
        self.picker.changed.connect(self._on_edit)

    def setup(self) -> Setup | None:
        """The validated setup.

        Raises
        ------
        InputError
            If something is missing or cannot be used.
        """
        return self.picker.model()  # type: ignore[return-value]

    @property
    def origin(self) -> str:
        """Where the setup comes from, such as ``"typed for 'shot'"``; empty for none."""
        if self.picker.kind == _NONE:
            return ""
        given = self._shown.get(self.picker.kind)
        return self._typed() if given is None else given.origin

    @property
    def described(self) -> str:
        """The kind of setup, and where it comes from."""
        kind = self.picker.choice.currentText()
        return f"{kind}, {self.origin}" if self.origin else kind

    def state(self) -> dict[str, Any]:
        """What is kept: what the user gave. Whether it is chosen is a matter of the image."""
        return {
            "own": {
                kind: {"values": given.values, "origin": given.origin}
                for kind, given in self._own.items()
            }
        }

    def restore(self, state: Mapping[str, Any]) -> None:
        """Have ready what `state` has returned; none is chosen."""
        own = state.get("own")
        for kind, given in own.items() if isinstance(own, Mapping) else ():
            origin = str(given["origin"]).removesuffix(_EARLIER) + _EARLIER
            self._own[kind] = _Given(dict(given["values"]), origin)
        self._show(_NONE)

    def follow(self, layer: Any, name: str = "", *, keep: bool = True) -> None:
        """Show the setup of another image.

        Parameters
        ----------
        layer : napari.layers.Image or None
            The image.
        name : str
            What to call images that are not a layer.
        keep : bool
            Whether what the user chooses from now on is kept with the layer.
        """
        if layer == self._layer and name == self._name:
            return
        # Files may be named after their setup is typed.
        stays = layer is None and self._layer is None and not self._name
        self._layer, self._name, self._keeps = layer, name, keep
        setup = None if layer is None else setup_of(layer)
        if setup is not None:
            self.suggest(setup, setup_origin_of(layer) or f"{CAME_WITH} '{layer.name}'")
        elif not stays:
            self._show(_NONE)
            self.changed.emit()

    def suggest(self, setup: Setup, origin: str) -> None:
        """Show a setup that is not the user's own, until he changes it.

        Parameters
        ----------
        setup : Setup
            The setup.
        origin : str
            Where it comes from.
        """
        self._show(setup.kind, _Given(setup.model_dump(), origin))
        self.changed.emit()

    def show_setup(self, values: Mapping[str, Any], origin: str = "") -> None:
        """Fill in a setup that the user gives.

        Parameters
        ----------
        values : mapping of str to object
            The setup, as a TOML file or a model's dump holds it.
        origin : str
            Where it comes from. Default: the user has typed it.
        """
        kind = str(values["kind"])
        given = _Given(dict(values), origin or self._typed())
        self._show(kind, given)
        self._remember(kind, given)
        self._keep_with_image()
        self.changed.emit()

    def _show(self, kind: str, given: _Given | None = None) -> None:
        """Fill in one setup, or none, and for the other kinds what the user gave last."""
        self._shown = {**self._own} | ({} if given is None else {kind: given})
        blank: dict[str, Any] = {known: {} for known in self.picker.state()["values"]}
        values = blank | {known: held.values for known, held in self._shown.items()}
        with QSignalBlocker(self.picker):
            self.picker.restore({"kind": kind, "values": values})
        self._tell()

    def _on_edit(self) -> None:
        """Take in what the user has chosen or typed."""
        kind, before = self.picker.kind, self._state
        values = self.picker.state()["values"].get(kind, {})
        # To look at another form, or to leave a field as it was, is no change of values.
        if kind == before["kind"] and values != before["values"].get(kind):
            self._remember(kind, _Given(values, self._origin_after(self._shown.get(kind))))
        self._tell()
        self._keep_with_image()
        self.changed.emit()

    def _origin_after(self, shown: _Given | None) -> str:
        """Where a setup comes from that the user has changed."""
        if shown is None or shown.origin.startswith("typed"):
            return self._typed()
        return shown.origin.removesuffix(_CHANGED) + _CHANGED

    def _remember(self, kind: str, given: _Given) -> None:
        """Keep what is shown for other images, if it is the user's own."""
        self._shown[kind] = given
        if not given.origin.startswith(CAME_WITH):
            self._own[kind] = given

    def _keep_with_image(self) -> None:
        if self._layer is None or not self._keeps:
            return
        try:
            setup = self.setup()
        except InputError:
            return  # half a setup: the image keeps the one it has
        if setup != setup_of(self._layer) or self.origin != setup_origin_of(self._layer):
            keep_setup(self._layer, setup, self.origin)

    def _typed(self) -> str:
        name = self._name if self._layer is None else self._layer.name
        return f"typed for '{name}'" if name else "typed"

    def _tell(self) -> None:
        """Say beside the fields where they come from, unless there is nothing in them."""
        self._state = self.picker.state()
        form = self.picker.form
        filled = form is not None and not form.is_empty
        self.note.setText(f"{self.origin[:1].upper()}{self.origin[1:]}." if filled else "")
        self.note.setVisible(filled)

    def _to_save(self) -> dict[str, object]:
        setup = self.setup()
        return {} if setup is None else setup.model_dump()

    def _take(self, loaded: dict[str, object], path: str) -> None:
        values = setup_from_dict(loaded, path).model_dump()
        whom = self._typed().removeprefix("typed")
        self.show_setup(values, f"loaded from {Path(path).name}{whom}")
