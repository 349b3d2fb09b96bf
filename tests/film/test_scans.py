"""Facts about films on a scan: they are found, turned upright, and their marks are masked."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
from numpy.typing import NDArray
from scipy import ndimage
from scipy.ndimage import gaussian_filter

from helpers.public_data import public_file
from napari_shadowinv._typing import FloatArray
from napari_shadowinv.errors import InputError
from napari_shadowinv.film import Calibration
from napari_shadowinv.film.scans import (
    burnt_edges,
    find_films,
    read_corners,
    straighten_film,
    usable_pixels,
    write_corners,
)

Array = NDArray[np.float64]


def laid(middle: tuple[float, float], size: tuple[float, float], degrees: float) -> Array:
    """Corners of a film, turned clockwise."""
    angle = np.deg2rad(degrees)
    down, right = (
        np.array([np.cos(angle), -np.sin(angle)]),
        np.array([np.sin(angle), np.cos(angle)]),
    )
    half = np.array(size) / 2
    signs = ((-1, -1), (-1, 1), (1, 1), (1, -1))
    return np.array([middle + half[0] * v * down + half[1] * u * right for v, u in signs])


def scanned(films: list[Array], shape: tuple[int, int] = (300, 420), seed: int = 0) -> Any:
    """A bright bed with films on it whose brightness grows to the right, 16 bits.

    Pixels are means over their squares.
    """
    rng = np.random.default_rng(seed)
    planes = np.full((*shape, 3), 64_000.0)
    parts = 8
    steps = (np.arange(parts) + 0.5) / parts - 0.5
    places = np.moveaxis(np.indices(shape, dtype=float), 0, -1)
    for corners in films:
        top_left, top_right, _, bottom_left = corners
        sides = [
            (end - top_left) / ((end - top_left) ** 2).sum() for end in (top_right, bottom_left)
        ]
        cover = np.zeros(shape)
        for step in np.stack(np.meshgrid(steps, steps), -1).reshape(-1, 2):
            shares = [(places + step - top_left) @ side for side in sides]
            cover += np.logical_and.reduce([(share >= 0) & (share <= 1) for share in shares])
        cover /= parts**2
        grey = 20_000 + 10_000 * ((places - top_left) @ sides[0])
        planes += cover[..., None] * (grey[..., None] * [1.0, 1.1, 0.9] - planes)
    return (planes + rng.normal(0, 300, planes.shape)).clip(0, 65_535).astype(np.uint16)


@pytest.mark.parametrize("degrees", [-3.0, 0.0, 0.7, 2.0])
def test_a_film_is_found_where_it_was_laid(degrees: float) -> None:
    corners = laid((140.25, 200.5), (120.75, 230.25), degrees)
    (film,) = find_films(scanned([corners]))
    np.testing.assert_allclose(film, corners, atol=0.02)


def test_notches_dust_and_writing_do_not_move_a_film() -> None:
    corners = laid((140.0, 200.0), (120.0, 230.0), 1.5)
    scan = scanned([corners])
    scan[70:100, 180:186] = 64_000  # a notch from above
    scan[180:204, 290:320] = 64_000  # a corner that was cut off
    scan[150:170, 100:110] = 3_000  # writing
    scan[20:23, 20:23] = scan[280, 300:310] = 9_000  # dust
    (film,) = find_films(scan)
    np.testing.assert_allclose(film, corners, atol=0.6)


def test_many_films_come_in_the_order_of_reading() -> None:
    middles = [(70.0, 90.0), (64.0, 300.0), (215.0, 110.0), (222.0, 310.0)]
    films = [laid(middle, (90.0, 150.0), turn) for middle, turn in zip(middles, (2, -1, 0, 1))]  # noqa: B905
    corners = find_films(scanned([films[k] for k in (3, 0, 2, 1)]))
    assert len(corners) == 4
    np.testing.assert_allclose(corners, films, atol=0.6)


def test_a_film_turned_upright_is_as_it_was() -> None:
    corners = laid((140.0, 200.0), (120.0, 230.0), 2.5)
    film = straighten_film(scanned([corners]), corners)
    assert film.shape == (120, 230, 3)
    grey = film[..., 0] / (20_000 + 10_000 * (np.arange(230) + 0.5) / 230)
    assert abs(grey[3:-3, 3:-3] - 1).max() < 0.06
    # No gradient from the top to the bottom is left.
    np.testing.assert_allclose(grey[5:30].mean(), grey[-30:-5].mean(), rtol=2e-3)


def slit_of(film: Array) -> tuple[float, float]:
    """Where the slit near the top right corner of the real films ends (y), and lies (x)."""
    part = film[:60, 535:570]
    away = np.abs(part - ndimage.median_filter(part, (1, 15)))
    profile = away[12:28].mean(axis=0)
    profile = np.clip(profile - np.median(profile), 0, None)
    best = int(np.argmax(profile))
    near = slice(max(best - 3, 0), best + 4)
    x = np.average(np.arange(35)[near], weights=profile[near])
    line = away[:, max(best - 1, 0) : best + 2].max(axis=1)
    level = np.median(line[12:28]) / 2
    end = 25 + int(np.flatnonzero(line[25:] < level)[0])
    return end - 1 + (line[end - 1] - level) / (line[end - 1] - line[end]), x


def test_real_films_lie_where_they_were_found_by_hand() -> None:
    table = public_file("rcf/Corner_Positions_Rectangle.csv").read_text().splitlines()
    rows = {row[1]: row[2:] for row in csv.reader(table) if row[0] == "19"}
    away, slits = [], []
    for number, letter in enumerate("ABCDEFGHIJKLMNOPQ"):
        scan = tifffile.imread(public_file(f"rcf/RCF_18{letter}.tif"))
        (film,) = find_films(scan)
        by_hand = [float(rows[name][number]) for name in ("Y1", "X1", "Y2", "X2")]
        away.append(film[:2].ravel() - by_hand)
        height = np.hypot(*(film[3] - film[0]))
        assert height == pytest.approx(296, abs=3)
        if letter not in "ABCDEFJ":  # torn along the slit, or it is too faint
            slits.append(slit_of(straighten_film(scan, film, shape=(296, 590)).mean(axis=-1)))
    assert np.abs(away).max() < 10
    assert np.sqrt(np.mean(np.square(away))) < 3.5
    # What is cut into all films alike lies at the same place of each.
    assert np.std(slits, axis=0).max() < 1.0


def test_a_scan_without_films_is_refused() -> None:
    with pytest.raises(InputError, match="no film was found on the scan"):
        find_films(scanned([]))
    with pytest.raises(InputError, match=r"the scan has shape \(20, 30\)"):
        find_films(np.ones((20, 30)))


def test_corners_in_another_order_are_refused() -> None:
    corners = laid((140.0, 200.0), (120.0, 230.0), 0)
    with pytest.raises(InputError, match="in the direction of reading"):
        straighten_film(np.ones((300, 420)), corners[::-1])
    with pytest.raises(InputError, match=r"corners have shape \(3, 2\)"):
        straighten_film(np.ones((300, 420)), corners[:3])


def test_corners_come_back_from_a_table(tmp_path: Path) -> None:
    films = {"A": laid((140, 200), (120, 230), 1), "B": laid((40, 50), (20, 30), -1)}
    path = tmp_path / "corners.csv"
    write_corners(path, films)
    again = read_corners(path)
    assert list(again) == ["A", "B"]
    for name, corners in films.items():
        np.testing.assert_allclose(again[name], corners, atol=0.006)
    write_corners(path, {"A": films["A"][[0, 2, 1, 3]]})
    with pytest.raises(InputError, match=r"line 2: corners .* do not go around"):
        read_corners(path)


SHAPE = (200, 320)


@pytest.fixture
def calibration() -> Calibration:
    doses = np.geomspace(0.5, 5000, 25)
    density = np.log10(1 + doses[:, None] / [15.0, 40.0, 150.0])
    return Calibration(doses, 40_000 / 10**density, np.full(3, 40_000.0))


@pytest.fixture
def film(calibration: Calibration) -> FloatArray:
    """Exposed with a sharp front, with noise."""
    y, x = np.indices(SHAPE)
    doses = 3 + 400 * np.exp(-((y - 60) ** 2 + (x - 150) ** 2) / 2 / 40**2)
    doses += np.where(np.hypot(y - 100, x - 200) < 50, 150, 0)
    planes = np.stack(
        [
            40_000 / 10 ** np.interp(np.log10(doses), np.log10(known), density)
            for density, known in map(calibration.curve, ("red", "green", "blue"))
        ]
    )
    noise = 1 + 0.012 * np.random.default_rng(0).normal(size=planes.shape)
    return np.moveaxis(planes * noise, 0, -1)


def test_exposure_is_no_mark(film: FloatArray, calibration: Calibration) -> None:
    usable = usable_pixels(film, calibration)
    assert not usable[:6].any()
    assert not usable[:, -6:].any()
    assert usable[6:-6, 6:-6].mean() > 0.995


def test_marks_are_found(film: FloatArray, calibration: Calibration) -> None:
    ink, scratch, hole = np.zeros((3, *SHAPE), bool)
    ink[170:188, 20:26] = ink[176:182, 20:50] = True
    scratch[170:172, 200:280] = True
    hole[40:48, 240:250] = True
    film[ink] *= [0.06, 0.06, 0.6]  # a blue pen, as measured
    film[scratch] *= 0.6  # it scatters light
    film[hole] = 64_000
    usable = usable_pixels(film, calibration, rim=0)
    for mark in (ink, hole):
        assert not usable[mark].any()
    assert not usable[gaussian_filter(scratch.astype(float), 0.5) > 0.6].any()
    near = gaussian_filter((ink | scratch | hole).astype(float), 3) > 0.002
    assert usable[~near].mean() > 0.995


@pytest.mark.parametrize("letter", "CLQ")
def test_the_writing_on_real_films_is_found(letter: str) -> None:
    kind, table = ("HDV2", "HDV2_3") if letter < "M" else ("EBT3", "EBT3_2")
    blank = tifffile.imread(public_file(f"rcf/{kind}.tif"))
    unexposed = straighten_film(blank, find_films(blank)[0])[60:-60, 60:-60].reshape(-1, 3)
    scan = tifffile.imread(public_file(f"rcf/RCF_18{letter}.tif"))
    film = straighten_film(scan, find_films(scan)[0])
    usable = usable_pixels(
        film,
        Calibration.from_csv(public_file(f"rcf/{table}_calibration.csv")),
        background=np.median(unexposed, axis=0),
    )
    # Letter and number in the lower corners; nothing in the middle.
    assert (~usable[220:280, 20:90]).mean() > 0.1
    assert (~usable[220:280, 510:575]).mean() > 0.1
    assert usable[50:220, 90:500].mean() > 0.985


def test_a_film_without_colours_is_refused(calibration: Calibration) -> None:
    with pytest.raises(InputError, match=r"the scan has shape \(20, 30\)"):
        usable_pixels(np.ones((20, 30)), calibration)


def beam() -> FloatArray:
    """Dose of a beam that the upper edge cuts, with a sharp front across the film."""
    y, x = np.indices(SHAPE)
    doses = 2 + 60 * np.exp(-((y / 90) ** 2) - ((x - 150) / 120) ** 2)
    doses = doses * np.where(x + 0.5 * y > 180, 3.0, 1.0)
    return np.asarray(doses * (1 + 0.05 * np.random.default_rng(1).normal(size=SHAPE)))


def test_burnt_edges_follow_the_burn() -> None:
    depth = np.arange(SHAPE[0])[:, None]
    burn = np.where(depth < 14, 40.0, 0.0) + 80 * np.exp(-depth / 4.0)
    doses = beam() + burn
    burnt = burnt_edges(doses)
    excess = doses / (doses - burn) > 1.3
    assert burnt[excess & (depth >= 3)].all()
    assert not burnt[30:].any()
    np.testing.assert_array_equal(burnt_edges(doses.T), burnt.T)
    np.testing.assert_array_equal(burnt_edges(doses[::-1]), burnt[::-1])


def test_burnt_edges_are_not_seen_in_a_beam() -> None:
    for turns in range(4):
        assert not burnt_edges(np.rot90(beam(), turns)).any()


@pytest.mark.parametrize("letter", "MP")
def test_burnt_edges_of_real_films_are_masked(letter: str) -> None:
    scan = tifffile.imread(public_file(f"rcf/RCF_18{letter}.tif"))
    red = straighten_film(scan, find_films(scan)[0], shape=(296, 590))[..., 0]
    calibration = Calibration.from_csv(public_file("rcf/EBT3_2_calibration.csv"))
    densities, doses = calibration.curve("red")
    dose = np.exp(np.interp(np.log10(calibration.background[0] / red), densities, np.log(doses)))
    burnt = burnt_edges(dose)
    # Below and beside the beam the dose is level; between the writing, nothing else disturbs it.
    for turns in (1, 2):
        side, masked = np.rot90(dose, -turns), np.rot90(burnt, -turns)
        part = np.s_[:, side.shape[1] * 2 // 5 : side.shape[1] * 3 // 5]
        profile = np.median(side[part], axis=1)
        usable = masked[part].mean(axis=1) < 0.5
        assert profile[6] > 2 * profile[45]
        assert usable[45]
        assert (profile[:45][usable[:45]] < 1.35 * profile[45]).all()
    assert not burnt[50:-50, 50:-50].any()
