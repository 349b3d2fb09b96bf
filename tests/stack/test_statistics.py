"""`stack_statistics`: means, spreads and peaks of shots that are done."""

from __future__ import annotations

import numpy as np
import pytest

from napari_shadowinv import InputError, InversionOptions, Recipe, Shot, invert_stack, run_stack
from napari_shadowinv.pipeline import RunOptions
from napari_shadowinv.stack import stack_statistics

OPTIONS = InversionOptions(n_sites=100)


def test_statistics_equal_numpy_and_are_lazy(night, optical_setup):
    stack = invert_stack(
        Shot(night.images, source=night.source), Recipe(options=OPTIONS, setup=optical_setup)
    )
    statistics = stack_statistics(stack)
    assert all(variable.chunks for variable in statistics.data_vars.values())
    computed = statistics.compute()
    for name in ("potential", "displacement", "deflection_angle"):
        values = stack[name].values
        np.testing.assert_allclose(computed[f"{name}_mean"], values.mean(axis=0), rtol=1e-9)
        np.testing.assert_allclose(
            computed[f"{name}_std"], values.std(axis=0, ddof=1), rtol=1e-6, atol=1e-15
        )
        assert computed[f"{name}_mean"].attrs["units"] == stack[name].attrs["units"]
    length = np.sqrt((stack.displacement.values**2).sum(axis=1)).max(axis=(1, 2))
    np.testing.assert_allclose(computed.displacement_peak, length, rtol=1e-12)


def test_shots_that_failed_do_not_count(night, tmp_path):
    images = night.images.copy()
    images[2] = 0
    out = tmp_path / "night.shadowinv.zarr"
    written = run_stack(
        Shot(images, source=night.source),
        out,
        Recipe(options=OPTIONS),
        run=RunOptions(dtype="float64"),
    )
    good = [0, 1, 3, 4, 5]
    alone = invert_stack(Shot(night.images[good], source=night.source), Recipe(options=OPTIONS))
    statistics, expected = stack_statistics(written), stack_statistics(alone)
    np.testing.assert_allclose(statistics.potential_mean, expected.potential_mean, rtol=1e-9)
    np.testing.assert_allclose(statistics.potential_std, expected.potential_std, rtol=1e-9)
    peaks = statistics.displacement_peak.values
    assert np.isnan(peaks[2])
    np.testing.assert_allclose(peaks[good], expected.displacement_peak, rtol=1e-12)


def test_one_shot_has_no_spread(night):
    stack = invert_stack(Shot(night.images[:1], source=night.source), Recipe(options=OPTIONS))
    assert np.isnan(stack_statistics(stack).potential_std).all()


def test_a_dataset_without_shots_is_refused(inversion):
    with pytest.raises(InputError, match="no fields of a series of shots"):
        stack_statistics(inversion.to_dataset())


def test_peak_leaves_out_masked_pixels(night, out):
    mask = np.ones(night.source.shape, bool)
    mask[4:16, 6:20] = False  # the blob
    written = night.run(out, mask=mask, shots=night.images[:2])
    np.testing.assert_array_equal(written.mask, [mask, mask])
    peaks = stack_statistics(written).displacement_peak.values
    lengths = np.hypot(*written.displacement.values.transpose(1, 0, 2, 3).astype(float))
    np.testing.assert_allclose(peaks, lengths[:, mask].max(axis=1), rtol=1e-12)
    assert (peaks < lengths.max(axis=(1, 2))).all()
