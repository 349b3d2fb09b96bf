"""Objects whose potential and displacement are known exactly.

- the paper's experiment and its toroidal magnetic field: `paper_setup`, `toroid`
- a building block, round or elliptical: `gaussian_blob`; phantoms are added with ``+``
- an object that no flip, shift or swap of axes leaves as it is: `ellipse_pair`
- what they are: `Phantom`
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from napari_shadowinv.errors import InputError
from napari_shadowinv.physics.setup import ProtonSetup

__all__ = ["Phantom", "ellipse_pair", "gaussian_blob", "paper_setup", "toroid"]

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Phantom:
    """An object's exact potential and displacement, at the pixels' centres.

    Attributes
    ----------
    potential : ndarray of float64, shape (H, W)
        Normalised potential φ in px², zero far away from the object.
    displacement : ndarray of float64, shape (2, H, W)
        Displacement d = -∇φ in px, axis order (y, x).
    """

    potential: FloatArray
    displacement: FloatArray

    def __add__(self, other: Phantom) -> Phantom:
        """Both objects in one beam: thin objects' deflections add up."""
        if not isinstance(other, Phantom):
            return NotImplemented
        if self.potential.shape != other.potential.shape:
            raise InputError(
                f"phantoms have shapes {self.potential.shape} and {other.potential.shape}: "
                "they must match"
            )
        return Phantom(self.potential + other.potential, self.displacement + other.displacement)


def paper_setup() -> ProtonSetup:
    """Return the experiment of the paper's benchmark.

    Returns
    -------
    ProtonSetup
        Protons of 14.7 MeV, 1.3 mm from source to object, 2 cm on to the detector, pixels
        of 1.5 µm in the object plane: 200 pixels are ten times the toroid's σ of 30 µm.

    References
    ----------
    Kasim et al., arXiv:1607.04179, Section IV A.

    Examples
    --------
    >>> paper_setup().magnification
    16.38
    """
    return ProtonSetup(
        energy=14.7,
        source_object_distance=1.3e-3,
        object_image_distance=2e-2,
        pixel_size=1.5e-6,
    )


def toroid(
    shape: tuple[int, int],
    setup: ProtonSetup,
    peak: float,
    sigma: float,
    center: tuple[float, float] | None = None,
) -> Phantom:
    """Toroidal magnetic field with -∫B × dz = D_m exp(-r²/2σ² + ½) r/σ.

    A positive peak deflects positive charges outwards.

    Parameters
    ----------
    shape : tuple of int
        Height and width of the image.
    setup : ProtonSetup
        The beam; its momentum is relativistic.
    peak : float
        Path-integrated field D_m in MG µm, reached at r = σ.
    sigma : float
        Radius σ in m, in the object plane.
    center : tuple of float, optional
        Centre (y, x) in px, may be fractional. Default: the image's centre.

    Returns
    -------
    Phantom
        Potential and displacement.

    Raises
    ------
    InputError
        If the shape or sigma is not positive, or a number is not finite.

    References
    ----------
    Kasim et al., arXiv:1607.04179, Eq. 10.

    Examples
    --------
    >>> phantom = toroid((200, 200), paper_setup(), peak=97, sigma=30e-6)
    >>> field = paper_setup().path_integrated_b(phantom.displacement, "MG um")
    >>> float(np.hypot(*field).max())
    96.99
    """
    _positive("sigma", sigma, "m")
    # At r = σ on the x axis, -B × dz points outwards where B_y is negative.
    displacement = float(setup.displacement_from_path_integrated_b([-peak, 0.0], "MG um")[1])
    sigma_px = sigma / setup.object_pixel_size
    return gaussian_blob(shape, displacement * sigma_px * np.exp(0.5), sigma_px, center)


