"""Filters of shots, and sources that are guessed from them."""

from __future__ import annotations

import imageio.v3 as iio
import numpy as np
import pytest
from scipy.io import savemat
from typer.testing import CliRunner

from helpers.night import OPTIONS, grouped
from napari_shadowinv import (
    InputError,
    InversionOptions,
    Recipe,
    Shot,
    invert,
    invert_stack,
    read,
    run_stack,
)
from napari_shadowinv.cli import app
from napari_shadowinv.io.store import DONE
from napari_shadowinv.preprocessing import (
    HighPassFilter,
    HotPixelFilter,
    InterpolatedEstimate,
    IsotropicEstimate,
    LowPassEstimate,
    LowPassFilter,
    PolynomialEstimate,
    UniformEstimate,
)
from napari_shadowinv.provenance import Provenance

FILTERS = (HotPixelFilter(), LowPassFilter(width=0.8))


@pytest.fixture
def bare(night) -> np.ndarray:
    """Where the blobs of a night never are."""
    y, x = np.mgrid[:24, :28]
    return np.hypot(y - 10, x - 14) > 8


@pytest.fixture
def usable() -> np.ndarray:
    mask = np.ones((24, 28), bool)
    mask[:3, :4] = False
    return mask


def alone(image, usable, bare):
    """One shot as a stack does it, by the functions themselves."""
    # Far from the object the masked corner hides nothing that counts.
    clean = LowPassFilter(width=0.8).filter_image(
        HotPixelFilter().filter_image(image, usable), usable
    )
    source = PolynomialEstimate(degree=1).source(clean, usable & bare)
    return invert(clean, source=source, mask=usable, options=OPTIONS)


def test_sources_are_guessed_from_filtered_shots(night, out, bare, usable):
    shots = night.images.copy()
    shots[:, 12, 20] = 900
    shots[:, ~usable] = np.nan
    arguments = {
        "source": PolynomialEstimate(degree=1),
        "source_mask": bare,
        "mask": usable,
        "filters": FILTERS,
        "options": OPTIONS,
        "variables": ("potential", "source", "weights"),
    }
    stack, choices = grouped(shots, {**arguments, "dtype": "float64"})
    written = run_stack(stack, out, **choices)
    stack, choices = grouped(shots, arguments, None)
    lazy = invert_stack(stack, **choices)
    assert (written.status == DONE).all()
    for index in (0, 3):
        expected = alone(shots[index], usable, bare)
        for name in ("potential", "source", "weights"):
            values = expected.variable(name)
            np.testing.assert_array_equal(written[name][index], values)
            np.testing.assert_array_equal(lazy[name][index].compute(), values)
    estimate = '{"method":"polynomial","degree":1}'
    assert written.attrs["source_image"] == f"estimated from each shot: {estimate}"
    for dataset in (written, lazy):
        provenance = Provenance.of(dataset.attrs)
        assert provenance is not None
        assert provenance.recipe.steps == FILTERS


def test_a_measured_source_is_blurred_as_its_shots(night, out):
    blur = (LowPassFilter(width=1.0),)
    expected = invert(
        LowPassFilter(width=1.0).filter_image(night.images[1]),
        source=LowPassFilter(width=1.0).filter_image(night.source),
        options=OPTIONS,
    )
    sources = np.stack([night.source] * 6)
    for source in (night.source, sources):
        stack = invert_stack(Shot(night.images, source=source), Recipe(steps=blur, options=OPTIONS))
        np.testing.assert_array_equal(stack.potential[1].compute(), expected.potential)
        np.testing.assert_array_equal(stack.source.values.reshape(-1, 24, 28)[0], expected.source)


def test_a_uniform_beam_is_shared_and_may_be_flattened(night):
    flatten = (HighPassFilter(width=9.0),)
    stack = invert_stack(
        night.images, Recipe(steps=flatten, source=UniformEstimate(), options=OPTIONS)
    )
    expected = invert(HighPassFilter(width=9.0).filter_image(night.images[2]), options=OPTIONS)
    np.testing.assert_allclose(stack.potential[2].compute(), expected.potential, rtol=0, atol=1e-9)


