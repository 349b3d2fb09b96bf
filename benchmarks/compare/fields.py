"""Displacements that are known exactly: maps of a square onto a square or into the plane.

A field is a function of n: the displacement at the centres of n×n pixels, axis order (y, x), in
parts of the square's side. So one function makes the truth of an image and its many rays.

- the structures of Kasim et al.: `paper_fields`
- images that Davies, Heuer and Bott name as hard: `blob`, `empty_void`, `waves`, `charge`
- 3-D fields by traced particles: `traced_fields`
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
from numpy.typing import NDArray

import tracing
from napari_shadowinv.physics import phantoms
from napari_shadowinv.physics.field_grid import FieldGrid
from napari_shadowinv.physics.phantoms import Phantom
from napari_shadowinv.physics.setup import ProtonSetup
from napari_shadowinv.physics.tracing import traced_displacement

Array = NDArray[np.float64]
Field = Callable[[int], Array]
Structure = Callable[[tuple[int, int], ProtonSetup], Phantom]

PIXELS_OF_SETUP = 200  # each way: 0.3 mm of the paper, 1 mm of the traced fields


def centres(n: int) -> tuple[Array, Array]:
    """Places y and x of the pixels' centres from the middle of the square, in sides."""
    axis = (np.arange(n) + 0.5) / n - 0.5
    return axis[:, None], axis[None, :]


def with_pixels(setup: ProtonSetup, n: int) -> ProtonSetup:
    """Setup whose images have n pixels each way and the same field of view."""
    assert setup.pixel_size is not None
    return setup.model_copy(update={"pixel_size": setup.pixel_size * PIXELS_OF_SETUP / n})


def of_phantom(structure: Structure) -> Field:
    """Field of a phantom on a square of the paper's size."""

    def field(n: int) -> Array:
        return structure((n, n), with_pixels(ProtonSetup.example(), n)).displacement / n

    return field


def paper_fields() -> dict[str, Field]:
    """Structures of Kasim et al., Section IV and Fig. 6; peaks of the toroids in MG µm."""

    def toroid(peak: float) -> Field:
        return of_phantom(lambda shape, setup: phantoms.toroid(shape, setup, peak, 30e-6))

    return {
        "toroid 24": toroid(24),
        "toroid 97": toroid(97),
        "toroid 194": toroid(194),
        "four toroids": of_phantom(phantoms.four_toroids),
        "cosine ellipses": of_phantom(phantoms.cosine_ellipses),
        "focusing pair": of_phantom(phantoms.focusing_pair),
        "opposite pair": of_phantom(phantoms.opposite_pair),
        "coaxial line": of_phantom(lambda shape, setup: phantoms.coaxial_line(shape, setup)[0]),
    }


def coaxial_source(n: int) -> Array:
    """Beam that the conductors of the coaxial line stop."""
    _, obstructed = phantoms.coaxial_line((n, n), with_pixels(ProtonSetup.example(), n))
    return np.where(obstructed, 0.0, 1.0)


def blob(n: int, strength: float, radius: float = 0.15) -> Array:
    """Deflection μ r exp(-r²/a²); a negative μ focuses to a peak of 1/(1 + μ)² in the middle."""
    y, x = centres(n)
    factor = strength * np.exp(-(y**2 + x**2) / radius**2)
    return np.stack([factor * y, factor * x])


def empty_void(n: int, hole: float = 0.2, rim: float = 0.4) -> Array:
    """Disc that is blown up to a ring of uniform brightness around a hole without light."""
    y, x = centres(n)
    r = np.hypot(y, x)
    landing = np.sqrt(hole**2 + r**2 * (1 - (hole / rim) ** 2))
    factor = np.where(r < rim, landing / np.maximum(r, 1e-12) - 1, 0.0)
    return np.stack([factor * y, factor * x])


def charge(n: int, strength: float = 0.01, radius: float = 0.1) -> Array:
    """Gaussian line charge, A (1 - exp(-r²/a²))/r: it moves rays across the border."""
    y, x = centres(n)
    squared = np.maximum(y**2 + x**2, 1e-12)
    factor = -strength * np.expm1(-squared / radius**2) / squared
    return np.stack([factor * y, factor * x])


def waves(seed: int, modes: int, smallest: float) -> Field:
    """Gradient of cosines with random amplitudes under sin²(πy) sin²(πx), in sides.

    Potential and displacement are zero at the border, as solvers differ in what they assume
    there. `smallest` is the smallest stretch of the map anywhere: the map is invertible while it
    is positive, and the light is the stronger the smaller it is.
    """
    raw = np.random.default_rng(seed).normal(size=(modes + 1, modes + 1))
    raw /= 1 + np.add.outer(np.arange(modes + 1) ** 2, np.arange(modes + 1) ** 2)
    # sin²(πy) cos(kπy) as a sum of cosines
    fade = np.zeros((modes + 1, modes + 3))
    for k in range(modes + 1):
        fade[k, k] += 1 / 2
        fade[k, k + 2] -= 1 / 4
        fade[k, abs(k - 2)] -= 1 / 4
    amplitude = fade.T @ raw @ fade
    numbers = np.arange(modes + 3) * np.pi

    def derivative(n: int, along_y: int, along_x: int) -> Array:
        phase = numbers[:, None] * (centres(n)[1] + 0.5)
        terms = [np.cos(phase), -np.sin(phase) * numbers[:, None]]
        terms.append(-terms[0] * numbers[:, None] ** 2)
        return np.asarray(terms[along_y].T @ amplitude @ terms[along_x])

    yy, yx, xx = (derivative(256, *order) for order in ((2, 0), (1, 1), (0, 2)))
    least = (yy + xx) / 2 - np.hypot((yy - xx) / 2, yx)
    amplitude *= (1 - smallest) / -least.min()
    return lambda n: np.stack([derivative(n, 1, 0), derivative(n, 0, 1)])


def hard_fields() -> dict[str, Field]:
    """Images of the kinds that Davies, Heuer and Bott name: peaks, voids, contrast, the border."""
    return {
        "peak 4": partial(blob, strength=-0.5),
        "peak 25": partial(blob, strength=-0.8),
        "peak 100": partial(blob, strength=-0.9),
        "peak 400": partial(blob, strength=-0.95),
        "void": partial(blob, strength=2.0),
        "empty void": empty_void,
        "contrast": waves(seed=11, modes=8, smallest=0.03),
        "border": charge,
    }


def traced_fields() -> dict[str, Field]:
    """Displacements of particles that are traced through 3-D magnetic fields of 1 mm."""
    grids = {
        "traced rod": partial(tracing.rod, 3e-3),
        "traced toroid": partial(tracing.toroid, 3e-3),
        "traced bubble": partial(tracing.bubble, 20.0),
        "traced turbulence": partial(tracing.turbulence, 2.0),
    }

    def field_of(make: Callable[[], FieldGrid]) -> Field:
        def field(n: int) -> Array:
            return traced_displacement(make(), with_pixels(tracing.SETUP, n), (n, n)) / n

        return field

    return {name: field_of(make) for name, make in grids.items()}
