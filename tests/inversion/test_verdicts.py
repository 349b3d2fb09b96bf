"""The verdict on an inversion, and what has to be measured for a better one."""

import dataclasses
import re

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from napari_shadowinv import InversionOptions, invert, synthetic_image
from napari_shadowinv.cautions import CAUTION_CODES, Caution
from napari_shadowinv.facts import Level, Verdict
from napari_shadowinv.inversion.error_budget import ErrorEstimate
from napari_shadowinv.physics.phantoms import gaussian_blob
from napari_shadowinv.physics.setup import ProtonSetup

FEW = InversionOptions(n_sites=900)


@pytest.fixture(scope="module")
def image():
    return synthetic_image(gaussian_blob((60, 72), 30.0, 8.0).displacement)


def stated_deviations(text):
    """Read "the beam known to 0.5 %" of a text as numbers of an `Instrument`."""
    found = re.findall(r"the ([a-z ]+) known to ([\d.e-]+) ?(%?)", text)
    return {name: float(number) / (100 if percent else 1) for name, number, percent in found}


@pytest.mark.parametrize("instrument", [{"beam_rms": 0.03}, {"beam_rms": 0.0, "blur": 3.0}])
def test_measure_next_is_the_total_with_that_instrument(image, instrument):
    first = invert(image, options=FEW, instrument=instrument).errors
    text = first.measure_next(first.share / 2)
    better = stated_deviations(text)
    assert set(better) == {"beam" if instrument["beam_rms"] else "blur"}
    changes = {"beam_rms" if name == "beam" else name: size for name, size in better.items()}
    second = invert(image, options=FEW, instrument=instrument | changes).errors
    assert text.endswith(f" for errors of {second.share_text}")
    assert second.share <= first.share / 2


def test_measure_next_of_noise_is_an_average(image):
    noisy = image + np.random.default_rng(1).normal(0, 0.2, image.shape)
    errors = invert(noisy, source=np.ones(image.shape), options=FEW).errors
    assert errors.limited_by.startswith("noise ")
    shots = int(re.search(r"(\d+) shots averaged", errors.measure_next(errors.share / 2))[1])
    averaged = dataclasses.replace(
        errors, noise=ErrorEstimate(*np.divide(errors.noise, shots**0.5))
    )
    assert averaged.share <= errors.share / 2
    assert errors.measure_next(1.1 * errors.share) == ""


@pytest.mark.parametrize("share_wanted", [0.05, 0.3, 0.45])
def test_measure_next_promises_no_less_than_the_edge_leaves(make_inversion, share_wanted):
    """A better beam uncovers the error at the edge that a worse one hides."""
    solved = make_inversion((48, 64))
    rms = solved.errors.rms
    quiet = dict.fromkeys(("noise", "discretisation"), ErrorEstimate(0.0, 0.0))
    hiding = {"edge": ErrorEstimate(0.4 * rms, 0.0), "beam": ErrorEstimate(0.5 * rms, 0.0)}
    errors = dataclasses.replace(solved.errors, effects={}, beam_variation=0.05, **quiet, **hiding)
    assert "edge" not in errors.parts
    text = errors.measure_next(share_wanted)
    beam = 20 * stated_deviations(text)["beam"]
    better = dataclasses.replace(errors, beam=errors.beam.times(beam))
    if "a larger field" in text:
        assert better.share > share_wanted
        edge = errors.edge.times(share_wanted / 0.4)
        better = dataclasses.replace(better, edge=edge)
    assert better.share <= share_wanted * (1 + 1e-9)
    assert text.endswith(f" for errors of {better.share_text}")


