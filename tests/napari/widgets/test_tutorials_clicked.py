"""The tutorials by their clicks: menus, labels and buttons as the pages name them."""

import re
import shlex
from pathlib import Path

import numpy as np
import pytest
from qtpy import QtWidgets
from qtpy.QtCore import Qt
from typer.testing import CliRunner

from napari_shadowinv import Instrument
from napari_shadowinv._napari.layer_metadata import result_of, role_of, unit_of
from napari_shadowinv._napari.viewer_sync import _text_overlay
from napari_shadowinv._napari.widgets._panels import ReportView
from napari_shadowinv.cli import app
from napari_shadowinv.io.store import DONE

PAGES = Path(__file__).parents[3] / "docs" / "tutorials"
PLUGIN = "Shadowinv"


def page(name):
    return (PAGES / name).read_text(encoding="utf-8")


def plain(text):
    """The text of a menu's entry or a button without its marks."""
    return re.sub(r"[&…]|\.\.\.", "", text).strip()


@pytest.fixture
def menu(window, qtbot):
    """Choose an entry of napari's menus, written as on the pages."""

    def trigger(path):
        owner = window.window._qt_window.menuBar()
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
def opened(window, menu):
    """Open a window of the plugin by the menu, and return it."""

    def by_menu(title):
        menu(f"Plugins > {PLUGIN} > {title}")
        docks = window.window._qt_window.findChildren(QtWidgets.QDockWidget)
        (tool,) = [dock.widget() for dock in docks if title in dock.windowTitle()]
        return tool

    return by_menu


def press(tool, text):
    """Press the visible button of a widget that has this text."""
    (button,) = [
        button
        for button in tool.findChildren(QtWidgets.QAbstractButton)
        if (plain(button.text()) or button.text()) == (plain(text) or text)
        and button.isVisibleTo(tool)
    ]
    assert button.isEnabled()
    button.click()


@pytest.fixture
def run(rest, qtbot):
    """Press Run, and wait until the layers are there and the button is as before."""

    def pressed(tool):
        press(tool, "Run")
        rest(tool)
        assert tool.panel.button.text() == "Run"
        qtbot.wait(50)

    return pressed


@pytest.fixture
def save_reload(window, choose):
    """Save the result under a name without ending, close everything and open the file."""

    def saved(tool, path, button="Save result…"):
        choose(path.with_suffix(""))
        press(tool, button)
        assert path.exists()
        window.layers.clear()
        window.open(path, plugin="napari-shadowinv")

    return saved


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


def enter_setup(tool, text):
    """Type the setup of a page's table."""
    select(tool, "particles (protons, …)")
    for title, value in re.findall(r"^\| ([\w ]+) \| `(.*?)` \|", text, re.M):
        enter(tool, title, value)


def layer_of(window, role):
    """Return the topmost layer with a role."""
    return [layer for layer in window.layers if role_of(layer) == role][-1]


def report_of(tool):
    reports = tool.findChildren(ReportView)
    return "\n".join(f"{title} {text}" for report in reports for title, text in report.rows)


def test_first_shadowgram_is_clicked_to_its_end(
    window, tmp_path, menu, opened, run, save_reload, choose, wait, messages
):
    text = page("first-shadowgram.md")
    menu(f"File > Open Sample > {PLUGIN} > Toroidal field below caustics")
    assert [layer.name for layer in window.layers if layer.visible] == ["toroid"]
    tool = opened("Invert")
    assert tool.image.layer is window.layers["toroid"]
    run(tool)
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

    profile = opened("Analyse")
    press(profile, "✎")
    middle = field.extent.world.mean(axis=0)
    ends = np.array([field.extent.world[0], field.extent.world[1]])
    ends[:, 0] = middle[0]
    lines = profile.lines.layer
    lines.add_lines(np.array([lines.world_to_data(end) for end in ends]))
    for layer in profile.layers:
        layer.visible = layer is field
    wait(lambda: [one.name for one in profile.profiles] == [field.name])
    flanks = np.array_split(profile.profiles[0].values, 2)
    for flank in flanks:
        assert np.nanmax(flank) == pytest.approx(9.7, rel=0.04)

    choose(tmp_path / "recipe.toml")
    (save,) = [one for one in tool.recipes.menu().actions() if one.text() == "Save…"]
    save.trigger()
    assert (tmp_path / "recipe_source.npy").exists()
    verdict, values, setup = tool.verdict.text(), np.asarray(field.data), tool.setup.setup()
    names = [layer.name for layer in window.layers if result_of(layer) is not None]
    save_reload(tool, tmp_path / "toroid.shadowinv")
    assert "toroid.shadowinv" in messages[-1]
    wait(lambda: role_of(window.layers.selection.active) == "field")
    again = window.layers.selection.active
    np.testing.assert_array_equal(np.asarray(again.data), values)
    assert unit_of(again) == "mT·m"
    assert result_of(again) is not None
    assert again.colorbar.visible
    assert tool.verdict.text() == verdict
    assert [layer.name for layer in window.layers if layer.name in names] == names
    assert {role_of(layer) for layer in window.layers if layer.visible} == {"field", "arrows"}
    # The image has its setup and source, and is a shot again.
    assert role_of(tool.image.layer) == "image"
    assert tool.setup.setup() == setup
    run(tool)
    strongest = window.layers.selection.active.data.max()
    assert strongest == pytest.approx(values.max(), rel=1e-6)