def gaussian_blob(
    shape: tuple[int, int],
    amplitude: float,
    sigma: float | tuple[float, float],
    center: tuple[float, float] | None = None,
    angle: float = 0.0,
) -> Phantom:
    """Potential φ = A exp(-½ (u²/σ_u² + v²/σ_v²)) with u, v along the ellipse's axes.

    Parameters
    ----------
    shape : tuple of int
        Height and width of the image.
    amplitude : float
        Amplitude A in px²; positive drives rays apart, negative gathers them.
    sigma : float or tuple of float
        Radius in px, or the radii (σ_u, σ_v); without rotation u is along y, v along x.
    center : tuple of float, optional
        Centre (y, x) in px, may be fractional. Default: the image's centre.
    angle : float, default 0
        Angle in rad by which the u axis is turned from y towards x.

    Returns
    -------
    Phantom
        Potential and displacement.

    Raises
    ------
    InputError
        If the shape or a radius is not positive, or a number is not finite.

    Examples
    --------
    >>> float(gaussian_blob((5, 5), amplitude=2.0, sigma=1.5).potential[2, 2])
    2.0
    """
    sigma_u, sigma_v = sigma if isinstance(sigma, tuple) else (sigma, sigma)
    for radius in (sigma_u, sigma_v):
        _positive("sigma", radius, "px")
    if not np.isfinite([amplitude, angle]).all():
        raise InputError(f"amplitude is {amplitude}, angle {angle}: both must be finite")
    y, x = _offsets(shape, center)
    cosine, sine = np.cos(angle), np.sin(angle)
    u = (y * cosine + x * sine) / sigma_u
    v = (x * cosine - y * sine) / sigma_v
    potential = amplitude * np.exp(-0.5 * (u**2 + v**2))
    along_y = potential * (u * cosine / sigma_u - v * sine / sigma_v)
    along_x = potential * (u * sine / sigma_u + v * cosine / sigma_v)
    return Phantom(potential, np.stack([along_y, along_x]))


def ellipse_pair(shape: tuple[int, int], strength: float = 1.0) -> Phantom:
    """Two different elliptical blobs off the centre, turned, of opposite sign.

    No symmetry of the square maps it onto itself: an inversion that mixes up axes, signs or
    half pixels cannot get it right.

    Parameters
    ----------
    shape : tuple of int
        Height and width of the image; the blobs scale with the smaller one.
    strength : float, default 1
        Factor on both amplitudes. At 1 the Jacobian is between 0.5 and 2.5; folds form
        from about 2.4.

    Returns
    -------
    Phantom
        Potential and displacement.

    Raises
    ------
    InputError
        If the shape is not positive, or the strength is not finite.
    """
    height, width = shape
    unit = min(height, width) / 100
    first = gaussian_blob(
        shape,
        45.0 * strength * unit**2,
        (7.0 * unit, 12.0 * unit),
        (0.37 * height, 0.42 * width),
        0.5,
    )
    second = gaussian_blob(
        shape,
        -15.0 * strength * unit**2,
        (10.0 * unit, 6.0 * unit),
        (0.63 * height, 0.66 * width),
        0.3,
    )
    return first + second


def _offsets(
    shape: tuple[int, int], center: tuple[float, float] | None
) -> tuple[FloatArray, FloatArray]:
    """Distances in y and x of the pixels' centres from a point, broadcastable."""
    height, width = shape
    if height < 1 or width < 1:
        raise InputError(f"shape is {shape}: height and width must be 1 or more")
    y, x = ((height - 1) / 2, (width - 1) / 2) if center is None else center
    if not np.isfinite([y, x]).all():
        raise InputError(f"center is {center}: expected finite (y, x) in px")
    rows, columns = np.arange(height, dtype=np.float64), np.arange(width, dtype=np.float64)
    return rows[:, None] - y, columns[None, :] - x


def _positive(name: str, value: float, unit: str) -> None:
    if not (np.isfinite(value) and value > 0):
        raise InputError(f"{name} is {value}: it must be positive, in {unit}")
