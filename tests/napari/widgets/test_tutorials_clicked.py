"""The tutorials by their clicks: menus, labels and buttons as the pages name them."""

from __future__ import annotations

import re
import shlex
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from qtpy import QtWidgets
from qtpy.QtCore import Qt
from typer.testing import CliRunner

from napari_shadowinv import Instrument
from napari_shadowinv._napari.layer_metadata import result_of, role_of, unit_of
from napari_shadowinv._napari.viewer_sync import _text_overlay
from napari_shadowinv._napari.widgets import _panels
from napari_shadowinv._napari.widgets._panels import ReportView
from napari_shadowinv.cli import app
from napari_shadowinv.io.store import DONE

PAGES = Path(__file__).parents[3] / "docs" / "tutorials"
PLUGIN = "Shadowinv"
PATIENCE_MS = 300_000


def page(name):
    return (PAGES / name).read_text(encoding="utf-8")


def plain(text):
    """The text of a menu's entry or a button without its marks."""
    return re.sub(r"[&…]|\.\.\.", "", text).strip()


@pytest.fixture
def choose(window, qtbot):
    """Choose an entry of napari's menus, written as on the pages."""

    def trigger(path):
        owner: Any = window.window._qt_window.menuBar()
        *menus, entry = (plain(part) for part in path.split(">"))
        for name in menus:
            (owner,) = [
                action.menu()
                for action in owner.actions()
                if action.menu() is not None and plain(action.text()) == name
            ]
            owner.aboutToShow.emit()
        matching = [action for action in owner.actions() if entry in plain(action.text())]
        assert len(matching) == 1, [action.text() for action in owner.actions()]
        assert matching[0].isEnabled()
        matching[0].trigger()
        qtbot.wait(50)

    return trigger


@pytest.fixture
def press(qtbot):
    """Press the visible button of a widget that has this text."""

    def click(tool, text):
        (button,) = [
            button
            for button in tool.findChildren(QtWidgets.QAbstractButton)
            if (plain(button.text()) or button.text()) == (plain(text) or text)
            and button.isVisibleTo(tool)
        ]
        assert button.isEnabled()
        button.click()

    return click


@pytest.fixture
def answer_dialogs(monkeypatch):
    """Answer all dialogs that ask for a file with this path."""

    def answer(path):
        for name in ("getSaveFileName", "getOpenFileName"):
            monkeypatch.setattr(QtWidgets.QFileDialog, name, lambda *_, **__: (str(path), ""))

    return answer


def tool_of(window, title):
    """The widget that a menu has opened."""
    (tool,) = [
        dock.widget()
        for dock in window.window._qt_window.findChildren(QtWidgets.QDockWidget)
        if title in dock.windowTitle()
    ]
    return tool


def select(tool, text, label=""):
    """Choose an entry of the one list that offers it, or of the list with this label."""
    (box,) = [
        box
        for box in tool.findChildren(QtWidgets.QComboBox)
        if box.isVisibleTo(tool)
        and box.findText(text) >= 0
        and (not label or label in labels_beside(box))
    ]
    box.setCurrentIndex(box.findText(text))
    box.activated.emit(box.currentIndex())


def labels_beside(box):
    """Texts of the labels in the same row."""
    direct = Qt.FindChildOption.FindDirectChildrenOnly
    labels = box.parentWidget().findChildren(QtWidgets.QLabel, options=direct)
    return {label.text() for label in labels}


def editor_of(tool, title):
    """The editor beside a label of the form that is shown."""
    for form in tool.findChildren(QtWidgets.QFormLayout):
        for row in range(form.rowCount()):
            label = form.itemAt(row, QtWidgets.QFormLayout.ItemRole.LabelRole)
            if label is not None and label.widget().text() == title:
                editor = form.itemAt(row, QtWidgets.QFormLayout.ItemRole.FieldRole).widget()
                if editor.isVisibleTo(tool):
                    return editor
    raise AssertionError(f"no field {title!r}")


