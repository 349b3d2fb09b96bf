from pathlib import Path

import numpy as np
import pytest
import tifffile

from helpers.public_data import public_file
from napari_shadowinv.errors import FileFormatError, InputError
from napari_shadowinv.film import Calibration, combined_dose, dose, net_optical_density

HEADER = "Film No's,Actual Dose,Log Dose,Red Ch,std dev,Green Ch,std dev,Blue Ch,std dev\n"
UNITS = "(C ),(Gy),log10(Gy),pix,,pix,,pix,\n"
ROWS = (
    "1,0.1,-1,40000,700,41000,700,31000,500\n"
    "2,1,0,39000,700,41100,700,30800,500\n"
    "3,10,1,32000,700,37000,700,30500,500\n"
    "4,100,2,13000,700,22000,700,24000,500\n"
    "5,1000,3,3000,700,6000,700,11000,500\n"
)
CHANNELS = ("red", "green", "blue")


@pytest.fixture
def table(tmp_path: Path) -> Path:
    path = tmp_path / "film.csv"
    path.write_text(HEADER + UNITS + ROWS)
    return path


def synthetic_film(calibration: Calibration, doses: np.ndarray, gain: float = 1.0) -> np.ndarray:
    """Scan of a film that received these doses, by the calibration itself."""
    planes = []
    for index, channel in enumerate(CHANNELS):
        density, known = calibration.curve(channel)
        darkened = 10 ** np.interp(np.log10(doses), np.log10(known), density)
        planes.append(gain * calibration.background[index] / darkened)
    return np.stack(planes, axis=-1)


def test_table_is_read_as_it_stands(table: Path) -> None:
    calibration = Calibration.from_csv(table)
    np.testing.assert_array_equal(calibration.doses, [0.1, 1, 10, 100, 1000])
    np.testing.assert_array_equal(calibration.pixels[3], [13000, 22000, 24000])
    np.testing.assert_array_equal(calibration.background, [40000, 41100, 31000])
    part = Calibration.from_csv(table, dose_range=(1, 100), background=(42000, 42000, 32000))
    density, doses = part.curve()
    assert doses[[0, -1]] == pytest.approx([1, 100])
    assert density[1] == pytest.approx(np.log10(42000 / 32000))


def test_net_optical_density_of_known_pixels() -> None:
    scan = np.array([[[1000, 100, 10], [500, 1000, 1]]], np.uint16)
    red = net_optical_density(scan, (1000, 1000, 1000), "red")
    np.testing.assert_allclose(red, [[0, np.log10(2)]], atol=1e-15)
    np.testing.assert_allclose(net_optical_density(scan, 1000.0, "blue"), [[2, 3]])
    unexposed = np.full((8, 12, 3), 65535, np.uint16)
    unexposed[2:6, 3:9] = 1000
    np.testing.assert_array_equal(net_optical_density(scan, unexposed, "green"), [[1, 0]])
    assert net_optical_density([[0]], 1.0) == np.inf


@pytest.mark.parametrize("channel", CHANNELS)
def test_synthetic_film_gives_back_its_dose(table: Path, channel: str) -> None:
    calibration = Calibration.from_csv(table)
    low, *_, high = calibration.curve(channel)[1]
    truth = np.geomspace(low, high, 60).reshape(6, 10)
    film_dose = dose(synthetic_film(calibration, truth), calibration, channel=channel)
    np.testing.assert_allclose(film_dose.dose, truth, rtol=1e-9)
    assert not film_dose.outside.any()


def test_films_of_the_table_have_their_own_dose(table: Path) -> None:
    calibration = Calibration.from_csv(table)
    film_dose = dose(calibration.pixels[None], calibration)
    np.testing.assert_allclose(film_dose.dose, calibration.doses[None])
    assert not film_dose.outside.any()


