"""Warnings where a converged answer is wrong, and none where it is right.

Images are made from rays that are traced here, not by the package's forward model; they are small
so that an inversion takes a few tenths of a second.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import ndimage

from helpers.fit_images import Displacement as Field
from helpers.fit_images import counted, on_pixels
from helpers.public_data import public_file, public_names
from napari_shadowinv.facts import Verdict, percent
from napari_shadowinv.inversion import invert, solution_checks
from napari_shadowinv.inversion.error_budget import ErrorEstimate
from napari_shadowinv.inversion.noise import ImageNoise
from napari_shadowinv.inversion.normalise import prepare
from napari_shadowinv.inversion.solution_checks import (
    mark_caustics,
)
from napari_shadowinv.io import read
from napari_shadowinv.options import InversionOptions
from napari_shadowinv.physics import phantoms
from napari_shadowinv.physics.forward import synthetic_image
from napari_shadowinv.physics.setup import ProtonSetup
from napari_shadowinv.plotting import report_figure

Array = NDArray[np.float64]

SIDE = 100
RAYS = 12
ONSET = np.exp(1.5) / 2
"""Strength of an outward Gaussian field, in units of its radius, at which caustics begin."""

MISFIT, NOTHING, FOLDS, EDGE = "misfit", "no-deflection", "folds", "edge"


@cache
def traced(field: Field, beyond: int = 0) -> Array:
    """Count rays, 144 from each pixel, where they land; they come from beyond the edge, too."""
    image = counted(field, (SIDE, SIDE), rays=RAYS, margin=beyond)
    image.flags.writeable = False
    return image


def gaussian(strength: float, height: float = 10.0, width: float = 10.0) -> Field:
    """Outwards, caustics begin at a strength of 1; inwards at -1."""
    slope = strength * (ONSET if strength > 0 else 1.0)

    def field(y: Array, x: Array) -> Array:
        v, u = y - 48.0, x - 51.0
        falling = slope * np.exp(-((v / height) ** 2 + (u / width) ** 2) / 2)
        return falling * np.stack([v * (width / height) ** 2, u])

    return field


def long_range(peak: float, core: float, y0: float = 49.5, x0: float = 49.5) -> Field:
    """Falls like 1/r beyond its core."""

    def field(y: Array, x: Array) -> Array:
        v, u = y - y0, x - x0
        falling = 2 * peak * core / (v**2 + u**2 + core**2)
        return falling * np.stack([v, u])

    return field


def sheet(y: Array, x: Array) -> Array:
    """Does not fall at all, on two sides."""
    return np.stack([0 * y, 2 * np.tanh((x - 50) / 8)])


def jet(y: Array, x: Array) -> Array:
    """The same all along y, through two edges."""
    u = x - 50
    return np.stack([0 * y, 3 * u / 6 * np.exp(0.5 - (u / 6) ** 2 / 2)])


def codes_of(inversion):
    """Codes of all warnings."""
    return {caution.code for caution in inversion.report.cautions}


def signs(image: Array, **options: object) -> list[str]:
    """Codes of the warnings of this module that an image gets."""
    choices = {"negative": "clip", **options}
    report = invert(image, options=InversionOptions.model_validate(choices)).report
    assert report.converged
    codes = (MISFIT, NOTHING, FOLDS, EDGE)
    return [caution.code for caution in report.cautions if caution.code in codes]


def noisy(image: Array, share: float, seed: int = 1) -> Array:
    return image + share * np.random.default_rng(seed).normal(size=image.shape)


# One definition of the image residual


def test_the_report_has_the_residual_of_the_used_pixels():
    image = noisy(traced(gaussian(0.3)), 0.05)
    mask = np.ones(image.shape, dtype=bool)
    mask[:30] = False
    inversion = invert(image, mask=mask)
    off = (inversion.image - inversion.reprojection)[30:]
    expected = np.sqrt((off**2).mean()) / inversion.image[30:].mean()
    assert inversion.report.image_residual == pytest.approx(expected)
    assert inversion.to_dataset().attrs["image_residual"] == pytest.approx(expected)
    share = percent(expected)
    residual = next(fact for fact in inversion.facts if fact.key == "image_residual")
    assert residual.text.startswith(f"{share} of the mean")
    titles = [
        axes.get_title(loc) for axes in report_figure(inversion).axes for loc in ("left", "center")
    ]
    assert f"Residual {share}" in titles


# The picture does not fit


@pytest.mark.parametrize(
    ("pattern", "contrast"),
    [("chequerboard", 1000), ("stripes", 2), ("wide chequerboard", 2)],
)
def test_a_pattern_as_fine_as_the_pixels_does_not_fit(pattern, contrast):
    y, x = np.indices((80, 80))
    odd = {
        "chequerboard": (y + x) % 2,
        "stripes": x % 2,
        "wide chequerboard": (y // 2 + x // 2) % 2,
    }[pattern]
    inversion = invert(np.where(odd == 1, float(contrast), 1.0))
    assert inversion.report.converged
    assert inversion.report.image_residual > 0.08
    assert inversion.report.cautions[0].code == MISFIT
    assert NOTHING not in codes_of(inversion)


def test_too_few_sites_do_not_fit_and_the_advice_is_more():
    image = traced(gaussian(0.6))
    report = invert(image, options=InversionOptions(n_sites=100)).report
    assert report.cautions[0].code == MISFIT
    assert "use more sites" in report.cautions[0].text
    assert signs(image, n_sites=5000) == []


@pytest.mark.parametrize("threads", [1, 3])
def test_the_residual_off_bright_lines_is_that_of_whole_planes(threads):
    rng = np.random.default_rng(3)
    image = rng.gamma(0.5, 2.0, (70, 90))  # many pixels are brighter than a line must be
    prepared = prepare(image, np.ones_like(image), InversionOptions(), image > 0.01)
    noise = ImageNoise(prepared)
    mask, mean = prepared.mask, prepared.source[prepared.mask].mean()
    around = ndimage.uniform_filter(prepared.image, 3)
    counted = mask & (around <= 3.0 * np.maximum(prepared.source, mean))
    assert 0.5 < counted.mean() < 0.95
    for scale in (0.01, 0.1, 0.3, 1.0):
        reprojection = prepared.image * (1 + scale * rng.normal(size=image.shape))
        bright = np.maximum(prepared.image, reprojection) / mean
        hidden = noise.variance(bright) + (0.04 * bright) ** 2 + 1e-12
        excess = np.where(counted, ((prepared.image - reprojection) / mean) ** 2 / hidden, 0.0)
        squares = excess[:64, :80].reshape(4, 16, 5, 16).mean(axis=(1, 3))
        share = counted[:64, :80].reshape(4, 16, 5, 16).mean(axis=(1, 3))
        ratio = np.quantile((squares / share)[share > 0.5], 0.98)
        coarse = solution_checks.is_coarse(prepared, reprojection, noise, threads)
        assert coarse == (ratio > 1.5**2)
        sums = np.empty((4, 5)), np.empty((4, 5))
        planes = solution_checks._Planes.of(prepared, reprojection)
        terms = noise.variance_terms + np.array([1e-12, 0.0, 0.04**2])
        solution_checks._average_squares(0, 4, planes, 16, terms, *sums)
        np.testing.assert_allclose(sums, (squares, share), rtol=1e-9)


@pytest.mark.parametrize("counts", [4, 25, 250])
def test_counts_are_no_pattern_even_with_empty_pixels(counts):
    image = np.random.default_rng(2).poisson(counts * traced(gaussian(0.5))).astype(float)
    if counts == 4:
        assert (image == 0).any()
    assert signs(image) == []


# No deflection found


@pytest.mark.parametrize(("share", "seed"), [(0.01, 1), (0.1, 2), (0.3, 3)])
def test_pure_noise_has_no_deflection(share, seed):
    assert signs(noisy(np.ones((SIDE, SIDE)), share, seed)) == [NOTHING]


@pytest.mark.parametrize("shape", [(60, 60), (40, 300)])
@pytest.mark.parametrize("boundary", ["closed", "free"])
def test_counts_of_a_uniform_beam_have_no_deflection(shape, boundary):
    image = np.random.default_rng(3).poisson(25, size=shape).astype(float)
    assert signs(image, boundary=boundary) == [NOTHING]


def test_noise_of_the_source_counts_too():
    rng = np.random.default_rng(4)
    y, x = np.indices((SIDE, SIDE))
    beam = 0.3 + np.exp(-((y - 40) ** 2 + (x - 60) ** 2) / 2 / 30**2)
    image, source = rng.poisson(100 * beam), rng.poisson(100 * beam)
    assert invert(image, source=source).report.cautions[0].code == NOTHING


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_field_of_twice_the_noise_is_found(seed):
    share = 0.1
    wave_y, wave_x = np.meshgrid(*[np.pi * np.arange(SIDE) / SIDE] * 2)
    with np.errstate(divide="ignore"):
        power = 1 / (wave_y**2 + wave_x**2)
    by_noise = share * np.sqrt(power[np.isfinite(power)].sum() / SIDE**2)
    weak = phantoms.gaussian_blob((SIDE, SIDE), 1.0, 14.0, (48, 51)).displacement
    weak *= 2 * by_noise / np.sqrt((weak**2).sum(axis=0).mean())
    assert signs(noisy(synthetic_image(weak), share, seed)) == []


# Deep folds


def test_mark_caustics_takes_regions_as_wide_as_the_sites():
    """Sites are 4 px apart: a single pixel below the limit is noise, twelve in a row are not."""
    jacobian, mask = np.ones((40, 40)), np.ones((40, 40), bool)
    jacobian[10, 30] = -0.5
    jacobian[20:32, 6:18] = -0.5
    mask[20:24] = False
    expected = np.zeros((40, 40), bool)
    expected[24:32, 6:18] = True
    np.testing.assert_array_equal(mark_caustics(jacobian, mask, 100, 0.2), expected)


@pytest.mark.parametrize(
    ("strength", "shape"),
    [(1.0, (10, 10)), (1.05, (10, 10)), (-1.1, (10, 10)), (1.1, (16, 8))],
    ids=["ring at the onset", "ring", "spot", "two sides"],
)
def test_caustics_that_have_just_formed_are_right_and_get_no_warning(strength, shape):
    field = gaussian(strength, *shape)
    image = traced(field)
    inversion = invert(image)
    true = on_pixels(field, (SIDE, SIDE))
    assert inversion.caustic.mean() > 0.01
    assert np.linalg.norm(inversion.displacement - true) < 0.05 * np.linalg.norm(true)
    assert inversion.report.cautions == ()


@pytest.mark.parametrize(
    ("strength", "shape", "share"),
    [
        (1.3, (10, 10), 0.0),
        (2.0, (10, 10), 0.0),
        (-1.6, (10, 10), 0.1),
        (1.5, (16, 8), 0.0),
    ],
    ids=["ring 1.3", "ring 2", "spot", "two sides"],
)
def test_deep_folds_are_wrong_and_get_a_warning(strength, shape, share):
    field = gaussian(strength, *shape)
    inversion = invert(noisy(traced(field), share), options=InversionOptions(negative="clip"))
    true = on_pixels(field, (SIDE, SIDE))
    assert np.linalg.norm(inversion.displacement - true) > 0.07 * np.linalg.norm(true)
    assert inversion.report.cautions[0].code == FOLDS


def test_hot_pixels_are_no_folds():
    image = noisy(np.ones((SIDE, SIDE)), 0.05)
    image[np.random.default_rng(5).random(image.shape) < 5e-4] = 20
    assert FOLDS not in signs(image)


# The field goes on beyond a closed edge


def cut_by_an_edge(y: Array, x: Array) -> Array:
    return gaussian(0.5)(y, x + 30)


def mirrored_at_an_edge(y: Array, x: Array) -> Array:
    return gaussian(0.5)(y, x + 51.5)


BEYOND = {
    "centred": (long_range(3, 10), "top bottom left right"),
    "off centre": (long_range(3, 8, 40, 60), "top bottom left right"),
    "sheet": (sheet, "left right"),
    "jet": (jet, "top bottom"),
    "cut": (cut_by_an_edge, "left"),
    "halved": (mirrored_at_an_edge, "left"),
}


@pytest.mark.parametrize(
    ("name", "boundary"),
    [
        *((name, "closed") for name in BEYOND),
        *((name, "free") for name in ("centred", "jet", "cut")),
    ],
)
def test_what_lies_beyond_the_edge_is_in_the_total(name, boundary):
    field, sides = BEYOND[name]
    image = noisy(traced(field, beyond=30), 0.03)
    options = InversionOptions(negative="clip", n_sites=3000, boundary=boundary)
    inversion = invert(image, source=np.ones(image.shape), options=options)
    true = on_pixels(field, (SIDE, SIDE))
    error = float(np.sqrt(((inversion.displacement - true) ** 2).sum(axis=0).mean()))
    assert inversion.verdict in (Verdict.EDGE, Verdict.UNCERTAIN)  # of a jet little
    assert error < 3 * inversion.errors.total.rms
    assert set(sides.split()) <= set(inversion.errors.sides)
    assert ("on all sides" in inversion.headline.text) == (len(inversion.errors.sides) == 4)


@pytest.mark.parametrize(
    ("boundary", "strength", "share"),
    [("closed", 0.6, 0.0), ("free", -0.6, 0.1), ("closed", 0.02, 0.03), ("free", 0.6, 0.0)],
)
def test_an_object_inside_has_no_error_by_the_edge(boundary, strength, share):
    image = noisy(traced(gaussian(strength), beyond=30), share)
    options = InversionOptions(negative="clip", n_sites=3000, boundary=boundary)
    errors = invert(image, source=np.ones(image.shape), options=options).errors
    by_edge = errors.parts.get("edge", ErrorEstimate(0.0, 0.0))
    assert by_edge.rms < 0.01 * errors.rms


# Good images


@pytest.mark.parametrize("name", public_names("prns") + public_names("pradformat"))
def test_other_reference_images_get_no_doubts(name: str):
    assert signs(read(public_file(name)).image) == []


@pytest.mark.parametrize("number", [0, 5])
def test_a_real_plume_gets_no_doubts(burner: list[Path], number: int):
    reference = read(burner[0]).bin_pixels(4).image
    assert (
        invert(read(burner[1 + number]).bin_pixels(4).image, source=reference).report.cautions == ()
    )


@pytest.mark.parametrize(
    "scene", ["four_toroids", "cosine_ellipses", "focusing_pair", "opposite_pair"]
)
def test_phantoms_get_no_doubts(scene: str):
    shape = (SIDE, SIDE)
    field = getattr(phantoms, scene)(shape, ProtonSetup.example()).displacement / 2
    image = synthetic_image(field)
    assert signs(image) == []
    assert signs(np.random.default_rng(6).poisson(100 * image).astype(float)) == []


def cropped(image, source, first):
    """A shot and its reference from a column on."""
    return codes_of(invert(image[:, first:], source=source[:, first:]))


@pytest.mark.parametrize("amplitude", [150.0, -60.0])
def test_an_object_that_a_crop_cuts_is_reported(amplitude):
    side, width = 128, 10.0
    blob = phantoms.gaussian_blob((side, side), amplitude, width, (60.0, 70.0))
    image = np.random.default_rng(3).poisson(1000 * synthetic_image(blob.displacement))
    source = np.full(image.shape, 1000.0)
    assert not cropped(image, source, 20)
    for widths in (2.0, 1.5):
        assert EDGE in cropped(image, source, round(70 - widths * width)), widths


def test_the_weaker_part_of_an_object_that_a_crop_cuts_is_reported():
    shape = (128, 128)
    strong = phantoms.gaussian_blob(shape, 120.0, 10.0, (60.0, 50.0)).displacement
    weak = phantoms.gaussian_blob(shape, 40.0, 10.0, (70.0, 90.0)).displacement
    image = np.random.default_rng(3).poisson(1000 * synthetic_image(strong + weak))
    source = np.full(shape, 1000.0)
    assert EDGE in codes_of(invert(image[:, :100], source=source[:, :100]))
    assert not codes_of(invert(image, source=source))


@pytest.mark.parametrize("seed", [3392, 3813, 3997])
def test_noise_along_the_edge_is_no_cut_object(seed):
    blob = phantoms.gaussian_blob((96, 96), 16.0, 9.0, (48.0, 48.0))
    image = np.random.default_rng(seed).poisson(200 * synthetic_image(blob.displacement))
    source = np.full(image.shape, 200.0)
    assert not codes_of(invert(image, source=source, options=InversionOptions(n_sites=1000)))


@pytest.mark.parametrize("at_peak", [True, False])
def test_a_mask_at_the_peak_is_reported(at_peak):
    blob = phantoms.gaussian_blob((96, 96), 60.0, 9.0)
    image = synthetic_image(blob.displacement)
    length = np.hypot(*blob.displacement)
    row, column = np.unravel_index(length.argmax(), length.shape) if at_peak else (18, 76)
    mask = np.ones(image.shape, bool)
    mask[row - 11 : row + 11, column - 11 : column + 11] = False
    assert ("masked-peak" in codes_of(invert(image, mask=mask))) == at_peak


GAPS = {
    "spot in the middle": lambda y, x: np.hypot(y, x) < 4,
    "spot on the flank": lambda y, x: np.hypot(y, x - 13) < 8,
    "wire": lambda y, x: abs(x - 12) < 4,
    "cross": lambda y, x: (abs(x) < 1.5) | (abs(y + 8) < 1.5),
    "bad pixels": lambda y, x: np.random.default_rng(3).random(y.shape) < 0.01,
}


@pytest.mark.parametrize("amplitude", [30.0, 120.0, -60.0])
@pytest.mark.parametrize("gap", GAPS)
def test_gaps_in_the_mask_are_crossed_within_the_stated_error(gap, amplitude):
    """Light that an object sends across their edges is not missed, and no pixel in them counts."""
    blob = phantoms.gaussian_blob((96, 96), amplitude, 13.0, (48.0, 48.0))
    y, x = np.indices((96, 96)) - 48.0
    masked = GAPS[gap](y, x)
    counts = (
        np.random.default_rng(1).poisson(400 * synthetic_image(blob.displacement)).astype(float)
    )
    source = np.full(counts.shape, 400.0)
    counts[masked], source[masked] = np.nan, 1e6
    inversion = invert(counts, source=source, mask=~masked)
    errors, used = inversion.errors.total, ~masked
    difference = (inversion.displacement - blob.displacement)[:, used]
    made = np.sqrt((difference**2).sum(axis=0).mean())
    assert made < 1.3 * errors.rms
    assert made < 0.12  # 0.05 without a mask; 0.9 where light is missed
    peaks = [np.hypot(*each)[used].max() for each in (inversion.displacement, blob.displacement)]
    assert abs(peaks[0] - peaks[1]) < 3 * errors.at_peak


def test_the_headline_and_errors_leave_masked_pixels_out():
    blob = phantoms.gaussian_blob((96, 96), 60.0, 9.0)
    image = synthetic_image(blob.displacement)
    mask = np.ones(image.shape, bool)
    mask[30:44, 40:56] = False
    inversion = invert(image, mask=mask)
    outside = np.hypot(*inversion.displacement)[mask].max()
    assert inversion.errors.peak == outside
    peak = float(inversion.headline.text.rsplit("|d| ", 1)[1].split(" ±")[0])
    assert peak == pytest.approx(outside, rel=0.05)
