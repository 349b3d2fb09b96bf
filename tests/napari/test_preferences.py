"""Preferences of the plugin in napari, and what follows them."""

import numpy as np
import pytest
from napari.layers import Image

from napari_shadowinv import add_to_viewer
from napari_shadowinv._napari import preferences as about
from napari_shadowinv._napari.layer_metadata import frame_for, role_of
from napari_shadowinv._napari.samples import toroid
from napari_shadowinv._system.machine import available_threads


@pytest.fixture
def configurations(manifest):
    return dict(manifest.contributions.configurations)


def test_the_manifest_has_the_defaults(configurations):
    declared = {
        group: {name: field.default for name, field in configuration.properties.items()}
        for group, configuration in configurations.items()
    }
    assert declared == about.DEFAULTS


def test_napari_has_every_colour_map_on_offer(configurations):
    offered = {
        name for field in configurations["colour_maps"].properties.values() for name in field.enum
    }
    assert {Image(np.eye(2), colormap=name).colormap.name for name in offered} == offered


def test_new_layers_have_the_preferred_colours(viewer, solved, preferences):
    add_to_viewer(viewer, solved, all_layers=True)
    colours = preferences.colour_maps
    colours.field, colours.signed, colours.image = "viridis", "PiYG", "gray_r"
    layers = add_to_viewer(viewer, solved, all_layers=True)
    names = {role_of(layer): layer.colormap.name for layer in layers if isinstance(layer, Image)}
    assert names["field"] == "viridis"
    assert names["residual"] == names["field y"] == "PiYG"
    assert names["image"] == names["reprojection"] == "gray_r"
    assert names["potential"] == "viridis"
    # Layers that were there keep their colours.
    assert {role_of(layer): layer.colormap.name for layer in viewer.layers[:3]}["image"] == "gray"
    assert toroid()[-1][1]["colormap"] == "gray_r"


@pytest.mark.parametrize(("rows", "unit", "scale"), [(600, "mm", 0.02), (400, "um", 20)])
def test_axes_have_a_unit_that_suits_their_length(rows, unit, scale):
    frame = frame_for((rows, 400), None, pixel_size=20e-6)
    assert frame.units == (unit, unit)
    assert frame.scale == pytest.approx((scale, scale))


def test_an_older_napari_has_the_defaults(monkeypatch):
    monkeypatch.delattr("napari.settings.get_plugin_settings", raising=False)
    assert about.colour_map("field") == "inferno"
    about.use_preferred_threads()
    assert available_threads(None) >= 1
