from __future__ import annotations

import numpy as np
import pytest

from napari_shadowinv.errors import InputError
from napari_shadowinv.inversion.normalise import flooring_for, number_of_sites, prepare
from napari_shadowinv.options import MAX_DEFAULT_SITES, InversionOptions


def test_image_source_and_floored_image_have_one_flux():
    rng = np.random.default_rng(0)
    image, source = 1 + 1000 * rng.random((20, 30)), rng.random((20, 30))
    image[:3] = 0
    prepared = prepare(image, source, InversionOptions())
    for values in (prepared.image, prepared.floored_image * prepared.unit):
        assert values.sum() == pytest.approx(source.sum(), rel=1e-12)
    assert prepared.floored_pixels == (image < 1e-3 * image.mean()).sum() == 90
    floor = prepared.floored_image.min() / prepared.floored_image.mean()
    assert floor == pytest.approx(1e-3, rel=1e-3)


@pytest.mark.parametrize("flux", ["conserve", "known"])
@pytest.mark.parametrize("masked", [False, True])
def test_many_images_of_one_source_are_floored_as_each_alone(flux, masked):
    rng = np.random.default_rng(4)
    options = InversionOptions(flux=flux, boundary="free", negative="clip")
    mask = rng.random((20, 30)) > 0.2 if masked else None
    source = rng.random((20, 30))
    floored = flooring_for(source, options, mask)
    for _ in range(3):
        image = 10 * rng.normal(size=(20, 30))
        expected = prepare(image, source, options, mask).floored_image
        np.testing.assert_array_equal(floored(image), expected)
    with pytest.raises(InputError, match="no positive pixel"):
        floored(-image.clip(0))


def test_without_a_source_it_is_uniform_and_keeps_the_images_units():
    image = np.random.default_rng(1).random((10, 10)) * 500
    prepared = prepare(image, None, InversionOptions())
    np.testing.assert_allclose(prepared.source, image.mean())
    np.testing.assert_allclose(prepared.image, image, rtol=1e-14)


def test_clipping_counts_and_keeps_the_input():
    image = np.ones((10, 10))
    image[0, :4] = -5
    original = image.copy()
    prepared = prepare(image, None, InversionOptions(negative="clip"))
    assert prepared.clipped_pixels == 4
    assert prepared.image.min() == 0
    np.testing.assert_array_equal(image, original)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("values", [[np.nan], [np.inf], [np.inf, -np.inf], [1e308, 1e308, np.nan]])
def test_values_that_are_not_finite_are_counted_without_a_warning(values):
    image = np.ones((20, 30))
    image[0, : len(values)] = values
    bad = np.count_nonzero(~np.isfinite(values))
    with pytest.raises(InputError, match=f"image has {bad} pixels that are NaN or infinite"):
        prepare(image, None, InversionOptions())


def test_integer_images_are_taken_as_they_are():
    image = np.arange(100, dtype=np.uint8).reshape(10, 10)
    prepared = prepare(image, None, InversionOptions())
    np.testing.assert_allclose(prepared.image, image.astype(float), rtol=1e-14)


def test_sites_default_to_the_pixels_up_to_a_limit():
    assert number_of_sites((20, 30), InversionOptions()) == 600
    assert number_of_sites((5000, 5000), InversionOptions()) == MAX_DEFAULT_SITES
    assert number_of_sites((20, 30), InversionOptions(n_sites=77)) == 77
    with pytest.raises(InputError, match="use at most"):
        number_of_sites((20, 30), InversionOptions(n_sites=10**13))


@pytest.mark.parametrize(("rows", "said"), [(3, False), (5, True)])
def test_a_mask_over_much_of_the_image_is_reported(rows, said):
    mask = np.ones((20, 30), bool)
    mask[:rows] = False
    cautions = prepare(np.ones((20, 30)), None, InversionOptions(), mask).cautions
    assert [caution.code for caution in cautions] == (["mask"] if said else [])
    assert all("excludes 25 % of the pixels" in caution.text for caution in cautions)


@pytest.mark.parametrize(("factor", "codes"), [(0.9, ["flux"]), (1.0, []), (1.1, ["flux"])])
def test_another_flux_than_the_sources_is_named(factor, codes):
    image = np.random.default_rng(0).uniform(0.9, 1.1, (24, 30))
    prepared = prepare(factor * image / image.mean(), np.ones(image.shape), InversionOptions())
    assert [caution.code for caution in prepared.cautions] == codes
