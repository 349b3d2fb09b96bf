"""A result describes itself once: its facts, and the faces that render them."""

from __future__ import annotations

import dataclasses
import textwrap
from pathlib import Path

import numpy as np
import pytest

from helpers.fit_images import without_causes
from napari_shadowinv import (
    FitOptions,
    InputError,
    InversionOptions,
    analyse,
    fit,
    invert,
    read,
    synthetic_image,
)
from napari_shadowinv._napari.widgets._panels import fact_rows as window_rows
from napari_shadowinv.cautions import CAUTION_CODES, Caution
from napari_shadowinv.cli._summary import fact_rows as table_rows
from napari_shadowinv.facts import (
    Assessment,
    Headline,
    Level,
    Verdict,
    percent,
    to_figures,
    with_error,
)
from napari_shadowinv.physics.phantoms import gaussian_blob
from napari_shadowinv.physics.setup import ProtonSetup
from napari_shadowinv.physics.units import shown_fields
from napari_shadowinv.shot import Shot, shots_of


@pytest.fixture(scope="module")
def image():
    clean = synthetic_image(gaussian_blob((48, 56), 20.0, 8.0).displacement)
    return clean + np.random.default_rng(0).normal(0, 0.01, clean.shape)


@pytest.fixture(scope="module")
def inversion(image):
    return invert(image, options=InversionOptions(n_sites=400))


@pytest.fixture(scope="module")
def hasty(image):
    """A fit of one image that has hardly begun."""
    options = FitOptions(samples=0, max_iterations=2, spacing=0.25)
    with without_causes():
        return fit(shots_of([image], noise=0.01), options=options)


@pytest.fixture(scope="module")
def fitted(image):
    """A fit of two images, with samples."""
    options = FitOptions(samples=3, max_iterations=20, spacing=0.25)
    shots = shots_of([image, image[::-1]], strength=[1, 0.8], noise=0.01)
    with without_causes():
        return fit(shots, options=options)


@pytest.fixture(scope="module")
def results(image, inversion, hasty):
    """One of each kind; the second has many cautions with characters that mean something."""
    doubtful = inversion.with_cautions(
        Caution("other", f"doubt {number} of <script> & co, {'very ' * 60}long")
        for number in range(9)
    )
    radiograph = Shot(image, path=Path("<b>.tif"), mask=image > 0)
    return [inversion, doubtful, hasty, radiograph, *analyse(inversion, ["contrast"])]


@pytest.mark.parametrize(
    ("value", "error", "written"),
    [
        (0.0312, 0.0, "0.0312"),
        (14.2, 1.42, "14.2 ± 1.4"),
        (5.0, 150.0, "5 ± 150"),
        (9.6e-7, 3.3e-4, "(0.0 ± 3.3) × 10⁻⁴"),
        (3.21e7, 4e5, "(3.210 ± 0.040) × 10⁷"),
    ],
)
def test_a_number_has_the_figures_that_its_error_allows(value, error, written):
    assert with_error(value, error) == written


@pytest.mark.parametrize(
    ("value", "written"),
    [
        (99.4, "99"),
        (99.6, "100"),
        (136.0, "136"),
        (9.97, "10"),
        (0.012, "0.012"),
        (9.9999e-7, "1 × 10⁻⁶"),
        (-2.5e7, "-2.5 × 10⁷"),
        (0.0, "0"),
        (np.inf, "inf"),
        (np.nan, "nan"),
    ],
)
def test_two_figures_never_end_in_an_exponent_of_a_program(value, written):
    assert to_figures(value) == written
    share = "below 0.01" if 0 < value < 0.01 else written
    assert percent(value / 100) == f"{share} %"


def test_errors_without_a_displacement_have_their_length():
    texts = texts_by_key(invert(np.full((32, 32), 7.0)).facts)
    assert texts["errors"].startswith("0.")
    assert " px (r.m.s.)" in texts["errors"]
    assert texts["error_limited_by"].startswith("beam 0.")
    assert "%" not in texts["errors"] + texts["error_limited_by"].partition("(5 %")[0]


def test_a_result_prints_a_few_lines_and_no_array(results):
    for result in results:
        lines = repr(result).splitlines()
        assert lines[0].startswith(type(result).__name__)
        assert len(lines) <= 6
        assert max(map(len, lines)) <= 160
        assert "array" not in repr(result)
        if hasattr(result, "headline"):
            assert lines[1] == textwrap.shorten(str(result.headline), 160, placeholder=" …")
    assert "more" not in repr(results[0])
    assert repr(results[1]).endswith("and 6 more")


@pytest.mark.parametrize("function", [invert, fit])
def test_a_file_or_its_content_is_no_image_yet(function, image, tmp_path):
    file = tmp_path / "shot.npy"
    np.save(file, image)
    for path in (file, str(file)):
        with pytest.raises(InputError, match=r"is the file .*shot.npy.*read\(.*\)\.image"):
            function(path)
    if function is invert:
        with pytest.raises(InputError, match=r"source is a Shot, .* give its \.image"):
            function(image, source=read(file))
        with pytest.raises(InputError, match=r"image is a Shot, .* give its \.image"):
            function(read(file))


def texts_by_key(facts):
    return {fact.key: fact.text for fact in facts}


