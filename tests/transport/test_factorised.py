from __future__ import annotations

import numpy as np
import pytest
from scipy.sparse import block_diag, csr_array, diags_array

from napari_shadowinv.transport.linear import FactorisedLaplacian


@pytest.fixture(scope="module")
def laplacian():
    """Of a grid with uneven conductances."""
    n = 30
    node = np.arange(n * n).reshape(n, n)
    first = np.concatenate([node[:, :-1].ravel(), node[:-1].ravel()])
    second = np.concatenate([node[:, 1:].ravel(), node[1:].ravel()])
    conductances = 10 ** np.random.default_rng(0).uniform(-3, 3, len(first))
    one_way = csr_array((conductances, (first, second)), shape=(n * n, n * n))
    both = one_way + one_way.T
    return csr_array(diags_array(both.sum(axis=1)) - both)


@pytest.mark.parametrize("grounded", [False, True])
def test_every_system_is_solved(laplacian, grounded):
    rng = np.random.default_rng(1)
    n = laplacian.shape[0]
    ground = np.where(rng.random(n) < 0.1, 2.0, 0.0) if grounded else None
    right = rng.normal(size=(n, 8))
    right[:, -1] = 0
    solution = FactorisedLaplacian(laplacian, ground).solve(right)
    if ground is None:
        np.testing.assert_array_equal(solution[0], 0)
        np.testing.assert_allclose(laplacian @ solution, right - right.mean(axis=0), atol=1e-7)
    else:
        np.testing.assert_allclose(
            laplacian @ solution + ground[:, None] * solution, right, atol=1e-7
        )
    np.testing.assert_array_equal(solution[:, -1], 0)


def test_groups_without_conductors_between_them_are_refused(laplacian):
    with pytest.raises(RuntimeError, match="several groups"):
        FactorisedLaplacian(csr_array(block_diag([laplacian, laplacian])))
