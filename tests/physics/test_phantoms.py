"""Phantoms agree with their formulas."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.integrate import trapezoid

from helpers.toroid import toroid_displacement
from napari_shadowinv.errors import InputError
from napari_shadowinv.physics.forward import jacobian_determinant, synthetic_image
from napari_shadowinv.physics.phantoms import (
    Phantom,
    coaxial_line,
    cosine_ellipses,
    cosine_toroid,
    ellipse_pair,
    focusing_pair,
    four_toroids,
    gaussian_blob,
    opposite_pair,
    plasma_wavelength,
    toroid,
    wakefield,
)
from napari_shadowinv.physics.setup import SPECIES, OpticalSetup, ProtonSetup

PHANTOMS = {
    "toroid": toroid((120, 90), ProtonSetup.example(), 97, 30e-6, center=(70.3, 41.8)),
    "ellipse": gaussian_blob((120, 90), 30.0, (18.0, 11.0), (50.2, 44.7), angle=0.7),
    "pair": ellipse_pair((120, 90)),
    "elliptical toroid": toroid(
        (120, 90), ProtonSetup.example(), -20, (27e-6, 18e-6), center=(60.2, 41.8), angle=0.4
    ),
    "four toroids": four_toroids((300, 280), ProtonSetup.example()),
    "focusing pair": focusing_pair((220, 200), ProtonSetup.example()),
    "opposite pair": opposite_pair((220, 200), ProtonSetup.example()),
    "wakefield": wakefield((240, 400), OpticalSetup.example()),
}
PAPER_SCENES = [four_toroids, cosine_ellipses, focusing_pair, opposite_pair]


@pytest.mark.parametrize("name", PHANTOMS)
def test_displacement_is_minus_the_gradient(name: str) -> None:
    """Central differences of objects that are smooth on the scale of a pixel."""
    phantom = PHANTOMS[name]
    error = np.stack(np.gradient(phantom.potential)) + phantom.displacement
    assert np.abs(error[:, 1:-1, 1:-1]).max() < 0.02 * np.abs(phantom.displacement).max()


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


def test_caustics_of_the_toroid_start_near_the_papers_value() -> None:
    """The map folds where 1 + d' = 0: at r = √3 σ, for D_m of about 186 MG µm."""
    setup = ProtonSetup.example()

    def smallest(peak: float) -> float:
        phantom = toroid((201, 201), setup, peak, 30e-6)
        return float(jacobian_determinant(phantom.displacement).min())

    assert smallest(180) > 0 > smallest(192)


@pytest.mark.parametrize("name", ["cosine ellipses", "coaxial line"])
def test_gradient_of_objects_with_a_kink_in_the_field(name: str) -> None:
    """Differences over ever smaller pixels approach a continuous field with its kinks."""
    errors = []
    for scale in (1, 4):
        setup = ProtonSetup.example().model_copy(update={"pixel_size": 1.5e-6 / scale})
        shape = (120 * scale, 120 * scale)
        if name == "cosine ellipses":
            phantom = cosine_ellipses(shape, setup)
        else:
            phantom, _ = coaxial_line(shape, setup)
        error = np.stack(np.gradient(phantom.potential)) + phantom.displacement
        largest = np.abs(phantom.displacement).max()
        errors.append(np.abs(error[:, 1:-1, 1:-1]).max() / largest)
    assert errors[1] < 0.02
    assert errors[0] / errors[1] == pytest.approx(4, rel=0.25)


@pytest.mark.parametrize("scene", PAPER_SCENES)
def test_caustics_of_the_papers_structures_have_just_formed(scene: Callable[..., Phantom]) -> None:
    """The map folds at the default strength, not yet at 10 % less."""
    setup = ProtonSetup.example()
    determinant = jacobian_determinant(scene((200, 200), setup).displacement)
    assert -0.1 < determinant.min() < 0
    assert np.mean(determinant < 0) < 0.05
    assert jacobian_determinant(scene((200, 200), setup, 0.9).displacement).min() > 0


@pytest.mark.parametrize("scene", PAPER_SCENES)
def test_no_flux_leaves_the_image_of_the_papers_structures(scene: Callable[..., Phantom]) -> None:
    displacement = scene((200, 200), ProtonSetup.example()).displacement
    assert synthetic_image(displacement).sum() == pytest.approx(200 * 200, rel=1e-4)


