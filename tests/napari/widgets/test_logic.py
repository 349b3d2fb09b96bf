"""Computations behind the widgets, without a window."""

from __future__ import annotations

import threading
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from napari.layers import Image, Labels, Shapes

from helpers.jobs import run_job
from napari_shadowinv import InputError, InversionOptions
from napari_shadowinv._napari.widgets._layers import crop_of, image_of, mask_of
from napari_shadowinv._napari.widgets._objects import GridFile
from napari_shadowinv._napari.widgets._stack_jobs import StackJob
from napari_shadowinv._napari.widgets.forward_model import ForwardJob
from napari_shadowinv._napari.widgets.invert_shot import SourceJob, estimate_cost
from napari_shadowinv._system.progress import Progress
from napari_shadowinv.analysis.paths import (
    Profile,
    interpolate,
    sample_path,
    sample_strip,
    table_text,
)
from napari_shadowinv.errors import InversionCancelled
from napari_shadowinv.inversion import Inversion, compilation, invert
from napari_shadowinv.physics.forward import synthetic_image
from napari_shadowinv.physics.phantom_models import BlobRecipe, ToroidRecipe
from napari_shadowinv.physics.phantoms import gaussian_blob, paper_setup
from napari_shadowinv.physics.trace_options import GridView
from napari_shadowinv.pipeline import Cache, run
from napari_shadowinv.pipeline.inversion_run import PREVIEW_SITES, quick_source
from napari_shadowinv.pipeline.run_options import RunOptions
from napari_shadowinv.preprocessing import (
    BackgroundFilter,
    ButterworthFilter,
    Crop,
    Estimate,
    GaussianEstimate,
    HighPassFilter,
    InterpolatedEstimate,
    IsotropicEstimate,
    LowPassEstimate,
    LowPassFilter,
    MeasuredSource,
    PolynomialEstimate,
    Recipe,
    Step,
    TotalVariationEstimate,
    UniformEstimate,
    filters,
    isotropic_source,
)
from napari_shadowinv.shot import Shot

FEW = InversionOptions(n_sites=500)
Array = np.ndarray[Any, Any]


def test_a_crop_gives_the_field_of_the_cropped_image(shot: Array) -> None:
    rows, columns = slice(4, 44), slice(10, 58)
    crop = Crop(y=(rows.start, rows.stop), x=(columns.start, columns.stop))
    cropped = run(Recipe(steps=(crop,), options=FEW), shot)
    alone = run(Recipe(options=FEW), shot[rows, columns])
    np.testing.assert_array_equal(cropped.displacement, alone.displacement)


def test_what_the_mask_hides_does_not_matter(shot: Array) -> None:
    usable = np.ones(shot.shape, bool)
    usable[30:36, 5:12] = False
    spoiled = shot.copy()
    spoiled[~usable] = np.nan
    recipe = Recipe(steps=(LowPassFilter(),), source=LowPassEstimate(), options=FEW)
    first, second = (
        run(recipe, Shot(image, mask=usable)) for image in (spoiled, np.where(usable, shot, 1e4))
    )
    np.testing.assert_allclose(first.potential, second.potential, atol=1e-9)


def test_sites_are_kept_while_the_source_stays(shot: Array) -> None:
    cache = Cache()
    source = np.full(shot.shape, 7.0)

    def inverted(image: Array, source: Any, **options: Any) -> None:
        run(Recipe(options=FEW.model_copy(update=options)), Shot(image, source=source), cache=cache)

    inverted(shot, source)
    inverted(shot, source)
    inverted(filters.low_pass(shot, 1.0), source, tolerance=1e-2)
    assert cache.hits == 2
    inverted(shot, source + np.linspace(0, 1, shot.shape[1]))
    inverted(shot, source, seed=1)
    assert cache.hits == 2


def test_other_boundaries_have_other_sites(shot: Array) -> None:
    cache = Cache()
    for boundary in ("closed", "free"):
        run(Recipe(options=FEW.model_copy(update={"boundary": boundary})), shot, cache=cache)
    assert cache.hits == 0