def enter(tool, title, text):
    """Type a value, such as "1.3 mm", and leave the field."""
    line = editor_of(tool, title)
    line.setText(text)
    line.editingFinished.emit()


def check(tool, text):
    """Check the visible box with this text."""
    (box,) = [
        box
        for box in tool.findChildren(QtWidgets.QCheckBox)
        if plain(box.text()) == text and box.isVisibleTo(tool)
    ]
    box.click()
    assert box.isChecked()


def wait_for_layers(tool, qtbot):
    """Wait until a run has ended and its layers are there; the Run button stands there again."""
    qtbot.waitUntil(lambda: tool.panel.button.text() == "Run", timeout=PATIENCE_MS)
    qtbot.waitUntil(lambda: not tool.results.busy, timeout=PATIENCE_MS)
    qtbot.wait(50)


def layer_of(window, role):
    """Return the topmost layer with a role."""
    return [layer for layer in window.layers if role_of(layer) == role][-1]


def overlay_text(window):
    """The text in the corner of the canvas."""
    return str(_text_overlay(window).text)


def report_of(tool):
    reports = tool.findChildren(ReportView)
    return "\n".join(f"{title} {text}" for report in reports for title, text in report.rows)


def save_reload(window, tool, path, press, answer_dialogs, button="Save result…"):
    """Save the result, close everything and open the file."""
    answer_dialogs(path)
    press(tool, button)
    assert path.exists()
    window.layers.clear()
    window.open(path, plugin="napari-shadowinv")


def test_first_shadowgram_is_clicked_to_its_end(
    window, choose, press, answer_dialogs, qtbot, tmp_path
):
    text = page("first-shadowgram.md")
    choose(f"File > Open Sample > {PLUGIN} > Toroidal field below caustics")
    assert [layer.name for layer in window.layers if layer.visible] == ["toroid"]
    choose(f"Plugins > {PLUGIN} > Invert")
    tool = tool_of(window, "Invert")
    assert tool.image.layer is window.layers["toroid"]
    press(tool, "Run")
    wait_for_layers(tool, qtbot)
    field = layer_of(window, "field")
    assert field.visible
    assert "9.7 mT·m" in text
    assert float(field.data.max()) == pytest.approx(9.7, rel=0.03)
    assert tool.verdict.text().startswith("<b>Determined</b>")
    (peak,) = re.findall(r"here \*Determined.*?: ([\d.]+ ± [\d.]+) mT", text)
    assert peak in tool.verdict.text()
    assert field.name.startswith("✓ ")
    (residual,) = re.findall(r"image residual of ([\d.]+ %)", text)
    assert residual.replace(" ", "") in report_of(tool).replace(" ", "")
    assert "Warning" not in report_of(tool)

    choose(f"Plugins > {PLUGIN} > Analyse")
    profile = tool_of(window, "Analyse")
    press(profile, "✎")
    middle = field.extent.world.mean(axis=0)
    ends = np.array([field.extent.world[0], field.extent.world[1]])
    ends[:, 0] = middle[0]
    lines = profile.lines.layer
    lines.add_lines(np.array([lines.world_to_data(end) for end in ends]))
    for row in range(profile.layers.count()):
        on = profile.layers.item(row).text() == field.name
        state = Qt.CheckState.Checked if on else Qt.CheckState.Unchecked
        profile.layers.item(row).setCheckState(state)
    qtbot.waitUntil(
        lambda: [one.name for one in profile.profiles] == [field.name], timeout=PATIENCE_MS
    )
    flanks = np.array_split(profile.profiles[0].values, 2)
    for flank in flanks:
        assert np.nanmax(flank) == pytest.approx(9.7, rel=0.04)

    answer_dialogs(tmp_path / "recipe.toml")
    (save,) = [one for one in tool.recipes.menu().actions() if one.text() == "Save…"]
    save.trigger()
    assert (tmp_path / "recipe_source.npy").exists()
    values = np.asarray(field.data)
    save_reload(window, tool, tmp_path / "toroid.shadowinv", press, answer_dialogs)
    again = layer_of(window, "field")
    np.testing.assert_array_equal(np.asarray(again.data), values)
    assert unit_of(again) == "mT·m"
    assert result_of(again) is not None


