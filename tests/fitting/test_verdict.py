"""Each verdict, from what it follows."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from napari_shadowinv.fitting.verdict import Verdict, judged

GOOD: dict[str, Any] = {
    "chi2": np.array([0.97, 1.04]),
    "names": ["image 1", "image 2"],
    "others": [],
    "single": False,
    "beam_unknown": False,
    "jacobian": np.ones((20, 20)),
    "folded": 0.3,
    "uncertainty": 0.02,
    "at_edge": 0.05,
    "edge_is_free": False,
}
ALONE = {"chi2": np.array([1.0]), "names": ["image 1"], "single": True, "folded": 0.0}


def test_images_that_are_explained_in_one_way_determine_the_field() -> None:
    verdict, why = judged(**GOOD)
    assert verdict is Verdict.DETERMINED
    assert "2 images" in why
    assert "0.97 to 1.04" in why


def test_unknown_error_bars_do_not_speak_against_a_field() -> None:
    verdict, why = judged(**GOOD | {"uncertainty": float("nan")})
    assert verdict is Verdict.DETERMINED
    assert "error bars were not" in why


@pytest.mark.parametrize(
    ("share", "free", "expected"),
    [
        (0.2, False, Verdict.DETERMINED),
        (0.4, False, Verdict.EDGE),
        (0.4, True, Verdict.DETERMINED),
        (0.9, True, Verdict.EDGE),
    ],
)
def test_a_field_that_the_edge_cuts_is_told(share: float, free: bool, expected: Verdict) -> None:
    verdict, why = judged(**GOOD | {"at_edge": share, "edge_is_free": free})
    assert verdict is expected
    assert ("edge='free'" in why) == (expected is Verdict.EDGE and not free)


def test_an_unknown_beam_is_determined_by_several_images() -> None:
    assert judged(**GOOD | {"beam_unknown": True})[0] is Verdict.DETERMINED


def test_an_image_that_is_not_explained_is_named() -> None:
    verdict, why = judged(**GOOD | {"chi2": np.array([1.1, 4.23])})
    assert verdict is Verdict.MISFIT
    assert "image 2 (4.2)" in why
    assert "image 1" not in why


def test_one_image_does_not_tell_an_unknown_beam() -> None:
    verdict, why = judged(**GOOD | ALONE | {"beam_unknown": True})
    assert verdict is Verdict.AMBIGUOUS
    assert "beam" in why


@pytest.mark.parametrize(
    ("folded", "expected"), [(0.4, Verdict.AMBIGUOUS), (0.05, Verdict.DETERMINED)]
)
def test_one_image_tells_few_folds_and_not_many(folded: float, expected: Verdict) -> None:
    verdict, why = judged(**GOOD | ALONE | {"folded": folded})
    assert verdict is expected
    assert ("40%" in why) == (expected is Verdict.AMBIGUOUS)
    assert "one image" in why


@pytest.mark.parametrize(
    ("meeting", "crossed", "expected"),
    [
        (0, 0, Verdict.DETERMINED),  # rays stay apart
        (20, 0, Verdict.AMBIGUOUS),  # they meet, and nowhere have they crossed
        (20, 10, Verdict.AMBIGUOUS),
        (5, 30, Verdict.DETERMINED),  # they clearly cross
    ],
)
def test_one_image_tells_rays_that_clearly_cross_and_not_those_that_nearly_meet(
    meeting: int, crossed: int, expected: Verdict
) -> None:
    jacobian = np.ones(400)
    jacobian[:meeting] = 0.02
    jacobian[meeting : meeting + crossed] = -0.8
    changes = {"jacobian": jacobian.reshape(20, 20), "folded": crossed / 400}
    assert judged(**GOOD | ALONE | changes)[0] is expected
    assert judged(**GOOD | changes)[0] is Verdict.DETERMINED  # several images tell


def test_several_fields_that_explain_as_well_are_told() -> None:
    others = [(0.01, 0.2), (0.02, 0.31), (0.005, 0.01), (0.5, 0.9)]
    verdict, why = judged(**GOOD | {"others": others})
    assert verdict is Verdict.SEVERAL
    assert why.startswith("3 different fields")  # one is the same, one explains worse
    assert "31%" in why


@pytest.mark.parametrize("other", [(0.5, 0.9), (0.0, 0.01)])
def test_other_fields_do_not_matter_if_they_are_worse_or_the_same(
    other: tuple[float, float],
) -> None:
    assert judged(**GOOD | {"others": [other]})[0] is Verdict.DETERMINED


def test_noise_that_leaves_much_open_is_told() -> None:
    verdict, why = judged(**GOOD | {"uncertainty": 0.12})
    assert verdict is Verdict.UNCERTAIN
    assert "12%" in why


def test_the_gravest_doubt_comes_first() -> None:
    """Images that are not explained, then one image, then other fields, then noise."""
    all_of_them = GOOD | ALONE | {"beam_unknown": True, "others": [(0.0, 0.5)], "uncertainty": 0.5}
    assert judged(**all_of_them | {"chi2": np.array([9.0])})[0] is Verdict.MISFIT
    assert judged(**all_of_them)[0] is Verdict.AMBIGUOUS
    assert judged(**all_of_them | {"beam_unknown": False})[0] is Verdict.SEVERAL
    assert judged(**all_of_them | {"beam_unknown": False, "others": []})[0] is Verdict.UNCERTAIN
