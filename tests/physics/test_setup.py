"""Conversions between pixels and SI, and the models' behaviour as files."""

from __future__ import annotations

import json
import math
import tomllib

import numpy as np
import pytest
import tomli_w
from pydantic import TypeAdapter, ValidationError

from napari_shadowinv.errors import InputError
from napari_shadowinv.physics.beam import (
    displacement_from_potential,
)
from napari_shadowinv.physics.setup import (
    SETUPS,
    SPECIES,
    OpticalSetup,
    ProtonSetup,
    Setup,
    setup_from_dict,
)

PROTON = {
    "kind": "proton",
    "energy": 14.7,
    "source_object_distance": 1.3e-3,
    "object_image_distance": 2e-2,
    "pixel_size": 1.5e-6,
}
OPTICAL = {
    "kind": "optical",
    "wavelength": 810e-9,
    "object_image_distance": 0.1,
    "detector_pixel_size": 5e-6,
}
ELECTRONVOLT = 1.602176634e-19
LIGHT_SPEED = 299792458.0


@pytest.fixture
def proton() -> ProtonSetup:
    return ProtonSetup(**PROTON)


@pytest.fixture
def optical() -> OpticalSetup:
    return OpticalSetup(**OPTICAL)


def test_magnification_of_the_paper() -> None:
    assert ProtonSetup.example().magnification == pytest.approx(1 + 20 / 1.3)


def test_collimated_beam_does_not_magnify(optical: OpticalSetup) -> None:
    assert optical.is_collimated
    assert optical.magnification == 1
    assert optical.object_pixel_size == 5e-6


def test_detector_pixels_are_smaller_in_the_object_plane(proton: ProtonSetup) -> None:
    on_detector = proton.pixel_size * proton.magnification
    by_detector = ProtonSetup(
        **{k: v for k, v in PROTON.items() if k != "pixel_size"}, detector_pixel_size=on_detector
    )
    assert by_detector.object_pixel_size == pytest.approx(1.5e-6)
    assert by_detector.potential(2.0) == pytest.approx(proton.potential(2.0))


def test_deflection_moves_the_ray_by_the_displacement(proton: ProtonSetup) -> None:
    angle = proton.deflection_angle(3.0)
    on_screen = angle * proton.object_image_distance
    assert on_screen / proton.magnification == pytest.approx(3.0 * 1.5e-6)


def test_angle_is_minus_the_gradient_of_the_potential(proton: ProtonSetup) -> None:
    phi = np.arange(5.0) ** 2
    gradient = np.gradient(proton.potential(phi), 1.5e-6)
    np.testing.assert_allclose(-gradient, proton.deflection_angle(-np.gradient(phi)))


@pytest.mark.parametrize("setup", [ProtonSetup(**PROTON), OpticalSetup(**OPTICAL)])
def test_round_trips_of_angle_and_potential(setup: Setup) -> None:
    values = np.linspace(-3, 5, 24).reshape(2, 3, 4)
    np.testing.assert_allclose(setup.displacement(setup.deflection_angle(values)), values)
    np.testing.assert_allclose(setup.normalized_potential(setup.potential(values)), values)


def test_momentum_and_velocity_of_the_papers_protons(proton: ProtonSetup) -> None:
    momentum = proton.momentum * LIGHT_SPEED / ELECTRONVOLT / 1e6
    assert momentum == pytest.approx(math.sqrt(14.7**2 + 2 * 14.7 * 938.27209), rel=1e-8)
    assert momentum == pytest.approx(166.74, abs=0.01)
    gamma = 1 + 14.7 / 938.27209
    assert proton.velocity / LIGHT_SPEED == pytest.approx(math.sqrt(1 - gamma**-2), rel=1e-8)


def test_momentum_has_classical_and_ultrarelativistic_limits(proton: ProtonSetup) -> None:
    slow = proton.model_copy(update={"energy": 1e-6})
    mass = SPECIES["proton"].mass
    assert slow.momentum == pytest.approx(math.sqrt(2 * mass * ELECTRONVOLT), rel=1e-8)
    fast = proton.model_copy(update={"energy": 1e6, "species": "electron"})
    assert fast.momentum == pytest.approx(1e12 * ELECTRONVOLT / LIGHT_SPEED, rel=1e-6)
    assert fast.velocity == pytest.approx(LIGHT_SPEED, rel=1e-9)
    assert fast.velocity <= LIGHT_SPEED


