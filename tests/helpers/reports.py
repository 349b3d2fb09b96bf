"""The rows of a window's report."""

from __future__ import annotations

from typing import Any

from qtpy.QtWidgets import QTableWidget


def texts_of(report: Any) -> dict[str, str]:
    """The texts of a table by their titles, or of all tables in a report."""
    tables = [report] if isinstance(report, QTableWidget) else report.findChildren(QTableWidget)
    return {
        table.item(row, 0).text().strip(): table.item(row, 1).text()
        for table in tables
        for row in range(table.rowCount())
    }
