"""Errors by an instrument that is not exact, against images that are changed here."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, shift

from napari_shadowinv import InputError, Instrument, InversionOptions, OpticalSetup, invert
from napari_shadowinv.inversion import plan_sites
from napari_shadowinv.physics import phantoms
from napari_shadowinv.physics.forward import synthetic_image
from napari_shadowinv.physics.setup import ProtonSetup

SIDE = 96
OPTIONS = InversionOptions(n_sites=2500)


def lens(strength: float):
    """Return an image of a blob that spreads or focuses the beam, without noise."""
    blob = phantoms.gaussian_blob((SIDE, SIDE), strength * SIDE**2, 0.1 * SIDE)
    return synthetic_image(blob.displacement)


def rms(displacement):
    return float(np.sqrt((displacement**2).sum(axis=0).mean()))


def with_background(image, size):
    return image + size * image.mean()


def with_gamma(image, size):
    return image ** (1 + size)


def with_blur(image, size):
    return gaussian_filter(image, size, mode="nearest")


CHANGES = {"background": with_background, "gamma": with_gamma, "blur": with_blur}


@pytest.mark.parametrize("strength", [0.006, -0.003])
@pytest.mark.parametrize(
    ("key", "size"), [("background", 0.05), ("gamma", 0.05), ("gamma", -0.1), ("blur", 1.5)]
)
def test_the_effect_of_a_detector_is_the_change_of_the_field(strength, key, size):
    image = lens(strength)
    source = np.ones(image.shape)
    instrument = Instrument(**{key: abs(size)})
    stated = invert(image, source=source, options=OPTIONS, instrument=instrument)
    changed = invert(CHANGES[key](image, size), source=source, options=OPTIONS)
    change = rms(changed.displacement - stated.displacement)
    (effect,) = (error for name, error in stated.errors.effects.items() if name.startswith(key))
    # Blur acts by the square of its width, which scatters.
    expected = np.sqrt(3) * change if key == "blur" else change
    assert effect.rms == pytest.approx(expected, rel=0.1)


def uneven_source():
    """Return a beam with structure of 8 px."""
    white = np.random.default_rng(5).normal(size=(SIDE, SIDE))
    smooth = gaussian_filter(white, 8, mode="wrap")
    return 1 + 0.1 * smooth / smooth.std()


@pytest.mark.parametrize(("key", "size"), [("background", 0.05), ("gamma", 0.05)])
def test_a_detector_changes_image_and_recorded_source_alike(key, size):
    """A beam that is bright in the middle, with a contrast far above the object's."""
    y, x = (np.indices((SIDE, SIDE)) - SIDE / 2) / SIDE
    source = np.exp(-4 * (y**2 + x**2))
    blob = phantoms.gaussian_blob((SIDE, SIDE), 0.006 * SIDE**2, 0.1 * SIDE)
    image = synthetic_image(blob.displacement, source)
    stated = invert(image, source=source, options=OPTIONS, instrument={key: size})
    change = CHANGES[key]
    changed = invert(change(image, size), source=change(source, size), options=OPTIONS)
    (effect,) = (error for name, error in stated.errors.effects.items() if name.startswith(key))
    moved = rms(changed.displacement - stated.displacement)
    assert effect.rms == pytest.approx(moved, rel=0.2)
    assert moved < 0.2 * stated.errors.rms


def test_the_effect_of_a_reference_out_of_register_is_that_of_shifts_and_turns():
    """In the mean over shifts along both axes, a turn and a change of scale."""
    source = uneven_source()
    blob = phantoms.gaussian_blob((SIDE, SIDE), 0.006 * SIDE**2, 0.1 * SIDE)
    image = synthetic_image(blob.displacement, source)
    exact = invert(image, source=source, options=OPTIONS, instrument={"registration": 0.4})
    corner = np.hypot(SIDE, SIDE) / 2
    y, x = np.indices((SIDE, SIDE)) - (SIDE - 1) / 2
    gradient = np.gradient(source)
    moves = {
        "y": shift(source, (0.4, 0), order=3, mode="nearest"),
        "x": shift(source, (0, 0.4), order=3, mode="nearest"),
        "turn": source + 0.4 / corner * (gradient[0] * x - gradient[1] * y),
        "scale": source + 0.4 / corner * (gradient[0] * y + gradient[1] * x),
    }
    in_place = Instrument(registration=0)
    changes = [
        rms(
            invert(image, source=moved, options=OPTIONS, instrument=in_place).displacement
            - exact.displacement
        )
        for moved in moves.values()
    ]
    (name,) = exact.errors.sizes  # as it was measured
    effect = exact.errors.effects[name].times(0.4 / exact.errors.sizes[name])
    assert effect.rms == pytest.approx(np.sqrt(np.sum(np.square(changes))), rel=0.15)


def test_an_estimated_source_is_in_register():
    image = lens(0.006)
    plan = plan_sites(uneven_source(), OPTIONS, measured=False)
    estimated = invert(image, plan=plan, options=OPTIONS, instrument={"registration": 1})
    assert not any("registration" in name for name in estimated.errors.parts)


