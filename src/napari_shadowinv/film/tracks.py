"""Etched tracks of a scanned piece of CR-39: `Tracks`, and their number in bins: `TrackImage`.

Etching widens the trail of a charged particle to a pit, whose diameter depends on the particle and
its energy; pits of high contrast or eccentricity are often noise. Which ranges count has to be
found for each etching. `napari_shadowinv.io.read_tracks` reads a scan, and
`napari_shadowinv.read` makes an image of it at once.

References
----------
Séguin et al., "Spectrometry of charged particles from inertial-confinement-fusion plasmas",
Review of Scientific Instruments 74, 975 (2003).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

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
