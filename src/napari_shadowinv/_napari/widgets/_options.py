"""How to invert: `OptionsForm`."""

from __future__ import annotations

from napari_shadowinv._napari.widgets._forms import ModelForm
from napari_shadowinv._napari.widgets._jobs import PREVIEW_SITES
from napari_shadowinv._napari.widgets._toml import TomlButtons
from napari_shadowinv._system.validation import validated
from napari_shadowinv.options import InversionOptions

__all__ = ["OptionsForm"]


class OptionsForm(ModelForm):
    """A form of the inversion's options, with buttons for TOML files."""

    def __init__(self) -> None:
        super().__init__(InversionOptions, first={"n_sites": PREVIEW_SITES})
        self.files = TomlButtons("options", self._to_save, self._take)
        self.layout().addWidget(self.files)

    def _to_save(self) -> dict[str, object]:
        self.model()
        return self.values()

    def _take(self, loaded: dict[str, object], path: str) -> None:
        validated(InversionOptions, loaded, path)
        self.set_values(loaded)
