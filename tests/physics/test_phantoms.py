"""Phantoms are what their formulas say."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from napari_shadowinv.errors import InputError
from napari_shadowinv.physics.forward import jacobian_determinant
from napari_shadowinv.physics.phantoms import (
    Phantom,
    ellipse_pair,
    gaussian_blob,
    paper_setup,
    toroid,
)
from napari_shadowinv.physics.setup import SPECIES

TOROID_DATA = Path(__file__).parents[3] / "shared" / "data" / "toroid"

PHANTOMS = {
    "toroid": toroid((120, 90), paper_setup(), 97, 30e-6, center=(70.3, 41.8)),
    "ellipse": gaussian_blob((120, 90), 30.0, (18.0, 11.0), (50.2, 44.7), angle=0.7),
    "pair": ellipse_pair((120, 90)),
}


@pytest.mark.parametrize("name", PHANTOMS)
def test_displacement_is_minus_the_gradient(name: str) -> None:
    phantom = PHANTOMS[name]
    error = np.stack(np.gradient(phantom.potential)) + phantom.displacement
    assert np.abs(error[:, 1:-1, 1:-1]).max() < 0.02 * np.abs(phantom.displacement).max()


def test_gradient_converges_to_the_displacement() -> None:
    """Four times the pixels across the same blob: central differences are 16 times better."""
    errors = []
    for scale in (1, 4):
        blob = gaussian_blob((41 * scale, 41 * scale), 1.0, (5.0 * scale, 3.0 * scale), angle=0.4)
        error = (np.stack(np.gradient(blob.potential)) + blob.displacement)[:, 1:-1, 1:-1]
        errors.append(np.abs(error).max() / np.abs(blob.displacement).max())
    assert errors[0] / errors[1] == pytest.approx(16, rel=0.1)


def test_toroid_has_its_peak_field_at_sigma() -> None:
    """Pixels of 1.5 µm put r = σ = 30 µm exactly 20 pixels from the centre."""
    setup = paper_setup()
    phantom = toroid((101, 121), setup, 97, 30e-6, center=(50, 55))
    field = np.hypot(*setup.path_integrated_b(phantom.displacement, "MG um"))
    assert field[50, 75] == pytest.approx(97, rel=1e-12)
    assert field[30, 55] == pytest.approx(97, rel=1e-12)
    assert field.max() == pytest.approx(97, rel=1e-12)
    r = np.arange(121) - 55
    profile = 97 * np.exp(-(r**2) / 800 + 0.5) * np.abs(r) / 20
    np.testing.assert_allclose(field[50], profile, rtol=1e-12)


def test_toroid_deflects_protons_outwards_and_electrons_inwards() -> None:
    setup = paper_setup()
    electrons = setup.model_copy(update={"species": "electron"})
    for beam, sign in ((setup, 1), (electrons, -1)):
        displacement = toroid((41, 41), beam, 10, 15e-6).displacement
        y, x = np.mgrid[:41, :41] - 20
        assert (sign * (displacement[0] * y + displacement[1] * x)).min() >= 0
        np.testing.assert_allclose(displacement[0] * x, displacement[1] * y, atol=1e-12)


def test_default_centre_is_the_middle_of_the_image() -> None:
    potential = gaussian_blob((20, 31), 1.0, 4.0).potential
    np.testing.assert_allclose(potential, potential[::-1, ::-1])
    np.testing.assert_allclose(potential, gaussian_blob((20, 31), 1.0, 4.0, (9.5, 15)).potential)


def test_axes_of_an_ellipse() -> None:
    """Without rotation the first radius is along y; the angle turns it towards x."""
    upright = gaussian_blob((41, 41), 1.0, (8.0, 3.0)).potential
    assert upright[28, 20] == pytest.approx(math.exp(-0.5))
    assert upright[20, 23] == pytest.approx(math.exp(-0.5))
    diagonal = gaussian_blob((41, 41), 1.0, (8.0, 3.0), angle=math.pi / 4).potential
    assert diagonal[26, 26] > diagonal[26, 14]


def test_phantoms_add_up() -> None:
    one, other = PHANTOMS["toroid"], PHANTOMS["ellipse"]
    both = one + other
    np.testing.assert_array_equal(both.potential, one.potential + other.potential)
    np.testing.assert_array_equal(both.displacement, one.displacement + other.displacement)


def test_ellipse_pair_has_no_symmetry_and_no_fold() -> None:
    pair = ellipse_pair((80, 80))
    determinant = jacobian_determinant(pair.displacement)
    assert determinant.min() > 0.4
    for turns in range(4):
        turned = np.rot90(pair.potential, turns)
        for other in (turned, turned.T):
            if turns or other is not turned:
                assert np.abs(other - pair.potential).max() > 0.3 * np.ptp(pair.potential)


def test_caustics_of_the_toroid_start_near_the_papers_value() -> None:
    """The map folds where 1 + d' = 0: at r = √3 σ, for D_m of about 186 MG µm."""
    setup = paper_setup()

    def smallest(peak: float) -> float:
        phantom = toroid((201, 201), setup, peak, 30e-6)
        return float(jacobian_determinant(phantom.displacement).min())

    assert smallest(180) > 0 > smallest(192)


def test_wrong_input_is_told() -> None:
    setup = paper_setup()
    with pytest.raises(InputError, match="sigma is 0: it must be positive, in m"):
        toroid((9, 9), setup, 10, 0)
    with pytest.raises(InputError, match=r"sigma is -1\.0: it must be positive, in px"):
        gaussian_blob((9, 9), 1.0, (3.0, -1.0))
    with pytest.raises(InputError, match="must be finite"):
        toroid((9, 9), setup, math.nan, 30e-6)
    with pytest.raises(InputError, match=r"shape is \(0, 9\)"):
        gaussian_blob((0, 9), 1.0, 3.0)
    with pytest.raises(InputError, match="center is"):
        gaussian_blob((9, 9), 1.0, 3.0, center=(math.inf, 0))
    with pytest.raises(InputError, match="they must match"):
        gaussian_blob((9, 9), 1.0, 3.0) + gaussian_blob((9, 8), 1.0, 3.0)
    with pytest.raises(TypeError):
        PHANTOMS["pair"] + 3  # type: ignore[operator]
    assert isinstance(PHANTOMS["pair"], Phantom)


@pytest.mark.skipif(
    not TOROID_DATA.is_dir(), reason="the shared toroid images are not beside the project"
)
@pytest.mark.parametrize("peak", [24, 97, 194])
def test_toroid_of_an_independent_code(peak: int) -> None:
    """Theirs has the momentum √(2 m W), so its displacement is 0.4 % larger."""
    setup = paper_setup()
    energy = setup.energy * 1e6 * SPECIES["proton"].charge
    classical = math.sqrt(2 * SPECIES["proton"].mass * energy)
    theirs = np.load(TOROID_DATA / f"dm{peak:03d}_displacement.npy")
    ours = toroid((200, 200), setup, peak, 30e-6).displacement
    assert setup.momentum / classical == pytest.approx(1.004, abs=2e-4)
    np.testing.assert_allclose(ours * setup.momentum / classical, theirs, atol=1e-5)