def test_gain_of_the_scanner_cancels(table: Path) -> None:
    calibration = Calibration.from_csv(table)
    truth = np.geomspace(0.2, 900, 40).reshape(5, 8)
    scan = synthetic_film(calibration, truth, gain=0.8)
    film_dose = dose(scan, calibration, background=0.8 * calibration.background)
    np.testing.assert_allclose(film_dose.dose, truth, rtol=1e-9)


@pytest.mark.parametrize("channel", CHANNELS)
def test_darker_is_more_dose_and_the_range_is_kept(table: Path, channel: str) -> None:
    calibration = Calibration.from_csv(table)
    scan = np.arange(65536, dtype=np.uint16).reshape(256, 256)
    film_dose = dose(scan, calibration, channel=channel)
    assert (np.diff(film_dose.dose.ravel()) <= 0).all()
    low, *_, high = calibration.curve(channel)[1]
    assert film_dose.dose.min() == pytest.approx(low)
    assert film_dose.dose.max() == pytest.approx(high)
    inside = ~film_dose.outside.ravel()
    assert (np.diff(film_dose.dose.ravel()[inside]) < 0).all()
    column = calibration.pixels[:, CHANNELS.index(channel)]
    np.testing.assert_array_equal(inside[: int(column.min())], False)
    np.testing.assert_array_equal(inside[int(column.max()) + 1 :], False)
    assert inside[int(column.min()) + 1]


def test_films_in_the_wrong_order_count_as_one(table: Path) -> None:
    density, doses = Calibration.from_csv(table).curve("green")
    # 0.1 Gy is darker there than 1 Gy.
    assert len(density) == 4
    assert doses[0] == pytest.approx(np.sqrt(0.1))
    assert density[0] == pytest.approx(np.log10(41100 / 41000) / 2)
    assert (np.diff(density) > 0).all()


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("", "has no column 'dose', but none"),
        ("a,b\n1,2\n", "has no column 'dose', but a, b"),
        (HEADER + UNITS + "1,0.1,-1,40000,7,x,7,1,1\n", r"line 3 has '0.1', '40000', 'x', '1'"),
        (HEADER + UNITS + ROWS + "6,2000\n", r"line 8 has '2000', '', '', ''"),
    ],
)
def test_mistakes_in_the_table_are_named(table: Path, content: str, message: str) -> None:
    table.write_text(content)
    with pytest.raises(InputError, match=message):
        Calibration.from_csv(table)


def test_mistakes_in_the_arguments_are_named(table: Path) -> None:
    calibration = Calibration.from_csv(table)
    with pytest.raises(FileFormatError, match="does not exist"):
        Calibration.from_csv(table.with_name("nowhere.csv"))
    with pytest.raises(InputError, match="has 1 films between 5 and 50 Gy"):
        Calibration.from_csv(table, dose_range=(5, 50))
    with pytest.raises(InputError, match="pixels must be positive"):
        Calibration(calibration.doses, -calibration.pixels)
    with pytest.raises(InputError, match="does not darken with dose"):
        Calibration(calibration.doses, calibration.pixels[::-1]).curve()
    with pytest.raises(InputError, match="channel is 'mean'"):
        dose(np.ones((4, 4, 3)), calibration, channel="mean")
    with pytest.raises(InputError, match=r"shape \(4, 4, 2\)"):
        dose(np.ones((4, 4, 2)), calibration)
    with pytest.raises(InputError, match="negative pixels or NaN"):
        dose(np.full((4, 4), np.nan), calibration)
    with pytest.raises(InputError, match=r"background has shape \(5,\)"):
        dose(np.ones((4, 4)), calibration, background=np.ones(5))
    with pytest.raises(InputError, match="background is 0"):
        dose(np.ones((4, 4)), calibration, background=0.0)
    with pytest.raises(InputError, match="8 bits"):
        dose(np.ones((4, 4), np.uint8), calibration)


