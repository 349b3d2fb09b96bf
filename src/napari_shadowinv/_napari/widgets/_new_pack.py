"""A form that creates a pack file from a folder of scans: `NewPackDialog`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from qtpy import QtWidgets
from qtpy.QtCore import Qt

from napari_shadowinv._napari.widgets._forms import ModelForm, wrapping_label
from napari_shadowinv.errors import InputError
from napari_shadowinv.film.pack import FILM_TYPES
from napari_shadowinv.pipeline.new_pack import (
    PACK_FILE,
    NewPack,
    draft_pack,
    missing_entries,
    write_new_pack,
)

_COLUMNS = ("Scan", "Film", "Filters in front of the film")
_MIN_SIZE_PX = (620, 560)


class NewPackDialog(QtWidgets.QDialog):
    """The scans of a folder in pack order, and entries that the scans do not contain.

    Attributes
    ----------
    written : Path or None
        Path of the pack file after saving.
    """

    def __init__(self, folder: Path, parent: QtWidgets.QWidget | None = None) -> None:
        super().__init__(parent)
        self.setWindowTitle("New film pack")
        self.setMinimumSize(*_MIN_SIZE_PX)
        self._folder = folder
        self.written: Path | None = None
        self.form = ModelForm(NewPack)
        self.table = QtWidgets.QTableWidget(0, len(_COLUMNS))
        self.table.setHorizontalHeaderLabels(_COLUMNS)
        self.table.horizontalHeader().setStretchLastSection(True)
        self.table.setToolTip(
            "<qt>Films in the order in which the beam passes them. Filters as thickness, unit and "
            "material, such as 13 um Al; 25 um Fe.</qt>"
        )
        self._problem = wrapping_label()
        choices = QtWidgets.QDialogButtonBox.StandardButton
        self.buttons = QtWidgets.QDialogButtonBox(choices.Save | choices.Cancel)
        self.buttons.accepted.connect(self.accept)
        self.buttons.rejected.connect(self.reject)
        column = QtWidgets.QVBoxLayout(self)
        for widget in (self.form, self.table, self._problem, self.buttons):
            column.addWidget(widget)
        self._show_layers(draft_pack(folder)["layers"])
        self.form.editors["film"].changed.connect(self._on_film)

    def entries(self) -> dict[str, Any]:
        """Return the entries of the pack file."""
        facts = self.form.model()
        assert isinstance(facts, NewPack)
        layers = [
            {
                "film": self.table.cellWidget(row, 1).currentText(),
                "filters": [
                    part.strip()
                    for part in self.table.item(row, 2).text().split(";")
                    if part.strip()
                ],
                "file": self.table.item(row, 0).text(),
            }
            for row in range(self.table.rowCount())
        ]
        return draft_pack(self._folder, facts, layers)

    def missing_text(self) -> str:
        """Return a sentence on entries still missing in the pack file, or the next action."""
        missing = missing_entries(self.entries())
        return f"Add to this file: {'; '.join(missing)}." if missing else "Press Run."

    def accept(self) -> None:
        """Write the pack file, or show the problem."""
        try:
            path = self._folder / PACK_FILE
            self.written = write_new_pack(
                self._folder, self.entries(), overwrite=path.exists() and self._may_replace(path)
            )
        except (InputError, OSError, ValueError) as error:
            self._problem.setText(str(error))
            return
        super().accept()

    def _may_replace(self, path: Path) -> bool:
        button = QtWidgets.QMessageBox.question(
            self, "New film pack", f"{path} already exists. Replace it?"
        )
        return bool(button == QtWidgets.QMessageBox.StandardButton.Yes)

    def _show_layers(self, layers: list[dict[str, Any]]) -> None:
        self.table.setRowCount(len(layers))
        for row, layer in enumerate(layers):
            scan = QtWidgets.QTableWidgetItem(layer["file"])
            scan.setFlags(scan.flags() & ~Qt.ItemFlag.ItemIsEditable)
            film = QtWidgets.QComboBox()
            film.addItems(list(FILM_TYPES))
            film.setCurrentText(layer["film"])
            self.table.setItem(row, 0, scan)
            self.table.setCellWidget(row, 1, film)
            self.table.setItem(row, 2, QtWidgets.QTableWidgetItem(""))

    def _on_film(self) -> None:
        """Show the selected type for all films whose file names contain no type."""
        facts = NewPack(film=self.form.editors["film"].value())
        for row, layer in enumerate(draft_pack(self._folder, facts)["layers"]):
            self.table.cellWidget(row, 1).setCurrentText(layer["film"])
