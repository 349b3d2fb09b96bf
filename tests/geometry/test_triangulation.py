"""Facts about regular triangulations: they are dual to power diagrams, however they came to be."""

from __future__ import annotations

from fractions import Fraction
from unittest.mock import Mock

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from helpers.polygons import clipped, rectangle, shoelace
from napari_shadowinv.errors import InputError, InversionCancelled
from napari_shadowinv.geometry import triangulation as module
from napari_shadowinv.geometry.triangle_mesh import LIMIT
from napari_shadowinv.geometry.triangulation import RegularTriangulation, hilbert_order

Array = NDArray[np.float64]

few = settings(max_examples=50, deadline=None)
fewer = settings(max_examples=20, deadline=None)
seeds = st.integers(0, 2**32 - 1)


def random_sites(kind: str, rng: np.random.Generator) -> Array:
    n = int(rng.integers(1, 70))
    if kind == "uniform":
        return rng.random((n, 2)) * rng.choice([1e-3, 1.0, 512.0]) + rng.choice([0.0, -3.0, 1e4])
    if kind == "grid":
        rows, columns = rng.integers(1, 10, 2)
        return np.stack(np.meshgrid(np.arange(rows), np.arange(columns)), -1).reshape(-1, 2) * 1.0
    if kind == "rounded grid":
        axis = np.linspace(-0.7, 1.1, rng.integers(2, 9))
        return np.stack(np.meshgrid(axis, axis), -1).reshape(-1, 2)
    if kind == "collinear":
        return np.outer(rng.random(n), rng.normal(size=2)) + rng.normal(size=2)
    if kind == "duplicates":
        return rng.integers(0, 6, (n, 2)) / 7
    if kind == "clustered":
        return rng.random((3, 2))[rng.integers(0, 3, n)] + 1e-4 * rng.normal(size=(n, 2))
    angle = 2 * np.pi * np.arange(n) / n
    return np.stack([np.cos(angle), np.sin(angle)], -1)


KINDS = ("uniform", "grid", "rounded grid", "collinear", "duplicates", "clustered", "circle")


def random_weights(sites: Array, rng: np.random.Generator) -> Array:
    n = len(sites)
    scale = max(float(np.ptp(sites, axis=0).max()), 1e-3) ** 2
    choice = rng.integers(0, 6)
    if choice == 0:
        return np.zeros(n)
    if choice == 1:
        return rng.integers(0, 3, n) * scale / 64
    if choice == 2:
        return scale * 10.0 ** rng.uniform(-8, 2, n) * rng.choice([-1, 1], n)
    return scale * rng.normal(size=n) * [1e-4, 1e-2, 1.0][choice - 3]


def cross(a: Array, b: Array) -> Array:
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def clipped_cell(i: int, triangulation: RegularTriangulation, bonus: float) -> Array:
    """Power cell of site i with a bonus to its weight, by half-planes, relative to the site."""
    points, weights = triangulation.points, triangulation.weights
    distance = float(np.abs(points[-1] - points[0]).max())
    reach = 8 * (distance + np.abs(weights).max() / distance)
    polygon = rectangle((-reach, -reach), (reach, reach))
    for j in np.argsort(((points - points[i]) ** 2).sum(1)):
        between = points[j] - points[i]
        gain = weights[j] - weights[i]
        if j != i and not between.any():
            if gain > 0 or (gain == 0 and j < i):
                return np.empty((0, 2))
        elif j != i:
            polygon = clipped(polygon, 2 * between, between @ between - gain + bonus)
        if len(polygon) < 3:
            return np.empty((0, 2))
    return polygon


def exact_cross(p: Array, q: Array, r: Array) -> Fraction:
    (px, py), (qx, qy), (rx, ry) = ([Fraction(float(x)) for x in s] for s in (p, q, r))
    return (qx - px) * (ry - py) - (qy - py) * (rx - px)


