"""Qt helpers of all widgets: layouts, timers, error messages, docks, saved state, plots."""

from __future__ import annotations

import functools
import json
import re
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, suppress
from pathlib import Path
from typing import Any, TypeVar

from qtpy.QtCore import QObject, QSettings, QSize, Qt, QTimer
from qtpy.QtWidgets import (
    QDockWidget,
    QFileDialog,
    QFrame,
    QHBoxLayout,
    QMainWindow,
    QPushButton,
    QScrollArea,
    QSizePolicy,
    QToolButton,
    QVBoxLayout,
    QWidget,
)

from napari_shadowinv._napari.viewer_sync import (
    USER_ERRORS,
    connect,
    connect_layers,
    error_text,
    show_user_error,
)
from napari_shadowinv.io import check_output, replacing
from napari_shadowinv.io.formats import RESULT, TABLE

Method = TypeVar("Method", bound=Callable[..., Any])

COLOURS = ("#4fa3ff", "#ffb347", "#7ddf64", "#ff6f91", "#b39ddb", "#4dd0e1")
_WIDTH_PX, _SPARE_WIDTH_PX = 330, 40  # of a panel, and of its dock beyond
_LEGEND_CHARACTERS, _HANDLE_CHARACTERS = 56, 5  # of a row above a plot
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


def scrolling_column(holder: QWidget, *widgets: QWidget) -> tuple[QScrollArea, QVBoxLayout]:
    """Fill a widget with a column that scrolls vertically; return its area and its layout."""
    content, area = QWidget(), QScrollArea()
    layout = column(content, *widgets, margin=6)
    layout.setAlignment(Qt.AlignmentFlag.AlignTop)
    area.setWidgetResizable(True)
    area.setFrameShape(QFrame.Shape.NoFrame)
    area.setHorizontalScrollBarPolicy(Qt.ScrollBarPolicy.ScrollBarAlwaysOff)
    area.setWidget(content)
    column(holder, area)
    return area, layout


def side_by_side(*widgets: tuple[QWidget, int], holder: QWidget | None = None) -> QWidget:
    """Lay out widgets in a row, each with its share of the spare width."""
    holder = holder or QWidget()
    layout = QHBoxLayout(holder)
    layout.setContentsMargins(0, 0, 0, 0)
    for widget, share in widgets:
        layout.addWidget(widget, share)
    return holder


def small_button(text: str, tip: str, action: Callable[[], Any]) -> QToolButton:
    return _with_action(QToolButton(text=text), tip, action)


def push_button(text: str, tip: str, action: Callable[[], Any]) -> QPushButton:
    return _with_action(QPushButton(text), tip, action)


def _with_action(button: Any, tip: str, action: Callable[[], Any]) -> Any:
    button.setToolTip(f"<qt>{tip}</qt>")
    button.clicked.connect(lambda: action())
    return button


def filter_of(title: str, endings: Sequence[str]) -> str:
    """Return the filter of a dialog for files with some endings, the usual one first."""
    return f"{title} ({' '.join(f'*{ending}' for ending in endings)})"


TABLES = filter_of("Tables", TABLE.suffixes)
RESULT_FILES = filter_of("Results", RESULT.suffixes)


def ask_file(parent: QWidget, title: str, proposal: str, filters: str) -> Path | None:
    """Ask for a file to write, which may be replaced if it exists; None if the user cancels.

    It has an ending of Qt's `filters`, such as ``"TIFF (*.tif *.tiff);;PNG (*.png)"``; a name
    without one gets the first of the chosen filter, and must be new.
    """

    def complete(name: str, chosen: str) -> Path:
        path = Path(name).expanduser()
        has_ending = path.suffix.lower() in re.findall(r"\*(\.\w+)", filters)
        ending = "" if has_ending else re.findall(r"\*(\.\w+)", chosen)[0]
        return path.with_name(path.name + ending)

    proposed = str(complete(proposal, filters))
    entered, chosen = QFileDialog.getSaveFileName(parent, title, proposed, filters)
    if not entered:
        return None
    path = complete(entered, chosen or filters)
    check_output(path, overwrite=path.name == Path(entered).name)  # Qt asked about this name only
    return path


