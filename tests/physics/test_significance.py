"""How far a field stands above its errors: the map |d|/σ, its structures, and the sentence."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from napari_shadowinv.facts import Level
from napari_shadowinv.physics.significance import (
    deviation_along,
    find_structures,
    significance,
    significance_facts,
    structures_of,
)

SHAPE = (40, 50)


def smooth_noise(seed: int, width: float = 3.0) -> np.ndarray:
    """Two components with a standard deviation of 1, correlated over some pixels."""
    white = np.random.default_rng(seed).normal(size=(2, 64, 64))
    smooth = np.stack([gaussian_filter(plane, width, mode="wrap") for plane in white])
    return smooth * 2 * np.sqrt(np.pi) * width


def patches(*levels: float) -> np.ndarray:
    """A map with square patches of 5 px side at these significances, 1 px of 0 between them."""
    plane = np.zeros(SHAPE)
    for number, level in enumerate(levels):
        plane[5:10, 6 * number : 6 * number + 5] = level
    return plane


def test_one_component_is_its_ratio_to_its_own_deviation():
    displacement = np.zeros((2, 3, 4))
    displacement[1] = -3.0
    std = np.stack([np.full((3, 4), 100.0), np.full((3, 4), 0.5)])
    np.testing.assert_array_equal(significance(displacement, std), 6.0)
    np.testing.assert_array_equal(deviation_along(displacement, std), 0.5)


def test_significance_is_linear_in_the_field_and_has_no_unit_and_direction():
    angle = np.linspace(0, 2 * np.pi, 17)
    displacement = 3 * np.stack([np.sin(angle), np.cos(angle)])
    np.testing.assert_allclose(significance(displacement, np.full((2, 17), 0.6)), 5.0)
    displacement, std = smooth_noise(0), 0.1 + np.abs(smooth_noise(1))
    np.testing.assert_allclose(
        significance(-3e-9 * displacement, 1e-9 * std), 3 * significance(displacement, std)
    )


def test_no_field_has_no_significance_and_no_error_an_infinite_one():
    displacement = np.array([[0.0, 0.0, 2.0, np.nan], [0.0, 0.0, 1.0, 1.0]])
    std = np.array([[1.0, 0.0, 0.0, 1.0], [1.0, 0.0, 0.0, 1.0]])
    np.testing.assert_array_equal(significance(displacement, std), [0.0, 0.0, np.inf, np.nan])


def test_structures_are_numbered_by_their_significance():
    structures = find_structures(patches(6.0, 20.0, 9.0))
    assert structures.peaks == (20.0, 9.0, 6.0)
    assert [structures.labels[7, x] for x in (2, 8, 14)] == [3, 1, 2]
    assert structures.share == 75 / 2000
    assert structures.largest == 20.0


def test_patches_below_the_level_of_chance_or_too_small_are_no_structures():
    limit = np.sqrt(2 * np.log(20 * 2000))
    structures = find_structures(patches(limit - 0.01, limit + 0.01))
    assert structures.limit == pytest.approx(limit)
    assert structures.peaks == (limit + 0.01,)
    plane = patches(20.0)
    plane[20:22, 20:24] = 20.0  # 8 px
    assert find_structures(plane).peaks == (20.0,)
    assert find_structures(plane, element=4.0).peaks == ()


def test_masked_pixels_belong_to_no_structure():
    plane, mask = patches(20.0, 9.0), np.ones(SHAPE, bool)
    mask[:, :6] = False
    structures = find_structures(plane, mask)
    assert (structures.peaks, structures.largest, structures.n_pixels) == ((9.0,), 9.0, 1760)
    assert not structures.labels[~mask].any()


def test_correlated_errors_alone_are_rarely_a_structure():
    std = np.ones((2, 64, 64))
    significant = [significance(smooth_noise(seed), std) for seed in range(200)]
    above = np.mean([plane > 2 for plane in significant])
    assert above == pytest.approx(np.exp(-2), rel=0.1)
    alarms = sum(bool(find_structures(plane).peaks) for plane in significant)
    assert alarms <= 10  # 5 %


def test_the_sentence_counts_structures_and_names_the_causes():
    displacement = np.stack([patches(6.0, 20.0), np.zeros(SHAPE)])
    structures = structures_of(displacement, np.ones((2, *SHAPE)))
    (fact,) = significance_facts(structures, ("noise", "beam, 5 %"))
    assert (fact.key, fact.level) == ("significance", Level.SOUND)
    assert fact.text == (
        "2 structures stand above 2 σ, on 2.5 % of the pixels, up to 20 σ (σ by noise; beam, 5 %)"
    )


@pytest.mark.parametrize(
    ("plane", "reason"),
    [
        (patches(1.5), "the field reaches 1.5 σ"),
        (patches(3.0), "the field reaches 3 σ, errors alone up to 4.6 σ among 2,000 pixels"),
        (np.pad([[9.0]], ((0, 39), (0, 49))), "9 σ are reached, but by a few pixels only"),
    ],
    ids=["weak", "chance", "speck"],
)
def test_a_field_within_its_errors_is_doubtful(plane: np.ndarray, reason: str):
    structures = structures_of(np.stack([plane, np.zeros(SHAPE)]), np.ones((2, *SHAPE)))
    (fact,) = significance_facts(structures, (), name="E")
    assert (fact.title, fact.level) == ("Significance E", Level.DOUBTFUL)
    assert fact.text == f"no structure stands above 2 σ: {reason}"
