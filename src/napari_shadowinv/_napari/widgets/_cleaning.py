"""What is done to images before they are inverted: `CleaningSection`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from qtpy.QtCore import Signal
from qtpy.QtWidgets import QVBoxLayout, QWidget

from napari_shadowinv._napari.widgets._forms import ModelPicker, kinds_of
from napari_shadowinv._napari.widgets._panels import section
from napari_shadowinv.preprocessing import FILTERS, Filter

__all__ = ["CleaningSection"]


class CleaningSection(QWidget):
    """A choice of filters, folded away under a title that tells which.

    Signals
    -------
    changed
        Another filter was chosen, or a value of it.
    """

    changed = Signal()

    def __init__(self) -> None:
        super().__init__()
        self.picker = ModelPicker("Filter", {"none": ("nothing", None), **kinds_of(FILTERS)})
        self.folded = section("", self.picker)
        column = QVBoxLayout(self)
        column.setContentsMargins(0, 0, 0, 0)
        column.addWidget(self.folded)
        self.picker.changed.connect(self._on_change)
        self._on_change()

    def model(self) -> Filter | None:
        """The chosen filter, if any.

        Raises
        ------
        InputError
            If a value is missing or cannot be used.
        """
        model = self.picker.model()
        assert model is None or isinstance(model, Filter)
        return model

    def state(self) -> dict[str, Any]:
        """What is kept between sessions."""
        return self.picker.state()

    def restore(self, state: Mapping[str, Any]) -> None:
        """Show what `state` has returned."""
        self.picker.restore(state)

    def _on_change(self) -> None:
        # A filter must not work unseen in a folded section.
        title = f"Filter first: {self.picker.choice.currentText()}"
        if self.folded.text() != title:
            self.folded.setText(title)
        self.changed.emit()
