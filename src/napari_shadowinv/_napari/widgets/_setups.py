"""The experiment's geometry: `SetupPicker`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from pydantic import BaseModel
from qtpy.QtCore import Signal
from qtpy.QtWidgets import QVBoxLayout, QWidget

from napari_shadowinv._napari.marks import setup_of
from napari_shadowinv._napari.widgets._forms import ModelPicker
from napari_shadowinv._napari.widgets._toml import TomlButtons

if TYPE_CHECKING:
    from napari_shadowinv.physics.setup import OpticalSetup, ProtonSetup

__all__ = ["SetupPicker"]

_NONE = "none"


def _proton() -> type[BaseModel]:
    from napari_shadowinv.physics.setup import ProtonSetup

    return ProtonSetup


def _optical() -> type[BaseModel]:
    from napari_shadowinv.physics.setup import OpticalSetup

    return OpticalSetup


class SetupPicker(QWidget):
    """No setup, particles or light, with buttons for TOML files.

    Signals
    -------
    changed
        Another setup.
    """

    changed = Signal()

    def __init__(self) -> None:
        super().__init__()
        self.picker = ModelPicker(
            "Setup",
            {
                _NONE: ("none: results in pixels", None),
                "proton": ("particles (protons, …)", _proton),
                "optical": ("light", _optical),
            },
        )
        self.picker.choice.setToolTip(
            "<qt>With the experiment's geometry the results are in SI units; lengths may be "
            "typed as 1.3 mm or 0.0013.</qt>"
        )
        self.files = TomlButtons("setup", self._to_save, self._take)
        column = QVBoxLayout(self)
        column.setContentsMargins(0, 0, 0, 0)
        column.addWidget(self.picker)
        column.addWidget(self.files)
        self.picker.changed.connect(self.changed)

    def setup(self) -> ProtonSetup | OpticalSetup | None:
        """The validated setup.

        Raises
        ------
        InputError
            If something is missing or cannot be used.
        """
        return self.picker.model()  # type: ignore[return-value]

    def state(self) -> dict[str, Any]:
        """What is kept."""
        return self.picker.state()

    def restore(self, state: Mapping[str, Any]) -> None:
        """Show what `state` has returned."""
        self.picker.restore(state)

    def show_setup(self, values: Mapping[str, Any]) -> None:
        """Fill in a setup, as a TOML file or a model's dump holds it."""
        kind = str(values["kind"])
        self.picker.restore({"kind": kind, "values": {kind: dict(values)}})

    def follow(self, image_layer: Any) -> None:
        """Take the setup that came with an image."""
        setup = setup_of(image_layer)
        if setup is not None:
            self.show_setup(setup.model_dump())

    def _to_save(self) -> dict[str, object]:
        setup = self.setup()
        return {} if setup is None else setup.model_dump()

    def _take(self, loaded: dict[str, object], path: str) -> None:
        from napari_shadowinv.physics.setup import setup_from_dict

        self.show_setup(setup_from_dict(loaded, path).model_dump())
