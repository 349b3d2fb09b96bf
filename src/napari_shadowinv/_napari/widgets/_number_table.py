"""A table with a check box, a name and numbers in each row: `NumberTable`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from qtpy.QtCore import Qt
from qtpy.QtGui import QColor
from qtpy.QtWidgets import QHeaderView, QTableWidget, QTableWidgetItem

from napari_shadowinv._napari.widgets._editors import format_number, parse_number
from napari_shadowinv._napari.widgets._forms import PROBLEM_STYLE
from napari_shadowinv.errors import InputError

_MAX_SHOWN_ROWS = 8
_PROBLEM_COLOUR = QColor(PROBLEM_STYLE.removeprefix("color: ").removesuffix(";"))


class NumberTable(QTableWidget):
    """A row for each image; its first cell holds the name and whether it is used."""

    def __init__(self, columns: int, widths: Mapping[int, int]) -> None:
        super().__init__(0, columns)
        self.verticalHeader().setVisible(False)
        self.setSelectionMode(QTableWidget.SelectionMode.NoSelection)
        self.setTextElideMode(Qt.TextElideMode.ElideMiddle)
        self.setHorizontalScrollBarPolicy(Qt.ScrollBarPolicy.ScrollBarAlwaysOff)
        header = self.horizontalHeader()
        header.setSectionResizeMode(0, QHeaderView.ResizeMode.Stretch)
        for column, width in widths.items():
            header.setSectionResizeMode(column, QHeaderView.ResizeMode.Fixed)
            header.resizeSection(column, width)

    def fill_row(self, row: int, name: str, tip: str, *, checked: bool) -> None:
        """Create the cells of a row, empty except the first."""
        item = QTableWidgetItem(name)
        item.setFlags(Qt.ItemFlag.ItemIsEnabled | Qt.ItemFlag.ItemIsUserCheckable)
        item.setCheckState(Qt.CheckState.Checked if checked else Qt.CheckState.Unchecked)
        item.setToolTip(f"<qt>{tip}</qt>")
        self.setItem(row, 0, item)
        for column in range(1, self.columnCount()):
            self.setItem(row, column, QTableWidgetItem())

    def fit_height(self) -> None:
        """Fit the height to the rows, up to a maximum."""
        rows = sum(self.rowHeight(row) for row in range(min(self.rowCount(), _MAX_SHOWN_ROWS)))
        header = self.horizontalHeader()
        header.setFixedHeight(header.sizeHint().height())
        self.setFixedHeight(header.height() + rows + 2 * self.frameWidth())

    def is_checked(self, row: int) -> bool:
        return bool(self.item(row, 0).checkState() == Qt.CheckState.Checked)

    def number(self, row: int, column: int, unit: str) -> float | None:
        """Return the number in a cell, None if it is empty; or raise an `InputError`."""
        item = self.item(row, column)
        exact, text = item.data(Qt.ItemDataRole.UserRole), item.text().strip()
        if exact is not None:
            return float(exact)
        return parse_number(text, unit) if text else None

    def write(self, row: int, column: int, value: Any, unit: str, tip: str) -> None:
        """Show a number, or text that the user has to correct."""
        item = self.item(row, column)
        is_number = not isinstance(value, str) and value is not None
        # The shown text is rounded.
        item.setData(Qt.ItemDataRole.UserRole, value if is_number else None)
        if not is_number:
            item.setText(value or "")
        else:
            item.setText(format_number(value, unit) if unit not in ("", "MeV") else f"{value:.6g}")
        self._check(item, unit, tip)

    def _check(self, item: QTableWidgetItem, unit: str, tip: str) -> None:
        """Mark an invalid number by its colour and tooltip."""
        try:
            parse_number(item.text() or "0", unit)
        except InputError as error:
            item.setForeground(_PROBLEM_COLOUR)
            item.setToolTip(f"<qt>{error}</qt>")
        else:
            item.setData(Qt.ItemDataRole.ForegroundRole, None)
            item.setToolTip(f"<qt>{tip}</qt>")
