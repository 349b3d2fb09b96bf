"""The examples of CONTRIBUTING.md must work as they stand there."""

from __future__ import annotations

import ast
import re
from importlib import import_module
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import typer
from typer.testing import CliRunner

from helpers.command_line import flat
from helpers.pages import ROOT, run_python, text_of
from napari_shadowinv import Inversion, cli, invert, synthetic_image, write
from napari_shadowinv.analysis import PRODUCTS, analyse
from napari_shadowinv.cli._terminal import EXIT_MISTAKE
from napari_shadowinv.inversion.budget import FLUX_ERRORS
from napari_shadowinv.io import store_columns
from napari_shadowinv.options import InversionOptions
from napari_shadowinv.physics.derivatives import finer_field
from napari_shadowinv.physics.phantoms import gaussian_blob
from napari_shadowinv.preprocessing import STEPS
from napari_shadowinv.preprocessing.steps import Step, choices_of
from napari_shadowinv.shot import Shot

PACKAGE = ROOT / "src" / "napari_shadowinv"
TEXT = text_of("CONTRIBUTING.md")


# Their blocks change a table, or need a window.
SEPARATE_SECTIONS = ("a quantity of the error budget", "a command", "a widget")


def section(title: str) -> str:
    """Return the text of an example."""
    match = re.search(rf"^### {title}.*?(?=^##)", TEXT, re.DOTALL | re.MULTILINE)
    assert match is not None
    return match[0]


@pytest.fixture(scope="module")
def names() -> dict[str, Any]:
    text = TEXT
    for title in SEPARATE_SECTIONS:
        text = text.replace(section(title), "")
    return run_python(text)


def test_the_filter_is_a_step(names):
    step = names["MedianFilter"](size=5)
    # Known by its definition alone; the recipe of this process was made before.
    assert choices_of(Step)["median"] is type(step)
    assert "median" not in STEPS
    image = np.ones((20, 20))
    image[9, 9] = 50.0
    np.testing.assert_array_equal(step.apply(Shot(image)).image, 1.0)


def test_the_product_has_a_band(names):
    assert "steepness" not in PRODUCTS
    displacement = gaussian_blob((24, 24), 4.0, 4.0).displacement
    counts = np.random.default_rng(0).poisson(400 * synthetic_image(displacement))
    inversion = invert(counts)
    (result,) = analyse(inversion, names["Steepness"](), samples=20)
    low, high = result.band("steepness")
    assert low < high
    _, at_points = finer_field(inversion.potential, inversion.displacement)
    slope = np.abs(np.diff(at_points[0], axis=0)).max()
    assert result["steepness"].value == slope


def test_the_option_is_one_field(names):
    (field,) = names["InversionOptions"].model_fields
    assert field not in InversionOptions.model_fields
    assert names["InversionOptions"](ceiling=10.0).ceiling == 10.0


def test_the_quantity_is_the_effect_of_a_nonlinear_detector(monkeypatch):
    budget_table = dict(FLUX_ERRORS)
    names = run_python(section("a quantity of the error budget"))
    nonlinear_detector = FLUX_ERRORS.pop("nonlinear detector")
    assert budget_table == FLUX_ERRORS
    assert nonlinear_detector is names["nonlinear_detector"]
    image = synthetic_image(gaussian_blob((64, 64), 20.0, 8.0).displacement)
    options = InversionOptions(n_sites=1500)
    plain = invert(image, source=np.ones(image.shape), options=options)
    monkeypatch.setitem(FLUX_ERRORS, "nonlinear detector", nonlinear_detector)
    inversion = invert(image, source=np.ones(image.shape), options=options)
    np.testing.assert_array_equal(inversion.displacement, plain.displacement)

    recorded = invert(image**1.05, source=np.ones(image.shape), options=options)
    change = recorded.displacement - plain.displacement
    rms = np.sqrt((change**2).sum(axis=0).mean())
    error = inversion.errors.effects["nonlinear detector"]
    assert error.rms == pytest.approx(rms, rel=0.2)
    total = np.hypot(plain.errors.total, error)
    np.testing.assert_allclose(inversion.errors.total, total)
    assert inversion.errors.of_peak.cause == "nonlinear detector"
    facts = {fact.key: fact.text for fact in inversion.facts}
    assert "nonlinear detector 4." in facts["error_limited_by"]
    restored = Inversion.from_dataset(inversion.to_dataset())
    assert restored.errors == inversion.errors


