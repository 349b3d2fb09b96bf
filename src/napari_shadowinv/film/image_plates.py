"""Image plates: from a scanner's values to the luminescence of the plate.

- values on a logarithmic scale, as Fuji's scanners write them: `fuji_luminescence`
- roots, as GE's scanners write them to ``.gel``: `ge_luminescence`
- which share is left some time after the exposure: `fading`

Both give photostimulated luminescence (PSL), which is proportional to the energy deposited in
the plate. An inversion needs it up to a factor only, so fading, which is the same for all of a
plate, matters where plates are compared.

References
----------
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

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from napari_shadowinv._typing import BoolArray, FloatArray
from napari_shadowinv.errors import InputError

__all__ = ["Luminescence", "fading", "fuji_luminescence", "ge_luminescence"]

# Share and decay time in minutes of the two parts of the signal: Boutoux et al.
_FADING = {
    "MS": ((0.334, 107.32), (0.666, 33974.0)),
    "SR": ((0.579, 15.052), (0.421, 3829.5)),
    "TR": ((0.535, 23.812), (0.465, 3837.2)),
    "MP": ((0.565, 18.461), (0.435, 6117.5)),
}
_LONGEST = 4000.0  # min, to which the fit was made


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
    scan: ArrayLike,
    *,
    resolution: float,
    sensitivity: float,
    latitude: float = 5.0,
    bits: int = 16,
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
    scan: ArrayLike,
    *,
    resolution: float,
    sensitivity: float,
    latitude: float = 5.0,
    bits: int = 16,
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
    if not 0 <= minutes <= _LONGEST:
        raise InputError(
            f"the plate was scanned after {minutes:g} min: expected 0 to {_LONGEST:g}, for which "
            "its fading is known"
        )
    return float(sum(share * np.exp(-minutes / time) for share, time in _FADING[plate]))
