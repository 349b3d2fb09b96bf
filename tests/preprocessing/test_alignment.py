"""Sources that are shifted against their image."""

from __future__ import annotations

import numpy as np
import pytest

from helpers.shifted_pair import shifted_pair
from napari_shadowinv import InputError
from napari_shadowinv.preprocessing import ReferencePair, align_source


@pytest.mark.parametrize("shift", [(0.0, 0.0), (0.4, 0.3), (2.3, -1.6), (11.2, -7.5)])
def test_the_shift_is_right_within_its_error(shift):
    image, source = shifted_pair(shift)
    aligned = align_source(image, source)
    assert aligned.error.max() < 0.1
    assert (np.abs(aligned.shift - shift) < 3 * aligned.error).all()
    assert aligned.is_significant == any(shift)
    assert ReferencePair(image, aligned.source, np.ones(image.shape, bool)).shift is None


def test_masked_pixels_do_not_count():
    image, source = shifted_pair((2.3, -1.6))
    image[:20] = 5000
    mask = np.ones(image.shape, bool)
    mask[:22] = False
    aligned = align_source(image, source, mask)
    np.testing.assert_allclose(aligned.shift, (2.3, -1.6), atol=0.15)


def test_what_does_not_determine_a_shift_is_refused():
    image, source = shifted_pair((2.3, -1.6), contrast=0.0)
    with pytest.raises(InputError, match="too little structure at their borders"):
        align_source(image, source)
    with pytest.raises(InputError, match="too little structure"):
        align_source(image, np.ones(image.shape))
    with pytest.raises(InputError, match=r"source has shape \(120, 149\), the image \(120, 150\)"):
        align_source(image, source[:, 1:])