def test_proton_radiograph_is_clicked_to_its_end(
    window, tmp_path, monkeypatch, opened, run, save_reload, choose
):
    text = page("proton-radiograph.md")
    monkeypatch.chdir(tmp_path)
    for block in re.findall(r"```python\n(.*?)```", text, re.DOTALL):
        exec(compile(block, "proton-radiograph.md", "exec"), {})
    window.open(["shot.tif", "reference.tif"], plugin="napari")
    tool = opened("Invert")
    assert (tool.image.layer.name, tool.source.layer.name) == ("shot", "reference")
    enter_setup(tool, text)
    choose(tmp_path / "setup.toml")
    press(tool.setup, "Save…")
    run(tool)
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
    run(tool)
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
    save_reload(tool, tmp_path / "shot.shadowinv")
    assert float(layer_of(window, "field").data.max()) == pytest.approx(peak, abs=0.06)


def test_no_reference_is_clicked_to_its_end(window, tmp_path, menu, opened, run, save_reload, wait):
    rows = re.findall(
        r"^\| ([a-z].*?) \| ([\d.]+) \| \d+ \| [\d.]+ \|", page("no-reference.md"), re.M
    )
    peaks = {title: float(peak) for title, peak in rows}
    menu(f"File > Open Sample > {PLUGIN} > Four toroidal fields, uneven beam")
    beam = window.layers["four toroids source"]
    assert not beam.visible
    tool = opened("Invert")
    assert tool.image.layer is window.layers["four toroids"]
    select(tool, "estimate: fitted polynomial")
    press(tool, "Show source")
    wait(lambda: not tool.panel.running)
    wait(lambda: len(window.layers) == 3)
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
        run(tool)
        fields.append(layer_of(window, "field"))
        assert float(fields[-1].data.max()) == pytest.approx(peaks[title], abs=0.06)
        assert verdict in tool.verdict.text()
        assert ("228 %" in report_of(tool)) == title.startswith("estimate")
    assert len({layer.name for layer in fields}) == 3
    save_reload(tool, tmp_path / "four.shadowinv")
    again = float(layer_of(window, "field").data.max())
    assert again == pytest.approx(peaks["uniform"], abs=0.06)


def test_two_energies_are_clicked_to_their_end(
    window, tmp_path, menu, opened, run, save_reload, choose
):
    text = page("two-energies.md")
    menu(f"File > Open Sample > {PLUGIN} > Two energies, beam not recorded")
    tool = opened("Fit several images")
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
    run(tool)
    assert "Determined" in tool.view.verdict.text()
    field, beam = layer_of(window, "field"), layer_of(window, "source")
    assert "peak 30.3 MG µm" in text
    assert unit_of(field) == "mT·m"
    assert float(field.data.max()) == pytest.approx(3.03, rel=0.02)
    assert layer_of(window, "uncertainty").data.shape == field.data.shape
    assert beam.data.std() / beam.data.mean() == pytest.approx(0.103, rel=0.05)

    choose(tmp_path / "recipe.toml")
    (save,) = [entry for entry in tool.recipes.menu().actions() if entry.text() == "Save…"]
    save.trigger()
    assert 'noise = "poisson"' in (tmp_path / "recipe.toml").read_text(encoding="utf-8")
    values = np.asarray(field.data)
    save_reload(tool, tmp_path / "two.shadowinv")
    np.testing.assert_array_equal(np.asarray(layer_of(window, "field").data), values)


