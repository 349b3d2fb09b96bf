"""Objects whose potential and displacement are known exactly.

- the paper's toroidal magnetic field: `toroid`
- the structures of its Fig. 6: `four_toroids`, `cosine_ellipses`, `focusing_pair`,
  `opposite_pair`, `coaxial_line`
- a plasma wave, probed by light: `wakefield`, `plasma_wavelength`
- building blocks, round or elliptical: `gaussian_blob`, `cosine_toroid`; phantoms are
  added with ``+``
- an object that every flip, shift or swap of axes changes: `ellipse_pair`
- the class of all of them: `Phantom`

All take `shape`, the image's height and width; magnetic fields also `setup`, the beam. `center`
is (y, x) in px, may be fractional, and is the image's centre by default. `angle`, in rad, turns
an ellipse's u axis from y towards x. A positive `peak`, in MG µm, deflects positive charges
outwards: the field runs counter-clockwise. An `InputError` refuses a shape or length that is not
positive and a number that is not finite.

The paper is Kasim et al., arXiv:1607.04179.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
from scipy import constants

from napari_shadowinv._typing import BoolArray, FloatArray
from napari_shadowinv.errors import InputError
from napari_shadowinv.physics.setup import OpticalSetup, ProtonSetup

__all__ = [
    "Phantom",
    "coaxial_line",
    "cosine_ellipses",
    "cosine_toroid",
    "ellipse_pair",
    "focusing_pair",
    "four_toroids",
    "gaussian_blob",
    "opposite_pair",
    "plasma_wavelength",
    "toroid",
    "wakefield",
]

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


def _require_positive(name: str, value: float, unit: str) -> None:
    if not (np.isfinite(value) and value > 0):
        raise InputError(f"{name} is {value}: it must be positive, in {unit}")


def _require_finite(**values: float) -> None:
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
    >>> from napari_shadowinv import ProtonSetup
    >>> phantom = toroid((200, 200), ProtonSetup.example(), peak=97, sigma=30e-6)
    >>> field = ProtonSetup.example().path_integrated_b(phantom.displacement, "MG um")
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
    _require_finite(amplitude=amplitude, angle=angle)
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
    _require_finite(peak=peak, angle=angle)
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
        _require_positive(name, radius, unit)
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


# Peak in MG µm, radii in shares of the image's smaller side, centre in shares of height
# and width, angle in rad.
Part = tuple[float, Radii, tuple[float, float], float]


def four_toroids(shape: tuple[int, int], setup: ProtonSetup, strength: float = 1.0) -> Phantom:
    """Four Gaussian toroids of different strength and size, all counter-clockwise: Fig. 6 (a).

    Positions and radii scale with the image. `strength` is a factor on the fields, whose largest
    peak is then 135 MG µm.
    """
    parts = [
        (135.0, 0.07, (0.31, 0.30), 0.0),
        (75.0, 0.05, (0.30, 0.69), 0.0),
        (100.0, 0.06, (0.69, 0.32), 0.0),
        (125.0, 0.08, (0.67, 0.67), 0.0),
    ]
    return _scene(toroid, parts, shape, setup, strength)


def cosine_ellipses(shape: tuple[int, int], setup: ProtonSetup, strength: float = 1.0) -> Phantom:
    """Two elliptical toroids, cos² up to a rim, counter-clockwise: Fig. 6 (b).

    Scaled as `four_toroids`; the peak fields are 64 and 62 MG µm.
    """
    parts = [(64.0, (0.24, 0.14), (0.37, 0.31), 0.35), (62.0, (0.14, 0.24), (0.66, 0.67), 0.20)]
    return _scene(cosine_toroid, parts, shape, setup, strength)


def focusing_pair(shape: tuple[int, int], setup: ProtonSetup, strength: float = 1.0) -> Phantom:
    """Two elliptical Gaussian toroids close together, clockwise: they focus protons; Fig. 6 (c).

    Scaled as `four_toroids`; the peak fields are 63 MG µm.
    """
    parts = [(-63.0, (0.12, 0.07), (0.5, 0.38), 0.2), (-63.0, (0.12, 0.07), (0.5, 0.61), -0.2)]
    return _scene(toroid, parts, shape, setup, strength)


def opposite_pair(shape: tuple[int, int], setup: ProtonSetup, strength: float = 1.0) -> Phantom:
    """Gaussian toroids, counter-clockwise left and clockwise right: Fig. 6 (d).

    Scaled as `four_toroids`; the peak fields are 154 and 68 MG µm, as it takes less to make rays
    meet than to drive them apart until they meet others.
    """
    parts = [(154.0, 0.08, (0.5, 0.33), 0.0), (-68.0, 0.08, (0.5, 0.67), 0.0)]
    return _scene(toroid, parts, shape, setup, strength)


def coaxial_line(
    shape: tuple[int, int],
    setup: ProtonSetup,
    peak: float = 60.0,
    radii: tuple[float, float, float] = (21e-6, 66e-6, 78e-6),
    center: Center = None,
) -> tuple[Phantom, BoolArray]:
    """Coaxial line along the beam: a field between two conductors that stop the beam; Fig. 6 (e).

    The currents of the two conductors are equal and opposite, and uniform inside each. So
    the field rises ∝ r in the inner conductor, falls ∝ 1/r between the two and to zero
    within the outer one, and is zero outside.

    Parameters
    ----------
    shape, setup, center
    peak : float, default 60
        Path-integrated field at the inner conductor's surface in MG µm.
    radii : tuple of float
        Radius of the inner conductor, inner and outer radius of the outer one, in m; increasing.

    Returns
    -------
    phantom : Phantom
        Potential and displacement, inside the conductors too.
    obstructed : ndarray of bool, shape (H, W)
        Pixels whose centres are in a conductor: there the source of the image is dark.
    """
    _require_finite(peak=peak)
    if len(radii) != 3 or not (np.isfinite(radii).all() and 0 < radii[0] < radii[1] < radii[2]):
        raise InputError(f"radii are {radii}: expected three positive, increasing values, in m")
    inner, outer, rim = (radius / setup.object_pixel_size for radius in radii)
    y, x = offsets(shape, center)
    r = np.hypot(y, x)
    enclosed = outward_displacement(setup, peak) * inner  # d = enclosed / r between the two
    share, potential = _coaxial_profile(r, inner, outer, rim)
    obstructed = (r < inner) | ((r > outer) & (r < rim))
    return Phantom(enclosed * potential, enclosed * np.stack([share * y, share * x])), obstructed


def _coaxial_profile(
    r: FloatArray, inner: float, outer: float, rim: float
) -> tuple[FloatArray, FloatArray]:
    """Current inside r over r², and the integral of current over r outwards; at most 1."""
    s = np.clip(r, outer, rim)
    wall = rim**2 - outer**2
    # ∫ (c² - s²) / (wall s) ds from s to c, with c the rim
    in_wall = (rim**2 * np.log(rim / s) - (rim**2 - s**2) / 2) / wall
    between = np.log(outer / np.clip(r, inner, outer))
    in_core = np.clip(1 - (r / inner) ** 2, 0, None) / 2
    current = np.where(r < outer, 1.0, (rim**2 - s**2) / wall)
    share = current / np.maximum(r, inner) ** 2
    return share, in_core + between + in_wall


def ellipse_pair(shape: tuple[int, int], strength: float = 1.0) -> Phantom:
    """Two different elliptical blobs off the centre, turned, of opposite sign.

    No symmetry of the square maps it onto itself: an inversion that mixes up axes, signs or
    half pixels cannot get it right. The blobs scale with the image's smaller side, both amplitudes
    with `strength`: at 1 the Jacobian is between 0.5 and 2.5; folds form from about 2.4.
    """
    height, width = shape
    unit = min(height, width) / 100
    first_amplitude, second_amplitude = 45.0 * strength * unit**2, -15.0 * strength * unit**2
    first_place, second_place = (0.37 * height, 0.42 * width), (0.63 * height, 0.66 * width)
    blob = gaussian_blob
    first = blob(shape, first_amplitude, (7.0 * unit, 12.0 * unit), first_place, 0.5)
    return first + blob(shape, second_amplitude, (10.0 * unit, 6.0 * unit), second_place, 0.3)


def _scene(
    make: Callable[..., Phantom], parts: Iterable[Part], shape: tuple[int, int],
    setup: ProtonSetup, strength: float,
) -> Phantom:  # fmt: skip
    _require_finite(strength=strength)
    _require_positive("smaller side of the image", min(shape), "px")
    side = min(shape) * setup.object_pixel_size
    phantoms = []
    for peak, radii, share, angle in parts:
        lengths = (side * radii[0], side * radii[1]) if isinstance(radii, tuple) else side * radii
        center = share[0] * shape[0] - 0.5, share[1] * shape[1] - 0.5
        phantoms.append(make(shape, setup, strength * peak, lengths, center, angle))
    return sum(phantoms[1:], start=phantoms[0])


def plasma_wavelength(density: float) -> float:
    """Wavelength 2πc/ω_p in m of the density wave in a cold plasma of n₀ electrons per m³.

    Examples
    --------
    >>> round(plasma_wavelength(1.65e25) * 1e6, 2)
    8.22
    """
    _require_positive("density", density, "electrons per m³")
    squared = density * constants.e**2 / (constants.m_e * constants.epsilon_0)
    return float(2 * math.pi * constants.c / math.sqrt(squared))


def wakefield(
    shape: tuple[int, int],
    setup: OpticalSetup,
    amplitude: float = 0.8,
    *,
    density: float = 1.65e25,
    width: float = 6e-6,
    length: float = 14e-6,
    curvature_radius: float = 20e-6,
    center: Center = None,
) -> Phantom:
    """Density wave along x with curved wavefronts, round about its axis.

    The wave's relative density is

        Δn/n₀ = A exp(-ρ²/2w² - ξ²/2ℓ²) cos(k_p (ξ - ρ²/2R)),

    with ξ the distance from the centre along x, ρ² = y² + z² and k_p = 2π over the plasma's
    wavelength. The beam travels along z. In a strong wave that a laser drives towards +x
    the fast electrons on the axis are heavier and the wave is longer there, so its fronts
    lag behind on the axis, as a positive R makes them.

    Parameters
    ----------
    shape, setup, center
    amplitude : float, default 0.8
        Amplitude A of Δn/n₀ in the centre; below 1 the density stays positive.
    density : float, default 1.65e25
        Density n₀ of the undisturbed plasma in m⁻³.
    width, length : float
        Radii w across and ℓ along the wave in m.
    curvature_radius : float
        Radius R of the wavefronts on the axis in m; negative bends them the other way,
        infinite makes them plane.

    Returns
    -------
    Phantom
        `OpticalSetup.relative_density_modulation` of its potential is the exact ∫Δn/n₀ dz.

    Notes
    -----
    A Gaussian with a complex width keeps its form when it is integrated:
    with s = 1/2w² + i k_p/2R,

        ∫Δn/n₀ dz = A exp(-ξ²/2ℓ²) Re[√(π/s) exp(i k_p ξ - s y²)].

    The potential belongs to a thin plasma, Φ = n₀/2n_c ∫Δn/n₀ dz, the first order of the
    paper's Eq. 11 (Section V) in n₀/n_c, which is 1 % for the paper's plasma and probe.
    """
    _require_finite(amplitude=amplitude)
    _require_positive("width", width, "m")
    _require_positive("length", length, "m")
    if curvature_radius == 0 or math.isnan(curvature_radius):
        raise InputError(f"radius of curvature is {curvature_radius}: it must not be 0, in m")
    wave_number = 2 * math.pi / plasma_wavelength(density)
    y, xi = (setup.object_pixel_size * offset for offset in offsets(shape, center))
    s = complex(1 / (2 * width**2), wave_number / (2 * curvature_radius))
    integral = amplitude * np.sqrt(np.pi / s) * np.exp(1j * wave_number * xi - s * y**2)
    integral *= np.exp(-(xi**2) / (2 * length**2))
    slope_x = integral * (1j * wave_number - xi / length**2)
    slopes = np.stack([(integral * -2 * s * y).real, slope_x.real])
    per_metre = density / (2 * setup.critical_density)
    return Phantom(
        setup.normalized_potential(per_metre * integral.real),
        setup.displacement(-per_metre * slopes),
    )
