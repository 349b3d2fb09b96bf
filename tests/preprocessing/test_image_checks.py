"""Mistakes are put into images whose field is known; the images without them stay silent."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from napari_shadowinv import InversionOptions, invert, run, synthetic_image
from napari_shadowinv.errors import InputError
from napari_shadowinv.inversion import plan_sites
from napari_shadowinv.physics.phantoms import gaussian_blob, toroid
from napari_shadowinv.physics.setup import ProtonSetup
from napari_shadowinv.preprocessing import (
    Bin,
    Crop,
    Dark,
    Recipe,
    image_cautions,
    image_checks,
    measure_shift,
)
from napari_shadowinv.preprocessing.image_checks import (
    CheckedImage,
    dark_level,
    is_negative,
    mask_dark,
    mask_gaps,
)
from napari_shadowinv.shot import Shot

SHAPE = (160, 160)
COUNTS = 300


def beam() -> np.ndarray:
    """A smooth beam with structure of 10 %, mean 1."""
    y, x = np.indices(SHAPE) / SHAPE[0]
    texture = gaussian_filter(np.random.default_rng(5).normal(size=SHAPE), 4)
    smooth = np.exp(-((y - 0.45) ** 2 + (x - 0.55) ** 2) / 0.5)
    structured = smooth * (1 + 0.1 * texture / texture.std())
    return structured / structured.mean()


def counted(peak: float) -> tuple[np.ndarray, np.ndarray]:
    """Image and source in counts, with noise of counting."""
    truth = toroid(SHAPE, ProtonSetup.example(), peak, 30e-6).displacement
    rng = np.random.default_rng(1)
    image = rng.poisson(COUNTS * synthetic_image(truth, beam())).astype(float)
    return image, rng.poisson(COUNTS * beam()).astype(float)


@pytest.fixture(scope="module")
def shot() -> tuple[np.ndarray, np.ndarray]:
    return counted(194.0)


@pytest.fixture(scope="module")
def faint() -> tuple[np.ndarray, np.ndarray]:
    return counted(24.0)


def peak_of(inversion) -> float:
    length = np.hypot(*inversion.displacement)
    return float(length[inversion.mask].max())


Y, X = np.indices(SHAPE) - 79.5
UNLIT = {
    "rim": np.hypot(Y, X) > 74,
    "frame": np.maximum(abs(Y), abs(X)) > 72,
    "beam stop": (np.hypot(Y + 50, X - 40) < 9) | ((abs(X - 40) < 3) & (Y < -50)),
}


@pytest.mark.parametrize(("name", "seed"), [*((name, 0) for name in UNLIT), ("rim", 1), ("rim", 2)])
def test_pixels_without_light_never_make_the_peak(name, seed) -> None:
    dark = UNLIT[name][::2, ::2]
    truth = toroid(dark.shape, ProtonSetup.example(), 40.0, 12e-6).displacement
    rng = np.random.default_rng(seed)
    image, source = (
        rng.poisson(60 * plane).astype(float)
        for plane in (synthetic_image(truth, np.ones(dark.shape)), np.ones(dark.shape))
    )
    options = InversionOptions(n_sites=1500)
    lit = invert(image, source=source, options=options)
    image[dark], source[dark] = rng.poisson(0.2, (2, int(dark.sum())))
    inversion = invert(image, source=source, options=options)
    np.testing.assert_array_equal(inversion.mask, ~dark)
    error = inversion.errors.of_peak.share * peak_of(lit)
    assert peak_of(inversion) == pytest.approx(peak_of(lit), abs=2 * error)
    (caution,) = (each for each in inversion.cautions if each.code == "unlit")
    assert f"{int(dark.sum()):,} " in caution.text
    planned = invert(image, plan=plan_sites(source, options), options=options)
    np.testing.assert_array_equal(planned.potential, inversion.potential)


def test_light_that_has_moved_into_the_dark_is_not_masked():
    """Bright discs on a dark ground, whose light an object moves by up to 4 px."""
    y, x = np.indices(SHAPE)
    discs = [np.hypot(y - a, x - b) < 14 for a, b in ((40, 45), (95, 60), (70, 115), (120, 120))]
    source = np.where(np.any(discs, axis=0), 300.0, 0.0)
    truth = gaussian_blob(SHAPE, 150.0, 24.0).displacement
    image = synthetic_image(truth, source)
    mask, (caution,) = mask_dark(image, source, None)
    assert caution.code == "unlit"
    assert 0.5 < 1 - mask.mean() < 0.9
    assert image[~mask].sum() < 1e-3 * image.sum()
    found = invert(image, source=source).displacement
    lit = source > 0
    error = np.linalg.norm((found - truth)[:, lit]) / np.linalg.norm(truth[:, lit])
    assert error < 0.05


@pytest.mark.parametrize("name", ["rim", "frame"])
def test_without_a_source_a_dark_rim_is_masked_and_a_hollow_stays(name) -> None:
    hollow = toroid(SHAPE, ProtonSetup.example(), 194.0, 30e-6).displacement
    image = np.random.default_rng(2).poisson(300 * synthetic_image(hollow, np.ones(SHAPE)))
    assert mask_dark(image.astype(float), None, None) == (None, [])
    framed = np.where(UNLIT[name], 2.0, image)
    lit, (caution,) = mask_dark(framed, None, None)
    np.testing.assert_array_equal(lit, ~UNLIT[name])
    assert caution.code == "unlit"


def test_a_small_smooth_spot_without_a_source_is_not_masked() -> None:
    y, x = np.mgrid[:24, :28]
    spot = 1e4 * np.exp(-((y - 12) ** 2 + (x - 14) ** 2) / 2 / 5**2) + 100
    image = np.random.default_rng(0).poisson(spot).astype(float)
    assert mask_dark(image, None, None) == (None, [])


def test_a_hollow_that_the_source_lights_is_not_masked() -> None:
    source = np.random.default_rng(0).poisson(100.0, SHAPE).astype(float)
    image = source.copy()
    image[60:100, 60:100] = np.random.default_rng(1).poisson(0.2, (40, 40))
    image[:, :20] = 0.0
    assert mask_dark(image, source, None) == (None, [])


@pytest.mark.parametrize("counts", [1000, 10_000])
def test_a_beam_that_falls_smoothly_to_a_few_counts_is_light(counts) -> None:
    beam = np.exp(-(Y**2 + X**2) / 2 / 32**2)
    assert (beam * counts).min() < 25
    rng = np.random.default_rng(3)
    image, source = (rng.poisson(counts * beam).astype(float) for _ in range(2))
    usable, _ = mask_dark(image, source, None)
    assert usable is None or (beam * counts)[~usable].max() < 6


@pytest.mark.parametrize("mark", [2**32 - 1, 2**16 - 1, 2**31 - 1, -1, -2, -9999])
def test_gaps_of_a_detector_are_masked_by_their_mark(mark, shot) -> None:
    image, source = (plane.copy() for plane in shot)
    gaps = np.zeros(SHAPE, bool)
    gaps[130:137] = gaps[:, 100:104] = True
    options = InversionOptions(n_sites=500)
    expected = run(Recipe(options=options), Shot(image, source=source, mask=~gaps))
    image[gaps] = mark
    inversion = run(Recipe(steps=(Dark(level=0),), options=options), Shot(image, source=source))
    np.testing.assert_array_equal(inversion.mask, ~gaps)
    np.testing.assert_array_equal(inversion.potential, expected.potential)
    (caution,) = (each for each in inversion.cautions if each.code == "unlit")
    assert f"{int(gaps.sum()):,} pixels of the image are {mark}," in caution.text
    source[gaps] = mark
    assert mask_gaps(source, None, "source")[1]


def test_light_up_to_the_limit_of_a_detector_is_no_gap(shot) -> None:
    image = np.minimum(shot[0] * 60, 2.0**16 - 1)
    assert (image == 2**16 - 1).sum() > 100
    assert mask_gaps(image, None, "image") == (None, [])
    subtracted = np.random.default_rng(0).poisson(0.3, (400, 400)) - 1.0
    assert mask_gaps(subtracted, None, "image") == (None, [])


def named(image, source, mask=None) -> list[str]:
    """The names of the cautions."""
    return [caution.code for caution in image_cautions(image, source, mask)]


def offset_share(*planes: np.ndarray, mask: np.ndarray | None = None) -> float:
    """The dark level of an image, or of image and source."""
    return dark_level([CheckedImage.of(plane, mask) for plane in planes])


def test_a_source_that_shots_share_is_checked_once(shot, faint, monkeypatch):
    checked: list[np.ndarray] = []
    find = image_checks.stray_pixels

    def note(image: np.ndarray, usable: np.ndarray) -> np.ndarray:
        checked.append(image)
        return find(image, usable)

    monkeypatch.setattr(image_checks, "stray_pixels", note)
    source = shot[1].copy()
    source[40, 50] *= 30
    alone = [image_cautions(image, source) for image in (shot[0], faint[0])]
    assert all("hot-pixels" in [caution.code for caution in cautions] for cautions in alone)
    checked.clear()
    shared = CheckedImage.of(source)
    assert [image_cautions(image, shared) for image in (shot[0], faint[0])] == alone
    assert len(checked) == 3
    plan = plan_sites(source)
    checked.clear()
    for image in (shot[0], faint[0]):
        invert(image, plan=plan)
    assert len(checked) == 3


def test_a_result_that_is_changed_does_not_change_later_checks(faint):
    image, source = faint
    plan = plan_sites(source)
    first = invert(image, plan=plan)
    first.source[:] = np.roll(first.source, 6, axis=0)
    assert measure_shift(image, first.source).is_significant.any()
    assert invert(image, plan=plan).report.cautions == first.report.cautions


def test_image_cautions_are_silent_on_a_right_shot(shot):
    image, source = shot
    assert named(image, source) == []
    assert named(image, None) == []
    assert named(7.3 * image, 0.1 * source) == []


@pytest.mark.parametrize("share", [0.2, 0.7])
def test_dark_level_is_the_offset_in_units_of_the_mean(shot, share):
    image = shot[0]
    offset = share * image.mean()
    assert offset_share(image) == 0
    assert offset_share(image + offset) == pytest.approx(share / (1 + share), rel=0.15)
    assert named(image + offset, shot[1] + offset) == ["dark-level"]


@pytest.mark.parametrize("power", [0.0, 0.5, 1.0])
def test_dark_level_needs_no_kind_of_noise_to_be_silent(power):
    image = synthetic_image(toroid(SHAPE, ProtonSetup.example(), 97.0, 30e-6).displacement)
    rng = np.random.default_rng(2)
    assert offset_share(image + 0.05 * image**power * rng.normal(size=SHAPE)) == 0


@pytest.mark.parametrize(("share", "seeds", "least_found"), [(0.2, 6, 6), (0.1, 12, 8)])
def test_dark_level_of_image_and_source_needs_no_deep_shadows(share, seeds, least_found):
    truth = toroid(SHAPE, ProtonSetup.example(), 97.0, 30e-6).displacement
    clean = synthetic_image(truth, beam())
    levels, alone = [], []
    for seed in range(seeds):
        rng = np.random.default_rng(seed)
        image, source = (rng.poisson(COUNTS * plane).astype(float) for plane in (clean, beam()))
        offset = share * image.mean()
        levels.append(offset_share(image + offset, source + offset))
        alone.append(offset_share(image + offset))
        assert offset_share(image, source) == 0
    found = np.array(levels)[np.nonzero(levels)]
    assert len(found) >= least_found
    assert np.median(levels) == pytest.approx(share / (1 + share), rel=0.15)
    np.testing.assert_allclose(found, share / (1 + share), rtol=0.6)
    assert np.count_nonzero(alone) < 2 / 3 * seeds


@pytest.mark.parametrize(("uneven", "speckle"), [(0.03, 0.0), (0.0, 0.1), (0.01, 0.03)])
def test_noise_in_proportion_to_the_signal_is_no_dark_level(uneven, speckle):
    truth = toroid(SHAPE, ProtonSetup.example(), 97.0, 30e-6).displacement
    rng = np.random.default_rng(3)
    pixels = 1 + uneven * rng.normal(size=SHAPE)

    def recorded(clean):
        flickering = np.clip(1 + speckle * rng.normal(size=SHAPE), 0, None)
        return rng.poisson(1000 * clean * pixels * flickering).astype(float)

    image, source = recorded(synthetic_image(truth, beam())), recorded(beam())
    assert offset_share(image, source) == 0


def test_dark_level_ignores_masked_pixels(shot):
    image = shot[0] + 100.0
    mask = np.ones(SHAPE, bool)
    mask[:, :40] = False
    garbled = np.where(mask, image, np.random.default_rng(0).normal(5000, 900, SHAPE))
    assert (
        offset_share(garbled, mask=mask)
        == offset_share(np.where(mask, image, 0.0), mask=mask)
        > 0.1
    )


def test_saturation_is_the_share_of_clipped_pixels(shot):
    image, source = shot
    limit = 1.5 * image.mean()
    clipped = np.minimum(image, limit)
    assert named(clipped, source) == ["saturation"]
    y, x = np.mgrid[-1:1:200j, -1:1:200j]
    beam = np.round(100 + 1000 * np.exp(-((x**2 + y**2) ** 2) / 0.03))
    assert (beam == beam.max()).mean() > 2e-3  # whole numbers repeat the maximum
    bright = image.copy()
    bright[:20] = 10 * image.max()
    below = np.arange(SHAPE[0])[:, None] >= np.full(SHAPE, 20)
    for plane, mask, share in (
        (clipped, None, np.mean(image >= limit)),
        (image, None, 0),
        (np.ones(SHAPE), None, 0),
        (beam, None, 0),
        (np.minimum(beam, 1000.0), None, (beam >= 1000).mean()),
        (bright, None, 20 / SHAPE[0]),
        (bright, below, 0),
    ):
        assert CheckedImage.of(plane, mask).saturated == pytest.approx(share)


def test_stray_pixels_are_those_put_in(shot):
    image = shot[0].copy()
    rows, columns = np.array([[20, 21], [70, 5], [140, 150], [10, 120]]).T
    image[rows, columns] = 20 * COUNTS
    image[30, 20] = 0
    expected = {*zip(rows.tolist(), columns.tolist(), strict=True), (30, 20)}
    assert {
        tuple(place) for place in np.argwhere(CheckedImage.of(image).stray).tolist()
    } == expected
    assert not CheckedImage.of(shot[0]).stray.any()
    assert named(image, shot[1]) == ["hot-pixels"]


def test_stray_pixels_leave_a_focus_alone():
    y, x = np.indices(SHAPE) - 80.0
    focus = 1 + 100 / (1 + 8 * (y**2 + x**2))
    assert not CheckedImage.of(focus).stray.any()


def test_negative_and_swapped_are_named(shot, faint):
    image, source = faint
    assert "negative" in named(image.max() - image, source)
    assert named(shot[1], shot[0])[-1:] == ["swapped"]


def test_invert_reports_the_cautions_of_the_checks(shot):
    image, source = (plane[30:130, 30:130] for plane in shot)
    dark = 0.5 * image.mean()
    few = InversionOptions(n_sites=300)
    warnings = invert(image + dark, source=source + dark, options=few).report.cautions
    assert "dark-level" in {caution.code for caution in warnings}
    # An estimate of the source comes from the image itself: nothing is compared with it.
    recipe = Recipe(source={"method": "gaussian"}, options=few)
    alone = run(recipe, np.minimum(image, 1.5 * image.mean()))
    names = {caution.code for caution in alone.report.cautions}
    assert "saturation" in names
    assert not {"register", "swapped", "negative"} & names


# The step


def test_dark_gives_the_field_without_an_offset(shot):
    image, source = (plane[:64, :64] for plane in shot)
    plain = run(Recipe(), Shot(image, source=source))
    taken = run(Recipe(steps=(Dark(level=200.0),)), Shot(image + 200, source=source + 200))
    np.testing.assert_array_equal(taken.displacement, plain.displacement)
    assert taken.provenance.image.notes == ("dark level 200 subtracted",)


def test_dark_frame_moves_with_the_image(shot, tmp_path):
    image, source = shot
    frame = np.random.default_rng(3).uniform(50, 250, SHAPE)
    np.save(tmp_path / "dark.npy", frame)
    dark = Dark(level=tmp_path / "dark.npy")
    crop, merge = Crop(y=(10, 74), x=(20, 84)), Bin(factor=2)
    plain = run(Recipe(steps=(crop, merge)), Shot(image, source=source))
    for steps in ((dark, crop, merge), (crop, dark, merge), (crop, merge, dark)):
        taken = run(Recipe(steps=steps), Shot(image + frame, source=source + frame))
        np.testing.assert_allclose(taken.displacement, plain.displacement, atol=1e-6)
    assert taken.provenance.image.dark.file == "dark.npy"


def test_dark_is_a_number_or_a_file_in_every_notation():
    for level in (12.5, "12.5"):
        assert Dark(level=level).level == 12.5
    recipe = Recipe(steps=(Dark(level="frames/dark.tif"),))
    assert recipe.dark_file.name == "dark.tif"
    assert Recipe.model_validate_json(recipe.model_dump_json()) == recipe


@pytest.mark.parametrize(
    ("level", "message"),
    [(500.0, "not below the image's mean"), ("unread.tif", "has not been read")],
)
def test_dark_says_why_it_cannot_be_subtracted(level, message):
    with pytest.raises(InputError, match=message):
        Dark(level=level).apply(Shot(np.full((8, 8), 400.0)))


def test_dark_is_compared_with_usable_pixels_only():
    image, mask = np.full((8, 8), 400.0), np.ones((8, 8), bool)
    image[0], mask[0] = 1e5, False
    with pytest.raises(InputError, match="not below the image's mean of 400"):
        Dark(level=500.0).apply(Shot(image, mask=mask))


def test_dark_frame_of_another_size_is_refused(tmp_path):
    np.save(tmp_path / "dark.npy", np.ones((5, 6)))
    with pytest.raises(InputError, match=r"\(5, 6\), image \(8, 8\): they must match"):
        run(Recipe(steps=(Dark(level=tmp_path / "dark.npy"),)), np.full((8, 8), 400.0))


V, U = np.indices((96, 96)) / 96 - 0.5
SPOT = np.exp(-2 * (V**2 + U**2))
EVEN = 1 + 0.05 * np.sin(5 * U + 2 * V)


@pytest.mark.parametrize("seed", [0, 1, 2])
@pytest.mark.parametrize(
    ("beam", "object_", "white"),
    [
        (SPOT, 0.3 * np.exp(-50 * (V**2 + U**2)), 1800),
        (EVEN, 0.8 * np.exp(-25 * (V**2 + U**2)), 2200),
    ],
)
def test_a_pair_of_negatives_is_seen_by_its_noise_and_by_its_rim(seed, beam, object_, white):
    rng = np.random.default_rng(seed)
    image, source = (rng.poisson(1000 * v).astype(float) for v in (beam * (1 + object_), beam))
    assert "negative" not in named(image, source)
    assert "negative" in named(white - image, white - source)
    if beam is SPOT:
        dense = [np.exp(-plane / 1000) for plane in (image, source)]
        unexposed = [np.pad(plane, 8, constant_values=1.0) for plane in dense]
        assert "negative" in named(*unexposed)


def test_images_without_noise_and_dark_objects_are_no_negatives():
    """Without noise only bends are left, the steepest where a beam is dim."""
    y, x = np.indices(SHAPE) / SHAPE[0] - 0.5
    rng = np.random.default_rng(1)
    clean = np.exp(-2 * (y**2 + x**2))
    ripples = 0.02 * np.cos(np.indices(SHAPE) / 9).sum(axis=0)
    assert "negative" not in named(clean * (1 + ripples), clean)
    smooth = 400 * (0.25 + np.exp(-4 * ((y - 0.05) ** 2 + (x + 0.08) ** 2) / 1.4))
    assert "negative" not in named(rng.poisson(smooth).astype(float), smooth)
    # Dark where its beam is bright, by an object.
    wide, shadow = np.exp(-3.56 * (y**2 + x**2)), 1 - 0.95 * np.exp(-4.23 * (y**2 + x**2))
    image, source = (rng.poisson(COUNTS * plane) for plane in (wide * shadow, wide))
    assert np.corrcoef(image.ravel(), source.ravel())[0, 1] < -0.4
    assert not is_negative(image, source, np.ones(SHAPE, bool))
