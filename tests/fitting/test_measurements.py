"""What is given to a fit: what is refused and why, and what is made of it."""

from __future__ import annotations

import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy import constants

from napari_shadowinv._typing import FloatArray
from napari_shadowinv.errors import InputError
from napari_shadowinv.fitting.measurements import (
    FitData,
    collect_data,
    strengths_of,
)
from napari_shadowinv.fitting.references import smooth_references
from napari_shadowinv.fitting.shots import point_spread
from napari_shadowinv.options import FitOptions
from napari_shadowinv.physics.setup import OpticalSetup, ProtonSetup
from napari_shadowinv.preprocessing.noise import estimated_noise
from napari_shadowinv.shot import Shot, shots_of

SIZE = (40, 51)


def images(count: int = 2) -> FloatArray:
    return np.random.default_rng(0).normal(5, 0.1, (count, *SIZE))


def given(**changes: Any) -> FitData:
    """Two images with strengths, and what a test changes about them."""
    known: dict[str, Any] = {"images": images(), "strength": [1, 0.6], "noise": 0.1} | changes
    chosen = {name: known.pop(name) for name in ("options", "fields") if name in known}
    fiducials = known.pop("fiducials", None)
    first, *others = shots_of(known.pop("images"), **known)
    shots = [replace(first, fiducials=fiducials), *others]
    return collect_data(shots, **{"options": FitOptions()} | chosen)


def protons(energy: float, **changes: Any) -> ProtonSetup:
    lengths = {"source_object_distance": 0.01, "object_image_distance": 0.2, "pixel_size": 2e-6}
    return ProtonSetup(energy=energy, **lengths | changes)


def with_pixel(value: float) -> FloatArray:
    stack = images()
    stack[1, 3, 4] = value
    return stack


def nearly_all_masked() -> FloatArray:
    mask = np.ones((2, *SIZE), bool)
    mask[1, 1:] = False
    return mask


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"images": ["a.tif", "b.tif"]}, "image 1 is the file a.tif, expected an array"),
        ({"images": [np.ones(40)] * 2}, r"image 1 has shape \(40,\), expected two dimensions"),
        ({"images": np.ones((2, 40, 20))}, r"shape \(40, 20\), expected at least 32 × 32 pixels"),
        ({"images": with_pixel(np.nan)}, "1 pixels that are NaN or infinite.*: mask them"),
        ({"images": np.zeros((2, *SIZE))}, "image 1 has no flux: expected a beam"),
        ({"mask": np.ones((51, 40), bool)}, r"mask has shape \(51, 40\), image \(40, 51\)"),
        (
            {"mask": nearly_all_masked()},
            r"image 2: mask leaves 51 of 2,040 pixels usable.*NeXus.* invert",
        ),
        (
            {"strength": [1, np.nan]},
            "strength is nan: expected a finite number",
        ),
        ({"strength": [0, 1]}, r"strengths of the first image are \[0.0\]: all fields must act"),
        ({"strength": [(1, 1), (0.5, 0.5)]}, "for 1 field: expected one number for"),
        (
            {"strength": [(1, 1), (0.5, 0.5)], "fields": ("B", "E")},
            "2 fields cannot be distinguished by images",
        ),
        ({"strength": None}, "2 images and neither strengths nor setups: give"),
        (
            {"strength": None, "setup": [protons(3), protons(15, pixel_size=3e-6)]},
            "image 2 has pixels of 3 µm at the object, the first of 2 µm: bring all",
        ),
        (
            {"strength": None, "setup": [protons(3)] * 2, "fields": ("B", "C")},
            r"fields are \['B', 'C'\]: expected some of B, E, plasma, phase",
        ),
        ({"source": "unkown"}, "source is the file unkown, expected an array: read it first"),
        ({"source": np.ones((40, 50))}, r"source has shape \(40, 50\), image \(40, 51\)"),
        ({"source": -np.ones(SIZE)}, "source has 2040 negative pixels"),
        ({"noise": "gauss"}, "noise is 'gauss': expected 'poisson' or 'proportional', standard"),
        ({"noise": 0}, "noise of image 1 is not positive: expected"),
        ({"noise": [0.1, 1e300]}, r"image 2: the noise is \S+e\+\d+ times the beam or more"),
        ({"noise": "poisson", "images": with_pixel(-1)}, "negative pixels, so they are no counts"),
        ({"psf": -1.0}, "psf of image 1 is -1.0: expected a standard deviation in px or a kernel"),
        ({"psf": 9.0}, r"psf of image \d is 9 px: expected less than an eighth of a side"),
        (
            {"psf": np.ones((3, 4))},
            r"psf of image 1 has shape \(3, 4\): expected a kernel with odd sides",
        ),
        ({"psf": [1.0, "wide"]}, r"psf of image \d is 'wide': expected numbers"),
        ({"strength": "strong"}, "strength is 'strong': expected numbers"),
        ({"strength": [[1, 2], [3]]}, r"strengths are \(1.0, 2.0\), \(3.0,\) for 1 field"),
        ({"noise": [0.1, [1, [2]]]}, "noise of image 2 is .*: expected numbers"),
        ({"fiducials": [[1, 2, 3], [4]]}, "fiducials is .*: expected numbers"),
        ({"mask": np.ones(SIZE)}, "image 1: mask has values of type float64, expected booleans"),
        ({"brightness": [1, "free"]}, "brightness is 1, 'free': expected a number for each image"),
        (
            {"brightness": "some"},
            "brightness is 'some': expected a positive number, or 'free' to fit it",
        ),
        (
            {"brightness": [1, -2]},
            "brightness is -2: expected a positive number",
        ),
        ({"fiducials": np.ones((2, 4))}, r"fiducials have shape \(2, 4\): expected rows of y, x"),
        ({"fiducials": [[45, 5, 0, 0, 1]]}, "fiducials lie outside the image or have no positive"),
        ({"fiducials": [[5, 5, 0, -1e300, 1]]}, "displaced by more than the image's 51 px"),
        ({"fiducials": [[5, 5, 0, 0, 1e-300]]}, "σ below 1e-06 px"),
        ({"images": images(1), "strength": [1], "source": "unknown"}, "one image and an unknown"),
    ],
)
def test_what_does_not_fit_is_refused_in_a_sentence(changes: Any, sentence: str) -> None:
    with pytest.raises(InputError, match=sentence) as refused:
        given(**changes)
    assert "\n" not in str(refused.value)


