"""Radiochromic film: from the scan to the dose that the beam left.

- a table of doses and the pixels that they gave: `Calibration`, `Calibration.from_csv`
- how much darker than unexposed film: `net_optical_density`
- the dose in every pixel, and where the table does not reach: `dose`

Film darkens with dose; the net optical density log10(unexposed / exposed) does not depend
on the scanner's gain, so a table can serve scans of another day if unexposed film was
scanned with them. Fluence is proportional to dose as long as the particles of a layer lose
about the same energy in it. Doses are in Gy; a `channel` is "red", the default, which tells
small doses best, "green" or "blue".

References
----------
Devic et al., "Precise radiochromic film dosimetry using a flat-bed document scanner",
Medical Physics 32, 2245 (2005).
"""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from napari_shadowinv._system.safety import refusing_damage, small_text
from napari_shadowinv._typing import AnyArray, BoolArray, FloatArray
from napari_shadowinv.errors import FileFormatError, InputError

__all__ = ["Calibration", "DoseMap", "dose", "net_optical_density"]

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

    Raises
    ------
    InputError
        If there are fewer than two films, or a value is not positive.

    Examples
    --------
    >>> grey = np.array([[40000.0], [4000.0], [400.0]])
    >>> film = Calibration(np.array([1.0, 10.0, 100.0]), np.repeat(grey, 3, axis=1))
    >>> film.optical_density([1.0, 10.0, 100.0]), film.dose_range()
    (array([0., 1., 2.]), (1.0, 100.0))
    """

    doses: FloatArray
    pixels: FloatArray
    background: FloatArray = field(default_factory=lambda: np.empty(0))

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
        for name, values in (("doses", doses), ("pixels", pixels), ("background", background)):
            if not (np.isfinite(values) & (values > 0)).all():
                raise InputError(f"a calibration's {name} must be positive numbers; correct them")
            # Frozen, but what was given may have been lists.
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
            Comma-separated values. The first line names the columns: one holds "dose" but not
            "log", others begin with "red", "green" and "blue"; the rest is ignored. A second
            line may tell units.
        background : array_like, shape (3,), optional
            Pixel of unexposed film.
        dose_range : tuple of float
            Smallest and largest dose of the rows to use. Tables are often continued by
            extrapolation; leave that part out here.

        Raises
        ------
        FileFormatError
            If the file is missing, has no such columns, or a row holds anything but numbers;
            the message tells the line.
        """
        table = _rows(path)
        used = table[(table[:, 0] >= dose_range[0]) & (table[:, 0] <= dose_range[1])]
        if len(used) < 2:
            raise InputError(
                f"{path} has {len(used)} films between {dose_range[0]:g} and {dose_range[1]:g} "
                "Gy: expected at least two; widen dose_range"
            )
        empty = np.empty(0) if background is None else np.asarray(background, float)
        return cls(used[:, 0], used[:, 1:], empty)

    def curve(self, channel: str = "red") -> tuple[FloatArray, FloatArray]:
        """Return net optical density and dose of one channel, both strictly increasing, shape (m,).

        Neighbours that noise put in the wrong order count as one film, with their mean density and
        geometric mean dose.
        """
        from scipy.optimize import isotonic_regression

        column = _channel(channel)
        order = np.argsort(self.doses, kind="stable")
        logarithms = np.log10(self.doses[order])
        density = np.log10(self.background[column] / self.pixels[order, column])
        blocks = isotonic_regression(density).blocks
        count = np.diff(blocks)
        density = np.add.reduceat(density, blocks[:-1]) / count
        if len(density) < 2:
            raise InputError(
                f"the calibration's {channel} channel does not darken with dose: expected lower "
                "pixels for larger doses; choose another channel or check the table"
            )
        return density, 10 ** (np.add.reduceat(logarithms, blocks[:-1]) / count)

    def dose_range(self, channel: str = "red") -> tuple[float, float]:
        """Return the smallest and the largest dose that a channel can tell."""
        doses = self.curve(channel)[1]
        return float(doses[0]), float(doses[-1])

    def optical_density(self, doses: ArrayLike, channel: str = "red") -> FloatArray:
        """Return the net optical density that doses give, held at the range's ends.

        It is linear in the logarithm of the dose between films; `dose` is its inverse.
        """
        density, known = self.curve(channel)
        logarithms = np.log10(np.asarray(doses, float))
        return np.asarray(np.interp(logarithms, np.log10(known), density))


