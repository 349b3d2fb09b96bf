"""Forms generated from the models, and the files that they read and write."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest
import tomli_w
from annotated_types import Ge, Gt, Le, Lt
from pydantic import BaseModel
from qtpy.QtWidgets import QFileDialog, QLineEdit

from napari_shadowinv import (
    InputError,
    Instrument,
    InversionOptions,
    OpticalSetup,
    ProtonSetup,
)
from napari_shadowinv._napari.widgets._forms import (
    ModelForm,
    ModelPicker,
    kinds_of,
    labels_of,
    save_text,
)
from napari_shadowinv._napari.widgets._inputs import InstrumentForm, SetupPicker
from napari_shadowinv._napari.widgets._qt import StateKeeper
from napari_shadowinv._system.validation import validate
from napari_shadowinv.io import read_toml
from napari_shadowinv.options import FitOptions
from napari_shadowinv.pipeline.files import setup_from
from napari_shadowinv.preprocessing import ESTIMATES, STEPS

CHANGED = {
    "n_sites": 1234,
    "floor": 2.5e-4,
    "tolerance": 1e-5,
    "lloyd_iterations": 0,
    "readout": "centroid",
    "negative": "clip",
    "seed": 2**40,
    "threads": 1,
}


def save_toml(values: dict[str, Any], path: Path) -> Path:
    return save_text(tomli_w.dumps(values), path, ".toml")


def the_form(qtbot: Any, model: Any) -> ModelForm:
    form = ModelForm(model)
    qtbot.addWidget(form)
    return form


def test_a_new_form_holds_the_defaults(qtbot: Any) -> None:
    assert the_form(qtbot, InversionOptions).model() == InversionOptions()


def test_every_field_can_be_set_and_is_described(qtbot: Any) -> None:
    form = the_form(qtbot, InversionOptions)
    form.set_values(CHANGED)
    assert form.model() == InversionOptions(**CHANGED)
    assert set(form.editors) == set(InversionOptions.model_fields)
    for name, field in InversionOptions.model_fields.items():
        assert str(field.description) in form.editors[name].toolTip()
    form.set_values({})
    assert form.model() == InversionOptions()


def test_a_number_is_kept_within_its_bounds(qtbot: Any) -> None:
    form = the_form(qtbot, InversionOptions)
    form.editors["lloyd_iterations"].set_value(5000)
    assert form.values()["lloyd_iterations"] == 1000
    form.editors["tolerance"].set_value(3.0)
    with pytest.raises(InputError, match="less than 1"):
        form.model()


def test_text_that_is_no_number_is_refused_with_what_was_typed(qtbot: Any) -> None:
    form = the_form(qtbot, InversionOptions)
    editor = form.editors["floor"].inner
    editor.setText("little")
    editor.editingFinished.emit()
    with pytest.raises(InputError, match="little"):
        form.model()
    editor.setText("0.01")
    editor.editingFinished.emit()
    assert form.model() == InversionOptions(floor=0.01)


def test_only_one_pixel_size_is_given(qtbot: Any, proton_setup: ProtonSetup) -> None:
    form = the_form(qtbot, ProtonSetup)
    form.set_values(proton_setup.model_dump())
    assert form.model() == proton_setup
    detector = form.editors["detector_pixel_size"]
    detector.inner.setChecked(True)
    detector.editor.set_value(145e-6)
    assert not form.editors["pixel_size"].checked
    assert form.values()["detector_pixel_size"] == 145e-6
    assert "pixel_size" not in form.values()


def placeholders(form: InstrumentForm) -> dict[str, str]:
    """Return the texts in grey of the numbers that are empty."""
    editors = {name: form.editors[name].inner for name in Instrument.model_fields}
    lines = {name: inner for name, inner in editors.items() if isinstance(inner, QLineEdit)}
    return {name: line.placeholderText() for name, line in lines.items() if not line.text()}


def test_an_instrument_shows_its_defaults_in_grey(qtbot: Any) -> None:
    form = InstrumentForm()
    qtbot.addWidget(form)
    exact = placeholders(form)
    assert exact.keys() == Instrument.model_fields.keys() - {"detector", "beam_source"}
    assert exact["beam_rms"] == "0.05, or 0.005 if recorded"
    assert exact["registration"] == "measured in the images"
    assert exact["noise_correlation"] == "measured in the image"
    assert (exact["blur"], exact["beam_length"]) == ("0 px", "0.25")
    assert form.values() == {}
    form.editors["detector"].set_value("image plate")
    form.editors["beam_source"].set_value("TNSA")
    shown = placeholders(form)
    assert (shown["blur"], shown["beam_rms"]) == ("1.5 px (image plate)", "0.1 (TNSA)")
    assert shown["absorption"] == "0"
    form.editors["blur"].set_value(2.0)
    assert "blur" not in placeholders(form)
    form.editors["detector"].set_value("camera")
    assert form.model() == Instrument.of("camera", source="TNSA", blur=2)
    form.editors["blur"].set_value(None)
    for kind in ("detector", "beam_source"):
        form.editors[kind].set_value(None)
    assert placeholders(form) == exact
    assert form.model() == Instrument()


@pytest.mark.parametrize("values", ["stated", "all"])
def test_an_instrument_is_shown_by_what_is_stated(qtbot: Any, values: str) -> None:
    """A recipe contains all numbers."""
    form = InstrumentForm()
    qtbot.addWidget(form)
    instrument = Instrument.of("film", source="laser", gamma=0, noise_correlation=0)
    form.restore(instrument.stated if values == "stated" else instrument.model_dump())
    assert form.model() == instrument
    assert form.state() == instrument.stated
    assert {"gamma", "noise_correlation"}.isdisjoint(placeholders(form))
    form.restore({"detector": "film", "blur": -1, "gamma": 0.1})
    with pytest.raises(InputError, match="Blur"):
        form.model()


def test_an_empty_setup_says_what_is_missing(qtbot: Any) -> None:
    picker = SetupPicker()
    qtbot.addWidget(picker)
    assert picker.setup() is None
    picker.picker.set_kind("proton")
    with pytest.raises(InputError, match="energy"):
        picker.setup()


@pytest.mark.parametrize("name", ["proton_setup", "optical_setup"])
def test_the_command_line_reads_a_saved_setup(
    name: str, request: pytest.FixtureRequest, qtbot: Any, tmp_path: Path
) -> None:
    setup = request.getfixturevalue(name)
    picker = SetupPicker()
    qtbot.addWidget(picker)
    picker.show_setup(setup.model_dump())
    path = save_toml(picker._to_save(), tmp_path / "setup")
    assert path.suffix == ".toml"
    assert setup_from(path) == setup
    picker.picker.set_kind("none")
    picker.load(read_toml(path), str(path))
    assert picker.setup() == setup
    if isinstance(setup, OpticalSetup):
        assert math.isinf(picker.setup().source_object_distance)


def test_saved_options_are_those_of_the_form(qtbot: Any, tmp_path: Path) -> None:
    form = the_form(qtbot, InversionOptions)
    form.set_values(CHANGED)
    path = save_toml(form.values(), tmp_path / "options.toml")
    assert InversionOptions(**read_toml(path)) == InversionOptions(**CHANGED)


def test_a_file_that_the_dialog_did_not_name_is_not_replaced(tmp_path: Path) -> None:
    save_toml({"seed": 1}, tmp_path / "options.toml")
    with pytest.raises(OSError, match="exists"):
        save_toml({"seed": 2}, tmp_path / "options")
    save_toml({"seed": 3}, tmp_path / "options.toml")
    assert read_toml(tmp_path / "options.toml") == {"seed": 3}


def test_the_buttons_save_and_load(
    qtbot: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, messages: list[str],
    proton_setup: ProtonSetup,
) -> None:  # fmt: skip
    picker = SetupPicker()
    qtbot.addWidget(picker)
    path = str(tmp_path / "setup.toml")
    monkeypatch.setattr(QFileDialog, "getSaveFileName", lambda *_, **__: (path, ""))
    monkeypatch.setattr(QFileDialog, "getOpenFileName", lambda *_, **__: (path, ""))
    picker.files.save_button.click()
    assert len(messages) == 1
    assert "no setup to save" in messages[0]
    picker.show_setup(proton_setup.model_dump())
    picker.files.save_button.click()
    picker.picker.set_kind("none")
    picker.files.load_button.click()
    assert picker.setup() == proton_setup
    Path(path).write_text("kind = 'proton'\nenergie = 3")
    picker.files.load_button.click()
    assert len(messages) == 2
    assert "energie" in messages[1]
    assert picker.setup() == proton_setup


def test_a_picker_remembers_what_each_kind_holds(qtbot: Any) -> None:
    picker, restored = (ModelPicker("Method", kinds_of(ESTIMATES)) for _ in range(2))
    for widget in (picker, restored):
        qtbot.addWidget(widget)
    picker.set_kind("polynomial")
    assert picker.form is not None
    picker.form.editors["degree"].set_value(7)
    picker.set_kind("low-pass")
    restored.restore(picker.state())
    assert restored.kind == "low-pass"
    restored.set_kind("polynomial")
    assert restored.model() == ESTIMATES["polynomial"](degree=7)  # type: ignore[call-arg]


def test_what_was_kept_is_loaded_and_damage_is_forgiven(qtbot: Any, settings_folder: Path) -> None:
    from qtpy.QtWidgets import QWidget

    widget = QWidget()
    qtbot.addWidget(widget)
    keeper = StateKeeper(widget, "test", lambda: {"a": [1, math.inf], "b": "µm"})
    assert keeper.load() == {}
    keeper.write()
    assert keeper.load() == {"a": [1, math.inf], "b": "µm"}
    StateKeeper(widget, "damaged", lambda: {}).write()
    (file,) = settings_folder.rglob("*.ini")
    file.write_text(file.read_text().replace("damaged={}", "damaged={]"))
    assert StateKeeper(widget, "damaged", lambda: {}).load() == {}
    form = the_form(qtbot, InversionOptions)
    form.set_values({"seed": "many", "unknown": 3, "floor": None, "readout": "none"})
    assert form.model() == InversionOptions()


def test_mistakes_name_the_fields_by_their_labels(qtbot: Any) -> None:
    form = the_form(qtbot, ProtonSetup)
    form.set_values({"energy": 14.7e6, "pixel_size": 1e-6})
    with pytest.raises(InputError) as refused:
        form.model()
    text = str(refused.value)
    assert "'Source to object (m)' is missing" in text
    assert "'Kinetic energy (MeV)' is 14700000.0: it must be at most" in text
    assert not any(key in text for key in ("source_object_distance", "'energy'"))


def test_contradictions_name_the_fields_by_their_labels(qtbot: Any) -> None:
    form = the_form(qtbot, InversionOptions)
    form.set_values({"flux": "known"})
    with pytest.raises(InputError, match="'Flux' is 'known' and 'Boundary' is 'closed'"):
        form.model()


@pytest.mark.parametrize("model", [InversionOptions, FitOptions, Instrument, *STEPS.values()])
def test_bounds_name_each_field_by_its_label(model: type[BaseModel]) -> None:
    for key, field in model.model_fields.items():
        if not any(isinstance(bound, Ge | Gt | Le | Lt) for bound in field.metadata):
            continue
        bad = next(value for value in (-1, 10**9) if is_refused(model, {key: value}))
        with pytest.raises(InputError) as refused:
            validate(model, {key: bad}, names=labels_of(model))
        assert f"'{field.title}' is {bad}" in str(refused.value)
        assert f"'{key}'" not in str(refused.value)


def is_refused(model: type[BaseModel], values: dict[str, Any]) -> bool:
    try:
        validate(model, values)
    except InputError:
        return True
    return False