def assert_triangulation(triangulation: RegularTriangulation) -> None:
    """Assert Euler's formula, symmetric neighbours, and positive orientation, exactly."""
    vertices, neighbors = triangulation.vertices, triangulation.neighbors
    points = triangulation.points
    n = len(triangulation.sites)
    visible = np.flatnonzero(~triangulation.hidden)
    assert len(vertices) == 2 * len(visible) + 2
    np.testing.assert_array_equal(np.unique(vertices), np.append(visible, np.arange(n, n + 4)))
    assert (neighbors < 0).sum() == 4
    for t, k in np.argwhere(neighbors >= 0):
        u = neighbors[t, k]
        j = np.flatnonzero(neighbors[u] == t)
        assert j.size == 1
        assert vertices[u, (j[0] + 1) % 3] == vertices[t, (k + 2) % 3]
        assert vertices[u, (j[0] + 2) % 3] == vertices[t, (k + 1) % 3]
    p, q, r = (points[vertices[:, k]] for k in range(3))
    size = np.abs(q - p).max(1) * np.abs(r - p).max(1)
    doubtful = cross(q - p, r - p) < 1e-12 * size
    for t in np.flatnonzero(doubtful):
        assert exact_cross(*points[vertices[t]]) > 0


def assert_locally_regular(triangulation: RegularTriangulation) -> None:
    """Assert that no neighbour's far corner lies below a triangle's lifted plane."""
    vertices, neighbors = triangulation.vertices, triangulation.neighbors
    t, k = np.nonzero(neighbors >= 0)
    u = neighbors[t, k]
    j = np.argmax(neighbors[u] == t[:, None], axis=1)
    corners = np.column_stack([vertices[t, (k + i) % 3] for i in range(3)] + [vertices[u, j]])
    ghostly = corners[:, 0] >= len(triangulation.sites)
    corners[ghostly] = corners[ghostly][:, [3, 2, 1, 0]]
    d = triangulation.points[corners] - triangulation.points[corners[:, :1]]
    w = triangulation.weights[corners] - triangulation.weights[corners[:, :1]]
    square = (d**2).sum(-1)
    a, b, q = d[:, 1], d[:, 2], d[:, 3]
    lift = square - w
    height = lift[:, 3] * cross(a, b) - lift[:, 1] * cross(q, b) - lift[:, 2] * cross(a, q)
    longest = np.sqrt(square.max(1))
    size = (square + np.abs(w)).max(1) * longest * np.sort(np.sqrt(square), axis=1)[:, 2]
    assert np.all(height >= -1e-13 * size)


def triangles(triangulation: RegularTriangulation) -> set[tuple[int, ...]]:
    """Triangles, each starting from its smallest vertex."""
    vertices = triangulation.vertices
    start = np.argmin(vertices, axis=1)[:, None]
    rolled = np.take_along_axis(vertices, (start + np.arange(3)) % 3, axis=1)
    return set(map(tuple, rolled.tolist()))


def assert_hides_empty_cells(triangulation: RegularTriangulation) -> None:
    """Assert that a cell is empty if and only if its site is hidden, give or take a touch."""
    extent = float(np.ptp(triangulation.sites, axis=0).max())
    rounding = 1e-13 * float(np.abs(triangulation.weights).max())
    touch = 1e-9 * extent**2 / len(triangulation.sites) + rounding
    for i, hidden in enumerate(triangulation.hidden):
        cell = clipped_cell(i, triangulation, -touch if hidden else touch)
        assert (shoelace(cell)[0] == 0) == hidden


@pytest.mark.parametrize("kind", KINDS)
@fewer
@given(seed=seeds)
def test_sites_are_hidden_when_their_cells_are_empty(kind: str, seed: int) -> None:
    rng = np.random.default_rng(seed)
    sites = random_sites(kind, rng)
    triangulation = RegularTriangulation(sites, random_weights(sites, rng))
    assert_triangulation(triangulation)
    assert_locally_regular(triangulation)
    assert_hides_empty_cells(triangulation)
    triangulation.update(random_weights(sites, rng))
    assert_triangulation(triangulation)
    assert_locally_regular(triangulation)
    assert_hides_empty_cells(triangulation)


@few
@given(seed=seeds)
def test_repaired_equals_rebuilt(seed: int) -> None:
    rng = np.random.default_rng(seed)
    n = int(rng.integers(1, 300))
    sites = rng.random((n, 2))
    triangulation = RegularTriangulation(sites, rng.random(n))
    for scale in rng.choice([1e-4, 1e-2, 1.0, 1e6], 4):
        weights = scale * rng.random(n)
        assert triangulation.update(weights)
        fresh = RegularTriangulation(sites, weights)
        assert triangles(triangulation) == triangles(fresh)
        np.testing.assert_array_equal(triangulation.hidden, fresh.hidden)
        np.testing.assert_array_equal(triangulation.weights, fresh.weights)


