"""Widgets that share their place in the window with others: `Docked`."""

from __future__ import annotations

from typing import Any

from qtpy.QtCore import Qt, QTimer
from qtpy.QtWidgets import QDockWidget, QMainWindow, QWidget

__all__ = ["Docked"]

# napari's own, which users expect to see beside a plugin's.
_ALWAYS_SEEN = {"layer list", "layer controls", "console"}


class Docked(QWidget):
    """A widget that joins the docks on its side of the window as a tab when it opens.

    napari puts a second dock below the first, where neither of them has room.
    """

    _has_place = False

    def showEvent(self, event: Any) -> None:
        super().showEvent(event)
        if not self._has_place:
            self._has_place = True
            # Now napari is still about to lay out the docks.
            QTimer.singleShot(0, self._join)

    def _join(self) -> None:
        dock = _dock_of(self)
        window = None if dock is None else dock.parent()
        if dock is None or not isinstance(window, QMainWindow) or dock.isFloating():
            return
        side = window.dockWidgetArea(dock)
        if side == Qt.DockWidgetArea.NoDockWidgetArea or window.tabifiedDockWidgets(dock):
            return
        others = [one for one in window.findChildren(QDockWidget) if one is not dock]
        for other in others:
            beside = window.dockWidgetArea(other) == side and other.isVisible()
            if beside and not other.isFloating() and other.objectName() not in _ALWAYS_SEEN:
                window.tabifyDockWidget(other, dock)
                dock.raise_()
                return


def _dock_of(widget: QWidget) -> QDockWidget | None:
    parent = widget.parent()
    while parent is not None and not isinstance(parent, QDockWidget):
        parent = parent.parent()
    return parent
