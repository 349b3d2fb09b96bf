"""All products in one pass: bands, units, kinds of results, and wrong requests."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from helpers.exact_fields import SETUP, field_of
from napari_shadowinv.analysis import (
    EnclosedCurrent,
    Flux,
    LineProfile,
    Region,
    add_products,
    analyse,
    product_from_text,
    products_in,
    products_table,
)
from napari_shadowinv.analysis._field_samples import sampled_fields
from napari_shadowinv.analysis.product import quantity_text
from napari_shadowinv.errors import InputError
from napari_shadowinv.facts import Level
from napari_shadowinv.fitting import Fit, fit
from napari_shadowinv.inversion import Inversion, invert
from napari_shadowinv.inversion.error_bars import Quantity
from napari_shadowinv.inversion.result import RetrievedField
from napari_shadowinv.options import FitOptions
from napari_shadowinv.physics.derivatives import finer_field
from napari_shadowinv.physics.forward import synthetic_image
from napari_shadowinv.physics.phantoms import Phantom
from napari_shadowinv.shot import Shot

LINE = LineProfile(path=[(31.5, 10), (31.5, 53)], width=3)
CIRCLES = [
    EnclosedCurrent(center=center, radius=radius)
    for center, radius in (((31.5, 31.5), 8), ((27, 36), 10), ((38, 30), 6), ((25, 25), 9))
]


def test_bands_hold_the_truth_as_often_as_they_say(
    recorded: Callable[[int], Inversion], ring: Phantom
):
    products = [LINE, *CIRCLES, Flux(path=[(31.5, 31.5), (31.5, 44)])]
    truths = analyse(field_of(ring), products)
    inside = []
    for seed in range(10, 16):
        results = analyse(recorded(seed), products, setup=SETUP, samples=30)
        for result, truth in zip(results, truths, strict=True):
            for name, quantity in truth.quantities.items():
                low, high = result.band(name)
                inside.append(((low <= quantity.value) & (quantity.value <= high)).mean())
    assert 0.55 < np.mean(inside) < 0.82


def test_bands_are_those_of_uncertainty(inversion: Inversion):
    def mean(potential: np.ndarray, displacement: np.ndarray) -> float:
        return float(displacement[1, 20:44, 20:44].mean())

    # The noise is measured in the image, here it is that of counts.
    sampled = inversion.uncertainty(200, noise="poisson", quantities={"mean": mean})
    reference = sampled.errors.samples
    region = Region(rectangle=((19.5, 19.5), (43.5, 43.5)))
    (result,) = analyse(inversion, region, samples=200, unit="px")
    assert result["mean_x"].value == pytest.approx(
        mean(*finer_field(inversion.potential, inversion.displacement))
    )
    assert result["mean_x"].std == pytest.approx(reference.quantities["mean"].std, rel=0.35)


def test_a_saved_inversion_has_the_same_bands(inversion: Inversion):
    dataset = inversion.in_units(SETUP).to_dataset()
    again = Inversion.from_dataset(dataset)
    before, after = (analyse(each, LINE, samples=20, setup=SETUP)[0] for each in (inversion, again))
    np.testing.assert_array_equal(before["magnitude"].samples, after["magnitude"].samples)
    (of_file,) = analyse(dataset, LINE, samples=20)  # with its setup
    np.testing.assert_array_equal(before["magnitude"].samples, of_file["magnitude"].samples)


def test_bands_follow_the_stated_noise(inversion: Inversion):
    def spread(level: float) -> float:
        options = inversion.options.model_copy(update={"noise_level": level})
        (result,) = analyse(replace(inversion, options=options), LINE, samples=40)
        return float(result["normal"].std.mean())

    assert spread(80.0) > 2 * spread(20.0)


def test_discretisation_and_instrument_are_among_the_causes(inversion: Inversion):
    instrument = inversion.instrument.model_copy(update={"background": 0.05, "energy": 0.1})
    (result,) = analyse(
        replace(inversion, instrument=instrument), CIRCLES[0], setup=SETUP, samples=20
    )
    assert result.causes[0] == "noise"
    assert {"background, 5 %", "discretisation", "energy, 10 %"} <= set(result.causes)
    # ∫B dz is proportional to the momentum, which is to the root of the energy.
    assert result["current"].std / abs(result["current"].value) > 0.045


def test_products_together_are_those_alone(inversion: Inversion):
    together = analyse(inversion, [LINE, CIRCLES[0]], setup=SETUP, samples=20)
    (alone,) = analyse(inversion, CIRCLES[0], setup=SETUP, samples=20)
    assert together[1]["current"].value == alone["current"].value
    assert together[1]["current"].std == pytest.approx(alone["current"].std, rel=0.02)


@pytest.fixture(scope="module")
def fitted(ring: Phantom) -> Fit:
    """A fit of the middle of the ring, with two samples that are known."""
    image = 400 * synthetic_image(ring.displacement)[12:52, 12:52]
    noisy = np.random.default_rng(5).poisson(image).astype(float)
    options = FitOptions(samples=0, max_iterations=5, spacing=0.25, threads=1)
    result = fit(Shot(noisy, SETUP, np.full(image.shape, 400.0)), options=options)
    y, x = np.mgrid[:40, :40].astype(float)
    changes = np.stack([0.3 * x, -0.1 * y, np.zeros((40, 40))]).astype(np.float32)
    (field,) = result.fields
    return replace(result, fields=(replace(field, samples=changes),))


def test_a_fit_has_the_bands_of_its_samples(fitted: Fit):
    (flux,) = analyse(fitted, Flux(path=[(10, 10), (10, 30)]))
    # A potential that rises along the line by 0.3 px² a px; not at all, if it rises across.
    rise = -SETUP.path_integrated_b([0.0, 1.0])[0] * 0.3 * 20 * SETUP.object_pixel_size
    # The error by the size of a pixel is in the samples, too.
    change = flux["flux"].samples - flux["flux"].value
    np.testing.assert_allclose(change, [rise, 0, 0], atol=1e-3 * abs(rise))
    assert "3 samples" in str(flux.facts)
    with pytest.raises(InputError, match="'E'"):
        analyse(fitted, LINE, deflector="E")


@pytest.mark.parametrize(
    ("unit", "size"), [("T m", 1), ("T mm", 1e-3), ("MG µm", 1e-4), ("kG cm", 1e-3), ("G cm", 1e-6)]
)
def test_units_of_a_magnetic_field_are_multiples(unit: str, size: float, exact: RetrievedField):
    (result,) = analyse(exact, LineProfile(path=[(40, 10), (40, 90)]), unit=unit)
    factor, symbol = result.scale_of("magnitude")
    assert (symbol, factor) == (unit, pytest.approx(1 / size))
    field = SETUP.path_integrated_b(exact.displacement)
    assert result["magnitude"].value.max() <= np.hypot(*field).max() * (1 + 1e-9)
    assert result.facts[0].text.endswith(unit)


def test_a_unit_chooses_its_field(exact: RetrievedField):
    line = LineProfile(path=[(40, 10), (40, 90)])
    pixels, volts, angles = (analyse(exact, line, unit=unit)[0] for unit in ("px", "V", "rad"))
    ratio = SETUP.path_integrated_e([0.0, 1.0])[1]
    np.testing.assert_allclose(volts["along"].value, ratio * pixels["along"].value)
    ratio = float(SETUP.deflection_angle(1.0))
    np.testing.assert_allclose(angles["along"].value, ratio * pixels["along"].value)


def test_a_field_without_errors_has_no_bands(exact: RetrievedField):
    (result,) = analyse(exact, CIRCLES[0])
    assert result.band("current") is None
    assert not result.has_bands
    fact = next(fact for fact in result.facts if fact.key == "bands")
    assert fact.level is Level.DOUBTFUL


def test_every_result_says_what_the_image_cannot_show(exact: RetrievedField):
    (result,) = analyse(exact, LINE)
    text = " ".join(result.limits)
    for subject in ("along the beam", "rotation", "uniform deflection", "taken as thin"):
        assert subject in text


def test_products_come_back_from_a_dataset(inversion: Inversion):
    results = analyse(inversion, [LINE, CIRCLES[0], CIRCLES[1]], setup=SETUP, samples=20)
    dataset = add_products(inversion.in_units(SETUP).to_dataset(), results)
    assert dataset["current_1_current"].attrs["units"] == "A m"
    assert Inversion.from_dataset(dataset).displacement is not None
    again = products_in(dataset)
    assert [each.name for each in again] == ["profile", "current_1", "current_2"]
    assert [each.product for each in again] == [each.product for each in results]
    assert [each.facts for each in again] == [each.facts for each in results]
    for before, after in zip(results, again, strict=True):
        for name in before.quantities:
            np.testing.assert_array_equal(before[name].value, after[name].value)
            np.testing.assert_array_equal(before.band(name, 0.95), after.band(name, 0.95))
    assert products_table(again) == products_table(results)
    assert products_in(add_products(dataset, again[:1]))[0].name == "profile"
    with pytest.raises(InputError, match=r"files have bands of 0\.68 and 0\.95"):
        again[0].band("along", 0.5)


def test_table_has_the_numbers_in_their_units(inversion: Inversion):
    results = analyse(inversion, [LINE, CIRCLES[0]], setup=SETUP, samples=20, unit="MG um")
    rows = [row.split(",") for row in products_table(results).splitlines()]
    assert rows[0][:6] == ["product", "quantity", "place", "place_unit", "value", "unit"]
    magnitude = [row for row in rows if row[:2] == ["profile", "magnitude"]]
    assert {row[5] for row in magnitude} == {"MG µm"}
    np.testing.assert_allclose(
        [float(row[4]) for row in magnitude], results[0]["magnitude"].value / 1e-4, rtol=1e-6
    )
    assert rows[-1][1] == "current"
    assert rows[-1][5] == "A m"


@pytest.mark.parametrize(
    ("keywords", "message"),
    [
        ({"unit": "furlong"}, r"unit is 'furlong', expected one of T m"),
        ({"unit": "m-2"}, r"unit is 'm⁻²', expected one of T m.*particles"),
        ({"samples": 3}, "expected at least 20"),
        ({"samples": 20.5}, "expected a whole number"),
        ({"deflector": "plasma"}, "expected one of B, E for this beam"),
    ],
)
def test_a_wrong_choice_is_refused(
    keywords: dict[str, object], message: str, exact: RetrievedField
):
    with pytest.raises(InputError, match=message):
        analyse(exact, LINE, **keywords)


def test_texts_and_tables_describe_the_same_products(exact: RetrievedField):
    table = {"product": "profile", "path": [(31.5, 10), (31.5, 53)], "width": 3}
    for result in analyse(exact, ["profile 31.5,10 31.5,53 width=3", table]):
        assert result.product == LINE
    assert product_from_text("current center=31.5,31.5 radius=8") == CIRCLES[0]
    corners = product_from_text("region rectangle=1,2 3,4")
    assert corners == Region(rectangle=((1, 2), (3, 4)))


@pytest.mark.parametrize(
    ("value", "spread", "unit", "written"),
    [
        (-9.94e-5, 4e-6, "1", "-0.994 × 10⁻⁴ (-1.022 to -0.966; 95 %: -1.033 to -0.955)"),
        (9.6e-7, 3.3e-4, "1", "0.0 × 10⁻⁴ (-2.3 to 2.3; 95 %: -3.2 to 3.2)"),
        (9.6e-7, 3.3e-4, "m", "1 µm (-228 to 230; 95 %: -319 to 321)"),
        (0.3, None, "1", "0.3"),
        (9.9999e-7, None, "1", "1 × 10⁻⁶"),
    ],
)
def test_a_number_and_its_band_have_one_power_of_ten(
    exact: RetrievedField, value: float, spread: float | None, unit: str, written: str
):
    (frame,) = (each.frame for each in sampled_fields(exact, None, None, None))
    samples = np.zeros(0) if spread is None else value + spread * np.linspace(-1, 1, 101)
    assert quantity_text(Quantity(np.asarray(value), samples), unit, frame) == written


@pytest.mark.parametrize("products", [7, [7], [["profile"]], None])
def test_what_is_no_product_is_refused(products: object, exact: RetrievedField):
    with pytest.raises(InputError, match=r"product 1 is a \w+, expected a product, a table"):
        analyse(exact, products)


def test_pixels_without_a_setup_have_one_unit(exact: RetrievedField):
    bare = RetrievedField(exact.dataset.drop_attrs())
    (result,) = analyse(bare, LINE)
    assert result.variables["along"].unit == "pixel"
    with pytest.raises(InputError, match="no setup to convert pixels with"):
        analyse(bare, LINE, unit="T m")
    with pytest.raises(InputError, match="needs the setup of the experiment"):
        analyse(bare, CIRCLES[0])


def test_a_potential_is_found_for_a_field_without_one(exact: RetrievedField):
    line = Flux(path=[(50, 50), (50, 90)])
    without = RetrievedField(exact.dataset.drop_vars("potential"))
    expected, actual = (analyse(each, line)[0]["flux"].value for each in (exact, without))
    assert actual == pytest.approx(expected, rel=5e-3)


def test_a_stack_is_refused(exact: RetrievedField):
    import xarray as xr

    stack = xr.concat([exact.dataset, exact.dataset], "shot")
    for wrong in (stack, RetrievedField(stack)):
        with pytest.raises(InputError, match="expected the result of one shot"):
            analyse(wrong, LINE)
    with pytest.raises(InputError, match="got ndarray, expected a result or its dataset"):
        analyse(np.zeros((5, 5)), LINE)
    with pytest.raises(InputError, match="got no product"):
        analyse(exact, [])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("proflie 1,1 2,2", "did you mean 'profile'"),
        ("profile a,b 2,2", "expected points y,x in px"),
        ("flux 1,1 2,2 width=3", "flux has no 'width'"),
        ("contrast 3", "expected name=value"),
        ("", "the product is ''"),
    ],
)
def test_a_wrong_line_of_text_is_refused(text: str, message: str):
    with pytest.raises(InputError, match=message):
        product_from_text(text)


def test_masked_pixels_under_a_line_are_reported(ring: Phantom):
    image = 400 * synthetic_image(ring.displacement)
    mask = np.ones(image.shape, bool)
    mask[28:36, 5:20] = False
    counts = np.random.default_rng(0).poisson(image)
    inversion = invert(counts, mask=mask, options={"n_sites": 900})
    (result,) = analyse(inversion, LINE, samples=20)
    caution = next(fact for fact in result.facts if fact.key == "mask")
    assert "of the line is at masked pixels" in caution.text
