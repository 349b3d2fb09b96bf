"""The widget that fits several images, and Refine of the widget for one, in a real window."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from qtpy.QtCore import Qt

from napari_shadowinv import ProtonSetup, read
from napari_shadowinv._napari.fit_layers import fit_layers
from napari_shadowinv._napari.layer_metadata import (
    keep_setup,
    mark,
    result_of,
    role_of,
    setup_of,
    unit_of,
)
from napari_shadowinv._napari.widgets._fitting import FitAnswer
from napari_shadowinv.errors import InputError
from napari_shadowinv.fitting import Fit, FitOptions, Verdict, fit
from napari_shadowinv.physics.forward import synthetic_image
from napari_shadowinv.physics.phantoms import gaussian_blob
from napari_shadowinv.physics.projection import project, transferred_displacement
from napari_shadowinv.physics.setup import OpticalSetup

Array = np.ndarray[Any, Any]
PATIENCE = 120_000  # ms
SHAPE = (48, 64)
LENGTHS = {"source_object_distance": 1.3e-3, "object_image_distance": 2e-2, "pixel_size": 1.5e-6}
ENERGIES = (14.7, 6.0)
SETUPS = tuple(ProtonSetup(energy=energy, **LENGTHS) for energy in ENERGIES)
TRUTH = gaussian_blob(SHAPE, 20.0, 8.0, (22.0, 35.0)).displacement
BEAM, GAIN, PSF = 1, 2, 3
QUICK = {"samples": 0, "steps": 5}


def images(noise: float = 0.01) -> list[Array]:
    """One magnetic object at two energies."""
    rng = np.random.default_rng(5)
    planes = [project(TRUTH, SETUPS[0], setup) for setup in SETUPS]
    return [300 * plane * rng.normal(1, noise, plane.shape) for plane in planes]


@pytest.fixture
def tool(window: Any, open_widget: Callable[[str], Any]) -> Any:
    for energy, setup, image in zip(ENERGIES, SETUPS, images(), strict=True):
        window.add_image(image, name=f"{energy} MeV", metadata=mark("shot", "", setup))
    widget = open_widget("Fit several images")
    widget.options.set_values(QUICK)
    return widget


@pytest.fixture(scope="session")
def fitted() -> Fit:
    """What the widget finds from its two images, without the window."""
    options = FitOptions(samples=2, steps=5)
    return fit(np.stack(images()), setups=SETUPS, psf=[0, 0], options=options)


@pytest.fixture
def show(qtbot: Any) -> Callable[[Any, Fit], None]:
    """Show a fit as if the widget had made it."""

    def shown(tool: Any, found: Fit) -> None:
        job = tool.request()
        described = fit_layers(found, job.frame, job.name, attributes=job.attributes)
        tool.show_result(FitAnswer(found, described), job)
        qtbot.waitUntil(lambda: not tool.results.busy, timeout=PATIENCE)

    return shown


@pytest.fixture
def run(qtbot: Any) -> Callable[[Any], Any]:
    """Press Run, wait until the layers are there, and return the result."""

    def pressed(widget: Any) -> Any:
        answers: list[Any] = []
        widget.panel.runner.ended.connect(answers.append)
        widget.panel.button.click()
        qtbot.waitUntil(lambda: bool(answers), timeout=PATIENCE)
        assert answers[0].error is None
        assert not answers[0].cancelled
        qtbot.waitUntil(lambda: not widget.results.busy, timeout=PATIENCE)
        return answers[0].value.fit

    return pressed


def layer_of(viewer: Any, role: str, word: str = "") -> Any:
    found = [one for one in viewer.layers if role_of(one) == role and word in one.name]
    assert len(found) == 1, [one.name for one in viewer.layers]
    return found[0]


def texts(tool: Any, column: int) -> list[str]:
    table = tool.images.table
    return [table.item(row, column).text() for row in range(table.rowCount())]


def type_in(tool: Any, row: int, column: int, text: str) -> None:
    tool.images.table.item(row, column).setText(text)


def test_the_table_is_filled_from_the_layers(window: Any, tool: Any, assert_it_fits: Any) -> None:
    window.add_image(np.ones((20, 30)), name="another size")
    window.add_image(np.ones((*SHAPE, 3)), name="colour", rgb=True)
    window.add_image(np.ones(SHAPE), name="beam", metadata=mark("source", ""))
    assert texts(tool, 0) == ["14.7 MeV", "6.0 MeV", "another size"]
    assert texts(tool, BEAM) == ["14.7", "6", ""]
    assert tool.images.table.horizontalHeaderItem(BEAM).text() == "Energy (MeV)"
    assert texts(tool, GAIN)[:2] == ["1", "1"]
    assert texts(tool, PSF)[:2] == ["0", "0"]
    assert tool.setup.setup() == SETUPS[0]
    window.layers["6.0 MeV"].name = "slow"
    assert texts(tool, 0)[1] == "slow"
    assert_it_fits(tool)


def test_what_is_asked_for_is_what_the_controls_show(window: Any, tool: Any) -> None:
    type_in(tool, 1, BEAM, "7 MeV")
    type_in(tool, 1, GAIN, "1.2")
    type_in(tool, 1, PSF, "0.8 px")
    tool.noise.restore("poisson")
    keywords = tool.request().keywords
    assert [one.energy for one in keywords["setups"]] == [14.7, 7.0]
    assert keywords["gains"] == [1.0, 1.2]
    assert keywords["psf"] == [0.0, 0.8]
    assert keywords["noise"] == "poisson"
    assert keywords["source"] is None
    assert keywords["options"] == FitOptions(**QUICK)
    # The image's own setup stays; what was typed stays with its layer, not with the widget.
    assert setup_of(window.layers["6.0 MeV"]) == SETUPS[1]
    window.add_image(np.ones((20, 30)))
    assert texts(tool, BEAM)[:2] == ["14.7", "7"]
    tool.gains.restore("free")
    assert tool.request().keywords["gains"] == "free"
    assert texts(tool, GAIN)[:2] == ["free", "free"]
    # The energy of the first image is that of the setup below, whichever is edited.
    type_in(tool, 0, BEAM, "15")
    assert tool.setup.setup().energy == 15
    tool.setup.show_setup(SETUPS[0].model_dump())
    assert texts(tool, BEAM)[0] == "14.7"


def test_the_field_is_recovered_in_si_units(window: Any, tool: Any, run: Any) -> None:
    tool.options.set_values({"samples": 2, "steps": 5})
    found = run(tool)
    assert found.verdict is Verdict.DETERMINED
    error = found.fields[0].displacement - TRUTH
    assert np.sqrt((error**2).mean() / (TRUTH**2).mean()) < 0.1
    field = layer_of(window, "field")
    assert field.visible
    assert unit_of(field).endswith("T·m")
    factor = {"µT·m": 1e6, "mT·m": 1e3, "T·m": 1.0}[unit_of(field)]
    strength = factor * np.hypot(*SETUPS[0].path_integrated_b(found.fields[0].displacement))
    np.testing.assert_allclose(field.data, strength, rtol=1e-6, atol=1e-6 * strength.max())
    sigma = factor * np.hypot(*SETUPS[0].path_integrated_b(found.fields[0].uncertainty))
    shown = layer_of(window, "uncertainty")
    np.testing.assert_allclose(shown.data, sigma, rtol=1e-6)
    assert unit_of(shown) == unit_of(field)
    np.testing.assert_array_equal(layer_of(window, "reprojection").data, found.reprojection)
    residual = layer_of(window, "residual").data
    assert residual.shape == (2, *SHAPE)
    np.testing.assert_allclose(residual[1], 100 * found.residual[1] / found.images[1].mean())
    assert tuple(field.scale) == pytest.approx((1.5, 1.5))
    assert tuple(window.layers["6.0 MeV"].scale) == pytest.approx((1.5, 1.5))
    # It can be told, projected and saved like the result of an inversion.
    assert result_of(field).setup == SETUPS[0]
    report = tool.view.report.texts()
    assert "6 MeV proton" in report["Image 2"]
    assert report["Setup"].startswith("particles")


def test_a_good_verdict_is_shown_and_a_bad_one_is_told(
    window: Any, tool: Any, show: Any, fitted: Fit, told: list[str]
) -> None:
    show(tool, fitted)
    assert "Verdict: determined" in tool.view.verdict.text()
    assert not tool.view.verdict.styleSheet()
    assert told == []
    count = len(window.layers)
    explanation = "the forward model does not explain image 2"
    show(tool, replace(fitted, verdict=Verdict.MISFIT, explanation=explanation))
    assert "Verdict: does not fit" in tool.view.verdict.text()
    assert explanation[1:] in tool.view.verdict.text()
    assert tool.view.verdict.styleSheet()
    assert told == [f"The fit's verdict is 'does not fit': {explanation}"]
    # The layers of the same images' earlier fit are replaced.
    assert len(window.layers) == count
    tool._last.keep_earlier.setChecked(True)
    show(tool, fitted)
    assert len(window.layers) > count
    tool.images.table.item(0, 0).setCheckState(Qt.CheckState.Unchecked)
    assert not tool.view.verdict.isVisible()


def test_two_fields_are_told_apart_and_named(
    window: Any, open_widget: Any, run: Any, proton_setup: ProtonSetup
) -> None:
    rng = np.random.default_rng(2)
    electric = gaussian_blob(SHAPE, 14.0, 7.0, (28.0, 24.0)).displacement
    setups = [ProtonSetup(energy=energy, **LENGTHS) for energy in (20.0, 3.0)]
    for setup in setups:
        moved = sum(
            transferred_displacement(d, setups[0], setup, deflector=f"{kind} field")
            for d, kind in ((0.5 * TRUTH, "magnetic"), (0.5 * electric, "electric"))
        )
        metadata = mark("shot", "", setup)
        noisy = synthetic_image(moved) + rng.normal(0, 0.01, SHAPE)
        window.add_image(noisy, name=f"{setup.energy}", metadata=metadata)
    tool = open_widget("Fit several images")
    tool.options.set_values(QUICK)
    tool.fields.restore("B and E")
    found = run(tool)
    assert [one.name for one in found.fields] == ["B", "E"]
    magnetic, other = layer_of(window, "field", "∫B×dz"), layer_of(window, "field", "∫E dz")
    assert magnetic.visible
    assert not other.visible
    assert unit_of(other).endswith("V")
    factor = {"V": 1.0, "kV": 1e-3, "MV": 1e-6}[unit_of(other)]
    expected = factor * np.hypot(*setups[0].path_integrated_e(found.fields[1].displacement))
    np.testing.assert_allclose(other.data, expected, rtol=1e-6, atol=1e-6 * expected.max())
    content = result_of(other).content
    np.testing.assert_array_equal(content["displacement"], found.fields[1].displacement)
    assert "path_integrated_b" not in content


def test_an_unknown_beam_is_fitted_and_shown(window: Any, tool: Any, run: Any) -> None:
    beam = 1 + 0.2 * np.cos(np.pi * np.arange(SHAPE[1]) / SHAPE[1]) * np.ones(SHAPE)
    for setup, layer in zip(SETUPS, window.layers, strict=True):
        image = project(TRUTH, SETUPS[0], setup, source=300 * beam)
        layer.data = image + np.random.default_rng(2).normal(0, 3, SHAPE)
    tool.source.picker.set_kind("unknown")
    run(tool)
    fitted = layer_of(window, "source").data
    assert np.abs(fitted / (300 * beam) - 1).max() < 0.1
    tool.source.picker.set_kind("layer")
    measured = window.add_image(300 * beam, name="beam")
    assert "beam" in texts(tool, 0)
    tool.source.layers.layer = measured
    assert "beam" not in texts(tool, 0)
    np.testing.assert_array_equal(tool.request().keywords["source"], 300 * beam)


def test_steps_are_done_to_all_images_first(window: Any, tool: Any) -> None:
    before = images()
    large = np.ones((2, 2)) / 4
    for layer in window.layers:
        layer.data = np.kron(layer.data, large)
    beam = 300 + np.arange(SHAPE[1]) + np.zeros(SHAPE)
    window.add_image(np.kron(beam, large), name="beam", metadata=mark("source", ""))
    tool.source.layers.layer = window.layers["beam"]
    tool.source.picker.set_kind("layer")
    painted = np.zeros((96, 128), np.uint8)
    painted[:4, :6] = 1
    tool.masks.layer = window.add_labels(painted)
    tool.steps.add("bin")
    job = tool.request()
    planes, keywords = job._prepared(lambda: False)
    usable = np.ones((2, *SHAPE), bool)
    usable[:, :2, :3] = False
    np.testing.assert_array_equal(keywords["mask"], usable)
    np.testing.assert_allclose(planes[usable], np.stack(before)[usable])
    np.testing.assert_allclose(keywords["source"][usable], np.stack([beam, beam])[usable])
    assert [one.object_pixel_size for one in keywords["setups"]] == pytest.approx([3e-6, 3e-6])
    assert job.frame.scale == pytest.approx((3, 3))
    assert job.frame.translate == pytest.approx((0.75, 0.75))
    assert "bin" in dict(job.given)["Steps"].lower()


def test_a_stack_has_a_row_for_each_plane(window: Any, open_widget: Any) -> None:
    stack = np.stack([*images(), images()[0]])
    layer = window.add_image(stack, name="run", metadata=mark("shot", "", SETUPS[0]))
    tool = open_widget("Fit several images")
    tool.images.stacks.layer = layer
    assert texts(tool, 0) == ["run 0", "run 1", "run 2"]
    assert texts(tool, BEAM) == ["14.7", "", ""]
    with pytest.raises(InputError, match="'run 1' has no energy: type it"):
        tool.request()
    type_in(tool, 1, BEAM, "6")
    tool.images.table.item(2, 0).setCheckState(Qt.CheckState.Unchecked)
    job = tool.request()
    assert job.keywords["setups"] == list(SETUPS)
    np.testing.assert_array_equal(np.stack(job.images), stack[:2])
    # Another reference: its own energy goes with it, and comes back.
    tool.images.table.item(0, 0).setCheckState(Qt.CheckState.Unchecked)
    assert tool.setup.setup().energy == 6
    tool.images.table.item(0, 0).setCheckState(Qt.CheckState.Checked)
    assert [one.energy for one in tool.request().keywords["setups"]] == [14.7, 6.0]


def test_without_a_setup_strengths_are_asked_for(window: Any, open_widget: Any, run: Any) -> None:
    for name, strength in (("strong", 1.0), ("weak", 0.6)):
        noise = np.random.default_rng(1).normal(0, 0.01, SHAPE)
        window.add_image(synthetic_image(strength * TRUTH) + noise, name=name)
    tool = open_widget("Fit several images")
    tool.options.set_values(QUICK)
    assert tool.images.table.horizontalHeaderItem(BEAM).text() == "Strength"
    with pytest.raises(InputError, match="'weak' has no strength"):
        tool.request()
    type_in(tool, 1, BEAM, "0.6")
    found = run(tool)
    assert found.strengths.ravel().tolist() == [1.0, 0.6]
    assert unit_of(layer_of(window, "field")) == "px"


def test_light_has_wavelengths_and_its_own_fields(window: Any, open_widget: Any) -> None:
    green = OpticalSetup(wavelength=532e-9, object_image_distance=0.01, pixel_size=1e-6)
    red = green.model_copy(update={"wavelength": 810e-9})
    for setup in (green, red):
        window.add_image(np.ones(SHAPE), name=setup.probe, metadata=mark("shot", "", setup))
    tool = open_widget("Fit several images")
    assert texts(tool, BEAM) == ["532 nm", "810 nm"]
    keys = [tool.fields.itemData(index) for index in range(tool.fields.count())]
    assert keys == ["plasma", "phase", "plasma and phase"]
    tool.fields.restore("plasma and phase")
    keywords = tool.request().keywords
    assert keywords["fields"] == ("plasma", "phase")
    assert keywords["setups"] == [green, red]


@pytest.mark.parametrize(
    ("spoil", "sentence"),
    [
        (lambda tool: type_in(tool, 1, BEAM, "fast"), "'6.0 MeV': 'fast' is not a number"),
        (lambda tool: type_in(tool, 1, BEAM, "-2"), "the setup of '6.0 MeV': 'energy' is -2"),
        (lambda tool: tool.images.table.item(1, 0).setCheckState(Qt.CheckState.Unchecked),
         "1 image is checked, expected two or more"),
        (lambda tool: tool.source.picker.set_kind("layer"), "no source layer is selected"),
    ],
)  # fmt: skip
def test_a_mistake_is_one_sentence(
    tool: Any, told: list[str], spoil: Callable[[Any], None], sentence: str
) -> None:
    spoil(tool)
    tool.panel.button.click()
    assert not tool.panel.runner.running
    (text,) = told
    assert text.lower().startswith(sentence.lower())
    assert tool.panel.status.text() == text


def test_without_images_it_says_what_is_needed(
    window: Any, open_widget: Callable[[str], Any], told: list[str]
) -> None:
    tool = open_widget("Fit several images")
    tool.panel.button.click()
    assert told[0].startswith("No images are checked, expected two or more")
    (first,) = (window.add_image(one, name="a") for one in images()[:1])
    tool.panel.button.click()
    assert told[1].startswith("1 image is checked")
    window.layers.remove(first)
    assert texts(tool, 0) == []
    tool.panel.button.click()
    assert told[2] == told[0]


def test_what_other_widgets_change_is_followed(window: Any, tool: Any, qtbot: Any) -> None:
    tool.hide()
    for layer, energy in zip(window.layers, (15.0, 7.0), strict=True):
        keep_setup(layer, SETUPS[0].model_copy(update={"energy": energy}), "typed elsewhere")
    tool.show()
    qtbot.waitUntil(tool.isVisible, timeout=PATIENCE)
    assert texts(tool, BEAM) == ["15", "7"]
    assert [one.energy for one in tool.request().keywords["setups"]] == [15.0, 7.0]
    assert tool.setup.origin == "typed elsewhere"


def test_doubts_of_the_reader_are_told(window: Any, tool: Any) -> None:
    window.layers[1].metadata = mark("shot", "", SETUPS[1], warnings=["it may be film"])
    assert ("Warning", "'6.0 MeV': it may be film") in tool.request().given


def test_images_that_do_not_fit_are_refused(
    window: Any, tool: Any, told: list[str], qtbot: Any
) -> None:
    window.add_image(np.ones((40, 64)), name="crop", metadata=mark("shot", "", SETUPS[0]))
    for row in range(3):
        tool.images.table.item(row, 0).setCheckState(Qt.CheckState.Checked)
    tool.panel.button.click()
    assert "'crop' has shape (40, 64), '14.7 MeV' (48, 64)" in told[-1]
    # What only the fit itself can see reaches the window in the same way.
    tool.images.table.item(2, 0).setCheckState(Qt.CheckState.Unchecked)
    window.layers["6.0 MeV"].data = np.full(SHAPE, np.nan)
    tool.panel.button.click()
    qtbot.waitUntil(lambda: not tool.panel.runner.running, timeout=PATIENCE)
    assert "NaN" in told[-1]
    assert len(told) == 2
    assert tool.panel.status.text() == told[-1]


def test_a_fit_is_cancelled_at_once(window: Any, tool: Any, qtbot: Any, told: list[str]) -> None:
    tool.options.set_values({"samples": 1000})
    tool.panel.button.click()
    qtbot.waitUntil(lambda: bool(tool.panel.runner.tag.history), timeout=PATIENCE)
    qtbot.waitUntil(lambda: "Fitting: " in tool.panel.status.text(), timeout=PATIENCE)
    assert "objective" in tool.panel.status.text()
    qtbot.waitUntil(tool.view.curve.isVisible, timeout=PATIENCE)
    start = time.perf_counter()
    tool.panel.button.click()
    qtbot.waitUntil(lambda: not tool.panel.runner.running, timeout=PATIENCE)
    assert time.perf_counter() - start < 1
    assert tool.panel.status.text() == "Cancelled."
    assert tool.panel.button.text() == "Run"
    assert not [layer for layer in window.layers if role_of(layer) == "field"]
    assert told == []


def test_closing_the_dock_ends_the_fit(window: Any, tool: Any, qtbot: Any, told: list[str]) -> None:
    tool.options.set_values({"samples": 1000})
    tool.panel.button.click()
    qtbot.waitUntil(lambda: bool(tool.panel.runner.tag.history), timeout=PATIENCE)
    window.window.remove_dock_widget(tool)
    tool.deleteLater()
    qtbot.waitUntil(
        lambda: not any(one.name == "shadowinv" for one in threading.enumerate()), timeout=5000
    )
    qtbot.wait(100)
    window.add_image(np.ones((8, 8)))
    assert told == []


def test_other_answers_are_shown_beside_the_best(
    window: Any, tool: Any, show: Any, fitted: Fit, qtbot: Any, told: list[str]
) -> None:
    found = fitted
    show(tool, found)
    assert not tool.view.answers.isVisible()
    best = found.basins[0]
    other = replace(
        best,
        start="from near",
        objective=1.02 * best.objective,
        distance=0.5,
        displacement=0.5 * best.displacement,
    )
    doubtful = replace(
        found, basins=(best, other), verdict=Verdict.SEVERAL, explanation="2 different fields"
    )
    show(tool, doubtful)
    assert len(told) == 1
    answers = tool.view.answers
    assert answers.isVisible()
    assert answers.itemText(0).endswith("the best")
    assert answers.itemText(1) == "from near: +2.0 %, 50% off"
    count = len(window.layers)
    answers.setCurrentIndex(1)
    qtbot.waitUntil(lambda: not tool.view._others.busy, timeout=PATIENCE)
    shown = layer_of(window, "field", "from near")
    assert shown.data.shape == SHAPE
    coarse = np.hypot(*SETUPS[0].path_integrated_b(other.displacement[0]))
    factor = {"µT·m": 1e6, "mT·m": 1e3, "T·m": 1.0}[unit_of(shown)]
    # Its pixels lie between pairs of the image's.
    pairs = shown.data.reshape(24, 2, 32, 2).mean(axis=(1, 3)) / factor
    assert np.abs(pairs - coarse)[2:-2, 2:-2].max() < 0.1 * coarse.max()
    answers.setCurrentIndex(0)
    assert len(window.layers) == count


def test_refine_starts_from_the_last_inversion(
    window: Any, open_widget: Any, qtbot: Any, told: list[str]
) -> None:
    shot = images()[0]
    window.add_image(shot, name="shot", metadata=mark("shot", "", SETUPS[0]))
    tool = open_widget("Invert shot")
    tool.options.set_values({"n_sites": 1500})
    tool.refining.button.click()
    assert "there is no inversion of this image" in told.pop().lower()
    tool.panel.button.click()
    qtbot.waitUntil(lambda: hasattr(tool, "results"), timeout=PATIENCE)
    qtbot.waitUntil(lambda: not tool.results.busy, timeout=PATIENCE)
    inversion = result_of(layer_of(window, "field")).content
    tool.refining.psf.setValue(0.5)
    answers: list[Any] = []
    tool.panel.runner.ended.connect(answers.append)
    tool.refining.button.click()
    assert tool.panel.button.text() == "Cancel"
    qtbot.waitUntil(lambda: bool(answers), timeout=PATIENCE)
    found = answers[0].value.fit
    expected = fit(
        inversion.image,
        setups=[SETUPS[0]],
        source=inversion.source,
        mask=inversion.mask,
        psf=0.5,
        start=inversion.potential,
    )
    np.testing.assert_allclose(found.fields[0].potential, expected.fields[0].potential)
    assert any(basin.start == "given" for basin in found.basins)
    qtbot.waitUntil(lambda: "Verdict" in tool.fit_view.verdict.text(), timeout=PATIENCE)
    names = [layer.name for layer in window.layers]
    qtbot.waitUntil(
        lambda: any("refined" in one.name and role_of(one) == "arrows" for one in window.layers),
        timeout=PATIENCE,
    )
    assert any("shot |∫B×dz|" in name for name in names), names
    refined = layer_of(window, "field", "refined")
    assert refined.data.shape == SHAPE
    qtbot.waitUntil(lambda: not tool._refined.busy, timeout=PATIENCE)
    assert refined.visible
    # A new inversion is not hidden by what was made of the one before.
    tool.panel.button.click()
    qtbot.waitUntil(lambda: not tool.panel.runner.running, timeout=PATIENCE)
    assert not refined.visible
    assert not tool.fit_view.verdict.isVisible()


def test_a_saved_fit_comes_back_as_it_was(
    window: Any, tool: Any, show: Any, fitted: Fit, tmp_path: Any
) -> None:
    found = fitted
    show(tool, found)
    qt_path = tmp_path / "fit.shadowinv"
    layers = [layer for layer in window.layers if result_of(layer) is not None]
    window.layers.selection = set(layers)
    window.layers.save(str(qt_path), selected=True, plugin="napari-shadowinv")
    dataset = read(qt_path)
    assert dataset.attrs["verdict"] == found.verdict.value
    assert json.loads(dataset.attrs["fields"]) == ["B"]
    np.testing.assert_array_equal(dataset["displacement"], found.fields[0].displacement)
    names = {layer.name for layer in layers}
    window.layers.clear()
    window.open(str(qt_path), plugin="napari-shadowinv")
    assert {layer.name for layer in window.layers} == names
    assert layer_of(window, "field").data.max() > 0


def test_choices_are_kept_between_sessions(window: Any, tool: Any, open_widget: Any) -> None:
    tool.fields.restore("B and E")
    tool.gains.restore("free")
    tool.noise.restore("poisson")
    kept = json.loads(json.dumps(tool.state()))
    tool.fields.restore("B")
    tool.gains.restore("known")
    tool.noise.restore("")
    del kept["setup"]  # a matter of the image
    tool.restore(kept)
    keywords = tool.request().keywords
    assert keywords["fields"] == ("B", "E")
    assert keywords["gains"] == "free"
    assert keywords["noise"] == "poisson"
    assert keywords["options"].steps == QUICK["steps"]
