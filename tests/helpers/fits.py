"""Small fits of one or two fields at two energies, with an alternative solution."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from napari_shadowinv import ProtonSetup
from napari_shadowinv.facts import Assessment, Verdict
from napari_shadowinv.fitting import Fit, fit
from napari_shadowinv.options import FitOptions, Instrument
from napari_shadowinv.physics.forward import synthetic_image
from napari_shadowinv.physics.phantoms import gaussian_blob
from napari_shadowinv.physics.projection import transferred_displacement
from napari_shadowinv.shot import shots_of

SHAPE = (48, 64)
LENGTHS = {"source_object_distance": 1.3e-3, "object_image_distance": 2e-2, "pixel_size": 1.5e-6}
SETUPS = tuple(ProtonSetup(energy=energy, **LENGTHS) for energy in (20.0, 3.0))
FIELDS = {
    "B": ("magnetic field", gaussian_blob(SHAPE, 10.0, 8.0, (22.0, 35.0)).displacement),
    "E": ("electric field", gaussian_blob(SHAPE, 7.0, 7.0, (28.0, 24.0)).displacement),
}
WHY = "2 different fields explain the images about as well"


def doubtful_fit(*names: str) -> Fit:
    """Fit the fields of these names; another start ends at half the field."""
    images = []
    for setup in SETUPS:
        moved = [
            transferred_displacement(displacement, SETUPS[0], setup, deflector=deflector)
            for deflector, displacement in map(FIELDS.get, names)
        ]
        noise = np.random.default_rng(int(setup.energy)).normal(0, 0.01, SHAPE)
        images.append(synthetic_image(np.sum(moved, axis=0)) + noise)
    best = fit(
        shots_of(images, setup=SETUPS, noise=0.01),
        fields=names,
        options=FitOptions(max_iterations=3, samples=2),
        instrument=Instrument(beam_rms=0),
    )
    first, half = best.basins[0], best.basins[0].displacement / 2
    alternative = replace(first, start="from near", distance=0.5, displacement=half)
    assessment = Assessment(Verdict.SEVERAL, WHY)
    return replace(best, basins=(first, alternative), assessment=assessment)
