"""What a widget held when it was last used, kept between sessions.

- keep a widget's state: `StateKeeper`
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from typing import Any

from qtpy.QtCore import QObject, QSettings, QTimer

__all__ = ["StateKeeper"]

_DELAY = 300  # ms; a slider on the move is not worth writing


class StateKeeper(QObject):
    """Writes a widget's state some time after its last change, in the user's settings.

    Parameters
    ----------
    parent : QObject
        The widget.
    name : str
        The key to keep it under.
    state : callable
        Returns what is to be kept, made of what JSON knows.
    """

    def __init__(self, parent: QObject, name: str, state: Callable[[], dict[str, Any]]) -> None:
        super().__init__(parent)
        self._name = name
        self._state = state
        self._timer = QTimer(self)
        self._timer.setSingleShot(True)
        self._timer.setInterval(_DELAY)
        self._timer.timeout.connect(self.write)

    def load(self) -> Mapping[str, Any]:
        """Return what was kept; nothing if there is none or it is damaged."""
        text = _settings().value(self._name, "{}")
        try:
            kept = json.loads(str(text))
        except ValueError:
            return {}
        return kept if isinstance(kept, dict) else {}

    def changed(self) -> None:
        """Write soon."""
        self._timer.start()

    def write(self) -> None:
        """Write now."""
        self._timer.stop()
        settings = _settings()
        settings.setValue(self._name, json.dumps(self._state()))
        settings.sync()


def _settings() -> QSettings:
    # Text that can be read and mended, on every system; Qt locks it and renames it into place.
    return QSettings(
        QSettings.Format.IniFormat, QSettings.Scope.UserScope, "napari-shadowinv", "widgets"
    )
