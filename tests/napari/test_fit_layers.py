"""A fit as layers: shown, saved, and shown again when its file is opened."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from napari.components import ViewerModel

from napari_shadowinv import ProtonSetup, read, write
from napari_shadowinv._napari.layer_metadata import (
    Frame,
    Result,
    displacement_of,
    layer_key,
    metadata_of,
    result_of,
    role_of,
    setup_of,
    unit_of,
)
from napari_shadowinv._napari.layers import add_layers, fit_layers
from napari_shadowinv._napari.result_files import missing_layers
from napari_shadowinv.cautions import Caution
from napari_shadowinv.facts import Assessment, Verdict
from napari_shadowinv.fitting import Fit, fit
from napari_shadowinv.inversion import Inversion
from napari_shadowinv.options import FitOptions, Instrument
from napari_shadowinv.physics.forward import synthetic_image
from napari_shadowinv.physics.phantoms import gaussian_blob
from napari_shadowinv.physics.projection import transferred_displacement
from napari_shadowinv.shot import shots_of

SHAPE = (48, 64)
LENGTHS = {"source_object_distance": 1.3e-3, "object_image_distance": 2e-2, "pixel_size": 1.5e-6}
SETUPS = tuple(ProtonSetup(energy=energy, **LENGTHS) for energy in (20.0, 3.0))
MAGNETIC = gaussian_blob(SHAPE, 10.0, 8.0, (22.0, 35.0)).displacement
ELECTRIC = gaussian_blob(SHAPE, 7.0, 7.0, (28.0, 24.0)).displacement
WHY = "2 different fields explain the images about as well"


def image(setup: ProtonSetup, *, electric: bool) -> Any:
    moved = transferred_displacement(MAGNETIC, SETUPS[0], setup, deflector="magnetic field")
    if electric:
        moved = moved + transferred_displacement(
            ELECTRIC, SETUPS[0], setup, deflector="electric field"
        )
    noise = np.random.default_rng(int(setup.energy)).normal(0, 0.01, SHAPE)
    return synthetic_image(moved) + noise


def found(fields: tuple[str, ...]) -> Fit:
    """A fit with an alternative solution, and the verdict on it."""
    images = [image(setup, electric=len(fields) > 1) for setup in SETUPS]
    options = FitOptions(max_iterations=3, samples=2)
    even = Instrument(beam_rms=0)
    best = fit(
        shots_of(images, setup=SETUPS, noise=0.01), fields=fields, options=options, instrument=even
    )
    (first, *_) = best.basins
    alternative = replace(
        first, start="from near", distance=0.5, displacement=first.displacement / 2
    )
    assessment = Assessment(Verdict.SEVERAL, WHY)
    return replace(best, basins=(first, alternative), assessment=assessment)


@pytest.fixture(scope="module")
def doubtful() -> Fit:
    return found(("B",))


@pytest.fixture(scope="module")
def two_fields() -> Fit:
    return found(("B", "E"))


def opened(viewer: ViewerModel, path: Path) -> dict[str, Any]:
    viewer.layers.clear()
    viewer.open(str(path), plugin="napari-shadowinv")
    slots = [layer_key(layer) for layer in viewer.layers]
    assert len(set(slots)) == len(slots)
    return dict(zip(slots, viewer.layers, strict=True))


def shown(viewer: ViewerModel, content: Fit, **place: Any) -> dict[str, Any]:
    """The layers of a fit as the widget adds them."""
    result = Result(content, content.setups[0], {"Mask": "painted"})
    layers = add_layers(viewer, fit_layers(result, Frame(**place), "pack fit"))
    return {layer_key(layer): layer for layer in layers}


def more(viewer: ViewerModel, layers: dict[str, Any]) -> dict[str, Any]:
    """All layers of a result of which only the main ones are shown."""
    missing = add_layers(viewer, missing_layers(viewer, layers["field"]))
    return layers | {layer_key(layer): layer for layer in missing}


def test_a_file_of_the_command_shows_all_of_a_fit(
    viewer: ViewerModel, two_fields: Fit, tmp_path: Path, messages: list[str]
) -> None:
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
    half = np.abs(displacement_of(layers["field B 1"])).max() / np.abs(MAGNETIC).max()
    assert half == pytest.approx(0.5, abs=0.1)


def test_a_verdict_cannot_be_missed(
    viewer: ViewerModel, doubtful: Fit, tmp_path: Path, messages: list[str]
) -> None:
    layers = opened(viewer, write(tmp_path / "pack.shadowinv", doubtful))
    assert messages == [f"pack.shadowinv: the fit's verdict is 'one of several': {WHY}"]
    for layer in layers.values():
        assert metadata_of(layer)["verdict"] == "one of several"
        assert metadata_of(layer)["explanation"] == WHY
    assert layers["field"].name == "? |∫B×dz| (µT·m) – pack"
    good = replace(doubtful, assessment=Assessment(Verdict.DETERMINED, "all starts lead to one"))
    layers = opened(viewer, write(tmp_path / "good.shadowinv", good))
    assert len(messages) == 1
    assert metadata_of(layers["field"])["verdict"] == "determined"
    assert layers["field"].name == "✓ |∫B×dz| (µT·m) – good"


def test_warnings_of_a_saved_inversion_are_told(
    viewer: ViewerModel, solved: Inversion, tmp_path: Path, messages: list[str]
) -> None:
    report = replace(solved.report, cautions=(Caution("not-converged", "it did not converge"),))
    opened(viewer, write(tmp_path / "shot.shadowinv", replace(solved, report=report)))
    assert messages == ["shot.shadowinv: it did not converge"]


def test_any_layer_stands_for_the_fit_when_it_is_saved(
    viewer: ViewerModel, two_fields: Fit, tmp_path: Path, messages: list[str]
) -> None:
    turned = {"translate": (3.0, 4.0), "rotate": ((0.0, -1.0), (1.0, 0.0))}
    layers = shown(viewer, two_fields, **turned)
    layers["field E"].colormap = "viridis"
    layers["residual"].visible = True
    path = tmp_path / "pack.shadowinv"
    for saved in (["residual", "field E"], ["field E"]):
        viewer.layers.selection = {layers[slot] for slot in saved}
        viewer.layers.save(str(path), selected=True, plugin="napari-shadowinv")
        again = Fit.from_dataset(read(path))
        for reloaded_field, fitted_field in zip(again.fields, two_fields.fields, strict=True):
            np.testing.assert_array_equal(reloaded_field.displacement, fitted_field.displacement)
        viewer.layers.clear()
        reopened = opened(viewer, path)
        assert {slot for slot, layer in reopened.items() if layer.visible} <= {
            "field",
            "arrows",
            *saved,
        }
        assert reopened["field E"].colormap.name == "viridis"
        assert tuple(reopened["field"].translate) == (3, 4)
        np.testing.assert_array_equal(reopened["field"].rotate, turned["rotate"])
        assert result_of(reopened["field"]).origins["Mask"] == "painted"
        viewer.layers.clear()
        layers = shown(viewer, two_fields, **turned)
        layers["field E"].colormap = "viridis"
    assert not [text for text in messages if "changed" in text]


def test_a_beam_is_shown_once_unless_images_have_different_ones(doubtful: Fit) -> None:
    def beam(content: Fit) -> Any:
        layers = fit_layers(Result(content), Frame(), "a")
        return next((data for data, about, _ in layers if role_of(about) == "source"), None)

    assert beam(doubtful) is None
    uneven = 1 + np.arange(SHAPE[1]) * np.ones(SHAPE) / 100
    proportional = np.stack([uneven, 1.3 * uneven])
    np.testing.assert_array_equal(beam(replace(doubtful, source=proportional)), uneven)
    different = np.stack([uneven, uneven[:, ::-1]])
    np.testing.assert_array_equal(beam(replace(doubtful, source=different)), different)