def test_a_preview_starts_from_the_one_before_and_a_run_does_not() -> None:
    shot = synthetic_image(gaussian_blob((48, 60), 45.0, 8.0).displacement)
    cache = Cache()

    def inverted(width: float, preview: bool, cache: Cache = cache) -> Inversion:
        recipe = Recipe(steps=(LowPassFilter(width=width),), options=FEW)
        return run(recipe, shot, cache=cache, preview=preview)

    inverted(1.0, preview=True)
    warm, cold = inverted(1.2, preview=True), inverted(1.2, preview=False)
    assert inverted(1.2, preview=True).report.iterations < cold.report.iterations
    assert warm.report.residual <= FEW.tolerance
    np.testing.assert_allclose(warm.displacement, cold.displacement, atol=0.01)
    # The same whatever was tried before.
    alone = inverted(1.2, preview=False, cache=Cache())
    # But for the last digit of the uniform source, which another filter rounds otherwise.
    np.testing.assert_allclose(cold.displacement, alone.displacement, atol=1e-11)
    assert cold.report.iterations == alone.report.iterations
    plan = cache.plan(2 + np.eye(*shot.shape), None, FEW)
    assert cache.last_inversion(plan) is None


def test_a_step_does_the_same_to_image_and_source_as_alone(shot: Array) -> None:
    usable = np.ones(shot.shape, bool)
    usable[5:9, 7:12] = False
    image = np.where(usable, shot, np.nan)
    beam = 1 + np.random.default_rng(0).random(shot.shape)
    recipe = Recipe(steps=(LowPassFilter(width=1.5),), options=FEW)
    mine = run(recipe, Shot(image, source=beam, mask=usable))
    smooth, source = (
        LowPassFilter(width=1.5).filter_image(plane, usable) for plane in (image, beam)
    )
    alone = invert(smooth, source=source, mask=usable, options=FEW)
    np.testing.assert_array_equal(mine.displacement, alone.displacement)
    assert np.isfinite(smooth).all()


@pytest.mark.parametrize("step", [HighPassFilter(), BackgroundFilter(), ButterworthFilter()])
def test_what_flattens_the_image_fits_no_measured_source(
    shot: Array, tmp_path: Path, step: Step
) -> None:
    beam = np.linspace(1, 1.1, shot.shape[1]) * np.ones(shot.shape)
    recipe = Recipe(steps=(step,), source=MeasuredSource())
    with pytest.raises(InputError, match="would flatten the image but not the source"):
        run(recipe, Shot(shot, source=beam))
    with pytest.raises(InputError, match="would flatten the image but not the source"):
        run_job(StackJob(shot[None], tmp_path / "a.shadowinv.zarr", recipe, beam))


