"""Facts about films laid on each other by marks that go through all of them."""

from __future__ import annotations

import numpy as np
import pytest

from napari_shadowinv.errors import InputError
from napari_shadowinv.film import move_corners, poses_by_fiducials

THROUGH = {"a": (-40.0, -60.0), "b": (-35.0, 70.0), "c": (45.0, 10.0)}
SHIFTS = np.array([(1.0, -2.0), (-3.0, 0.5), (2.0, 1.5)])
TURNS = np.array([0.01, -0.02, 0.01])
UPRIGHT = np.array([(-75.5, -100.5), (-75.5, 100.5), (75.5, 100.5), (75.5, -100.5)])


def rotation(turn: float) -> np.ndarray:
    return np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])


def scanned(layer: int, askew: float = 0.3) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Marks and corners of a film on its scan, where the film lies askew."""
    axes, middle = rotation(askew), np.array([200.0, 230.0])
    on_film = {
        name: np.array(place) @ rotation(TURNS[layer]) + SHIFTS[layer]
        for name, place in THROUGH.items()
    }
    return {name: middle + place @ axes for name, place in on_film.items()}, middle + UPRIGHT @ axes


NAMES = ["film 1", "film 2", "film 3"]


def test_shifts_and_turns_are_those_of_the_marks() -> None:
    films = [scanned(layer) for layer in range(3)]
    scales = [1.0, 1.01, 1.02]
    poses = poses_by_fiducials(*map(list, zip(*films, strict=True)), scales, NAMES)
    np.testing.assert_allclose(poses.turns, TURNS, atol=1e-6)
    shifts = poses.shifts * np.array(scales)[:, None]
    np.testing.assert_allclose(shifts - shifts.mean(axis=0), SHIFTS, atol=2e-3)
    np.testing.assert_allclose(poses.errors, 0.3 / np.sqrt(3))
    assert poses.closure < 1e-3
    # Moved so, the films' frames lie at the same place against the marks.
    for (marks, corners), shift, turn, scale in zip(
        films, poses.shifts, poses.turns, scales, strict=True
    ):
        moved = move_corners(corners, shift, turn, scale)
        middle, right = moved.mean(axis=0), moved[1] - moved[0]
        right /= np.hypot(*right)
        axes = np.array([[right[1], -right[0]], right])
        for name, place in marks.items():
            np.testing.assert_allclose((place - middle) @ axes.T, THROUGH[name], atol=3e-3)


def test_one_mark_gives_a_shift_and_none_leaves_the_edges() -> None:
    (first, corners), (second, _), _ = (scanned(layer) for layer in range(3))
    points = [first, {"a": second["a"]}, {"x": second["b"]}]
    poses = poses_by_fiducials(points, [corners] * 3, [1.0] * 3, NAMES)
    assert poses.turns[1] == pytest.approx(poses.turns[0])
    np.testing.assert_array_equal(poses.shifts[2], 0)
    np.testing.assert_allclose(poses.errors, [0.3, 0.3, 3.0])
    assert np.isnan(poses.closure), "nothing checks one mark a film"


def test_marks_that_are_read_badly_tell_it_by_how_far_they_contradict_each_other() -> None:
    rng = np.random.default_rng(0)
    closures = []
    for _ in range(40):
        films = [scanned(layer) for layer in range(3)]
        for marks, _ in films:
            for name in marks:
                marks[name] = marks[name] + rng.normal(0, 1.5, 2)
        poses = poses_by_fiducials(*map(list, zip(*films, strict=True)), [1.0] * 3, NAMES)
        closures.append(poses.closure)
        np.testing.assert_allclose(poses.errors, max(poses.closure, 0.3) / np.sqrt(3))
    assert np.sqrt(np.mean(np.square(closures))) == pytest.approx(1.5, rel=0.15)


def test_marks_that_tell_nothing_or_another_thing_are_refused() -> None:
    (first, corners), (second, _), _ = (scanned(layer) for layer in range(3))
    with pytest.raises(InputError, match="no mark is on two films or more"):
        poses_by_fiducials([first, {}, {"x": second["b"]}], [corners] * 3, [1.0] * 3, NAMES)
    swapped = {**second, "a": second["b"], "b": second["a"]}
    with pytest.raises(InputError, match=r"mark on film . is .* px from its place by the marks"):
        poses_by_fiducials([first, swapped, first], [corners] * 3, [1.0] * 3, NAMES)