def test_noise_may_hide_single_pixels() -> None:
    noise = np.full(SIZE, 0.1)
    noise[5, 6] = 1e100
    weights = given(noise=noise).scene.weights
    assert weights[0, 5, 6] < 1e-99
    assert weights[0, 5, 7] > 0


def test_one_image_and_an_unknown_source_are_taken_if_asked_for() -> None:
    alone = given(
        images=images(1)[0],
        strength=None,
        source="unknown",
        options=FitOptions(ambiguous=True),
    )
    assert alone.single
    assert alone.unknown
    assert alone.scene.imperfect.keys == {"beam"}
    assert alone.scene.free_brightness


def test_a_source_in_other_units_is_refused_unless_gains_are_free() -> None:
    """Or given: a tenth as bright, and what is found later comes on top of ten."""
    source = np.full(SIZE, images()[0].mean() / 10)
    with pytest.raises(InputError, match="image 1 is 10 times as bright as its source"):
        given(source=source)
    free = given(source=source, brightness="free")
    expected = images().mean(axis=(1, 2)) / source.mean()
    np.testing.assert_allclose(free.brightness, expected)
    np.testing.assert_allclose(free.units, images().mean(axis=(1, 2)))
    np.testing.assert_allclose(given(source=source, brightness=expected).brightness, expected)


@pytest.mark.parametrize(("second", "single"), [(1.0, True), (0.95, True), (0.8, False)])
def test_images_at_nearly_one_energy_are_one_image(second: float, single: bool) -> None:
    assert given(strength=[1, second]).single is single


