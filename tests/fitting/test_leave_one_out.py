"""Images left out and predicted by the others: who is named, and that order changes nothing.

The images are made by counting rays, not by the forward model that is fitted.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
import pytest

from helpers.fit_images import bump, counted, noisy, together
from napari_shadowinv import FitOptions, InputError, ProtonSetup
from napari_shadowinv._typing import FloatArray
from napari_shadowinv.fitting import LeaveOneOut, leave_one_out
from napari_shadowinv.fitting.left_out import explanation_of
from napari_shadowinv.shot import shots_of

SHAPE = (56, 56)
NOISE = 0.04
LENGTHS = {"source_object_distance": 0.01, "object_image_distance": 0.3, "pixel_size": 1e-5}
SETUPS = [ProtonSetup(energy=energy, **LENGTHS) for energy in (8, 10, 12.2, 14.5, 16.7)]


@lru_cache
def without_noise(slope: float, by: float, **changes: Any) -> FloatArray:
    return counted(bump(slope, 7.0, (27, 27 + by)), SHAPE, rays=28, margin=8, **changes)


def images_of(
    factors: list[float],
    moved: list[float] | None = None,
    energies: list[ProtonSetup] = SETUPS,
    **changes: Any,
) -> FloatArray:
    """Images of an object that has a strength, and lies moved along x by so many px, in each."""
    made = []
    for setup, factor, by in zip(energies, factors, moved or [0.0] * 5, strict=False):
        size = factor * energies[0].momentum / setup.momentum
        made.append(without_noise(size * 0.8, by, **changes))
    return noisy(made, NOISE)


def levels(count: int) -> FloatArray:
    """χ² of the noise itself, as it fell out in each image."""
    return np.asarray((noisy([np.zeros(SHAPE)] * count, 1.0) ** 2).mean(axis=(1, 2)))


def checked(images: FloatArray, **keywords: Any) -> LeaveOneOut:
    options = keywords.pop("options", FitOptions(spacing=0.2))
    attributes = {"setup": SETUPS, "noise": NOISE} | keywords
    return leave_one_out(shots_of(images, **attributes), options=options)


def assert_follows_noise_a_little(found: LeaveOneOut) -> None:
    """A field of an image's own has hundreds of numbers, for the 3136 pixels of this image."""
    shares = found.alone / levels(len(found.alone))
    assert shares.max() < 1
    assert shares.min() > 0.9


@pytest.fixture(scope="module")
def static() -> LeaveOneOut:
    return checked(images_of([1] * 5))


def test_each_image_of_a_static_object_is_predicted_to_the_noise(static: LeaveOneOut) -> None:
    assert static.explained.all()
    np.testing.assert_allclose(static.chi2, levels(5), atol=0.06)
    assert_follows_noise_a_little(static)
    np.testing.assert_allclose(static.brightness, 1, atol=0.01)
    # The noise is that of the images, and the mean is 1.
    np.testing.assert_allclose(static.rms, NOISE * np.sqrt(static.chi2), rtol=0.01)
    np.testing.assert_array_equal(static.residual, static.images - static.predicted)
    assert static.explanation.startswith("one static field explains all 5 images")


def test_a_prediction_is_nearer_to_the_object_than_the_noise(static: LeaveOneOut) -> None:
    clean = static.images - noisy([np.zeros(SHAPE)] * 5, NOISE)
    wrong = np.sqrt(((static.predicted - clean) ** 2).mean(axis=(1, 2)))
    assert wrong.max() < 0.3 * NOISE


@pytest.mark.parametrize(
    ("factors", "moved"),
    [([1, 1, 1, 1.25, 1.25], [0.0] * 5), ([1] * 5, [0.0, 0.0, 0.0, 3.0, 3.0])],
    ids=["stronger", "moved"],
)
def test_the_images_of_a_changed_object_are_named_and_no_others(
    factors: list[float], moved: list[float]
) -> None:
    found = checked(images_of(factors, moved), options=FitOptions(spacing=0.25))
    np.testing.assert_array_equal(found.explained, [True, True, True, False, False])
    np.testing.assert_allclose(found.chi2[:3], levels(5)[:3], atol=0.06)
    assert found.chi2[3:].min() > 1.5
    assert_follows_noise_a_little(found)
    assert found.explanation.startswith(
        "the images at 14.5 and 16.7 MeV are not explained by one static field with the others (χ² "
    )


def test_neither_gains_nor_noise_given_too_small_are_taken_for_a_change() -> None:
    brightness = np.array([1.0, 1.4, 0.8])
    images = images_of([1] * 3) * brightness[:, None, None]
    known = {"source": np.ones(SHAPE), "noise": 0.85 * NOISE * brightness, "brightness": "free"}
    found = checked(images, setup=SETUPS[:3], **known)
    assert found.chi2.min() > 1.3
    assert found.explained.all()
    np.testing.assert_allclose(found.brightness, brightness, rtol=0.01)


