from __future__ import annotations

import dataclasses
import json
import threading
from pathlib import Path

import numpy as np
import pytest
from scipy import ndimage

from helpers.pages import run_python, text_of
from napari_shadowinv import (
    InputError,
    InversionOptions,
    OpticalSetup,
    ProtonSetup,
    invert,
    read,
    synthetic_image,
    write,
)
from napari_shadowinv.errors import InversionCancelled
from napari_shadowinv.geometry.interpolation import WIDTH
from napari_shadowinv.inversion import ErrorSamples, Inversion, plan_sites, resampling, samples
from napari_shadowinv.physics.phantoms import gaussian_blob
from napari_shadowinv.physics.poisson import border_mean

SHAPE = (40, 48)
COUNTS = 20.0
OPTIONS = InversionOptions(negative="clip")
IN_COUNTS = InversionOptions(units_per_quantum=1.0)


@pytest.fixture(scope="module")
def phantom():
    return gaussian_blob(SHAPE, 12.0, (3.5, 5.0), (19.3, 24.8), 0.4)


@pytest.fixture(scope="module")
def clean(phantom):
    return synthetic_image(phantom.displacement)


@pytest.fixture(scope="module")
def plan():
    return plan_sites(np.ones(SHAPE), OPTIONS)


@pytest.fixture(scope="module")
def counts(clean):
    return np.random.default_rng(5).poisson(200 * clean)


def samples_of(
    image, n, *, noise="poisson", method="linear", quantities=None, on_progress=None, **given
) -> ErrorSamples:
    """Samples of the noise alone of an image."""
    inversion = invert(image, **given)
    sampled = inversion.uncertainty(
        n,
        noise=noise,
        noise_only=True,
        method=method,
        quantities=quantities,
        on_progress=on_progress,
    )
    assert sampled.errors is not None
    assert sampled.errors.samples is not None
    return sampled.errors.samples


def poisson_shot(clean, rng):
    return rng.poisson(COUNTS * clean)


def gaussian_shot(clean, rng):
    return clean + 0.15 * rng.normal(size=clean.shape)


@pytest.mark.parametrize(
    ("shot", "noise"),
    [(poisson_shot, "poisson"), (gaussian_shot, 0.15)],
    ids=["Poisson", "Gaussian"],
)
def test_error_bars_of_one_shot_are_the_scatter_of_many(phantom, clean, plan, shot, noise):
    """And about two thirds of them hold the truth, as one standard deviation should."""
    rng = np.random.default_rng(11)
    shots = [shot(clean, rng) for _ in range(30)]
    inversions = [invert(noisy, plan=plan, options=OPTIONS) for noisy in shots]
    true = phantom.potential - border_mean(phantom.potential)
    potentials = [inversion.potential for inversion in inversions]
    displacements = [inversion.displacement for inversion in inversions]
    for method, n in (("linear", 200), ("resolve", 20)):
        result = samples_of(shots[0], n, plan=plan, noise=noise, method=method, options=OPTIONS)
        for std, fields, truth in (
            (result.potential_std, potentials, true),
            (result.displacement_std, displacements, phantom.displacement),
        ):
            assert np.median(std / np.std(fields, axis=0, ddof=1)) == pytest.approx(1, abs=0.25)
            covered = np.mean([np.abs(field - truth) < std for field in fields])
            assert covered == pytest.approx(0.683, abs=0.08)


def test_error_bars_of_correlated_noise_are_the_scatter_of_many():
    clean = synthetic_image(gaussian_blob((96, 100), 30.0, 12.0, (45.0, 52.0)).displacement)
    sites = plan_sites(np.ones(clean.shape), InversionOptions(n_sites=2400))
    rng = np.random.default_rng(4)

    def shot():
        noise = ndimage.gaussian_filter(rng.normal(size=clean.shape), 1.2, mode="wrap")
        return clean + 0.03 * noise / noise.std()

    result = samples_of(shot(), 60, plan=sites, noise=0.03, options=OPTIONS)
    assert "correlated over 1." in result.noise
    displacements = [invert(shot(), plan=sites, options=OPTIONS).displacement for _ in range(20)]
    ratio = result.displacement_std / np.std(displacements, axis=0, ddof=1)
    # Without correlation, they would be four times as small.
    assert np.median(ratio) == pytest.approx(1, abs=0.35)


