"""The rows of a window's report."""

from __future__ import annotations

from typing import Any


def texts_of(report: Any) -> dict[str, str]:
    """Return the texts of a report by their titles, its details included."""
    return {title.strip(): text for title, text in report.rows}