@few
@given(seed=seeds, kind=st.sampled_from(KINDS), weighted=st.booleans())
def test_moved_equals_rebuilt(seed: int, kind: str, weighted: bool) -> None:
    rng = np.random.default_rng(seed)
    n = int(rng.integers(1, 300))
    sites = rng.random((n, 2))
    weights = rng.random(n) / (4 * n) if weighted else np.zeros(n)
    region = [[0.0, 0.0], [1.0, 1.0]]
    triangulation = RegularTriangulation(sites, weights, region=region)
    for step in (1e-3, 0.3, 3.0):
        sites = np.clip(sites + step / np.sqrt(n) * rng.normal(size=(n, 2)), 0, 1)
        triangulation.move(sites)
        fresh = RegularTriangulation(sites, weights, region=region)
        np.testing.assert_array_equal(triangulation.points, fresh.points)
        if len(np.unique(sites, axis=0)) == n:  # of duplicates any may be the vertex
            np.testing.assert_array_equal(triangulation.hidden, fresh.hidden)
            assert triangles(triangulation) == triangles(fresh)
    degenerate = np.resize(random_sites(kind, rng), (n, 2))
    triangulation.move(degenerate)
    assert_triangulation(triangulation)
    if not weighted:
        visible = degenerate[~triangulation.hidden]
        assert len(visible) == len(np.unique(degenerate, axis=0))
        assert len(visible) == len(np.unique(visible, axis=0))


