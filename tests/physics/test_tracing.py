import math
from types import SimpleNamespace

import numpy as np
import pytest
import xarray as xr
from scipy import constants
from scipy.interpolate import RegularGridInterpolator

from napari_shadowinv.errors import InputError, InversionCancelled
from napari_shadowinv.physics.field_grid import FieldGrid, field_grid
from napari_shadowinv.physics.particle_flight import line_integrals, trace_particles
from napari_shadowinv.physics.setup import OpticalSetup, ProtonSetup
from napari_shadowinv.physics.trace_options import TraceOptions
from napari_shadowinv.physics.tracing import trace

SETUP = ProtonSetup(
    energy=14.7, source_object_distance=1e-2, object_image_distance=0.2, pixel_size=2e-5
)
PARALLEL = SETUP.model_copy(update={"source_object_distance": math.inf})
SIDE = 1e-3
FINE = TraceOptions(step=0.1, max_turn=0.005)


def uniform_grid(nodes=21, side=SIDE, **components):
    """A cube with uniform fields: by=10.0 in T, ez=1e9 in V/m."""
    fields = {}
    for symbol in "be":
        values = [components.get(f"{symbol}{axis}", 0.0) for axis in "zyx"]
        if any(values):
            fields[symbol] = np.ones((3, nodes, nodes, nodes)) * np.reshape(values, (3, 1, 1, 1))
    return FieldGrid(fields.get("b"), fields.get("e"), spacing=(side / (nodes - 1),) * 3)


def toroid_grid(peak=5.0, nodes=41, side=SIDE, thickness=1.0):
    """A Gaussian azimuthal field about the beam, with its peak in T; zero on the faces."""
    places = np.linspace(-side / 2, side / 2, nodes)
    z, y, x = np.meshgrid(thickness * places, places, places, indexing="ij")
    width = side / 10
    profile = peak * math.exp(0.5) / width
    profile = profile * np.exp(-(x**2 + y**2 + (z / thickness) ** 2) / (2 * width**2))
    spacing = side / (nodes - 1)
    return FieldGrid(
        np.stack([0 * x, x * profile, -y * profile]),
        spacing=(thickness * spacing, spacing, spacing),
    )


def random_grid(seed=0, strength=50.0, nodes=12, electric=0.0):
    values = np.random.default_rng(seed).normal(size=(2, 3, nodes, nodes, nodes))
    spacing = (SIDE / (nodes - 1),) * 3
    return FieldGrid(
        strength * values[0], electric * values[1] if electric else None, spacing=spacing
    )


EMPTY = FieldGrid(np.zeros((3, 4, 4, 4)), spacing=(1e-4,) * 3)


def aims(count=50, spread=20.0, seed=1):
    return np.random.default_rng(seed).uniform(-spread, spread, (2, count))


# exact motions


@pytest.mark.parametrize("energy", [0.5, 14.7, 500.0])
def test_particle_in_uniform_field_follows_a_circle(energy):
    setup = PARALLEL.model_copy(update={"energy": energy})
    radius = 4 * SIDE
    field = setup.momentum / (constants.e * radius)
    particle = trace_particles(uniform_grid(by=field), setup, [[0.0], [0.0]], options=FINE)
    sine = SIDE / radius
    angle = -math.asin(sine)  # a_x = -(q/p) ∫B_y dz
    assert particle.deflection[1, 0] == pytest.approx(angle, rel=1e-6)
    assert particle.deflection[0, 0] == pytest.approx(0, abs=1e-12)
    flight = setup.object_image_distance - SIDE / 2
    moved = -radius * (1 - math.cos(angle)) + flight * math.tan(angle)
    assert particle.displacement[1, 0] * setup.pixel_sizes[1] == pytest.approx(moved, rel=1e-6)


def test_particle_gyrates_by_the_exact_angle_with_default_steps():
    """About a field along the beam, a particle that flies at an angle turns by q B L / p_z."""
    aim = np.array([[3.0], [10.0]])
    field = 400.0
    particle = trace_particles(uniform_grid(bz=field), SETUP, aim)
    slopes = aim[:, 0] * SETUP.object_pixel_size / SETUP.source_object_distance
    along = SETUP.momentum / math.sqrt(1 + slopes @ slopes)
    turn = constants.e * field * SIDE / along
    cosine, sine = math.cos(turn), math.sin(turn)
    # dv/dt = (q/m) v × B: with z into the screen and y down, from y towards x
    turned = [cosine * slopes[0] - sine * slopes[1], cosine * slopes[1] + sine * slopes[0]]
    change = np.arctan(turned) - np.arctan(slopes)
    np.testing.assert_allclose(particle.deflection[:, 0], change, rtol=1e-5)


