"""The shots of a table (CSV), with energy, brightness and mask of each: `ShotTable`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from qtpy.QtCore import QSignalBlocker, Signal
from qtpy.QtWidgets import QFileDialog, QSizePolicy, QWidget

from napari_shadowinv._napari.widgets._editors import parse_number
from napari_shadowinv._napari.widgets._forms import PathEdit, labelled, small_button
from napari_shadowinv._napari.widgets._qt import column, notify_errors, side_by_side
from napari_shadowinv._napari.widgets._tables import NumberTable
from napari_shadowinv._system.validation import validated
from napari_shadowinv.errors import InputError
from napari_shadowinv.io.formats import SITES
from napari_shadowinv.pipeline.shot_table import ShotRow, table_rows, write_table

_ENERGY, _BRIGHTNESS, _MASK = 1, 2, 3
_NUMBERS = {_ENERGY: ("energy", "MeV"), _BRIGHTNESS: ("brightness", "")}
_WIDTHS_PX = {_ENERGY: 92, _BRIGHTNESS: 76, _MASK: 90}
_TITLES = ["Shot", "Energy (MeV)", "Brightness", "Mask"]
_TIPS = {
    _ENERGY: "Energy of the particles; empty for the setup's energy.",
    _BRIGHTNESS: "Brightness of the image relative to the source, by which it is divided; empty "
    "for 1.",
    _MASK: "Image of the same size, 0 at unusable pixels, with a path relative to the table; empty "
    "for the common mask.",
}
_FILE_FILTER = "tables (*.csv)"


class _TableEdit(PathEdit):
    def ask(self) -> str:
        path, _ = QFileDialog.getOpenFileName(self, self._title, "", _FILE_FILTER)
        return str(path)


class ShotTable(QWidget):
    """The rows of a table of shots; changes are written to the file only by Save."""

    changed = Signal()

    def __init__(self) -> None:
        super().__init__()
        self._rows: list[ShotRow] = []
        self._loaded = ""
        self.file = _TableEdit("Table of the shots", "shots.csv")
        self.file.edit.setToolTip(
            "<qt>A table (.csv) with a row for each shot and the columns file, energy, setup, "
            "brightness, mask, source, exclude.</qt>"
        )
        self.save_button = small_button("Save…", "Save the rows as a table (.csv).", self._save)
        self.table = NumberTable(len(_TITLES), _WIDTHS_PX)
        self.table.setHorizontalHeaderLabels(_TITLES)
        self.setSizePolicy(QSizePolicy.Policy.Preferred, QSizePolicy.Policy.Maximum)
        column(self, labelled("", side_by_side((self.file, 1), (self.save_button, 0))), self.table)
        self.file.changed.connect(self._load)
        self.table.itemChanged.connect(self._on_edit)
        self._fill()

    def shots(self) -> list[ShotRow]:
        """Return the shown rows, unchecked ones as excluded; or raise an `InputError`."""
        if self.file.path != self._loaded:
            self._read()
        if not self._rows:
            raise InputError(
                "no table is selected: choose a .csv file with a row for each shot, with the "
                "columns file and energy"
            )
        return [self._row(number) for number in range(len(self._rows))]

    def _row(self, number: int) -> ShotRow:
        row = self._rows[number]
        changes: dict[str, Any] = {"exclude": not self.table.is_checked(number)}
        try:
            for column, (name, unit) in _NUMBERS.items():
                changes[name] = self.table.number(number, column, unit)
        except InputError as error:
            raise InputError(f"'{row.file.name}': {error}") from error
        mask = self.table.item(number, _MASK).text().strip()
        if not mask or row.mask is None or mask != row.mask.name:
            changes["mask"] = self._folder / mask if mask else None
        entries = row.model_dump(exclude={"strength"})  # tables have another form of it
        edited = validated(ShotRow, {**entries, **changes}, f"'{row.file.name}'")
        return edited.model_copy(update={"strength": row.strength})

    @property
    def _folder(self) -> Path:
        return Path(self._loaded).expanduser().parent

    @notify_errors
    def _load(self) -> None:
        if self.file.path != self._loaded:
            self._read()
            self.changed.emit()

    def _read(self) -> None:
        self._rows, self._loaded = [], self.file.path
        try:
            if self._loaded:
                self._rows = table_rows(Path(self._loaded).expanduser())
        finally:
            self._fill()

    def _fill(self) -> None:
        with QSignalBlocker(self.table):
            self.table.setRowCount(len(self._rows))
            for number, row in enumerate(self._rows):
                self.table.fill_row(number, row.file.name, _tip(row), checked=not row.exclude)
                for column, (name, unit) in _NUMBERS.items():
                    self.table.write(number, column, getattr(row, name), unit, _TIPS[column])
                self._show_mask(number, "" if row.mask is None else row.mask.name)
        self.table.setVisible(bool(self._rows))
        self.save_button.setEnabled(bool(self._rows))
        self.table.fit_height()

    def _show_mask(self, number: int, name: str) -> None:
        item = self.table.item(number, _MASK)
        item.setText(name)
        item.setToolTip(f"<qt>{_TIPS[_MASK]}</qt>")

    def showEvent(self, event: Any) -> None:
        super().showEvent(event)
        # The rows get the heights of napari's style only now.
        self.table.fit_height()

    def _on_edit(self, item: Any) -> None:
        column = item.column()
        if column in _NUMBERS:
            unit, text = _NUMBERS[column][1], item.text().strip()
            try:
                value: Any = parse_number(text, unit) if text else None
            except InputError:
                value = text  # stays for correction
            with QSignalBlocker(self.table):
                self.table.write(item.row(), column, value, unit, _TIPS[column])
        self.changed.emit()

    @notify_errors
    def _save(self) -> None:
        rows = self.shots()
        path, _ = QFileDialog.getSaveFileName(
            self, "Save the table", self._loaded or "shots.csv", _FILE_FILTER
        )
        if path:
            target = Path(path)
            write_table(target if target.suffix else target.with_suffix(SITES.suffix), rows)


def _tip(row: ShotRow) -> str:
    """Return a row's file and its entries without a cell."""
    files = {"setup": row.setup, "source": row.source}
    entries = [f"with its own {name} ({file})" for name, file in files.items() if file is not None]
    return f"{', '.join([str(row.file), *entries])}. Uncheck the shot to exclude it."
