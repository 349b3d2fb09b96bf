"""Computations behind the widgets, without a window."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from napari.layers import Image, Labels, Shapes

from helpers.jobs import run_job
from napari_shadowinv import InputError, InversionOptions
from napari_shadowinv._napari.jobs import SourceJob
from napari_shadowinv._napari.widgets._layers import crop_of, image_of, mask_of
from napari_shadowinv._napari.widgets._stack_jobs import StackJob
from napari_shadowinv._system.progress import Progress
from napari_shadowinv.errors import InversionCancelled
from napari_shadowinv.inversion import compilation
from napari_shadowinv.pipeline import run
from napari_shadowinv.pipeline.run_options import RunOptions
from napari_shadowinv.preprocessing import (
    BackgroundFilter,
    Crop,
    PolynomialEstimate,
    Recipe,
)
from napari_shadowinv.shot import Shot

FEW = InversionOptions(n_sites=500)
Array = np.ndarray[Any, Any]


def stack_job(shots, folder, recipe):
    return StackJob(shots=Shot(shots), out=folder / "a.shadowinv.zarr", recipe=recipe)


def test_a_stack_tells_that_it_compiles(shot, tmp_path, monkeypatch):
    monkeypatch.setattr(compilation, "is_compiled", lambda: False)
    progress: list[Progress] = []
    job = stack_job(shot[None], tmp_path, Recipe(options=FEW))
    status = job.run(progress.append, lambda: False)
    assert list(dict.fromkeys(report.stage for report in progress)) == ["prepare", "shots"]
    assert any(report.message.startswith("compiling, ") for report in progress)
    assert status.text == "1 of 1 done"


LARGE = np.random.default_rng(0).normal(100, 5, (1024, 1024))
SLOW = PolynomialEstimate(degree=10)


def running(recipe):
    return lambda hear, stop: run(recipe, LARGE, on_progress=hear, should_stop=stop)


@pytest.mark.parametrize(
    "job",
    [
        lambda tmp_path: SourceJob(SLOW, Shot(LARGE), None, {}).run,
        lambda tmp_path: running(Recipe(source=SLOW)),
        lambda tmp_path: running(Recipe(steps=(BackgroundFilter(degree=10),))),
        lambda tmp_path: stack_job(LARGE[None], tmp_path, Recipe(source=SLOW)).run,
    ],
    ids=["source", "shot", "step", "stack"],
)
def test_a_megapixel_ends_at_the_look_that_asks(job, tmp_path):
    looks: list[bool] = []

    def should_stop():
        looks.append(len(looks) >= 8)  # in the middle of the estimate or filter
        return looks[-1]

    with pytest.raises(InversionCancelled):
        job(tmp_path)(lambda _: None, should_stop)
    assert looks.count(False) == 8
    assert looks.count(True) <= 2  # a stack's own, and its worker's


def test_a_shot_is_looked_at_before_the_books_count_it(shot, tmp_path):
    stack, out = np.stack([shot, shot]), tmp_path / "a.shadowinv.zarr"
    counted: list[tuple[int, int]] = []

    class CountingJob(StackJob):
        def _update(self, status):
            if status.outcome is not None:
                counted.append((status.outcome.index, self.status.ended))

    options = RunOptions(workers=1)
    job = CountingJob(shots=Shot(stack), out=out, recipe=Recipe(options=FEW), options=options)
    run_job(job)
    assert counted == [(0, 0), (1, 1)]
    assert job.status.ended == 2


def test_painted_pixels_are_unusable_or_the_only_usable_ones():
    image, labels = Image(np.ones((10, 12))), Labels(np.zeros((10, 12), int))
    assert mask_of(labels, image, True) is None
    labels.data[2, 3] = 5
    usable = mask_of(labels, image, True)
    assert usable is not None
    assert usable.sum() == 119
    assert not usable[2, 3]
    chosen = mask_of(labels, image, False)
    assert chosen is not None
    assert chosen.sum() == 1


def test_a_drawn_crop_follows_the_scale_of_its_image():
    image = Image(np.ones((20, 30)), scale=(2.0, 2.0), translate=(10.0, 0.0))
    rectangle = Shapes([np.array([[14, 8], [14, 40], [30, 40], [30, 8]])], shape_type="rectangle")
    assert crop_of(rectangle, image) == Crop(y=(2, 11), x=(4, 21))
    beyond = Shapes([np.array([[-90, -90], [-90, 90], [90, 90], [90, -90]])])
    assert crop_of(beyond, image) == Crop(y=(0, 20), x=(0, 30))
    assert crop_of(Shapes(ndim=2), image) is None


def test_a_drawn_mask_covers_the_pixels_under_it():
    image = Image(np.ones((20, 30)), scale=(2.0, 2.0))
    rectangle = Shapes([np.array([[8, 8], [8, 20], [16, 20], [16, 8]])], shape_type="rectangle")
    usable = mask_of(rectangle, image, True)
    assert usable is not None
    assert not usable[5:8, 5:10].any()
    assert usable[:3].all()


def test_layers_that_are_no_single_image_are_refused():
    with pytest.raises(InputError, match="File → Open"):
        image_of(None)
    with pytest.raises(InputError, match="colour"):
        image_of(Image(np.ones((8, 8, 3)), rgb=True))
    with pytest.raises(InputError, match="Split Stack"):
        image_of(Image(np.ones((4, 8, 8))))
    with pytest.raises(InputError, match="they must match"):
        mask_of(Labels(np.zeros((8, 9), int)), Image(np.ones((8, 8))), True)
