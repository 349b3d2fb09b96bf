"""A recipe applied to shots: the same as doing each of its steps by hand."""

from __future__ import annotations

import typing
from pathlib import Path
from typing import Any

import h5py
import imageio.v3 as iio
import numpy as np
import pytest
from scipy.io import savemat

from helpers.stacks import inverted_stack
from napari_shadowinv import (
    InputError,
    Instrument,
    InversionOptions,
    OpticalSetup,
    invert,
)
from napari_shadowinv._typing import FloatArray
from napari_shadowinv.cautions import Caution
from napari_shadowinv.cli._settings import (
    INVERSION_SECTIONS,
    settings_of,
    source_from,
    with_steps,
)
from napari_shadowinv.inversion import plan_sites
from napari_shadowinv.inversion.normalise import number_of_sites
from napari_shadowinv.io import read_shot
from napari_shadowinv.options import FitChoices, FitOptions
from napari_shadowinv.physics.forward import synthetic_image
from napari_shadowinv.physics.phantoms import gaussian_blob
from napari_shadowinv.physics.setup import ProtonSetup
from napari_shadowinv.pipeline import Cache, read_recipe, run, write_recipe
from napari_shadowinv.pipeline.fit_run import collect_fit_inputs
from napari_shadowinv.pipeline.inversion_run import collect_inputs
from napari_shadowinv.pipeline.rerun import rerun
from napari_shadowinv.preprocessing import (
    ESTIMATES,
    STEPS,
    BackgroundFilter,
    Bin,
    Choice,
    Crop,
    Dark,
    IsotropicEstimate,
    LowPassFilter,
    MeasuredSource,
    PolynomialEstimate,
    Recipe,
    Rotate,
    Step,
)
from napari_shadowinv.shot import Shot

SHAPE = (40, 52)
OPTIONS = InversionOptions(n_sites=400)
MOVES: tuple[tuple[Step, ...], ...] = (
    (Rotate(angle=90),),
    (Rotate(angle=-180),),
    (Crop(y=(3, 31), x=(8, None)),),
    (Bin(factor=3),),
    (Rotate(angle=-90), Crop(y=(5, 45), x=(2, 37)), Bin(factor=2)),
    (Bin(factor=2), Rotate(angle=180), Crop(x=(1, 22)), Rotate(angle=270)),
)


@pytest.fixture(scope="module")
def image() -> FloatArray:
    blob = gaussian_blob(SHAPE, 8.0, 6.0, (18, 27))
    ramp = np.tile(np.linspace(80, 120, SHAPE[1]), (SHAPE[0], 1))
    return synthetic_image(blob.displacement, ramp)


def assert_same(one: Any, other: Any, rtol: float = 0.0) -> None:
    for name in ("displacement", "potential", "weights", "image", "source", "residual"):
        expected = other.variable(name)
        scale = rtol * np.abs(expected).max()
        np.testing.assert_allclose(one.variable(name), expected, rtol=0, atol=scale)


def test_without_steps_it_is_invert(image: FloatArray) -> None:
    free = InversionOptions(boundary="free", flux="known")
    for options in (OPTIONS, InversionOptions(), free):  # the latter choose their sites
        assert_same(run(Recipe(options=options), image), invert(image, options=options))
    beam = np.full_like(image, 90)
    mask = np.ones(SHAPE, bool)
    mask[5, 7] = False
    inversion = run(Recipe(options=OPTIONS), Shot(image, source=beam, mask=mask))
    assert_same(inversion, invert(image, source=beam, mask=mask, options=OPTIONS))


def test_steps_are_done_in_their_order(image: FloatArray) -> None:
    background, smooth = BackgroundFilter(degree=1), LowPassFilter(width=2)
    for steps in ((background, Bin(factor=2), smooth), (smooth, Bin(factor=2), background)):
        expected = image
        for step in steps:
            if step is background:
                expected = BackgroundFilter(degree=1).filter_image(expected)
            elif step is smooth:
                expected = LowPassFilter(width=2.0).filter_image(expected)
            else:
                expected = expected.reshape(20, 2, 26, 2).sum(axis=(1, 3))
        assert_same(
            run(Recipe(steps=steps, options=OPTIONS), image), invert(expected, options=OPTIONS)
        )


