from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from helpers.polygons import clipped_to_rectangle, over_pixels, power_cell, power_diagram, shoelace
from napari_shadowinv.geometry.density import Density, split_pixels
from napari_shadowinv.geometry.power_diagram import PowerDiagram
from napari_shadowinv.geometry.triangulation import RegularTriangulation
from napari_shadowinv.physics.arrays import block_sums


def low_and_high(shape):
    return (-0.5, -0.5), (shape[0] - 0.5, shape[1] - 0.5)


@given(st.integers(0, 2**32 - 1), st.sampled_from([0.0, 0.3, 3.0, 30.0]))
@settings(max_examples=40, deadline=None)
def test_every_cell_equals_half_plane_clipping(seed, spread):
    rng = np.random.default_rng(seed)
    image = rng.random((6, 8))
    sites = rng.random((20, 2)) * image.shape - 0.5
    weights = spread * rng.random(20)
    diagram = power_diagram(sites, Density.from_image(image), weights)
    for i in range(20):
        cell = power_cell(sites, weights, i, *low_and_high(image.shape))
        mass, moments, inertia = over_pixels(cell, image)
        assert diagram.masses[i] == pytest.approx(mass, abs=1e-10)
        if mass > 1e-6:
            np.testing.assert_allclose(diagram.centroids[i], moments / mass, atol=1e-6)
            about_site = inertia - 2 * sites[i] @ moments + sites[i] @ sites[i] * mass
            assert diagram.inertia[i] == pytest.approx(about_site, abs=1e-8)


def awkward_sites(kind, rng, shape):
    n = int(rng.integers(2, 14))
    if kind == "grid":
        sites = rng.permutation(np.indices((3, 4)).reshape(2, -1).T.astype(float))[:n]
    elif kind == "collinear":
        sites = np.outer(rng.random(n), [2.0, 3.0])
    elif kind == "duplicates":
        sites = rng.integers(0, 3, (n, 2)).astype(float)
    elif kind == "clustered":
        sites = 1.5 + 1e-3 * rng.normal(size=(n, 2))
    else:
        sites = rng.random((n, 2)) * shape - 0.5
    return sites


@pytest.mark.parametrize("kind", ["uniform", "grid", "collinear", "duplicates", "clustered"])
@given(st.integers(0, 2**32 - 1))
@settings(max_examples=50, deadline=None)
def test_masses_equal_half_plane_clipping(kind, seed):
    """A thousand diagrams, weights over ten orders of magnitude, to 1e-10 of a mean cell."""
    rng = np.random.default_rng(seed)
    for scale in 10.0 ** rng.uniform(-8, 2, 4):
        image = rng.random((4, 5))
        sites = awkward_sites(kind, rng, image.shape)
        weights = scale * rng.normal(size=len(sites))
        cells = [
            power_cell(sites, weights, i, *low_and_high(image.shape)) for i in range(len(sites))
        ]
        expected = [over_pixels(cell, image)[0] for cell in cells]
        masses = power_diagram(sites, Density.from_image(image), weights).masses
        np.testing.assert_allclose(masses, expected, rtol=0, atol=1e-10 * image.sum() / len(sites))


def test_a_border_that_ends_far_away_is_as_exact_as_any():
    """Only two of eleven sites within 1e-3 px have cells, whose border ends between ghosts."""
    rng = np.random.default_rng(491635)
    scale = (10.0 ** rng.uniform(-8, 2, 4))[0]
    image = rng.random((4, 5))
    sites = awkward_sites("clustered", rng, image.shape)
    weights = scale * rng.normal(size=len(sites))
    expected = [
        over_pixels(power_cell(sites, weights, i, *low_and_high(image.shape)), image)[0]
        for i in range(len(sites))
    ]
    diagram = power_diagram(sites, Density.from_image(image), weights)
    assert np.flatnonzero(diagram.masses).tolist() == [2, 3]
    np.testing.assert_allclose(diagram.masses, expected, rtol=0, atol=1e-12)


def test_cells_tile_the_image():
    rng = np.random.default_rng(3)
    image = rng.random((50, 70)) * 1000
    sites = rng.random((2000, 2)) * image.shape - 0.5
    diagram = power_diagram(sites, Density.from_image(image), rng.random(2000))
    assert diagram.masses.sum() == pytest.approx(image.sum(), rel=1e-13)
    areas = [
        shoelace(clipped_to_rectangle(diagram.cell(i), *low_and_high(image.shape)))[0]
        for i in range(0, 2000)
    ]
    assert sum(areas) == pytest.approx(50 * 70, rel=1e-12)


