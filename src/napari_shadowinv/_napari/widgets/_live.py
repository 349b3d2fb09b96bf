"""Widgets that run on a button, and with a preview on every change: `LivePanel`."""

from __future__ import annotations

from typing import Any

from qtpy.QtCore import QTimer
from qtpy.QtWidgets import QCheckBox

from napari_shadowinv._napari.widgets._base import ToolPanel
from napari_shadowinv._napari.widgets._notifications import MISTAKES, notify_errors
from napari_shadowinv._napari.widgets._panels import RunPanel
from napari_shadowinv._napari.widgets._runner import Outcome

__all__ = ["LivePanel"]

_SETTLE = 10  # ms; a few changes at once are one


class LivePanel(ToolPanel):
    """Runs what `request` describes; a subclass says what that is and shows the result.

    At most one run is under way and one, the latest, waits. A preview gives way to the
    next and to the button; a run that the button began is not disturbed by previews.

    Parameters
    ----------
    viewer, name
        See `ToolPanel`.
    panel : RunPanel
        The button.
    """

    def __init__(self, viewer: Any, name: str, panel: RunPanel) -> None:
        super().__init__(viewer, name)
        self.panel = panel
        self.live = QCheckBox("Live preview")
        self._running_preview = False
        self._settle = QTimer(self)
        self._settle.setSingleShot(True)
        self._settle.setInterval(_SETTLE)
        self._settle.timeout.connect(self._preview)
        panel.button.clicked.connect(lambda: self._run_or_cancel())
        panel.runner.ended.connect(self._on_end)
        self.live.toggled.connect(self.on_change)

    def request(self, preview: bool = False) -> Any:
        """What the controls ask for: with a method `run`, and whether it is a `preview`.

        Raises
        ------
        InputError
            If something cannot be used.
        """
        raise NotImplementedError

    def show_result(self, value: Any, request: Any) -> None:
        """Show what a run returned."""
        raise NotImplementedError

    def on_change(self) -> None:
        """Something that the result depends on has changed."""
        self.keep()
        if self._ready and self.live.isChecked():
            self._settle.start()

    def showEvent(self, event: Any) -> None:
        super().showEvent(event)
        if self._ready and self.live.isChecked():
            self._settle.start()

    def _run_or_cancel(self) -> None:
        if self.panel.runner.running and not self._running_preview:
            self.panel.cancel()
            return
        try:
            request = self.request()
        except MISTAKES as error:
            self.panel.refuse(error)
            return
        self._running_preview = False
        self.panel.run(request.run, request)

    def _preview(self) -> None:
        busy = self.panel.runner.running and not self._running_preview
        if busy or not self.isVisible():
            return
        try:
            request = self.request(preview=True)
        except MISTAKES as error:
            # Half a rectangle, half a number: no reason for a notification.
            self.panel.say(str(error), problem=True)
            return
        self._running_preview = True
        self.panel.run(request.run, request, quiet=True)

    @notify_errors
    def _on_end(self, outcome: Outcome) -> None:
        if outcome.value is not None:
            self.show_result(outcome.value, outcome.tag)