def test_source_and_masks_go_through_the_same_steps(image: FloatArray) -> None:
    mask, bare = np.ones(SHAPE, bool), np.ones(SHAPE, bool)
    mask[2:4, 2:5], bare[12:24, 20:34] = False, False
    steps = (Rotate(angle=90), Crop(x=(0, 36)), Bin(factor=2), LowPassFilter(width=1))

    def by_hand(array: Any) -> Any:
        turned = np.rot90(array)[:, :36].reshape(26, 2, 18, 2)
        return turned.all(axis=(1, 3)) if array.dtype == bool else turned.sum(axis=(1, 3))

    usable = by_hand(mask)
    small = LowPassFilter(width=1).filter_image(by_hand(image), usable)
    recipe = Recipe(steps=steps, source=PolynomialEstimate(degree=1), options=OPTIONS)
    source = PolynomialEstimate(degree=1).source(small, usable & by_hand(bare))
    inversion = run(recipe, Shot(image, mask=mask, source_mask=bare))
    # Sums of a turned array are rounded in another order.
    expected = invert(small, source=source, mask=usable, options=OPTIONS)
    assert_same(inversion, expected, rtol=1e-9)
    measured = LowPassFilter(width=1).filter_image(by_hand(1.1 * image + 9), usable)
    inversion = run(
        Recipe(steps=steps, options=OPTIONS), Shot(image, source=1.1 * image + 9, mask=mask)
    )
    expected = invert(small, source=measured, mask=usable, options=OPTIONS)
    assert_same(inversion, expected, rtol=1e-9)


@pytest.mark.parametrize("steps", MOVES)
def test_the_matrix_says_where_pixels_came_from(steps: tuple[Step, ...]) -> None:
    """A plane is exact under linear interpolation, so its values show where a pixel was."""
    recipe = Recipe(steps=steps, setup=ProtonSetup.example())
    matrix = recipe.matrix(SHAPE)
    for axis, plane in enumerate(np.indices(SHAPE, dtype=float)):
        moved = recipe.move(Shot(plane, setup=ProtonSetup.example()))
        assert moved.shape == recipe.shape_after(SHAPE)
        share = abs(np.linalg.det(matrix))  # pixels of the image in one of the result
        y, x = np.indices(moved.shape)
        expected = matrix[axis, 0] * y + matrix[axis, 1] * x + matrix[axis, 2]
        used = np.ones(moved.shape, bool) if moved.mask is None else moved.mask
        assert used.mean() > 0.6
        np.testing.assert_allclose(moved.image[used] / share, expected[used], atol=1e-9)
        assert moved.setup is not None
        assert moved.setup.object_pixel_size == pytest.approx(
            share**0.5 * ProtonSetup.example().object_pixel_size
        )


@pytest.mark.parametrize("steps", MOVES)
def test_a_point_source_is_where_it_was_in_the_recorded_image(steps: tuple[Step, ...]) -> None:
    image = np.ones(SHAPE)
    setup = ProtonSetup.example().model_copy(update={"pixel_size": 6.5e-6})
    recipe = Recipe(steps=steps, source=IsotropicEstimate(), setup=setup, options=OPTIONS)
    inversion = run(recipe, image)
    uncropped = run(recipe.model_copy(update={"steps": ()}), image).source
    moved = recipe.move(Shot(uncropped))
    used = inversion.mask if moved.mask is None else inversion.mask & moved.mask
    ratio = inversion.source[used] / moved.image[used]
    # The source sees the same solid angle, up to the curvature within rotated pixels.
    np.testing.assert_allclose(ratio, ratio.mean(), rtol=2e-4)