def test_magnetic_force_is_velocity_cross_field(proton: ProtonSetup) -> None:
    """Against numpy's cross product, for any direction of the field and the sign of the charge."""
    for species, sign in (("proton", 1), ("electron", -1)):
        setup = proton.model_copy(update={"species": species})
        field_y, field_x = 0.4e-3, -0.7e-3
        force = sign * np.cross([0, 0, 1], [field_x, field_y, 0])
        angle = setup.deflection_angle(
            setup.displacement_from_path_integrated_b([field_y, field_x])
        )
        expected = ELECTRONVOLT * force[[1, 0]] / setup.momentum
        np.testing.assert_allclose(angle, expected, rtol=1e-9)


def test_round_trips_of_fields_and_line_integrals(
    proton: ProtonSetup, optical: OpticalSetup
) -> None:
    rng = np.random.default_rng(0)
    vectors, plane = rng.normal(size=(2, 4, 5)), rng.normal(size=(4, 5))
    for unit in ("T m", "MG um"):
        moved = proton.displacement_from_path_integrated_b(vectors, unit)
        np.testing.assert_allclose(proton.path_integrated_b(moved, unit), vectors)
    for convert, invert, values in (
        (proton.path_integrated_e, proton.displacement_from_path_integrated_e, vectors),
        (optical.line_integrated_log_index, optical.normalized_potential_from_log_index, plane),
    ):
        np.testing.assert_allclose(convert(invert(values)), values, rtol=1e-14)
    density = optical.line_integrated_density(plane)
    log_index = -density / (2 * optical.critical_density)
    np.testing.assert_allclose(optical.normalized_potential_from_log_index(log_index), plane)
    # A field along +x pushes a proton to +x.
    assert proton.displacement_from_path_integrated_e([0.0, 1.0])[1] > 0


def test_potential_in_metres_gives_the_displacement_in_pixels(proton: ProtonSetup) -> None:
    y, x = np.mgrid[:7, :9].astype(float)
    normalised = proton.normalized_potential(proton.potential(3 * y**2 - y * x))
    displacement = displacement_from_potential(normalised)
    # Differences of second order are exact for a parabola, at the border too.
    np.testing.assert_allclose(displacement, [x - 6 * y, y], atol=1e-12)
    with pytest.raises(InputError, match=r"potential has shape \(7,\)"):
        displacement_from_potential(np.zeros(7))


def test_known_uniform_electric_field(proton: ProtonSetup) -> None:
    """A field along +x of 1 GV/m over 1 mm pushes a proton to +x by q E L / (p v)."""
    momentum = 166.74e6 * ELECTRONVOLT / LIGHT_SPEED
    angle = ELECTRONVOLT * 1e6 / (momentum * proton.velocity)
    displacement = proton.displacement(np.array([0.0, angle]))
    np.testing.assert_allclose(proton.path_integrated_e(displacement), [0, 1e6], rtol=1e-4)


def test_slow_particles_follow_the_papers_electric_formula() -> None:
    """Eq. 2b: a = q/(2W) ∫E dz."""
    setup = ProtonSetup(**{**PROTON, "energy": 1e-3})
    angle = setup.deflection_angle([1.0, 0.0])[0]
    assert setup.path_integrated_e([1.0, 0.0])[0] == pytest.approx(2 * 1e3 * angle, rel=1e-5)


def test_critical_density_at_810_nm(optical: OpticalSetup) -> None:
    """1.1e21 cm⁻³ divided by the square of the wavelength in µm."""
    assert optical.critical_density * 1e-6 == pytest.approx(1.115e21 / 0.81**2, rel=1e-3)
    assert optical.critical_density * 1e-6 == pytest.approx(1.7e21, rel=1e-2)


def test_density_gives_the_refractive_index_of_the_potential(optical: OpticalSetup) -> None:
    """A slab of thin plasma: ln √(1 - n/n_c) times its thickness, there and back."""
    density, thickness = 1e-4 * optical.critical_density, 2e-3
    log_index = 0.5 * math.log(1 - density / optical.critical_density) * thickness
    phi = optical.normalized_potential(-log_index)
    assert optical.line_integrated_log_index(phi) == pytest.approx(log_index)
    assert optical.line_integrated_density(phi) == pytest.approx(density * thickness, rel=1e-4)
    modulation = optical.relative_density_modulation(phi, density)
    assert modulation == pytest.approx(thickness, rel=1e-4)


@pytest.mark.parametrize("density", [0.0, -1.0, math.nan, math.inf])
def test_density_must_be_positive(optical: OpticalSetup, density: float) -> None:
    with pytest.raises(InputError, match=r"density is .* must be positive"):
        optical.relative_density_modulation(1.0, density)