def test_an_edge_that_the_assumed_beam_partly_explains_is_named_once(make_inversion):
    """The error at the edge counts what exceeds the others, with what was assumed among them."""
    solved = make_inversion((48, 64))
    edge = ErrorEstimate(0.5 * solved.errors.rms, 0.0)
    beam = ErrorEstimate(0.3 * solved.errors.rms, 0.0)
    quiet = dict.fromkeys(("noise", "discretisation"), ErrorEstimate(0.0, 0.0))
    errors = dataclasses.replace(solved.errors, edge=edge, beam=beam, effects={}, **quiet)
    assert errors.reason == "limited by edge (errors 50 %)"


def test_the_total_against_the_largest_error_decides_the_verdict(image):
    inversion = invert(image, options=FEW, instrument={"beam_rms": 0.001})
    share = inversion.errors.share
    for factor, verdict in ((1.01, Verdict.DETERMINED), (0.99, Verdict.UNCERTAIN)):
        options = FEW.model_copy(update={"max_error": factor * share})
        again = dataclasses.replace(inversion, options=options)
        assert again.verdict is verdict
        assert again.headline.title == verdict
        assert f"; limited by beam (errors {again.errors.share_text})" in again.headline.text
        assert (again.headline.level is Level.SOUND) == (verdict is Verdict.DETERMINED)


def test_a_beam_that_nobody_measured_is_a_condition_unless_more_is_wrong(image):
    inversion = invert(image, options=FEW)
    errors = inversion.errors
    assert inversion.verdict is Verdict.CONDITIONAL
    headline = inversion.headline
    assert headline.level is Level.CONDITIONAL
    assert headline.level.is_success
    # What it says of an even beam is what an inversion with that beam says.
    stated = re.fullmatch(
        r"peak \|d\| ([\d.]+) ± ([\d.]+) px if the beam is even to ([\d.]+) %; ± ([\d.]+) "
        r"\(field ([\d.]+) %\) if it is 5 % uneven \(assumed\)",
        inversion.in_units(None).assessment.explanation,
    )
    assert "limited by the beam (assumed 5 % uneven): record a reference for ±" in headline.text
    assert f"± {stated[2]}" in headline.text
    assert f"± {stated[4]} px" in headline.text
    peak, if_even, even, if_uneven, share = map(float, stated.groups())
    known = invert(image, options=FEW, instrument={"beam_rms": even / 100})
    assert known.verdict is Verdict.DETERMINED
    assert if_even == pytest.approx(known.errors.total.at_peak, rel=0.05)
    assert if_uneven == pytest.approx(errors.total.at_peak, rel=0.05)
    assert (peak, share / 100) == pytest.approx((errors.peak, errors.share), rel=0.05)
    for fault in ({"beam_rms": 0.05}, {"background": 0.5}):
        assert invert(image, options=FEW, instrument=fault).verdict is Verdict.UNCERTAIN
    assert inversion.with_cautions([Caution("flux", "")]).headline.level is Level.DOUBTFUL


def test_the_error_of_the_energy_counts_for_the_field_alone(image):
    instrument = {"beam_rms": 0.0, "energy": 0.4}
    inversion = invert(image, options=FEW, instrument=instrument)
    assert inversion.in_units(None).assessment.verdict is Verdict.DETERMINED
    assessment = inversion.in_units(ProtonSetup.example()).assessment
    assert assessment.verdict is Verdict.UNCERTAIN
    assert "energy" in assessment.reason
    assert "the energy known to" in assessment.advice


def test_an_error_beyond_proportion_is_said_to_be_rough(image):
    errors = [invert(image, options=FEW, instrument={"beam_rms": rms}) for rms in (0.002, 0.3)]
    assert errors[0].errors.share < 0.5 < errors[1].errors.share
    rows = [dict(each.errors.rows())["errors"] for each in errors]
    assert ["not proportional" in text for text in rows] == [False, True]


def test_errors_of_zero_displacement_are_not_determined():
    inversion = invert(np.ones((32, 32)), options=FEW)
    assert inversion.verdict is Verdict.UNCERTAIN
    assert inversion.errors.measure_next(0.05) == ""