def test_particle_in_transverse_electric_field_follows_a_catenary():
    field = 2e9
    particle = trace_particles(uniform_grid(ex=field), PARALLEL, [[0.0], [0.0]], options=FINE)
    momentum = PARALLEL.momentum * constants.c
    total = math.hypot(momentum, PARALLEL.particle.mass * constants.c**2)
    across = total * math.sinh(constants.e * field * SIDE / momentum)
    assert particle.deflection[1, 0] == pytest.approx(math.atan2(across, momentum), rel=1e-6)


@pytest.mark.parametrize("field", [-8e9, 3e9, 1e12])
def test_particle_gains_charge_times_voltage(field):
    particle = trace_particles(uniform_grid(ez=field), PARALLEL, [[0.0], [0.0]])
    assert particle.energy_change[0] == pytest.approx(field * SIDE * 1e-6, rel=1e-3)
    assert particle.displacement[:, 0] == pytest.approx([0, 0], abs=1e-12)


def test_particle_drifts_across_electric_and_magnetic_fields():
    """Slow particles along B_z turn about a centre that drifts by E × B / B²."""
    setup = SETUP.model_copy(update={"energy": 0.01, "pixel_size": 1e-6})
    magnetic, electric = 120.0, 1e7
    aim = np.array([[4.0], [7.0]])
    options = TraceOptions(step=0.05, max_turn=0.01)
    grid = uniform_grid(bz=magnetic, ex=electric)
    particle = trace_particles(grid, setup, aim, options=options)
    slopes = aim[:, 0] * 1e-6 / setup.source_object_distance
    speed = setup.velocity / math.sqrt(1 + slopes @ slopes)
    time = SIDE / speed
    turn = constants.e * magnetic * time / setup.particle.mass
    assert turn > 2 * math.pi
    # complex y + i x: v' = i ω v + (q/m) i E_x, since q v × B turns from y towards x
    drift = -electric / magnetic
    velocity = speed * complex(*slopes)
    end = (velocity - drift) * np.exp(1j * turn) + drift
    change = np.arctan([end.real / speed, end.imag / speed]) - np.arctan(slopes)
    np.testing.assert_allclose(particle.deflection[:, 0], change, rtol=1e-3)
    centre = drift * time + (velocity - drift) * (np.exp(1j * turn) - 1) / (
        1j * constants.e * magnetic / setup.particle.mass
    )
    entry = slopes * (setup.source_object_distance - SIDE / 2)
    screen = np.array([centre.real, centre.imag]) + entry
    flight = setup.object_image_distance - SIDE / 2
    screen = screen + flight * np.array([end.real, end.imag]) / speed
    landing = particle.landing[:, 0] * setup.pixel_sizes[1]
    np.testing.assert_allclose(landing, screen, rtol=2e-3)


def test_ray_along_an_edge_of_the_grid_takes_no_more_steps_than_others():
    grid = uniform_grid(nodes=11, by=5.0)
    ends = np.array(grid.extent[1]) / SETUP.object_pixel_size
    places = np.concatenate([ends * share for share in (0.95238095, 1.0, 1.05263158)])
    aim = np.stack(np.meshgrid(places, places)).reshape(2, -1)
    assert trace_particles(grid, SETUP, aim).steps.max() < 40


# conservation


def test_magnetic_field_conserves_the_energy():
    particles = trace_particles(random_grid(strength=500.0), SETUP, aims())
    assert np.abs(particles.deflection).max() > 0.1
    assert np.abs(particles.energy_change).max() < 1e-12 * SETUP.energy


def test_electrostatic_field_returns_the_energy():
    places = np.linspace(-SIDE / 2, SIDE / 2, 101)
    z, y, x = np.meshgrid(places, places, places, indexing="ij")
    voltage, width = 2e5, SIDE / 10
    potential = voltage * np.exp(-(x**2 + y**2 + z**2) / (2 * width**2))
    electric = np.stack([z, y, x]) * potential / width**2
    grid = FieldGrid(electric=electric, spacing=(places[1] - places[0],) * 3)
    particles = trace_particles(grid, SETUP, aims(spread=8.0))
    assert np.abs(particles.energy_change).max() < 1e-3 * voltage * 1e-6
    assert np.abs(particles.deflection).max() > 1e-3