def test_images_are_in_units_of_their_beams() -> None:
    source = np.add.outer(np.linspace(3, 4, SIZE[0]), np.linspace(0, 1, SIZE[1]))
    data = given(source=source, brightness=[1, 2], noise=[0.1, 0.12])
    pad = data.scene.pad
    np.testing.assert_allclose(data.units, [source.mean(), 2 * source.mean()])
    for k, stack in enumerate(images()):
        np.testing.assert_allclose(data.scene.images[k, :40, :51] * data.units[k], stack)
        beam = data.scene.beams[k, pad : pad + 40, pad : pad + 51]
        np.testing.assert_allclose(beam * data.units[k], (1 + k) * source)
        noise = data.units[k] / np.sqrt(data.scene.weights[k, :40, :51])
        np.testing.assert_allclose(noise, (0.1, 0.12)[k])


def test_pixels_that_fill_up_blocks_and_masked_ones_do_not_count() -> None:
    mask = np.ones(SIZE, bool)
    mask[5, 6:9] = False
    stack = images()
    stack[:, ~mask] = np.nan
    data = given(images=stack, mask=mask)
    assert data.size == SIZE
    assert data.scene.images.shape == (2, 40, 56)
    np.testing.assert_array_equal(data.scene.weights[0, :40, :51] > 0, mask)
    assert not data.scene.weights[:, :, 51:].any()
    assert np.isfinite(data.scene.images).all()


@pytest.mark.parametrize(
    ("side", "filled"), [(200, 200), (204, 208), (464, 472), (576, 592), (1000, 1000)]
)
def test_sides_are_filled_to_lengths_with_fast_transforms(side: int, filled: int) -> None:
    """251 and 307 coefficients would be primes: 4 and 8 more are not."""
    data = given(images=np.ones((2, 40, side)))
    assert data.size == (40, side)
    assert data.scene.images.shape == (2, 40, filled)
    assert data.scene.rays.shape[1] == filled // 2 + 16 + 3
    assert not data.scene.weights[:, :, side:].any()


def test_strengths_are_relative_to_the_first_image() -> None:
    data = given(strength=[[2, 4], [1, 3]], fields=("B", "E"))
    np.testing.assert_allclose(data.scene.strengths, [[1, 1], [0.5, 0.75]])


def test_noise_that_is_a_share_of_each_pixel() -> None:
    y, x = np.indices(SIZE)
    beam = np.exp(y / 12)  # 27 times as bright below
    hole = (y > 12) & (y < 20) & (x > 20) & (x < 30)
    chance = np.random.default_rng(4).normal(size=(2, *SIZE))
    shots = beam * (1 + np.array([0.03, 0.06])[:, None, None] * chance)
    shots[:, hole] = 0
    data = given(images=shots, noise="proportional", source=beam, mask=~hole)
    assert not data.counted
    used = data.scene.weights[:, :40, :51] > 0
    noise = data.units[:, None, None] / np.sqrt(np.where(used, data.scene.weights[:, :40, :51], 1))
    for k, share in enumerate((0.03, 0.06)):
        measured_share = (noise[k] / beam)[used[k] & (noise[k] > 0.006 * data.units[k])]
        assert np.median(measured_share) == pytest.approx(share, rel=0.05)
        assert np.abs(measured_share / share - 1).max() < 0.25


def test_noise_beyond_what_the_model_can_explain_is_not_believed() -> None:
    data = given(noise=1e-9)
    np.testing.assert_allclose(data.scene.weights[:, :, :51], 1 / 0.005**2)


def test_fiducials_count_from_the_corner() -> None:
    data = given(fiducials=[[3, 4, 0.5, -1, 0.2]])
    fiducials = data.scene.fiducials
    assert fiducials is not None
    np.testing.assert_array_equal(fiducials.places, [[3.5, 4.5]])
    np.testing.assert_array_equal(fiducials.displacements, [[0.5, -1]])
    np.testing.assert_array_equal(fiducials.errors, [0.2])


def test_kernels_have_the_sum_one_and_each_image_may_have_its_own() -> None:
    data = given(psf=[1.5, np.full((3, 5), 2.0)])
    assert data.scene.psf[0] == 1.5
    np.testing.assert_allclose(data.scene.psf[1], np.full((3, 5), 1 / 15))
    assert given(psf=0.7).scene.psf == [0.7, 0.7]
    for psf, shapes in (
        (np.ones((3, 5)), [(3, 5)] * 2),
        ([np.ones((3, 3)), np.ones((5, 5))], [(3, 3), (5, 5)]),
    ):
        assert [np.shape(kernel) for kernel in given(psf=psf).scene.psf] == shapes