def test_the_effect_of_an_absorbing_object_is_that_of_smooth_transmissions():
    """Transmissions drawn here: white noise, smoothed over the object, within its rim."""
    image = lens(0.006)
    source = np.ones(image.shape)
    stated = invert(image, source=source, options=OPTIONS, instrument={"absorption": 0.02})
    length = np.hypot(*stated.displacement)
    inside = (length > 0.1 * length.max()).astype(float)
    radius = np.sqrt(inside.sum() / np.pi)
    envelope = gaussian_filter(inside, radius / 4)
    changes = []
    for seed in range(12):
        white = np.random.default_rng(seed).normal(size=[3 * SIDE] * 2)
        smooth = gaussian_filter(white, radius / np.sqrt(2), mode="wrap")
        transmission = 1 + 0.02 * envelope * smooth[:SIDE, :SIDE] / smooth.std()
        # What the object absorbs is lacking in the image where its rays land.
        moved = synthetic_image(stated.displacement, transmission)
        still = synthetic_image(stated.displacement, source)
        changed = invert(image * moved / still, source=source, options=OPTIONS)
        changes.append(rms(changed.displacement - stated.displacement))
    (effect,) = (e for name, e in stated.errors.effects.items() if name.startswith("absorption"))
    assert effect.rms == pytest.approx(np.sqrt(np.mean(np.square(changes))), rel=0.35)


def test_a_stated_instrument_changes_the_errors_alone():
    image = lens(0.006)
    plain = invert(image, options=OPTIONS)
    exact = invert(image, options=OPTIONS, instrument=Instrument())
    assert plain.errors == exact.errors
    assert set(plain.errors.effects) == {"solver"}
    stated = invert(image, options=OPTIONS, instrument={"background": 0.1, "beam_rms": 0.02})
    np.testing.assert_array_equal(plain.displacement, stated.displacement)
    assert plain.errors.total.rms > stated.errors.total.rms  # the beam was assumed with 5 %


def test_every_budget_states_the_sensitivities():
    errors = invert(lens(0.006), options=OPTIONS).errors
    assert set(errors.sensitivities) == {
        "background, 5 %",
        "gamma, 0.05",
        "blur, 1 px",
        "absorption, 1 %",
    }
    assert errors.sensitivities["background, 5 %"].rms == pytest.approx(0.05 * errors.rms, rel=0.2)


def test_parts_are_ranked_and_add_in_squares_to_the_total():
    instrument = Instrument(background=0.02, gamma=0.05, blur=1, other_field=0.1)
    errors = invert(lens(0.006), options=OPTIONS, instrument=instrument).errors
    sizes = [error.rms for error in errors.parts.values()]
    assert sizes == sorted(sizes, reverse=True)
    assert next(iter(errors.parts)) == errors.of_peak.cause == "beam assumed, 5 %"
    assert errors.of_peak.share == errors.total.at_peak / errors.peak
    assert errors.total.rms == pytest.approx(np.sqrt(np.sum(np.square(sizes))))
    assert errors.parts["other field, 10 %"].rms == pytest.approx(0.1 * errors.rms)


def test_a_free_boundary_has_the_same_effects():
    """Of an object in the middle, whose margin is empty."""
    image = lens(0.006)
    source = np.ones(image.shape)
    closed, free = (
        invert(
            image,
            source=source,
            options=InversionOptions(n_sites=2500, boundary=boundary),
            instrument={"background": 0.05, "gamma": 0.05},
        ).errors.effects
        for boundary in ("closed", "free")
    )
    for name in ("background, 5 %", "gamma, 0.05"):
        assert free[name].rms == pytest.approx(closed[name].rms, rel=0.25)


def test_masked_pixels_have_no_background():
    """Of an image whose mask hides a corner, the effect is that of the other pixels."""
    image = lens(0.006)
    mask = np.ones(image.shape, bool)
    mask[:20, :20] = False
    source = np.ones(image.shape)
    keywords = {"source": source, "mask": mask, "options": OPTIONS}
    stated = invert(image, instrument={"background": 0.05}, **keywords)
    changed = invert(np.where(mask, with_background(image, 0.05), np.nan), **keywords)
    change = np.where(mask, changed.displacement - stated.displacement, 0)
    assert stated.errors.effects["background, 5 %"].rms == pytest.approx(
        rms(change) / np.sqrt(mask.mean()), rel=0.15
    )


@pytest.mark.parametrize(
    ("values", "text"),
    [
        ({"background": -0.1}, "background"),
        ({"gamma": 1.5}, "gamma"),
        ({"beam_rms": 1.0}, "beam_rms"),
        ({"beam_length": 0.0}, "beam_length"),
        ({"blur": float("nan")}, "blur"),
        ({"bakground": 0.1}, "background"),
        ({"beam": 0.1}, "unknown key 'beam'"),
    ],
)
def test_a_wrong_instrument_is_refused_in_a_sentence(values, text):
    with pytest.raises(InputError, match=text) as error:
        invert(np.ones((20, 20)), instrument=values)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("setup", "power"),
    [
        (ProtonSetup.example(), 0.5),
        (OpticalSetup(wavelength=8e-7, object_image_distance=0.1, pixel_size=1e-6), 0.0),
    ],
)
def test_an_error_of_the_energy_scales_the_field_not_the_displacement(setup, power):
    image = lens(0.006)
    result = invert(image, source=np.ones(image.shape), instrument={"energy": 0.1})
    exact = invert(image, source=np.ones(image.shape))
    assert result.errors == exact.errors
    in_si = result.in_units(setup).field_errors
    added = np.sqrt(in_si.total.rms**2 - result.errors.total.rms**2)
    assert added == pytest.approx(0.1 * power * result.errors.rms, rel=0.02, abs=1e-9)
    assert (result.in_units(setup).facts[0] == exact.in_units(setup).facts[0]) == (power == 0)
