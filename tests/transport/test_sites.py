from __future__ import annotations

import numpy as np
import pytest

from helpers.polygons import power_diagram
from napari_shadowinv._system.progress import Reporter
from napari_shadowinv.errors import InversionCancelled
from napari_shadowinv.geometry.density import Density
from napari_shadowinv.geometry.power_diagram import PowerDiagram
from napari_shadowinv.geometry.triangulation import RegularTriangulation
from napari_shadowinv.transport.sites import lloyd, plan_levels, sample_sites


def gaussian_beam(shape=(60, 80)):
    y, x = np.indices(shape)
    return np.exp(-(((y - 20) / 20) ** 2) - ((x - 50) / 25) ** 2) + 0.02


def test_sites_are_as_dense_as_the_source_is_bright():
    source = gaussian_beam()
    sites = sample_sites(source, 20000, seed=1)
    counts, _, _ = np.histogram2d(*(sites.T + 0.5), bins=(6, 8), range=((0, 60), (0, 80)))
    flux = source.reshape(6, 10, 8, 10).sum(axis=(1, 3))
    expected = 20000 * flux / flux.sum()
    # independent points would deviate by sqrt(expected)
    deviation = (counts - expected) / np.sqrt(expected)
    assert np.abs(deviation).max() < 3
    assert deviation.std() < 1


def test_no_site_falls_on_a_dark_pixel_or_outside():
    source = np.zeros((30, 40))
    source[10:20, 5:15] = 1
    sites = sample_sites(source, 500, seed=2)
    assert (sites >= [9.5, 4.5]).all()
    assert (sites <= [19.5, 14.5]).all()


def test_the_seed_decides():
    source = gaussian_beam()
    np.testing.assert_array_equal(sample_sites(source, 100, 7), sample_sites(source, 100, 7))
    assert not np.array_equal(sample_sites(source, 100, 7), sample_sites(source, 100, 8))


def test_lloyd_lowers_the_inertia_and_evens_out_the_flux():
    source = Density.from_image(gaussian_beam())
    sites = sample_sites(gaussian_beam(), 1000, seed=3)
    after, steps = lloyd(RegularTriangulation(sites), source, iterations=30)
    assert steps == 30
    before = power_diagram(sites, source)
    assert after.inertia.sum() < 0.9 * before.inertia.sum()
    assert after.masses.std() < 0.5 * before.masses.std()


def test_cells_without_light_keep_their_sites():
    """Where sums along a row cancel but for rounding, a centroid would be anywhere."""
    rng = np.random.default_rng(0)
    source = np.zeros((40, 80))
    source[:, :40] = rng.uniform(0, 1, (40, 40))
    source[::2, 60:] = 1e-14 * rng.uniform(0, 1, (20, 20))
    density = Density.from_image(source)
    sites = rng.uniform(0, 1, (400, 2)) * [39, 79]
    triangulation = RegularTriangulation(sites, region=density.region)
    lloyd(triangulation, density, iterations=3)
    assert ((triangulation.sites > -0.5) & (triangulation.sites < [39.5, 79.5])).all()


def test_lloyd_ends_at_its_tolerance():
    source = Density.from_image(np.ones((20, 20)))
    sites = sample_sites(np.ones((20, 20)), 100, seed=4)
    triangulation = RegularTriangulation(sites)
    diagram, steps = lloyd(triangulation, source, iterations=1000, tolerance=0.01)
    assert 0 < steps < 1000
    away = power_diagram(triangulation.sites, source).centroids - triangulation.sites
    np.testing.assert_allclose(away, diagram.centroids - triangulation.sites, atol=1e-12)
    assert np.sqrt((away**2).sum(axis=1).mean()) < 0.01 * 2.0


def test_levels_quarter_and_their_masses_add_up_to_the_source():
    source = gaussian_beam()
    plan = plan_levels(source, 5000, lloyd_iterations=2)
    assert [len(level.sites) for level in plan.levels] == [312, 1250, 5000]
    for level in plan.levels:
        assert level.mass.sum() == pytest.approx(source.sum(), rel=1e-12)
        assert (level.mass > 0).all()


def test_few_sites_on_a_bright_spot_hold_the_whole_image():
    source = np.zeros((200, 200))
    source[100:103, 50:53] = 1
    plan = plan_levels(source, 30, lloyd_iterations=2)
    triangulation = plan.levels[-1].triangulation
    masses = PowerDiagram(triangulation, Density.from_image(np.ones((200, 200)))).masses
    assert masses.sum() == pytest.approx(200 * 200, rel=1e-12)


@pytest.mark.parametrize("threads", [1, 3])
def test_all_levels_stop_when_asked_to(threads):
    """The coarse levels, which are made in another thread, must not be waited for."""
    calls = []

    def soon():
        calls.append(True)
        return len(calls) > 3

    plan = plan_levels(gaussian_beam(), 4000, lloyd_iterations=1_000_000, threads=threads)
    with pytest.raises(InversionCancelled):
        plan.levels.with_reporter(Reporter(None, soon)).compute_all(threads)


def test_levels_do_not_depend_on_threads():
    single, parallel = (
        plan_levels(gaussian_beam(), 5000, lloyd_iterations=3, threads=threads)
        for threads in (1, 3)
    )
    for a, b in zip(single.levels, parallel.levels, strict=True):
        np.testing.assert_array_equal(a.sites, b.sites)
        np.testing.assert_array_equal(a.mass, b.mass)
