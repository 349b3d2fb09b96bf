"""What a field owes to objects beyond its image's edge, against fields of a wider plane."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.fft import dstn, idstn
from scipy.ndimage import gaussian_filter

from napari_shadowinv.physics.edge import edge_changes, edge_doubt, edge_sides
from napari_shadowinv.physics.poisson import poisson_invert

SIDE = 48


def slopes(potential):
    return -np.array(np.gradient(potential))


def changes_of(potential):
    return edge_changes(potential, slopes(potential))


def blob(y, x, width=4.0):
    rows, columns = np.indices((SIDE, SIDE))
    return np.exp(-((rows - y) ** 2 + (columns - x) ** 2) / (2 * width**2))


def rms(displacement):
    return float(np.sqrt((displacement**2).sum(axis=-3).mean()))


def test_nothing_beyond_the_edge_moves_a_field_that_ends_inside():
    potential = blob(24, 22)
    assert rms(changes_of(potential)[:, 1:].sum(axis=0)) < 1e-4 * rms(slopes(potential))


def test_the_smallest_images_have_changes():
    assert np.isfinite(changes_of(np.outer(np.arange(4.0), np.arange(4.0)))).all()


def test_changes_have_no_sources_inside_but_an_even_one_of_another_exposure():
    for change in changes_of(blob(40, 3) - blob(5, 20, 6.0)):
        around = sum(np.roll(change[0], step, axis) for step in (1, -1) for axis in (0, 1))
        sources = (4 * change[0] - around)[1:-1, 1:-1]
        np.testing.assert_allclose(sources, sources.mean(), atol=1e-12)


def test_changes_turn_flux_back_or_hold_the_potential_along_an_edge():
    potential = blob(30, 6) - 0.5 * blob(5, 20, 6.0)
    closed = potential + np.sqrt(2) * changes_of(potential)[0, 0]
    assert rms(changes_of(closed)[0, 1:]) < 0.3 * rms(changes_of(potential)[0, 1:])
    top = changes_of(potential)[1, 0]
    assert abs(np.corrcoef(top[0], potential[0])[0, 1]) > 0.999
    assert np.abs(top[-1] - top[-2]).max() < 1e-3 * np.abs(top).max()


def test_an_object_that_goes_on_unchanged_owes_little_to_the_edge():
    """A jet, and a sheet, either side of which has another potential, in a closed frame."""
    x = (np.arange(SIDE) - 24) / 5.0
    for line in (np.exp(-(x**2) / 2), np.tanh(x)):
        jet = changes_of(np.tile(line, (SIDE, 1)))[:, 1:]
        assert np.sqrt((jet**2).sum(axis=(0, 1)).mean()) < 0.2 * rms(slopes(np.tile(line, (4, 1))))
    cut = changes_of(blob(0, 24, 6.0))[:, 1:]
    assert np.sqrt((cut**2).sum(axis=(0, 1)).mean()) > 0.3 * rms(slopes(blob(0, 24, 6.0)))


def held_at_edge(contrast):
    """Potential of a contrast that is zero along the edge."""
    waves = 2 - 2 * np.cos(np.pi * np.arange(1, SIDE + 1) / (SIDE + 1))
    return -idstn(dstn(contrast, type=1) / (waves[:, None] + waves), type=1)


@pytest.mark.parametrize("boundary", ["closed", "held"])
@pytest.mark.parametrize("reach", ["local", "far"])
def test_the_changes_are_the_error_where_everything_goes_on(boundary, reach):
    """Random potentials, or charges, whose fields reach far, on a plane six times as wide."""
    frame = slice(None), *(slice(2 * SIDE, 3 * SIDE),) * 2
    wave = 2 * np.pi * np.fft.fftfreq(6 * SIDE)
    square = wave[:, None] ** 2 + wave**2
    square[0, 0] = np.inf
    errors = []
    for seed in range(20):
        noise = np.random.default_rng(seed).normal(size=(6 * SIDE, 6 * SIDE))
        smooth = gaussian_filter(noise, 3.0, mode="wrap")
        wide = smooth if reach == "local" else np.fft.ifft2(np.fft.fft2(smooth) / square).real
        truth = slopes(wide)[frame]
        contrast = np.gradient(truth[0], axis=0) + np.gradient(truth[1], axis=1)
        closed = poisson_invert(1 - 0.1 * contrast / np.abs(contrast).max())
        closed *= 10 * np.abs(contrast).max()
        field = closed if boundary == "closed" else held_at_edge(-contrast)
        estimate = rms(np.sqrt((changes_of(field)[:, 1:] ** 2).sum(axis=0)))
        errors.append((rms(slopes(field) - truth), estimate))
    error, estimate = np.sqrt(np.mean(np.square(errors), axis=0))
    assert 0.4 < error / estimate < 2


def test_flux_that_leaves_on_all_sides_is_another_exposure():
    """The field of a charge falls as 1/r; a closed edge adds an even background."""
    rows, columns = np.indices((SIDE, SIDE)) - 23.5
    square = rows**2 + columns**2 + 4.0**2
    image = 1 - 0.01 * 2 * 4.0**2 * 8 / square**2
    field = poisson_invert(image)
    truth = 0.01 * 8 * np.stack([rows, columns]) / square
    closed = slopes(np.pad(field, 1, mode="symmetric"))[:, 1:-1, 1:-1]
    estimate = np.sqrt((edge_changes(field, closed)[:, 1:] ** 2).sum(axis=(0, 1)).mean())
    error = rms(closed - truth)
    assert error > 0.3 * rms(truth)
    assert error / estimate == pytest.approx(1, abs=0.25)


@pytest.mark.parametrize(
    ("places", "sides"),
    [
        ([(24, 0)], ("left",)),
        ([(24, 0), (24, 47)], ("left", "right")),
        ([(0, 24), (47, 24), (24, 0), (24, 47)], ("top", "bottom", "left", "right")),
    ],
)
def test_the_sides_are_those_that_cut_an_object(places, sides):
    changes = changes_of(sum(blob(*place) for place in places))
    assert edge_sides((changes[:, 1:] ** 2).sum(axis=(0, 1))) == sides
    assert ("all sides" in edge_doubt(0.3, 0.0, 0.1, sides)) == (len(sides) == 4)