def net_optical_density(
    scan: ArrayLike, background: float | Sequence[float] | ArrayLike, channel: str = "red"
) -> FloatArray:
    """Return how much darker a film is than unexposed film: log10(unexposed / exposed).

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
    plane = _plane(np.asarray(scan), channel, "scan")
    unexposed = _unexposed(np.asarray(background), channel)
    with np.errstate(divide="ignore"):
        density: FloatArray = np.log10(unexposed) - np.log10(plane)
    return density


def _plane(scan: AnyArray, channel: str, name: str) -> FloatArray:
    column = _channel(channel)
    is_colour = scan.ndim == 3 and scan.shape[-1] in (3, 4)
    if scan.size == 0 or not (scan.ndim == 2 or is_colour):
        raise InputError(
            f"the {name} has shape {scan.shape}: expected (height, width) or (height, width, 3)"
        )
    plane = np.asarray(scan[..., column] if is_colour else scan, dtype=np.float64)
    if not (np.isfinite(plane) & (plane >= 0)).all():
        raise InputError(f"the {name} holds negative pixels or NaN: expected grey levels")
    return plane


def _unexposed(background: AnyArray, channel: str) -> float:
    if background.ndim == 0:
        value = float(background)
    elif background.shape == (3,):
        value = float(background[_channel(channel)])
    else:
        plane = _plane(background, channel, "background")
        top, left = (length // 4 for length in plane.shape)
        middle = plane[top : len(plane) - top, left : plane.shape[1] - left]
        value = float(np.median(middle))
    if not (np.isfinite(value) and value > 0):
        raise InputError(f"the background is {value:g}: expected the pixel of unexposed film, > 0")
    return value


def _channel(channel: str) -> int:
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
    known, doses = calibration.curve(channel)
    # Rounding of the logarithms must not put the films of the table themselves outside.
    slack = 1e-12
    outside = (density < known[0] - slack) | (density > known[-1] + slack)
    return DoseMap(10 ** np.interp(density, known, np.log10(doses)), outside)


@refusing_damage
def _rows(path: Path) -> FloatArray:
    """Dose and red, green and blue pixel of every film in a table, shape (n, 4)."""
    text = small_text(path, "a calibration table, comma-separated values", "utf-8-sig")
    lines = list(csv.reader(text.splitlines()))
    columns = _columns(path, [name.strip().lower() for name in lines[0]] if lines else [])
    rows: list[list[float]] = []
    for number, cells in enumerate(lines[1:], start=2):
        picked = [cells[column] if column < len(cells) else "" for column in columns]
        try:
            rows.append([float(cell) for cell in picked])
        except ValueError:
            has_units = number == 2
            if any(cell.strip() for cell in cells) and not has_units:
                raise FileFormatError(
                    f"{path}, line {number} has {', '.join(map(repr, picked))[:80]}: expected a "
                    "dose and three pixels as numbers; correct it"
                ) from None
    return np.array(rows, dtype=np.float64).reshape(-1, 4)


def _columns(path: Path, names: list[str]) -> list[int]:
    found = [[at for at, name in enumerate(names) if "dose" in name and "log" not in name]]
    for colour in ("red", "green", "blue"):
        found.append([at for at, name in enumerate(names) if name.startswith(colour)])
    if not all(found):
        raise FileFormatError(
            f"{path} has the columns {', '.join(map(repr, names)) or 'none'}: expected one with "
            "'dose', and columns whose names begin with 'red', 'green' and 'blue'"
        )
    return [candidates[0] for candidates in found]