@pytest.mark.parametrize("n_bad", [0, 9])
@pytest.mark.parametrize("key", ["mask", "file", "source_mask"])
def test_a_mask_of_bad_pixels_is_called_inverted(
    n_bad: int, key: str, image: FloatArray, tmp_path: Path
) -> None:
    bad = np.zeros(SHAPE, bool)
    bad.flat[: 17 * n_bad : 17] = True
    file = tmp_path / "pixel_mask.tif"
    iio.imwrite(file, bad.astype(np.uint8))
    recipe = Recipe(options=OPTIONS, mask=file if key == "file" else None)
    masks = {} if key == "file" else {key: bad}
    leaves = f"mask leaves {n_bad} of {bad.size:,} pixels usable"
    with pytest.raises(InputError, match=f"{leaves}.*NeXus pixel masks 0 is usable"):
        run(recipe, Shot(image, source=np.ones(SHAPE), **masks))


def changed(choice: type[Choice]) -> Choice:
    """A choice with values other than its defaults."""
    values: dict[str, Any] = {}
    for name, field in choice.parameters().items():
        options = typing.get_args(field.annotation)
        if isinstance(field.default, str):
            values[name] = next(option for option in options if option != field.default)
        elif isinstance(field.default, tuple):
            values[name] = (1, 9)
        else:
            values[name] = 180 if name == "angle" else (field.default or 0) + 1
    return choice.model_validate(values)


SETUPS = (
    ProtonSetup.example(),
    OpticalSetup(wavelength=5e-7, object_image_distance=0.1, pixel_size=1e-5),
)


FITS = (
    FitChoices(),
    FitChoices(fields=("B", "E"), beam="unknown", brightness="free", noise="poisson"),
    FitChoices(noise=3.5, psf=0.0, options=FitOptions(align="affine", smoothness=2.0)),
    FitChoices(source_size=1e-5, resolution=3e-5, options=FitOptions(threads=2, seed=7)),
)


@pytest.mark.parametrize(("setup", "fit"), list(zip(2 * SETUPS, FITS, strict=True)))
@pytest.mark.parametrize("source", [*ESTIMATES.values(), MeasuredSource])
def test_a_recipe_survives_its_file(
    tmp_path: Path, source: Any, setup: Any, fit: FitChoices
) -> None:
    chosen = MeasuredSource(file=tmp_path / "beam.tif", variable="b")
    recipe = Recipe(
        steps=tuple(changed(step) for step in STEPS.values()),
        source=chosen if source is MeasuredSource else changed(source),
        mask=tmp_path / "below" / "mask.png",
        setup=setup,
        instrument=Instrument(detector="film", beam_source="TNSA", beam_rms=0.02, background=0),
        options=InversionOptions(n_sites=7, boundary="free", flux="known"),
        fit=fit,
    )
    path = tmp_path / "recipe.toml"
    write_recipe(path, recipe)
    assert read_recipe(path) == recipe
    assert str(tmp_path) not in path.read_text()  # paths are relative to the recipe
    assert "gamma" not in path.read_text()  # the default of film
    assert Recipe.model_validate_json(recipe.model_dump_json()) == recipe


def typed(value: Any) -> str:
    """Return a value as it is typed."""
    return ":".join(map(str, value)) if isinstance(value, tuple) else str(value)


def test_every_parameter_can_be_typed() -> None:
    for step in (changed(model) for model in STEPS.values()):
        words = [f"{name}={typed(value)}" for name, value in step.values().items()]
        assert with_steps((), [" ".join([step.name(), *words])]) == (step,)
    for source in (changed(model) for model in ESTIMATES.values()):
        words = [f"{name}={typed(value)}" for name, value in source.values().items()]
        assert source_from(" ".join([source.name(), *words]), None) == source
    settings = settings_of(["instrument.gamma=0.1"], INVERSION_SECTIONS, {})
    assert settings.change("instrument", Instrument(blur=2)) == Instrument(blur=2, gamma=0.1)


def test_a_step_of_a_recipe_is_changed_in_its_place() -> None:
    steps = with_steps((), ["bin 2", "hot-pixels 6", "low-pass 3"])
    assert [step.name() for step in steps] == ["hot-pixels", "bin", "low-pass"]
    moved = (steps[2], steps[1])
    again = with_steps(moved, ["low-pass width=4", "bin 5"])
    assert [step.values() for step in again] == [{"width": 4}, {"factor": 5}]