def write_text(path: Path, text: str) -> None:
    """Write a text whole, or not at all, where `ask_file` allowed it."""
    with replacing(path, overwrite=True) as unfinished:
        unfinished.write_text(text, encoding="utf-8")


def timer(parent: QObject, interval: int, action: Callable[[], Any], once: bool = False) -> QTimer:
    """Create a timer without starting it; `interval` in ms."""
    qt_timer = QTimer(parent, singleShot=once, interval=interval)
    qt_timer.timeout.connect(action)
    return qt_timer


def when_destroyed(owner: QObject, action: Callable[[], Any]) -> None:
    """Call a function when a Qt object is destroyed; it must not hold a reference to the object."""

    def once(*_: object) -> None:
        _callbacks.discard(once)
        action()

    _callbacks.add(once)
    owner.destroyed.connect(once)


def while_alive(
    owner: QObject, model: Any, names: str | Sequence[str], method: Callable[[Any], Any]
) -> None:
    """Connect a method to events of a layer or viewer during the life of a Qt object."""
    when_destroyed(owner, connect(model, names, method))


def layers_while_alive(
    owner: QObject, layers: Any, names: str | Sequence[str], method: Callable[[Any], Any]
) -> None:
    """Connect a method to events of all layers, also new ones, during the life of a Qt object."""
    when_destroyed(owner, connect_layers(layers, names, method))


def notify_errors(method: Method) -> Method:
    """Turn a user's error into a notification; the nearest widget with `show_problem` shows it."""

    @functools.wraps(method)
    def guarded(*args: Any, **kwargs: Any) -> Any:
        try:
            return method(*args, **kwargs)
        except USER_ERRORS as error:
            show_user_error(error)
            widget = args[0]
            while widget is not None and not hasattr(widget, "show_problem"):
                widget = widget.parent()
            if widget is not None:
                widget.show_problem(error_text(error))
            return None

    return guarded  # type: ignore[return-value]


class Docked(QWidget):
    """A widget that opens as a tab of the docks on its side, where napari would squeeze it below.

    napari gives its viewer to a parameter `napari_viewer`.
    """

    def __init__(self) -> None:
        super().__init__()
        self._is_placed = False
        self.setMinimumWidth(_WIDTH_PX)
        self.setSizePolicy(QSizePolicy.Policy.Preferred, QSizePolicy.Policy.Expanding)

    def sizeHint(self) -> QSize:
        return QSize(_WIDTH_PX + _SPARE_WIDTH_PX, 600)

    def showEvent(self, event: Any) -> None:
        super().showEvent(event)
        if not self._is_placed:
            QTimer.singleShot(0, self._join)  # napari lays out the docks after this event

    def _join(self) -> None:
        dock: Any = self.parent()
        while dock is not None and not isinstance(dock, QDockWidget):
            dock = dock.parent()
        window = None if dock is None else dock.parent()
        if self._is_placed or dock is None or not isinstance(window, QMainWindow):
            return
        self._is_placed = True
        if dock.isFloating() or window.tabifiedDockWidgets(dock):
            return
        side = window.dockWidgetArea(dock)
        for neighbour in window.findChildren(QDockWidget):
            is_beside = neighbour is not dock and window.dockWidgetArea(neighbour) == side
            is_shown = neighbour.isVisible() and not neighbour.isFloating()
            if is_beside and is_shown and neighbour.objectName() not in _NAPARI_DOCKS:
                window.tabifyDockWidget(neighbour, dock)
                dock.raise_()
                return


def saved_state(name: str) -> Mapping[str, Any]:
    """Return what a window saved in the settings; empty if there is nothing, or it is damaged."""
    with suppress(ValueError):
        state = json.loads(str(_settings().value(name, "{}")))
        return state if isinstance(state, dict) else {}
    return {}


