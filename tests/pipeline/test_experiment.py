"""Planned experiments: simulated shots obey what is stated, and errors are what is made."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from napari_shadowinv import Instrument, OpticalSetup, ProtonSetup, invert, read, trace, write
from napari_shadowinv.errors import InputError, InversionCancelled
from napari_shadowinv.facts import Verdict, percent
from napari_shadowinv.physics import FieldGrid
from napari_shadowinv.physics.phantom_models import BlobRecipe, FourToroidsRecipe, ToroidRecipe
from napari_shadowinv.physics.phantoms import gaussian_blob, toroid
from napari_shadowinv.physics.poisson import counting_error
from napari_shadowinv.pipeline import ExperimentOptions, plan_experiment
from napari_shadowinv.pipeline.experiment_object import (
    Grid,
    PlannedObject,
    object_of_displacement,
    object_of_field,
    object_of_phantom,
    object_of_result,
    phantom_of_text,
)
from napari_shadowinv.pipeline.experiment_result import (
    ExperimentPlan,
    PlannedShot,
    Spread,
)
from napari_shadowinv.pipeline.experiment_shots import ExperimentInputs, ShotSimulator

SETUP = ProtonSetup.example()
SLOWER = SETUP.model_copy(update={"energy": 6.0})
EXACT = Instrument(beam_rms=0.0)
LIGHT = OpticalSetup(wavelength=5e-7, object_image_distance=0.1, pixel_size=1e-6)
BLANK = PlannedObject(np.zeros((2, 64, 64)), setup=SETUP)


def simulator(
    instrument: Instrument = EXACT,
    *,
    counts: float = 1e9,
    structure: float = 0.0,
    target: PlannedObject | None = None,
    psf: float = 0.0,
    seed: int = 0,
) -> ShotSimulator:
    recipe = ToroidRecipe(peak=30, radius=12e-6)
    target = target or object_of_phantom(recipe, SETUP, (64, 64))
    options = ExperimentOptions(counts=counts, psf=psf, seed=seed)
    if structure:
        changes = {"reference": "recorded", "reference_counts": 1e12, "beam_structure": structure}
        options = options.model_copy(update=changes)
    return ShotSimulator(ExperimentInputs(target, (SETUP,), (64, 64), instrument, options))


def image_of(instrument: Instrument = EXACT, number: int = 0, **choices) -> NDArray[np.float64]:
    return simulator(instrument, **choices).draw(number).images[0] / 1e9


# Objects


def test_a_phantom_keeps_its_field_and_size_in_other_setups_and_pixels():
    target = object_of_phantom(ToroidRecipe(peak=60), SETUP, (120, 120))
    coarse = SETUP.model_copy(update={"pixel_size": 3e-6})
    for setup, side, tolerance in ((SETUP, 120, 2e-4), (coarse, 60, 5e-3)):
        exact = toroid((side, side), setup, 60, 30e-6).displacement
        moved = target.displacement(setup, Grid((side, side)))
        np.testing.assert_allclose(moved, exact, atol=tolerance * np.abs(exact).max())
    field = SLOWER.path_integrated_b(target.displacement(SLOWER, Grid((120, 120))), "MG um")
    assert np.hypot(*field).max() == pytest.approx(60, rel=2e-3)
    # One in pixels is the same in finer ones.
    target = object_of_phantom(BlobRecipe(amplitude=40, sigma=9), None, (64, 64))
    exact = gaussian_blob((64, 64), 40, 9).displacement
    np.testing.assert_allclose(target.displacement(None, Grid((64, 64))), exact, atol=2e-3)


def test_a_saved_result_is_an_object_with_its_setup(tmp_path):
    result = invert(image_of())
    path = tmp_path / "shot.shadowinv"
    write(path, result.in_units(SETUP).to_dataset())
    target = object_of_result(read(path))
    np.testing.assert_allclose(
        target.displacement(SETUP, Grid((64, 64))), result.displacement, atol=1e-9
    )


def bubble(strength: float, length: float = 1.2e-4) -> FieldGrid:
    """Return an azimuthal field about the beam, of a Gaussian ellipsoid."""
    places, depth = np.linspace(-5e-5, 5e-5, 41), np.linspace(-4 * length, 4 * length, 41)
    z, y, x = np.meshgrid(depth, places, places, indexing="ij")
    bell = strength * np.exp(-(x**2 + y**2) / (2 * 1.2e-5**2) - z**2 / (2 * length**2))
    spacing = (depth[1] - depth[0], places[1] - places[0], places[1] - places[0])
    return FieldGrid(np.stack([0 * x, -x * bell, y * bell]), spacing=spacing)


def test_particles_are_traced_through_a_planned_field_in_each_setup():
    target = object_of_field(bubble(2e6, 1e-5), SETUP)
    for setup in (SETUP, SLOWER):
        grid = Grid((60, 60), 2, margin=1)
        half = setup.model_copy(update={"pixel_size": setup.object_pixel_size / 2})
        exact = trace(bubble(2e6, 1e-5), half, grid.sizes).displacement / 2
        np.testing.assert_allclose(target.displacement(setup, grid), exact, atol=1e-12)
    # A thin field is displaced by its line integral.
    line = SETUP.path_integrated_b(target.displacement(SETUP, Grid((60, 60))))
    peak = 2e6 * 1.2e-5 * np.exp(-0.5) * 1e-5 * np.sqrt(2 * np.pi)
    assert np.hypot(*line).max() == pytest.approx(peak, rel=0.02)


def test_a_field_is_planned():
    target = object_of_field(bubble(2e6, 1e-5), SETUP)
    assert target.shape == (66, 66)
    plan = plan_experiment(
        target, SETUP, instrument=EXACT, options=ExperimentOptions(counts=1e5, draws=2)
    )
    assert plan.is_determined
    assert plan.error.median < 0.02
    (assumed,) = [fact.text for fact in plan.facts if fact.key == "assumed"]
    assert "thin" not in assumed


def test_phantoms_are_read_from_texts():
    assert phantom_of_text("toroid:peak=60,radius=2e-5") == ToroidRecipe(peak=60, radius=2e-5)
    assert phantom_of_text("four-toroids") == FourToroidsRecipe()


# Simulated shots


def test_flux_is_conserved_by_an_exact_instrument():
    assert image_of().mean() == pytest.approx(1, abs=1e-3)


def test_a_draw_is_the_same_again_and_others_differ():
    instrument = Instrument(detector="film", beam_source="TNSA")
    first, again = (simulator(instrument, counts=100).draw(3) for _ in range(2))
    np.testing.assert_array_equal(first.images, again.images)
    assert (first.images != simulator(instrument, counts=100).draw(4).images).any()
    assert (first.images != simulator(instrument, counts=100, seed=1).draw(3).images).any()


def test_counts_scatter_as_poisson():
    image = simulator(counts=50, target=BLANK).draw(0).images[0]
    assert image.mean() == pytest.approx(50, rel=0.01)
    assert image.var() == pytest.approx(50, rel=0.1)


def test_the_beam_varies_as_its_prior():
    # A smooth field has an expected r.m.s.; that of a single draw scatters widely about it.
    instrument = Instrument(beam_rms=0.05, beam_length=0.3)
    chosen = simulator(instrument, target=BLANK)
    beams = np.array([chosen.draw(number).images[0] / 1e9 - 1 for number in range(150)])
    assert np.abs(beams.mean(axis=(1, 2))).max() < 1e-3
    assert np.sqrt((beams**2).mean()) == pytest.approx(0.05, rel=0.06)
    assert beams.std(axis=(1, 2)).max() > 2 * beams.std(axis=(1, 2)).min()
    # The mean over the image is taken out of a field with Gaussian correlation.
    apart = np.subtract.outer(np.arange(64), np.arange(64)) / (0.3 * 64)
    variance = 0.05**2 / (1 - np.exp(-(apart**2) / 2).mean() ** 2)
    for lag in (6, 12, 24):
        steps = beams[:, :, lag:] - beams[:, :, :-lag]
        expected = 2 * variance * (1 - np.exp(-((lag / (0.3 * 64)) ** 2) / 2))
        assert (steps**2).mean() == pytest.approx(expected, rel=0.12)


def test_backgrounds_scatter_by_the_stated_share():
    chosen = simulator(Instrument(beam_rms=0.0, background=0.1))
    levels = [chosen.draw(number).images[0].mean() / 1e9 - 1 for number in range(60)]
    assert np.std(levels) == pytest.approx(0.1, rel=0.25)


def test_a_gamma_is_an_exponent():
    exact, image = image_of(), image_of(Instrument(beam_rms=0.0, gamma=0.1))
    ratio = np.log(image) / np.log(exact)
    is_bright = np.abs(np.log(exact)) > 0.05
    assert ratio[is_bright].std() < 0.01
    assert abs(ratio[is_bright].mean() - 1) > 0.001


def test_the_stated_point_spread_adds_to_the_unknown_one():
    # A Gaussian of σ takes exp(-k² σ² / 2) of a wave; variances add.
    x = np.arange(64.0)
    wave = np.cos(2 * np.pi * 8 * (x + 0.5) / 64)
    amplitudes = [float((image_of(psf=psf) * wave).mean()) for psf in (0.0, 2.0)]
    expected = np.exp(-((2 * np.pi * 8 / 64) ** 2) * 4 / 2)
    assert amplitudes[1] / amplitudes[0] == pytest.approx(expected, rel=0.05)


def test_numbers_of_an_imperfection_stay_if_another_changes():
    beam = Instrument(beam_rms=0.05)
    both = Instrument(beam_rms=0.05, background=0.1)
    first, second = (simulator(each, target=BLANK).draw(2).images[0] for each in (beam, both))
    difference = (second - first) / 1e9
    assert difference.std() < 1e-3 < abs(difference.mean())


def test_the_reference_shows_the_structure_out_of_register():
    # A shift by much more than a pixel makes image and reference differ.
    residuals = []
    for registration in (0.0, 3.0):
        instrument = Instrument(beam_rms=0.0, beam_length=0.1, registration=registration)
        shots = simulator(instrument, target=BLANK, structure=0.1).draw(1)
        assert shots.source is not None
        residuals.append(float((shots.images[0] / shots.source - 1).std()))
    assert residuals[0] < 2e-4
    assert residuals[1] > 0.02


# Plans


def small_plan(**choices) -> ExperimentPlan:
    options = ExperimentOptions(**{"counts": 300, "draws": 6, "reference": "none", **choices})
    return plan_experiment(
        BlobRecipe(amplitude=15, sigma=6), shape=(64, 64), instrument=EXACT, options=options
    )


def test_more_counts_lower_the_error_by_their_root():
    few, many = (small_plan(counts=counts, draws=8).error.median for counts in (100, 1600))
    assert few / many == pytest.approx(4, rel=0.25)


def test_the_reported_error_is_the_error_made():
    plan = small_plan(draws=12)
    assert 0.7 < plan.ratio < 1.4


def test_plans_repeat_on_any_number_of_threads():
    first, second = small_plan(threads=1), small_plan(threads=2)
    assert first.shots == second.shots
    assert first.shots != small_plan(seed=1).shots


def test_a_wrong_energy_is_in_the_error_made_and_reported():
    # The field scales with the momentum, by half the error of the energy.
    instrument = Instrument(beam_rms=0.0, energy=0.2)
    plan = plan_experiment(
        ToroidRecipe(peak=20, radius=9e-6),
        SETUP,
        shape=(64, 64),
        instrument=instrument,
        options=ExperimentOptions(counts=1e6, draws=8),
    )
    assert plan.parts["energy"] == pytest.approx(0.1, rel=0.03)
    assert next(iter(plan.parts)) == "energy"
    energies = [np.random.default_rng([0, number, 0]).normal() for number in range(8)]
    errors = [shot.error for shot in plan.shots]
    expected = np.abs((1 + 0.2 * np.array(energies)) ** -0.5 - 1)
    np.testing.assert_allclose(errors, expected, atol=0.02)


def test_two_energies_are_fitted_and_the_searches_are_stated():
    plan = plan_experiment(
        ToroidRecipe(peak=30, radius=9e-6),
        [SETUP, SLOWER],
        shape=(48, 48),
        instrument=EXACT,
        options=ExperimentOptions(draws=3),
    )
    assert plan.method == "fit"
    assert [shot.is_searched for shot in plan.shots] == [True, False, False]
    assert plan.error.median < 0.05
    assert "alternative solutions were not looked for" in plan.shots[1].reason
    assert "1 of 3" in next(fact.text for fact in plan.facts if fact.key == "searched")
    assert not np.isnan([shot.total for shot in plan.shots]).any()


def test_progress_counts_the_draws_until_a_plan_is_stopped():
    steps = []
    few = {"shape": (48, 48), "options": ExperimentOptions(draws=2, threads=1)}
    note = lambda progress: steps.append((progress.step, progress.total))  # noqa: E731
    plan_experiment(BlobRecipe(amplitude=15, sigma=6), on_progress=note, **few)
    assert list(dict.fromkeys(steps)) == [(0, 2), (1, 2), (2, 2)]
    with pytest.raises(InversionCancelled):
        plan_experiment(BlobRecipe(), shape=(64, 64), should_stop=lambda: True)


def planned(target=ToroidRecipe(peak=30), setups=(SETUP,), shape=(64, 64), **choices):  # noqa: B008
    return plan_experiment(target, setups and list(setups), shape=shape, **choices)


COARSE = SLOWER.model_copy(update={"pixel_size": 3e-6})
REFUSED = {
    "two setups are the same": lambda: planned(setups=(SETUP, SETUP)),
    "pixels of 3 µm": lambda: planned(setups=(SETUP, COARSE)),
    "expected height and width of 32 px": lambda: planned(shape=(8, 64)),
    "displaces rays by nothing": lambda: planned(ToroidRecipe(peak=0)),
    "select the setup 'particles'": lambda: planned(setups=None),
    "noise correlation": lambda: planned(instrument=Instrument(noise_correlation=1.0)),
    "expected a phantom or a field": lambda: planned(None),
    "without a setup": lambda: planned(
        object_of_displacement(gaussian_blob((64, 64), 40, 9).displacement)
    ),
    "expected one of charged particles": lambda: object_of_field(bubble(2e6), LIGHT),
    "expected a weaker field": lambda: object_of_field(bubble(1e11, 1e-5), SETUP),
    "did you mean 'toroid'": lambda: phantom_of_text("torroid"),
    "did you mean 'peak'": lambda: phantom_of_text("toroid:peek=60"),
    "expected a name and a number": lambda: phantom_of_text("toroid:peak=strong"),
    "radius .*must be greater than 0": lambda: phantom_of_text("toroid:radius=-1"),
    "counts .*must be greater than 0": lambda: ExperimentOptions(counts=0),
    "one or the other": lambda: ExperimentOptions(psf=1.0, resolution=1e-5),
    "reference": lambda: ExperimentOptions(beam_structure=0.1),
    "at least 2": lambda: ExperimentOptions(draws=1),
}


@pytest.mark.parametrize("words", REFUSED)
def test_a_mistake_is_refused_in_a_sentence(words):
    with pytest.raises(InputError, match=words) as raised:
        REFUSED[words]()
    assert "\n" not in str(raised.value)


# Results


def plan_of(shots: list[PlannedShot], instrument: Instrument = EXACT) -> ExperimentPlan:
    return ExperimentPlan(
        title="an object",
        setups=(),
        shape=(4, 4),
        instrument=instrument,
        options=ExperimentOptions(draws=len(shots)),
        method="inversion",
        shots=tuple(shots),
        images=np.ones((1, 4, 4)),
        truth=np.ones((2, 4, 4)),
        retrieved=np.ones((2, 4, 4)),
        seconds={"shots": 1.0},
    )


def shot(number: int, error: float, total: float = 0.02, **parts: float) -> PlannedShot:
    return PlannedShot(number, Verdict.DETERMINED, "", error, 0.0, total, parts)


def gains_of(shots: list[PlannedShot], instrument: Instrument = EXACT) -> dict[str, float]:
    return {gain.cause: gain.total for gain in plan_of(shots, instrument).gains}


def test_an_interval_holds_two_thirds_of_the_draws():
    spread = Spread.of(list(np.arange(101) / 100))
    assert (spread.median, spread.low, spread.high) == pytest.approx((0.5, 0.16, 0.84))


def test_a_gain_is_that_of_half_a_number_or_twice_the_counts():
    instrument = Instrument(beam_rms=0.0, background=0.04, blur=2.0)
    parts = {"background": 0.03, "blur": 0.04, "noise": 0.0}
    gains = gains_of([shot(k, 0.05, **parts) for k in range(2)], instrument)
    assert gains["background"] == pytest.approx(np.hypot(0.015, 0.04))
    assert gains["blur"] == pytest.approx(np.hypot(0.03, 0.01))
    gains = gains_of([shot(k, 0.05, noise=0.04, background=0.03) for k in range(2)])
    assert gains["noise"] == pytest.approx(np.hypot(0.04 / np.sqrt(2), 0.03))
    # A number that the images determine gains nothing.
    of_beam = shot(0, 0.03, 0.03, background=0.03)
    determined = [replace(of_beam, number=k, scales={"background": 0.01}) for k in range(2)]
    gains = gains_of(determined, Instrument(beam_rms=0.0, background=0.04))
    assert gains == {"background": pytest.approx(0.03, rel=1e-3)}


def test_a_determined_field_that_is_wrong_is_reported():
    plan = plan_of([shot(0, 0.01), shot(1, 0.2)])
    assert plan.silent == 1
    assert not plan.is_determined
    assert "do not rely" in next(fact.text for fact in plan.facts if fact.key == "silent")


def test_tables_have_a_row_for_each_draw():
    plan = plan_of([shot(0, 0.01, noise=0.02), shot(1, 0.2, noise=0.02)])
    first, second = plan.rows()
    assert ",".join(first) == "draw,verdict,error,peak_error,reported_error,searched,part_noise"
    assert (second["draw"], second["verdict"], second["error"]) == (1, "determined", 0.2)


def test_the_limit_by_counts_is_known_before_the_first_shot():
    """The error made is about as large."""
    options = ExperimentOptions(counts=200, draws=4, method="inversion")
    said: list[str] = []
    plan = plan_experiment(
        BlobRecipe(amplitude=10, sigma=9),
        shape=(64, 64),
        instrument=Instrument(beam_rms=0),
        options=options,
        on_progress=lambda progress: said.append(progress.text),
    )
    field = gaussian_blob((64, 64), 10, 9).displacement
    rms = np.sqrt((field**2).sum(axis=0).mean())
    assert plan.limit == pytest.approx(counting_error((64, 64), 200) / rms, rel=1e-3)
    assert f"limit by counts {percent(plan.limit)}" in said[:2]
    assert plan.error.median == pytest.approx(plan.limit, rel=0.2)
