"""A table with a name, a box to check and numbers in each row: `NumberTable`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from qtpy.QtCore import Qt
from qtpy.QtGui import QColor
from qtpy.QtWidgets import QHeaderView, QTableWidget, QTableWidgetItem

from napari_shadowinv._napari.widgets._fields import parsed, shown
from napari_shadowinv._napari.widgets._forms import PROBLEM_STYLE
from napari_shadowinv.errors import InputError

_TALLEST = 8  # rows
_PROBLEM = QColor(PROBLEM_STYLE.removeprefix("color: ").removesuffix(";"))


class NumberTable(QTableWidget):
    """A row for each image; its first cell has its name and tells whether it is used."""

    def __init__(self, columns: int, widths: Mapping[int, int]) -> None:
        super().__init__(0, columns)
        self.verticalHeader().setVisible(False)
        self.setSelectionMode(QTableWidget.SelectionMode.NoSelection)
        self.setTextElideMode(Qt.TextElideMode.ElideMiddle)
        self.setHorizontalScrollBarPolicy(Qt.ScrollBarPolicy.ScrollBarAlwaysOff)
        header = self.horizontalHeader()
        header.setSectionResizeMode(0, QHeaderView.ResizeMode.Stretch)
        for at, width in widths.items():
            header.setSectionResizeMode(at, QHeaderView.ResizeMode.Fixed)
            header.resizeSection(at, width)

    def fill_row(self, row: int, name: str, tip: str, *, checked: bool) -> None:
        """Make the cells of a row, all empty but the first."""
        item = QTableWidgetItem(name)
        item.setFlags(Qt.ItemFlag.ItemIsEnabled | Qt.ItemFlag.ItemIsUserCheckable)
        item.setCheckState(Qt.CheckState.Checked if checked else Qt.CheckState.Unchecked)
        item.setToolTip(f"<qt>{tip}</qt>")
        self.setItem(row, 0, item)
        for at in range(1, self.columnCount()):
            self.setItem(row, at, QTableWidgetItem())

    def fit_height(self) -> None:
        """Show all rows, up to a few."""
        rows = sum(self.rowHeight(row) for row in range(min(self.rowCount(), _TALLEST)))
        header = self.horizontalHeader()
        header.setFixedHeight(header.sizeHint().height())
        self.setFixedHeight(header.height() + rows + 2 * self.frameWidth())

    def is_checked(self, row: int) -> bool:
        return bool(self.item(row, 0).checkState() == Qt.CheckState.Checked)

    def number(self, row: int, at: int, unit: str) -> float | None:
        """Return what a cell holds, None if it is empty; or an `InputError`."""
        item = self.item(row, at)
        exact, text = item.data(Qt.ItemDataRole.UserRole), item.text().strip()
        if exact is not None:
            return float(exact)
        return parsed(text, unit) if text else None

    def write(self, row: int, at: int, value: Any, unit: str, tip: str) -> None:
        """Show a number, or a text that is to be mended."""
        item = self.item(row, at)
        is_number = not isinstance(value, str) and value is not None
        # The text is rounded.
        item.setData(Qt.ItemDataRole.UserRole, value if is_number else None)
        if not is_number:
            item.setText(value or "")
        else:
            item.setText(shown(value, unit) if unit not in ("", "MeV") else f"{value:.6g}")
        self._judge(item, unit, tip)

    def _judge(self, item: QTableWidgetItem, unit: str, tip: str) -> None:
        """Colour what is no number, and say so in its tool tip."""
        try:
            parsed(item.text() or "0", unit)
        except InputError as error:
            item.setForeground(_PROBLEM)
            item.setToolTip(f"<qt>{error}</qt>")
        else:
            item.setData(Qt.ItemDataRole.ForegroundRole, None)
            item.setToolTip(f"<qt>{tip}</qt>")