def test_error_falls_with_the_square_of_the_step():
    grid = toroid_grid(peak=50.0)
    exact = trace_particles(grid, SETUP, aims(spread=10.0), options=TraceOptions(step=0.02))
    errors = [
        np.linalg.norm(
            trace_particles(
                grid, SETUP, aims(spread=10.0), options=TraceOptions(step=step)
            ).deflection
            - exact.deflection
        )
        / np.linalg.norm(exact.deflection)
        for step in (1.0, 0.5)
    ]
    assert 3 < errors[0] / errors[1] < 5
    assert errors[1] < 1e-3


# images


def test_free_flight_is_magnified_exactly():
    particles = trace_particles(uniform_grid(by=1e-300, nodes=5), SETUP, aims(spread=500.0))
    outside = np.abs(particles.aim).max(axis=0) > 30
    np.testing.assert_array_equal(particles.landing[:, outside], particles.aim[:, outside])
    np.testing.assert_array_equal(particles.landing, particles.aim)
    traced = trace(EMPTY, SETUP, (20, 30))
    np.testing.assert_array_equal(traced.displacement, 0)
    np.testing.assert_allclose(traced.image, 1, rtol=1e-12)


@pytest.mark.parametrize(("kind", "unit"), [("magnetic", "T m"), ("electric", "V")])
def test_thin_weak_field_deflects_by_its_line_integral(kind, unit):
    grid = toroid_grid(peak=1.0, thickness=0.05)
    if kind == "electric":
        electric = np.asarray(grid.magnetic)[[0, 2, 1]] * 1e7
        grid = FieldGrid(electric=electric, spacing=grid.spacing)
    traced = trace(grid, SETUP, (40, 40), options=TraceOptions(rays_per_pixel=1))
    assert traced.thin_screen_error < 2e-3
    if kind == "magnetic":
        retrieved = SETUP.path_integrated_b(traced.displacement)
        truth = traced.path_integrated_b
    else:
        retrieved = SETUP.path_integrated_e(traced.displacement)
        truth = traced.path_integrated_e
    assert np.linalg.norm(retrieved - truth) < 2e-3 * np.linalg.norm(truth)


def test_field_around_the_beam_focuses_or_defocuses_by_its_sense():
    """A counter-clockwise field, seen along the beam, drives protons apart; electrons together."""
    for species, sign in (("proton", 1), ("electron", -1)):
        setup = SETUP.model_copy(update={"species": species})
        # counter-clockwise with y down: at the right of the axis the field points up
        grid = FieldGrid(-np.asarray(toroid_grid().magnetic), spacing=toroid_grid().spacing)
        particle = trace_particles(grid, setup, [[0.0], [4.0]])
        assert sign * particle.displacement[1, 0] > 0


@pytest.mark.parametrize(
    "change",
    [{"energy": 3.0}, {"species": "alpha"}, {"species": "electron", "energy": 100.0}],
)
@pytest.mark.parametrize("deflector", ["magnetic field", "electric field"])
def test_deflection_scales_with_charge_and_momentum(change, deflector):
    grid = toroid_grid(peak=0.01)
    if deflector == "electric field":
        grid = FieldGrid(electric=np.asarray(grid.magnetic) * 1e7, spacing=grid.spacing)
    changed = SETUP.model_copy(update=change)
    first, second = (
        trace_particles(grid, setup, aims(spread=8.0)).deflection for setup in (SETUP, changed)
    )
    ratio = changed.angle_ratio(SETUP, deflector)
    np.testing.assert_allclose(second, ratio * first, rtol=2e-3, atol=1e-4 * np.abs(second).max())


def test_traced_fluence_conserves_the_flux():
    traced = trace(toroid_grid(peak=20.0), SETUP, (60, 60))
    assert traced.launched == traced.landed + traced.outside + traced.lost
    assert traced.lost == 0
    # The object is far from the border: nothing leaves the image.
    assert traced.image.sum() == pytest.approx(60 * 60, rel=1e-9)


