"""What all windows share: their place, and their work in a thread."""

import math
import threading
from types import SimpleNamespace

import numpy as np
import pytest
from matplotlib import rc_context
from matplotlib.text import Text
from qtpy.QtCore import Qt
from qtpy.QtWidgets import QDockWidget, QLabel

from helpers.forms import enter
from helpers.windows import running_threads
from napari_shadowinv import InputError, ProtonSetup
from napari_shadowinv._napari.form import PROBLEM_STYLE, ModelPicker
from napari_shadowinv._napari.layer_metadata import metadata_for, role_of
from napari_shadowinv._napari.layers import add_to_viewer
from napari_shadowinv._napari.run import Outcome, Run
from napari_shadowinv._napari.simulate import Simulate
from napari_shadowinv._napari.widgets._qt import Plot
from napari_shadowinv._napari.widgets.analyse import Analyse
from napari_shadowinv._napari.widgets.film_pack import FilmPack
from napari_shadowinv._napari.widgets.fit_images import FitImages
from napari_shadowinv._napari.widgets.invert import Invert
from napari_shadowinv.preprocessing import STEPS

NAMES = ("Invert", "Fit several images", "Film pack", "Simulate", "Analyse")
QUICK = {"samples": 0, "max_iterations": 3, "spacing": 0.25, "smoothness": 5.0}
EXAMPLE = ProtonSetup.example()


def test_each_fits_beside_the_canvas(window, open_widget, shot, qtbot, wait):
    """It needs no sideways scrolling and has no gaps, in windows of any size."""
    for name in ("shot", "another shot of a long name"):
        window.add_image(shot, name=name)
    for name in NAMES:
        tool = open_widget(name)
        wait(tool.isVisible)
        if name == "Invert":
            tool.setup.show_setup(EXAMPLE.model_dump())
            for step in STEPS:
                tool.steps.add(step)
            tool.steps.folded.expand()
            tool.image.set_kind("folder")
        for size in ((1280, 800), (2560, 1440)):
            window.window._qt_window.resize(*size)
            qtbot.wait(50)
            fits = tool.minimumSizeHint().width()
            assert fits <= 360
            wait(lambda: tool.width() >= fits)  # noqa: B023
            bottom = tool.mapTo(window.window._qt_window, tool.rect().bottomLeft()).y()
            assert bottom <= size[1]
            if hasattr(tool, "area"):
                wait(lambda: tool.area.horizontalScrollBar().maximum() == 0)  # noqa: B023
                spread = tool.area.widget().layout().expandingDirections()
                assert not spread & Qt.Orientation.Vertical


def test_docks_share_their_place_as_tabs(window, open_widget, qtbot, wait):
    main = window.window._qt_window
    tools = [open_widget(name) for name in ("Invert", "Analyse", "Simulate")]
    docks = [next(d for d in main.findChildren(QDockWidget) if d.isAncestorOf(t)) for t in tools]
    wait(lambda: len(main.tabifiedDockWidgets(docks[0])) == 2)
    assert set(main.tabifiedDockWidgets(docks[0])) == set(docks[1:])
    wait(tools[-1].isVisible)  # the latest is in front
    assert tools[-1].height() > 0.7 * main.height()
    # Whoever puts one elsewhere finds it there when it is shown again.
    main.addDockWidget(Qt.DockWidgetArea.LeftDockWidgetArea, docks[0])
    docks[0].hide()
    docks[0].show()
    qtbot.wait(100)
    assert main.dockWidgetArea(docks[0]) == Qt.DockWidgetArea.LeftDockWidgetArea
    assert docks[1] not in main.tabifiedDockWidgets(docks[0])


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


def a_shot(viewer, opened, shot, **_):
    viewer.add_image(shot, name="shot")
    tool = opened(Invert)
    tool.options.restore({"n_sites": 300})
    return tool


def a_stack(viewer, opened, shot, tmp_path, **_):
    viewer.add_image(np.stack([shot, shot]), name="run")
    tool = opened(Invert)
    tool.store.folder.restore({"path": str(tmp_path / "run.shadowinv.zarr")})
    return tool


def a_fit(viewer, opened, shot, **_):
    for name, energy in (("fast", 14.7), ("slow", 6.0)):
        setup = EXAMPLE.model_copy(update={"energy": energy})
        viewer.add_image(shot + energy, name=name, metadata=metadata_for("shot", "", setup))
    tool = opened(FitImages)
    tool.options.restore(QUICK)
    return tool


def a_pack(opened, film_pack, **_):
    tool = opened(FilmPack)
    tool.file.restore({"file": str(film_pack.pack)})
    return tool


