"""*Simulate*: the image of an object, and the plan of an experiment with it."""

import numpy as np
import pytest

from helpers.forms import enter
from helpers.layers import by_role
from helpers.reports import texts_of
from napari_shadowinv import OpticalSetup, ProtonSetup
from napari_shadowinv._napari.layer_metadata import (
    Frame,
    Result,
    displacement_of,
    role_of,
    source_of,
    unit_of,
)
from napari_shadowinv._napari.layers import add_layers, add_to_viewer, fit_layers
from napari_shadowinv._napari.simulate import Simulate
from napari_shadowinv._napari.widgets.invert import Invert
from napari_shadowinv.physics.forward import synthetic_image
from napari_shadowinv.physics.phantoms import coaxial_line, four_toroids, wakefield
from napari_shadowinv.physics.projection import predict_image


@pytest.fixture
def image(run):
    """Press Run, and return the layer of the image."""

    def pressed(tool):
        run(tool)
        (layer,) = tool.results.layers
        return layer

    return pressed


def test_an_object_makes_its_image_and_caustics_are_warned_of(opened, image, messages):
    tool = opened(Simulate)
    tool.object.set_kind("four_toroids")
    tool.side.setText("60 x 80")
    strength = tool.object.form.entries["strength"]
    enter(strength, 0.2)
    expected = four_toroids((60, 80), ProtonSetup.example(), 0.2)
    layer = image(tool)
    np.testing.assert_allclose(layer.data, synthetic_image(expected.displacement))
    assert tuple(layer.scale) == pytest.approx((1.5, 1.5))
    assert not tool.warning.isVisibleTo(tool)
    messages.clear()
    enter(strength, 2.0)
    image(tool)
    assert tool.warning.isVisibleTo(tool)
    assert "Caustics" in tool.warning.text()
    assert messages == []


def test_only_fields_of_results_are_offered(viewer, opened, refused, solved, proton_setup, shot):
    tool = opened(Simulate)
    tool.object.set_kind("layer")
    refused(tool, "here is no result to start from")
    viewer.add_image(shot, name="counts")
    add_to_viewer(viewer, solved, proton_setup, name="solved", all_layers=True)
    roles = [role_of(layer) for layer in tool.field.offered]
    assert roles == ["potential", "field y", "field x", "field"]
    assert tool.panel.status.text() == ""  # the error was of no layer
    assert tool.setup.setup() == proton_setup


def test_a_fitted_field_deflects_by_its_own_cause(viewer, opened, image, two_fields):
    add_layers(viewer, fit_layers(Result(two_fields), Frame(), "fit"))
    first, second = two_fields.setups
    tool = opened(Simulate)
    tool.object.set_kind("layer")
    for field, cause in zip(two_fields.fields, ("magnetic field", "electric field"), strict=True):
        tool.field.layer = next(
            layer
            for layer in tool.field.offered
            if np.array_equal(displacement_of(layer), field.displacement)
        )
        tool.setup.show_setup(second.model_dump())
        expected = predict_image(field.displacement, first, second, deflector=cause)
        np.testing.assert_allclose(image(tool).data, expected)


def test_a_result_is_seen_in_another_experiment_as_the_core_sees_it(
    viewer, opened, image, messages, solved, proton_setup
):
    layers = by_role(add_to_viewer(viewer, solved, proton_setup, name="solved", all_layers=True))
    tool = opened(Simulate)
    tool.object.set_kind("layer")
    slow = proton_setup.model_copy(update={"energy": 3.0})
    tool.setup.show_setup(slow.model_dump())
    expected = predict_image(solved.displacement, proton_setup, slow)
    layer = image(tool)
    assert layer.name.startswith("solved image")
    np.testing.assert_allclose(layer.data, expected)
    assert "the magnetic field alone deflects the beam" in tool.warning.text()
    # Its potential stands for the same field.
    assert unit_of(layers["potential"]) != "px²"
    tool.field.layer = layers["potential"]
    tool.setup.show_setup(slow.model_dump())
    np.testing.assert_allclose(image(tool).data, expected)
    # It knows its own experiment.
    for show_own in (
        lambda: tool.setup.show_setup(proton_setup.model_dump()),
        lambda: tool.setup.set_kind("none"),
    ):
        show_own()
        again = image(tool).data
        np.testing.assert_allclose(again, synthetic_image(solved.displacement))
    inner = (slice(3, -3), slice(3, -3))
    relative = solved.reprojection / solved.source.mean()
    assert abs(again - relative)[inner].max() < 0.02 * relative.max()
    assert messages == []


def test_conductors_stop_the_beam_and_their_image_can_be_inverted(opened, image, messages):
    tool = opened(Simulate)
    tool.object.set_kind("coaxial")
    layer = image(tool)
    phantom, obstructed = coaxial_line((200, 200), ProtonSetup.example())
    dark = np.where(obstructed, 0.0, 1.0)
    np.testing.assert_allclose(layer.data, synthetic_image(phantom.displacement, dark))
    np.testing.assert_array_equal(source_of(layer), dark)
    shot = opened(Invert)
    np.testing.assert_array_equal(shot.source.measured(shot.image.layer).image, dark)
    assert messages == []


def test_an_object_brings_the_beam_that_it_needs(opened, image):
    tool = opened(Simulate)
    tool.object.set_kind("wakefield")
    assert tool.setup.setup() == OpticalSetup.example()
    wave = wakefield((200, 200), OpticalSetup.example())
    np.testing.assert_allclose(image(tool).data, synthetic_image(wave.displacement))
    enter(tool.object.form.entries["density"], "2e19 cm⁻³")
    assert tool.object.model().density == pytest.approx(2e25)

    # What somebody has typed is not replaced.
    entered = OpticalSetup.example().model_copy(update={"wavelength": 532e-9})
    tool.setup.show_setup(entered.model_dump())
    tool.object.set_kind("toroid")
    assert tool.setup.setup() == ProtonSetup.example()
    tool.object.set_kind("wakefield")
    assert tool.setup.setup() == entered


@pytest.fixture
def tool(opened):
    """The widget with a small toroid and three draws."""
    tool = opened(Simulate)
    tool.task.set_kind("plan")
    tool.object.set_kind("toroid")
    tool.object.form.restore({"peak": 20.0, "radius": 9e-6})
    tool.side.setText("64 x 64")
    tool.instrument.restore({"beam_rms": 0.0})
    tool.options.restore({"draws": 3, "counts": 3000.0})
    return tool


def test_a_plan_shows_its_verdict_and_the_first_image(tool, image):
    assert tool.setup.setup() == ProtonSetup.example()
    layer = image(tool)
    assert "would be determined: 3 of 3" in tool.verdict.text()
    assert "Error made" in texts_of(tool.report)
    assert role_of(layer) == "shot"
    assert layer.data.mean() == pytest.approx(3000, rel=0.01)
    assert not tool.plot.isHidden()
