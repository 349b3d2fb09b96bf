"""Etched tracks in CR-39, one by one, and the image that they make.

- the tracks of a scan, and those within ranges of their properties: `Tracks`, `Tracks.select`
- the number of tracks in each bin: `Tracks.image`, `TrackImage`

Etching widens the trail of a charged particle to a pit, whose diameter depends on the particle and
its energy; pits of high contrast or eccentricity are often noise. Which ranges count has to be
found for each etching. `napari_shadowinv.io.read_tracks` reads a scan,
`napari_shadowinv.io.read_cpsa` makes an image of it at once.

References
----------
Séguin et al., "Spectrometry of charged particles from inertial-confinement-fusion plasmas",
Review of Scientific Instruments 74, 975 (2003).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from napari_shadowinv._typing import AnyArray, BoolArray, FloatArray
from napari_shadowinv.errors import InputError

__all__ = ["TrackImage", "Tracks"]

_TRACKS_PER_BIN = 50
_BINS_PER_SIDE = 300
_MOST_BINS = 100_000_000
_ON_THE_EDGE = 1e-9  # of a bin: rounding does not push a track out of the image
_MICRONS = 1e6  # in a metre


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
        return Tracks(
            self.y[is_inside],
            self.x[is_inside],
            self.diameter[is_inside],
            self.contrast[is_inside],
            self.eccentricity[is_inside],
            self.size,
        )

    def image(self, bin: float | None = None) -> TrackImage:
        """Count the tracks in square bins from the top left corner.

        Parameters
        ----------
        bin : float, optional
            Side of a bin in µm. Default: the smallest with a whole number of bins along the
            shorter side, at most 300 along the longer one, and 50 tracks in each on average.

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
        side = self._usual_bin() if bin is None else bin / _MICRONS
        if not (np.isfinite(side) and 0 < side <= min(self.size) / 2 * (1 + _ON_THE_EDGE)):
            raise InputError(
                f"bin is {side * _MICRONS:g} µm: expected at most half of the scanned area's "
                f"shorter side, {min(self.size) / 2 * _MICRONS:g} µm, and more than 0"
            )
        if self.size[0] * self.size[1] > _MOST_BINS * side**2:
            raise InputError(
                f"bin is {side * _MICRONS:g} µm: expected at most {_MOST_BINS} bins, on an area of "
                f"{self.size[0]:g} × {self.size[1]:g} m; choose larger bins"
            )
        height, width = (int(length / side + _ON_THE_EDGE) for length in self.size)
        row, column = self.y / side, self.x / side
        inside = (row >= -_ON_THE_EDGE) & (column >= -_ON_THE_EDGE)
        inside &= (row <= height + _ON_THE_EDGE) & (column <= width + _ON_THE_EDGE)
        rows = np.clip(row[inside].astype(np.int64), 0, height - 1)
        columns = np.clip(column[inside].astype(np.int64), 0, width - 1)
        hits = np.bincount(rows * width + columns, minlength=height * width)
        counts = hits.reshape(height, width).astype(np.uint32)
        return TrackImage(counts, np.sqrt(np.maximum(counts, 1.0)), float(side * _MICRONS))

    def _usual_bin(self) -> float:
        height, width = self.size
        filled = np.sqrt(_TRACKS_PER_BIN * height * width / len(self))
        target = max(filled, max(self.size) / _BINS_PER_SIDE)
        # A whole number of bins along the shorter side, so that little is cut off.
        return min(self.size) / max(2, int(min(self.size) / target + _ON_THE_EDGE))


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
