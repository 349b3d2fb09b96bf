"""The examples of CONTRIBUTING.md must work as they stand there."""

from __future__ import annotations

import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from napari_shadowinv import Fit, FitOptions, fit, synthetic_image
from napari_shadowinv.fitting import additive
from napari_shadowinv.options import InversionOptions
from napari_shadowinv.physics.phantoms import gaussian_blob
from napari_shadowinv.preprocessing import STEPS, Radiograph
from napari_shadowinv.preprocessing.steps import Step, choices_of

ROOT = Path(__file__).parents[1]
TEXT = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def names() -> dict[str, Any]:
    names: dict[str, Any] = {"__name__": "contributing"}
    for block in re.findall(r"```python\n(.*?)```", TEXT, re.DOTALL):
        exec(compile(block, "CONTRIBUTING.md", "exec", dont_inherit=True), names)
    return names


def test_the_filter_is_a_step(names):
    step = names["MedianFilter"](size=5)
    # Known by its definition alone; the recipe of this process was made before.
    assert choices_of(Step)["median"] is type(step)
    assert "median" not in STEPS
    image = np.ones((20, 20))
    image[9, 9] = 50.0
    np.testing.assert_array_equal(step.applied(Radiograph(image)).image, 1.0)


def test_the_option_is_one_field(names):
    (field,) = names["InversionOptions"].model_fields
    assert field not in InversionOptions.model_fields
    assert names["InversionOptions"](ceiling=10.0).ceiling == 10.0


def test_the_column_reads_a_result_and_words_it(names):
    column = names["RMS_DISPLACEMENT"]
    inversion = SimpleNamespace(displacement=np.full((2, 4, 4), 3.0))
    assert column.text({column.key: column.value(inversion)}) == "4.24"
    assert column.heading == "rms_displacement (px)"


def test_the_unknown_is_fitted_with_the_field(names, monkeypatch):
    truth = gaussian_blob((48, 48), 30.0, 7.0).displacement
    backgrounds = [0.08, -0.05]
    images = np.stack([synthetic_image(truth), synthetic_image(0.6 * truth)])
    images += np.array(backgrounds)[:, None, None]
    images += 0.02 * np.random.default_rng(0).normal(size=images.shape)
    known = {"strengths": [1, 0.6], "noise": 0.02, "source": np.ones((48, 48))}
    monkeypatch.setattr(additive, "ADDITIVE", (names["Background"],))
    options_class = type("Options", (names["FitOptions"], FitOptions), {})
    result = fit(images, options=options_class(background=0.1), **known)
    error = np.abs(result.fields[0].displacement - truth).max()
    plain = fit(images, options=options_class(samples=0), **known)
    assert plain.report.added == {}
    assert error < 0.1 * np.abs(plain.fields[0].displacement - truth).max()
    rows = np.array(result.report.added["background"])
    assert rows.shape == (2, 1, 2)
    for (value, deviation), background in zip(rows[:, 0], backgrounds, strict=True):
        assert 1e-4 < deviation < 0.01
        assert abs(value - background) < 4 * deviation
    facts = {fact.key: fact.text for fact in result.facts()}
    assert f"background {rows[0, 0, 0]:.3g} ± " in facts["image_1"]
    # The option is then one of FitOptions itself.
    monkeypatch.setattr("napari_shadowinv.fitting.result.FitOptions", options_class)
    again = Fit.from_dataset(result.to_dataset())
    assert again.report.added == result.report.added


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


def test_the_setup_converts_and_projects(names):
    setup = names["XRaySetup"].example()
    assert setup.deflection_angle(1.0) == pytest.approx(1e-6 * 11.0 / 1.0)
    harder = setup.model_copy(update={"photon_energy": 16.0})
    assert harder.angle_ratio(setup, "electron density") == 0.25
    assert harder.probe == "X-rays of 16 keV"


def test_the_rooms_are_those_of_the_source():
    package = ROOT / "src" / "napari_shadowinv"
    rooms = {path.parent.name for path in package.glob("*/__init__.py")}
    listed = re.findall(r"^        ([_a-z]+)/ ", TEXT, re.MULTILINE)
    assert set(listed) == rooms


def test_every_benchmark_is_listed_and_every_link_leads_somewhere():
    listed = re.findall(r"benchmarks/(\w+\.py)", TEXT)
    benchmarks = {path.name for path in (ROOT / "benchmarks").glob("*.py")} - {
        "reference.py",
        "simulated_pack.py",
    }
    assert set(listed) == benchmarks
    for target in re.findall(r"\]\(([^)#]+)\)", TEXT):
        assert (ROOT / target).exists(), target
