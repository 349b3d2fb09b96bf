from __future__ import annotations

import numpy as np
import pytest

from helpers.polygons import clipped, power_cell, shoelace
from napari_shadowinv.geometry.interpolation import natural_neighbor
from napari_shadowinv.geometry.triangulation import RegularTriangulation

FAR = ((-1e3, -1e3), (1e3, 1e3))


def test_shares_are_the_areas_taken_from_each_voronoi_cell():
    rng = np.random.default_rng(0)
    sites = rng.random((60, 2)) * 10
    values = rng.random(60)
    for query in rng.random((20, 2)) * 4 + 3:
        weighted = total = 0.0
        for i in range(60):
            cell = power_cell(sites, np.zeros(60), i, *FAR)
            taken = clipped(cell, 2 * (sites[i] - query), sites[i] @ sites[i] - query @ query)
            area = abs(shoelace(taken)[0])
            weighted += area * values[i]
            total += area
        expected = weighted / total
        got = natural_neighbor(RegularTriangulation(sites), values, query[None])[0]
        assert got == pytest.approx(expected, abs=1e-10)


def test_values_are_met_at_the_sites_and_in_the_middle_of_a_grid():
    y, x = np.mgrid[0:5.0, 0:5.0]
    sites = np.column_stack([y.ravel(), x.ravel()])
    values = np.random.default_rng(3).random(25)
    triangulation = RegularTriangulation(sites)
    np.testing.assert_array_equal(natural_neighbor(triangulation, values, sites), values)
    middle = natural_neighbor(triangulation, values, [[1.5, 2.5]])[0]
    assert middle == pytest.approx(values.reshape(5, 5)[1:3, 2:4].mean())