@pytest.mark.parametrize("method", ["linear", "resolve"])
def test_error_bars_hold_what_lies_beyond_the_edge(method):
    shape = (64, 64)
    whole = gaussian_blob((64, 96), 60.0, 9.0, (30.0, 36.0)).displacement
    image = np.random.default_rng(2).poisson(1000 * synthetic_image(whole))[:, 32:]
    truth = whole[:, :, 32:]
    inversion = invert(image, source=np.full(shape, 1000.0), options=InversionOptions(n_sites=1000))
    peak = {"peak": lambda _, displacement: np.hypot(*displacement).max()}
    errors = inversion.uncertainty(
        24, noise="poisson", noise_only=True, method=method, quantities=peak
    ).errors
    result, std = errors.samples, errors.per_pixel
    assert errors.causes == ("noise", "edge")
    total = float(np.sqrt((std**2).sum(axis=0).mean()))
    assert total == pytest.approx(errors.total.rms, rel=0.1)
    assert np.median(np.abs(inversion.displacement - truth) / std) == pytest.approx(0.7, abs=0.4)
    assert result.quantities["peak"].std > 0.05 * np.hypot(*truth).max()


def test_gain_says_how_many_units_a_quantum_makes(counts, plan):
    as_counts = samples_of(counts, 3, plan=plan)
    as_units = samples_of(
        8.0 * counts, 3, plan=plan, options=InversionOptions(units_per_quantum=8.0)
    )
    np.testing.assert_allclose(as_units.displacement_std, as_counts.displacement_std, rtol=1e-6)
    mistaken = samples_of(8.0 * counts, 3, plan=plan)
    ratio = mistaken.displacement_std / as_counts.displacement_std
    assert np.median(ratio) == pytest.approx(8**-0.5, rel=0.25)


def test_an_array_gives_each_pixel_its_own_noise(clean, plan):
    everywhere = np.full(SHAPE, 0.05)
    by_array = samples_of(clean, 3, plan=plan, noise=everywhere, options=OPTIONS)
    by_number = samples_of(clean, 3, plan=plan, noise=0.05, options=OPTIONS)
    np.testing.assert_array_equal(by_array.potential_std, by_number.potential_std)
    right_only = np.where(np.arange(SHAPE[1]) < 24, 0.0, everywhere)
    lopsided = samples_of(clean, 3, plan=plan, noise=right_only, options=OPTIONS)
    noiseless, noisy = lopsided.displacement_std[:, :, :16], lopsided.displacement_std[:, :, 32:]
    assert np.median(noiseless) < 0.5 * np.median(noisy)


def test_solving_samples_loosely_does_not_change_the_error_bars(monkeypatch, clean, plan):
    choices = {"plan": plan, "noise": 0.2, "method": "resolve"}
    loose = samples_of(clean, 6, **choices, options=OPTIONS)
    monkeypatch.setattr(samples, "_SAMPLE_SHARE", 0.0)
    strict = OPTIONS.model_copy(update={"tolerance": 1e-6})
    exact = samples_of(clean, 6, **choices, options=strict)
    assert loose.tolerance > 1e-3 > exact.tolerance
    assert sum(loose.iterations) < sum(exact.iterations)
    for name in ("potential_std", "displacement_std"):
        ratio = getattr(loose, name) / getattr(exact, name)
        assert np.median(ratio) == pytest.approx(1, abs=4e-3)
        assert np.percentile(np.abs(ratio - 1), 99) < 0.03


def test_samples_start_from_the_images_weights(counts, plan):
    result = samples_of(counts, 5, plan=plan)
    assert all(result.converged)
    assert max(result.iterations) < invert(counts, plan=plan).report.iterations