def test_flux_from_outside_the_image_is_deflected_into_it():
    grid = uniform_grid(by=0.2, side=4 * SIDE, nodes=41)
    traced = trace(grid, PARALLEL, (20, 20))
    assert np.abs(traced.displacement).min(axis=(1, 2))[1] > 5
    np.testing.assert_allclose(traced.image, 1, rtol=1e-6)


def test_counts_agree_with_the_fluence_within_their_noise():
    grid = toroid_grid(peak=20.0)
    fluence = trace(grid, SETUP, (40, 40)).image
    options = TraceOptions(output="counts", counts=100)
    traced = trace(grid, SETUP, (40, 40), options=options)
    assert traced.image.sum() == traced.landed
    assert traced.launched == traced.landed + traced.outside + traced.lost
    chi2 = np.mean((traced.image - 100 * fluence) ** 2 / (100 * fluence))
    assert 0.9 < chi2 < 1.1
    np.testing.assert_allclose(traced.source, 100)


def test_results_depend_on_the_seed_and_not_on_the_number_of_threads():
    grid = random_grid(electric=1e8)

    def traced(**choices):
        options = TraceOptions(output="counts", counts=30, **choices)
        return trace(grid, SETUP, (20, 30), options=options)

    first, second = traced(threads=1), traced(threads=3)
    assert (traced(seed=2).image != first.image).any()
    for name in ("image", "displacement", "deflection", "path_integrated_b", "path_integrated_e"):
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name))


def test_source_size_spreads_by_the_magnification_less_one():
    options = TraceOptions(output="counts", counts=100, source_size=4e-5, keep_particles=True)
    particles = trace(EMPTY, SETUP, (50, 50), options=options).particles
    spread = np.std(particles.landing - particles.aim, axis=1)
    magnification = SETUP.magnification
    expected = 4e-5 * (magnification - 1) / magnification / SETUP.object_pixel_size
    np.testing.assert_allclose(spread, expected, rtol=5e-3)


def test_energies_are_those_of_a_table_or_gaussian():
    options = TraceOptions(output="counts", counts=100, keep_particles=True)
    spectrum = [[1.0, 3.0, 4.0], [0.0, 2.0, 0.0]]  # a triangle from 1 over 3 to 4
    energy = trace(EMPTY, SETUP, (50, 50), options=options, spectrum=spectrum).particles.energy
    assert energy.mean() == pytest.approx(8 / 3, rel=2e-3)
    assert energy.var() == pytest.approx((1 + 9 + 16 - 3 - 4 - 12) / 18, rel=5e-3)
    assert (energy < 3).mean() == pytest.approx(2 / 3, rel=2e-3)
    options = options.model_copy(update={"energy_spread": 0.5})
    energy = trace(EMPTY, SETUP, (50, 50), options=options).particles.energy
    assert energy.mean() == pytest.approx(SETUP.energy, rel=1e-3)
    assert energy.std() == pytest.approx(0.5, rel=5e-3)


def test_profile_shapes_the_beam():
    plane = np.arange(1.0, 401.0).reshape(20, 20)
    np.testing.assert_allclose(trace(EMPTY, SETUP, (20, 20), profile=plane).image, plane)

    def tilted(y, x):
        return 2 + x / 1e-3 + 3 * y / 1e-3

    traced = trace(EMPTY, SETUP, (20, 20), profile=tilted)
    y, x = (np.mgrid[:20, :20] - 9.5) * 2e-5
    np.testing.assert_allclose(traced.image, tilted(y, x), rtol=1e-9)
    options = TraceOptions(output="counts", counts=400)
    counts = trace(EMPTY, SETUP, (20, 20), profile=plane, options=options)
    assert counts.source.mean() == pytest.approx(400)
    chi2 = np.mean((counts.image - counts.source) ** 2 / counts.source)
    assert 0.8 < chi2 < 1.2


def test_particles_that_turn_round_are_lost():
    radius = SIDE / 8
    field = PARALLEL.momentum / (constants.e * radius)
    traced = trace(uniform_grid(by=field), PARALLEL, (20, 20))
    assert traced.lost > 0
    assert np.isnan(traced.displacement[:, 10, 10]).all()
    assert traced.launched == traced.landed + traced.outside + traced.lost
    assert np.isfinite(traced.image).all()


# line integrals


