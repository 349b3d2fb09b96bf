"""Detectors other than film: CR-39 and image plates.

- the etched tracks of a scan of CR-39, and those within ranges of their properties: `Tracks`,
  `Tracks.select`; the number of tracks in each bin: `Tracks.image`, `TrackImage`
- luminescence of an image plate from values on a logarithmic scale, as Fuji's scanners write them:
  `fuji_luminescence`; from roots, as GE's scanners write them to ``.gel``: `ge_luminescence`
- which share of it is left some time after the exposure: `fading`

Etching widens the trail of a charged particle to a pit, whose diameter depends on the particle and
its energy; pits of high contrast or eccentricity are often noise. Which ranges count has to be
found for each etching. `napari_shadowinv.io.read_tracks` reads a scan, and
`napari_shadowinv.read` makes an image of it at once.

Photostimulated luminescence (PSL) is proportional to the energy deposited in the plate. An
inversion needs it up to a factor only, so fading, which is the same for all of a plate, matters
where plates are compared.

References
----------
Séguin et al., "Spectrometry of charged particles from inertial-confinement-fusion plasmas",
Review of Scientific Instruments 74, 975 (2003).

Maddox et al., "High-energy x-ray backlighter spectrum measurements using calibrated image
plates", Review of Scientific Instruments 82, 023111 (2011).

Williams et al., "Calibration and equivalency analysis of image plate scanners", Review of
Scientific Instruments 85, 11E604 (2014).

Bonnet et al., "Response functions of imaging plates to photons, electrons and 4He particles",
Review of Scientific Instruments 84, 103510 (2013).

Boutoux et al., "Study of imaging plate detector sensitivity to 5-18 MeV electrons", Review of
Scientific Instruments 86, 113304 (2015).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from napari_shadowinv._typing import AnyArray, BoolArray, FloatArray
from napari_shadowinv.errors import InputError

_EDGE_TOLERANCE_BINS = 1e-9  # rounding does not push a track out of the image


class TrackImage(NamedTuple):
    """Tracks counted in square bins.

    Attributes
    ----------
    counts : ndarray of uint32, shape (H, W)
        Number of tracks; the fluence is ``counts`` over the bin's area.
    error : ndarray of float64, shape (H, W)
        Standard deviation by Poisson's law: the root of the number, and 1 where it is 0.
    bin : float
        Side of a bin in µm of the detector.
    """

    counts: NDArray[np.uint32]
    error: FloatArray
    bin: float


@dataclass(frozen=True, eq=False)
class Tracks:
    """Tracks of a scanned piece of CR-39.

    Attributes
    ----------
    y, x : ndarray of float64, shape (n,)
        Distances in m down and right from the top left corner of the scanned area.
    diameter : ndarray, shape (n,)
        In µm.
    contrast, eccentricity : ndarray, shape (n,)
        As the scanning program gives them, from 0 to about 100.
    size : tuple of float
        Height and width of the scanned area in m.
    """

    y: FloatArray
    x: FloatArray
    diameter: AnyArray
    contrast: AnyArray
    eccentricity: AnyArray
    size: tuple[float, float]

    def __len__(self) -> int:
        return len(self.y)

    def select(
        self,
        *,
        diameter: tuple[float | None, float | None] | None = None,
        contrast: tuple[float | None, float | None] | None = None,
        eccentricity: tuple[float | None, float | None] | None = None,
    ) -> Tracks:
        """Return the tracks within ranges.

        Parameters
        ----------
        diameter, contrast, eccentricity : tuple of float or None, optional
            Smallest and largest value, both of which count; None for no limit.

        Raises
        ------
        InputError
            If a range is not two numbers in their order.

        Examples
        --------
        >>> place, width = np.array([0.1, 0.2]), np.array([3.0, 8.0])
        >>> tracks = Tracks(place, place, width, width, width, (1.0, 1.0))
        >>> len(tracks.select(diameter=(4, None)))
        1
        """
        ranges = {"diameter": diameter, "contrast": contrast, "eccentricity": eccentricity}
        is_inside = np.ones(len(self), bool)
        for name, limits in ranges.items():
            if limits is not None:
                is_inside &= _within(getattr(self, name), name, limits)
        columns = {name: getattr(self, name)[is_inside] for name in ("y", "x", *ranges)}
        return replace(self, **columns)

    def image(
        self, bin: float | None = None, *, tracks_per_bin: float = 50, bins_per_side: int = 300
    ) -> TrackImage:
        """Count the tracks in square bins from the top left corner.

        Parameters
        ----------
        bin : float, optional
            Side of a bin in µm. Default: the smallest with a whole number of bins along the
            shorter side, at most `bins_per_side` along the longer one, and `tracks_per_bin` in
            each on average.
        tracks_per_bin, bins_per_side : number, default 50 and 300
            Of the usual bin.

        Returns
        -------
        TrackImage
            Incomplete bins at the right and lower edge are cut off.

        Raises
        ------
        InputError
            If there is no track, or the bins are too large or too small for the area.
        """
        if not len(self):
            raise InputError(
                "no track lies within the ranges: expected at least one; widen diameter, contrast "
                "or eccentricity"
            )
        if bin is not None:
            side = bin / 1e6
        else:
            filled = np.sqrt(tracks_per_bin * self.size[0] * self.size[1] / len(self))
            target = max(filled, max(self.size) / bins_per_side)
            # A whole number of bins along the shorter side, so that little is cut off.
            side = min(self.size) / max(2, int(min(self.size) / target + _EDGE_TOLERANCE_BINS))
        if not (np.isfinite(side) and 0 < side <= min(self.size) / 2 * (1 + _EDGE_TOLERANCE_BINS)):
            raise InputError(
                f"bin is {side * 1e6:g} µm: expected at most half of the scanned area's "
                f"shorter side, {min(self.size) / 2 * 1e6:g} µm, and more than 0"
            )
        if self.size[0] * self.size[1] > 1e8 * side**2:
            raise InputError(
                f"bin is {side * 1e6:g} µm: expected at most 100000000 bins, on an "
                f"area of {self.size[0]:g} × {self.size[1]:g} m; choose larger bins"
            )
        height, width = (int(length / side + _EDGE_TOLERANCE_BINS) for length in self.size)
        row, column = self.y / side, self.x / side
        inside = (row >= -_EDGE_TOLERANCE_BINS) & (column >= -_EDGE_TOLERANCE_BINS)
        inside &= (row <= height + _EDGE_TOLERANCE_BINS) & (column <= width + _EDGE_TOLERANCE_BINS)
        rows = np.clip(row[inside].astype(np.int64), 0, height - 1)
        columns = np.clip(column[inside].astype(np.int64), 0, width - 1)
        hits = np.bincount(rows * width + columns, minlength=height * width)
        counts = hits.reshape(height, width).astype(np.uint32)
        return TrackImage(counts, np.sqrt(np.maximum(counts, 1.0)), float(side * 1e6))


def _within(values: AnyArray, name: str, limits: tuple[float | None, float | None]) -> BoolArray:
    try:
        low, high = limits
        ends = (-np.inf if low is None else float(low), np.inf if high is None else float(high))
    except (TypeError, ValueError):
        ends = (np.nan, np.nan)
    if not ends[0] <= ends[1]:
        raise InputError(
            f"{name} is {limits!r}: expected its smallest and its largest value, such as (4, 12), "
            "with None for no limit"
        )
    return np.asarray((values >= ends[0]) & (values <= ends[1]))


# Share and decay time in minutes of the two parts of the signal, fitted to measurements of up to
# 4000 minutes: Boutoux et al.
_FADING = {
    "MS": ((0.334, 107.32), (0.666, 33974.0)),
    "SR": ((0.579, 15.052), (0.421, 3829.5)),
    "TR": ((0.535, 23.812), (0.465, 3837.2)),
    "MP": ((0.565, 18.461), (0.435, 6117.5)),
}


class Luminescence(NamedTuple):
    """Luminescence in every pixel of a plate.

    Attributes
    ----------
    psl : ndarray of float64, shape (H, W)
        In PSL.
    saturated : ndarray of bool, shape (H, W)
        True where the scanner was at the end of its scale: there it was at least `psl`, and the
        pixel cannot be used.
    """

    psl: FloatArray
    saturated: BoolArray


def fuji_luminescence(
    scan: ArrayLike, *, resolution: float, sensitivity: float, latitude: float = 5.0, bits: int = 16
) -> Luminescence:
    """Convert values on a logarithmic scale, as Fuji's scanners write them.

    With G the value, PSL = (R/100)² · 4000/S · 10^(L·(G/(2^bits - 1) - 1/2)) (Maddox et al.).

    Parameters
    ----------
    scan : array_like, shape (H, W)
        Values as they stand in the file.
    resolution : float
        R, side of a pixel in µm.
    sensitivity : float
        S, the scanner's setting, such as 1000, 4000 or 10000.
    latitude : float
        L, decades that the scale spans, the scanner's setting.
    bits : int
        Depth of the values.

    Raises
    ------
    InputError
        If a value is outside of the scale, or a setting is not positive.

    Examples
    --------
    >>> fuji_luminescence([[0, 65535]], resolution=100, sensitivity=4000, latitude=4).psl
    array([[1.e-02, 1.e+02]])
    """
    values, saturated = _scale(scan, bits)
    factor = _factor(resolution, sensitivity, latitude)
    return Luminescence(factor * 10 ** (latitude * (values - 1)), saturated)


def ge_luminescence(
    scan: ArrayLike, *, resolution: float, sensitivity: float, latitude: float = 5.0, bits: int = 16
) -> Luminescence:
    """Convert roots of the signal, as GE's scanners write them to ``.gel``.

    With G the value, PSL = (G/(2^bits - 1))² · (R/100)² · 4000/S · 10^(L/2) (Williams et al.).

    Parameters
    ----------
    scan, resolution, latitude, bits
        As for `fuji_luminescence`.
    sensitivity : float
        S of a Fuji scanner with the same gain. The voltage of the photomultiplier sets it:
        Williams et al. measured h = 4000/S, which is 4, 1 and 0.4 at S = 1000, 4000 and 10000.

    Raises
    ------
    InputError
        As `fuji_luminescence`.

    Examples
    --------
    >>> ge_luminescence([[0, 65535]], resolution=100, sensitivity=4000, latitude=4).psl
    array([[  0., 100.]])
    """
    values, saturated = _scale(scan, bits)
    return Luminescence(_factor(resolution, sensitivity, latitude) * values**2, saturated)


def _scale(scan: ArrayLike, bits: int) -> tuple[FloatArray, BoolArray]:
    """Return values as shares of the scale, and the saturated pixels."""
    values = np.asarray(scan, dtype=np.float64)
    if not 1 <= bits <= 32:
        raise InputError(f"bits is {bits}: expected the depth of the scan, 8 or 16")
    white = 2.0**bits - 1
    if values.ndim != 2 or not values.size:
        raise InputError(f"the scan has shape {values.shape}: expected (height, width)")
    if not ((values >= 0) & (values <= white)).all():
        raise InputError(
            f"the scan holds values from {values.min():g} to {values.max():g}: expected 0 to "
            f"{white:g} for {bits} bits, as the scanner wrote them"
        )
    return values / white, values == white


def _factor(resolution: float, sensitivity: float, latitude: float) -> float:
    """Return the luminescence at the end of the scale."""
    settings = {"resolution": resolution, "sensitivity": sensitivity, "latitude": latitude}
    for name, value in settings.items():
        if not 0 < value < np.inf:
            raise InputError(f"{name} is {value:g}: expected the scanner's setting, above 0")
    return float((resolution / 100) ** 2 * (4000 / sensitivity) * 10 ** (latitude / 2))


def fading(minutes: float, plate: str) -> float:
    """Return the remaining share of the luminescence; divide by it to correct a scan.

    It is a sum of two exponentials fitted to measurements (Boutoux et al.). Other measurements
    differ: for MS after an hour Bonnet et al. have 0.78, this function 0.86.

    Parameters
    ----------
    minutes : float
        Time from exposure to scan, up to 4000 min.
    plate : {"MS", "SR", "TR", "MP"}
        Kind of Fuji plate (BAS-…).

    Raises
    ------
    InputError
        If the plate is of no known kind, or the time outside of the fit.

    Examples
    --------
    >>> round(fading(60, "TR"), 3)
    0.501
    """
    if plate not in _FADING:
        raise InputError(f"plate is {plate!r}: expected one of {', '.join(_FADING)}")
    if not 0 <= minutes <= 4000:
        raise InputError(
            f"the plate was scanned after {minutes:g} min: expected 0 to 4000, for which its "
            "fading is known"
        )
    return float(sum(share * np.exp(-minutes / time) for share, time in _FADING[plate]))
