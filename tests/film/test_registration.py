"""Facts about the alignment of films: by the structure that they share, and by marks."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage

from napari_shadowinv.errors import InputError
from napari_shadowinv.film.registration import (
    check_orientation,
    move_corners,
    poses_by_fiducials,
    register,
)
from napari_shadowinv.film.scans import straighten_film

SHAPE = (150, 210)
RNG = np.random.default_rng(3)
LARGE = ndimage.gaussian_filter(RNG.normal(size=(260, 320)), 30) * 60
FINE = ndimage.gaussian_filter(RNG.normal(size=(260, 320)), 3) * 1.5


def film(shift: tuple[float, float], turn: float = 0.0, noise: int | None = None) -> np.ndarray:
    """What is `shift` further down and right than on a film that lies as it should, turned."""
    y, x = np.indices(SHAPE, dtype=float)
    y, x = y - (SHAPE[0] - 1) / 2 - shift[0], x - (SHAPE[1] - 1) / 2 - shift[1]
    c, s = np.cos(turn), np.sin(turn)
    at = [c * y + s * x + 129.5, -s * y + c * x + 159.5]
    image = ndimage.map_coordinates(LARGE + FINE, at, order=3)
    return image + 0.05 * np.random.default_rng(noise).normal(size=SHAPE) * (noise is not None)


ALL = np.ones(SHAPE, dtype=bool)


def test_films_are_found_to_lie_as_they_do() -> None:
    shifts = np.array([(0, 0), (2.3, -1.4), (-3.2, 0.6), (0.4, 3.9)])
    turns = np.array([0.0, 0.006, -0.004, 0.002])
    films = [film(tuple(shift), turn, k) for k, (shift, turn) in enumerate(zip(shifts, turns))]  # noqa: B905
    poses = register(films, [ALL] * 4, spread=5.0)
    np.testing.assert_allclose(poses.shifts - poses.shifts[0], shifts, atol=0.15)
    np.testing.assert_allclose(poses.turns - poses.turns[0], turns, atol=5e-4)
    assert poses.by_images.all()
    assert poses.closure < 0.15
    # Content agrees to tenths of a pixel, but only edges are independent of fields.
    moves = np.sqrt((poses.shifts**2).mean(axis=1))
    assert (np.hypot(moves, 0.05) < poses.errors).all()
    assert (poses.errors < np.hypot(moves, 0.3)).all()
    # Only where all lie together is left to the edges.
    np.testing.assert_allclose(poses.shifts.mean(axis=0), 0, atol=1e-9)


def test_edges_that_images_agree_with_are_kept() -> None:
    films = [film((0, 0), noise=1), film((0.9, -0.5), 0.003, noise=2), film((0.3, 0.4), noise=3)]
    poses = register(films, [ALL] * 3)
    np.testing.assert_array_equal(poses.shifts, 0)
    np.testing.assert_array_equal(poses.turns, 0)
    assert poses.by_images.all()
    moved = register([films[0], film((2.9, -0.5), noise=2), films[2]], [ALL] * 3)
    assert np.abs(moved.shifts).max() > 1


def test_what_is_masked_does_not_count() -> None:
    first, second = film((0, 0), noise=1), film((1.5, -2.5), noise=2)
    usable = ALL.copy()
    usable[60:100, 30:90] = False
    marked = np.where(usable, second, 9.0)
    poses = register([first, marked], [ALL, usable])
    np.testing.assert_allclose(poses.shifts[1] - poses.shifts[0], [1.5, -2.5], atol=0.2)


def test_films_that_show_nothing_alike_stay_at_their_edges() -> None:
    noise = np.random.default_rng(5).normal(size=(3, *SHAPE))
    films = [film((0, 0), noise=7), film((2.0, 0.0), noise=8), 0.3 * noise[0]]
    poses = register(films, [ALL] * 3)
    assert list(poses.by_images) == [True, True, False]
    np.testing.assert_array_equal(poses.shifts[2], 0)
    assert poses.errors[2] > 2.5
    assert np.isnan(poses.closure)


def test_moved_corners_cut_the_film_where_it_shows_the_same() -> None:
    shift, turn = (2.4, -1.7), 0.02
    scan = np.pad(film(shift, turn), 40, mode="edge")
    corners = np.array([(39.5, 39.5), (39.5, 249.5), (189.5, 249.5), (189.5, 39.5)])
    cut = straighten_film(scan, move_corners(corners, shift, turn, 1.0), shape=SHAPE)
    inner = np.s_[20:-20, 20:-20]
    np.testing.assert_allclose(cut[inner], film((0, 0))[inner], atol=0.02)


def test_moved_corners_measure_shifts_in_pixels_of_the_scale() -> None:
    corners = np.array([(0, 0), (0, 200), (150, 200), (150, 0)], dtype=float)
    moved = move_corners(corners, (2.0, -1.0), 0.0, 3.0)
    np.testing.assert_allclose(moved - corners, np.tile([6.0, -3.0], (4, 1)))


@pytest.mark.parametrize(
    ("way", "message"),
    [
        (np.s_[::-1, ::-1], "turned = 180"),
        (np.s_[:, ::-1], r"left to right: give its layer mirrored = true$"),
        (np.s_[::-1], "mirrored = true, turned = 180"),
    ],
)
def test_a_film_the_other_way_round_is_told(way: tuple[slice, ...], message: str) -> None:
    films = [film((0, 0)), film((1.0, 2.0), noise=1), film((0, 1.0), noise=2)[way]]
    names = ["film 4", "film 5", "film 6"]
    with pytest.raises(InputError, match=f"film 6 does not lie as film 5 does.*{message}"):
        check_orientation(films, [ALL] * 3, names)
    check_orientation(films[:2], [ALL] * 2, names[:2])


def test_all_films_the_other_way_round_are_named() -> None:
    films = [film((0, 0), noise=k) for k in range(6)]
    mirrored = [films[0][:, ::-1], films[1], films[2], films[3][::-1, ::-1], *films[4:]]
    message = "film 1 was scanned mirrored left.*mirrored = true; film 4 was scanned upside down"
    with pytest.raises(InputError, match=f"2 films do not lie as the others do .*{message}"):
        check_orientation(mirrored, [ALL] * 6, [f"film {k}" for k in range(1, 7)])


def test_of_a_symmetric_beam_nothing_is_said() -> None:
    y, x = np.indices(SHAPE) - np.array(SHAPE).reshape(2, 1, 1) / 2 + 0.5
    beam = -(y**2 + x**2) / 3000
    check_orientation([beam, beam[::-1]], [ALL] * 2, ["film 1", "film 2"])


def test_other_shapes_are_refused() -> None:
    with pytest.raises(InputError, match=r"images have shape .*expected both as \(films, height"):
        register(np.zeros((2, 30, 30)), np.ones((2, 30, 31), bool))


def exposed(fall: float) -> np.ndarray:
    """Logarithm of a smooth dose that falls from film to film, by a table with a kink."""
    y, x = np.indices(SHAPE)
    smooth = 3.0 - ((x - 100) / 90) ** 2 - ((y - 20) / 80) ** 2 - fall
    kinked = smooth + 1.5 * np.maximum(smooth - 1.2, 0)
    return np.asarray(kinked + 0.01 * np.random.default_rng(int(1e3 * fall)).normal(size=SHAPE))


def test_a_line_of_equal_dose_does_not_move_films() -> None:
    films = [exposed(fall) for fall in (0.0, 0.25, 0.5)]
    poses = register(films, [ALL] * 3)
    assert np.abs(poses.shifts).max() < 0.5
    assert np.abs(poses.turns).max() < 0.002


def test_a_turn_that_edges_exclude_is_refused() -> None:
    for turn, is_seen in ((0.018, True), (0.026, False)):
        poses = register([film((0, 0), noise=1), film((2.0, 1.0), turn, noise=2)], [ALL] * 2)
        assert list(poses.by_images) == [is_seen] * 2


def test_a_large_move_needs_a_third_film_of_the_same_kind() -> None:
    films = [film((0, 0), noise=1), film((12.0, 0), noise=2), film((0, 0), noise=3)]
    assert not register(films[:2], [ALL] * 2).by_images.any()
    confirmed = register(films, [ALL] * 3, kinds=["EBT3"] * 3)
    np.testing.assert_allclose(np.diff(confirmed.shifts[:, 0]), [12, -12], atol=0.3)
    alone = register(films, [ALL] * 3, kinds=["EBT3", "EBT3", "HDV2"])
    assert list(alone.by_images) == [True, False, True]


def test_films_at_three_places_confirm_each_other() -> None:
    # 12 px from each other, further than a comparison may move two films by itself.
    places = [(0.0, 0.0), (12.0, 0.0), (6.0, 10.4)]
    films = [film(place, noise=k) for k, place in enumerate(places)]
    for first, second in ((0, 1), (1, 2), (0, 2)):
        assert not register([films[first], films[second]], [ALL] * 2).by_images.any()
    poses = register(films, [ALL] * 3)
    assert poses.by_images.all()
    np.testing.assert_allclose(poses.shifts - poses.shifts[0], places, atol=0.3)


def test_edges_of_a_kind_are_trusted_by_films_of_that_kind() -> None:
    nothing = 0.3 * np.random.default_rng(5).normal(size=(2, *SHAPE))
    torn = [film((7.0, 0), noise=7), film((-7.0, 0), noise=8), film((7.0, 0), noise=9)]
    poses = register([*torn, *nothing], [ALL] * 5, kinds=["torn"] * 4 + ["cut"])
    assert poses.errors[3] > 4
    assert poses.errors[4] < 3.5


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