def test_line_integrals_are_those_of_the_trilinear_field():
    grid = random_grid(electric=1e9)
    setup = SETUP.model_copy(update={"pixel_size": 1e-4})
    integrals = line_integrals(grid, setup, (9, 12))
    axes = [np.linspace(low, high, 12) for low, high in grid.extent]
    z = np.linspace(*grid.extent[0], 20001)
    weights = np.full(z.size, z[1] - z[0])
    weights[[0, -1]] /= 2
    for row, column in ((0, 0), (4, 6), (7, 10)):
        offsets = np.array([row - 4.0, column - 5.5]) * setup.object_pixel_size
        y, x = offsets[:, None] * (1 + z / setup.source_object_distance)
        for at, (field, component) in enumerate(
            ((grid.magnetic, 1), (grid.magnetic, 2), (grid.electric, 1), (grid.electric, 2))
        ):
            interpolate = RegularGridInterpolator(
                axes, field[component], bounds_error=False, fill_value=0.0
            )
            value = weights @ interpolate(np.stack([z, y, x], axis=-1))
            assert integrals[at, row, column] == pytest.approx(
                value, rel=1e-3, abs=1e-4 * np.abs(field[component]).max() * SIDE
            )


# grids


def lab_field(x, y, z):
    """A field without symmetry."""
    bell = np.exp(-((x - 1e-4) ** 2 + 2 * y**2 + 3 * (z + 5e-5) ** 2) / (2 * 1.5e-4**2))
    return np.stack([3 * bell + x / SIDE, -2 * bell + z / SIDE, bell + y / SIDE])


@pytest.mark.parametrize(("beam", "right"), [("x", "y"), ("-y", "z"), ("z", "-y"), ("-x", "-z")])
def test_turned_grid_is_the_field_seen_along_another_axis(beam, right):
    nodes = np.linspace(-SIDE / 2, SIDE / 2, 16)
    z, y, x = np.meshgrid(nodes + 2e-4, nodes, nodes + 1e-4, indexing="ij")
    grid = FieldGrid(
        lab_field(x, y, z)[::-1], spacing=(nodes[1] - nodes[0],) * 3, centre=(2e-4, 0.0, 1e-4)
    )
    turned = grid.turned(beam=beam, right=right)
    unit = {"x": [1, 0, 0], "y": [0, 1, 0], "z": [0, 0, 1]}
    vectors = [np.array(unit[name[-1]]) * (-1 if "-" in name else 1) for name in (beam, right)]
    along, across = vectors
    down = np.cross(along, across)
    axes = [np.linspace(low, high, 16) for low, high in turned.extent]
    places = np.meshgrid(*axes, indexing="ij")
    lab = np.tensordot(np.stack([along, down, across]).T, np.stack(places), axes=1)
    values = np.tensordot(np.stack([along, down, across]), lab_field(*lab), axes=1)
    np.testing.assert_allclose(turned.magnetic, values, atol=1e-9)


class UnitObject:
    """A unit as an object."""

    def __init__(self, text):
        self.text = text

    def __str__(self):
        return self.text


def dataset(units="T", length="m", scale=1.0, size=1.0, dims=("x", "z", "y"), reverse=False):
    grid = toroid_grid(nodes=11)
    variables = {
        f"B{axis}": (("z", "y", "x"), np.asarray(grid.magnetic)[k] / scale, {"units": units})
        for k, axis in enumerate("zyx")
    }
    coords = {
        axis: (axis, np.linspace(low, high, 11) / size, {"units": length})
        for axis, (low, high) in zip("zyx", grid.extent, strict=True)
    }
    labelled = xr.Dataset(variables, coords).transpose(*dims)
    return labelled.isel(x=slice(None, None, -1)) if reverse else labelled


@pytest.mark.parametrize(
    "choices",
    [{"units": "kG", "scale": 0.1}, {"length": "um", "size": 1e-6}, {"reverse": True}],
)
def test_dataset_is_converted_to_si(choices):
    grid, expected = field_grid(dataset(**choices)), toroid_grid(nodes=11)
    np.testing.assert_allclose(grid.magnetic, expected.magnetic, rtol=1e-12)
    np.testing.assert_allclose(grid.spacing, expected.spacing)
    np.testing.assert_allclose(grid.extent, expected.extent)


