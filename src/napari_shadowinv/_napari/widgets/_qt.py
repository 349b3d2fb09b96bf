"""What all widgets need of Qt and napari."""

from __future__ import annotations

import functools
import json
import weakref
from collections.abc import Callable, Mapping
from typing import Any, TypeVar

from napari.utils.notifications import show_error
from qtpy.QtCore import QObject, QSettings, Qt, QTimer
from qtpy.QtWidgets import QDockWidget, QHBoxLayout, QMainWindow, QVBoxLayout, QWidget

from napari_shadowinv._napari.notifications import MISTAKES, window_text

Method = TypeVar("Method", bound=Callable[..., Any])

_WRITE_AFTER = 300  # ms; a slider on the move is not worth writing
# napari's own docks, which users expect to see beside a plugin's.
_ALWAYS_SEEN = {"layer list", "layer controls", "console"}
# Held here, because a garbage collection that takes a widget away would first empty a function
# that only the widget holds, and then have Qt call it.
_callbacks: set[Callable[..., None]] = set()


def column(holder: QWidget, *widgets: QWidget, margin: int = 0) -> QVBoxLayout:
    """Put widgets into another one, one below the other."""
    layout = QVBoxLayout(holder)
    layout.setContentsMargins(margin, margin, margin, margin)
    for widget in widgets:
        layout.addWidget(widget)
    return layout


def beside(*widgets: tuple[QWidget, int], holder: QWidget | None = None) -> QWidget:
    """Put widgets beside each other, each with its share of the width to spare."""
    holder = holder or QWidget()
    layout = QHBoxLayout(holder)
    layout.setContentsMargins(0, 0, 0, 0)
    for widget, share in widgets:
        layout.addWidget(widget, share)
    return holder


def timer(parent: QObject, interval: int, action: Callable[[], Any], once: bool = False) -> QTimer:
    """A timer that is not started yet; `interval` in ms."""
    made = QTimer(parent)
    made.setSingleShot(once)
    made.setInterval(interval)
    made.timeout.connect(action)
    return made


def when_destroyed(thing: QObject, action: Callable[[], Any]) -> None:
    """Call a function, which must not hold the object itself, when a Qt object is destroyed."""

    def once(*_: object) -> None:
        _callbacks.discard(once)
        action()

    _callbacks.add(once)
    thing.destroyed.connect(once)


def while_alive(thing: QObject, emitter: Any, method: Callable[..., Any]) -> None:
    """Connect a method to an event of a layer or viewer for as long as a Qt object lives."""
    emitter.connect(method)
    reference = weakref.WeakMethod(method)

    def disconnect() -> None:
        alive = reference()
        if alive is not None:
            emitter.disconnect(alive)

    when_destroyed(thing, disconnect)


def error_text(error: BaseException | str) -> str:
    """What is wrong and what to do; of a fault of the program's, at least its name."""
    text = window_text(str(error))
    if isinstance(error, MemoryError) and not text:
        text = "there is not enough memory for this"
    elif not isinstance(error, (str, *MISTAKES)):
        first = text.partition("\n")[0]
        text = f"internal error: {type(error).__name__}: {first} (see the notification)"
    return text[:1].upper() + text[1:]


def tell_error(error: BaseException | str) -> None:
    show_error(error_text(error))


def notify_errors(method: Method) -> Method:
    """Turn a mistake into one notification; the nearest widget with `show_problem` shows it."""

    @functools.wraps(method)
    def told(*args: Any, **kwargs: Any) -> Any:
        try:
            return method(*args, **kwargs)
        except MISTAKES as error:
            tell_error(error)
            widget = args[0]
            while widget is not None and not hasattr(widget, "show_problem"):
                widget = widget.parent()
            if widget is not None:
                widget.show_problem(error_text(error))
            return None

    return told  # type: ignore[return-value]


class Docked(QWidget):
    """A widget that joins the docks on its side as a tab; napari would squeeze it below them.

    Choosing it again in the menu while it is a tab in the background brings it to the front,
    where napari would hide it.
    """

    _dock: QDockWidget | None = None
    _in_front = True

    def showEvent(self, event: Any) -> None:
        super().showEvent(event)
        if self._dock is None:
            # Now napari is still about to lay out the docks.
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
        for other in window.findChildren(QDockWidget):
            here = other is not dock and window.dockWidgetArea(other) == side and other.isVisible()
            if here and not other.isFloating() and other.objectName() not in _ALWAYS_SEEN:
                window.tabifyDockWidget(other, dock)
                dock.raise_()
                return


class StateKeeper(QObject):
    """Writes a widget's state, made of what JSON knows, to the settings soon after a change."""

    def __init__(self, parent: QObject, name: str, state: Callable[[], dict[str, Any]]) -> None:
        super().__init__(parent)
        self._name = name
        self._state = state
        self._timer = timer(self, _WRITE_AFTER, self.write, once=True)

    def load(self) -> Mapping[str, Any]:
        """Return what was kept; nothing if there is none or it is damaged."""
        text = _settings().value(self._name, "{}")
        try:
            kept = json.loads(str(text))
        except ValueError:
            return {}
        return kept if isinstance(kept, dict) else {}

    def changed(self) -> None:
        self._timer.start()

    def write(self) -> None:
        self._timer.stop()
        settings = _settings()
        settings.setValue(self._name, json.dumps(self._state()))
        settings.sync()


def _settings() -> QSettings:
    # Text that can be read and mended, on every system; Qt locks it and renames it into place.
    return QSettings(
        QSettings.Format.IniFormat, QSettings.Scope.UserScope, "napari-shadowinv", "widgets"
    )
