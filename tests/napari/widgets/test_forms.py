"""Forms of the package's models, and the files that they read and write; no window is open."""

import json
import math
import tomllib
from pathlib import Path

import pytest
import tomli_w
from magicgui.widgets import LineEdit
from qtpy.QtWidgets import QFileDialog

from helpers.forms import enter
from napari_shadowinv import InputError, Instrument, InversionOptions, OpticalSetup, ProtonSetup
from napari_shadowinv._napari.form import ModelForm
from napari_shadowinv._napari.widgets._inputs import InstrumentForm, SetupPicker
from napari_shadowinv._napari.widgets._qt import save_state, saved_state
from napari_shadowinv.options import FitOptions
from napari_shadowinv.physics.phantom_models import PHANTOMS
from napari_shadowinv.physics.trace_options import GridView
from napari_shadowinv.pipeline.experiment_options import ExperimentOptions
from napari_shadowinv.pipeline.files import setup_from
from napari_shadowinv.preprocessing import ESTIMATES, STEPS, Crop, Dark

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
OTHERS = (InversionOptions, FitOptions, Instrument, ExperimentOptions, GridView)
MODELS = [*OTHERS, *PHANTOMS.values(), *STEPS.values(), *ESTIMATES.values()]
STATED = [
    ProtonSetup.example(),
    OpticalSetup.example(),
    InversionOptions(**CHANGED),
    FitOptions(smoothness=1.5, align="shift"),
    Instrument(detector="film", beam_source="laser", gamma=0, noise_correlation=0),
    Crop(y=(3, 40), x=(5, None)),
    Dark(level=Path("dark.tif")),
    STEPS["low-pass"](width=12.345),
    STEPS["hot-pixels"](threshold=50.0),  # beyond the end of its slider
    ESTIMATES["polynomial"](degree=7),
]


def the_form(qtbot, model):
    form = InstrumentForm() if model is Instrument else ModelForm(model)
    qtbot.addWidget(form)
    return form


@pytest.mark.parametrize("model", MODELS)
def test_an_empty_form_states_nothing(qtbot, model):
    form = the_form(qtbot, model)
    assert form.model() == model()
    assert not form.state().keys() - {"step", "method"}
    described = {name for name, field in model.model_fields.items() if field.description}
    assert form.entries.keys() == described
    for name in described:
        assert str(model.model_fields[name].description) in form.entries[name].widget.tooltip


@pytest.mark.parametrize("stated", STATED, ids=lambda each: type(each).__name__)
def test_stated_values_come_back_exactly(qtbot, stated):
    form, later = (the_form(qtbot, type(stated)) for _ in range(2))
    form.restore(stated.model_dump())
    assert form.model() == stated
    later.restore(json.loads(json.dumps(form.state())))
    assert later.model() == stated
    assert type(stated)(**tomllib.loads(tomli_w.dumps(form.state()))) == stated
    form.restore({})
    assert not form.state().keys() - {"step", "method", "kind"}


def test_numbers_are_typed_with_units_and_shown_with_prefixes(qtbot):
    form = the_form(qtbot, ProtonSetup)
    energy, distance = form.entries["energy"], form.entries["object_image_distance"]
    enter(energy, "14700 keV")
    enter(distance, "0.0013")
    assert (energy.value, energy.line.value) == (14.7, "14.7 MeV")
    assert (distance.value, distance.line.value) == (1.3e-3, "1.3 mm")
    energy.line.value = "3 MeV"  # the entry is not left yet
    assert form.state()["energy"] == 3.0
    enter(energy, "")
    assert "energy" not in form.state()
    options = the_form(qtbot, InversionOptions)
    enter(options.entries["floor"], "0.001")  # the default, stated
    assert options.state() == {"floor": 0.001}


@pytest.mark.parametrize(
    ("text", "says"), [("little", "'little'"), ("3", "less than 1"), ("0.01", "")]
)
def test_the_model_refuses_what_was_typed(qtbot, text, says):
    form = the_form(qtbot, InversionOptions)
    enter(form.entries["floor"], text)
    assert form._problem.text().startswith("options: 'Floor' is" if says else "")
    if says:
        with pytest.raises(InputError, match=says):
            form.model()
    else:
        assert form.model() == InversionOptions(floor=0.01)
    enter(form.entries["floor"], "")
    enter(form.entries["flux"], "known")
    with pytest.raises(InputError, match="'Flux' is 'known' and 'Boundary' is 'closed'"):
        form.model()