def test_proton_radiograph_is_clicked_to_its_end(
    window, choose, press, answer_dialogs, qtbot, tmp_path, monkeypatch
):
    text = page("proton-radiograph.md")
    monkeypatch.chdir(tmp_path)
    for block in re.findall(r"```python\n(.*?)```", text, re.DOTALL):
        exec(compile(block, "proton-radiograph.md", "exec"), {})
    window.open(["shot.tif", "reference.tif"], plugin="napari")
    choose(f"Plugins > {PLUGIN} > Invert")
    tool = tool_of(window, "Invert")
    assert (tool.image.layer.name, tool.source.layer.name) == ("shot", "reference")
    select(tool, "particles (protons, …)")
    for title, value in re.findall(r"^\| ([\w ]+) \| `(.*?)` \|", text, re.M):
        enter(tool, title, value)
    answer_dialogs(tmp_path / "setup.toml")
    press(tool.setup, "Save…")
    press(tool, "Run")
    wait_for_layers(tool, qtbot)
    report = report_of(tool)
    (residual,) = re.findall(r"\*\*Image residual\*\* ([\d.]+ %)", text)
    assert f"{residual} of the mean" in report
    assert "Caustics 0 % of the pixels" in report
    assert "Warning" not in report
    field = layer_of(window, "field")
    assert unit_of(field) == "mT·m"
    assert float(field.data.max()) == pytest.approx(15.0, rel=0.02)
    assert str(field.units[-1]) == "micrometer"

    check(tool, "Keep earlier results")
    select(tool, "uniform")
    press(tool, "Run")
    wait_for_layers(tool, qtbot)
    wrong = layer_of(window, "field")
    assert wrong is not field
    assert field in window.layers
    assert wrong.name.startswith("? ")
    peak, error = (float(number) for number in re.findall(r"now ([\d.]+) ± ([\d.]+) mT", text)[0])
    assert float(wrong.data.max()) == pytest.approx(peak, abs=0.06)
    assert f"{peak} ± {error} mT" in report_of(tool)
    (smaller,) = re.findall(r"even smaller \(([\d.]+ %)\)", text)
    assert f"Image residual {smaller} of" in report_of(tool)
    line = tool.verdict.text()
    assert "Reaches the edge" in line
    assert "assumed uniform" in report_of(tool)
    save_reload(window, tool, tmp_path / "shot.shadowinv", press, answer_dialogs)
    assert float(layer_of(window, "field").data.max()) == pytest.approx(peak, abs=0.06)


def test_no_reference_is_clicked_to_its_end(window, choose, press, answer_dialogs, qtbot, tmp_path):
    rows = re.findall(
        r"^\| ([a-z].*?) \| ([\d.]+) \| \d+ \| [\d.]+ \|", page("no-reference.md"), re.M
    )
    peaks = {title: float(peak) for title, peak in rows}
    choose(f"File > Open Sample > {PLUGIN} > Four toroidal fields, uneven beam")
    beam = window.layers["four toroids source"]
    assert not beam.visible
    choose(f"Plugins > {PLUGIN} > Invert")
    tool = tool_of(window, "Invert")
    assert tool.image.layer is window.layers["four toroids"]
    select(tool, "estimate: fitted polynomial")
    press(tool, "Show source")
    qtbot.waitUntil(lambda: not tool.panel.running, timeout=PATIENCE_MS)
    qtbot.waitUntil(lambda: len(window.layers) == 3, timeout=PATIENCE_MS)
    guess = window.layers.selection.active
    assert role_of(guess) == "source"
    assert guess.contrast_limits == window.layers["four toroids"].contrast_limits
    # It is nearer to the true beam than a uniform one is.
    assert np.std(guess.data - beam.data) < 0.7 * np.std(beam.data)

    check(tool, "Keep earlier results")
    fields = []
    verdicts = {
        "estimate: fitted polynomial": "Too uncertain",
        "supplied with the shot": "Determined",
        "uniform": "Too uncertain",
    }
    for title, verdict in verdicts.items():
        select(tool, title)
        press(tool, "Run")
        wait_for_layers(tool, qtbot)
        fields.append(layer_of(window, "field"))
        assert float(fields[-1].data.max()) == pytest.approx(peaks[title], abs=0.06)
        assert verdict in tool.verdict.text()
        assert ("227 %" in report_of(tool)) == title.startswith("estimate")
    assert len({layer.name for layer in fields}) == 3
    save_reload(window, tool, tmp_path / "four.shadowinv", press, answer_dialogs)
    again = float(layer_of(window, "field").data.max())
    assert again == pytest.approx(peaks["uniform"], abs=0.06)