@pytest.mark.parametrize(
    ("code", "verdict"),
    [
        ("misfit", Verdict.MISFIT),
        ("folds", Verdict.AMBIGUOUS),
        ("masked-peak", Verdict.UNCERTAIN),
    ],
)
def test_a_caution_about_the_solution_decides_the_verdict(image, code, verdict):
    inversion = invert(image, source=np.ones(image.shape), options=FEW)
    assert inversion.verdict is Verdict.DETERMINED
    doubtful = inversion.with_cautions([Caution(code, "a sentence")])
    assert doubtful.verdict is verdict
    assert doubtful.to_dataset().attrs["verdict"] == verdict
    assert doubtful.headline.title == verdict
    assert f" px; {CAUTION_CODES[code]}: " in doubtful.headline.text


def test_a_recorded_reference_may_differ_from_the_beam(image):
    speckles = np.exp(gaussian_filter(np.random.default_rng(0).normal(size=image.shape), 1.5))
    recorded = synthetic_image(gaussian_blob(image.shape, 30.0, 8.0).displacement, speckles)
    inversion = invert(recorded, source=speckles, options=FEW)
    assert inversion.verdict is Verdict.CONDITIONAL
    explanation = inversion.in_units(None).assessment.explanation
    (even,) = re.findall(r"if beam and reference agree to ([\d.]+) %", explanation)
    assert "if they differ by 0.5 % (assumed)" in explanation
    options = {"source": speckles, "options": FEW}
    agreeing = invert(recorded, **options, instrument={"beam_rms": float(even) / 100})
    assert agreeing.verdict is Verdict.DETERMINED
    stated = invert(recorded, **options, instrument={"beam_rms": 0.005})
    assert stated.verdict is Verdict.UNCERTAIN
    assert stated.errors.share == pytest.approx(inversion.errors.share)


def test_a_registration_that_nobody_measured_is_a_condition(image):
    """A beam that is smooth along one axis does not show how far its reference was shifted."""
    step = 1 + 0.6 * np.tanh((np.arange(72.0) - 36) / 6) * np.ones((60, 1))
    recorded = synthetic_image(gaussian_blob(step.shape, 12.0, 8.0).displacement, step)
    options = {"source": step, "options": FEW}
    inversion = invert(recorded, **options, instrument={"beam_rms": 0.0})
    assert inversion.verdict is Verdict.CONDITIONAL
    stated = re.fullmatch(
        r"peak \|d\| [\d.]+ ± ([\d.]+) px if beam and reference agree to ([\d.]+) px; ± [\d.]+ "
        r"\(field [\d.]+ %\) if they differ by 0.2 px \(assumed\)",
        inversion.in_units(None).assessment.explanation,
    )
    at_peak, agreement = map(float, stated.groups())
    exact = {"beam_rms": 0.0, "registration": agreement}
    aligned = invert(recorded, **options, instrument=exact)
    assert aligned.verdict is Verdict.DETERMINED
    assert at_peak == pytest.approx(aligned.errors.total.at_peak, rel=0.05)
    stated = invert(recorded, **options, instrument=exact | {"registration": 0.2})
    assert stated.verdict is Verdict.UNCERTAIN
    both = invert(recorded, **options).in_units(None).assessment.explanation
    assert "if they differ by 0.5 % and 0.2 px (assumed)" in both


def test_measured_errors_come_before_those_of_an_assumed_beam(image):
    noisy = image + np.random.default_rng(1).normal(0, 0.2, image.shape)
    inversion = invert(noisy, options=FEW, instrument={"noise_correlation": 0.0})
    exact = invert(noisy, options=FEW, instrument={"noise_correlation": 0.0, "beam_rms": 0.0})
    assert inversion.verdict is Verdict.UNCERTAIN
    assert inversion.errors.reason == (
        f"limited by noise (errors {exact.errors.share_text}) "
        f"and beam (assumed, {inversion.errors.share_text})"
    )
    assert inversion.errors.reason in inversion.headline.text
