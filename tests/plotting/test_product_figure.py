"""The figure of products shows their values, bands and words, none over another."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import xarray as xr

from helpers.exact_fields import SETUP, field_of
from napari_shadowinv.analysis import CurrentDensity, LineProfile, Region, analyse, analyse_shots
from napari_shadowinv.inversion import invert
from napari_shadowinv.physics.forward import synthetic_image
from napari_shadowinv.physics.phantoms import toroid
from napari_shadowinv.plotting import products_figure

PRODUCTS = [
    LineProfile(path=[(23.5, 5), (23.5, 42)]),
    Region(center=(23.5, 23.5), radius=8),
    CurrentDensity(smoothing=2),
]


def test_figure_draws_curves_with_bands_and_maps_in_their_units():
    phantom = toroid((48, 48), SETUP, 30.0, 9e-6)
    image = np.random.default_rng(0).poisson(400 * synthetic_image(phantom.displacement))
    inversion = invert(image, source=np.full(image.shape, 400.0))
    results = analyse(inversion, PRODUCTS, setup=SETUP, samples=20, unit="MG µm")
    figure = products_figure(results, title="shot 7")
    profile = figure.axes[0]
    assert profile.get_ylabel() == "field (MG µm)"
    assert profile.get_xlabel() == "Distance along the line (µm)"
    (line,) = (line for line in profile.lines if line.get_label() == "normal")
    np.testing.assert_allclose(line.get_ydata(), results[0]["normal"].value / 1e-4)
    assert len(profile.collections) == 4  # two bands of two components
    band = results[0].band("normal", 0.95)
    edges = profile.collections[3].get_paths()[0].vertices[:, 1]
    np.testing.assert_allclose(edges.max(), band[1].max() / 1e-4)
    (shown,) = (axes.images[0] for axes in figure.axes if axes.images)
    ratio = shown.get_array() / results[2]["density"].value
    np.testing.assert_allclose(ratio, ratio[0, 0])


def test_words_are_on_the_page_and_not_over_each_other():
    results = analyse(field_of(toroid((48, 48), SETUP, 30.0, 9e-6)), PRODUCTS)
    figure = products_figure(results, title="shot 7")
    figure.draw_without_rendering()
    texts = [text.get_window_extent() for text in figure.texts]
    boxes = [axes.get_tightbbox() for axes in figure.axes]
    for box in texts:
        assert figure.bbox.x0 <= box.x0
        assert box.x1 <= figure.bbox.x1
        assert figure.bbox.y0 <= box.y0
        assert box.y1 <= figure.bbox.y1
    for first, second in combinations(texts, 2):
        assert not first.overlaps(second)
    for text in texts:
        assert not any(text.overlaps(box) for box in boxes)
    written = " ".join(text.get_text() for text in figure.texts)
    for fact in results[1].facts[:3]:
        assert fact.text in written
    assert "a rotation of the displacement is not seen" in written.lower()


def test_series_has_a_panel_for_each_unit():
    fields = [field_of(toroid((48, 48), SETUP, peak, 9e-6)) for peak in (20.0, 30.0)]
    stack = xr.concat([field.dataset for field in fields], "shot").assign_attrs(
        fields[0].dataset.attrs
    )
    (series,) = analyse_shots(stack, PRODUCTS[1], [0.0, 2e-9])
    numbers, places = products_figure([series]).axes
    assert (numbers.get_ylabel(), places.get_ylabel()) == ("field (T m)", "µm")
    assert places.get_xlabel() == "time (ns)"
    lines = {line.get_label(): line for axes in (numbers, places) for line in axes.lines}
    np.testing.assert_allclose(lines["rms"].get_xdata(), [0, 2])
    np.testing.assert_allclose(lines["centroid_x"].get_ydata(), 1e6 * series["centroid_x"].value)


def test_numbers_alone_need_no_panel():
    results = analyse(field_of(toroid((48, 48), SETUP, 30.0, 9e-6)), PRODUCTS[1])
    assert products_figure(results).axes == []