def test_two_energies_are_clicked_to_their_end(
    window, choose, press, answer_dialogs, qtbot, tmp_path, monkeypatch
):
    text = page("two-energies.md")
    monkeypatch.setattr(_panels, "_REDRAW_MS", PATIENCE_MS)  # the curve once, at the end
    choose(f"File > Open Sample > {PLUGIN} > Two energies, beam not recorded")
    choose(f"Plugins > {PLUGIN} > Fit several images")
    tool = tool_of(window, "Fit several images")
    table = tool.images
    rows = [[table.item(row, column).text() for column in (0, 1)] for row in range(2)]
    assert rows == [["14.7 MeV", "14.7"], ["3 MeV", "3"]]
    assert table.horizontalHeaderItem(1).text() == "Energy (MeV)"
    assert {table.item(row, 0).checkState() for row in range(2)} == {Qt.CheckState.Checked}
    source, noise = re.findall(
        r"Set \*\*Source\*\* to \*(.*?)\*, type \*(.*?)\* as \*\*Noise\*\*", text
    )[0]
    select(tool, source, label="Source")
    enter(tool, "Noise", noise)
    press(tool, "Run")
    wait_for_layers(tool, qtbot)
    assert "Determined" in tool.view.verdict.text()
    field, beam = layer_of(window, "field"), layer_of(window, "source")
    assert "peak 30.3 MG µm" in text
    assert unit_of(field) == "mT·m"
    assert float(field.data.max()) == pytest.approx(3.03, rel=0.02)
    assert layer_of(window, "uncertainty").data.shape == field.data.shape
    assert beam.data.std() / beam.data.mean() == pytest.approx(0.103, rel=0.05)

    answer_dialogs(tmp_path / "recipe.toml")
    (save,) = [entry for entry in tool.recipes.menu().actions() if entry.text() == "Save…"]
    save.trigger()
    assert 'noise = "poisson"' in (tmp_path / "recipe.toml").read_text(encoding="utf-8")
    values = np.asarray(field.data)
    save_reload(window, tool, tmp_path / "two.shadowinv", press, answer_dialogs)
    np.testing.assert_array_equal(np.asarray(layer_of(window, "field").data), values)