def test_a_stack_tells_that_it_compiles(
    shot: Array, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(compilation, "is_compiled", lambda: False)
    progress: list[Progress] = []
    job = StackJob(shot[None], tmp_path / "a.shadowinv.zarr", Recipe(options=FEW))
    status = job.run(progress.append, lambda: False)
    assert list(dict.fromkeys(report.stage for report in progress)) == ["prepare", "shots"]
    assert any(report.message.startswith("compiling, ") for report in progress)
    assert status.text == "1 of 1 done"


def test_a_flat_source_is_no_other_after_the_image_is_flattened(shot: Array) -> None:
    recipe = Recipe(steps=(HighPassFilter(width=9.0),), options=FEW)
    fields = [run(recipe, Shot(shot, source=beam)) for beam in (None, 3 * np.ones(shot.shape))]
    np.testing.assert_allclose(fields[0].displacement, fields[1].displacement, atol=1e-9)
    assert fields[1].errors.beam.rms > 0  # the filter takes from the object


def test_a_uniform_source_is_the_same_after_a_filter(shot: Array) -> None:
    cache = Cache()
    for width in (1.0, 1.5, 2.0):
        recipe = Recipe(steps=(LowPassFilter(width=width),), options=FEW)
        run(recipe, shot, cache=cache)
    assert cache.hits == 2


def test_seconds_of_all_stages_are_told(shot: Array) -> None:
    report = run(Recipe(source=LowPassEstimate(), options=FEW), shot).report
    assert set(report.seconds) == {"source", "prepare", "sites", "transport", "read-out", "errors"}
    assert report.seconds["sites"] > 0
    assert not report.warnings


def test_report_leaves_masked_pixels_out_of_the_peak(shot: Array) -> None:
    inversion = invert(shot, options=FEW)
    mask = np.ones(shot.shape, bool)
    mask[36:44, 8:16] = False
    displacement = np.where(mask, inversion.displacement, 100.0)
    masked = replace(inversion, mask=mask, displacement=displacement)
    (text,) = [fact.text for fact in masked.facts if fact.key == "displacement"]
    largest = np.hypot(*inversion.displacement)[mask].max()
    assert float(text.removeprefix("peak |d| ").split()[0]) == pytest.approx(largest, rel=0.01)


def test_doubts_of_a_source_are_in_the_report(shot: Array) -> None:
    near = paper_setup().model_copy(update={"pixel_size": 2e-5})

    def warnings(source: Estimate, image: Shot | Array = shot, **more: Any) -> str:
        recipe = Recipe(source=source, options=FEW, setup=near)
        return str(run(recipe, image, **more).report.warnings)

    assert "choose the source 'isotropic'" in warnings(UniformEstimate())
    assert "isotropic" not in warnings(IsotropicEstimate())
    # Also of an estimate that was made before.
    y, x = np.mgrid[: shot.shape[0], : shot.shape[1]]
    beam = 100 * np.exp(-((y - 24) ** 2 + (x - 30) ** 2) / 2 / 8**2) + 1
    hidden = np.hypot(y - 24, x - 30) > 10
    cache = Cache()
    for _ in range(2):
        text = warnings(GaussianEstimate(), Shot(beam * shot, mask=hidden), cache=cache)
        assert "the Gaussian beam rises to" in text


def test_the_axis_of_an_isotropic_source_is_in_the_middle_of_the_whole_image(shot: Array) -> None:
    near = paper_setup().model_copy(update={"pixel_size": 2e-5})
    crop = slice(20, 40), slice(5, 35)
    recipe = Recipe(
        steps=(Crop(y=(20, 40), x=(5, 35)),), source=IsotropicEstimate(), options=FEW, setup=near
    )
    expected = isotropic_source(np.ones(shot.shape), near)[crop]
    for preview in (False, True):
        source = run(recipe, shot, preview=preview).source
        np.testing.assert_allclose(source / source.mean(), expected / expected.mean())


def test_the_image_itself_is_refused_as_its_source(shot: Array) -> None:
    with pytest.raises(InputError, match="the source is the image itself"):
        run(Recipe(options=FEW), Shot(shot, source=3 * shot))


def test_a_preview_has_few_sites(shot: Array) -> None:
    many = np.tile(shot, (2, 2))
    assert many.size > PREVIEW_SITES
    assert run(Recipe(), many, preview=True).report.n_sites == PREVIEW_SITES
    assert run(Recipe(options=FEW), many, preview=True).report.n_sites == 500


@pytest.mark.parametrize("estimate", [LowPassEstimate(width=40), PolynomialEstimate()])
def test_a_quick_estimate_is_close_to_the_exact_one(estimate: Estimate) -> None:
    y, x = np.mgrid[:90, :121]
    beam = 100 * np.exp(-((y - 40) ** 2 + (x - 70) ** 2) / 9000)
    usable = np.ones(beam.shape, bool)
    usable[10:20, 30:50] = False
    quick = quick_source(estimate, np.where(usable, beam, 1e9), usable, 3000)
    exact = estimate.source(beam, usable)
    assert quick[usable].sum() == pytest.approx(beam[usable].sum(), rel=1e-9)
    assert abs(quick - exact)[usable].max() < 0.03 * exact.max()


def test_a_quick_total_variation_removes_the_object_and_keeps_the_edge() -> None:
    y, x = np.mgrid[:90, :120]
    beam = np.where(x < 60, 100.0, 60.0)
    shot = beam + 30 * (np.hypot(y - 45, x - 30) < 5)
    estimate = TotalVariationEstimate(weight=1.0)
    quick, exact = quick_source(estimate, shot, None, 3000), estimate.source(shot, None)
    away = abs(x - 59.5) > 6
    assert abs(quick - exact)[away].max() < 3
    assert abs(quick - beam)[away].max() < 5


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"image": np.zeros((20, 20))}, "no positive pixel"),
        ({"image": np.full((20, 20), np.nan)}, "NaN"),
        ({"image": np.ones((1, 1))}, "at least 4 × 4"),
        ({"image": np.ones((3, 20, 20))}, "expected two dimensions"),
        ({"source": np.ones((20, 21))}, "must match"),
        ({"source": Path("no such file.tif")}, "no such file"),
        ({"mask": np.ones((20, 21), bool)}, "must match"),
        ({"recipe": Recipe(steps=(Crop(y=(3, 4)),))}, "larger rectangle"),
        ({"recipe": Recipe(source=InterpolatedEstimate())}, "without a source mask"),
    ],
)
def test_a_mistake_gets_a_sentence(change: dict[str, Any], words: str) -> None:
    good = {"recipe": Recipe(), "image": np.ones((20, 20))}
    arguments = {**good, **change}
    with pytest.raises((InputError, OSError), match=words):
        run(arguments.pop("recipe"), Shot(**arguments))