@pytest.mark.parametrize(("align", "free"), [("none", 0), ("shift", 2), ("affine", 6)])
def test_alignment_frees_the_numbers_of_a_frame(align: Any, free: int) -> None:
    scene = given(options=FitOptions(align=align, align_spread=0.3)).scene
    assert scene.free_frames.sum() == free
    assert scene.prior.frame_weights[0] == pytest.approx(1 / 0.3**2)


def test_a_free_edge_has_a_wider_strip_and_fades() -> None:
    stack = np.ones((1, 240, 280))
    free = given(images=stack, strength=[1], options=FitOptions(boundary="free"))
    assert free.scene.pad == 24  # a tenth of the shorter side in blocks
    assert free.scene.decay == 24
    fading = given(images=stack, strength=[1])
    assert fading.scene.pad == 16
    assert fading.scene.decay == np.inf
    open_edge = given(options=FitOptions(boundary="free", margin=40, decay_length=9.0))
    assert (open_edge.scene.pad, open_edge.scene.decay) == (40, 9)


def momentum_and_velocity(energy: float) -> tuple[float, float]:
    """Of a proton with a kinetic energy in MeV: p c in MeV, and β."""
    rest_energy = constants.m_p * constants.c**2 / constants.e / 1e6
    momentum = np.sqrt((energy + rest_energy) ** 2 - rest_energy**2)
    return momentum, momentum / (energy + rest_energy)


def test_strengths_follow_from_momenta_and_velocities() -> None:
    """A magnetic field deflects by 1 / p, an electric one by 1 / pβ."""
    energies = (3.0, 14.7, 60.0)
    strengths = strengths_of([protons(energy) for energy in energies], ("B", "E"))
    p, beta = np.transpose([momentum_and_velocity(energy) for energy in energies])
    np.testing.assert_allclose(strengths[:, 0], p[0] / p, rtol=1e-9)
    np.testing.assert_allclose(strengths[:, 1], (p * beta)[0] / (p * beta), rtol=1e-9)


def test_strengths_grow_with_the_distance_over_which_rays_drift() -> None:
    """Displacement at the object: angle × drift / magnification."""
    near = protons(10, pixel_size=None, detector_pixel_size=42e-6)
    far = protons(10, object_image_distance=0.4, pixel_size=None, detector_pixel_size=2e-6 * 41)
    assert near.object_pixel_size == pytest.approx(far.object_pixel_size)
    expected = (0.4 / 41) / (0.2 / 21)
    np.testing.assert_allclose(strengths_of([near, far], ("B",))[:, 0], [1, expected])


def test_plasma_deflects_light_with_the_square_of_the_wavelength() -> None:
    lengths = {"object_image_distance": 0.1, "pixel_size": 1e-6}
    setups = [OpticalSetup(wavelength=length, **lengths) for length in (800e-9, 400e-9)]
    np.testing.assert_allclose(strengths_of(setups, ("plasma",))[:, 0], [1, 0.25])


def test_fields_that_do_not_bend_the_beam_are_refused() -> None:
    with pytest.raises(InputError, match="plasma"):
        strengths_of([protons(3), protons(15)], ("plasma",))


def test_a_source_blurs_by_its_size_behind_the_object_and_the_detector_by_its_own() -> None:
    """A source of size s is s L / l large at the detector; all is divided by M = 1 + L / l."""
    setup = protons(10)  # l = 1 cm, L = 20 cm, M = 21, 2 µm at the object
    assert point_spread(setup, source_size=10e-6) == pytest.approx(10 * 20 / 21 / 2)
    assert point_spread(setup, resolution=84e-6) == pytest.approx(84 / 21 / 2)
    both = point_spread(setup, 10e-6, 84e-6)
    assert both == pytest.approx(np.hypot(10 * 20 / 21 / 2, 84 / 21 / 2))
    assert point_spread(setup) == 0