def test_small_moves_are_repaired_not_rebuilt(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(12)
    sites = rng.random((2000, 2))
    triangulation = RegularTriangulation(sites, region=[[0, 0], [1, 1]])
    moved = np.clip(sites + 0.001 * rng.normal(size=(2000, 2)), 0, 1)
    fresh = RegularTriangulation(moved, region=[[0, 0], [1, 1]])
    twin, before = triangulation.copy(), triangles(triangulation)
    monkeypatch.setattr(RegularTriangulation, "_build", None)
    triangulation.move(moved)
    assert triangles(triangulation) == triangles(fresh)
    np.testing.assert_array_equal(twin.sites, sites)
    assert triangles(twin) == before


@few
@given(seed=seeds)
def test_stopped_repair_keeps_all_sites_and_can_go_on(seed: int) -> None:
    rng = np.random.default_rng(seed)
    n = int(rng.integers(30, 300))
    sites = rng.random((n, 2))
    triangulation = RegularTriangulation(sites)
    direction = rng.normal(size=n) / n
    assert not triangulation.update(100 * direction, stop_when_hidden=True)
    assert_triangulation(triangulation)
    assert not triangulation.hidden.any()
    step = 1.0
    while not triangulation.update(step * direction, stop_when_hidden=True):
        assert RegularTriangulation(sites, step * direction).hidden.any()
        step /= 2
    fresh = RegularTriangulation(sites, step * direction)
    assert not fresh.hidden.any()
    assert triangles(triangulation) == triangles(fresh)


@fewer
@given(seed=seeds, kind=st.sampled_from(KINDS))
def test_stopped_repair_of_degenerate_sites_is_valid(seed: int, kind: str) -> None:
    rng = np.random.default_rng(seed)
    sites = random_sites(kind, rng)
    triangulation = RegularTriangulation(sites)
    for _ in range(3):
        finished = triangulation.update(random_weights(sites, rng), stop_when_hidden=True)
        assert_triangulation(triangulation)
        if finished:
            assert_locally_regular(triangulation)


def hull_heights(triangulation: RegularTriangulation) -> Array:
    """Height of the lower convex hull of the lifted points above each site."""
    points = triangulation.points - triangulation.sites.mean(axis=0)
    lifted = np.column_stack([points, ((points**2).sum(1) - triangulation.weights) / 2])
    facets = ConvexHull(lifted).equations
    facets = facets[facets[:, 2] < -1e-9]
    planes = -(points[:-4] @ facets[:, :2].T + facets[:, 3]) / facets[:, 2]
    return np.asarray(planes.max(axis=1))


@few
@given(seed=seeds, scale=st.sampled_from([1e-4, 1e-2, 1.0]))
def test_lower_hidden_reaches_the_convex_hull(seed: int, scale: float) -> None:
    rng = np.random.default_rng(seed)
    n = int(rng.integers(3, 300))
    sites = rng.random((n, 2))
    weights = scale * rng.random(n)
    regular = RegularTriangulation(sites, weights)
    triangulation = RegularTriangulation(sites)
    raised = triangulation.lower_hidden(weights)
    assert not triangulation.hidden.any()
    assert_triangulation(triangulation)
    assert_locally_regular(triangulation)
    np.testing.assert_array_equal(raised, triangulation.weights[:-4])
    np.testing.assert_array_equal(raised[~regular.hidden], weights[~regular.hidden])
    assert np.all(raised[regular.hidden] > weights[regular.hidden])
    centred = sites - sites.mean(axis=0)
    heights = ((centred**2).sum(1) - raised) / 2
    hidden = regular.hidden
    np.testing.assert_allclose(heights[hidden], hull_heights(regular)[hidden], rtol=0, atol=1e-9)


@pytest.mark.parametrize("kind", KINDS)
@fewer
@given(seed=seeds)
def test_lower_hidden_leaves_only_duplicates_out(kind: str, seed: int) -> None:
    rng = np.random.default_rng(seed)
    sites = random_sites(kind, rng)
    weights = random_weights(sites, rng)
    triangulation = RegularTriangulation(sites)
    raised = triangulation.lower_hidden(weights)
    assert np.all(raised >= weights)
    places = np.unique(sites, axis=0)
    assert np.count_nonzero(~triangulation.hidden) == len(places)
    assert_triangulation(triangulation)
    if kind != "clustered":  # there the weights' rounding exceeds the distance of the cells
        assert_locally_regular(triangulation)
        assert triangulation.update(raised, stop_when_hidden=True)


def test_shrinking_lowered_weights_opens_every_cell() -> None:
    rng = np.random.default_rng(1)
    sites = rng.random((2000, 2))
    triangulation = RegularTriangulation(sites)
    raised = triangulation.lower_hidden(0.05 * rng.random(2000))
    assert triangulation.update(0.99 * raised, stop_when_hidden=True)


@few
@given(seed=seeds, scale=st.sampled_from([0.0, 1e-3, 1e-1]))
def test_order_of_sites_does_not_matter(seed: int, scale: float) -> None:
    rng = np.random.default_rng(seed)
    sites = rng.random((200, 2))
    weights = scale * rng.random(200)
    shuffle = rng.permutation(200)
    triangulation = RegularTriangulation(sites, weights)
    shuffled = RegularTriangulation(sites[shuffle], weights[shuffle])
    np.testing.assert_array_equal(shuffled.points[:200], sites[shuffle])
    back = np.append(shuffle, np.arange(200, 204))
    renamed = back[shuffled.vertices]
    start = np.argmin(renamed, axis=1)[:, None]
    renamed = np.take_along_axis(renamed, (start + np.arange(3)) % 3, axis=1)
    assert set(map(tuple, renamed.tolist())) == triangles(triangulation)
    np.testing.assert_array_equal(triangulation.hidden[shuffle], shuffled.hidden)


@pytest.mark.parametrize(
    ("weights", "visible"), [([0, 0, 0], 0), ([0, 1, 0], 1), ([0, 1, 1], 1), ([2, 3, 5], 2)]
)
def test_heaviest_duplicate_stays(weights: list[float], visible: int) -> None:
    sites = [[0.5, 0.5]] * 3 + [[0, 0], [0, 1], [1, 0], [1, 1]]
    triangulation = RegularTriangulation(sites)
    triangulation.update(weights + [0] * 4)
    assert np.flatnonzero(~triangulation.hidden[:3]).tolist() == [visible]


def test_short_stack_gives_the_same_triangles(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(5)
    sites, weights, later = rng.random((400, 2)), rng.random(400) / 100, rng.random(400) / 1000
    built, repaired = RegularTriangulation(sites, weights), RegularTriangulation(sites, later)
    monkeypatch.setattr(module, "STACK_SIZE", 5)
    triangulation = RegularTriangulation(sites, weights)
    assert triangles(triangulation) == triangles(built)
    triangulation.update(later)
    assert triangles(triangulation) == triangles(repaired)


def test_exhausted_repair_is_rebuilt() -> None:
    rng = np.random.default_rng(6)
    sites, weights = rng.random((400, 2)), rng.random(400) / 1000
    triangulation = RegularTriangulation(sites)
    triangulation._mesh.counters[LIMIT] = 3
    assert triangulation.update(weights)
    assert triangles(triangulation) == triangles(RegularTriangulation(sites, weights))
    triangulation = RegularTriangulation(sites)
    triangulation._mesh.counters[LIMIT] = 3
    assert not triangulation.update(weights, stop_when_hidden=True)
    assert_triangulation(triangulation)
    assert not triangulation.hidden.any()
    assert triangulation.update(np.zeros(400), stop_when_hidden=True)
    assert triangles(triangulation) == triangles(RegularTriangulation(sites))


def test_hilbert_order_is_a_permutation_with_short_steps() -> None:
    axis = np.arange(64.0)
    points = np.stack(np.meshgrid(axis, axis), -1).reshape(-1, 2)
    order = hilbert_order(points)
    np.testing.assert_array_equal(np.sort(order), np.arange(4096))
    steps = np.abs(np.diff(points[order], axis=0)).sum(axis=1)
    assert np.all(steps == 1)
    np.testing.assert_array_equal(hilbert_order(points[order]), np.arange(4096))


def test_building_in_parts_gives_the_same_triangles_or_ends_when_a_sign_of_life_raises() -> None:
    sites = np.random.default_rng(0).random((1000, 2))
    weights = np.random.default_rng(1).random(1000) / 500
    at_once = RegularTriangulation(sites, weights)
    signs: list[int] = []
    in_parts = RegularTriangulation(sites, weights, alive=lambda: signs.append(1), part=150)
    assert len(signs) == 7
    np.testing.assert_array_equal(in_parts.vertices, at_once.vertices)
    np.testing.assert_array_equal(in_parts.hidden, at_once.hidden)
    cancelled = Mock(side_effect=[None, InversionCancelled("stopped")])
    with pytest.raises(InversionCancelled):
        RegularTriangulation(sites, alive=cancelled, part=150)


def test_arrays_cannot_be_written() -> None:
    triangulation = RegularTriangulation([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    for name in ("sites", "points", "weights", "vertices", "neighbors", "hidden"):
        assert not getattr(triangulation, name).flags.writeable


@pytest.mark.parametrize("sites", [[[0.0, np.nan]], [[0.0, 1.0, 2.0]], np.empty((0, 2))])
def test_bad_sites_are_refused(sites: object) -> None:
    with pytest.raises(InputError, match="sites"):
        RegularTriangulation(sites)


def test_bad_weights_are_refused() -> None:
    triangulation = RegularTriangulation([[0.0, 0.0], [1.0, 0.0]])
    with pytest.raises(InputError, match=r"weights have shape \(3,\), there are 2 sites"):
        triangulation.update([0.0, 0.0, 0.0])
    with pytest.raises(InputError, match="infinity"):
        triangulation.update([0.0, np.inf])


@pytest.mark.parametrize("sorted_first", [False, True])
def test_more_sites_are_put_in_as_if_they_had_been_there(sorted_first):
    """Next to the first ones, among them, and at their places; the order is kept."""
    rng = np.random.default_rng(7)
    first = rng.uniform(0, 10, (300, 2))
    if sorted_first:
        first = first[hilbert_order(first)]
    more = np.concatenate([rng.uniform(-2, 12, (80, 2)), first[:3]])
    before = RegularTriangulation(first)
    vertices = before.vertices.copy()
    grown = before.with_more(more)
    everything = np.concatenate([first, more])
    np.testing.assert_array_equal(grown.sites, everything)
    np.testing.assert_array_equal(before.vertices, vertices)
    assert grown.hidden.sum() == 3

    def triangles(triangulation):
        places = triangulation.points[triangulation.vertices]
        inner = (triangulation.vertices < len(everything)).all(axis=1)
        return {tuple(sorted(map(tuple, corners))) for corners in places[inner].round(9).tolist()}

    assert triangles(grown) == triangles(RegularTriangulation(everything))
    weights = rng.uniform(0, 0.05, len(everything))
    grown.update(weights)
    anew = RegularTriangulation(everything, weights)
    assert triangles(grown) == triangles(anew)
