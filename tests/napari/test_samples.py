"""Sample data: there at once, with setup and source, and as they were meant."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import pytest
from napari.components import ViewerModel

from napari_shadowinv import OpticalSetup, ProtonSetup
from napari_shadowinv._napari import samples
from napari_shadowinv._napari.layer_metadata import role_of, setup_of, source_of
from napari_shadowinv.physics.forward import synthetic_image

SHOTS = ("toroid", "toroid_with_caustics", "four_toroids", "coaxial_line")


@pytest.mark.parametrize("name", [*SHOTS, "wakefield_run"])
def test_each_opens_within_two_seconds(viewer: ViewerModel, name: str) -> None:
    synthetic_image(np.zeros((2, 8, 8)))  # compiles its kernels
    start = time.thread_time()
    layers = viewer.open_sample("napari-shadowinv", name)
    assert time.thread_time() - start < 2
    assert layers
    for layer in layers:
        assert isinstance(setup_of(layer), (ProtonSetup, OpticalSetup))
        assert {str(unit) for unit in layer.units[-2:]} == {"micrometer"}


@pytest.mark.parametrize("name", SHOTS)
def test_the_source_is_a_layer_where_it_is_not_uniform(viewer: ViewerModel, name: str) -> None:
    layers = {role_of(layer): layer for layer in viewer.open_sample("napari-shadowinv", name)}
    assert ("source" in layers) == (name != "toroid_with_caustics")
    beam: Any = source_of(layers["shot"])
    if beam is not None:
        np.testing.assert_array_equal(layers["source"].data, beam)
        # Only what is thrown out of the image is missing.
        share = layers["shot"].data.sum() / beam.sum()
        assert 0.95 < share < 1.005


def test_caustics_are_where_the_name_promises_them() -> None:
    ((image, _, _),) = samples.toroid_with_caustics()
    below = samples.toroid()[-1][0]
    assert image.max() > 8 * image.mean()
    assert below.max() < 8 * below.mean()


def test_the_same_sample_is_the_same_every_time() -> None:
    for make in (samples.four_toroids, samples.coaxial_line):
        np.testing.assert_array_equal(make()[-1][0], make()[-1][0])


def test_the_run_is_lazy_and_changes_with_time() -> None:
    ((stack, keywords, _),) = samples.wakefield_run()
    assert type(stack).__module__.startswith("dask")
    assert len(stack) == 20
    assert stack.numblocks == (20, 1, 1)
    assert keywords["axis_labels"] == ("shot", "y", "x")
    planes = stack[[2, 10]].compute()
    contrast = planes.std(axis=(1, 2)) / planes.mean(axis=(1, 2))
    assert contrast[1] > 1.5 * contrast[0]
    low, high = keywords["contrast_limits"]
    assert low < planes.mean() < high