def test_a_store_is_not_continued_with_other_filters_or_guesses(night, out, bare):
    begun = {
        "source": LowPassEstimate(width=6),
        "source_mask": bare,
        "filters": (LowPassFilter(width=1),),
    }
    night.run(out, **begun)
    assert (night.run(out, **begun).status == DONE).all()
    for change, message in (
        ({"filters": (LowPassFilter(width=1.5),)}, 'different steps .*"low-pass", "width": 1.0'),
        ({"filters": ()}, "different steps"),
        ({"source": LowPassEstimate(width=7)}, "different source image"),
        ({"source": None, "source_mask": None}, "different source image"),
        ({"source_mask": ~bare}, "different source mask image"),
    ):
        with pytest.raises(InputError, match=message):
            night.run(out, **{**begun, **change})


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        ({"filters": (HighPassFilter(),)}, "would flatten the image but not the source"),
        ({"source_mask": np.eye(24, 28) < 1}, "got a source mask"),
        ({"source": InterpolatedEstimate()}, "without a source mask"),
        (
            {
                "source": PolynomialEstimate(),
                "source_mask": np.arange(28) > np.zeros((24, 1)) + 9,
                "mask": np.arange(28) > np.zeros((24, 1)) + 9,
            },
            "excluded from the inversion",
        ),
        ({"source": IsotropicEstimate()}, "'isotropic' without a setup"),
        (
            {"source": LowPassEstimate(width=6), "source_mask": np.ones((3, 3), bool)},
            r"mask has shape \(3, 3\)",
        ),
    ],
)
def test_nonsense_is_refused_before_anything_is_computed(night, out, arguments, named):
    with pytest.raises(InputError, match=named):
        night.run(out, **arguments)
    assert not out.exists()


def test_an_estimate_that_cannot_be_made_fails_its_shot_alone(night, out):
    spoilt = night.images.copy()
    spoilt[2] = 0
    written = run_stack(spoilt, out, Recipe(source=LowPassEstimate(width=6), options=OPTIONS))
    assert list(written.status) == [1, 1, 2, 1, 1, 1]


def test_arrays_of_matlab_files_and_a_free_boundary(night, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for index, image in enumerate(night.images[:2]):
        savemat(f"shot_{index}.mat", {"shot": image, "dark": 0 * image, "beam": night.source})
    keys = ["options.n_sites=100", "options.margin=5", "options.flux=known"]
    flags = ["--boundary", "free", *(f"--set={key}" for key in keys)]
    batch = ["batch", "shot_*.mat::shot", "--scheduler", "threads", "--quiet", *flags]
    result = CliRunner().invoke(app, [*batch, "--out", "n.shadowinv.zarr"])
    assert result.exit_code == 0, result.output
    options = InversionOptions(n_sites=100, boundary="free", margin=5, flux="known")
    image = night.images[1] / night.images[1].mean()
    expected = invert(image, source=np.ones_like(image), options=options)
    np.testing.assert_allclose(
        read("n.shadowinv.zarr").potential[1], expected.potential, rtol=1e-6, atol=1e-6
    )


def test_a_batch_prepares_its_shots_as_an_inversion_of_one(
    night, tmp_path, monkeypatch, bare, usable
):
    monkeypatch.chdir(tmp_path)
    iio.imwrite("bare.png", bare.astype(np.uint8))
    iio.imwrite("usable.png", usable.astype(np.uint8))
    (tmp_path / "recipe.toml").write_text(
        '[options]\nn_sites = 100\n[source]\nmethod = "polynomial"\ndegree = 1\n'
    )
    flags = [
        "--recipe", "recipe.toml", "--mask", "usable.png", "--set=source_mask=bare.png",
        "--step=low-pass 0.8", "--step=hot-pixels 6", "--bin", "2", "--quiet",
    ]  # fmt: skip
    out = ["--out", "n.shadowinv.zarr", "--scheduler", "threads"]
    shot = str(night.path(1))
    for command in (["batch", night.glob, *out], ["invert", shot, "--out", "one.shadowinv"]):
        result = CliRunner().invoke(app, [*command, *flags])
        assert result.exit_code == 0, result.output
    stack, single = read("n.shadowinv.zarr"), read("one.shadowinv")
    np.testing.assert_array_equal(stack.potential[1], single.potential.astype(np.float32))
    output = " ".join(CliRunner().invoke(app, ["info", "n.shadowinv.zarr"]).output.split())
    assert "source fitted polynomial, degree 1" in output
    assert "low-pass (smooth), width 0.8" in output