def test_elliptical_toroid_reaches_its_peak_on_the_shorter_axis() -> None:
    setup = ProtonSetup.example()
    phantom = toroid((121, 121), setup, 50, (30e-6, 15e-6))
    field = np.hypot(*setup.path_integrated_b(phantom.displacement, "MG um"))
    assert field[60, 70] == pytest.approx(50, rel=1e-12)  # σ_v is 10 pixels
    assert field.max() == pytest.approx(50, rel=1e-12)
    assert field[80, 60] == pytest.approx(25, rel=1e-12)  # σ_u is twice as long


def test_cosine_toroid_ends_smoothly_at_its_rim() -> None:
    """cos² has slope zero at the rim, and its largest slope half-way to it."""
    setup = ProtonSetup.example()
    phantom = cosine_toroid((121, 121), setup, 50, (60e-6, 30e-6))
    field = np.hypot(*setup.path_integrated_b(phantom.displacement, "MG um"))
    assert field[60, 70] == pytest.approx(50, rel=1e-12)  # the rim is at 20 pixels
    assert field.max() == pytest.approx(50, rel=1e-12)
    np.testing.assert_array_equal(phantom.potential[60, 80:], 0)
    np.testing.assert_array_equal(field[60, 80:], 0)
    assert field[60, 60] == 0
    assert np.isfinite(phantom.displacement).all()


def test_directions_of_the_papers_structures() -> None:
    """Counter-clockwise drives rays apart, a positive potential; clockwise gathers them."""
    shape, setup = (200, 200), ProtonSetup.example()
    assert four_toroids(shape, setup).potential.min() >= 0
    assert cosine_ellipses(shape, setup).potential.min() >= 0
    assert focusing_pair(shape, setup).potential.max() <= 0
    opposite = opposite_pair(shape, setup).potential
    assert opposite[:, :80].min() > -0.1
    assert opposite[:, :80].max() > 100
    assert opposite[:, 125:].max() < 1
    assert opposite[:, 125:].min() < -100


def test_coaxial_line_obeys_amperes_law() -> None:
    """2π r B is the current inside r: all of it between the conductors, none outside."""
    setup = ProtonSetup.example()
    phantom, obstructed = coaxial_line((201, 201), setup, 40, (15e-6, 60e-6, 75e-6))
    field = np.hypot(*setup.path_integrated_b(phantom.displacement, "MG um"))[100, 100:]
    r = np.arange(101.0)
    np.testing.assert_allclose(field[10:41] * r[10:41], 400, rtol=1e-12)
    np.testing.assert_allclose(field[:11], 4 * r[:11], atol=1e-12)
    np.testing.assert_allclose(field[50:], 0, atol=1e-12)
    inside = np.flatnonzero(obstructed[100, 100:])
    np.testing.assert_array_equal(inside, [*range(10), *range(41, 50)])
    np.testing.assert_array_equal(phantom.potential[100, 150:], 0)


