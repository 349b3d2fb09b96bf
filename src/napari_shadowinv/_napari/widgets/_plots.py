"""Plots in the colours of napari's theme: `Plot`, `ObjectiveCurve`."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby
from typing import Any

import numpy as np
from qtpy import QtWidgets

from napari_shadowinv._napari.widgets import _qt as qt

COLOURS = ("#4fa3ff", "#ffb347", "#7ddf64", "#ff6f91", "#b39ddb", "#4dd0e1")


_CURVE_HEIGHT_PX = 210
_CONSTANT_STAGES = ("samples",)  # do not change the objective


class Plot(QtWidgets.QWidget):
    """A figure, created at the first drawing."""

    def __init__(self, height: int) -> None:
        super().__init__()
        self.setMinimumHeight(height)
        self.setSizePolicy(
            QtWidgets.QSizePolicy.Policy.Expanding, QtWidgets.QSizePolicy.Policy.Expanding
        )
        qt.column(self)
        self.figure: Any = None
        self.ink, self.paper = "", ""
        self._canvas: Any = None

    def fresh_axes(self, rows: int = 1) -> list[Any]:
        """Return empty axes in a column with a common x axis."""
        if self._canvas is None:
            self._make_canvas()
        self.ink, self.paper = self._colours()
        self.figure.clear()
        self.figure.set_facecolor(self.paper)
        axes = list(self.figure.subplots(rows, 1, sharex=True, squeeze=False)[:, 0])
        for axis in axes:
            self._style_axis(axis)
        return axes

    def add_legend(self, holder: Any, size: int = 8, **keywords: Any) -> None:
        colours = {"labelcolor": self.ink, "facecolor": self.paper, "edgecolor": self.ink}
        holder.legend(fontsize=size, **colours, **keywords)

    def draw(self) -> None:
        self._canvas.draw_idle()

    def _make_canvas(self) -> None:
        # Importing matplotlib takes half a second.
        from matplotlib.backends.backend_qtagg import FigureCanvasQTAgg
        from matplotlib.figure import Figure

        self.figure = Figure(layout="constrained")
        # matplotlib's class is untyped.
        canvas: Any = FigureCanvasQTAgg
        self._canvas = canvas(self.figure)
        self._canvas.setMinimumSize(100, 100)
        self.layout().addWidget(self._canvas)

    def _colours(self) -> tuple[str, str]:
        from napari.settings import get_settings
        from napari.utils.theme import get_theme

        try:
            theme = get_theme(get_settings().appearance.theme)
            return theme.text.as_hex(), theme.background.as_hex()
        except (KeyError, AttributeError, ValueError):
            palette = self.palette()
            return palette.windowText().color().name(), palette.window().color().name()

    def _style_axis(self, axis: Any) -> None:
        axis.set_facecolor(self.paper)
        axis.tick_params(colors=self.ink, which="both", labelsize=8)
        for spine in axis.spines.values():
            spine.set_color(self.ink)
        axis.grid(color=self.ink, alpha=0.15)


class ObjectiveCurve(Plot):
    """The objective of a fit at each step, with a colour for each stage."""

    def __init__(self) -> None:
        super().__init__(_CURVE_HEIGHT_PX)
        self.setMaximumHeight(_CURVE_HEIGHT_PX)
        self._shown = 0
        self.setVisible(False)

    def empty(self) -> None:
        self._shown = 0
        self.setVisible(False)

    def show_steps(self, history: Sequence[tuple[str, float]]) -> None:
        """Draw the objective at each step; do nothing without new steps."""
        steps = [step for step in history if step[0] not in _CONSTANT_STAGES]
        if len(steps) == self._shown:
            return
        self._shown = len(steps)
        values = np.array([value for _, value in steps])
        drawable = np.where(values > 0, values, np.nan)
        if np.isfinite(drawable).sum() < 2:
            return
        self.setVisible(True)
        (axis,) = self.fresh_axes()
        colours: dict[str, str] = {}
        begin = 0
        for stage, group in groupby(steps, key=lambda step: step[0]):
            end = begin + len(list(group))
            numbers, objectives = np.arange(begin, end) + 1, drawable[begin:end]
            begin = end
            if np.isnan(objectives).all():
                continue
            label = "" if stage in colours else stage
            colour = colours.setdefault(stage, COLOURS[len(colours) % len(COLOURS)])
            axis.plot(numbers, objectives, "-", color=colour, label=label)
        axis.set_yscale("log")
        axis.set_ylabel("objective", color=self.ink, fontsize=8)
        axis.set_xlabel("step", color=self.ink, fontsize=8)
        self.add_legend(self.figure, 7, loc="outside upper center", ncols=3, frameon=False)
        self.draw()