@pytest.mark.parametrize(("n_sites", "nonlinearity"), [(SHAPE[0] * SHAPE[1], 0.05), (None, 0.13)])
def test_the_linear_response_to_little_noise_is_that_of_solving_again(clean, n_sites, nonlinearity):
    """But for the finest waves, where the cells are pixels with slopes inside."""
    options = OPTIONS.model_copy(update={"tolerance": 1e-7, "n_sites": n_sites})
    choices = {"noise": 0.005, "options": options}
    linear = samples_of(clean, 5, **choices)
    solved = samples_of(clean, 5, **choices, method="resolve")
    assert linear.linearity.nonlinearity < nonlinearity
    assert solved.linearity is None
    for name in ("potential_std", "displacement_std"):
        linear_bars, solved_bars = getattr(linear, name), getattr(solved, name)
        assert np.linalg.norm(linear_bars - solved_bars) < nonlinearity * np.linalg.norm(
            solved_bars
        )


def test_samples_that_do_not_converge_are_counted(clean):
    options = InversionOptions(max_iterations=1, negative="clip")
    inversion = dataclasses.replace(invert(clean), options=options)
    result = inversion.uncertainty(2, noise=0.5)
    assert result.errors.samples.converged == (False, False)
    assert "2 of 2 samples that were solved" in str(result.cautions)
    with pytest.raises(InputError, match="the inversion did not converge"):
        invert(clean, options=options).uncertainty(2)


def test_progress_comes_from_the_callers_thread_and_counts_the_samples(counts):
    steps, threads = [], set()

    def listen(progress):
        steps.append(progress)
        threads.add(threading.get_ident())

    samples_of(counts, 3, on_progress=listen)
    assert {progress.stage for progress in steps} == {"samples"}
    assert threads == {threading.get_ident()}
    assert (steps[-1].step, steps[-1].total) == (3, 3)


def test_cancelling_among_the_samples_ends_them(counts, plan):
    steps = []

    def listen(progress):
        if progress.stage == "samples":
            steps.append(progress.step)

    with pytest.raises(InversionCancelled, match="samples"):
        invert(counts, plan=plan).uncertainty(
            500, on_progress=listen, should_stop=lambda: max(steps, default=0) > 1
        )
    assert max(steps) == WIDTH  # samples of a block are done together


def test_cancelling_while_samples_are_prepared_waits_for_nothing(monkeypatch, counts, plan):
    begun, go_on, inversion = threading.Event(), threading.Event(), invert(counts, plan=plan)

    def prepared(*_):
        begun.set()
        assert go_on.wait(60)

    monkeypatch.setattr(resampling, "LinearResampling", prepared)
    with pytest.raises(InversionCancelled, match="samples"):
        inversion.uncertainty(3, should_stop=begun.is_set)
    assert not go_on.is_set()
    go_on.set()


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ({"n": 1}, "n is 1, expected a whole number of samples, at least 2"),
        ({"n": 2.5}, "n is 2.5, expected a whole number"),
        ({"noise": "gauss"}, "noise is 'gauss', expected 'poisson', a standard deviation"),
        ({"noise": 0.0}, "noise is zero everywhere"),
        ({"noise": -1.0}, "negative or not finite"),
        ({"noise": np.full(SHAPE, np.nan)}, "negative or not finite"),
        ({"noise": np.ones((3, 4))}, r"noise has shape \(3, 4\), image \(40, 48\)"),
        ({"noise": 1.0, "options": IN_COUNTS}, "1 units per quantum and noise is a standard"),
        ({"options": {"units_per_quantum": 1e-30}}, "more than 1e\\+18 quanta in a pixel"),
    ],
)
def test_bad_arguments_are_one_clear_sentence(counts, arguments, says):
    with pytest.raises(InputError, match=says):
        samples_of(counts, **{"n": 2, **arguments})


def test_an_image_that_is_not_counts_needs_a_gain(clean):
    with pytest.raises(InputError, match=r"not whole numbers.*give the image units per"):
        samples_of(clean, 2)


@pytest.fixture(scope="module")
def sampled(counts, plan):
    return invert(counts, plan=plan).uncertainty(3, noise="poisson", noise_only=True)