@pytest.mark.parametrize("length", [-1e-6, np.nan, np.inf])
def test_lengths_that_are_none_are_refused(length: float) -> None:
    with pytest.raises(InputError, match=r"source_size is .*: expected a length in m"):
        point_spread(protons(10), source_size=length)
    with pytest.raises(InputError, match=r"resolution is .*: expected a length in m"):
        point_spread(protons(10), resolution=length)


def test_noise_is_estimated_beside_structure_and_dead_pixels() -> None:
    y, x = np.indices((100, 120))
    structure = 3 + np.exp(-((y - 50) ** 2 + (x - 60) ** 2) / 2 / 8**2) + 0.02 * x
    image = structure + np.random.default_rng(3).normal(0, 0.07, structure.shape)
    used = np.ones(image.shape, bool)
    assert estimated_noise(image, used) == pytest.approx(0.07, rel=0.05)
    image[::7, ::5] = np.nan
    used[::7, ::5] = False
    assert estimated_noise(image, used) == pytest.approx(0.07, rel=0.05)
    assert estimated_noise(image, np.zeros(image.shape, bool)) == 0


@pytest.mark.parametrize(("mesh", "remaining"), [(0.0, 0.2), (0.1, 0.9), (0.6, 1.0)])
def test_references_lose_noise_and_keep_structure(mesh: float, remaining: float) -> None:
    rng = np.random.default_rng(6)
    y, x = np.indices((96, 96))
    beam = 100 * (1 + 0.1 * np.cos(y / 20) + mesh * np.sin(x) * np.sin(0.9 * y))
    recorded, shot = beam + rng.normal(0, 3, (2, 96, 96))
    shot[30:60, 40:70] *= 1.4  # an object
    planes = recorded[None], shot[None], np.full((1, 96, 96), 4.2), np.ones((1, 96, 96), bool)
    blurred, _ = smooth_references(*planes)
    before, after = (np.std((each - beam)[3:-3, 3:-3]) for each in (recorded, blurred[0]))
    assert after <= remaining * before


def test_shots_have_setup_source_mask_and_name() -> None:
    setups = protons(14.7), protons(6)
    beam, mask = np.full(SIZE, 5.0), np.eye(*SIZE) == 0
    shots = [
        Shot(image, setup, source=beam, mask=mask)
        for image, setup in zip(images(), setups, strict=True)
    ]
    shots = [replace(shot, name=name) for shot, name in zip(shots, ("fast", "slow"), strict=True)]
    data = collect_data(shots, options=FitOptions())
    assert data.names == ("fast", "slow")
    assert data.setups == setups
    np.testing.assert_array_equal(data.scene.weights[1, : SIZE[0], : SIZE[1]] > 0, mask)
    same = [Shot(shots[0].image, strength=1 / k, name=f"shot {k}") for k in (1, 2)]
    with pytest.raises(InputError, match="shot 1 and shot 2 are the same"):
        collect_data(same, options=FitOptions())


@pytest.mark.parametrize(
    ("first", "second", "message"),
    [
        ({"source": "unknown"}, {"source": np.ones(SIZE)}, "image 2 has no unknown source, other"),
        ({"noise": 0.1}, {"noise": "poisson"}, "noise is 'poisson' in some images and a number in"),
        (
            {"brightness": 2},
            {},
            "image 2 has no brightness, other images have: expected it for all",
        ),
        ({}, {"fiducials": [[5, 5, 0, 0, 1]]}, "received fiducials of a later image"),
        ({}, {"start": np.zeros(SIZE)}, "received start of a later image"),
        (
            {"strength": (1,)},
            {"strength": (1, 0.5)},
            "expected one number for each field in all",
        ),
    ],
)
def test_images_that_are_known_differently_are_refused(
    first: dict[str, Any], second: dict[str, Any], message: str
) -> None:
    usual = {} if "strength" in first else {"strength": 1}
    shots = [
        Shot(image, **usual | known) for image, known in zip(images(), (first, second), strict=True)
    ]
    with pytest.raises(InputError, match=re.escape(message)):
        collect_data(shots, options=FitOptions())