def test_quotes_keep_a_space_in_a_value() -> None:
    for file in ("'dark frame.tif'", '"dark frame.tif"', "dark' 'frame.tif"):
        assert with_steps((), [f"dark {file}"]) == (Dark(level=Path("dark frame.tif")),)
    with pytest.raises(InputError, match="second quotation mark"):
        with_steps((), ["dark 'dark frame.tif"])


OTHER = {
    "n_sites": 77, "floor": 0.3, "tolerance": 0.05, "lloyd_iterations": 0, "lloyd_tolerance": 1.0,
    "readout": "centroid", "solver": "lbfgs", "stages": "single",
    "max_iterations": 9, "negative": "clip", "boundary": "free", "margin": 9, "decay_length": 3.0,
    "flux": "known", "caustic_jacobian": 0.5, "seed": 4, "threads": 1, "accuracy": 0.3,
    "noise_level": 0.1, "units_per_quantum": 2.0, "max_error": 0.2,
}  # fmt: skip


def test_site_key_has_every_option_that_moves_sites(image: FloatArray) -> None:
    """Of every such option, and of no other: a cache relies on the key."""
    assert OTHER.keys() == InversionOptions.model_fields.keys()
    mask = np.ones(SHAPE, bool)
    mask[20:, 30:] = False
    for name, value in OTHER.items():
        free = name in ("margin", "decay_length", "flux")
        base = InversionOptions(n_sites=300, boundary="free" if free else "closed")
        variant = base.model_copy(update={name: value})
        sites = [
            plan_sites(image, options.model_copy(update={"n_sites": count}), mask=mask)
            .levels[-1]
            .sites
            for options in (base, variant)
            for count in [number_of_sites(SHAPE, options)]
        ]
        is_same = sites[0].shape == sites[1].shape and np.array_equal(*sites)
        assert (base.site_key() == variant.site_key()) == is_same, name


def test_cache_spares_work_without_changing_results(image: FloatArray) -> None:
    cache = Cache()
    recipe = Recipe(source=PolynomialEstimate(degree=1), options=OPTIONS)
    first = run(recipe, image, cache=cache)
    sharper = recipe.model_copy(
        update={"options": OPTIONS.model_copy(update={"tolerance": 1e-5, "threads": 1})}
    )
    second = run(sharper, image, cache=cache)
    assert cache.hits == 1
    assert_same(second, run(sharper, image))
    preview = run(sharper, image, cache=cache, preview=True)
    np.testing.assert_allclose(preview.displacement, second.displacement, atol=1e-3)
    assert preview.provenance is not None
    assert preview.provenance.image.notes == ("previewed",)
    assert_same(run(recipe, image, cache=cache), first)


@pytest.mark.parametrize(
    ("recipe", "given", "named"),
    [
        (Recipe(), {"dark": 1}, "dark frame, which a result cannot repeat"),
        (Recipe(source=MeasuredSource()), {}, "asks for a measured source, but none is given"),
        (Recipe(source=PolynomialEstimate()), {"source": 2}, "choose one of them"),
        (
            Recipe(steps=(BackgroundFilter(),)),
            {"source": 2},
            "would flatten the image but not the source",
        ),
        (Recipe(), {"mask": (3, 4)}, r"mask has shape \(3, 4\), image \(40, 52\)"),
        (Recipe(), {"source_mask": SHAPE}, "no source estimate to use it"),
        (Recipe(source=IsotropicEstimate()), {}, "and no setup"),
        (Recipe(steps=(Crop(y=(38, 90)),)), {}, "contains 52 × 2 pixels"),
        (Recipe(steps=(Bin(factor=30),)), {}, "cannot bin 40×52 pixels by 30"),
    ],
)
def test_run_refuses_inputs_that_do_not_match(
    image: FloatArray, recipe: Recipe, given: dict[str, Any], named: str
) -> None:
    arguments: dict[str, Any] = {
        name: value * image if isinstance(value, int) else np.ones(value, bool)
        for name, value in given.items()
    }
    with pytest.raises(InputError, match=named):
        run(recipe, Shot(image, **arguments))


