"""Effects of an instrument: what is recorded of light, and how places move."""

import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from napari_shadowinv.instrument.effects import (
    RESPONSES,
    Background,
    Gamma,
    motion,
    motions,
    widen,
    widening,
)

SIZE, NUMBER, STEP = 0.1, 1.3, 1e-6
LIGHT = np.random.default_rng(0).uniform(0.3, 3.0, (5, 7))


@pytest.mark.parametrize("response", RESPONSES)
def test_the_light_of_what_is_recorded_is_the_light(response) -> None:
    recorded, _, _ = response.record(LIGHT, SIZE, NUMBER)
    np.testing.assert_allclose(response.light(recorded, SIZE, NUMBER)[0], LIGHT)
    assert not np.allclose(recorded, LIGHT, atol=0.01)


@pytest.mark.parametrize("response", RESPONSES)
def test_derivatives_of_a_response_are_its_differences(response) -> None:
    recorded, of_light, of_number = response.record(LIGHT, SIZE, NUMBER)
    by_light = (response.record(LIGHT + STEP, SIZE, NUMBER)[0] - recorded) / STEP
    by_number = (response.record(LIGHT, SIZE, NUMBER + STEP)[0] - recorded) / STEP
    np.testing.assert_allclose(of_light * np.ones(LIGHT.shape), by_light, rtol=1e-4)
    np.testing.assert_allclose(of_number, by_number, rtol=1e-4, atol=1e-7)

    light, of_recorded, of_number = response.light(LIGHT, SIZE, NUMBER)
    above = response.light(LIGHT * (1 + STEP), SIZE, NUMBER)[0]
    by_recorded = np.log(above / light) / STEP
    by_number = np.log(response.light(LIGHT, SIZE, NUMBER + STEP)[0] / light) / STEP
    np.testing.assert_allclose(of_recorded * np.ones(LIGHT.shape), by_recorded, rtol=1e-4)
    np.testing.assert_allclose(of_number, by_number, rtol=1e-4, atol=1e-7)


def test_a_detector_adds_its_background_after_its_response() -> None:
    assert [type(each) for each in RESPONSES] == [Gamma, Background]
    assert Gamma().record(LIGHT, 0.1, 2.0)[0] == pytest.approx(LIGHT**1.2)
    assert Background().record(LIGHT, 0.1, 2.0)[0] == pytest.approx(LIGHT + 0.2)


def test_widening_is_the_derivative_of_a_wider_image() -> None:
    image = np.random.default_rng(0).random((24, 30))
    slope = (widen(image, 1.3 + 1e-4) - widen(image, 1.3 - 1e-4)) / 2e-4
    np.testing.assert_allclose(widening(image, 1.3), slope, atol=1e-8)
    assert widen(image, 2.0).sum() == pytest.approx(image.sum())
    np.testing.assert_array_equal(widen(image, 0.0), image)


def test_a_turn_moves_the_corners_by_its_number_and_no_radius() -> None:
    places = np.array([[0.0, 0.0, 10.0], [0.0, 20.0, 10.0]])
    middle = np.array([[5.0], [10.0]])
    for number, along in ((2, 0.0), (3, 1.0)):  # a turn, and a change of scale
        moves = motion(places, (11, 21), np.eye(4)[number])
        lengths = np.hypot(*(places - middle))
        assert np.hypot(*moves) == pytest.approx(lengths / (np.hypot(11, 21) / 2))
        radial = ((places - middle) * moves).sum(axis=0) / lengths
        assert radial == pytest.approx(along * np.hypot(*moves))


def test_motions_of_an_image_are_its_changes_by_each_motion() -> None:
    places = np.indices((30, 40), np.float64)
    image = np.cos(places[0] / 9 + 1) * np.sin(places[1] / 7)
    for unit, change in zip(np.eye(4), motions(image), strict=True):
        moved = map_coordinates(image, places + motion(places, image.shape, 1e-3 * unit))
        inner = np.s_[5:-5, 5:-5]
        np.testing.assert_allclose(change[inner], ((moved - image) / 1e-3)[inner], atol=2e-3)