def test_an_unknown_beam_is_that_of_the_others() -> None:
    def beam(y: FloatArray, x: FloatArray) -> FloatArray:
        return 1 + 0.25 * np.cos(np.pi * (x - 10) / 90) * np.sin(np.pi * y / 110)

    setups = [ProtonSetup(energy=energy, **LENGTHS) for energy in (5, 10, 20, 40)]
    images = images_of([1, 1, 1, 1.6], energies=setups, beam=beam)
    options = FitOptions(spacing=0.25)
    found = checked(images, setup=setups, source="unknown", options=options)
    np.testing.assert_array_equal(found.explained, [True, True, True, False])


def test_an_image_that_lies_elsewhere_on_its_detector_is_found_there() -> None:
    images = images_of([1] * 3)
    images[0] = np.roll(images[0], (1, -2), axis=(0, 1))
    images[2] = np.roll(images[2], 2, axis=1)
    aligned = checked(images, setup=SETUPS[:3], options=FitOptions(align="shift", spacing=0.2))
    assert aligned.explained.all()
    np.testing.assert_allclose(aligned.chi2, levels(3), atol=0.06)


def test_deep_folds_of_a_static_object_are_no_change() -> None:
    # χ² of the third image is above the noise by more than the others' variance explains.
    blobs = together(
        bump(2.962, 3.725, (23.957, 18.186), 1.562), bump(2.282, 3.919, (24.342, 18.656), 1.468)
    )
    strengths = [1.0, 0.842, 0.604]
    images = [
        counted(lambda y, x, s=strength: s * blobs(y, x), (42, 48), rays=24, margin=10)
        for strength in strengths
    ]
    beam = np.ones((42, 48))
    left_out = leave_one_out(
        shots_of(noisy(images, 0.03, 21), strength=strengths, source=beam, noise=0.03)
    )
    assert left_out.explained.all()
    assert left_out.chi2[2] > 1.4


def test_the_limit_allows_five_times_the_prediction_variance() -> None:
    strengths, blob, sigma = [1.0, 0.8, 0.65], bump(1.6, 5, (21, 25)), 0.05
    clean = np.stack(
        [
            counted(lambda y, x, s=strength: s * blob(y, x), (44, 48), rays=28, margin=8)
            for strength in strengths
        ]
    )
    images = noisy(clean, sigma)
    shots = shots_of(images, strength=strengths, source=np.ones((44, 48)), noise=sigma)
    left_out = leave_one_out(shots, options=FitOptions(spacing=0.2))
    noise, variance = (
        (((planes - clean) / sigma) ** 2).mean(axis=(1, 2))
        for planes in (images, left_out.predicted)
    )
    # Of the image displaced most, which the others leave open by a tenth of the noise.
    assert 0.08 < variance[0] < 0.2
    assert 3.7 < (left_out.limit[0] - 1.15 * noise[0]) / variance[0] < 5.6
    assert left_out.explained.all()


def test_two_images_are_too_few() -> None:
    with pytest.raises(InputError, match="received 2 images: leaving one out needs 3 or more"):
        checked(np.ones((2, *SHAPE)), setup=SETUPS[:2])


def test_images_without_energies_are_told() -> None:
    with pytest.raises(InputError, match="received 5 images and neither strengths nor setups"):
        checked(noisy([np.ones(SHAPE)] * 5, NOISE), setup=None)


def test_the_noise_is_that_of_chi2(static: LeaveOneOut) -> None:
    squares = np.nanmean(static.normalised_residual**2, axis=(1, 2))
    np.testing.assert_allclose(squares, static.chi2)
    part = static.only([2, 0])
    np.testing.assert_array_equal(part.normalised_residual, static.normalised_residual[[2, 0]])


def test_it_survives_its_dataset(static: LeaveOneOut) -> None:
    again = LeaveOneOut.from_dataset(static.to_dataset())
    names = (
        "predicted",
        "residual",
        "chi2",
        "alone",
        "limit",
        "rms",
        "brightness",
        "mask",
        "noise",
    )
    for name in names:
        np.testing.assert_array_equal(getattr(again, name), getattr(static, name))
    assert again.explanation == static.explanation
    flux_density = {"images", "left_out_prediction", "left_out_residual", "left_out_noise"}
    stored = static.to_dataset()
    assert {stored[name].attrs["units"] for name in flux_density} == {"1/pixel**2"}
    with pytest.raises(InputError, match="left_out_chi2"):
        LeaveOneOut.from_dataset(static.to_dataset().drop_vars("left_out_chi2"))


def test_the_sentence_names_images_by_energy_by_name_or_by_number() -> None:
    chi2, limit = np.array([1.0, 3.14, 1.0, 2.2, 1.0]), np.full(5, 1.2)
    assert "the images at 10 and 14.5 MeV are not" in explanation_of(chi2, limit, SETUPS, None)
    assert "(χ² 3.1, 2.2): the object may have" in explanation_of(chi2, limit, SETUPS, None)
    assert "the images b and d are not" in explanation_of(chi2, limit, None, list("abcde"))
    assert "the image 2 is not" in explanation_of(chi2[:3], limit[:3], None, None)
    most = explanation_of(np.array([1, 1, 200.0, 9, 9]), limit, None, None)
    assert most.startswith("no static field explains more than 2 of 5 images: the images 3, 4 and")
    assert "(χ² 200, 9.0, 9.0)" in most
