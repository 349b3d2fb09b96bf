"""Qt helpers of all widgets: layouts, timers, error messages, docks, saved state."""

from __future__ import annotations

import functools
import json
import weakref
from collections.abc import Callable, Mapping
from typing import Any, TypeVar

from napari.utils.notifications import show_error
from qtpy.QtCore import QObject, QSettings, Qt, QTimer
from qtpy.QtWidgets import QDockWidget, QHBoxLayout, QMainWindow, QVBoxLayout, QWidget

from napari_shadowinv._napari.viewer_sync import USER_ERRORS, window_text

Method = TypeVar("Method", bound=Callable[..., Any])

_WRITE_DELAY_MS = 300  # a moving slider is written once
# napari's docks, which users expect to see next to a plugin's.
_NAPARI_DOCKS = {"layer list", "layer controls", "console"}
# Garbage collection of a widget would clear a function that only the widget holds before Qt
# calls it.
_callbacks: set[Callable[..., None]] = set()


def column(holder: QWidget, *widgets: QWidget, margin: int = 0) -> QVBoxLayout:
    """Lay out widgets in a column of `holder`."""
    layout = QVBoxLayout(holder)
    layout.setContentsMargins(margin, margin, margin, margin)
    for widget in widgets:
        layout.addWidget(widget)
    return layout


def side_by_side(*widgets: tuple[QWidget, int], holder: QWidget | None = None) -> QWidget:
    """Lay out widgets in a row, each with its share of the spare width."""
    holder = holder or QWidget()
    layout = QHBoxLayout(holder)
    layout.setContentsMargins(0, 0, 0, 0)
    for widget, share in widgets:
        layout.addWidget(widget, share)
    return holder


def timer(parent: QObject, interval: int, action: Callable[[], Any], once: bool = False) -> QTimer:
    """Create a timer without starting it; `interval` in ms."""
    qt_timer = QTimer(parent)
    qt_timer.setSingleShot(once)
    qt_timer.setInterval(interval)
    qt_timer.timeout.connect(action)
    return qt_timer


def when_destroyed(owner: QObject, action: Callable[[], Any]) -> None:
    """Call a function when a Qt object is destroyed; it must not hold a reference to the object."""

    def once(*_: object) -> None:
        _callbacks.discard(once)
        action()

    _callbacks.add(once)
    owner.destroyed.connect(once)


def while_alive(owner: QObject, emitter: Any, method: Callable[..., Any]) -> None:
    """Connect a method to an event of a layer or viewer during the life of a Qt object."""
    emitter.connect(method)
    reference = weakref.WeakMethod(method)

    def disconnect() -> None:
        living_method = reference()
        if living_method is not None:
            emitter.disconnect(living_method)

    when_destroyed(owner, disconnect)


def error_text(error: BaseException | str) -> str:
    """Return the message of an error for the user; for a bug, its type and first line."""
    text = window_text(str(error))
    if isinstance(error, MemoryError) and not text:
        text = "there is not enough memory for this"
    elif not isinstance(error, (str, *USER_ERRORS)):
        first_line = text.partition("\n")[0]
        text = f"internal error: {type(error).__name__}: {first_line} (see the notification)"
    return text[:1].upper() + text[1:]


def report_error(error: BaseException | str) -> None:
    show_error(error_text(error))


def notify_errors(method: Method) -> Method:
    """Turn a user's error into a notification; the nearest widget with `show_problem` shows it."""

    @functools.wraps(method)
    def guarded(*args: Any, **kwargs: Any) -> Any:
        try:
            return method(*args, **kwargs)
        except USER_ERRORS as error:
            report_error(error)
            widget = args[0]
            while widget is not None and not hasattr(widget, "show_problem"):
                widget = widget.parent()
            if widget is not None:
                widget.show_problem(error_text(error))
            return None

    return guarded  # type: ignore[return-value]


class Docked(QWidget):
    """A widget that opens as a tab of the docks on its side, where napari would squeeze it below.

    Choosing a tab in the background again in the menu brings it to the front, where napari would
    hide it.
    """

    _dock: QDockWidget | None = None
    _in_front = True

    def showEvent(self, event: Any) -> None:
        super().showEvent(event)
        if self._dock is None:
            # napari lays out the docks after this event.
            QTimer.singleShot(0, self._join)

    def hideEvent(self, event: Any) -> None:
        super().hideEvent(event)
        dock = self._dock
        if dock is not None and dock.isHidden() and not self._in_front:
            QTimer.singleShot(0, self._come_to_front)

    def _come_to_front(self) -> None:
        if self._dock is not None and self._dock.parent().isVisible():
            self._in_front = True
            self._dock.show()
            self._dock.raise_()

    def _on_visibility(self, visible: bool) -> None:
        if self._dock is not None and not self._dock.isHidden():
            self._in_front = visible

    def _join(self) -> None:
        dock = self.parent()
        while dock is not None and not isinstance(dock, QDockWidget):
            dock = dock.parent()
        window = None if dock is None else dock.parent()
        if self._dock is not None or dock is None or not isinstance(window, QMainWindow):
            return
        self._dock = dock
        dock.visibilityChanged.connect(self._on_visibility)
        side = window.dockWidgetArea(dock)
        if dock.isFloating() or side == Qt.DockWidgetArea.NoDockWidgetArea:
            return
        if window.tabifiedDockWidgets(dock):
            return
        for neighbour in window.findChildren(QDockWidget):
            is_on_side = neighbour is not dock and window.dockWidgetArea(neighbour) == side
            if not is_on_side or not neighbour.isVisible() or neighbour.isFloating():
                continue
            if neighbour.objectName() not in _NAPARI_DOCKS:
                window.tabifyDockWidget(neighbour, dock)
                dock.raise_()
                return


class StateKeeper(QObject):
    """Saves a widget's state, of JSON values, in the settings soon after a change."""

    def __init__(self, parent: QObject, name: str, state: Callable[[], dict[str, Any]]) -> None:
        super().__init__(parent)
        self._name = name
        self._state = state
        self._timer = timer(self, _WRITE_DELAY_MS, self.write, once=True)

    def load(self) -> Mapping[str, Any]:
        """Return the saved state; empty if there is none or it is damaged."""
        text = _settings().value(self._name, "{}")
        try:
            state = json.loads(str(text))
        except ValueError:
            return {}
        return state if isinstance(state, dict) else {}

    def changed(self) -> None:
        self._timer.start()

    def write(self) -> None:
        self._timer.stop()
        settings = _settings()
        settings.setValue(self._name, json.dumps(self._state()))
        settings.sync()


def _settings() -> QSettings:
    # A readable text file on every system; Qt locks it and replaces it atomically.
    return QSettings(
        QSettings.Format.IniFormat, QSettings.Scope.UserScope, "napari-shadowinv", "widgets"
    )