def test_dataset_has_a_deviation_beside_each_field(
    sampled, proton_setup: ProtonSetup, optical_setup: OpticalSetup
):
    result = sampled.errors.samples
    for setup in (None, proton_setup, optical_setup):
        dataset = sampled.in_units(setup).to_dataset()
        plain = dataclasses.replace(sampled, errors=None)
        fields = set(plain.in_units(setup).to_dataset().data_vars)
        np.testing.assert_array_equal(dataset["potential_std"], result.potential_std)
        np.testing.assert_array_equal(dataset["displacement_mean"], result.displacement_mean)
        deviations = {str(name) for name in dataset.data_vars if str(name).endswith("_std")}
        assert {name.removesuffix("_std") for name in deviations} < fields
        for name in deviations:
            field = dataset[name.removesuffix("_std")]
            assert dataset[name].attrs["units"] == field.attrs["units"]
            assert "standard deviation" in dataset[name].attrs["long_name"]
            assert dataset[name].dims == field.dims
            assert (dataset[name] >= 0).all()
    assert "line_integrated_density_std" in dataset
    assert json.loads(dataset.attrs["uncertainty"])["n"] == 3


def test_deviations_of_si_fields_belong_to_their_components(sampled, proton_setup: ProtonSetup):
    """Protons deflected along y have met a field along x."""
    dataset = sampled.in_units(proton_setup).to_dataset()
    of_one_pixel = np.abs(proton_setup.path_integrated_b(np.array([1.0, 0.0])[:, None, None]))
    along_x = float(of_one_pixel[1, 0, 0])
    np.testing.assert_allclose(
        dataset["path_integrated_b_std"], along_x * sampled.errors.per_pixel[::-1], rtol=1e-12
    )


def test_significance_is_a_fact_also_of_the_file(tmp_path: Path, sampled):
    (fact,) = [fact for fact in sampled.facts if fact.key == "significance"]
    assert "above 2 σ" in fact.text
    assert "(σ by noise)" in fact.text
    path = write(tmp_path / "shot.shadowinv", sampled)
    dataset = read(path)
    np.testing.assert_array_equal(dataset["displacement_std"], sampled.errors.per_pixel)
    assert json.loads(dataset.attrs["uncertainty"])["noise"] == "Poisson, 1 per quantum"
    restored = Inversion.from_dataset(dataset)
    assert restored.errors is not None
    np.testing.assert_array_equal(restored.errors.per_pixel, sampled.errors.per_pixel)
    assert fact in restored.facts
    write(path, restored, overwrite=True)
    assert fact in Inversion.from_dataset(read(path)).facts


def test_a_damaged_standard_deviation_is_refused(sampled):
    dataset = sampled.to_dataset()
    dataset["displacement_std"] = dataset["displacement_std"].isel(component=0, drop=True)
    with pytest.raises(InputError, match="displacement_std has shape"):
        Inversion.from_dataset(dataset)


def test_the_page_about_error_bars_works_as_it_stands_there(tmp_path: Path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    names = run_python(text_of("docs/uncertainty.md"))
    assert (tmp_path / "shot.shadowinv").exists()
    middle = names["samples"].potential_std[24:40, 24:40]
    assert 0.3 * middle.mean() < names["error_bar"] < 1.5 * middle.mean()


def test_quantities_may_depend_on_the_first_samples() -> None:
    counts = np.random.default_rng(1).poisson(400, (24, 24))
    spreads: list[float] = []

    def choose(changes: np.ndarray) -> dict[str, object]:
        assert changes.shape[1:] == (24, 24)
        spreads.append(float(changes.std()))
        return {"middle": lambda potential, displacement: potential[12, 12] / spreads[0]}

    for method in ("linear", "resolve"):
        chosen = samples_of(counts, n=20, method=method, quantities=choose)
        middle = {"middle": lambda potential, displacement: potential[12, 12]}
        fixed = samples_of(counts, n=20, method=method, quantities=middle)
        np.testing.assert_allclose(
            chosen.quantities["middle"].samples * spreads.pop(), fixed.quantities["middle"].samples
        )
        assert spreads == []