def test_the_column_reads_a_result_and_words_it(names):
    column = names["RMS_DISPLACEMENT"]
    inversion = SimpleNamespace(displacement=np.full((2, 4, 4), 3.0))
    assert column.text({column.key: column.value(inversion)}) == "4.24"
    assert column.heading == "rms_displacement (px)"


def test_the_column_is_in_the_reports_of_inversions(names, monkeypatch, inversion):
    column = names["RMS_DISPLACEMENT"]
    monkeypatch.setattr(store_columns, "COLUMNS", (*store_columns.COLUMNS, column))
    values = store_columns.column_values(inversion)
    assert values[column.key] == pytest.approx(inversion.errors.rms)


@pytest.mark.parametrize("kind", ["u1", ">u2"])
def test_the_format_is_recognised_and_read(names, tmp_path, kind):
    pixels = np.arange(32, 44).reshape(3, 4).astype(kind)
    white = np.iinfo(kind).max
    path = tmp_path / "shot.pgm"
    path.write_bytes(b"P5\n4 3\n%d\n" % white + pixels.tobytes())
    assert names["PGM"].fits(path, path.read_bytes())
    image, metadata = names["read_pgm"](path)
    np.testing.assert_array_equal(image, pixels)
    assert metadata == {"bits": 8 * pixels.itemsize}


@pytest.fixture
def result_files(tmp_path, inversion, make_fit):
    paths = [tmp_path / "inversion.shadowinv", tmp_path / "fit.shadowinv"]
    for path, result in zip(paths, (inversion, make_fit()), strict=True):
        write(path, result.to_dataset())
    return paths


@pytest.fixture
def command():
    """Run the command, on an app of its registration alone."""
    text = section("a command")
    app = typer.Typer()
    module = SimpleNamespace(**run_python(text))
    (registration,) = re.findall(r"^    (app\.command.*)$", text, re.MULTILINE)
    exec(registration, {**vars(cli), "app": app, "_headlines": module})
    runner = CliRunner(env={"COLUMNS": "500"})
    return lambda *arguments: runner.invoke(app, [str(argument) for argument in arguments])


def test_the_command_prints_results_refuses_mistakes_and_has_help(
    command, result_files, inversion, make_fit, tmp_path
):
    answer = command(*result_files)
    assert answer.exit_code == 0, answer.output
    text = flat(answer.output)
    assert "Headlines" in text
    for path, result in zip(result_files, (inversion, make_fit()), strict=True):
        assert f"{path.name} {result.headline.text}" in text
    answer = command(tmp_path / "absent.shadowinv")
    assert answer.exit_code == EXIT_MISTAKE
    assert "absent.shadowinv" in answer.output
    assert "Traceback" not in answer.output
    answer = command("--help")
    assert "Print the peak and the warnings of each result in one line." in flat(answer.output)


@pytest.fixture
def area_map(qtbot, tmp_path):
    """The widget in a viewer without a window, and the viewer."""
    pytest.importorskip("napari")
    from napari.components import ViewerModel
    from qtpy.QtCore import QSettings

    QSettings.setPath(QSettings.Format.IniFormat, QSettings.Scope.UserScope, str(tmp_path))
    viewer = ViewerModel()
    widget = run_python(section("a widget"))["AreaMap"](viewer)
    qtbot.addWidget(widget)
    return widget, viewer