def test_a_job_ends_when_it_is_asked_to(shot: Array) -> None:
    stop = threading.Event()
    stages: list[str] = []

    def hear(progress: Any) -> None:
        stages.append(progress.stage)
        if progress.stage == "transport":
            stop.set()

    with pytest.raises(InversionCancelled):
        run(Recipe(options=FEW), shot, on_progress=hear, should_stop=stop.is_set)
    assert "read-out" not in stages


LARGE = np.random.default_rng(0).normal(100, 5, (1024, 1024))
SLOW = PolynomialEstimate(degree=10)


def running(recipe: Recipe) -> Any:
    return lambda hear, stop: run(recipe, LARGE, on_progress=hear, should_stop=stop)


@pytest.mark.parametrize(
    "job",
    [
        lambda tmp_path: SourceJob(SLOW, Shot(LARGE), None, {}, preview=False).run,
        lambda tmp_path: running(Recipe(source=SLOW)),
        lambda tmp_path: running(Recipe(steps=(BackgroundFilter(degree=10),))),
        lambda tmp_path: (
            StackJob(LARGE[None], tmp_path / "a.shadowinv.zarr", Recipe(source=SLOW)).run
        ),
    ],
    ids=["source", "shot", "step", "stack"],
)
def test_a_megapixel_ends_at_the_look_that_asks(job: Any, tmp_path: Path) -> None:
    looks: list[bool] = []

    def should_stop() -> bool:
        looks.append(len(looks) >= 8)  # in the middle of the estimate or filter
        return looks[-1]

    with pytest.raises(InversionCancelled):
        job(tmp_path)(lambda _: None, should_stop)
    assert looks.count(False) == 8
    assert looks.count(True) <= 2  # a stack's own, and its worker's


def test_a_shot_is_looked_at_before_the_books_count_it(shot: Array, tmp_path: Path) -> None:
    stack, out = np.stack([shot, shot]), tmp_path / "a.shadowinv.zarr"
    counted: list[tuple[int | None, int]] = []

    class CountingJob(StackJob):
        def _update(self, index: int | None) -> None:
            counted.append((index, self.status.ended))

    job = CountingJob(stack, out, Recipe(options=FEW), run_options=RunOptions(workers=1))
    run_job(job)
    assert counted == [(0, 0), (1, 1)]
    assert job.status.ended == 2


def test_a_strong_object_warns_of_caustics_and_a_weak_one_does_not() -> None:
    weak = run_job(ForwardJob(BlobRecipe(amplitude=5, sigma=8), shape=(40, 50)))
    strong = run_job(ForwardJob(BlobRecipe(amplitude=-200, sigma=8), shape=(40, 50)))
    assert weak.warning == ""
    assert "Caustics" in strong.warning
    assert strong.caustic_share > 0


def test_a_potential_and_its_object_make_the_same_image() -> None:
    blob = BlobRecipe(amplitude=20, sigma=8)
    phantom = blob.phantom((40, 50), None)
    by_object = run_job(ForwardJob(blob, shape=(40, 50)))
    by_potential = run_job(ForwardJob(1e9 * phantom.potential, to_px2=1e-9))
    assert abs(by_object.image - by_potential.image).max() < 0.02


def test_a_magnetic_object_asks_for_particles() -> None:
    with pytest.raises(InputError, match="select the setup"):
        run_job(ForwardJob(ToroidRecipe()))