def test_facts_give_the_numbers_of_the_report_and_the_field_in_its_unit(inversion):
    texts = texts_by_key(inversion.facts)
    report = inversion.report
    assert texts["image_residual"].startswith(percent(report.image_residual))
    assert texts["sites"].startswith("400; ")
    assert f"{np.hypot(*inversion.displacement).max():.1f}" in texts["displacement"]
    assert texts["caustics"] == "0 % of the pixels"
    assert texts["time"].startswith(f"{sum(report.seconds.values()):.2f} s")
    assert "field" not in texts
    setup = ProtonSetup.example()
    field = texts_by_key(inversion.in_units(setup).facts)["field"]
    strength = setup.field_in_si("path_integrated_b", inversion.displacement)
    assert f"{1e3 * np.hypot(*strength).max():.3g}" in field
    assert "mT·m" in field


def test_a_caution_is_a_doubtful_fact_and_lack_of_convergence_a_failed_one(image, inversion):
    doubtful = inversion.with_cautions([Caution("beam", "the beam differs")])
    (fact,) = [fact for fact in doubtful.facts if fact.key == "beam" and fact.title == "Warning"]
    assert (fact.text, fact.level) == ("the beam differs", Level.DOUBTFUL)
    failed = invert(image, options=InversionOptions(n_sites=400, max_iterations=1))
    levels = {fact.key: fact.level for fact in failed.facts}
    assert levels["flux_residual"] is Level.FAILED
    assert levels["image_residual"] is Level.SOUND


def test_every_face_shows_the_same_texts(inversion):
    table = dict(table_rows(inversion.facts, details=True))
    assert inversion.verdict not in table.values()  # it is in the line above
    window = window_rows(inversion.facts) + window_rows(inversion.facts, details=True)
    assert {name.lower(): text for name, text in window} == table


def test_facts_of_a_fit_name_images_fields_and_the_verdict(fitted):
    facts = fitted.facts_with_names(["first.tif", "second.tif"])
    texts = texts_by_key(facts)
    assert texts["image_2"].startswith("second.tif, χ² ")
    assert "strength 0.8" in texts["image_2"]
    errors = fitted.fields[0].errors
    assert errors.peak == np.hypot(*fitted.fields[0].displacement).max()
    peak = with_error(errors.peak, errors.total.at_peak)
    assert texts["field_B"].startswith(f"peak |d| {peak} px")
    assert texts["verdict"] == fitted.verdict
    assert {fact.level for fact in facts if fact.key == "verdict"} == {Level.DOUBTFUL}


def test_the_title_of_a_headline_is_one_word_for_trust(hasty):
    titles = {
        (Verdict.DETERMINED, Level.SOUND): "determined",
        (Verdict.DETERMINED, Level.DOUBTFUL): "determined, with warnings",
        (Verdict.CONDITIONAL, Level.CONDITIONAL): "depends on the beam",
        (Verdict.EDGE, Level.DOUBTFUL): "reaches the edge",
        (Verdict.UNCERTAIN, Level.FAILED): "failed",
        (None, Level.SOUND): "sound",
    }
    for (verdict, level), title in titles.items():
        assert Headline(level, "9 T", verdict).title == title
    doubted = Headline(Level.DOUBTFUL, "9 T", Verdict.DETERMINED)
    assert str(doubted) == "Determined, with warnings: 9 T"
    # That of a fit begins with its peaks.
    (shown,) = shown_fields([hasty.fields[0].displacement], None, mask=hasty.used)
    assert hasty.headline.text.startswith(f"peak |d| {shown.largest:.3g} px; ")
    assert hasty.assessment.short in hasty.headline.text


def test_a_headline_and_a_report_are_short_and_a_report_repeats_nothing(inversion, fitted):
    words = ("peak |∫B×dz| 9.734 ± 0.077 mT·m", "peak |∫E dz| (1.34 ± 0.12) × 10⁻⁴ MV")
    long = Assessment(Verdict.UNCERTAIN, "a reason of six words, say", "advice " * 9)
    doubts = [Caution(code, "a sentence") for code in CAUTION_CODES]
    for peaks in (words[:1], words):
        for assessment in (long, Assessment(Verdict.DETERMINED, "limited by noise")):
            headline = Headline.of(peaks, assessment, doubts)
            assert len(headline.text.split()) <= Headline.MOST_WORDS
            assert headline.text.startswith(f"{'; '.join(peaks)}; {assessment.reason}")
    for facts in (inversion.facts, inversion.in_units(ProtonSetup.example()).facts, fitted.facts):
        rows = table_rows(facts)
        assert 4 <= len(rows) <= 6, "and the setup"
        texts = [text for _, text in rows]
        assert not [text for text in texts if sum(text in other for other in texts) > 1]


def test_each_fitted_field_has_its_significance(fitted):
    (fact,) = [fact for fact in fitted.facts if fact.key == "significance_B"]
    structures = fitted.structures(fitted.fields[0])
    assert fact.text.startswith(f"{len(structures.peaks)} structure")
    causes = "beam assumed, 5 %; noise; assumed background, 5 %; assumed gamma, 0.05"
    assert f"up to {structures.peaks[0]:.3g} σ (σ by {causes})" in fact.text
    assert dict(table_rows(fitted.facts, details=True))["significance B"] == fact.text
    assert dict(window_rows(fitted.facts, details=True))["Significance B"] == fact.text
    field = dataclasses.replace(fitted.fields[0], errors=None)
    assert "significance_B" not in texts_by_key(dataclasses.replace(fitted, fields=(field,)).facts)