@pytest.mark.parametrize(
    "setup", [ProtonSetup(**PROTON), OpticalSetup(**OPTICAL)], ids=["proton", "optical"]
)
def test_a_setup_survives_every_file(setup: Setup) -> None:
    dump = setup.model_dump()
    assert type(setup)(**dump) == setup
    assert type(setup).model_validate_json(setup.model_dump_json()) == setup
    assert setup_from_dict(json.loads(setup.model_dump_json())) == setup
    assert setup_from_dict(tomllib.loads(tomli_w.dumps(dump))) == setup
    assert TypeAdapter(Setup).validate_python(dump) == setup


def test_every_field_has_a_description() -> None:
    for model in SETUPS.values():
        for field in model.model_fields.values():
            assert field.title
            assert field.description


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"energy": 0}, r"'energy' is 0: kinetic energy \(MeV\) must be greater than 0"),
        ({"object_image_distance": -1}, "'object_image_distance' is -1: .* greater than 0"),
        ({"object_image_distance": math.inf}, "must be a finite number"),
        ({"pixel_size": 0.0}, "'pixel_size' is 0.0: .* greater than 0"),
        ({"detector_pixel_size": 1e-5}, "received both of 'pixel_size'"),
        ({"pixel_size": None}, "received neither of 'pixel_size'"),
        ({"energi": 3}, "unknown key 'energi', did you mean 'energy'"),
        ({"colour": 3}, "unknown key 'colour', expected one of kind"),
        ({"species": "proten"}, "'species' is 'proten': species must be 'proton'"),
        ({"energy": "high"}, "'energy' is 'high': expected a number in MeV"),
        ({"kind": "protons"}, "'kind' is 'protons', .* did you mean 'proton'"),
        ({"kind": ["proton"]}, "'kind' is .* must be 'proton' .* or 'optical'"),
        ({"kind": "electron"}, 'give kind = "proton" and species = "electron"'),
        ({"kind": "Electrons"}, 'give kind = "proton" and species = "electron"'),
        ({"kind": "protons"}, "species.*: proton, deuteron,.*electron.*did you mean 'proton'"),
        (
            {"kind": "proton", "species": "positron"},
            "'species' is 'positron': .*'proton', 'deuteron',.*'electron'",
        ),
        ({"kind": None}, "'kind' is missing, .*species.*electron.*or 'optical'"),
    ],
)
def test_setup_refuses_wrong_values_in_one_sentence(
    change: dict[str, object], message: str
) -> None:
    with pytest.raises(InputError, match=message) as caught:
        setup_from_dict({**PROTON, **change}, "setup file shot.toml")
    assert str(caught.value).startswith("setup file shot.toml: ")
    assert "\n" not in str(caught.value)


def test_a_missing_key_is_named_unless_it_is_misspelt() -> None:
    rest = {k: v for k, v in PROTON.items() if k != "energy"}
    with pytest.raises(InputError, match="'energy' is missing, give the kinetic energy"):
        setup_from_dict(rest)
    with pytest.raises(InputError) as caught:
        setup_from_dict(rest | {"enery": 14.7})
    assert str(caught.value) == "setup: unknown key 'enery', did you mean 'energy'?"
    with pytest.raises(InputError, match="received a list"):
        setup_from_dict([PROTON])  # type: ignore[arg-type]


def test_constructor_and_later_changes_are_checked(proton: ProtonSetup) -> None:
    with pytest.raises(InputError, match=r"^ProtonSetup: 'energy' is 0: .* greater than 0$"):
        ProtonSetup(**{**PROTON, "energy": 0})
    with pytest.raises(ValidationError, match="frozen"):
        proton.energy = 3.0  # type: ignore[misc]


def test_vectors_must_have_two_components(proton: ProtonSetup) -> None:
    with pytest.raises(InputError, match=r"displacement has shape \(3, 4\)"):
        proton.path_integrated_b(np.zeros((3, 4)))
    with pytest.raises(InputError, match=r"field has shape \(\)"):
        proton.displacement_from_path_integrated_b(1.0)
    with pytest.raises(InputError, match="unit is 'G cm': it must be one of T m, MG um"):
        proton.path_integrated_b(np.zeros((2, 4)), "G cm")  # type: ignore[arg-type]


@pytest.mark.parametrize("kind", SETUPS)
def test_every_field_of_a_setup_can_be_made(kind: str) -> None:
    setup = SETUPS[kind].example()
    for field in setup.si_fields:
        values = np.ones((2, 3, 4) if field.is_vector else (3, 4))
        assert setup.field_in_si(field.name, values).shape == values.shape
    assert setup.main_field.name in {field.name for field in setup.si_fields if field.is_vector}
    assert setup.angle_ratio(setup, setup.default_deflector(setup)) == 1
