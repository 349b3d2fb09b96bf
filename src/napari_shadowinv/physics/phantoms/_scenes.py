"""The paper's experiment, and the objects that it puts into it.

The layouts are read off the paper's Fig. 6, which gives no numbers. At `strength` 1 the
first caustics have just formed in `paper_setup` on 200 × 200 pixels: the Jacobian's
minimum is a little below zero, as for the paper's toroid of 194 MG µm.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np

from napari_shadowinv._typing import BoolArray, FloatArray
from napari_shadowinv.errors import InputError
from napari_shadowinv.physics.phantoms import _shapes
from napari_shadowinv.physics.phantoms._shapes import Center, Phantom, Radii, cosine_toroid, toroid
from napari_shadowinv.physics.setup import ProtonSetup

# Peak in MG µm, radii in shares of the image's smaller side, centre in shares of height
# and width, angle in rad.
Part = tuple[float, Radii, tuple[float, float], float]


def paper_setup() -> ProtonSetup:
    """Experiment of the paper's benchmark (Section IV A).

    Protons of 14.7 MeV, 1.3 mm from source to object, 2 cm on to the detector, pixels
    of 1.5 µm in the object plane: 200 pixels are ten times the toroid's σ of 30 µm.
    """
    return ProtonSetup.example()


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
    _shapes.require_finite(peak=peak)
    if len(radii) != 3 or not (np.isfinite(radii).all() and 0 < radii[0] < radii[1] < radii[2]):
        raise InputError(f"radii are {radii}: expected three positive, increasing values, in m")
    inner, outer, rim = (radius / setup.object_pixel_size for radius in radii)
    y, x = _shapes.offsets(shape, center)
    r = np.hypot(y, x)
    enclosed = _shapes.outward_displacement(setup, peak) * inner  # d = enclosed / r between the two
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
    blob = _shapes.gaussian_blob
    first = blob(shape, first_amplitude, (7.0 * unit, 12.0 * unit), first_place, 0.5)
    return first + blob(shape, second_amplitude, (10.0 * unit, 6.0 * unit), second_place, 0.3)


def _scene(
    make: Callable[..., Phantom], parts: Iterable[Part], shape: tuple[int, int],
    setup: ProtonSetup, strength: float,
) -> Phantom:  # fmt: skip
    """Sum of the parts, each made by `toroid` or `cosine_toroid`."""
    _shapes.require_finite(strength=strength)
    _shapes.require_positive("smaller side of the image", min(shape), "px")
    side = min(shape) * setup.object_pixel_size
    phantoms = []
    for peak, radii, share, angle in parts:
        lengths = (side * radii[0], side * radii[1]) if isinstance(radii, tuple) else side * radii
        center = share[0] * shape[0] - 0.5, share[1] * shape[1] - 0.5
        phantoms.append(make(shape, setup, strength * peak, lengths, center, angle))
    return sum(phantoms[1:], start=phantoms[0])
