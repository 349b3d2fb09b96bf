"""Each verdict, from what it follows."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from napari_shadowinv._typing import BoolArray, FloatArray
from napari_shadowinv.facts import Assessment, Headline, Verdict
from napari_shadowinv.fitting.pattern import Pattern
from napari_shadowinv.fitting.posterior import BeamError
from napari_shadowinv.fitting.result import Basin, Fit, FitReport, FittedField
from napari_shadowinv.fitting.verdict import Evidence, assess_verdict
from napari_shadowinv.options import FitOptions, Instrument


def blob(middle: tuple[int, int]) -> FloatArray:
    """Displacement of a Gaussian potential in 48 × 48 px, 1 px at most."""
    y, x = np.indices((48, 48))
    v, u = (y - middle[0]) / 6, (x - middle[1]) / 6
    return np.exp(0.5 - (v**2 + u**2) / 2) * np.stack([v, u])


SIDES = "left", "right"
GOOD: dict[str, Any] = {
    "chi2": np.array([0.97, 1.04]),
    "rivals": [],
    "single": False,
    "beam_unknown": False,
    "jacobian": np.ones((48, 48)),
    "total": 0.02,
    "ended": True,
    "pattern": Pattern(np.array([-1.0, 1.0])),
    "beam": None,
    "displacement": blob((24, 24)),
    "used": np.ones((48, 48), bool),
    "hidden": 0.0,
    "parts": {"noise": 0.02},
    "options": FitOptions(max_error=0.05),
    "instrument": Instrument(),
}


CUT: dict[str, Any] = {"parts": {"edge": 0.3, "noise": 0.02}, "total": 0.3}


def assess(
    *,
    total: float,
    ended: bool,
    beam: BeamError | None,
    parts: dict[str, float],
    chi2: FloatArray,
    rivals: list[tuple[float, float]],
    displacement: FloatArray,
    used: BoolArray,
    options: FitOptions,
    instrument: Instrument,
    **facts: Any,
) -> tuple[Verdict, str]:
    """Return the verdict on a fit with these errors and other facts.

    `rivals` are other answers: how much worse their objective is, as a share, and how far away.
    """
    solutions = [(0.0, 0.0), *rivals]
    mask = np.tile(used, (len(chi2), 1, 1))
    planes, of_each = np.zeros(mask.shape), np.ones(len(chi2))
    errors = np.full(displacement.shape, 0.02)
    fit = Fit(
        images=planes,
        mask=mask,
        strengths=of_each[:, None],
        fields=(FittedField("B", planes[0], displacement, errors, (1.0, 1.0)),),
        source=planes,
        brightness=of_each,
        frames=np.zeros((len(chi2), 6)),
        reprojection=planes,
        residual=planes,
        chi2=chi2,
        noise=of_each,
        basins=tuple(Basin("", 1 + worse, 1.0, away, planes) for worse, away in solutions),
        folded=0.0,
        assessment=Assessment(Verdict.UNCERTAIN, ""),
        report=FitReport(
            0.0,
            1,
            ended,
            {},
            total,
            beam=beam,
            parts=parts,
            sides=SIDES,
            beam_rms=0.05,
            numbers={key: [[0.0, 0.01]] for key in parts if instrument.has_numbers},
        ),
        options=options,
        instrument=instrument,
    )
    answer = assess_verdict(Evidence(fit, **facts))
    headline = Headline.of(["peak |∫B×dz| 9.734 ± 0.077 mT·m"], answer)
    assert answer.short in headline.text, "reason and advice have room beside a peak"
    return answer.verdict, answer.explanation


ALONE = {
    "chi2": np.array([1.0]),
    "single": True,
    "pattern": Pattern(np.array([-1.0])),
}


@pytest.mark.parametrize(
    ("part", "side", "safety"),
    [("background", 80, 1), ("beam", 80, 1), ("gamma", 80, 2), ("blur", 80, 2), ("beam", 79, 2)],
)
def test_errors_that_are_underestimated_need_a_margin(part: str, side: int, safety: float) -> None:
    for factor, expected in ((0.9, Verdict.DETERMINED), (1.1, Verdict.UNCERTAIN)):
        share = factor * 0.05 / safety
        displacement = np.pad(blob((24, 24)), ((0, 0), (20, side - 68), (20, 28)))
        used = np.ones((side, 96), bool)
        changes = {"displacement": displacement, "used": used}
        changes |= {"total": share, "parts": {part: share}}
        changes |= {"instrument": Instrument(beam_rms=0.01)}
        verdict, why = assess(**GOOD | changes)
        assert verdict is expected
        if expected is Verdict.UNCERTAIN and safety > 1:
            assert f"{safety} times as large" in why


def test_images_that_are_explained_in_one_way_determine_the_field() -> None:
    verdict, why = assess(**GOOD)
    assert verdict is Verdict.DETERMINED
    assert "2 images" in why
    assert "0.97 to 1.04" in why


@pytest.mark.parametrize(
    ("chi2", "expected"),
    [(0.6, Verdict.DETERMINED), (0.3, Verdict.DETERMINED), (1.4, Verdict.MISFIT)],
)
def test_only_too_much_residual_is_a_misfit(chi2: float, expected: Verdict) -> None:
    verdict, why = assess(**GOOD | {"chi2": np.array([chi2, 1.0])})
    assert verdict is expected
    assert ("noise is stated too large (image 1: χ² 0.3" in why) == (chi2 < 0.4)


@pytest.mark.parametrize(
    ("share", "expected"), [(0.04, Verdict.DETERMINED), (0.1, Verdict.UNCERTAIN)]
)
def test_counts_with_too_little_noise_have_a_dark_level(share: float, expected: Verdict) -> None:
    pattern = Pattern(np.array([-1.0, 1.0]), missing_counts=share, counts_deviation=0.005)
    verdict, why = assess(**GOOD | {"pattern": pattern})
    assert verdict is expected
    assert ("a dark level of about 10 %" in why) == (share > 0.05)


def test_a_cause_that_wins_is_a_misfit_without_a_pattern() -> None:
    pattern = Pattern(np.array([-1.0, 1.0]), cause="blur: give the point spread", tried="blur")
    verdict, why = assess(**GOOD | {"pattern": pattern})
    assert verdict is Verdict.MISFIT
    assert "give the point spread" in why
    undecided = replace(pattern, cause="")
    assert assess(**GOOD | {"pattern": undecided})[0] is Verdict.DETERMINED


def test_a_misfit_without_a_cause_lists_what_was_tried() -> None:
    pattern = Pattern(np.array([0.5, 40.0]), tried="a dark level, blur")
    verdict, why = assess(**GOOD | {"pattern": pattern})
    assert verdict is Verdict.MISFIT
    assert "not explained by a dark level, blur" in why


@pytest.mark.parametrize(
    ("strength", "cause", "expected"),
    [
        (3.0, "", Verdict.DETERMINED),
        (4.5, "", Verdict.DETERMINED),
        (6.6, "", Verdict.MISFIT),
        (6.6, "the beam differs", Verdict.MISFIT),
        (40.0, "", Verdict.MISFIT),
    ],
)
def test_verdict_names_a_residual_that_is_no_noise(
    strength: float, cause: str, expected: Verdict
) -> None:
    pattern = Pattern(np.array([0.5, strength]), cause=cause)
    verdict, why = assess(**GOOD | {"pattern": pattern})
    assert verdict is expected
    if expected is Verdict.MISFIT:
        assert f"image 2: {strength:.0f} " in why
        assert "image 1" not in why
        assert (cause or "dark level") in why


def test_verdict_takes_a_misfit_of_a_cut_object_for_the_edge() -> None:
    verdict, why = assess(**GOOD | CUT | {"chi2": np.array([1.6, 1.0])})
    assert verdict is Verdict.EDGE
    assert "larger field of view" in why
    assert "image 1: χ² 1.6" in why


def test_verdict_takes_a_pattern_of_a_cut_object_for_the_edge() -> None:
    cut = CUT | {"pattern": Pattern(np.array([0.0, 40.0]))}
    verdict, why = assess(**GOOD | cut)
    assert verdict is Verdict.EDGE
    assert "larger field of view" in why
    assert "no noise" in why


@pytest.mark.parametrize(("hidden", "expected"), [(0.3, "determined"), (0.8, "too uncertain")])
def test_verdict_names_a_mask_over_the_strongest_structure(hidden: float, expected: str) -> None:
    verdict, why = assess(**GOOD | {"hidden": hidden})
    assert verdict == expected
    assert ("mask hides" in why) == (hidden > 0.5)


def of_assumed_beam(noise: float, share: float) -> dict[str, Any]:
    beam = BeamError(sensitivity=0.1, variation=0.05, share=share, scale=0.25, assumed=True)
    parts = {"beam": share, "noise": noise}
    return {"beam": beam, "total": float(np.hypot(noise, share)), "parts": parts}


@pytest.mark.parametrize(
    ("share", "expected"), [(0.03, Verdict.DETERMINED), (0.2, Verdict.CONDITIONAL)]
)
def test_a_beam_that_was_assumed_is_a_condition(share: float, expected: Verdict) -> None:
    verdict, why = assess(**GOOD | of_assumed_beam(0.02, share))
    assert verdict is expected
    if share > 0.05:
        # 1 % × √(0.05² - 0.02²) / 0.1, and √(0.02² + 0.2²)
        assert why.startswith("peak |d| 1.000")
        assert "if the beam is even to 0.4 %; ± 0.02 (field 20 %) if it is 5 % uneven" in why


def test_a_detector_that_was_assumed_is_a_condition() -> None:
    parts = {"background": 0.08, "gamma": 0.06, "noise": 0.03}
    errors = {"parts": parts, "total": float(np.hypot(0.1, 0.03))}
    verdict, why = assess(**GOOD | errors)
    assert verdict is Verdict.DETECTOR
    # 0.4 = √(0.05² - 0.03²) / 0.1
    assert "if the detector is exact to 2 % of background and 0.02 of gamma; " in why
    assert "(field 10 %) if it is off by 5 % of background and 0.05 of gamma (assumed)" in why
    stated = {"instrument": Instrument(background=0.08, gamma=0.06)}
    assert assess(**GOOD | errors | stated)[0] is Verdict.UNCERTAIN


def test_beam_and_detector_that_were_assumed_are_one_condition() -> None:
    both = of_assumed_beam(0.02, 0.2)
    both |= {"parts": both["parts"] | {"gamma": 0.06}, "total": float(np.hypot(0.2, 0.0632))}
    verdict, why = assess(**GOOD | both)
    assert verdict is Verdict.CONDITIONAL
    assert "if they are off by 5 % and 0.05 of gamma (assumed)" in why


@pytest.mark.parametrize(
    "fault",
    [
        {"hidden": 0.8},
        of_assumed_beam(0.06, 0.2),
        {"ended": False},
        {"pattern": Pattern(np.array([9.0, 1.0]))},
        {"parts": {"edge": 0.5, "beam": 0.2, "noise": 0.02}, "total": 0.54},
        {"parts": {"edge": 0.2, "beam": 0.2, "noise": 0.02}, "total": 0.28},
    ],
)
def test_an_assumed_beam_excuses_no_other_fault(fault: dict[str, Any]) -> None:
    verdict, _ = assess(**GOOD | of_assumed_beam(0.02, 0.2) | fault)
    assert not verdict.level.is_success


def test_a_beam_that_was_assumed_is_a_condition_of_a_fit_with_other_numbers() -> None:
    of_beam: dict[str, Any] = {"total": 0.1, "parts": {"beam": 0.09, "gamma": 0.04}}
    film = Instrument(gamma=0.03)
    big: dict[str, Any] = {"displacement": np.pad(blob((24, 24)), ((0, 0), (20, 20), (20, 20)))}
    big |= {"used": np.ones((88, 88), bool)}
    stated = {"instrument": Instrument(beam_rms=0.05)}
    assert assess(**GOOD | big | of_beam | stated)[0] is Verdict.UNCERTAIN
    assert assess(**GOOD | big | of_beam | {"instrument": film})[0] is Verdict.UNCERTAIN  # doubled
    of_beam["parts"] = {"beam": 0.09, "background": 0.04}
    film = Instrument(background=0.03)
    assert assess(**GOOD | big | of_beam | {"instrument": film})[0] is Verdict.CONDITIONAL


def test_deep_folds_of_several_images_need_no_caution() -> None:
    """The error bars hold there what they hold elsewhere."""
    deep = {"jacobian": np.where(np.hypot(*blob((24, 24))) > 0.5, -0.5, 1.0)}
    for beam_unknown in (False, True):
        verdict, why = assess(**GOOD | deep | {"beam_unknown": beam_unknown})
        assert verdict is Verdict.DETERMINED
        assert why.endswith("(χ² 0.97 to 1.04)")


def test_verdict_says_how_correlated_noise_widens_the_bars() -> None:
    verdict, why = assess(**GOOD | {"pattern": Pattern(np.array([0.0, 0.0]), correlation=1.0)})
    assert verdict is Verdict.DETERMINED
    assert "correlated over 1.0 px" in why
    assert "3.5 times" in why


def test_unknown_error_bars_do_not_speak_against_a_field() -> None:
    verdict, why = assess(**GOOD | {"total": float("nan")})
    assert verdict is Verdict.DETERMINED
    assert "error bars were not" in why


@pytest.mark.parametrize(
    ("edge", "noise", "expected"),
    [
        (0.04, 0.01, Verdict.DETERMINED),
        (0.10, 0.01, Verdict.EDGE),
        (0.10, 0.08, Verdict.UNCERTAIN),  # noise moves a field at the edge, too
    ],
)
def test_what_lies_beyond_the_edge_is_told(edge: float, noise: float, expected: Verdict) -> None:
    errors = {"parts": {"edge": edge, "noise": noise}, "total": float(np.hypot(edge, noise))}
    verdict, why = assess(**GOOD | errors)
    assert verdict is expected
    assert ("beyond the left and right edges" in why) == (expected is Verdict.EDGE)


def test_a_search_that_was_cut_short_determines_nothing() -> None:
    verdict, why = assess(**GOOD | {"ended": False})
    assert verdict is Verdict.UNCERTAIN
    assert "allow more" in why


def test_rays_that_one_image_has_lost_leave_it_open() -> None:
    away = {"displacement": 12 * blob((24, 40))}
    verdict, why = assess(**GOOD | ALONE | away)
    assert verdict is Verdict.AMBIGUOUS
    assert "miss the image" in why
    assert assess(**GOOD | away | CUT)[0] is Verdict.EDGE


def test_an_unknown_beam_is_determined_by_several_images() -> None:
    assert assess(**GOOD | {"beam_unknown": True})[0] is Verdict.DETERMINED


def test_an_image_that_is_not_explained_is_named() -> None:
    verdict, why = assess(**GOOD | {"chi2": np.array([1.1, 4.23])})
    assert verdict is Verdict.MISFIT
    assert "image 2: χ² 4.2" in why
    assert "image 1" not in why
    assert "between images" in why
    _, alone = assess(**GOOD | ALONE | {"chi2": np.array([1.8])})
    assert "between images" not in alone


def test_one_image_does_not_tell_an_unknown_beam() -> None:
    verdict, why = assess(**GOOD | ALONE | {"beam_unknown": True})
    assert verdict is Verdict.AMBIGUOUS
    assert "beam" in why


@pytest.mark.parametrize("around", [0, 60])
@pytest.mark.parametrize("value", [0.1, -0.8])
@pytest.mark.parametrize(("share", "expected"), [(0.01, "determined"), (0.05, "one image")])
def test_one_image_does_not_tell_where_rays_meet_or_cross(
    around: int, value: float, share: float, expected: str
) -> None:
    """However large the field of view is."""
    displacement = np.pad(blob((24, 24)), ((0, 0), (around, around), (around, around)))
    of_object = np.argwhere(np.hypot(*displacement) > 0.1)
    jacobian = np.ones(displacement.shape[1:])
    for place in of_object[: round(share * len(of_object))]:
        jacobian[tuple(place)] = value
    used = np.ones(displacement.shape[1:], bool)
    changes = {"jacobian": jacobian, "displacement": displacement, "used": used}
    verdict, why = assess(**GOOD | ALONE | changes)
    assert verdict.startswith(expected)
    assert ("5 % of the object" in why) == (share > 0.02)
    assert assess(**GOOD | changes)[0] is Verdict.DETERMINED  # several images tell


def test_several_fields_that_explain_as_well_are_told() -> None:
    solutions = [(0.01, 0.2), (0.02, 0.31), (0.005, 0.01), (0.5, 0.9)]
    verdict, why = assess(**GOOD | {"rivals": solutions})
    assert verdict is Verdict.SEVERAL
    assert why.startswith("3 fields, up to 31 % apart")  # one is the same, one explains worse


def test_fields_that_differ_within_the_stated_error_are_one_answer() -> None:
    open_by_noise = GOOD | {"total": 0.12, "parts": {"noise": 0.12}}
    verdict, why = assess(**open_by_noise | {"rivals": [(0.0, 0.2)]})
    assert verdict is Verdict.UNCERTAIN
    assert why.startswith("limited by noise (errors 12 %)")
    assert assess(**open_by_noise | {"rivals": [(0.0, 0.3)]})[0] is Verdict.SEVERAL


@pytest.mark.parametrize("other", [(0.5, 0.9), (0.0, 0.01)])
def test_other_fields_do_not_matter_if_they_are_worse_or_the_same(
    other: tuple[float, float],
) -> None:
    assert assess(**GOOD | {"rivals": [other]})[0] is Verdict.DETERMINED


def test_noise_that_leaves_much_open_is_told() -> None:
    verdict, why = assess(**GOOD | {"total": 0.12, "parts": {"noise": 0.12}})
    assert verdict is Verdict.UNCERTAIN
    assert "(errors 12 %)" in why


def test_the_gravest_doubt_comes_first() -> None:
    """Images that are not explained, then one image, then other fields, then noise."""
    all_of_them = GOOD | ALONE | {"beam_unknown": True, "rivals": [(0.0, 1.5)], "total": 0.5}
    assert assess(**all_of_them | {"chi2": np.array([9.0])})[0] is Verdict.MISFIT
    assert assess(**all_of_them)[0] is Verdict.AMBIGUOUS
    assert assess(**all_of_them | {"beam_unknown": False})[0] is Verdict.SEVERAL
    assert assess(**all_of_them | {"beam_unknown": False, "rivals": []})[0] is Verdict.UNCERTAIN
