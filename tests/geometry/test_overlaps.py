from __future__ import annotations

import numpy as np
import pytest

from napari_shadowinv.geometry.density import Density
from napari_shadowinv.geometry.power_diagram import PowerDiagram, pixel_shares
from napari_shadowinv.geometry.triangulation import RegularTriangulation

SHAPE = (23, 31)


@pytest.fixture(params=[(5, 0.0), (60, 4.0), (60, 60.0), (900, 0.3), (3000, 0.05)])
def diagram(request):
    """Few sites and many; with spread weights some cells are hidden, others lie far away."""
    n, spread = request.param
    rng = np.random.default_rng(n)
    triangulation = RegularTriangulation(
        rng.random((n, 2)) * SHAPE - 0.5, region=Density.from_image(np.ones(SHAPE)).region
    )
    triangulation.update(spread * rng.random(n))
    return PowerDiagram(triangulation, Density.from_image(np.ones(SHAPE)))


def test_each_pixel_is_shared_out_among_the_cells(diagram):
    shares = pixel_shares(diagram, SHAPE)
    assert shares.data.min() > -1e-12
    np.testing.assert_allclose(shares.sum(axis=0), 1, rtol=1e-12)
    np.testing.assert_allclose(shares.sum(axis=1), diagram.masses, atol=1e-11)


def test_they_make_the_masses_of_any_image(diagram):
    image = np.random.default_rng(1).normal(size=SHAPE)
    exact = PowerDiagram(diagram._triangulation, Density.from_image(image)).masses
    masses = pixel_shares(diagram, SHAPE) @ image.ravel()
    np.testing.assert_allclose(masses, exact, atol=1e-11)


def test_threads_change_no_bit():
    rng = np.random.default_rng(2)
    triangulation = RegularTriangulation(rng.random((9000, 2)) * SHAPE - 0.5)
    diagram = PowerDiagram(triangulation, Density.from_image(np.ones(SHAPE)))
    single, parallel = (pixel_shares(diagram, SHAPE, threads=threads) for threads in (1, 2))
    for name in ("indptr", "indices", "data"):
        np.testing.assert_array_equal(getattr(single, name), getattr(parallel, name))