def test_film_pack_is_clicked_to_its_end(
    window, tmp_path, film_pack, pack_doses, opened, run, save_reload, choose, rest, wait
):
    """With three simulated films instead of the real ones."""
    tool = opened("Film pack")
    choose(film_pack.pack)
    press(tool, "…")
    run(tool)
    names = [f"{title} – trio" for title in ("dose (Gy)", "fluence (1/(m² MeV))", "unusable")]
    assert [layer.name for layer in window.layers] == names
    fluence = layer_of(window, "fluence")
    np.testing.assert_array_equal(fluence.data, pack_doses.fluence)
    assert window.layers.selection.active is tool.packs.layer is fluence
    first, _, last = (f"{energy:.3g}" for energy in pack_doses.energies)
    assert f"Films 3, {first} to {last} MeV" in report_of(tool)
    films = zip(pack_doses.fluence.astype(float), pack_doses.usable, strict=True)
    np.testing.assert_allclose(tool.spectrum.fluence, [film[used].mean() for film, used in films])
    (hatched,) = [patch for patch in tool.plot.figure.axes[0].patches if patch.get_hatch()]
    low = hatched.get_x()
    assert low <= tool.spectrum.energies[-1] <= low + hatched.get_width()
    # The same pack again takes the place of its result.
    run(tool)
    assert len(window.layers) == 3
    window.dims.set_current_step(0, 1)
    energy = f"{tool.spectrum.energies[1]:.3g} MeV"
    wait(lambda: energy in str(_text_overlay(window).text))
    whole = np.array(tool.spectrum.fluence)
    press(tool, "✎")
    tool.regions.layer.add_rectangles([[20, 30], [49, 59]])
    wait(lambda: (tool.spectrum.fluence != whole).all())

    press(tool, "Show corners")
    polygon = window.layers.selection.active
    corners = np.array(polygon.data[0])
    corners[0] -= [2, 0]
    polygon.data = [corners]
    press(tool, "Paint mask")
    marks = window.layers.selection.active
    assert marks.mode == "paint"
    marks.paint((1, 40, 50), marks.selected_label)
    run(tool)
    assert "Warning" not in tool.panel.status.text()
    fluence = layer_of(window, "fluence")
    assert (layer_of(window, "unusable").data[1] == marks.selected_label).any()

    press(tool, "Layers for a fit")
    rest(tool)
    films = [layer for layer in window.layers if role_of(layer) == "shot"]
    assert len(films) == 3
    table = opened("Fit several images").images
    assert [table.item(row, 0).text() for row in range(3)] == [layer.name for layer in films]

    values = np.asarray(fluence.data)
    save_reload(tool, tmp_path / "pack.shadowinv", "Save…")
    np.testing.assert_array_equal(np.asarray(layer_of(window, "fluence").data), values)


def test_stack_is_clicked_to_its_end(window, tmp_path, monkeypatch, menu, opened, run, wait, qtbot):
    text = page("stack.md")
    monkeypatch.chdir(tmp_path)
    menu(f"File > Open Sample > {PLUGIN} > Plasma wave, 20 optical shots")
    tool = opened("Invert")
    select(tool, "high-pass")
    tool.store.folder.restore({"path": str(tmp_path / "night.shadowinv.zarr")})
    run(tool)
    field = layer_of(window, "field")
    assert field.data.shape[0] == 20
    window.dims.set_current_step(0, 12)
    qtbot.wait(50)

    (command,) = re.findall(r"^    shadowinv (export .*)$", text, re.M)
    result = CliRunner().invoke(app, shlex.split(command))
    assert result.exit_code == 0, result.output
    names = {}
    (lines,) = re.findall(r"^    import xarray\n(?:    .*\n)+", text, re.M)
    exec(re.sub("^    ", "", lines, flags=re.M), names)
    night = names["night"]
    assert (night.status == DONE).all()
    window.layers.clear()
    window.open(tmp_path / "night.shadowinv.zarr", plugin="napari-shadowinv")
    assert layer_of(window, "field").data.shape[0] == 20


def test_film_without_reference_is_clicked_to_its_verdict(
    window, tmp_path, monkeypatch, opened, run
):
    text = page("film-without-reference.md")
    monkeypatch.chdir(tmp_path)
    block = re.findall(r"```python\n(.*?)```", text, re.DOTALL)[0]
    exec(compile(block, "film-without-reference.md", "exec"), {})
    window.open("8MeV.tif", plugin="napari")
    tool = opened("Invert")
    enter_setup(tool, text)
    press(tool, "Instrument")
    for entry, title in re.findall(r"\*([\w ]+)\* under \*\*([\w ]+)\*\*", text):
        select(tool, entry, title)
    run(tool)
    assert tool.instrument.model() == Instrument(detector="film", beam_source="TNSA")
    report = report_of(tool)
    assert tool.verdict.text().startswith("<b>Too uncertain</b>")
    for number in ("1.76 ± 0.45 mT·m", "98 % of the field"):
        assert number in text
        assert number in report