def test_forward_model_traces_a_3d_field_from_a_file(tmp_path):
    """The field is uniform: the displacement is that of its line integral."""
    places = np.linspace(-2e-4, 2e-4, 9)
    zeros = np.zeros((9, 9, 9))
    components = {"Bx": zeros, "By": zeros + 0.5, "Bz": zeros}
    dataset = xr.Dataset(
        {name: (("z", "y", "x"), values, {"units": "T"}) for name, values in components.items()},
        {axis: (axis, places, {"units": "m"}) for axis in "zyx"},
    )
    path = tmp_path / "field.nc"
    dataset.to_netcdf(path, engine="h5netcdf")
    setup = paper_setup()
    with pytest.raises(InputError, match="there is no setup"):
        run_job(ForwardJob(GridFile(str(path), GridView()), shape=(20, 30)))
    job = ForwardJob(GridFile(str(path), GridView(right="-x")), shape=(20, 30), setup=setup)
    prediction = run_job(job)
    # Seen with x to the left, y points up.
    expected = setup.displacement_from_path_integrated_b([-0.5 * 4e-4, 0.0])[1]
    np.testing.assert_allclose(prediction.displacement[1], expected, rtol=1e-2)
    assert "faces reaches 100 %" in prediction.warning


def test_a_plane_is_sampled_exactly_at_its_place_in_the_world() -> None:
    y, x = np.mgrid[:30, :40]
    plane = 2.0 * y + 0.5 * x
    points, distance = sample_path([[5.0, 10.0], [35.0, 50.0]], 0.5)
    values = interpolate(plane, points, lambda at: (at - np.array([3.0, 4.0])) / 2.0)
    expected = (points[:, 0] - 3) + 0.25 * (points[:, 1] - 4)
    inside = ((points[:, 1] - 4) / 2 >= 0) & ((points[:, 1] - 4) / 2 <= 39)
    np.testing.assert_allclose(values[inside], expected[inside], atol=1e-12)
    assert distance[-1] == pytest.approx(50)
    assert np.isnan(interpolate(plane, np.array([[-1.0, 0.0]]), lambda at: at)).all()


def test_a_table_names_each_unit_once() -> None:
    profiles = [
        Profile("a potential (nm)", "nm", np.array([1.0, 2.0])),
        Profile("re-projection", "flux/px²", np.array([np.nan, 4.0])),
    ]
    text = table_text(np.array([0.0, 1.5]), "µm", profiles)
    assert text.splitlines() == [
        "distance (µm),a potential (nm),re-projection (flux/px²)",
        "0,1,nan",
        "1.5,2,4",
    ]


def test_painted_pixels_are_unusable_or_the_only_usable_ones() -> None:
    image, labels = Image(np.ones((10, 12))), Labels(np.zeros((10, 12), int))
    assert mask_of(labels, image, True) is None
    labels.data[2, 3] = 5
    usable = mask_of(labels, image, True)
    assert usable is not None
    assert usable.sum() == 119
    assert not usable[2, 3]
    chosen = mask_of(labels, image, False)
    assert chosen is not None
    assert chosen.sum() == 1


def test_a_drawn_crop_follows_the_scale_of_its_image() -> None:
    image = Image(np.ones((20, 30)), scale=(2.0, 2.0), translate=(10.0, 0.0))
    rectangle = Shapes([np.array([[14, 8], [14, 40], [30, 40], [30, 8]])], shape_type="rectangle")
    assert crop_of(rectangle, image) == Crop(y=(2, 11), x=(4, 21))
    beyond = Shapes([np.array([[-90, -90], [-90, 90], [90, 90], [90, -90]])])
    assert crop_of(beyond, image) == Crop(y=(0, 20), x=(0, 30))
    assert crop_of(Shapes(ndim=2), image) is None


def test_a_drawn_mask_covers_the_pixels_under_it() -> None:
    image = Image(np.ones((20, 30)), scale=(2.0, 2.0))
    rectangle = Shapes([np.array([[8, 8], [8, 20], [16, 20], [16, 8]])], shape_type="rectangle")
    usable = mask_of(rectangle, image, True)
    assert usable is not None
    assert not usable[5:8, 5:10].any()
    assert usable[:3].all()


