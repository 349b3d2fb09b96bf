"""Radiochromic film: from the scan to the dose of the beam.

- a table of doses and the pixels that they gave: `Calibration`, `Calibration.from_csv`
- darkening against unexposed film: `net_optical_density`
- the dose in every pixel, and where it is outside the table: by one channel `dose`, by all three
  with its error `combined_dose`

Film darkens with dose; the net optical density log10(unexposed / exposed) does not depend
on the scanner's gain, so a table can serve scans of another day if unexposed film was
scanned with them. Fluence is proportional to dose as long as the particles of a layer lose
about the same energy in it. Doses are in Gy; a `channel` is "red", the default, which is the most
sensitive to small doses, "green" or "blue".

References
----------
Devic et al., "Precise radiochromic film dosimetry using a flat-bed document scanner",
Medical Physics 32, 2245 (2005).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from napari_shadowinv._system.tables import read_table
from napari_shadowinv._typing import AnyArray, BoolArray, FloatArray
from napari_shadowinv.errors import InputError

_CHANNELS = ("red", "green", "blue")


class DoseMap(NamedTuple):
    """Dose in every pixel of a film.

    Attributes
    ----------
    dose : ndarray of float64, shape (H, W)
        Held at the nearer end of the calibrated range outside of it.
    outside : ndarray of bool, shape (H, W)
        True where the film is lighter or darker than any that was calibrated.
    """

    dose: FloatArray
    outside: BoolArray


@dataclass(frozen=True, eq=False)
class Calibration:
    """Pixels of films that received known doses.

    Attributes
    ----------
    doses : ndarray, shape (n,)
    pixels : ndarray, shape (n, 3)
        Mean red, green and blue pixel of each film.
    background : ndarray, shape (3,)
        Pixel of unexposed film in the same scan; the lightest of `pixels` if it is not given.
    spreads : ndarray, shape (n, 3)
        Standard deviation of the pixels of each film; 2 % of them if it is not given.

    Raises
    ------
    InputError
        If there are fewer than two films, or a value is not positive.

    Examples
    --------
    >>> grey = np.array([[40000.0], [4000.0], [400.0]])
    >>> film = Calibration(np.array([1.0, 10.0, 100.0]), np.repeat(grey, 3, axis=1))
    >>> film.curve()
    (array([0., 1., 2.]), array([  1.,  10., 100.]))
    """

    doses: FloatArray
    pixels: FloatArray
    background: FloatArray = field(default_factory=lambda: np.empty(0))
    spreads: FloatArray = field(default_factory=lambda: np.empty(0))

    def __post_init__(self) -> None:
        doses, pixels = np.asarray(self.doses, float), np.asarray(self.pixels, float)
        if doses.ndim != 1 or len(doses) < 2 or pixels.shape != (len(doses), 3):
            raise InputError(
                f"a calibration has doses of shape {doses.shape} and pixels of shape "
                f"{pixels.shape}: expected (n,) and (n, 3), at least two films"
            )
        background = np.asarray(self.background, float)
        if background.size == 0:
            background = pixels.max(axis=0)
        if background.shape != (3,):
            raise InputError(
                f"the calibration's background has shape {background.shape}: expected one pixel "
                "for red, green and blue"
            )
        spreads = np.asarray(self.spreads, float)
        if spreads.size == 0:
            spreads = 0.02 * pixels
        if spreads.shape != pixels.shape:
            raise InputError(
                f"the calibration's spreads have shape {spreads.shape}: expected that of its "
                f"pixels, {pixels.shape}"
            )
        columns = {"doses": doses, "pixels": pixels, "background": background, "spreads": spreads}
        for name, values in columns.items():
            if not (np.isfinite(values) & (values > 0)).all():
                raise InputError(f"a calibration's {name} must be positive numbers; correct them")
            # Frozen, but the arguments may have been lists.
            object.__setattr__(self, name, values)

    @classmethod
    def from_csv(
        cls,
        path: str | Path,
        *,
        background: ArrayLike | None = None,
        dose_range: tuple[float, float] = (0.0, np.inf),
    ) -> Calibration:
        """Read a table with a film in each row.

        Parameters
        ----------
        path : str or Path
            Comma-separated values. The first line names the columns: one contains "dose" but not
            "log", others begin with "red", "green" and "blue"; a column behind one of these whose
            name begins with "std" holds its spread. Other columns are ignored. A second line may
            contain units.
        background : array_like, shape (3,), optional
            Pixel of unexposed film.
        dose_range : tuple of float
            Smallest and largest dose of the rows to use. Tables are often continued by
            extrapolation; leave that part out here.

        Raises
        ------
        FileFormatError
            If the file is missing, or is no table.
        InputError
            If it has no such columns, or a row holds anything but numbers; the message names the
            line.
        """
        films = _films_of(Path(path))
        used = films[(films[:, 0] >= dose_range[0]) & (films[:, 0] <= dose_range[1])]
        if len(used) < 2:
            raise InputError(
                f"{path} has {len(used)} films between {dose_range[0]:g} and {dose_range[1]:g} "
                "Gy: expected at least two; widen the range of doses"
            )
        empty = np.empty(0) if background is None else np.asarray(background, float)
        return cls(used[:, 0], used[:, 1:4], empty, used[:, 4:])

    def curve(self, channel: str = "red") -> tuple[FloatArray, FloatArray]:
        """Return net optical density and dose of one channel, both strictly increasing, shape (m,).

        The density is linear in the logarithm of the dose between films; `dose` is its inverse.

        Neighbours that noise put in the wrong order count as one film, with their mean density and
        geometric mean dose.
        """
        from scipy.optimize import isotonic_regression

        column = _channel_index(channel)
        order = np.argsort(self.doses, kind="stable")
        logarithms = np.log10(self.doses[order])
        density = np.log10(self.background[column] / self.pixels[order, column])
        blocks = isotonic_regression(density).blocks
        count = np.diff(blocks)
        density = np.add.reduceat(density, blocks[:-1]) / count
        if len(density) < 2 or self.doses.min() == self.doses.max():
            raise InputError(
                f"the calibration's {channel} channel does not darken with dose: expected lower "
                "pixels for larger doses; choose another channel or check the table"
            )
        return density, 10 ** (np.add.reduceat(logarithms, blocks[:-1]) / count)

    def log_error(self, doses: ArrayLike, channel: str = "red") -> FloatArray:
        """Return the standard deviation of the logarithm of a dose measured in one pixel."""
        column = _channel_index(channel)
        density, table_doses = self.curve(channel)
        order = np.argsort(self.doses, kind="stable")
        spread = (self.spreads[order, column] / self.pixels[order, column]) / np.log(10)
        spread = np.interp(np.log(table_doses), np.log(self.doses[order]), spread)
        # Growth of the dose with the density, over two films that are not neighbours.
        slope = np.gradient(np.log(table_doses), density)
        error = np.maximum(spread, 1e-4) * slope  # of the density, where the table has none
        return np.asarray(np.interp(np.log(np.asarray(doses, float)), np.log(table_doses), error))


def net_optical_density(
    scan: ArrayLike, background: float | Sequence[float] | ArrayLike, channel: str = "red"
) -> FloatArray:
    """Return the net optical density of a film, log10(unexposed / exposed).

    Parameters
    ----------
    scan : array_like, shape (H, W, 3) or (H, W, 4) or (H, W)
        Scan of the film in transmission, or one channel of it.
    background : float or array_like, shape (3,) or (H', W', 3)
        Pixel of unexposed film, one for each channel, or a scan of it: then the median of
        its middle half in height and width counts, since its rim shows the scanner's bed.
    channel : {"red", "green", "blue"}

    Returns
    -------
    ndarray of float64, shape (H, W)
        Net optical density: 0 for unexposed film, infinite for a black pixel.

    Raises
    ------
    InputError
        If a shape does not fit, or a value is negative or no number.

    Examples
    --------
    >>> net_optical_density([[1000, 100]], 1000.0)
    array([[0., 1.]])
    """
    plane = _check_plane(np.asarray(scan), channel, "scan")
    unexposed = _unexposed_level(np.asarray(background), channel)
    with np.errstate(divide="ignore"):
        return np.asarray(np.log10(unexposed) - np.log10(plane))


def _check_plane(scan: AnyArray, channel: str, name: str) -> FloatArray:
    column = _channel_index(channel)
    is_colour = scan.ndim == 3 and scan.shape[-1] in (3, 4)
    if scan.size == 0 or not (scan.ndim == 2 or is_colour):
        raise InputError(
            f"the {name} has shape {scan.shape}: expected (height, width) or (height, width, 3)"
        )
    plane = np.asarray(scan[..., column] if is_colour else scan, dtype=np.float64)
    if not (np.isfinite(plane) & (plane >= 0)).all():
        raise InputError(f"the {name} holds negative pixels or NaN: expected grey levels")
    return plane


def _unexposed_level(background: AnyArray, channel: str) -> float:
    if background.ndim == 0:
        value = float(background)
    elif background.shape == (3,):
        value = float(background[_channel_index(channel)])
    else:
        value = _median_of_middle(_check_plane(background, channel, "background"))
    if not (np.isfinite(value) and value > 0):
        raise InputError(f"the background is {value:g}: expected the pixel of unexposed film, > 0")
    return value


def checked_scan(scan: ArrayLike) -> AnyArray:
    """Return a colour scan without its alpha channel, or raise an `InputError`."""
    values = np.asarray(scan)
    if values.ndim != 3 or values.shape[-1] not in (3, 4) or not values.size:
        raise InputError(
            f"the scan has shape {values.shape}: expected (height, width, 3), in red, green and "
            "blue"
        )
    return values[..., :3]


def unexposed_pixel(scan: ArrayLike) -> FloatArray:
    """Return the pixel of unexposed film, (3,), from its scan; see `net_optical_density`."""
    planes = (_check_plane(np.asarray(scan), channel, "scan") for channel in _CHANNELS)
    return np.array([_median_of_middle(plane) for plane in planes])


def _median_of_middle(plane: FloatArray) -> float:
    y_top, x_left = (length // 4 for length in plane.shape)
    return float(np.median(plane[y_top : len(plane) - y_top, x_left : plane.shape[1] - x_left]))


def _channel_index(channel: str) -> int:
    if channel not in _CHANNELS:
        raise InputError(f'channel is {channel!r}: expected "red", "green" or "blue"')
    return _CHANNELS.index(channel)


def dose(
    scan: ArrayLike,
    calibration: Calibration,
    *,
    background: float | Sequence[float] | ArrayLike | None = None,
    channel: str = "red",
) -> DoseMap:
    """Return the dose in every pixel of a film.

    Parameters
    ----------
    scan, background, channel
        As for `net_optical_density`. The default background is the calibration's: then the scan
        must have been made with the same scanner and settings.
    calibration : Calibration
        Table for this kind of film.

    Raises
    ------
    InputError
        As `net_optical_density`, and if a scan with 8 bits comes without its background.

    Examples
    --------
    >>> grey = np.array([[40000.0], [4000.0], [400.0]])
    >>> film = Calibration(np.array([1.0, 10.0, 100.0]), np.repeat(grey, 3, axis=1))
    >>> dose([[4000, 400, 40]], film)
    DoseMap(dose=array([[ 10., 100., 100.]]), outside=array([[False, False,  True]]))
    """
    if background is None and np.asarray(scan).dtype == np.uint8:
        raise InputError(
            "the scan has 8 bits, calibrations have 16 and no background was given: give a scan "
            "of unexposed film as background"
        )
    unexposed = calibration.background if background is None else background
    density = net_optical_density(scan, unexposed, channel)
    densities, doses = calibration.curve(channel)
    # Rounding of the logarithms must not put the films of the table themselves outside.
    slack = 1e-12
    outside = (density < densities[0] - slack) | (density > densities[-1] + slack)
    return DoseMap(10 ** np.interp(density, densities, np.log10(doses)), outside)


class CombinedDose(NamedTuple):
    """Dose in every pixel of a film by all three channels.

    Attributes
    ----------
    dose : ndarray of float64, shape (H, W)
        Held at the end of the calibrated range outside of it.
    error : ndarray of float64, shape (H, W)
        Its standard deviation in a pixel, as a share of it: by the spread of the calibration's
        films, or by how far the channels differ if that is more.
    outside : ndarray of bool, shape (H, W)
        True where every channel is lighter or darker than any film of the table.
    """

    dose: FloatArray
    error: FloatArray
    outside: BoolArray


def combined_dose(
    scan: ArrayLike,
    calibration: Calibration,
    *,
    background: Sequence[float] | ArrayLike | None = None,
) -> CombinedDose:
    """Return the dose in every pixel by a weighted mean of the three channels.

    The logarithms of the doses by the three channels are averaged, each weighted by one over the
    square of its error: the spread of its pixels over how fast they darken. So red counts most
    where doses are small, and blue where red is nearly black.

    Parameters
    ----------
    scan, calibration, background
        As for `dose`, with all three channels.

    Raises
    ------
    InputError
        As `dose`, and if the scan has no colours.
    """
    values = checked_scan(scan)
    maps = {c: dose(values, calibration, background=background, channel=c) for c in _CHANNELS}
    logarithms = np.log([each.dose for each in maps.values()])
    errors = np.array([calibration.log_error(each.dose, c) for c, each in maps.items()])
    is_inside = ~np.array([each.outside for each in maps.values()])
    weights = np.where(is_inside, errors**-2, 0.0)
    outside = np.asarray(~is_inside.any(axis=0))
    total = np.where(outside, 1.0, weights.sum(axis=0))
    weighted = (weights * logarithms).sum(axis=0)
    mean = np.where(outside, np.median(logarithms, axis=0), weighted / total)
    # Of the mean, by how far the channels are from it.
    variance = (weights * logarithms**2).sum(axis=0) / total - mean**2
    scatter = np.sqrt(np.maximum(variance, 0.0) / np.maximum(is_inside.sum(axis=0) - 1, 1))
    error = np.maximum(1 / np.sqrt(total), scatter)
    return CombinedDose(np.exp(mean), np.where(outside, np.inf, error), outside)


def _films_of(path: Path) -> FloatArray:
    """Read dose and red, green and blue pixel of every film, then spreads if all are present."""
    table = read_table(path)
    names = [next((name for name in table.header if "dose" in name and "log" not in name), "dose")]
    for colour in _CHANNELS:
        names.append(next((name for name in table.header if name.startswith(colour)), colour))
    columns = [table.position_of(name) for name in names]
    spreads = [position + 1 for position in columns[1:]]
    header = [*table.header, ""]
    if all(header[position].startswith("std") for position in spreads):
        columns += spreads
    rows: list[list[float]] = []
    for line, cells in table.rows.items():
        picked = [cells[column] for column in columns]
        try:
            row = [float(cell) for cell in picked]
        except ValueError:
            if line == min(table.rows):  # it may contain units
                continue
            row = [np.nan]
        if not np.isfinite(row).all() or row[0] < 0:
            raise InputError(
                f"{path}, line {line} has {', '.join(map(repr, picked))[:80]}: expected a dose of "
                "0 or more and the pixels as numbers; correct or delete the row"
            )
        rows.append(row)
    return np.array(rows, dtype=np.float64).reshape(-1, len(columns))