def test_plasma_wave_has_its_wavelength_and_lags_on_the_axis() -> None:
    """Its crests lie a plasma wavelength apart on the axis, and further to +x off it."""
    setup = OpticalSetup.example()
    wavelength = plasma_wavelength(1.65e25)
    assert wavelength == pytest.approx(3.339e7 / math.sqrt(1.65e25), rel=1e-3)
    wave = wakefield((241, 401), setup, length=1.0, curvature_radius=40e-6, width=3e-6)
    on_axis = wave.potential[120]
    crests = np.flatnonzero((on_axis[1:-1] > on_axis[:-2]) & (on_axis[1:-1] > on_axis[2:])) + 1
    spacing = np.diff(crests).mean() * setup.object_pixel_size
    assert spacing == pytest.approx(wavelength, rel=0.02)
    crest = crests[len(crests) // 2]
    off_axis = wave.potential[150, crest - 15 : crest + 16]
    assert np.argmax(off_axis) > 15


def _wave_density(y: float, z: NDArray[np.float64], xi: float) -> NDArray[np.float64]:
    """Δn/n₀ of the default wakefield, all lengths in µm."""
    k = 2 * math.pi / (plasma_wavelength(1.65e25) * 1e6)
    square = y**2 + z**2
    envelope = 0.8 * np.exp(-square / 72 - xi**2 / 392)
    modulation: NDArray[np.float64] = envelope * np.cos(k * (xi - square / 40))
    return modulation


@pytest.mark.parametrize(("row", "column"), [(120, 200), (111, 217), (150, 160), (97, 230)])
def test_line_integral_of_the_plasma_wave(row: int, column: int) -> None:
    """The closed form equals the sum of the density along the beam."""
    setup = OpticalSetup.example()
    wave = wakefield((241, 401), setup)
    modulation = setup.relative_density_modulation(wave.potential, 1.65e25) * 1e6
    z = np.linspace(-60, 60, 20_001)
    density = _wave_density((row - 120) * 0.25, z, (column - 200) * 0.25)
    assert modulation[row, column] == pytest.approx(trapezoid(density, z), rel=1e-9)


def test_thin_plasma_is_the_first_order_of_the_exact_root() -> None:
    """-∫Δ ln η dz by the paper's Eq. 11: off by order n₀/n_c, so by λ² of the probe."""
    z = np.linspace(-60, 60, 20_001)
    errors = []
    for wavelength in (810e-9, 405e-9):
        setup = OpticalSetup.example().model_copy(update={"wavelength": wavelength})
        share = 1.65e25 / setup.critical_density
        density = 1 + _wave_density(0.0, z, 0.0)
        log_index = 0.5 * np.log1p(-share * density) - 0.5 * math.log1p(-share)
        exact = -trapezoid(log_index, z) * 1e-6
        first_order = setup.potential(wakefield((3, 3), setup).potential)[1, 1]
        errors.append(abs(first_order / exact - 1))
    assert errors[0] < 0.02
    assert errors[0] / errors[1] == pytest.approx(4, rel=0.05)


BEAM, LIGHT, SMALL = ProtonSetup.example(), OpticalSetup.example(), (9, 9)
REFUSED = {
    "strength nan: it must be finite": lambda: four_toroids((20, 20), BEAM, math.nan),
    "smaller side of the image is 0": lambda: focusing_pair((0, 20), BEAM),
    "expected one number or two, in m": lambda: toroid(SMALL, BEAM, 10, (1e-6, 1e-6, 1e-6)),
    "radius is 0: it must be positive, in m": lambda: cosine_toroid(SMALL, BEAM, 10, 0),
    "three positive, increasing": lambda: coaxial_line(SMALL, BEAM, radii=(2e-6, 1e-6, 3e-6)),
    "width is -1: it must be positive, in m": lambda: wakefield(SMALL, LIGHT, width=-1),
    "curvature is 0: it must not be 0": lambda: wakefield(SMALL, LIGHT, curvature_radius=0),
    "density is 0: it must be positive": lambda: plasma_wavelength(0),
    "sigma is 0: it must be positive, in m": lambda: toroid(SMALL, BEAM, 10, 0),
    r"sigma is -1\.0: it must be positive, in px": lambda: gaussian_blob(SMALL, 1, (3.0, -1.0)),
    "must be finite": lambda: toroid(SMALL, BEAM, math.nan, 30e-6),
    r"shape is \(0, 9\)": lambda: gaussian_blob((0, 9), 1.0, 3.0),
    "center is": lambda: gaussian_blob(SMALL, 1.0, 3.0, center=(math.inf, 0)),
    "they must match": lambda: gaussian_blob(SMALL, 1, 3.0) + gaussian_blob((9, 8), 1, 3.0),
}


@pytest.mark.parametrize("words", REFUSED)
def test_phantoms_refuse_wrong_input(words: str) -> None:
    with pytest.raises(InputError, match=words):
        REFUSED[words]()


def test_toroid_of_an_independent_code() -> None:
    """Theirs has the momentum √(2 m W), so its displacement is 0.4 % larger."""
    setup = ProtonSetup.example()
    energy = setup.energy * 1e6 * SPECIES["proton"].charge
    classical = math.sqrt(2 * SPECIES["proton"].mass * energy)
    ours = toroid((200, 200), setup, 97, 30e-6).displacement
    ratio = setup.momentum / classical
    assert ratio == pytest.approx(1.004, abs=2e-4)
    np.testing.assert_allclose(ratio * ours, toroid_displacement(97), atol=1e-5)
