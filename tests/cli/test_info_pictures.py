"""What `shadowinv info` says of a picture: its pixels' size, its turn, and its doubts."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import tifffile

from helpers.command_line import flat, shadowinv

SHOT = np.random.default_rng(0).poisson(400, (24, 32)).astype(np.uint16)


@pytest.mark.parametrize("channels", [1, 3])
def test_info_of_a_picture_states_size_turn_and_gaps(tmp_path: Path, channels: int) -> None:
    path = tmp_path / "shot.tif"
    image = SHOT if channels == 1 else np.stack([SHOT, SHOT + 1, SHOT + 2], axis=-1)
    profile = (34675, "B", 4, b"sRGB", True)
    tags = [(274, "H", 1, 3, True), (42113, "s", 0, str(SHOT[0, 0]), True), profile]
    kind = "minisblack" if channels == 1 else "rgb"
    dots = {"resolution": (500, 500), "resolutionunit": "CENTIMETER"}
    tifffile.imwrite(path, image, photometric=kind, extratags=tags, metadata=None, **dots)
    text = flat(shadowinv("info", path).output)
    assert "detector pixel size (m) 2e-05" in text
    assert "turned upright as the file says" in text
    assert "not proportional to the light" in text
    if channels == 1:
        assert f"{np.count_nonzero(SHOT[0, 0] == SHOT)} pixels without a value" in text
