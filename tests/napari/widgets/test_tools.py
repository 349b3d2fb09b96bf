"""What all widgets share, in a real window."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.text import Text
from qtpy.QtWidgets import QLabel

from helpers.forms import enter
from napari_shadowinv._napari.form import PROBLEM_STYLE, ModelPicker
from napari_shadowinv._napari.widgets._qt import Plot

Array = np.ndarray[Any, Any]
PATIENCE = 60_000  # ms
NAMES = (
    "Invert",
    "Fit several images",
    "Film pack",
    "Simulate",
    "Analyse",
)


def test_each_widget_fits_beside_the_canvas(window, open_widget, shot, qtbot):
    window.add_image(shot, name="shot")
    for name in NAMES:
        widget = open_widget(name)
        qtbot.waitUntil(widget.isVisible, timeout=PATIENCE)
        fits = widget.minimumSizeHint().width
        assert fits() <= 360
        for size in ((1280, 800), (2560, 1440)):
            window.window._qt_window.resize(*size)
            qtbot.wait(30)
            qtbot.waitUntil(lambda: widget.width() >= fits(), timeout=PATIENCE)  # noqa: B023
            bottom = widget.mapTo(window.window._qt_window, widget.rect().bottomLeft()).y()
            assert bottom <= size[1]


def orange_texts(tool):
    return [
        label.text()
        for label in tool.findChildren(QLabel)
        if PROBLEM_STYLE in label.styleSheet() and label.text() and label.isVisibleTo(tool)
    ]


def test_nothing_is_orange_before_something_is_typed(window, open_widget, shot, qtbot):
    """In every form that can be chosen, and once there is an image."""
    tools = {name: open_widget(name) for name in NAMES}
    chosen = 0
    for name, tool in tools.items():
        assert orange_texts(tool) == [], name
        for picker in tool.findChildren(ModelPicker):
            before = picker.choice.value
            for value in picker.choice.choices:
                picker.choice.value = value
                assert orange_texts(tool) == [], (name, picker.choice.current_choice)
                chosen += 1
            if before is not None:
                picker.choice.value = before
    assert chosen > 20
    window.add_image(shot, name="shot")
    qtbot.wait(50)
    for name, tool in tools.items():
        assert orange_texts(tool) == [], name
    setup = tools["Invert"].setup
    for kind in setup.choice.choices:
        setup.set_kind(kind)
        assert orange_texts(tools["Invert"]) == [], setup.choice.current_choice
    setup.set_kind("proton")
    enter(setup.form.entries["energy"], 14.7)
    assert any("Source" in text for text in orange_texts(tools["Invert"]))


def test_a_plot_ignores_the_settings_of_other_figures(qtbot):
    plot = Plot(200)
    qtbot.addWidget(plot)

    def draw(columns):
        columns[0].plot([0, 1], [0, 1], label="a_b")
        columns[0].set_xlabel("50 % of a_b")  # no text that TeX takes
        columns[0].legend()

    with rc_context({"text.usetex": True}):
        plot.show_drawing(draw)
        plot.figure.canvas.draw()
    assert not any(text.get_usetex() for text in plot.figure.findobj(Text))