def test_a_source_beside_the_shot_in_its_file_is_found(tmp_path: Path, image: FloatArray) -> None:
    beam = np.full_like(image, 90)
    savemat(tmp_path / "shots.mat", {"shot": image, "beam": beam})
    shot = read_shot(tmp_path / "shots.mat", variable="shot")
    recipe = Recipe(source=MeasuredSource(variable="beam"), options=OPTIONS)
    assert_same(run(recipe, shot), invert(image, source=beam, options=OPTIONS))
    with pytest.raises(InputError, match="but names no file"):
        inverted_stack(np.stack([image, image]), tmp_path, recipe)
    stack = inverted_stack(Shot(np.stack([image, image]), source=beam), tmp_path, recipe)
    np.testing.assert_array_equal(stack.displacement[1], run(recipe, shot).displacement)


def test_a_shot_keeps_the_doubts_about_its_file(tmp_path: Path, image: FloatArray) -> None:
    """What was given with it precedes what the file says, but not what its reader doubts."""
    path = tmp_path / "shot.jpg"
    grey = (200 * image / image.max()).astype(np.uint8)
    iio.imwrite(path, grey)
    assert {caution.code for caution in read_shot(path).cautions} == {"gamma"}
    inversion = run(Recipe(options=OPTIONS), Shot(path))
    assert "gamma" in {caution.code for caution in inversion.cautions}
    doubts = (Caution("gamma", "not linear"),)
    recorded = Shot(image, name="stored", path=path, cautions=doubts)
    known = Shot(path, name="given").completed_by(recorded)
    of_file = ("image", "path", "metadata", "cautions", "setup_in_file")
    assert all(getattr(known, name) is getattr(recorded, name) for name in of_file)
    assert known.name == "given"


def test_a_source_that_was_not_recorded_has_the_error_of_an_estimate(image: FloatArray) -> None:
    beams = [
        run(Recipe(options=OPTIONS), Shot(image, source=0 * image + 1, measured=measured)).errors
        for measured in (False, True)
    ]
    assert beams[0] is not None
    assert beams[1] is not None
    assert beams[0].beam_basis == "assumed"
    assert beams[1].beam_basis != "assumed"


def test_a_shot_is_shown_and_what_an_inversion_does_not_use_is_named(image: FloatArray) -> None:
    assert "Shot" in repr(Shot("shot.tif", name="shot"))
    with pytest.raises(InputError, match=r"image is 'shot\.tif': read it first"):
        _ = Shot("shot.tif").shape
    with pytest.raises(InputError, match=r"setup is 'setup\.toml': expected that of an experiment"):
        Shot(image, setup="setup.toml")
    texts = [c.text for c in run(Recipe(options=OPTIONS), Shot(image, psf=2.0)).report.cautions]
    assert any("the shot has psf, which only fits use" in text for text in texts)


def test_a_setup_of_the_shot_precedes_the_recipe_and_that_of_its_file_does_not(
    image: FloatArray, tmp_path: Path
) -> None:
    ours, file, theirs = (
        ProtonSetup.example().model_copy(update={"energy": energy}) for energy in (3.0, 9.0, 15.0)
    )
    with h5py.File(tmp_path / "shot.h5", "w") as written:
        written["image"] = image
        written.attrs.update(
            object_type="radiograph",
            pradformat_version="0.2.0",
            pixel_width=file.object_pixel_size * file.magnification,
            source_object_dist=file.source_object_distance,
            object_image_dist=file.object_image_distance,
            spec_name="p+",
            spec_energy=1e6 * file.energy,
        )
    recorded = read_shot(tmp_path / "shot.h5")
    recipe, shot = Recipe(setup=theirs, options=OPTIONS), Shot(image, ours)
    assert collect_inputs(recipe, shot).shot.setup == ours
    fits = collect_fit_inputs(recipe.model_copy(update={"source": None}), [shot])
    assert fits.setups == (ours,)
    for of_file in (recorded, recorded.bin_pixels(2)):
        assert collect_inputs(recipe, of_file).shot.setup == theirs
        assert collect_inputs(Recipe(), of_file).shot.setup == of_file.setup
    assert recorded.setup is not None
    assert recorded.setup.energy == pytest.approx(file.energy)
    again = rerun(run(recipe, shot), [image])
    assert again.is_identical
    assert again.content.provenance.setup == ours
