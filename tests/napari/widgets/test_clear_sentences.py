"""Windows speak of their own labels, once, and of what an earlier image left behind."""

from __future__ import annotations

import pickle

import numpy as np
import pytest

from helpers.reports import texts_of
from napari_shadowinv._napari.form import StepsSection
from napari_shadowinv._napari.viewer_sync import error_text
from napari_shadowinv._napari.widgets.invert import Invert
from napari_shadowinv.errors import InputError
from napari_shadowinv.physics.forward import synthetic_image
from napari_shadowinv.physics.phantoms import ellipse_pair
from napari_shadowinv.physics.setup import ProtonSetup, setup_from_dict
from napari_shadowinv.preprocessing import Bin

PATIENCE = 60_000  # ms


def test_an_error_calls_the_fields_of_a_setup_by_their_labels():
    with pytest.raises(InputError) as caught:
        setup_from_dict({"kind": "proton", "object_image_distance": 0}, "the setup")
    assert "'object_image_distance' is 0" in str(caught.value)
    text = error_text(caught.value)
    assert "'Object to image (m)' is 0" in text
    assert "_" not in text
    sent = pickle.loads(pickle.dumps(caught.value))
    assert (type(sent), str(sent)) == (InputError, str(caught.value))


def test_a_doubt_of_a_setup_stands_in_the_form_only(viewer, opened, qtbot, messages):
    image = synthetic_image(ellipse_pair((40, 52)).displacement)
    viewer.add_image(image, name="shot")
    tool = opened(Invert)
    tool.options.restore({"n_sites": 200})
    swapped = {"source_object_distance": 1.0, "object_image_distance": 0.01, "energy": 14.7}
    tool.setup.show_setup(ProtonSetup(pixel_size=1e-6, **swapped).model_dump())
    doubt = tool.setup.warning_label.text()
    assert "the magnification is 1.01" in doubt
    tool.panel.button.click()
    qtbot.waitUntil(lambda: tool.verdict.text() != "", timeout=PATIENCE)
    assert doubt not in texts_of(tool.report).values()


def test_steps_of_an_earlier_image_are_announced(qtbot):
    steps = StepsSection()
    qtbot.addWidget(steps)
    steps.restore([{"step": "bin", "factor": 2}])
    assert steps._earlier.text().startswith("Kept from an earlier image: bin.")
    steps.show_steps([Bin(factor=3)])  # of a recipe that the user loads
    assert steps._earlier.text() == ""
    steps.restore([])
    assert steps._earlier.text() == ""


def estimated(tool, method, qtbot):
    tool.source.set_kind(method)
    tool.show_source.click()
    qtbot.waitUntil(lambda: not tool.panel.running, timeout=PATIENCE)
    return str(tool.panel.status.text())


def test_an_estimate_that_contains_the_object_says_so(viewer, opened, qtbot):
    image = synthetic_image(1.5 * ellipse_pair((96, 120)).displacement)
    viewer.add_image(image * np.random.default_rng(5).normal(1, 0.01, image.shape), name="shot")
    tool = opened(Invert)
    assert estimated(tool, "polynomial", qtbot) == ""
    assert "of the pattern in the image" in estimated(tool, "total-variation", qtbot)
    mask = np.zeros(image.shape, int)
    mask[20:76, 20:100] = 1
    tool.source_masks.layer = viewer.add_labels(mask)
    assert estimated(tool, "total-variation", qtbot) == ""


def test_a_file_that_fails_is_not_shown_in_place_of_the_last_shot(
    window, open_widget, qtbot, tmp_path
):
    tool = open_widget("Invert")
    tool.options.restore({"n_sites": 100})
    tool.image.set_kind("folder")
    tool.image.form.restore({"path": str(tmp_path)})
    tool.store.watch.restore({"pattern": "*.npy"})
    tool.store.folder.restore({"path": str(tmp_path / "a.shadowinv.zarr")})
    image = synthetic_image(ellipse_pair((40, 52)).displacement)
    (tmp_path / "a0.npy").write_bytes(b"")
    for number in (1, 2):
        np.save(tmp_path / f"a{number}.npy", image)
    tool.panel.button.click()
    qtbot.waitUntil(lambda: "2 done" in tool.panel.status.text(), timeout=PATIENCE)
    (tmp_path / "a3.npy").write_bytes(b"")
    qtbot.waitUntil(lambda: len(tool.stack_view.failures.rows) == 2, timeout=PATIENCE)
    qtbot.wait(1000)
    assert window.dims.current_step[0] == 2
    np.save(tmp_path / "a4.npy", image)
    qtbot.waitUntil(lambda: window.dims.current_step[0] == 4, timeout=PATIENCE)
    tool.panel.button.click()
    qtbot.waitUntil(lambda: not tool.panel.running, timeout=PATIENCE)
