"""Facts about marks on films: they are found, and exposure is not taken for one."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import tifffile
from scipy.ndimage import gaussian_filter

from napari_shadowinv._typing import FloatArray
from napari_shadowinv.errors import InputError
from napari_shadowinv.film import Calibration, find_films, straighten_film
from napari_shadowinv.film.scans import burnt_edges, usable_pixels

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
        [40_000 / 10 ** calibration.optical_density(doses, c) for c in ("red", "green", "blue")]
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


@pytest.mark.parametrize("letter", "CGLMQ")
def test_the_writing_on_real_films_is_found(shared_data: Path, letter: str) -> None:
    folder = shared_data / "rcf"
    kind, table = ("HDV2", "HDV2_3") if letter < "M" else ("EBT3", "EBT3_2")
    blank = tifffile.imread(folder / f"{kind}.tif")
    unexposed = straighten_film(blank, find_films(blank)[0])[60:-60, 60:-60].reshape(-1, 3)
    scan = tifffile.imread(folder / f"RCF_18{letter}.tif")
    film = straighten_film(scan, find_films(scan)[0])
    usable = usable_pixels(
        film,
        Calibration.from_csv(folder / f"{table}_calibration.csv"),
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
def test_burnt_edges_of_real_films_are_masked(shared_data: Path, letter: str) -> None:
    folder = shared_data / "rcf"
    scan = tifffile.imread(folder / f"RCF_18{letter}.tif")
    red = straighten_film(scan, find_films(scan)[0], shape=(296, 590))[..., 0]
    calibration = Calibration.from_csv(folder / "EBT3_2_calibration.csv")
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
