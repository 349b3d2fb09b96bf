"""What a stack refuses before anything is written, or does not continue."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
import pytest

from helpers.night import OPTIONS
from helpers.slow_reading import log_and_read
from helpers.store_content import content
from napari_shadowinv import (
    FileFormatError,
    InputError,
    Instrument,
    InversionOptions,
    Shot,
    run_stack,
)
from napari_shadowinv.physics.setup import OpticalSetup
from napari_shadowinv.preprocessing import (
    HighPassFilter,
    IsotropicEstimate,
    KrigedEstimate,
    LowPassEstimate,
    LowPassFilter,
    PolynomialEstimate,
    UniformEstimate,
)
from napari_shadowinv.stack import FileReader

SHAPE = (24, 28)
Y, X = np.indices(SHAPE)
BARE = np.hypot(Y - 10, X - 14) > 8  # where no blob is
FREE = OPTIONS.model_copy(update={"boundary": "free"})
ONES = np.ones(SHAPE)

NONSENSE: dict[str, tuple[dict[str, Any], str]] = {
    "a flattened image": ({"filters": (HighPassFilter(),)}, "would flatten the image but not the"),
    "a mask of no estimate": ({"source_mask": Y != X}, "got a source mask"),
    "nothing to predict": ({"source": KrigedEstimate()}, "without a source mask"),
    "masks apart": (
        {"source": PolynomialEstimate(), "source_mask": X > 9, "mask": X > 9},
        "excluded from the inversion",
    ),
    "no setup": ({"source": IsotropicEstimate()}, "'isotropic' and no setup"),
    "a small source mask": (
        {"source": LowPassEstimate(width=6), "source_mask": np.ones((3, 3), bool)},
        r"mask has shape \(3, 3\)",
    ),
    "a small source": ({"source": np.ones((5, 6))}, r"source has shape \(5, 6\), shots \(24, 28\)"),
    "a small mask": ({"source": None, "mask": np.ones((5, 6), bool)}, "mask has shape"),
    "two sources": ({"source": np.stack([ONES, ONES])}, r"shape \(2, 24, 28\): expected one image"),
    "a variable": ({"variables": ["potental"]}, "no variable 'potental'"),
    "a variable in SI units": ({"variables": ["potential_si"]}, "needs a setup"),
    "a ragged variable": (
        {"source": ONES, "options": FREE, "variables": ["site_flux"]},
        r"'site_flux' \(shots may differ",
    ),
    "a pattern": ({"shots": "nothing/*.tif"}, "no file matches nothing/"),
    "no shots": ({"shots": []}, "empty list"),
    "one image": ({"shots": np.ones((5, 6))}, r"shape \(5, 6\), expected \(shot, y, x\)"),
    "a number": ({"shots": 7}, "are a int: expected an array"),
}
OF_STORES: dict[str, tuple[dict[str, Any], str]] = {
    "a scheduler": ({"scheduler": "quick"}, "scheduler is 'quick'"),
    "workers": ({"workers": 0}, "'workers' is 0: workers must be at least 1"),
    "a type": ({"dtype": "int8"}, "must be 'float32' or 'float64'"),
}


@pytest.mark.parametrize("name", [*NONSENSE, *OF_STORES])
def test_nonsense_is_refused_before_anything_is_computed(any_night, out, name):
    changes, words = {**NONSENSE, **OF_STORES}[name]
    with pytest.raises(InputError, match=words):
        any_night.run(out, **{"shots": any_night.images, **changes})
    assert not out.exists()


def test_shots_that_cannot_be_inverted_are_refused(any_night, tmp_path, out):
    (tmp_path / "a.tif").write_bytes(b"")
    (tmp_path / "empty").mkdir()
    for shots, words in (
        (Shot(any_night.images, source=UniformEstimate()), "choose an estimate in the recipe"),
        (Shot(any_night.images, strength=0.5, brightness=2), "has strength, brightness, expected"),
        (tmp_path / "empty", "contains no image: expected a folder"),
        (str(tmp_path / "*.tif"), "none of 1 shots can be read"),
    ):
        with pytest.raises((InputError, FileFormatError), match=words):
            run_stack(shots, out)


# How a store was begun, what differs now, and words of the sentence.
ESTIMATED = {
    "source": LowPassEstimate(width=6),
    "source_mask": BARE,
    "filters": (LowPassFilter(width=1),),
}
BEGUN = {"measured": {}, "estimated": ESTIMATED, "by a reader": {"reader": log_and_read}}
LIGHT = OpticalSetup(wavelength=5e-7, object_image_distance=0.3, pixel_size=1e-5)
DIFFERENT: dict[str, list[tuple[dict[str, Any], str]]] = {
    "measured": [
        ({"options": InversionOptions(n_sites=50)}, r"options \(n_sites: 100 there, 50 now\)"),
        (
            {"instrument": Instrument(gamma=0.1)},
            r"different instrument \(gamma: default there, 0.1 now\)",
        ),
        ({"source": ONES}, "different source image"),
        ({"mask": Y > 0}, "different mask image"),
        ({"setup": LIGHT}, "different setup"),
        ({"variables": ("potential",)}, "different stored"),
    ],
    "estimated": [
        ({"filters": (LowPassFilter(width=1.5),)}, 'different steps .*"low-pass", "width": 1.0'),
        ({"filters": ()}, "different steps"),
        ({"source": LowPassEstimate(width=7)}, "different source image"),
        ({"source": None, "source_mask": None}, "different source image"),
        ({"source_mask": ~BARE}, "different source mask image"),
    ],
    "by a reader": [
        ({"reader": reader}, "different reader")
        for reader in (FileReader(), partial(log_and_read, loud=True), FileReader(channel="red"))
    ],
}


@pytest.mark.parametrize("begun", BEGUN)
def test_a_store_is_not_continued_otherwise(night, out, begun):
    night.run(out, **BEGUN[begun])
    before = content(out)
    for changes, words in DIFFERENT[begun]:
        with pytest.raises(InputError, match=words):
            night.run(out, **{**BEGUN[begun], **changes})
    assert content(out) == before
    # Threads and order are no difference, nor the same file again, later.
    np.save(night.path(3), night.images[3])
    paths = [night.path(index) for index in (0, 1, 3, 2, 4, 5)]
    options = OPTIONS.model_copy(update={"threads": 1})
    resumed = night.run(out, **BEGUN[begun], shots=paths, options=options)
    assert list(resumed.name.values) == [f"shot_{index}.npy" for index in range(6)]
    assert content(out) == before
    np.save(night.path(3), night.images[3] + 1)
    with pytest.raises(InputError, match=r"shot 3 \(shot_3.npy\) has changed"):
        night.run(out, **BEGUN[begun])
    night.path(3).unlink()
    with pytest.raises(InputError, match=r"\(6 there, 5 given, without shot_3.npy"):
        night.run(out, **BEGUN[begun])
    assert content(out) == before


def test_only_a_store_by_its_name_is_overwritten(any_night, tmp_path):
    with pytest.raises(FileFormatError, match=r"ends with \.shadowinv\.zarr"):
        any_night.run(tmp_path / "night.zarr")
    mine = tmp_path / "thesis.shadowinv.zarr"
    mine.mkdir()
    (mine / "chapter.txt").write_text("years of work")
    with pytest.raises(FileFormatError, match="is not a stack of shots"):
        any_night.run(mine, overwrite=True)
    assert (mine / "chapter.txt").read_text() == "years of work"
