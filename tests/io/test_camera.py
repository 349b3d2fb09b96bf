import struct
from pathlib import Path

import numpy as np
import pytest

from helpers.image_files import save_b16, save_spe
from napari_shadowinv.errors import FileFormatError
from napari_shadowinv.io import read_shot

RAMP = np.arange(6 * 9).reshape(6, 9)
FOOTER = b'<SpeFormat version="3.0"><DataFormat><DataBlock type="Frame" count="1">%b</DataBlock>'
REGION = b'<DataBlock type="Region" count="1" width="9" height="6" size="108" />'


@pytest.mark.parametrize("comment", [b"", b"shot 17, f/2"])
@pytest.mark.parametrize("name", ["shot.b16", "shot.tif"])
def test_b16_comes_back(tmp_path: Path, name: str, comment: bytes) -> None:
    pixels = (RAMP * 1213).astype(np.uint16)
    radiograph = read_shot(save_b16(tmp_path / name, pixels, comment))
    np.testing.assert_array_equal(radiograph.image, pixels)
    assert radiograph.metadata["kind"] == "b16"
    assert radiograph.metadata["bits"] == 16


def test_b16_with_the_basic_header(tmp_path: Path) -> None:
    path = tmp_path / "shot.b16"
    header = b"PCO-" + struct.pack("<5i", 24 + 108, 24, 9, 6, 0)
    path.write_bytes(header + RAMP.astype("<u2").tobytes())
    np.testing.assert_array_equal(read_shot(path).image, RAMP)
    # The first pixel stands where the extended header would tell a colour camera.
    path.write_bytes(header + (RAMP * 0 + [1, 0, 0] * 3).astype("<u2").tobytes())
    assert read_shot(path).image[0, 0] == 1


@pytest.mark.parametrize(
    ("code", "dtype"),
    [(0, "<f4"), (1, "<i4"), (2, "<i2"), (3, "<u2"), (5, "<f8"), (6, "u1"), (8, "<u4")],
)
@pytest.mark.parametrize("footer", [b"", FOOTER % REGION])
def test_spe_comes_back(tmp_path: Path, footer: bytes, code: int, dtype: str) -> None:
    pixels = (RAMP * 3 - (40 if dtype in ("<f4", "<i4", "<i2", "<f8") else 0)).astype(dtype)
    radiograph = read_shot(save_spe(tmp_path / "shot.spe", pixels, code, footer))
    np.testing.assert_array_equal(radiograph.image, pixels)
    assert radiograph.metadata["kind"] == "spe"
    assert radiograph.metadata["version"] == (3.0 if footer else 2.5)


def test_spe_is_known_by_its_marks_or_its_name(tmp_path: Path) -> None:
    pixels = RAMP.astype("<u2")
    assert read_shot(save_spe(tmp_path / "shot.dat", pixels)).image[1, 2] == 11
    assert read_shot(save_spe(tmp_path / "a.SPE", pixels, marked=False)).image[1, 2] == 11
    with pytest.raises(FileFormatError, match="not in a recognised image format"):
        read_shot(save_spe(tmp_path / "shot.xyz", pixels, marked=False))
