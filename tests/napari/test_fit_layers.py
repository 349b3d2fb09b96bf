"""A fit as layers, shown when its file is opened."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from helpers.fits import FIELDS, SETUPS, SHAPE, WHY
from napari_shadowinv import write
from napari_shadowinv._napari.layer_metadata import (
    Frame,
    Result,
    displacement_of,
    layer_key,
    role_of,
    setup_of,
    unit_of,
)
from napari_shadowinv._napari.layers import add_layers, fit_layers
from napari_shadowinv._napari.result_files import missing_layers
from napari_shadowinv.cautions import Caution
from napari_shadowinv.facts import Assessment, Verdict


def opened(viewer, path):
    viewer.layers.clear()
    viewer.open(str(path), plugin="napari-shadowinv")
    slots = [layer_key(layer) for layer in viewer.layers]
    assert len(set(slots)) == len(slots)
    return dict(zip(slots, viewer.layers, strict=True))


def more(viewer, layers):
    """All layers of a result of which only the main ones are shown."""
    missing = add_layers(viewer, missing_layers(viewer, layers["field"]))
    return layers | {layer_key(layer): layer for layer in missing}


def test_a_file_of_the_command_shows_all_of_a_fit(viewer, two_fields, tmp_path, messages):
    layers = opened(viewer, write(tmp_path / "pack.shadowinv", two_fields))
    layers = more(viewer, layers)
    in_each = ["potential", "field y", "field x", "direction", "field", "uncertainty", "arrows"]
    in_each += ["significance", "structures"]
    of_fields = ["field arrows", *(f"{role}{part}" for role in in_each for part in ("", " E"))]
    of_answers = [f"{role} {name} 1" for role in ("field", "arrows") for name in "BE"]
    of_images = ["reprojection", "residual"]
    assert set(layers) == {*of_fields, *of_answers, *of_images, "image 1", "image 2"}
    assert {slot for slot, layer in layers.items() if layer.visible} == {"field", "arrows"}
    for slot in of_images:
        assert layers[slot].data.shape == (2, *SHAPE)
        assert tuple(map(str, layers[slot].units)) == ("pixel", "micrometer", "micrometer")
        assert tuple(layers[slot].scale) == pytest.approx((1, 1.5, 1.5))
    np.testing.assert_array_equal(layers["reprojection"].data, two_fields.reprojection)
    for number, (pixels, setup) in enumerate(zip(two_fields.images, SETUPS, strict=True), 1):
        np.testing.assert_array_equal(layers[f"image {number}"].data, pixels)
        assert setup_of(layers[f"image {number}"]) == setup
    for slot, fitted_field in zip(("field", "field E"), two_fields.fields, strict=True):
        np.testing.assert_array_equal(displacement_of(layers[slot]), fitted_field.displacement)
    assert unit_of(layers["field"]).endswith("T·m")
    assert unit_of(layers["field E"]).endswith("V")
    assert unit_of(layers["uncertainty E"]) == unit_of(layers["field E"])
    assert "from near" in layers["field B 1"].name
    half = np.abs(displacement_of(layers["field B 1"])).max() / np.abs(FIELDS["B"][1]).max()
    assert half == pytest.approx(0.5, abs=0.1)


def test_a_verdict_cannot_be_missed(viewer, doubtful, tmp_path, messages):
    layers = opened(viewer, write(tmp_path / "pack.shadowinv", doubtful))
    assert messages == [f"pack.shadowinv: the fit's verdict is 'one of several': {WHY}"]
    assert layers["field"].name == "? |∫B×dz| (µT·m) – pack"
    good = replace(doubtful, assessment=Assessment(Verdict.DETERMINED, "all starts lead to one"))
    layers = opened(viewer, write(tmp_path / "good.shadowinv", good))
    assert len(messages) == 1
    assert layers["field"].name == "✓ |∫B×dz| (µT·m) – good"


def test_warnings_of_a_saved_inversion_are_told(viewer, solved, tmp_path, messages):
    report = replace(solved.report, cautions=(Caution("not-converged", "it did not converge"),))
    opened(viewer, write(tmp_path / "shot.shadowinv", replace(solved, report=report)))
    assert messages == ["shot.shadowinv: it did not converge"]


def test_a_beam_is_shown_once_unless_images_have_different_ones(doubtful):
    def beam(content):
        layers = fit_layers(Result(content), Frame(), "a")
        return next((data for data, about, _ in layers if role_of(about) == "source"), None)

    assert beam(doubtful) is None
    uneven = 1 + np.arange(SHAPE[1]) * np.ones(SHAPE) / 100
    proportional = np.stack([uneven, 1.3 * uneven])
    np.testing.assert_array_equal(beam(replace(doubtful, source=proportional)), uneven)
    different = np.stack([uneven, uneven[:, ::-1]])
    np.testing.assert_array_equal(beam(replace(doubtful, source=different)), different)