def test_the_widget_adds_the_layer_of_its_job(area_map, qtbot):
    from napari_shadowinv._napari.layer_metadata import metadata_for

    widget, viewer = area_map
    y, x = np.indices((20, 30))
    metadata = metadata_for("field", "px", displacement=np.stack([0.1 * y, 0.2 * x]))
    viewer.add_image(np.ones((20, 30)), name="shot field", metadata=metadata, scale=(3, 3))
    widget.panel.button.click()
    qtbot.waitUntil(lambda: "shot field area" in viewer.layers, timeout=60_000)
    layer = viewer.layers["shot field area"]
    np.testing.assert_allclose(layer.data, 1.1 * 1.2)
    np.testing.assert_array_equal(layer.scale, (3, 3))
    widget.panel.button.click()
    qtbot.waitUntil(lambda: not widget.panel.running, timeout=60_000)
    assert len(viewer.layers) == 2


def test_the_widget_refuses_to_run_without_a_result(area_map):
    widget, viewer = area_map
    viewer.add_image(np.ones((20, 30)))
    widget.panel.button.click()
    assert "invert a shot first" in widget.panel.status.text()
    assert not widget.panel.running


def test_the_widget_is_in_the_manifest():
    npe2 = pytest.importorskip("npe2")
    yaml = pytest.importorskip("yaml")
    text = section("a widget")
    (block,) = re.findall(r"```yaml\n(.*?)```", text, re.DOTALL)
    manifest = yaml.safe_load((PACKAGE / "napari.yaml").read_text(encoding="utf-8"))
    for kind, entries in yaml.safe_load(block).items():
        manifest["contributions"][kind] += entries
    contributions = npe2.PluginManifest(**manifest).contributions
    command = contributions.commands[-1]
    assert contributions.widgets[-1].command == command.id
    assert command.python_name.rpartition(":")[2] == "AreaMap"
    assert "class AreaMap(" in text


def test_the_rooms_are_those_of_the_source():
    rooms = {path.parent.name for path in PACKAGE.glob("*/__init__.py")}
    listed = re.findall(r"^        ([_a-z]+)/ ", TEXT.split("    tests/ ")[0], re.MULTILINE)
    assert set(listed) == rooms
    modules = {path.stem for path in PACKAGE.glob("*.py")}
    lines = re.findall(r"^        ((?:[_a-z]+, )*[_a-z]+)  ", TEXT, re.MULTILINE)
    assert {name for line in lines for name in line.split(", ")} == modules


def test_each_reference_of_the_glossary_exists():
    text = TEXT.partition("### Glossary")[2].partition("\n## ")[0]
    references = re.findall(r"`([_a-z]+(?:\.\w+)+)`", text.replace("name.shadowinv.zarr", ""))
    assert len(references) > 20
    for reference in references:
        room, _, name = reference.rpartition(".")
        if (PACKAGE / f"{reference.replace('.', '/')}.py").exists():
            continue
        assert hasattr(import_module(f"napari_shadowinv.{room}"), name), reference


def test_the_longest_module_is_as_long_as_stated():
    limit = re.search(r"No module is longer than (\d+) lines", TEXT)
    assert limit is not None
    lengths = [len(path.read_text("utf-8").splitlines()) for path in PACKAGE.rglob("*.py")]
    assert 500 < max(lengths) <= int(limit[1])


def test_benchmarks_and_examples_import_what_is_there():
    for folder in ("benchmarks", "docs", "examples"):
        for path in (ROOT / folder).rglob("*.py"):
            for node in ast.walk(ast.parse(path.read_text("utf-8"))):
                if isinstance(node, ast.ImportFrom) and PACKAGE.name in str(node.module):
                    exec(ast.unparse(node), {})


def test_every_benchmark_is_listed():
    listed = re.findall(r"benchmarks/(\w+\.py)", TEXT)
    benchmarks = {path.name for path in (ROOT / "benchmarks").glob("*.py")} - {
        "exact_shots.py",
        "reference.py",
        "simulated_pack.py",
    }
    assert set(listed) == benchmarks