def test_one_of_two_pixel_sizes_is_given(qtbot, proton_setup):
    form = the_form(qtbot, ProtonSetup)
    form.restore(proton_setup.model_dump())
    enter(form.entries["detector_pixel_size"], "145 µm")
    assert form.state()["detector_pixel_size"] == 145e-6
    assert "pixel_size" not in form.state()


def placeholders(form):
    """Return the texts in grey of the numbers that are empty."""
    lines = {name: entry.line for name, entry in form.entries.items()}
    return {
        name: line.native.placeholderText()
        for name, line in lines.items()
        if isinstance(line, LineEdit) and not line.value
    }


def test_an_instrument_shows_its_defaults_in_grey(qtbot):
    form = InstrumentForm()
    qtbot.addWidget(form)
    exact = placeholders(form)
    assert exact.keys() == Instrument.model_fields.keys() - {"detector", "beam_source"}
    assert exact["beam_rms"] == "0.05, or 0.005 if recorded"
    assert exact["registration"] == "measured in the images"
    assert exact["noise_correlation"] == "measured in the image"
    assert (exact["blur"], exact["beam_length"]) == ("0 px", "0.25")
    enter(form.entries["detector"], "image plate")
    enter(form.entries["beam_source"], "TNSA")
    shown = placeholders(form)
    assert (shown["blur"], shown["beam_rms"]) == ("1.5 px (image plate)", "0.1 (TNSA)")
    assert shown["absorption"] == "0"
    enter(form.entries["blur"], 2.0)
    assert "blur" not in placeholders(form)
    enter(form.entries["detector"], "camera")
    assert form.model() == Instrument(detector="camera", beam_source="TNSA", blur=2)
    form.restore({})
    assert placeholders(form) == exact


def test_choices_for_recipes_have_a_row_while_they_are_stated(qtbot):
    form = ModelForm(InversionOptions)
    qtbot.addWidget(form)
    solver = form.entries["solver"].widget.native
    for values in ({}, {"solver": "lbfgs"}, {}):
        form.restore(values)
        assert solver.isHidden() == (not values)
        assert form.model() == InversionOptions(**values)


@pytest.mark.parametrize("name", ["proton_setup", "optical_setup"])
def test_buttons_save_and_load_what_the_command_reads(
    name, request, qtbot, tmp_path, choose, messages
):
    setup, picker = request.getfixturevalue(name), SetupPicker("test")
    qtbot.addWidget(picker)
    path = tmp_path / "setup.toml"
    choose(path)
    picker.save_button.click()
    assert len(messages) == 1
    assert "no setup to save" in messages[0]
    picker.show_setup(setup.model_dump())
    picker.save_button.click()
    assert setup_from(path) == setup
    picker.set_kind("none")
    picker.load_button.click()
    assert picker.setup() == setup
    path.write_text("kind = 'proton'\nenergie = 3")
    picker.load_button.click()
    assert len(messages) == 2
    assert "energie" in messages[1]
    assert picker.setup() == setup


def test_a_file_is_chosen_for_a_number_that_may_be_one(qtbot, monkeypatch):
    form = the_form(qtbot, Dark)
    monkeypatch.setattr(QFileDialog, "getOpenFileName", lambda *_, **__: ("dark.tif", ""))
    form.entries["level"].widget[1].native.click()
    assert form.model() == Dark(level=Path("dark.tif"))
    enter(form.entries["level"], "12.5")
    assert form.model() == Dark(level=12.5)


def test_what_was_kept_is_loaded_and_damage_is_forgiven(settings_folder):
    assert saved_state("test") == {}
    save_state("test", {"a": [1, math.inf], "b": "µm"})
    assert saved_state("test") == {"a": [1, math.inf], "b": "µm"}
    save_state("damaged", {})
    (file,) = settings_folder.rglob("*.ini")
    file.write_text(file.read_text().replace("damaged={}", "damaged={]"))
    assert saved_state("damaged") == {}
