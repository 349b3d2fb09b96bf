"""A laser-driven density wave in a plasma, seen from the side by a short pulse of light."""

from __future__ import annotations

import math

import numpy as np
from scipy import constants

from napari_shadowinv.errors import InputError
from napari_shadowinv.physics.phantoms import _shapes
from napari_shadowinv.physics.phantoms._shapes import Center, Phantom, require_positive
from napari_shadowinv.physics.setup import OpticalSetup

PAPER_DENSITY = 1.65e25
"""Density of the paper's plasma in electrons per m³."""


def wakefield_setup() -> OpticalSetup:
    """Optical probe of the paper's plasma wave: collimated light of 810 nm (Section V).

    The image is of a plane 20 µm behind the wave, at 0.25 µm per pixel. The paper gives neither
    distance nor pixel; farther behind, diffraction at a wave of 8 µm would no longer be small.
    """
    return OpticalSetup.example()


def plasma_wavelength(density: float) -> float:
    """Wavelength 2πc/ω_p in m of the density wave in a cold plasma of n₀ electrons per m³.

    Examples
    --------
    >>> round(plasma_wavelength(1.65e25) * 1e6, 2)
    8.22
    """
    require_positive("density", density, "electrons per m³")
    squared = density * constants.e**2 / (constants.m_e * constants.epsilon_0)
    return float(2 * math.pi * constants.c / math.sqrt(squared))


def wakefield(
    shape: tuple[int, int],
    setup: OpticalSetup,
    amplitude: float = 0.8,
    *,
    density: float = PAPER_DENSITY,
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
    _shapes.require_finite(amplitude=amplitude)
    require_positive("width", width, "m")
    require_positive("length", length, "m")
    if curvature_radius == 0 or math.isnan(curvature_radius):
        raise InputError(f"curvature_radius is {curvature_radius}: it must not be 0, in m")
    wave_number = 2 * math.pi / plasma_wavelength(density)
    y, xi = (setup.object_pixel_size * offset for offset in _shapes.offsets(shape, center))
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