def test_grid_with_a_dataset_in_the_layout_of_plasmapy_is_read():
    """PlasmaPy: axes ax0, ax1, ax2 are x, y, z; units are objects whose text is the unit."""
    grid = toroid_grid(nodes=11)
    axes = dict(zip(("ax2", "ax1", "ax0"), "zyx", strict=True))
    variables = {
        f"B_{axis}": (tuple(axes), np.asarray(grid.magnetic)[k] * 1e4, {"unit": UnitObject("G")})
        for k, axis in enumerate("zyx")
    }
    coords = {
        name: np.linspace(low, high, 11) * 1e3
        for name, (low, high) in zip(axes, grid.extent, strict=True)
    }
    labelled = xr.Dataset(variables, coords, {"axis_units": [UnitObject("mm")] * 3})
    read = field_grid(SimpleNamespace(ds=labelled))
    np.testing.assert_allclose(read.magnetic, grid.magnetic, rtol=1e-12)
    np.testing.assert_allclose(read.extent, grid.extent)


def test_traced_image_is_labelled_with_units():
    traced = trace(toroid_grid(nodes=11), SETUP, (20, 20))
    labelled = traced.to_dataset()
    assert labelled["path_integrated_b"].attrs["units"] == "T m"
    assert labelled["deflection"].attrs["units"] == "rad"
    assert float(labelled["x"][1] - labelled["x"][0]) == pytest.approx(2e-5)
    np.testing.assert_array_equal(labelled["displacement"], traced.displacement)


# wrong input


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (lambda d: d.drop_attrs(), "no unit"),
        (lambda d: d.drop_vars("Bx"), "no Bx"),
        (lambda d: d.rename(By="density"), "no By"),
        (lambda d: d.rename(z="depth"), "no coordinate 'z'"),
        (lambda d: d.assign_coords(z=("z", d.z.values**3 * 1e6, {"units": "m"})), "evenly"),
        (lambda d: d.expand_dims(time=2), "select one"),
        (lambda d: d.assign(Bx=d.Bx.where(d.x > 0)), "NaN or infinite"),
        (lambda d: d.assign(Bx=(d.Bx * 1e300).assign_attrs(units="T")), "check"),
        (lambda d: d.assign(Bx=d.Bx.assign_attrs(units="furlong")), "'furlong'"),
    ],
)
def test_unusable_dataset_is_refused_in_a_sentence(change, sentence):
    with pytest.raises(InputError, match=sentence):
        trace(change(dataset()), SETUP, (20, 20))


def centred_at(*centre):
    grid = toroid_grid(nodes=11)
    return FieldGrid(grid.magnetic, spacing=grid.spacing, centre=centre)


COUNTS = {"output": "counts"}


@pytest.mark.parametrize(
    ("given", "sentence"),
    [
        ({"options": {"source_size": 1e-5}}, "use output 'counts'"),
        ({"options": COUNTS | {"energy_spread": 10.0}}, "use a spectrum"),
        ({"options": COUNTS, "spectrum": [[3.0, 1.0], [1.0, 1.0]]}, "sort them"),
        ({"options": COUNTS, "spectrum": [1.0, 2.0]}, "energies in MeV"),
        ({"options": COUNTS | {"source_size": 1e-5}, "setup": PARALLEL}, "collimated"),
        ({"profile": np.ones((3, 3))}, "must match"),
        ({"profile": -np.ones((20, 20))}, "negative"),
        ({"options": {"threads": 0}}, "threads"),
        ({"options": {"seed": -1}}, "seed"),
        ({"options": {"step": 2.0}}, "step"),
        ({"setup": OpticalSetup.example()}, "charged particles"),
        ({"field": centred_at(-1e-2, 0, 0)}, "the source is at"),
        ({"field": centred_at(0.2, 0, 0)}, "the source is at"),
        ({"field": centred_at(0, 0, 0.1)}, "centre the grid"),
        ({"field": uniform_grid(ez=1e38, nodes=3)}, "unit of the field"),
    ],
)
def test_unusable_choice_is_refused_in_a_sentence(given, sentence):
    usual = {"field": toroid_grid(nodes=11), "setup": SETUP, "shape": (20, 20)}
    with pytest.raises(InputError, match=sentence):
        trace(**usual | given)


def test_request_to_stop_ends_the_tracing():
    with pytest.raises(InversionCancelled):
        trace(toroid_grid(nodes=11), SETUP, (20, 20), should_stop=lambda: True)
