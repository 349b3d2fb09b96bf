"""Tests of one static field by a recipe: order, windows, refused input."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest

from napari_shadowinv import FitOptions, InputError, ProtonSetup, fit
from napari_shadowinv._typing import FloatArray
from napari_shadowinv.facts import Level, Verdict
from napari_shadowinv.fitting import Fit, FitShot, FitWindows
from napari_shadowinv.fitting.windows import window_facts
from napari_shadowinv.io import read, write
from napari_shadowinv.options import FitChoices
from napari_shadowinv.physics.forward import synthetic_image
from napari_shadowinv.physics.phantoms import gaussian_blob
from napari_shadowinv.pipeline import run_leave_one_out, run_windows
from napari_shadowinv.preprocessing import Recipe

SHAPE = (56, 64)
NOISE = 0.02
LENGTHS = {"source_object_distance": 0.01, "object_image_distance": 0.3, "pixel_size": 1e-5}
SETUPS = [ProtonSetup(energy=energy, **LENGTHS) for energy in (5, 7, 10, 14, 20)]
STRENGTHS = [SETUPS[0].momentum / setup.momentum for setup in SETUPS]
TRUTH = gaussian_blob(SHAPE, 40.0, 8.0, (28, 33)).displacement
FACTORS = (1.0, 1.0, 1.0, 1.25, 1.25)
HASTY = FitOptions(samples=0, max_iterations=3, spacing=0.5)
PLAIN = FitOptions(samples=0, spacing=0.2)
RECIPE = Recipe(fit=FitChoices(noise=NOISE, options=PLAIN))

ONE = np.ones((1, 1))


def shots_of(factors: tuple[float, ...], **changes: Any) -> list[FitShot]:
    noise = np.random.default_rng(5).normal(0, NOISE, (5, *SHAPE))
    return [
        FitShot(synthetic_image(factor * strength * TRUTH) + plane, setup, **changes)
        for factor, strength, setup, plane in zip(factors, STRENGTHS, SETUPS, noise, strict=False)
    ]


def share(displacement: FloatArray) -> float:
    """How strong a field is, relative to the object."""
    return float((displacement * TRUTH).sum() / (TRUTH**2).sum())


@pytest.fixture(scope="module")
def windows() -> FitWindows:
    return run_windows(RECIPE, shots_of(FACTORS), 2)


def test_windows_follow_the_strength_of_the_object(windows: FitWindows) -> None:
    assert windows.numbers == ((0, 1), (1, 2), (2, 3), (3, 4))
    shares = [share(displacement) for displacement in windows.displacement[:, 0]]
    assert shares[0] == pytest.approx(1, rel=0.02)
    assert shares[1] == pytest.approx(1, rel=0.02)
    assert shares[3] == pytest.approx(1.25, rel=0.02)
    # One field for both sides of the change explains neither.
    assert 1 < shares[2] < 1.25
    assert windows.fits[2].verdict is Verdict.MISFIT
    assert [fit.verdict for fit in windows.fits].count(Verdict.DETERMINED) == 3
    for window in (0, 1, 3):
        np.testing.assert_allclose(windows.fits[window].chi2, 1, atol=0.1)


def test_a_window_is_the_fit_of_its_images(windows: FitWindows) -> None:
    images = np.stack([np.asarray(shot.image) for shot in shots_of(FACTORS)[1:3]])
    alone = fit(images, setups=SETUPS[1:3], noise=NOISE, options=PLAIN)
    np.testing.assert_array_equal(
        windows.fits[1].fields[0].displacement, alone.fields[0].displacement
    )
    provenance = windows.fits[1].provenance
    assert provenance is not None
    assert [image.setup for image in provenance.images] == SETUPS[1:3]


def test_windows_are_one_dataset_against_energy_and_time(windows: FitWindows) -> None:
    dataset = windows.to_dataset()
    assert dataset["displacement"].dims == ("window", "component", "y", "x")
    np.testing.assert_array_equal(dataset["displacement"], windows.displacement[:, 0])
    np.testing.assert_allclose(dataset["energy"], [6, 8.5, 12, 17])
    # A proton of 6 MeV has 11.3 % of the velocity of light.
    gamma = 1 + 6 / 938.272
    velocity = 299_792_458 * np.sqrt(1 - gamma**-2)
    assert float(dataset["time_of_flight"][0]) == pytest.approx(0.01 / velocity, rel=1e-6)
    assert dataset["time_of_flight"].attrs["units"] == "s"
    expected = SETUPS[0].path_integrated_b(windows.displacement[:, 0].swapaxes(0, 1))
    np.testing.assert_allclose(dataset["path_integrated_b"], expected.swapaxes(0, 1))
    np.testing.assert_array_equal(dataset["image_number"][2], [3, 4])
    assert str(dataset["verdict"].values[2]) == "does not fit"
    # A field at the strength of its own window is the same in SI units.
    own_field = SETUPS[2].path_integrated_b(windows.fits[2].fields[0].displacement)
    np.testing.assert_allclose(dataset["path_integrated_b"][2], own_field, rtol=1e-9)


def test_windows_are_kept_in_the_file_of_a_fit(tmp_path: Any, windows: FitWindows) -> None:
    first_fit = windows.fits[0]
    write(tmp_path / "fit.shadowinv", windows.added_to(first_fit.to_dataset()))
    dataset = read(tmp_path / "fit.shadowinv")
    again = Fit.from_dataset(dataset)  # type: ignore[arg-type]
    np.testing.assert_array_equal(again.fields[0].displacement, first_fit.fields[0].displacement)
    content = windows.to_dataset()
    for name in ("displacement", "path_integrated_b", "chi2", "explanation", "energy"):
        np.testing.assert_array_equal(dataset[f"window_{name}"], content[name])  # type: ignore[index]
    # The images of this file are those of the first window.
    first = dataclasses.replace(windows, numbers=((0, 1),), fits=(first_fit,), strengths=ONE)
    facts = window_facts(first.added_to(first_fit.to_dataset()))
    assert facts == first.facts
    assert [fact.key for fact in windows.facts] == [f"window_{w}" for w in range(1, 5)]
    assert windows.facts[2].level is Level.DOUBTFUL
    assert windows.facts[1].text.startswith("images 2, 3, mean energy ")


def test_nothing_depends_on_the_order_of_images_or_on_threads() -> None:
    shots, order = shots_of(FACTORS)[1:4], [2, 0, 1]
    recipes = [
        Recipe(fit=FitChoices(noise=NOISE, options=HASTY.model_copy(update={"threads": threads})))
        for threads in (1, 2)
    ]
    calls = list(zip(recipes, (shots, [shots[k] for k in order]), strict=True))
    first, second = (run_leave_one_out(*each) for each in calls)
    assert second.explanation == first.explanation
    for name in ("predicted", "residual", "chi2", "alone", "limit", "rms", "brightness"):
        np.testing.assert_array_equal(getattr(second, name), getattr(first, name)[order])
    film, again = (run_windows(*each, 2) for each in calls)
    np.testing.assert_array_equal(film.displacement, again.displacement)
    assert (film.numbers, again.numbers) == (((0, 1), (1, 2)), ((1, 2), (2, 0)))


def test_strengths_take_the_place_of_energies() -> None:
    shots = [
        FitShot(shot.image, strength=(strength,))
        for shot, strength in zip(shots_of(FACTORS), STRENGTHS, strict=True)
    ]
    result = run_windows(Recipe(fit=FitChoices(options=HASTY)), shots[::-1][:3], 2)
    assert result.numbers == ((2, 1), (1, 0))
    assert result.beam_means is None
    dataset = result.to_dataset()
    assert not {"energy", "time_of_flight"} & set(dataset.coords)
    third, fourth, fifth = np.array(STRENGTHS[2:]) / STRENGTHS[2]
    np.testing.assert_allclose(dataset["strength"], [(third + fourth) / 2, (fourth + fifth) / 2])


@pytest.mark.parametrize(
    ("count", "size", "told"),
    [
        (3, 4, "received 3 images and windows of 4: expected windows of 1 to 3 images"),
        (3, 0, "windows of 0"),
    ],
)
def test_windows_that_do_not_exist_are_refused(count: int, size: int, told: str) -> None:
    with pytest.raises(InputError, match=told):
        run_windows(RECIPE, shots_of(FACTORS)[:count], size)


def test_leave_one_out_refuses_too_few_or_unordered_images() -> None:
    with pytest.raises(InputError, match="received 2 images: leaving one out needs 3"):
        run_leave_one_out(RECIPE, shots_of(FACTORS)[:2])
    bare = [FitShot(shot.image) for shot in shots_of(FACTORS)]
    for run in (run_leave_one_out, lambda *given: run_windows(*given, 2)):
        with pytest.raises(InputError, match="neither strengths nor setups"):
            run(RECIPE, bare)
