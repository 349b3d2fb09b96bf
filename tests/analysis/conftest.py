"""Fields with exact products, and an inversion of a noisy image."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from helpers.exact_fields import SETUP, field_of
from napari_shadowinv.inversion import Inversion, invert
from napari_shadowinv.inversion.result import RetrievedField
from napari_shadowinv.physics.forward import synthetic_image
from napari_shadowinv.physics.phantoms import Phantom, ellipse_pair, toroid

COUNTS = 400.0


@pytest.fixture(scope="session")
def ellipses() -> Phantom:
    return ellipse_pair((100, 110))


@pytest.fixture(scope="session")
def exact(ellipses: Phantom) -> RetrievedField:
    return field_of(ellipses)


@pytest.fixture(scope="session")
def ring() -> Phantom:
    return toroid((64, 64), SETUP, 40.0, 12e-6)


@pytest.fixture(scope="session")
def recorded(ring: Phantom) -> Callable[[int], Inversion]:
    """Return inversions of images of the ring with different noise."""
    image = COUNTS * synthetic_image(ring.displacement)

    def invert_noisy(seed: int) -> Inversion:
        noisy = np.random.default_rng(seed).poisson(image)
        return invert(noisy, source=np.full(image.shape, COUNTS))

    return invert_noisy


@pytest.fixture(scope="session")
def inversion(recorded: Callable[[int], Inversion]) -> Inversion:
    return recorded(1)
