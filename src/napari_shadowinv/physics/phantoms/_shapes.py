"""The class of a phantom, and building blocks: one object each."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from napari_shadowinv._typing import FloatArray
from napari_shadowinv.errors import InputError
from napari_shadowinv.physics.setup import ProtonSetup

Radii = float | tuple[float, float]
Center = tuple[float, float] | None


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


def offsets(shape: tuple[int, int], center: Center) -> tuple[FloatArray, FloatArray]:
    """Distances in y and x of the pixels' centres from a point, broadcastable."""
    height, width = shape
    if height < 1 or width < 1:
        raise InputError(f"shape is {shape}: height and width must be 1 or more")
    y, x = ((height - 1) / 2, (width - 1) / 2) if center is None else center
    if not np.isfinite([y, x]).all():
        raise InputError(f"center is {center}: expected finite (y, x) in px")
    rows, columns = np.arange(height, dtype=np.float64), np.arange(width, dtype=np.float64)
    return rows[:, None] - y, columns[None, :] - x


def require_positive(name: str, value: float, unit: str) -> None:
    if not (np.isfinite(value) and value > 0):
        raise InputError(f"{name} is {value}: it must be positive, in {unit}")


def require_finite(**values: float) -> None:
    if not np.isfinite(list(values.values())).all():
        received = ", ".join(f"{name} {value}" for name, value in values.items())
        verb = "it must" if len(values) == 1 else "all must"
        raise InputError(f"received {received}: {verb} be finite")


def toroid(
    shape: tuple[int, int],
    setup: ProtonSetup,
    peak: float,
    sigma: Radii,
    center: Center = None,
    angle: float = 0.0,
) -> Phantom:
    """Toroidal magnetic field with -∫B × dz = D_m exp(-r²/2σ² + ½) r/σ.

    Parameters
    ----------
    shape, setup, center, angle
    peak : float
        Path-integrated field D_m in MG µm, reached at r = σ; Eq. 10 of the paper.
    sigma : float or tuple of float
        Radius σ in m, in the object plane; two radii (σ_u, σ_v) stretch the potential to
        an ellipse, whose field reaches the peak on its shorter axis.

    Examples
    --------
    >>> from napari_shadowinv.physics.phantoms import paper_setup
    >>> phantom = toroid((200, 200), paper_setup(), peak=97, sigma=30e-6)
    >>> field = paper_setup().path_integrated_b(phantom.displacement, "MG um")
    >>> float(np.hypot(*field).max())
    96.99
    """
    sigmas = _pixels_of(setup, "sigma", sigma)
    amplitude = outward_displacement(setup, peak) * min(sigmas) * np.exp(0.5)
    return gaussian_blob(shape, amplitude, sigmas, center, angle)


def gaussian_blob(
    shape: tuple[int, int],
    amplitude: float,
    sigma: Radii,
    center: Center = None,
    angle: float = 0.0,
) -> Phantom:
    """Potential φ = A exp(-½ (u²/σ_u² + v²/σ_v²)) with u, v along the ellipse's axes.

    Parameters
    ----------
    shape, center, angle
    amplitude : float
        Amplitude A in px²; positive drives rays apart, negative gathers them.
    sigma : float or tuple of float
        Radius in px, or the radii (σ_u, σ_v); without rotation u is along y, v along x.
    """
    radii = _checked_radii("sigma", sigma, "px")
    require_finite(amplitude=amplitude, angle=angle)
    u, v = _ellipse_axes(shape, radii, center, angle)
    potential = amplitude * np.exp(-0.5 * (u**2 + v**2))
    return Phantom(potential, _along_axes(potential * u, potential * v, radii, angle))


def cosine_toroid(
    shape: tuple[int, int],
    setup: ProtonSetup,
    peak: float,
    radius: Radii,
    center: Center = None,
    angle: float = 0.0,
) -> Phantom:
    """Toroidal magnetic field whose potential is a cos² that ends at a rim; Fig. 6 (b).

    The potential is A cos²(πρ/2) inside the ellipse ρ² = u²/R_u² + v²/R_v² < 1 and zero
    outside. Potential and field are continuous; the field's slope jumps at the rim, so the
    image has a sharp edge there.

    Parameters
    ----------
    shape, setup, center, angle
    peak : float
        Largest path-integrated field in MG µm, half-way to the rim on the shorter axis.
    radius : float or tuple of float
        Radius, or the half axes (R_u, R_v), in m in the object plane.
    """
    radii = _pixels_of(setup, "radius", radius)
    require_finite(peak=peak, angle=angle)
    amplitude = outward_displacement(setup, peak) * min(radii) * 2 / np.pi
    u, v = _ellipse_axes(shape, radii, center, angle)
    rho = np.hypot(u, v)
    inside = rho < 1
    potential = np.where(inside, amplitude * np.cos(np.pi / 2 * rho) ** 2, 0.0)
    # -φ'(ρ)/ρ; numpy's sinc is sin(πρ)/(πρ), finite in the centre
    slope = np.where(inside, amplitude * np.pi**2 / 2 * np.sinc(rho), 0.0)
    return Phantom(potential, _along_axes(slope * u, slope * v, radii, angle))


def outward_displacement(setup: ProtonSetup, field: float) -> float:
    """Displacement in px, away from the centre, by a counter-clockwise field in MG µm."""
    # On the x axis -B × dz points outwards where B_y is negative.
    return float(setup.displacement_from_path_integrated_b([-field, 0.0], "MG um")[1])


def _pixels_of(setup: ProtonSetup, name: str, lengths: Radii) -> tuple[float, float]:
    u, v = _checked_radii(name, lengths, "m")
    return u / setup.object_pixel_size, v / setup.object_pixel_size


def _checked_radii(name: str, radii: Radii, unit: str) -> tuple[float, float]:
    pair = radii if isinstance(radii, tuple) else (radii, radii)
    if len(pair) != 2:
        raise InputError(f"{name} is {pair}: expected one number or two, in {unit}")
    for radius in pair:
        require_positive(name, radius, unit)
    return pair


def _ellipse_axes(
    shape: tuple[int, int], radii: tuple[float, float], center: Center, angle: float
) -> tuple[FloatArray, FloatArray]:
    """Coordinates along the ellipse's axes, each in units of its radius."""
    y, x = offsets(shape, center)
    cosine, sine = np.cos(angle), np.sin(angle)
    return (y * cosine + x * sine) / radii[0], (x * cosine - y * sine) / radii[1]


def _along_axes(
    along_u: FloatArray, along_v: FloatArray, radii: tuple[float, float], angle: float
) -> FloatArray:
    """Turn derivatives by u and v, as `_ellipse_axes` scales them, into (y, x) per pixel."""
    cosine, sine = np.cos(angle), np.sin(angle)
    u, v = along_u / radii[0], along_v / radii[1]
    return np.stack([u * cosine - v * sine, u * sine + v * cosine])
