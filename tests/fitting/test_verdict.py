"""Each verdict, from what it follows."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from napari_shadowinv._typing import BoolArray, FloatArray
from napari_shadowinv.facts import Assessment, Headline, Verdict
from napari_shadowinv.fitting.pattern import Pattern
from napari_shadowinv.fitting.result import Basin, Fit, FitReport, FittedField
from napari_shadowinv.fitting.verdict import Evidence, assess_verdict, hidden_contrast
from napari_shadowinv.instrument.effects import EFFECTS
from napari_shadowinv.inversion.error_budget import ErrorBudget, ErrorEstimate
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
    "is_fitted": True,
    "displacement": blob((24, 24)),
    "used": np.ones((48, 48), bool),
    "hidden": 0.0,
    "parts": {"noise": 0.02},
    "options": FitOptions(max_error=0.05),
    "instrument": Instrument(),
}


CUT: dict[str, Any] = {"parts": {"edge": 0.3, "noise": 0.02}, "total": 0.3}


def budget_of(
    total: float, parts: dict[str, float], instrument: Instrument, *, is_fitted: bool
) -> ErrorBudget | None:
    """The budget of these shares, a tenth as large at the peak; None for a total of NaN.

    A beam that is not fitted moves the displacement by a tenth for each per cent.
    """
    if np.isnan(total):
        return None
    estimates = {key: ErrorEstimate(share, share / 10) for key, share in parts.items()}
    noise, edge, beam = (estimates.pop(key, None) for key in ("noise", "edge", "beam"))
    names = {each.key: each.name(each.tested) for each in EFFECTS}
    effects = {names[key]: estimate for key, estimate in estimates.items()}
    return ErrorBudget(
        1.0,
        1.0,
        noise or ErrorEstimate(0.0, 0.0),
        effects,
        edge=edge and ErrorEstimate(total, total / 10),
        sides=SIDES,
        beam=beam,
        beam_sensitivity=None if is_fitted else ErrorEstimate(0.1, 0.01),
        sizes={each.name(each.tested): each.tested for each in EFFECTS},
        beam_variation=0.05,
        beam_basis="assumed" if instrument.beam_rms is None else "stated",
        assumed=() if instrument.has_numbers else tuple(effects),
        sampled=ErrorEstimate(total, total / 10),
    )


def assess(
    *,
    total: float,
    ended: bool,
    is_fitted: bool,
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
    errors = budget_of(total, parts, instrument, is_fitted=is_fitted)
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


def patterned(strength: float = 0.0, **changes: Any) -> dict[str, Any]:
    return {"pattern": Pattern(np.array([0.0, strength]), **changes)}


def with_errors(**parts: float) -> dict[str, Any]:
    return {"parts": parts, "total": float(np.sqrt(sum(part**2 for part in parts.values())))}


DEEP = {"jacobian": np.where(np.hypot(*blob((24, 24))) > 0.5, -0.5, 1.0)}
LOST = {"displacement": 12 * blob((24, 40))}
DOUBTFUL = ALONE | {"rivals": [(0.0, 1.5)], "total": 0.5, "parts": {"noise": 0.5}}


@pytest.mark.parametrize(
    ("changes", "expected", "words"),
    [
        ({}, Verdict.DETERMINED, "2 images to the noise (χ² 0.97 to 1.04)"),
        ({"beam_unknown": True}, Verdict.DETERMINED, ""),
        # Only too much residual is a misfit.
        ({"chi2": np.array([0.6, 1.0])}, Verdict.DETERMINED, "(χ² 0.60 to 1.00)"),
        ({"chi2": np.array([0.3, 1.0])}, Verdict.DETERMINED, "too large (image 1: χ² 0.3"),
        ({"chi2": np.array([1.4, 1.0])}, Verdict.MISFIT, "image 1: χ² 1.4, where 1"),
        ({"chi2": np.array([1.1, 4.23])}, Verdict.MISFIT, "explain image 2: χ² 4.2, where 1"),
        (ALONE | {"chi2": np.array([1.8])}, Verdict.MISFIT, "expected: noise, source"),
        # Counts with too little noise have a dark level.
        (patterned(missing_counts=0.04, counts_deviation=0.005), Verdict.DETERMINED, ""),
        (patterned(missing_counts=0.1, counts_deviation=0.005), Verdict.UNCERTAIN, "about 10 %"),
        # A pattern is a misfit; without one, a cause that wins is.
        (patterned(4.5), Verdict.DETERMINED, ""),
        (patterned(6.6), Verdict.MISFIT, "by image 2: 7 standard"),
        (patterned(6.6, cause="the beam differs"), Verdict.MISFIT, "likely the beam differs"),
        (patterned(40.0, tried="blur"), Verdict.MISFIT, "not explained by blur"),
        (patterned(tried="blur", cause="blur: give it"), Verdict.MISFIT, "blur: give it"),
        (patterned(tried="blur"), Verdict.DETERMINED, ""),
        (patterned(correlation=1.0), Verdict.DETERMINED, "bars 3.5 times"),
        # An object that the edge cuts is explained by nothing within it, but nearly.
        (CUT | {"chi2": np.array([1.6, 1.0])}, Verdict.EDGE, "image 1: χ² 1.6"),
        (CUT | patterned(40.0), Verdict.EDGE, "no noise"),
        (CUT | LOST, Verdict.EDGE, ""),
        (with_errors(edge=0.04, noise=0.01), Verdict.DETERMINED, ""),
        (with_errors(edge=0.1, noise=0.01), Verdict.EDGE, "beyond the left and right edges"),
        (with_errors(edge=0.1, noise=0.08), Verdict.UNCERTAIN, ""),  # noise moves it, too
        # One image leaves open what several tell.
        (ALONE | {"beam_unknown": True}, Verdict.AMBIGUOUS, "take another energy, or an image of"),
        (ALONE | LOST, Verdict.AMBIGUOUS, "rays miss the image"),
        (DEEP, Verdict.DETERMINED, "1.04)"),  # the bars hold there what they hold elsewhere
        (DEEP | {"beam_unknown": True}, Verdict.DETERMINED, "1.04)"),
        # Of these one is the same, one explains worse.
        (
            {"rivals": [(0.01, 0.2), (0.02, 0.31), (0.005, 0.01), (0.5, 0.9)]},
            Verdict.SEVERAL,
            "3 fields, up to 31 % apart",
        ),
        ({"rivals": [(0.5, 0.9)]}, Verdict.DETERMINED, ""),
        ({"rivals": [(0.0, 0.01)]}, Verdict.DETERMINED, ""),
        (with_errors(noise=0.12) | {"rivals": [(0.0, 0.3)]}, Verdict.SEVERAL, ""),
        (with_errors(noise=0.12) | {"rivals": [(0.0, 0.2)]}, Verdict.UNCERTAIN, "limited by noise"),
        (with_errors(noise=0.12), Verdict.UNCERTAIN, "(errors 12 %)"),
        (
            with_errors(noise=0.12) | {"options": FitOptions(max_error=0.2)},
            Verdict.DETERMINED,
            "",
        ),
        ({"total": float("nan")}, Verdict.DETERMINED, "error bars were not"),
        ({"hidden": 0.3}, Verdict.DETERMINED, ""),
        ({"hidden": 0.8}, Verdict.UNCERTAIN, "mask hides"),
        ({"ended": False}, Verdict.UNCERTAIN, "allow more"),
        # The gravest doubt comes first.
        (DOUBTFUL | {"beam_unknown": True, "chi2": np.array([9.0])}, Verdict.MISFIT, ""),
        (DOUBTFUL | {"beam_unknown": True}, Verdict.AMBIGUOUS, ""),
        (DOUBTFUL, Verdict.SEVERAL, ""),
        (DOUBTFUL | {"rivals": []}, Verdict.UNCERTAIN, ""),
    ],
)
def test_each_case_has_its_verdict(changes: dict[str, Any], expected: Verdict, words: str) -> None:
    verdict, why = assess(**GOOD | changes)
    assert verdict is expected
    assert words in why


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


def of_assumed_beam(noise: float, share: float) -> dict[str, Any]:
    parts = {"beam": share, "noise": noise}
    return {"is_fitted": False, "total": float(np.hypot(noise, share)), "parts": parts}


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


Y, X = np.indices((64, 64))
RING = np.exp(-((np.hypot(Y - 32, X - 32) - 14) ** 2) / 2 / 2**2)[None]


def holed(middle: tuple[int, int], side: int) -> np.ndarray:
    used = np.ones((1, 64, 64), bool)
    row, column = (place - side // 2 for place in middle)
    used[0, row : row + side, column : column + side] = False
    return used


@pytest.mark.parametrize(
    ("middle", "side", "is_hidden"),
    [((32, 46), 16, True), ((32, 46), 6, False), ((10, 10), 14, False)],
    ids=["over the ring", "too small to matter", "beside it"],
)
def test_hidden_contrast_is_that_of_structure_under_holes(
    middle: tuple[int, int], side: int, is_hidden: bool
) -> None:
    assert (hidden_contrast(RING, holed(middle, side)) > 0.5) == is_hidden


def test_hidden_contrast_is_zero_without_a_mask_in_one_image() -> None:
    assert hidden_contrast(RING, np.ones((1, 64, 64), bool)) == 0
    used = np.concatenate([holed((32, 46), 16), np.ones((1, 64, 64), bool)])
    assert hidden_contrast(np.concatenate([RING, RING]), used) == 0
