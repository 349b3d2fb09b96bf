"""Profiles in a matplotlib canvas that wears napari's colours: `ProfilePlot`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from qtpy.QtWidgets import QSizePolicy, QVBoxLayout, QWidget

from napari_shadowinv._napari.widgets._sampling import Profile

__all__ = ["ProfilePlot"]

_COLOURS = ("#4fa3ff", "#ffb347", "#7ddf64", "#ff6f91", "#b39ddb", "#4dd0e1")
_LONGEST_NAME = 34


class ProfilePlot(QWidget):
    """One plot for each unit, one above the other, with the distance in common."""

    def __init__(self) -> None:
        super().__init__()
        self.setMinimumHeight(220)
        self.setSizePolicy(QSizePolicy.Policy.Expanding, QSizePolicy.Policy.Expanding)
        column = QVBoxLayout(self)
        column.setContentsMargins(0, 0, 0, 0)
        self.figure: Any = None
        self._canvas: Any = None

    def show_profiles(
        self, distance: np.ndarray[Any, Any], unit: str, profiles: Sequence[Profile]
    ) -> None:
        """Draw profiles; none empties the plot."""
        if self._canvas is None:
            if not profiles:
                return
            self._make_canvas()
        ink, paper = self._colours()
        self.figure.clear()
        self.figure.set_facecolor(paper)
        units = list(dict.fromkeys(profile.unit for profile in profiles))
        axes = self.figure.subplots(max(len(units), 1), 1, sharex=True, squeeze=False)[:, 0]
        for axis, of_unit in zip(axes, units or [""], strict=True):
            _dress(axis, ink, paper)
            axis.set_ylabel(of_unit or "value", color=ink)
            for number, profile in enumerate(profiles):
                if profile.unit == of_unit:
                    colour = _COLOURS[number % len(_COLOURS)]
                    axis.plot(distance, profile.values, color=colour, label=_short(profile.name))
            if profiles:
                axis.legend(fontsize=8, labelcolor=ink, facecolor=paper, edgecolor=ink)
        averaged = f", {profiles[0].averaged}" if profiles and profiles[0].averaged else ""
        axes[-1].set_xlabel(f"distance ({unit}){averaged}", color=ink)
        self._canvas.draw_idle()

    def _make_canvas(self) -> None:
        # Half a second to import: not before there is something to draw.
        from matplotlib.backends.backend_qtagg import FigureCanvasQTAgg
        from matplotlib.figure import Figure

        self.figure = Figure(layout="constrained")
        # It comes without types.
        canvas: Any = FigureCanvasQTAgg
        self._canvas = canvas(self.figure)
        self._canvas.setMinimumSize(100, 100)
        self.layout().addWidget(self._canvas)

    def _colours(self) -> tuple[str, str]:
        palette = self.palette()
        from napari.settings import get_settings
        from napari.utils.theme import get_theme

        try:
            theme = get_theme(get_settings().appearance.theme)
            return theme.text.as_hex(), theme.background.as_hex()
        except (KeyError, AttributeError, ValueError):
            return palette.windowText().color().name(), palette.window().color().name()


def _dress(axis: Any, ink: str, paper: str) -> None:
    axis.set_facecolor(paper)
    axis.tick_params(colors=ink, labelsize=8)
    for spine in axis.spines.values():
        spine.set_color(ink)
    axis.grid(color=ink, alpha=0.15)


def _short(name: str) -> str:
    if len(name) <= _LONGEST_NAME:
        return name
    return f"…{name[-_LONGEST_NAME + 1 :]}"