@pytest.mark.parametrize(
    ("layer", "beam", "beside"),
    [
        ("RCF_18H", np.s_[200:280, 350:450], np.s_[300:360, 620:700]),
        ("RCF_18K", np.s_[200:260, 260:340], np.s_[380:430, 350:450]),
    ],
)
def test_real_film_has_its_dose_in_the_beam(
    layer: str, beam: tuple[slice, ...], beside: tuple[slice, ...]
) -> None:
    table = public_file("rcf/HDV2_3_calibration.csv")
    calibration = Calibration.from_csv(table, dose_range=(0, 2000))
    unexposed = tifffile.imread(public_file("rcf/HDV2.tif"))
    scan = tifffile.imread(public_file(f"rcf/{layer}.tif"))
    red, green = (
        dose(scan, calibration, background=unexposed, channel=channel)
        for channel in ("red", "green")
    )
    for film_dose in (red, green):
        assert film_dose.dose.shape == scan.shape[:2]
        assert np.median(film_dose.dose[beam]) > 5 * np.median(film_dose.dose[beside])
        assert 5 < np.median(film_dose.dose[beam]) < 500
        assert not film_dose.outside[beam].any()
        # The scanner's bed is lighter than any film.
        assert film_dose.outside[:10, :10].all()
    assert np.median(green.dose[beam] / red.dose[beam]) == pytest.approx(1, abs=0.03)


def test_all_channels_together_give_back_the_dose(table: Path) -> None:
    calibration = Calibration.from_csv(table)
    truth = np.geomspace(2, 900, 60).reshape(6, 10)
    combined = combined_dose(synthetic_film(calibration, truth), calibration)
    np.testing.assert_allclose(combined.dose, truth, rtol=1e-9)
    assert not combined.outside.any()


def test_errors_of_noisy_films_match_their_scatter(table: Path) -> None:
    """In the spread of the table; of three channels they are smaller than of the best."""
    np.testing.assert_array_equal(Calibration.from_csv(table).spreads[0], [700, 700, 500])
    doses = np.geomspace(1, 2000, 25)
    density = np.log10(1 + doses[:, None] / [15.0, 40.0, 150.0])
    pixels = 40_000 / 10**density
    calibration = Calibration(doses, pixels, np.full(3, 40_000.0), 0.01 * pixels)
    truth = np.repeat([[5.0, 15.0, 40.0, 150.0, 800.0]], 4000, axis=0)
    film = synthetic_film(calibration, truth)
    film *= 1 + 0.01 * np.random.default_rng(0).normal(size=film.shape)
    combined = combined_dose(film, calibration)
    assert not combined.outside.any()
    scatter = np.log(combined.dose / truth).std(axis=0)
    estimated = np.sqrt((combined.error**2).mean(axis=0))
    # Told by three channels that differ by chance, they are up to a fifth too large.
    assert ((estimated / scatter > 0.95) & (estimated / scatter < 1.3)).all()
    best = np.min([calibration.log_error(truth[0], channel) for channel in CHANNELS], axis=0)
    assert (scatter < best).all()


def test_a_channel_that_is_black_does_not_count(table: Path) -> None:
    calibration = Calibration.from_csv(table)
    film = synthetic_film(calibration, np.full((4, 4), 800.0))
    film[..., 0] = 10
    combined = combined_dose(film, calibration)
    np.testing.assert_allclose(combined.dose, 800, rtol=1e-9)
    assert not combined.outside.any()
    assert combined_dose(np.full((2, 2, 3), 5.0), calibration).outside.all()
    with pytest.raises(InputError, match="in red, green and blue"):
        combined_dose(film[..., 0], calibration)


def test_channels_that_differ_make_the_error(table: Path) -> None:
    calibration = Calibration.from_csv(table)
    film = synthetic_film(calibration, np.full((4, 4), 100.0))
    film[..., 2] = synthetic_film(calibration, np.full((4, 4), 200.0))[..., 2]
    combined = combined_dose(film, calibration)
    alone = combined_dose(synthetic_film(calibration, np.full((4, 4), 100.0)), calibration)
    assert (combined.error > 1.5 * alone.error).all()
    assert ((combined.dose > 100) & (combined.dose < 200)).all()