def test_film_pack_is_clicked_to_its_end(
    window, choose, press, answer_dialogs, qtbot, tmp_path, film_pack
):
    """With three simulated films instead of the real ones."""

    def wait():
        qtbot.waitUntil(lambda: not tool.panel.running, timeout=PATIENCE_MS)
        busy = (tool.results, tool.fit_images)
        qtbot.waitUntil(lambda: not any(layers.busy for layers in busy), timeout=PATIENCE_MS)
        qtbot.wait(50)

    choose(f"Plugins > {PLUGIN} > Film pack")
    tool = tool_of(window, "Film pack")
    answer_dialogs(film_pack.pack)
    press(tool, "…")
    press(tool, "Run")
    wait()
    fluence = layer_of(window, "fluence")
    assert fluence.data.shape[0] == len(tool.spectrum.energies) == 3
    window.dims.set_current_step(0, 1)
    energy = f"{tool.spectrum.energies[1]:.3g} MeV"
    qtbot.waitUntil(lambda: energy in overlay_text(window), timeout=PATIENCE_MS)
    whole = np.array(tool.spectrum.fluence)
    press(tool, "✎")
    tool.regions.layer.add_rectangles([[20, 30], [49, 59]])
    qtbot.waitUntil(lambda: (tool.spectrum.fluence != whole).all(), timeout=PATIENCE_MS)

    press(tool, "Show corners")
    corners = np.array(tool.corners.polygon.data[0])
    corners[0] -= [2, 0]
    tool.corners.polygon.data = [corners]
    press(tool, "Paint mask")
    marks = window.layers.selection.active
    assert marks.mode == "paint"
    marks.paint((1, 40, 50), marks.selected_label)
    press(tool, "Run")
    wait()
    assert "Warning" not in tool.panel.status.text()
    fluence = layer_of(window, "fluence")
    assert (layer_of(window, "unusable").data[1] == marks.selected_label).any()

    press(tool, "Layers for a fit")
    wait()
    films = [layer for layer in window.layers if role_of(layer) == "shot"]
    assert len(films) == 3
    choose(f"Plugins > {PLUGIN} > Fit several images")
    table = tool_of(window, "Fit several images").images
    assert [table.item(row, 0).text() for row in range(3)] == [layer.name for layer in films]

    values = np.asarray(fluence.data)
    save_reload(window, tool, tmp_path / "pack.shadowinv", press, answer_dialogs, "Save…")
    np.testing.assert_array_equal(np.asarray(layer_of(window, "fluence").data), values)


def test_stack_is_clicked_to_its_end(window, choose, press, qtbot, tmp_path, monkeypatch):
    text = page("stack.md")
    monkeypatch.chdir(tmp_path)
    choose(f"File > Open Sample > {PLUGIN} > Plasma wave, 20 optical shots")
    choose(f"Plugins > {PLUGIN} > Invert")
    tool = tool_of(window, "Invert")
    select(tool, "high-pass")
    tool.store.folder.restore({"path": str(tmp_path / "night.shadowinv.zarr")})
    press(tool, "Run")
    wait_for_layers(tool, qtbot)
    field = layer_of(window, "field")
    assert field.data.shape[0] == 20
    window.dims.set_current_step(0, 12)
    qtbot.wait(50)

    (command,) = re.findall(r"^    shadowinv (info .*)$", text, re.M)
    result = CliRunner().invoke(app, shlex.split(command))
    assert result.exit_code == 0, result.output
    names: dict[str, Any] = {}
    (lines,) = re.findall(r"^    import xarray\n(?:    .*\n)+", text, re.M)
    exec(re.sub("^    ", "", lines, flags=re.M), names)
    night = names["night"]
    assert (night.status == DONE).all()
    window.layers.clear()
    window.open(tmp_path / "night.shadowinv.zarr", plugin="napari-shadowinv")
    assert layer_of(window, "field").data.shape[0] == 20


def test_film_without_reference_is_clicked_to_its_verdict(
    window, choose, press, qtbot, tmp_path, monkeypatch
):
    text = page("film-without-reference.md")
    monkeypatch.chdir(tmp_path)
    block = re.findall(r"```python\n(.*?)```", text, re.DOTALL)[0]
    exec(compile(block, "film-without-reference.md", "exec"), {})
    window.open("8MeV.tif", plugin="napari")
    choose(f"Plugins > {PLUGIN} > Invert")
    tool = tool_of(window, "Invert")
    select(tool, "particles (protons, …)")
    for title, value in re.findall(r"^\| ([\w ]+) \| `(.*?)` \|", text, re.M):
        enter(tool, title, value)
    press(tool, "Instrument")
    for entry, title in re.findall(r"\*([\w ]+)\* under \*\*([\w ]+)\*\*", text):
        select(tool, entry, title)
    press(tool, "Run")
    wait_for_layers(tool, qtbot)
    assert tool.instrument.model() == Instrument(detector="film", beam_source="TNSA")
    report = report_of(tool)
    assert tool.verdict.text().startswith("<b>Too uncertain</b>")
    for number in ("1.75 ± 0.42 mT·m", "98 % of the field"):
        assert number in text
        assert number in report
