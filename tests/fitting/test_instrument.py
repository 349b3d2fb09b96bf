"""An instrument that is not exact is fitted together with the fields, or enters their errors."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from helpers.fit_images import (
    bump,
    counted,
    distance,
    fit_images,
    noisy,
    on_pixels,
    without_causes,
)
from napari_shadowinv import Instrument, ProtonSetup
from napari_shadowinv._typing import FloatArray
from napari_shadowinv.facts import Verdict, percent
from napari_shadowinv.fitting import Fit
from napari_shadowinv.fitting.descent import coarser
from napari_shadowinv.fitting.instrument import Imperfect, imperfect_instrument, number_text
from napari_shadowinv.fitting.measurements import collect_data
from napari_shadowinv.fitting.posterior import Posterior
from napari_shadowinv.instrument.shapes import Shapes
from napari_shadowinv.options import BeamPrior, FitOptions
from napari_shadowinv.shot import shots_of

pytestmark = pytest.mark.usefixtures("no_causes")

SIZE = (40, 48)
STRENGTHS = [1, 0.6]
NOISE = 0.03
RING = bump(3.0, 4.6, (19, 25), tall=1.2)
FEW = FitOptions(samples=4, max_iterations=20, spacing=0.25, threads=1)
BARE = FEW.model_copy(update={"samples": 0})
HASTY = FEW.model_copy(update={"samples": 2, "max_iterations": 5})
EXACT_BEAM = {"beam_rms": 0.0}


@cache
def clean_images(blur: float = 0.0) -> FloatArray:
    return np.stack(
        [counted(lambda y, x, a=a: a * RING(y, x), SIZE, blur=blur, margin=12) for a in STRENGTHS]
    )


def shots(background: float = 0.0, gamma: float = 0.0, blur: float = 0.0) -> FloatArray:
    recorded = clean_images(blur) ** (1 + gamma)
    return noisy(list((1 - background) * recorded + background), NOISE)


def fitted(images: FloatArray, instrument: Instrument | None, **keywords: object) -> Fit:
    choices = {"strength": STRENGTHS, "noise": NOISE, "options": FEW} | keywords
    return fit_images(images, instrument=instrument, **choices)


@pytest.fixture(scope="module")
def plain() -> Fit:
    """Fit of images of a perfect instrument, which is taken for perfect."""
    with without_causes():
        return fitted(shots(), Instrument(**EXACT_BEAM))


@pytest.fixture(scope="module")
def assumed() -> Fit:
    """Fit of the same images with the usual assumption of a beam."""
    with without_causes():
        return fitted(shots(), Instrument(), options=HASTY)


@pytest.fixture(scope="module")
def unsure() -> Fit:
    """Fit of the same images, which may have a background of 5 %."""
    with without_causes():
        return fitted(shots(), Instrument(**EXACT_BEAM, background=0.05), options=FEW)


def error(result: Fit) -> float:
    return distance(result.fields[0].displacement, on_pixels(RING, SIZE))


@pytest.mark.parametrize(
    ("imperfection", "instrument", "key"),
    [
        ({"background": 0.15}, {"background": 0.1}, "background"),
        ({"gamma": -0.15}, {"gamma": 0.1}, "gamma"),
    ],
)
def test_two_energies_determine_what_is_stated(
    imperfection: dict[str, float], instrument: dict[str, float], key: str
) -> None:
    images = shots(**imperfection)
    blind = fitted(images, Instrument(**EXACT_BEAM), options=BARE)
    aware = fitted(images, Instrument(**EXACT_BEAM, **instrument))
    assert error(aware) < 0.5 * error(blind)
    assert error(aware) < 0.05
    for value, deviation in aware.report.numbers[key]:
        assert abs(value - imperfection[key]) < max(4 * deviation, 0.02)
    assert (aware.chi2 < blind.chi2).all()
    assert aware.total_error > aware.errors.shares["noise"] > 0


def test_a_point_spread_wider_than_stated_is_found() -> None:
    images = shots(blur=1.6)
    aware = fitted(images, Instrument(**EXACT_BEAM, blur=1.3), psf=1.0)
    ((variance, deviation),) = aware.report.numbers["blur"]
    assert abs(variance - (1.6**2 - 1)) < max(4 * deviation, 0.3)
    blind = fitted(images, Instrument(**EXACT_BEAM), psf=1.0, options=BARE)
    assert error(aware) < 0.05 < error(blind)


def test_an_instrument_without_numbers_changes_no_bit(assumed: Fit) -> None:
    other = fitted(shots(), Instrument(energy=0.05), options=HASTY)
    np.testing.assert_array_equal(other.fields[0].displacement, assumed.fields[0].displacement)
    assert (other.verdict, other.total_error) == (assumed.verdict, assumed.total_error)


def test_a_detector_of_which_nothing_is_stated_is_in_the_error() -> None:
    """Unfolded images of a dark level of 10 % are explained by a field that is as much too weak."""
    weak = bump(0.4, 6.6, (19, 25))
    clean = np.stack([counted(lambda y, x, a=a: a * weak(y, x), SIZE) for a in STRENGTHS])
    images = noisy(list(0.9 * clean + 0.1), NOISE)
    keywords = {"source": np.ones(SIZE)}
    blind = fitted(images, None, **keywords)
    off = distance(blind.fields[0].displacement, on_pixels(weak, SIZE))
    assert blind.total_error > off / 3 > blind.errors.shares["noise"]
    assert blind.errors.shares.keys() >= {"background", "gamma"}
    stated = fitted(images, Instrument(**EXACT_BEAM), **keywords)
    counts = fitted(np.round(1000 * images), None, source=np.full(SIZE, 1000), noise="poisson")
    for result in (stated, counts):
        assert not {"background", "gamma"} & result.errors.shares.keys()


def test_one_image_keeps_its_field_and_gets_larger_errors() -> None:
    """It cannot tell the instrument from the object."""
    image = shots()[1]
    source = np.ones(SIZE)
    keywords = {"strength": None, "source": source}
    exact = fitted(image, Instrument(), **keywords)
    unsure = fitted(image, Instrument(beam_rms=0.05, background=0.1), **keywords)
    np.testing.assert_array_equal(unsure.fields[0].displacement, exact.fields[0].displacement)
    assert unsure.verdict is Verdict.UNCERTAIN
    assert "beam" in unsure.errors.ranking
    # A beam 1 % off would move the field by so much; the instrument's numbers stay as stated.
    by_percent = exact.errors.beam_sensitivity.rms / exact.errors.rms
    assert unsure.errors.shares["beam"] == pytest.approx(5 * by_percent, rel=0.5)
    ((value, deviation),) = unsure.report.numbers["background"]
    assert value == 0
    assert 0.03 < deviation < 0.3


@pytest.mark.parametrize("instrument", [{"beam_rms": 0.05}, {**EXACT_BEAM, "absorption": 0.05}])
def test_the_mean_of_an_inexact_beam_is_not_known(instrument: dict[str, float]) -> None:
    """Images 2 % brighter than their source would pass for another field."""
    keywords = {"source": np.ones(SIZE), "options": BARE}
    fields = [
        fitted(factor * shots(), Instrument(**instrument), **keywords).fields[0].displacement
        for factor in (1.0, 1.02)
    ]
    assert distance(fields[1], fields[0]) < 0.01


def test_errors_have_a_part_for_all_that_is_stated() -> None:
    instrument = Instrument(beam_rms=0.02, beam_length=1.0, background=0.02)
    result = fitted(shots(), instrument, options=HASTY)
    parts = result.errors.shares
    assert parts.keys() - {"edge"} == {"noise", "beam", "background"}
    assert list(parts.values()) == sorted(parts.values(), reverse=True)
    facts = {fact.title: fact.text for fact in result.facts}
    assert facts["Errors"].startswith(f"{percent(result.total_error)} of the displacement")
    assert all(title in facts["Limited by"] for title in ("noise", "beam", "background"))
    assert "background" in facts["Instrument"]
    restored = Fit.from_dataset(result.to_dataset())
    assert restored.errors.shares == parts
    assert restored.report.numbers == result.report.numbers


def test_samples_to_first_order_are_compared_with_fitted_ones(unsure: Fit) -> None:
    """A background of 5 % acts almost linearly; what does not is reported with its remedy."""
    linearity = unsure.report.linearity
    assert 0 < linearity.nonlinearity < 0.3
    assert linearity.spread_ratio == pytest.approx(1, abs=0.15)
    assert not any(caution.code == "samples" for caution in unsure.cautions)
    assert Fit.from_dataset(unsure.to_dataset()).report.linearity == linearity

    skewed = replace(unsure.report, linearity=replace(linearity, nonlinearity=0.6))
    (caution,) = (c for c in replace(unsure, report=skewed).cautions if c.code == "samples")
    assert "differ from solved ones by 60 % of their change" in caution.text
    assert "measure the instrument" in caution.text


def test_energy_adds_to_the_errors_of_fields_in_si_units_alone() -> None:
    setups = [
        ProtonSetup(
            energy=energy, source_object_distance=0.01, object_image_distance=0.2, pixel_size=1e-5
        )
        for energy in (3.0, 8.0)
    ]
    images = noisy([counted(lambda y, x, a=a: a * RING(y, x), SIZE) for a in (1, 0.61)], NOISE)
    keywords = {"strength": None, "setup": setups, "options": HASTY}
    result = fitted(images, Instrument(energy=0.1), **keywords)
    (field,) = result.fields
    in_pixels, in_si = (result.peak_error(field, setup) for setup in (None, setups[0]))
    assert in_pixels is not None
    assert in_si is not None
    # ∫B dz is proportional to the momentum, nearly the root of the energy.
    assert in_si.share == pytest.approx(np.hypot(in_pixels.share, 0.05), rel=0.01)
    assert in_si.cause == "energy, 10 %"
    assert "energy" not in in_pixels.cause
    assert Fit.from_dataset(result.to_dataset()).instrument == result.instrument


def test_stated_correlation_of_noise_widens_the_errors(assumed: Fit) -> None:
    correlated = fitted(shots(), Instrument(noise_correlation=1.0), options=HASTY)
    by_noise = [result.errors.shares["noise"] for result in (correlated, assumed)]
    assert by_noise[0] == pytest.approx(np.sqrt(4 * np.pi) * by_noise[1])


def test_each_fit_states_its_sensitivities(plain: Fit, unsure: Fit) -> None:
    """By as much as fits of changed images move."""
    names = {name.partition(",")[0] for name in plain.errors.sensitivities}
    assert names == {"gamma", "blur", "background", "absorption"}
    with_background = fitted(shots(background=0.05), Instrument(**EXACT_BEAM), options=BARE)
    moved = with_background.fields[0].displacement - plain.fields[0].displacement
    size = np.sqrt((moved**2).mean() / (plain.fields[0].displacement ** 2).mean())
    stated = plain.errors.sensitivities["background, 5 %"].rms / plain.errors.rms
    assert stated == pytest.approx(size, rel=0.35)
    text = {fact.title: fact.text for fact in plain.facts}["Sensitivity"]
    assert "(background, 5 %)" in text
    assert "background" not in {fact.title: fact.text for fact in unsure.facts}["Sensitivity"]


def test_effects_of_noise_and_instrument_add_to_each_sample() -> None:
    data = collect_data(
        shots_of(shots(), strength=STRENGTHS, noise=NOISE),
        instrument=Instrument(beam_rms=0.05, background=0.1, gamma=0.1),
        options=FEW.model_copy(update={"smoothness": 100.0}),
    )
    scene = coarser(data.scene, 2)
    posterior = Posterior(scene, scene.nothing(), np.random.default_rng(0))
    sample = posterior.draw_samples(1)[0]
    [effects] = posterior.effects([sample])
    assert effects.keys() == {"noise", "gamma", "background", "beam"}
    total = sum(effect.potentials for effect in effects.values())
    np.testing.assert_allclose(total, sample.change.potentials, atol=1e-12)
    assert not any(effect.common.any() for key, effect in effects.items() if key != "noise")


def test_beams_are_fitted_as_uneven_as_is_assumed_of_their_source() -> None:
    speckled = 1 + 0.1 * np.random.default_rng(0).random(SIZE)
    for source, rms in ((None, 0.05), (speckled, 0.005), (np.ones(SIZE), 0.0)):
        known = {"strength": STRENGTHS, "noise": NOISE, "source": source}
        data = collect_data(shots_of(shots(), **known), options=FEW)
        assert data.beam.rms == rms
        assert [*data.scene.imperfect.parts] == ["beam"] * (rms > 0)
        assert data.common


# Numbers and their effects


def test_what_a_detector_adds_is_taken_from_its_beam() -> None:
    imperfect = Imperfect({"gamma": 0.1, "background": 0.05})
    common, separate = np.array([2.0]), np.array([3.0])
    light = np.linspace(0.5, 2, 12).reshape(3, 4)
    recorded = light**1.2 + 0.15
    np.testing.assert_allclose(imperfect.entering(recorded, common, separate)[0], light)


def test_numbers_keep_their_places_in_larger_pixels() -> None:
    shapes = np.random.default_rng(1).random((3, 8, 8))
    fine = Imperfect(
        {"gamma": 0.1, "background": 0.1}, blur=4.0, shapes=(Shapes.of_planes("beam", shapes),)
    )
    coarse = fine.coarsen(2)
    assert coarse.parts == fine.parts
    assert fine.counts == (5, 1)
    assert coarse.blur == 1.0
    (part,) = coarse.shapes
    np.testing.assert_allclose(part.planes.mean(axis=(1, 2)), shapes.mean(axis=(1, 2)))


def test_beams_vary_as_far_as_stated() -> None:
    used = np.ones((40, 52), bool)
    imperfect = imperfect_instrument(
        Instrument(),
        BeamPrior(rms=0.04, length=0.3, between=0.02),
        np.ones((2, 40, 52)),
        used,
        ((4, 4), (4, 6)),
        is_common=True,
        other_strengths=None,
    )
    for shapes, rms in zip(imperfect.shapes, (0.04, 0.02), strict=True):
        planes = np.stack([shapes.sum(unit) for unit in np.eye(len(shapes))])
        inside = planes[:, 4:-4, 4:-6]
        assert np.sqrt((inside**2).sum(axis=0).mean()) == pytest.approx(rms, rel=0.01)
        np.testing.assert_allclose(inside.mean(axis=(1, 2)), 0, atol=1e-12)


def test_numbers_are_written_with_the_digits_of_their_errors() -> None:
    assert number_text("gamma", [[-0.1034, 0.0123]]) == "gamma 0.897 ± 0.012"
    assert (
        number_text("background", [[0.1, 0.004], [0.02, 0.03]])
        == "background 10.00 ± 0.40, 2.0 ± 3.0 %"
    )
    assert number_text("blur", [[2.76, 0.31]]) == "variance of the point spread +2.76 ± 0.31 px²"