def test_flux_through_each_border_equals_the_polygons():
    """In a uniform image the flux is the length of the border inside the image."""
    rng = np.random.default_rng(4)
    shape = (8, 8)
    sites = rng.random((30, 2)) * shape - 0.5
    weights = 0.5 * rng.random(30)
    diagram = power_diagram(sites, Density.from_image(np.ones(shape)), weights)
    lengths = {}
    for i in range(30):
        cell = power_cell(sites, weights, i, *low_and_high(shape))
        lift = (sites**2).sum(axis=1) - weights
        for start, end in zip(cell, np.roll(cell, -1, axis=0), strict=True):
            middle = (start + end) / 2
            powers = lift - 2 * sites @ middle
            nearest = np.argsort(powers)[:2]
            if powers[nearest[1]] - powers[nearest[0]] < 1e-9:
                lengths[tuple(sorted(nearest))] = np.linalg.norm(start - end)
    laplacian = diagram.laplacian().toarray()
    fluxes = -2 * laplacian * np.linalg.norm(sites[:, None] - sites, axis=-1)
    border_lengths = {
        (i, j): fluxes[i, j] for i, j in np.argwhere(np.triu(fluxes, 1) > 1e-9).tolist()
    }
    assert border_lengths.keys() == lengths.keys()
    for pair, length in lengths.items():
        assert border_lengths[pair] == pytest.approx(length, abs=1e-9)


def test_regular_grid_of_sites_gives_equal_square_cells():
    """Every vertex of the grid is shared by four cells: the most degenerate case."""
    image = np.ones((12, 12))
    y, x = np.mgrid[0.5:12:2, 0.5:12:2]
    sites = np.column_stack([y.ravel(), x.ravel()])
    diagram = power_diagram(sites, Density.from_image(image))
    np.testing.assert_allclose(diagram.masses, 4.0, rtol=1e-12)
    np.testing.assert_allclose(diagram.centroids, sites, atol=1e-12)
    np.testing.assert_allclose(diagram.inertia, 4 * (2**2 + 2**2) / 12, rtol=1e-11)
    laplacian = diagram.laplacian().toarray()
    assert laplacian[0, 0] == pytest.approx(2 * 2 / (2 * 2))  # a corner cell: two borders of 2 px


def test_laplacian_is_symmetric_and_its_rows_sum_to_zero():
    rng = np.random.default_rng(5)
    image = rng.random((20, 20))
    sites = rng.random((200, 2)) * 20 - 0.5
    laplacian = power_diagram(sites, Density.from_image(image)).laplacian().toarray()
    np.testing.assert_allclose(laplacian, laplacian.T, atol=1e-15)
    np.testing.assert_allclose(laplacian.sum(axis=1), 0, atol=1e-12)
    assert (laplacian - np.diag(np.diag(laplacian)) <= 0).all()


def test_one_and_many_threads_agree_bit_for_bit():
    rng = np.random.default_rng(6)
    density = Density.from_image(rng.random((60, 60)))
    triangulation = RegularTriangulation(rng.random((20000, 2)) * 60 - 0.5)
    single, parallel = (
        PowerDiagram(triangulation, density, with_moments=True, threads=threads)
        for threads in (1, 5)
    )
    np.testing.assert_array_equal(single.masses, parallel.masses)
    np.testing.assert_array_equal(single.centroids, parallel.centroids)
    np.testing.assert_array_equal(single.inertia, parallel.inertia)
    np.testing.assert_array_equal(single.laplacian().data, parallel.laplacian().data)


def test_hidden_site_has_an_empty_cell():
    sites = np.array([[1.0, 1.0], [1.0, 5.0], [5.0, 1.0], [5.0, 5.0], [3.0, 3.1]])
    weights = np.array([0.0, 0.0, 0.0, 0.0, -100.0])
    diagram = power_diagram(sites, Density.from_image(np.ones((7, 7))), weights)
    assert diagram.masses[4] == 0
    assert len(diagram.cell(4)) == 0
    np.testing.assert_array_equal(diagram.centroids[4], sites[4])
    assert diagram.masses[:4].sum() == pytest.approx(49)


def test_squares_of_pixels_equal_the_pixels_that_share_their_flux():
    rng = np.random.default_rng(5)
    few = rng.random((6, 9))
    sites = rng.random((50, 2)) * (24, 36) - 0.5
    weights = 4 * rng.random(50)
    merged = Density.from_image(few, side=4)
    pixels = Density.from_image(split_pixels(few, 4))
    assert merged.shape == pixels.shape
    expected, diagram = (power_diagram(sites, density, weights) for density in (pixels, merged))
    for quantity in ("masses", "centroids", "inertia"):
        actual, desired = getattr(diagram, quantity), getattr(expected, quantity)
        np.testing.assert_allclose(actual, desired, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(diagram.laplacian().toarray(), expected.laplacian().toarray())
    np.testing.assert_allclose(block_sums(pixels.image, 4), few)
