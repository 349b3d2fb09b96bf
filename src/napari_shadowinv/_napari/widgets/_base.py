"""What dock widgets of the plugin are made of: `ToolPanel`, `PathEdit`, `with_button`."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, Protocol

from qtpy.QtCore import QSize, Qt, Signal
from qtpy.QtWidgets import (
    QFileDialog,
    QFrame,
    QHBoxLayout,
    QLineEdit,
    QScrollArea,
    QSizePolicy,
    QToolButton,
    QVBoxLayout,
    QWidget,
)

from napari_shadowinv._napari.widgets._docking import Docked
from napari_shadowinv._napari.widgets._state import StateKeeper

if TYPE_CHECKING:
    from napari_shadowinv._napari.widgets._panels import RunPanel

__all__ = ["Part", "PathEdit", "ToolPanel", "with_button"]

_WIDTH = 330


class Part(Protocol):
    """A control with a state."""

    def state(self) -> Any:
        """What is kept, made of what JSON knows."""
        ...

    def restore(self, state: Any) -> None:
        """Show what `state` has returned."""
        ...


class ToolPanel(Docked):
    """A column of controls that scrolls where the window is low, never sideways.

    A subclass has a `panel` with its button.

    Parameters
    ----------
    viewer : napari.Viewer
        The viewer to work in.
    name : str
        The key of the state that is kept between sessions.
    """

    panel: RunPanel

    def __init__(self, viewer: Any, name: str) -> None:
        super().__init__()
        self.viewer = viewer
        self._ready = False
        content = QWidget()
        self.column = QVBoxLayout(content)
        self.column.setContentsMargins(6, 6, 6, 6)
        self.column.setAlignment(Qt.AlignmentFlag.AlignTop)
        area = QScrollArea()
        area.setWidgetResizable(True)
        area.setFrameShape(QFrame.Shape.NoFrame)
        area.setHorizontalScrollBarPolicy(Qt.ScrollBarPolicy.ScrollBarAlwaysOff)
        area.setWidget(content)
        self.area = area
        whole = QVBoxLayout(self)
        whole.setContentsMargins(0, 0, 0, 0)
        whole.addWidget(area)
        self.setMinimumWidth(_WIDTH)
        self.setSizePolicy(QSizePolicy.Policy.Preferred, QSizePolicy.Policy.Expanding)
        self._keeper = StateKeeper(self, name, self.state)

    def sizeHint(self) -> QSize:
        return QSize(_WIDTH + 30, 600)

    def show_problem(self, text: str) -> None:
        """Show what is wrong, where it can be read until the next run."""
        self.panel.say(text, problem=True)

    def parts(self) -> dict[str, Part]:
        """The controls whose states are kept between sessions, by name."""
        return {}

    def state(self) -> dict[str, Any]:
        """What is kept between sessions, made of what JSON knows."""
        return {name: part.state() for name, part in self.parts().items()}

    def restore(self, kept: Mapping[str, Any]) -> None:
        """Show what `state` has returned."""
        for name, part in self.parts().items():
            if name in kept:
                part.restore(kept[name])

    def restore_last(self) -> None:
        """Show what was kept when the widget was used last."""
        self.restore(self._keeper.load())

    def keep(self) -> None:
        """The state has changed: write it soon."""
        if self._ready:
            self._keeper.changed()

    def hideEvent(self, event: Any) -> None:
        if self._ready:
            self._keeper.write()
        super().hideEvent(event)


class PathEdit(QWidget):
    """A file's path, typed or chosen.

    Signals
    -------
    changed
        Another path was given.
    """

    changed = Signal()

    def __init__(self, title: str, example: str = "path of a file") -> None:
        super().__init__()
        self._title = title
        self.edit = QLineEdit()
        self.edit.setPlaceholderText(example)
        self.edit.setMinimumWidth(60)
        row = QHBoxLayout(self)
        row.setContentsMargins(0, 0, 0, 0)
        row.addWidget(with_button(self.edit, "…", title, self._choose))
        self.edit.editingFinished.connect(self.changed)

    @property
    def path(self) -> str:
        """The path; empty if there is none."""
        return str(self.edit.text()).strip()

    def ask(self) -> str:
        """Let the user choose in a dialog; empty if he does not."""
        path, _ = QFileDialog.getOpenFileName(self, self._title)
        return str(path)

    def _choose(self) -> None:
        path = self.ask()
        if path:
            self.edit.setText(path)
            self.changed.emit()


def with_button(widget: QWidget, text: str, tip: str, action: Callable[[], Any]) -> QWidget:
    """A widget with a small button on its right."""
    holder = QWidget()
    row = QHBoxLayout(holder)
    row.setContentsMargins(0, 0, 0, 0)
    button = QToolButton()
    button.setText(text)
    button.setToolTip(tip)
    button.clicked.connect(lambda: action())
    row.addWidget(widget, 1)
    row.addWidget(button)
    holder.button = button
    return holder
