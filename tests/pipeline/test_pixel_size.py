"""The size of a pixel that an image's file states: offered to the setup, and compared with it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile

from napari_shadowinv import ProtonSetup, Recipe, run
from napari_shadowinv.errors import InputError
from napari_shadowinv.io import read_shot, write
from napari_shadowinv.pipeline.files import setup_from
from napari_shadowinv.preprocessing import Bin

SHOT = np.random.default_rng(0).poisson(400, (40, 44)).astype(np.uint16)
LENGTHS = {"energy": 14.7, "source_object_distance": 0.01, "object_image_distance": 0.09}  # M = 10


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """A shot whose file states pixels of 20 µm."""
    path = tmp_path / "shot.tif"
    tifffile.imwrite(path, SHOT, resolution=(500, 500), resolutionunit="CENTIMETER")
    return path


@pytest.mark.parametrize(
    ("size", "is_doubted"),
    [
        ({"detector_pixel_size": 20e-6}, False),
        ({"pixel_size": 2e-6}, False),
        ({"pixel_size": 20e-6}, False),  # the file may mean those at the object
        ({"detector_pixel_size": 25e-6}, True),
        ({"pixel_size": 4e-6}, True),
    ],
)
@pytest.mark.parametrize("steps", [(), (Bin(factor=2),)])
def test_setup_with_other_pixels_than_the_file_is_doubted(
    path: Path, size: dict[str, float], is_doubted: bool, steps: tuple[Any, ...]
) -> None:
    setup = ProtonSetup(**LENGTHS, **size)
    recipe = Recipe(setup=setup, steps=steps, options={"n_sites": 100})
    result = run(recipe, path)
    texts = [caution.text for caution in result.report.cautions if caution.code == "setup"]
    assert any("by the image's file" in text for text in texts) == is_doubted


def toml(path: Path, **entries: Any) -> Path:
    rows = (f"{key} = {value!r}".replace("'", '"') for key, value in entries.items())
    path.write_text("\n".join(rows))
    return path


def test_setup_is_completed_by_the_file_but_for_its_kind_and_size(path: Path) -> None:
    geometry = read_shot(path).metadata["geometry"]
    file = path.with_name("a.toml")
    setup = setup_from(toml(file, kind="proton", **LENGTHS), geometry)
    assert setup.object_pixel_size == pytest.approx(2e-6)
    toml(file, kind="proton", pixel_size=7e-6, **LENGTHS)
    assert setup_from(file, geometry).object_pixel_size == 7e-6
    with pytest.raises(InputError, match="'kind' is missing"):
        setup_from(toml(file, object_image_distance=0.09), geometry)
    # Images of its own state the pixels at the object.
    setup = ProtonSetup(**LENGTHS, detector_pixel_size=20e-6)
    write(path, SHOT.astype(float), setup=setup, overwrite=True)
    stated = read_shot(path).metadata["geometry"]
    assert stated == {"pixel_size": pytest.approx(setup.object_pixel_size)}
