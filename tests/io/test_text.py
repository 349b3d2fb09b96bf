from pathlib import Path

import numpy as np
import pytest

from helpers.public_data import public_file
from napari_shadowinv._typing import FloatArray
from napari_shadowinv.errors import FileFormatError
from napari_shadowinv.io import read, read_shot


def test_separators_decimal_commas_byte_order_mark_and_blank_lines(tmp_path: Path) -> None:
    path = tmp_path / "shot.csv"
    path.write_text("1,5;2;3e-1;\n4.25;5,125;-6;\n")
    np.testing.assert_array_equal(read(path).image, [[1.5, 2, 0.3], [4.25, 5.125, -6]])
    path.write_bytes(b"\xef\xbb\xbf1,2,\r\n\r\n3,4e1,\r\n\r\n")
    np.testing.assert_array_equal(read(path).image, [[1, 2], [3, 40]])


def test_comments_are_not_read(tmp_path: Path) -> None:
    path = tmp_path / "shot.txt"
    path.write_bytes("# pixel size = 25 µm\n% energy = 3\n1 2\n3 4\n".encode("latin-1"))
    np.testing.assert_array_equal(read_shot(path).image, [[1, 2], [3, 4]])
    assert read_shot(path).setup is None


def test_published_example() -> None:
    path = public_file("prns/target-example.txt")
    image = read_shot(path).image
    assert image.shape == (128, 128)
    assert image.mean() == pytest.approx(1, rel=1e-3)
    np.testing.assert_array_equal(image, np.loadtxt(path))


NOISE = np.random.default_rng(0).poisson(200, (12, 15)).astype(float)


@pytest.mark.parametrize("step", [1, -1, 0.5, 6.5e-6])
@pytest.mark.parametrize("delimiter", [" ", "\t", ","])
def test_column_and_row_of_coordinates_are_refused(
    tmp_path: Path, step: float, delimiter: str
) -> None:
    path = tmp_path / "export.asc"
    y, x = step * np.arange(1, 13), step * np.arange(15) + 3
    corner = np.block([[np.zeros((1, 1)), x[None]], [y[:, None], NOISE]])
    tables = {
        "first column": np.column_stack([y, NOISE]), "first row": np.vstack([x, NOISE]),
        "last column": np.column_stack([NOISE, y]), "last row": np.vstack([NOISE, x]),
        "first (column|row)": corner,
    }  # fmt: skip
    for name, table in tables.items():
        np.savetxt(path, table, delimiter=delimiter)
        with pytest.raises(FileFormatError, match=f"in its {name}"):
            read(path)


def test_lists_of_coordinates_and_uneven_steps_are_refused(tmp_path: Path) -> None:
    path, (y, x) = tmp_path / "export.csv", np.indices(NOISE.shape)
    wavelengths = 500 + 0.3 * np.arange(12) - 0.002 * np.arange(12) ** 2
    listed = r"values of 1[25] × 1[25] pixels in columns"
    for columns, sentence in (
        ([c.ravel() for c in (x, y, NOISE)], listed),
        ([c.ravel() for c in (y, x, NOISE)], listed),
        ([wavelengths, NOISE], "in its first column"),
    ):
        np.savetxt(path, np.column_stack(columns))
        with pytest.raises(FileFormatError, match=sentence):
            read(path)


@pytest.mark.parametrize(
    "image",
    [
        NOISE,
        np.add.outer(3.0 * np.arange(12), 2.0 * np.arange(15)),
        np.ones((12, 15)),
        NOISE[:, :3],
        np.tile(np.arange(15.0), (12, 1)),
        np.hypot(*np.indices((12, 15))),
        np.exp(-(np.hypot(*(np.indices((40, 50)) - 25)) ** 2) / 200),
        np.pad(NOISE, 3),
        np.arange(12.0 * 15).reshape(12, 15),
    ],
)
def test_images_as_text_are_no_coordinates(tmp_path: Path, image: FloatArray) -> None:
    np.savetxt(tmp_path / "shot.txt", image)
    np.testing.assert_allclose(read(tmp_path / "shot.txt").image, image)
