"""A shot of a stack is inverted as it would be alone."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import pytest

from helpers.night import OPTIONS, SHAPE, make_shots
from helpers.stacks import inverted_stack
from napari_shadowinv import Recipe, Shot, run
from napari_shadowinv.inversion.variables import setup_from_dataset
from napari_shadowinv.io.store import DONE
from napari_shadowinv.physics.setup import OpticalSetup
from napari_shadowinv.preprocessing import (
    Bin,
    HighPassFilter,
    HotPixelFilter,
    LowPassFilter,
    PolynomialEstimate,
    UniformEstimate,
)
from napari_shadowinv.provenance import Provenance

IMAGES, SOURCE = make_shots(2)
LIGHT = OpticalSetup(wavelength=532e-9, object_image_distance=0.3, pixel_size=12e-6)
FREE = OPTIONS.model_copy(update={"boundary": "free"})
KNOWN = OPTIONS.model_copy(update={"boundary": "free", "margin": 5, "flux": "known"})
USABLE = np.ones(SHAPE, bool)
USABLE[:3, :4] = False
BARE = np.hypot(*(np.indices(SHAPE) - np.array([10, 14]).reshape(2, 1, 1))) > 8  # no blob is there
SPOILT = np.where(USABLE, IMAGES, np.nan)
HOT = SPOILT.copy()
HOT[:, 12, 20] = 900
BLUR = (LowPassFilter(width=1.0),)


class Case(NamedTuple):
    """Shots with what is known of all, a recipe, and how close a field comes to that alone."""

    shots: Shot
    recipe: dict[str, Any]
    tolerance: float = 0.0  # of uniform beams, whose images are divided by another mean


CASES = {
    "a source and a setup": Case(Shot(IMAGES, source=SOURCE), {"setup": LIGHT}),
    "a free boundary": Case(Shot(IMAGES, source=SOURCE), {"setup": LIGHT, "options": FREE}),
    "no source": Case(Shot(IMAGES), {}, 1e-9),
    "no source and known flux": Case(Shot(IMAGES), {"options": KNOWN}, 1e-9),
    "a mask": Case(Shot(SPOILT, source=SOURCE, mask=USABLE), {}),
    "a mask and no source": Case(Shot(SPOILT, mask=USABLE), {}, 1e-9),
    "an estimate after filters": Case(
        Shot(HOT, mask=USABLE, source_mask=BARE),
        {
            "steps": (HotPixelFilter(), LowPassFilter(width=0.8)),
            "source": PolynomialEstimate(degree=1),
        },
    ),
    "a blurred source": Case(Shot(IMAGES, source=SOURCE), {"steps": BLUR}),
    "a flattened image": Case(
        Shot(IMAGES), {"steps": (HighPassFilter(width=9.0),), "source": UniformEstimate()}, 1e-9
    ),
    "wide pixels": Case(Shot(IMAGES, source=SOURCE), {"steps": (Bin(factor=2),), "setup": LIGHT}),
}
STORED = ("potential", "displacement", "caustic", "mask", "image", "source", "reprojection")


@pytest.mark.usefixtures("compiled")
@pytest.mark.parametrize("name", CASES)
def test_a_shot_of_a_stack_is_as_alone(name, tmp_path):
    shots, choices, tolerance = CASES[name]
    recipe = Recipe(**{"options": OPTIONS, **choices})
    # Numbers of sites differ with a free boundary.
    of_sites = () if recipe.options.boundary == "free" else ("weights", "sites")
    names = (*STORED, *of_sites)
    stack = inverted_stack(shots, tmp_path, recipe, *names)
    assert (stack.status == DONE).all()
    assert stack.potential.chunks[0] == (1,) * 2
    assert Provenance.of(stack.attrs).recipe.steps == recipe.steps
    assert setup_from_dataset(stack) == run(recipe, replace(shots, image=shots.image[0])).setup
    for index in range(2):
        inversion = run(recipe, replace(shots, image=shots.image[index]))
        alone = inversion.to_dataset()
        if tolerance:  # fluxes are relative to the mean
            used = stack["mask"][index].values
            relative = alone.image.values[used] / alone.image.values[used].mean()
            np.testing.assert_allclose(stack.image[index].values[used], relative, rtol=1e-9)
        for each in ("potential", "displacement") if tolerance else names:
            values = stack[each].isel(shot=index)
            assert values.dims == alone[each].dims
            assert values.attrs == alone[each].attrs
            np.testing.assert_allclose(
                values, alone[each], rtol=tolerance, atol=tolerance, err_msg=str(each)
            )
        assert stack.iterations[index] == inversion.report.iterations
        assert bool(stack.converged[index]) is inversion.report.converged
        assert float(stack.flux_residual[index]) == pytest.approx(inversion.report.residual)
        assert float(stack.image_residual[index]) > 0