def an_image(opened, **_):
    return opened(Simulate)


def a_plan(opened, **_):
    tool = opened(Simulate)
    tool.task.set_kind("plan")
    return tool


def a_product(viewer, opened, solved, **_):
    add_to_viewer(viewer, solved, EXAMPLE)
    tool = opened(Analyse).products
    tool.product.set_kind("current-density")
    return tool


@pytest.fixture
def ready(viewer, opened, shot, tmp_path, film_pack, solved):
    """Open a window with inputs that can be run."""
    inputs = {"shot": shot, "tmp_path": tmp_path, "film_pack": film_pack, "solved": solved}
    return lambda make: make(viewer=viewer, opened=opened, **inputs)


@pytest.mark.parametrize("make", [a_shot, a_stack, a_fit, a_pack, an_image, a_plan, a_product])
def test_cancelled_work_leaves_nothing(ready, cancelled, held, make):
    cancelled(ready(make))
    assert held.stops == [True]


def test_an_image_deleted_during_the_run_is_told_once(
    ready, viewer, held, rest, messages, proton_setup
):
    tool = ready(a_shot)
    tool.setup.show_setup(proton_setup.model_dump())
    tool.panel.button.click()
    first = viewer.layers[0]
    viewer.layers.remove(first)
    held.set()
    rest(tool)
    told = [text for text in messages if "was deleted" in text]
    assert told == ["'shot' was deleted during its inversion; the result is shown anyway"]
    assert any(role_of(layer) == "field" and layer.data.any() for layer in viewer.layers)
    # Pixels beside micrometres would take the scale bar's unit away.
    assert {str(layer.units[-1]) for layer in viewer.layers} == {"micrometer"}
    assert all(tuple(layer.scale[-2:]) == pytest.approx((1.5, 1.5)) for layer in viewer.layers)


@pytest.mark.parametrize("what", ["window", "dock"])
def test_closing_ends_the_work(make_napari_viewer, qtbot, wait, shot, held, messages, what):
    viewer = make_napari_viewer(show=True)
    viewer.add_image(shot)
    _, tool = viewer.window.add_plugin_dock_widget("napari-shadowinv", "Invert")
    tool.panel.button.click()
    assert running_threads()
    if what == "window":
        viewer.close()
    else:
        viewer.window.remove_dock_widget(tool)
        tool.deleteLater()
    wait(lambda: not running_threads())
    qtbot.wait(100)
    if what == "dock":
        viewer.add_image(shot)
    assert messages == []


class Stubborn:
    """Work that checks whether to stop only when allowed to."""

    def __init__(self):
        self.may_look = threading.Event()
        self.stopped = threading.Event()

    def __call__(self, on_progress, should_stop):
        self.may_look.wait(30)
        if should_stop():
            self.stopped.set()
        return "late"


@pytest.fixture
def panel(qtbot):
    """A button that remembers how its work ended."""
    run = Run("Run", "Do it.")
    qtbot.addWidget(run)
    run.outcomes = []
    run.ended.connect(run.outcomes.append)
    return run


def test_work_that_does_not_stop_is_left_alone(panel, wait):
    work = Stubborn()
    panel.start(work, tag="first")
    panel.cancel()
    wait(lambda: not panel.running)
    assert not work.may_look.is_set()
    assert panel.outcomes == [Outcome(cancelled=True, tag="first")]
    panel.start(lambda *_: "next", tag="second")
    work.may_look.set()
    assert work.stopped.wait(5)
    wait(lambda: not panel.running)
    assert panel.outcomes[1:] == [Outcome("next", tag="second")]


def test_work_that_must_be_finished_is_waited_for(panel, qtbot, wait):
    work, job = Stubborn(), SimpleNamespace(patience=math.inf)
    panel.start(work, job)
    panel.cancel()
    qtbot.wait(800)
    assert panel.running
    assert panel.outcomes == []
    work.may_look.set()
    wait(lambda: not panel.running)
    assert panel.outcomes == [Outcome("late", tag=job)]


def test_what_went_wrong_stays_until_the_next_run(panel, qtbot, wait, messages):
    def mistaken(*_):
        raise InputError("the film has no grain: expected some; take another one")

    panel.start(mistaken)
    wait(lambda: not panel.running)
    qtbot.wait(700)
    status = panel.status
    assert status.text() == messages[0] == "The film has no grain: expected some; take another one"
    panel.start(lambda *_: None)
    assert (status.text(), status.styleSheet()) == ("Starting…", "")
    wait(lambda: not panel.running)
    assert status.isHidden()