def save_state(name: str, state: Mapping[str, Any]) -> None:
    """Save JSON values of a window in the settings."""
    settings = _settings()
    settings.setValue(name, json.dumps(state))
    settings.sync()


def _settings() -> QSettings:
    # A readable text file on every system; Qt locks it and replaces it atomically.
    return QSettings(
        QSettings.Format.IniFormat, QSettings.Scope.UserScope, "napari-shadowinv", "widgets"
    )


class Plot(QWidget):
    """A figure, hidden until the first drawing; it grows with the window unless it is `fixed`.

    It is drawn in napari's colours, whatever the user's matplotlibrc says.
    """

    def __init__(self, height: int, *, fixed: bool = False) -> None:
        super().__init__()
        self.setMinimumHeight(height)
        if fixed:
            self.setMaximumHeight(height)
        policy = QSizePolicy.Policy
        self.setSizePolicy(policy.Expanding, policy.Fixed if fixed else policy.Expanding)
        self.setVisible(False)
        column(self)
        self.figure: Any = None
        self.ink, self.paper = "", ""
        self._canvas: Any = None

    def show_drawing(self, draw: Callable[[list[Any]], Any], rows: int = 1) -> None:
        """Draw on empty axes in a column, with the names of their curves above them."""
        self.setVisible(True)
        with self._style():
            if self._canvas is None:
                self._make_canvas()
            self.figure.clear()
            self.figure.set_facecolor(self.paper)
            axes = list(self.figure.subplots(rows, 1, sharex=True, squeeze=False)[:, 0])
            draw(axes)
            for each in axes:
                self._name_curves(each)
        self._canvas.draw_idle()

    def _name_curves(self, axes: Any) -> None:
        """Replace a legend on the curves by a title for a single one, else by a legend above."""
        if axes.get_legend() is not None:
            axes.get_legend().remove()
        _, names = axes.get_legend_handles_labels()
        if len(names) == 1 and not axes.patches:  # bars are there without a name
            axes.set_title(names[0], loc="left")
        elif names:
            columns = max(1, _LEGEND_CHARACTERS // (max(map(len, names)) + _HANDLE_CHARACTERS))
            axes.legend(ncols=columns, loc="lower left", bbox_to_anchor=(0, 1))

    def _make_canvas(self) -> None:
        # Importing matplotlib takes half a second.
        from matplotlib.backends.backend_qtagg import FigureCanvasQTAgg
        from matplotlib.figure import Figure

        untyped: Any = FigureCanvasQTAgg  # as matplotlib's classes are
        style = self._style

        class Canvas(untyped):
            def draw(self) -> None:
                with style():  # also of labels that are made when they are drawn
                    super().draw()

        self.figure = Figure(layout="constrained")
        self._canvas = Canvas(self.figure)
        self._canvas.setMinimumSize(100, 100)
        self.layout().addWidget(self._canvas)

    def _style(self) -> AbstractContextManager[None]:
        from napari_shadowinv.plotting import own_style

        self.ink, self.paper = self._colours()
        inked = ("text.color", "axes.labelcolor", "axes.edgecolor", "xtick.color", "ytick.color")
        return own_style(
            dict.fromkeys((*inked, "grid.color"), self.ink)
            | {"axes.facecolor": self.paper, "axes.grid": True, "grid.alpha": 0.15}
            | dict.fromkeys(("axes.labelsize", "xtick.labelsize", "ytick.labelsize"), 8)
            | dict.fromkeys(("axes.titlesize", "legend.fontsize"), 7)
            | {"legend.frameon": False, "legend.borderaxespad": 0.2}
            | {"legend.handlelength": 1.0, "legend.columnspacing": 0.8}
        )

    def _colours(self) -> tuple[str, str]:
        from napari.settings import get_settings
        from napari.utils.theme import get_theme

        try:
            theme = get_theme(get_settings().appearance.theme)
            return theme.text.as_hex(), theme.background.as_hex()
        except (KeyError, AttributeError, ValueError):
            palette = self.palette()
            return palette.windowText().color().name(), palette.window().color().name()
