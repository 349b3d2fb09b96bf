"""Film packs as layers, without a window."""

from copy import deepcopy
from dataclasses import replace

import numpy as np
import pytest
from napari.layers import Layer

from napari_shadowinv import write
from napari_shadowinv._napari.layer_metadata import frame_for, role_of, setup_of, usable_of
from napari_shadowinv._napari.viewer_sync import connect_viewer
from napari_shadowinv._napari.widgets.film_pack import film_layers
from napari_shadowinv._napari.widgets.fit_images import entries_of

PLUGIN = "napari-shadowinv"


@pytest.fixture
def file(pack_doses, tmp_path):
    return write(tmp_path / "trio.shadowinv", pack_doses)


def opened(viewer, file):
    return {str(role_of(layer)): layer for layer in viewer.open(file, plugin=PLUGIN)}


def test_a_pack_opens_as_stacks_of_films(viewer, pack_doses, file, tmp_path):
    layers = opened(viewer, file)
    assert list(layers) == ["dose", "fluence", "unusable"]
    assert [layer.visible for layer in layers.values()] == [False, True, False]
    pixel = 1e6 * pack_doses.pixel_size / 11  # over the magnification
    for layer in layers.values():
        assert layer.data.shape == pack_doses.fluence.shape
        assert layer.axis_labels == ("layer", "y", "x")
        np.testing.assert_allclose(layer.scale, (1, pixel, pixel))
    np.testing.assert_array_equal(layers["fluence"].data, pack_doses.fluence)
    np.testing.assert_array_equal(layers["dose"].data, pack_doses.dose)
    np.testing.assert_array_equal(layers["unusable"].data == 0, pack_doses.usable)
    # Without a setup it has the pixels of its scans.
    bare = write(tmp_path / "bare.shadowinv", replace(pack_doses, setups=()))
    scale = opened(viewer, bare)["fluence"].scale
    np.testing.assert_allclose(scale[1:], 1e6 * pack_doses.pixel_size)


def test_the_film_in_view_is_named_and_has_its_own_contrast(viewer, file, pack_doses):
    energies, times = pack_doses.energies, 1e12 * pack_doses.times_of_flight
    labels = [
        f"{energy:.3g} MeV, {time:.3g} ps" for energy, time in zip(energies, times, strict=True)
    ]
    connect_viewer(viewer)
    fluence = opened(viewer, file)["fluence"]
    text = viewer.canvas.overlays.text
    viewer.dims.set_current_step(0, 0)
    assert text.visible
    assert text.text == f"film 1: {labels[0]}"
    first = tuple(fluence.contrast_limits)
    viewer.dims.set_current_step(0, 2)
    assert text.text == f"film 3: {labels[2]}"
    middle = fluence.data[2][20:60, 20:80]
    assert fluence.contrast_limits[1] < 1.5 * np.percentile(middle, 99.9) < first[1]
    fluence.contrast_limits = (0, 7e12)
    viewer.dims.set_current_step(0, 0)
    assert tuple(fluence.contrast_limits) == first
    viewer.dims.set_current_step(0, 2)
    assert tuple(fluence.contrast_limits) == (0, 7e12)
    fluence.visible = False
    assert not text.visible


def test_images_for_a_fit_know_setup_energy_and_usable_pixels(pack_doses):
    lost = deepcopy(pack_doses)
    lost.usable[1] = False
    frame = frame_for(lost.dose.shape, lost.setup)
    layers = [Layer.create(*layer_data) for layer_data in film_layers(lost, frame, "trio")]
    first, _, last = (f"{energy:.3g} MeV" for energy in pack_doses.energies)
    assert [layer.name for layer in layers] == [f"film 1, {first}", f"film 3, {last}"]
    for layer, k in zip(layers, (0, 2), strict=True):
        usable = lost.usable[k]
        setup = setup_of(layer)
        assert setup.energy == lost.energies[k]
        np.testing.assert_array_equal(usable_of(layer), usable)
        np.testing.assert_array_equal(layer.data, np.where(usable, lost.fluence[k], 0))
        np.testing.assert_allclose(layer.scale, 1e6 * setup.object_pixel_size)
    # Without a setup they know their energy only.
    first, *_ = film_layers(replace(lost, setups=()), frame, "trio")
    assert setup_of(first[1]) is None
    assert entries_of(first[1]) == {"energy": lost.energies[0]}


def test_layers_that_are_no_measurement_are_marked(pack_doses):
    assert list(pack_doses.spectrum().is_measured) == [True, True, False]
    faint = deepcopy(pack_doses)
    faint.fluence_error[0] = faint.fluence[0]
    faint.usable[1] = False
    assert not faint.spectrum().is_measured.any()
    # Electrons leave 0.1 Gy in the last film; what protons and they leave before it.
    flat = deepcopy(pack_doses)
    for scale, is_measured in ((2.5, False), (4.0, True)):
        for k, dose in enumerate((10.0, 0.1 * scale, 0.1)):
            flat.dose[k] = np.where(flat.usable[k], dose, np.nan)
        assert list(flat.spectrum().is_measured) == [True, is_measured, False]
