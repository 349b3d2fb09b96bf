"""Facts about the simulated pack: protons are conserved and go where physics sends them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tifffile

import simulated_pack
from napari_shadowinv.film import Pack, PackLayer, Slab
from napari_shadowinv.film.unfolding import ResponseMatrix
from simulated_pack import PITCH, Placement, Scene, Truth, simulate

SHAPE = (90, 120)
ASKEW = Placement((160, 190), (82.3, 91.6), np.deg2rad(1.7), (1.5, -0.7))


@pytest.fixture(scope="module")
def truth(tmp_path_factory: pytest.TempPathFactory) -> Truth:
    folder = tmp_path_factory.mktemp("pack")
    return simulate(folder, layers=3, shape=SHAPE, seed=4, b_peak=1.5, e_peak=1.0)


@pytest.fixture(scope="module")
def scene(truth: Truth) -> Scene:
    return truth.scene


def pencil(scene: Scene, row: float, column: float) -> np.ndarray:
    """Weights of rays in a narrow beam through a place of the object; their sum is 1."""
    (y, x), *_ = scene._rays
    weights = np.exp(-((y - row) ** 2 + (x - column) ** 2) / 2 / 1.2**2)
    return weights / weights.sum()


def centroid(image: np.ndarray) -> np.ndarray:
    y, x = np.indices(image.shape)
    return np.array([(image * y).sum(), (image * x).sum()]) / image.sum()


@pytest.mark.parametrize("layer", [0, 2])
def test_protons_are_conserved(scene: Scene, layer: int) -> None:
    energies, weights = np.array([3.1, 4.0, 9.0]), np.array([5.0, 2.0, 1.0])
    beam = pencil(scene, 40, 60)
    landed = scene.landed(layer, energies, weights, ASKEW, beam)
    assert landed.sum() == pytest.approx(8, rel=1e-9)
    assert landed.min() > -1e-6 * landed.max()


@pytest.mark.parametrize("place", [None, ASKEW])
def test_without_fields_a_film_shows_the_beam_magnified(
    scene: Scene, place: Placement | None
) -> None:
    bare = replace(scene, b_scale=0.0, e_scale=0.0)
    landed = bare.landed(2, np.array([9.0]), np.array([1e6]), place)
    scale = bare.magnifications[2] / bare.magnifications[0]
    assert scale == pytest.approx(1 + 0.518e-3 / 0.11, rel=1e-6)
    lies = place or Placement(SHAPE, tuple(bare.middle))
    film = lies.on_film()
    at = (film + np.array(lies.slip)[:, None, None]) / scale + bare.middle[:, None, None]
    expected = 1e6 * bare.beam(*at, 9.0) / scale**2
    inside = (np.abs(film) < bare.middle[:, None, None]).all(axis=0)
    assert inside.sum() > 0.9 * np.prod(SHAPE)
    np.testing.assert_allclose(landed[inside], expected[inside], rtol=2e-4)


@pytest.mark.parametrize("energy", [3.0, 14.7, 40.0])
@pytest.mark.parametrize("layer", [0, 2])
def test_a_pencil_of_protons_is_deflected_by_the_lorentz_force(
    scene: Scene, energy: float, layer: int
) -> None:
    beam = pencil(scene, 41, 68)
    rays, *_ = scene._rays
    by, bx = (scene.b_field(*rays) * beam).sum(axis=1)
    ey, ex = (scene.e_field(*rays) * beam).sum(axis=1)
    charge, light, mass = 1.602176634e-19, 299792458.0, 1.67262192e-27
    gamma = 1 + 1e6 * energy * charge / (mass * light**2)
    velocity = light * np.sqrt(1 - gamma**-2)
    momentum = gamma * mass * velocity
    places = {}
    for name, strengths in {"none": (0, 0), "B": (1, 0), "E": (0, 1)}.items():
        scaled_scene = replace(
            scene, b_scale=strengths[0] * scene.b_scale, e_scale=strengths[1] * scene.e_scale
        )
        landed = scaled_scene.landed(layer, np.array([energy]), np.array([1.0]), ASKEW, beam)
        places[name] = centroid(landed)
    along = ASKEW.axes * scene.distances[layer] / PITCH
    # Along the beam, z = x × y: F = e v × B.
    by_b = charge / momentum * np.array([bx, -by]) @ along
    by_e = charge / (momentum * velocity) * np.array([ey, ex]) @ along
    np.testing.assert_allclose(places["B"] - places["none"], by_b, rtol=1e-5, atol=1e-7)
    np.testing.assert_allclose(places["E"] - places["none"], by_e, rtol=1e-5, atol=1e-7)
    assert np.hypot(*by_b) > 0.01
    assert np.hypot(*by_e) > 0.005


def test_the_magnetic_field_has_no_divergence_and_the_electric_no_curl(truth: Truth) -> None:
    (dby_dy, _), (_, dbx_dx) = (np.gradient(component) for component in truth.b_field)
    (_, dey_dx), (dex_dy, _) = (np.gradient(component) for component in truth.e_field)
    assert np.abs(dby_dy + dbx_dx).max() < 0.02 * np.abs(dby_dy).max()
    assert np.abs(dey_dx - dex_dy).max() < 0.02 * np.abs(dey_dx).max()


def test_films_see_all_protons_that_reach_them(truth: Truth) -> None:
    """Without fields, in the middle: spectrum times dose per proton."""
    steel = (Slab(material="Al", thickness=13e-6), Slab(material="Fe", thickness=25e-6))
    mylar = [(Slab(material="Mylar", thickness=thickness),) for thickness in (100e-6, 200e-6)]
    layers = [PackLayer(film="HDV2", filters=filters) for filters in (steel, *mylar)]
    response = ResponseMatrix.of(Pack(layers=tuple(layers)), np.linspace(2, 45, 40_001))
    bare = replace(truth, scene=replace(truth.scene, b_scale=0.0, e_scale=0.0))
    for k in range(3):
        all_energies = response.doses[k] * truth.scene.spectrum(response.energies)
        all_energies = np.trapezoid(all_energies, response.energies)
        per_area = truth.beam(k)[45, 60] / PITCH**2
        per_area *= (truth.scene.magnifications[0] / truth.scene.magnifications[k]) ** 2
        assert bare.dose(k)[45, 60] == pytest.approx(all_energies * per_area, rel=3e-3)


def test_a_film_lies_where_its_corners_are(tmp_path: Path) -> None:
    """Its area, its middle and its moments of inertia on the scan are those of the rectangle."""
    options = {"handwriting": False, "notch": False, "noise": False, "protons": 0.0}
    bare = simulate(tmp_path, layers=2, shape=SHAPE, seed=1, **options)
    for file, corners in zip(bare.files, bare.corners, strict=True):
        scan = tifffile.imread(file)[..., 0].astype(float)
        bed = np.median(scan[:20], axis=0)
        cover = (bed - scan) / (bed - simulated_pack.BASE[0])
        assert cover.sum() == pytest.approx(np.prod(SHAPE), rel=1e-3)
        np.testing.assert_allclose(centroid(cover), corners.mean(axis=0), atol=0.02)
        across, down = corners[1] - corners[0], corners[3] - corners[0]
        np.testing.assert_allclose([np.hypot(*down), np.hypot(*across)], SHAPE)
        steps = np.moveaxis(np.indices(cover.shape), 0, -1) - corners.mean(axis=0)
        inertia = np.einsum("yx,yxa,yxb->ab", cover, steps, steps) / cover.sum()
        expected = (np.outer(down, down) + np.outer(across, across)) / 12
        np.testing.assert_allclose(inertia, expected, atol=1.5)


def test_noise_is_that_of_whole_protons_and_of_grain() -> None:
    rng = np.random.default_rng(0)
    counts = simulated_pack._counted(np.full((300, 400), 40.0), 0.05, rng)
    assert counts.mean() == pytest.approx(40, rel=1e-3)
    expected = 40 * 0.05 + (simulated_pack.GRAIN * 40) ** 2
    assert counts.var() == pytest.approx(expected, rel=0.02)
