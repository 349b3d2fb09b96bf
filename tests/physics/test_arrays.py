"""Masked and labelled arrays: masks are respected, axes are taken by their names."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pytest
import xarray as xr

from helpers.stacks import inverted_stack
from napari_shadowinv import (
    FitOptions,
    InputError,
    InversionOptions,
    OpticalSetup,
    ProtonSetup,
    Recipe,
    invert,
    poisson_invert,
    predict_image,
    run,
    synthetic_image,
)
from napari_shadowinv.fitting.measurements import collect_data
from napari_shadowinv.inversion import plan_sites
from napari_shadowinv.physics.arrays import block_sums, coordinate_spacing, order_by_value
from napari_shadowinv.physics.phantoms import gaussian_blob
from napari_shadowinv.pipeline.fit_run import collect_fit_inputs
from napari_shadowinv.preprocessing.estimates import UniformEstimate
from napari_shadowinv.shot import Shot

OPTIONS = InversionOptions(n_sites=300)
SETUP = OpticalSetup(
    wavelength=532e-9,
    source_object_distance=float("inf"),
    object_image_distance=0.1,
    pixel_size=1e-5,
)
TRUTH = gaussian_blob((32, 40), 20.0, 6.0).displacement
SHOT = 300 * synthetic_image(TRUTH)


def turned(image: Any) -> xr.DataArray:
    """The same image, x first."""
    return xr.DataArray(np.ascontiguousarray(np.asarray(image).T), dims=("x", "y"))


def displaced(result: Any) -> Any:
    return result.displacement if hasattr(result, "displacement") else result


INVERT: dict[str, Callable[..., Any]] = {
    "invert": lambda image, mask=None: invert(image, mask=mask, options=OPTIONS),
    "run": lambda image, mask=None: run(Recipe(options=OPTIONS), Shot(image, mask=mask)),
    "run_stack": lambda image, mask=None: _stored(Shot(_stack_of(image), mask=mask)).isel(shot=1),
    "fit": lambda image, mask=None: _measured(image, mask),
    "fit a list": lambda image, mask=None: _measured([image], mask),
    "run_fit": lambda image, mask=None: _seen(
        collect_fit_inputs(Recipe(), [Shot(image, mask=mask)]).shots
    ),
}


def _measured(images: Any, mask: Any = None) -> np.ndarray[Any, Any]:
    is_list = isinstance(images, list)
    return _seen([Shot(image, mask=mask) for image in (images if is_list else [images])])


def _seen(shots: Sequence[Shot]) -> np.ndarray[Any, Any]:
    """Images and weights that a fit sees."""
    scene = collect_data(shots, options=FitOptions()).scene
    return np.stack([scene.images, scene.weights])


def _stored(shots: Any, recipe: Recipe | None = None) -> Any:
    with TemporaryDirectory() as folder:
        return inverted_stack(shots, Path(folder), recipe or Recipe(options=OPTIONS)).load()


def _stack_of(image: Any) -> Any:
    if isinstance(image, xr.DataArray):
        return xr.concat([image, image], "shot").transpose(..., "shot")
    return (np.ma if isinstance(image, np.ma.MaskedArray) else np).stack([image, image])


@pytest.mark.parametrize("entry", INVERT)
def test_labelled_array_is_taken_by_its_names(entry: str) -> None:
    expected = displaced(INVERT[entry](SHOT))

    assert np.array_equal(displaced(INVERT[entry](turned(SHOT))), expected)


@pytest.mark.parametrize(
    "use",
    [
        lambda array: synthetic_image(TRUTH, array),
        lambda array: poisson_invert(array),
        lambda array: predict_image(TRUTH, SETUP, SETUP, source=array),
        lambda array: synthetic_image(np.ma.stack([array, array])),
        lambda array: SETUP.potential(array),
        *INVERT.values(),
        lambda array: invert(SHOT, mask=array > 0, options=OPTIONS),
        lambda array: plan_sites(array, OPTIONS),
        lambda array: UniformEstimate().source(array),
    ],
    ids=[
        *("source", "poisson_invert", "project", "displacement", "potential"),
        *(*INVERT, "mask", "plan_sites", "estimate"),
    ],
)
def test_masked_values_are_refused(use: Callable[..., Any]) -> None:
    image, mask = SHOT.copy(), np.zeros(SHOT.shape, bool)
    mask[4:8, 5:9] = True
    with pytest.raises(InputError, match="masked values, expected none"):
        use(np.ma.MaskedArray(image, mask))


def test_forward_models_take_axes_by_name() -> None:
    field = xr.DataArray(TRUTH, dims=("component", "y", "x"), attrs={"units": "px"})
    beam = np.linspace(1, 2, 32)[:, None] * np.ones((32, 40))

    assert np.array_equal(
        synthetic_image(field.transpose("x", "component", "y"), turned(beam)),
        synthetic_image(TRUTH, beam),
    )
    assert np.array_equal(poisson_invert(turned(SHOT)), poisson_invert(SHOT))
    proton = ProtonSetup(
        energy=14.7, source_object_distance=0.01, object_image_distance=0.28, pixel_size=1e-5
    )
    assert np.array_equal(
        proton.path_integrated_b(field.transpose("y", "x", "component")),
        proton.path_integrated_b(TRUTH),
    )


def test_dataset_of_a_result_is_taken_as_it_is() -> None:
    inversion = invert(SHOT, options=OPTIONS)
    dataset = inversion.in_units(SETUP).to_dataset()

    for turn in (dataset, dataset.transpose("x", ...)):
        image = synthetic_image(turn.displacement, turn.source)
        assert np.array_equal(image, synthetic_image(inversion.displacement, inversion.source))
        again = run(Recipe(setup=SETUP, options=OPTIONS), turn.image)
        assert again.image.shape == SHOT.shape


def test_displacement_in_metres_is_refused() -> None:
    field = xr.DataArray(1e-6 * TRUTH, dims=("component", "y", "x"), attrs={"units": "m"})

    with pytest.raises(InputError, match="unit 'm', expected 'px'"):
        synthetic_image(field)


@pytest.mark.parametrize("dims", [("lat", "lon"), ("y", "time"), ("shot", "y", "x")])
def test_strange_dimensions_are_refused_by_name(dims: tuple[str, ...]) -> None:
    image = xr.DataArray(np.ones((8,) * len(dims)), dims=dims)

    with pytest.raises(InputError, match=f"image has the dimensions '{dims[0]}'"):
        invert(image, options=OPTIONS)


def test_unnamed_dimensions_are_taken_in_order() -> None:
    plain = invert(SHOT, options=OPTIONS)

    assert np.array_equal(invert(xr.DataArray(SHOT), options=OPTIONS).potential, plain.potential)


def _placed(spacing_y: float, spacing_x: float, unit: str) -> xr.DataArray:
    places = {
        name: (name, spacing * np.arange(side), {"units": unit})
        for name, spacing, side in zip("yx", (spacing_y, spacing_x), SHOT.shape, strict=True)
    }
    return xr.DataArray(SHOT, dims=("y", "x"), coords=places)


@pytest.mark.parametrize(
    ("spacing_y", "spacing_x", "unit", "passes"),
    [
        *((0.01, 0.01, "mm", True), (10, 10, "µm", True), (1, 1, "px", True), (1, 1, "", True)),
        *((0.2, 0.2, "mm", False), (0.01, 0.02, "mm", False)),
    ],
)
def test_coordinates_must_agree_with_the_setup(
    spacing_y: float, spacing_x: float, unit: str, passes: bool
) -> None:
    image, recipe = _placed(spacing_y, spacing_x, unit), Recipe(setup=SETUP, options=OPTIONS)
    stack = xr.concat([image, image], "shot")
    if passes:
        assert run(recipe, image).setup == SETUP
        assert _stored(stack, recipe).sizes["shot"] == 2
        return
    with pytest.raises(InputError, match=r"pixels of .* m"):
        run(recipe, image)
    with pytest.raises(InputError, match=r"pixels of .* m"):
        _stored(stack, recipe)


def test_uneven_coordinates_are_refused() -> None:
    image = _placed(1.0, 1.0, "mm")
    with pytest.raises(InputError, match="not evenly spaced"):
        invert(image.assign_coords(y=image.y**2), options=OPTIONS)


@pytest.mark.parametrize(
    ("unit", "metres"),
    [("m", 1.0), ("cm", 1e-2), ("mm", 1e-3), ("micron", 1e-6), ("um", 1e-6), ("nm", 1e-9)],
)
def test_coordinate_spacing_is_in_metres(unit: str, metres: float) -> None:
    spacing = coordinate_spacing(_placed(2.0, 2.0, unit), "image")
    assert spacing == pytest.approx(2 * metres)


@pytest.mark.parametrize("side", [1, 2, 3, 7])
def test_block_sums_are_numpys_to_the_last_bit(side):
    plane = np.random.default_rng(0).random((22, 30))
    height, width = 22 // side, 30 // side
    blocks = plane[: height * side, : width * side].reshape(height, side, width, side)
    np.testing.assert_array_equal(block_sums(plane, side), blocks.sum(axis=(1, 3)))
    usable = plane > 0.1
    counts = (blocks > 0.1).sum(axis=(1, 3))
    np.testing.assert_array_equal(block_sums(usable, side), counts)
    assert block_sums(plane.astype(np.float32), side).dtype == np.float32


@pytest.mark.parametrize("scale", [1e-290, 1.0, 1e290])
def test_order_by_value_sorts_at_any_scale(scale: float) -> None:
    values = scale * np.random.default_rng(3).integers(-5, 50, 3000)
    order = order_by_value(values)
    assert np.array_equal(order, np.argsort(values, kind="stable"))
    assert np.array_equal(order_by_value(np.full(7, scale)), np.arange(7))
