"""Entries of a form as a user makes them."""

from __future__ import annotations

from typing import Any

from magicgui.widgets import LineEdit

from napari_shadowinv._napari.form import Entry


def enter(entry: Entry, value: Any) -> None:
    """Type or choose a value, and leave the entry."""
    if isinstance(entry.line, LineEdit):
        entry.line.value = str(value)
        entry.line.native.editingFinished.emit()
    else:
        entry.line.value = value