def test_layers_that_are_no_single_image_are_refused() -> None:
    with pytest.raises(InputError, match="File → Open"):
        image_of(None)
    with pytest.raises(InputError, match="colour"):
        image_of(Image(np.ones((8, 8, 3)), rgb=True))
    with pytest.raises(InputError, match="Split Stack"):
        image_of(Image(np.ones((4, 8, 8))))
    with pytest.raises(InputError, match="they must match"):
        mask_of(Labels(np.zeros((8, 9), int)), Image(np.ones((8, 8))), True)


@pytest.mark.parametrize("degrees", [0.0, 33.0, 90.0, 200.0])
def test_a_strip_averages_across_the_line_and_not_along_it(degrees: float) -> None:
    """The mean of cos ks across a width w is sinc kw/2; variations along the line are kept."""
    turned = np.deg2rad(degrees)
    tangent = np.array([np.sin(turned), np.cos(turned)])
    normal = np.array([np.cos(turned), -np.sin(turned)])
    middle, k, width = np.array([60.0, 65.0]), 0.15, 21.0
    place = np.moveaxis(np.mgrid[:121, :131].astype(float), 0, -1) - middle
    line = [middle - 30 * tangent, middle + 30 * tangent]
    _, distance = sample_path(line, 1.0)
    strip = sample_strip(line, distance, width, 1.0)
    assert strip.shape == (21, len(distance), 2)
    across = interpolate(np.cos(k * place @ normal), strip, lambda at: at)
    half = k * width / 2
    np.testing.assert_allclose(across, np.sin(half) / half, atol=0.003)
    on_line = interpolate(np.cos(k * place @ tangent), strip, lambda at: at)
    np.testing.assert_allclose(on_line, np.cos(k * (distance - 30)), atol=0.003)


def test_a_strip_of_whole_pixels_is_the_mean_of_their_rows() -> None:
    y, x = np.mgrid[:40, :50].astype(float)
    line = [[20.0, 5.0], [20.0, 45.0]]
    _, distance = sample_path(line, 1.0)
    for width in (1, 5, 9):
        values = interpolate(y**2 + x, sample_strip(line, distance, width, 1.0), lambda at: at)
        np.testing.assert_allclose(values, 400 + (width**2 - 1) / 12 + 5 + distance)
    # A row that is partly outside counts as far as it is inside.
    edge = [[0.0, 5.0], [0.0, 45.0]]
    values = interpolate(y, sample_strip(edge, distance, 5, 1.0), lambda at: at)
    np.testing.assert_allclose(values, 1.0)
    path = [[5.0, 5.0], [5.0, 15.0], [25.0, 15.0]]
    _, distance = sample_path(path, 1.0)
    strip = sample_strip(path, distance, 3.0, 1.0)
    np.testing.assert_allclose(np.ptp(strip[:, distance < 9.5, 0], axis=0), 2)
    np.testing.assert_allclose(np.ptp(strip[:, distance > 10.5, 1], axis=0), 2)


def test_the_table_tells_what_is_averaged() -> None:
    profile = Profile("height", "nm", np.array([1.0]), "mean over 5 px")
    assert table_text(np.zeros(1), "µm", [profile]).splitlines()[0] == (
        'distance (µm),"height (nm), mean over 5 px"'
    )


def test_the_cost_of_a_large_image_is_told_beforehand() -> None:
    few = InversionOptions(n_sites=10_000)
    assert estimate_cost((500, 500), few).text == ""
    four = estimate_cost((2000, 2000), few)
    # Measured: a process of 0.8 GB at its peak, without the layers of 7 planes.
    assert 0.8e9 < four.memory < 2 * (0.8e9 + 7 * 8 * 4e6)
    # Measured: 16 s of processor time, which two cores share.
    assert 16 / 2 < four.seconds < 16
    assert four.text == "4 Mpx with 10,000 sites: about 10 s and up to 1.3 GB."
    assert "about 40 s" in estimate_cost((2000, 2000), few, pace=3).text
    sixteen = estimate_cost((4000, 4000), few)
    assert sixteen.seconds == pytest.approx(4 * four.seconds, rel=0.05)
    huge = estimate_cost((100_000, 100_000), few)
    assert huge.exceeds_memory
    assert "GB: crop or bin the image" in huge.text
