"""What is known when flux crosses the image's edge."""

from __future__ import annotations

import numpy as np
import pytest

from napari_shadowinv import InputError, InversionOptions, invert, synthetic_image
from napari_shadowinv.inversion import plan_sites
from napari_shadowinv.physics.phantoms import gaussian_blob
from napari_shadowinv.transport.sites import Margin, edge_flux

SIDE, AROUND = 100, 40
FREE = InversionOptions(boundary="free", n_sites=4000)
CLOSED = InversionOptions(n_sites=4000)
ACROSS = ((45, (7, 12), (40, 18), 0.5), (-30, (10, 6), (81, 65), 0.3))
ISOLATED = ((45, (7, 12), (35, 45), 0.5), (-30, (10, 6), (65, 60), 0.3))


def crop(values):
    return np.ascontiguousarray(values[..., AROUND:-AROUND, AROUND:-AROUND])


def shot(blobs, peak=3.0):
    """Image and displacement inside an edge that the object and its light do not stop at."""
    shape = (SIDE + 2 * AROUND,) * 2
    parts = [
        gaussian_blob(shape, amplitude, widths, (y + AROUND, x + AROUND), angle)
        for amplitude, widths, (y, x), angle in blobs
    ]
    field = sum(part.displacement for part in parts)
    field *= peak / np.hypot(*field).max()
    return synthetic_image(field, np.ones(shape)), field


def l2(field, true):
    return float(np.linalg.norm(field - true) / np.linalg.norm(true))


@pytest.fixture(scope="module")
def across():
    image, field = shot(ACROSS)
    return crop(image), crop(field)


@pytest.fixture(scope="module")
def plan():
    return plan_sites(np.ones((SIDE, SIDE)), FREE)


@pytest.mark.parametrize(("flux", "units"), [("known", 1.0), ("conserve", 7.0)])
def test_an_object_across_the_edge_no_longer_corrupts_the_field(across, flux, units):
    image, true = across
    source = np.ones_like(image)
    closed = invert(image, source=source, options=CLOSED)
    options = FREE.model_copy(update={"flux": flux})
    free = invert(units * image, source=source, options=options)
    assert free.report.converged
    assert l2(closed.displacement, true) > 0.2
    assert l2(free.displacement, true) < 0.06
    assert free.report.flux_scale == pytest.approx(units, rel=4e-3)


def test_an_isolated_object_comes_out_as_with_a_closed_boundary():
    image, true = map(crop, shot(ISOLATED))
    closed = invert(image, options=InversionOptions(n_sites=image.size))
    free = invert(image, options=InversionOptions(n_sites=image.size, boundary="free"))
    assert l2(free.displacement, true) < 1.1 * l2(closed.displacement, true)


def test_the_flux_through_each_side_is_that_of_the_true_rays(across, plan):
    image, _ = across
    known_flux = FREE.model_copy(update={"flux": "known"})
    report = invert(image, plan=plan, options=known_flux).report
    field = shot(ACROSS)[1]
    margin = Margin(np.ones(field.shape[1:]), AROUND)
    of_image = np.zeros(margin.beam.shape)
    margin.within(of_image)[:] = 1
    flux_left, entered = edge_flux(
        synthetic_image(field, of_image), synthetic_image(field, 1 - of_image), margin
    )
    assert max(flux_left.values()) > 0.001
    for side in ("top", "bottom", "left", "right"):
        net = report.flux_left[side] - report.flux_entered[side]
        assert net == pytest.approx(flux_left[side] - entered[side], abs=2e-4)
    gone = sum(report.flux_left.values()) - sum(report.flux_entered.values())
    assert image.sum() == pytest.approx(SIDE**2 * (1 - gone), rel=2e-4)


def test_nothing_moves_where_image_and_source_agree(plan):
    still = invert(np.full((SIDE, SIDE), 3.0), plan=plan, options=FREE)
    assert np.abs(still.displacement).max() < 1e-6
    assert still.report.iterations == 0


def test_result_covers_the_image_alone_and_its_sites_the_margin_too(across, plan):
    inversion = invert(across[0], plan=plan, options=FREE)
    for values in (
        inversion.potential,
        inversion.reprojection,
        inversion.residual,
        inversion.image,
    ):
        assert values.shape == (SIDE, SIDE)
    assert inversion.displacement.shape == (2, SIDE, SIDE)
    gradient = np.array(np.gradient(inversion.potential))
    np.testing.assert_allclose(inversion.displacement[:, 1:-1, 1:-1], -gradient[:, 1:-1, 1:-1])
    off = np.abs(inversion.cells.sites - (SIDE - 1) / 2)
    inside = (off < SIDE / 2).all(axis=1)
    assert inside.sum() == pytest.approx(4000, rel=0.01)
    assert off.max() == pytest.approx(SIDE / 2 + 5, abs=1)
    rms = np.sqrt(np.mean(inversion.residual**2))
    assert rms < 0.2 * np.sqrt(np.mean((inversion.image - inversion.source) ** 2))


def test_a_narrow_decay_holds_the_potential_down_at_the_edge(across, plan):
    """In the limit flux leaves at the edge for nothing, and the potential is constant there."""

    def at_edge(decay_length):
        options = FREE.model_copy(update={"decay_length": decay_length})
        potential = invert(across[0], plan=plan, options=options).potential
        return np.ptp(np.concatenate([potential[0], potential[-1], *potential[:, [0, -1]].T]))

    assert at_edge(0.5) < 0.5 * at_edge(5.0) < 0.5 * at_edge(50.0)


def test_a_start_and_a_plan_change_nothing_but_the_steps(across, plan):
    image, _ = across
    cold = invert(image, source=np.ones_like(image), options=FREE)
    warm = invert(image, plan=plan, options=FREE, start=cold)
    assert warm.report.iterations == 0
    np.testing.assert_allclose(warm.potential, cold.potential, atol=1e-9)


def test_the_source_continues_beyond_masked_pixels_at_the_edge():
    source = np.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]])
    mask = np.array([[True, True, True], [False, True, True]])
    margin = Margin.around(source, 2, mask)
    np.testing.assert_array_equal(margin.within(margin.beam), source)
    assert margin.beam[0, 0] == 1
    assert margin.beam[-1, -1] == 6
    assert margin.beam[3, 1] in (1, 5)  # beside the masked 4


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"flux": "known"}, "'flux' is 'known' and 'boundary' is 'closed'"),
        ({"boundary": "free", "solver": "lbfgs"}, "'solver' is 'lbfgs' and 'boundary' is 'free'"),
    ],
)
def test_choices_that_do_not_go_together_are_refused(options, says):
    with pytest.raises(ValueError, match=says):
        InversionOptions(**options)


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (CLOSED, "plan was made for a free boundary but options have 'closed'"),
        (FREE.model_copy(update={"margin": 9}), "margin of 5 px but options ask for 9 px"),
    ],
)
def test_a_plan_for_another_boundary_is_refused(plan, options, says):
    with pytest.raises(InputError, match=says):
        invert(np.ones((SIDE, SIDE)), plan=plan, options=options)
