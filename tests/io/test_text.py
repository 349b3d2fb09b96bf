from pathlib import Path

import numpy as np
import pytest

from helpers.public_data import public_file
from napari_shadowinv._typing import FloatArray
from napari_shadowinv.errors import FileFormatError
from napari_shadowinv.io import read, read_shot
from napari_shadowinv.physics.setup import ProtonSetup

VALUES = np.random.default_rng(3).normal(0, 1e3, (5, 7))


def lines(path: Path, *rows: str) -> Path:
    path.write_text("\n".join(rows), encoding="utf-8")
    return path


def test_separators_decimal_commas_byte_order_mark_and_blank_lines(tmp_path: Path) -> None:
    path = tmp_path / "shot.csv"
    path.write_text("1,5;2;3e-1;\n4.25;5,125;-6;\n")
    np.testing.assert_array_equal(read(path).image, [[1.5, 2, 0.3], [4.25, 5.125, -6]])
    path.write_bytes(b"\xef\xbb\xbf1,2,\r\n\r\n3,4e1,\r\n\r\n")
    np.testing.assert_array_equal(read(path).image, [[1, 2], [3, 40]])


@pytest.mark.parametrize(
    "comments",
    [
        (
            "# source_object_distance = 0.014",
            "# object_image_distance = 0.2",
            "# pixel_size = 1e-5",
            "# energy = 14.7",
        ),
        (
            "% Source-object distance: 1.4 cm",
            "% OBJECT IMAGE DISTANCE (mm): 200",
            "% pixel size: 10 µm",
            "% energy: 14700 keV",
        ),
        ("# s2r_cm 1.4", "# s2d_cm 21.4", "# bin_um 152.857142857", "# Ep_MeV 14.7"),
    ],
)
def test_comments_tell_the_setup(tmp_path: Path, comments: tuple[str, ...]) -> None:
    path = lines(tmp_path / "shot.txt", "# PROBLEM, run 3: 2019-05-01", *comments, "1 2", "3 4")
    setup = read_shot(path).setup
    assert isinstance(setup, ProtonSetup)
    assert setup.energy == pytest.approx(14.7)
    assert setup.source_object_distance == pytest.approx(0.014)
    assert setup.object_image_distance == pytest.approx(0.2)
    assert setup.object_pixel_size == pytest.approx(1e-5)


def test_comments_that_state_a_part_of_a_setup_or_nothing(tmp_path: Path) -> None:
    path = tmp_path / "shot.txt"
    path.write_bytes("# pixel_size = 25 µm\n1 2\n3 4\n".encode("latin-1"))
    radiograph = read_shot(path)
    assert radiograph.setup is None
    assert radiograph.metadata["geometry"] == {"pixel_size": pytest.approx(25e-6)}
    comments = ("# energy 3 of 5 shots", "# bin 4", "# shot 17", "# taken: 12:30", "#" * 3_000_000)
    assert read_shot(lines(path, *comments, "1 2", "3 4")).metadata["geometry"] == {}


def pradreader(path: Path, *header: str, blocks: int = 3) -> Path:
    """Write shot, reference and a mask that leaves the last two columns out."""
    mask = np.zeros(VALUES.shape)
    mask[:, -2:] = 1
    with path.open("w") as file:
        file.write("".join(f"# {line}\n" for line in header))
        for block in (VALUES, VALUES + 1, mask, mask)[:blocks]:
            np.savetxt(file, block, delimiter=",", fmt="%.17g")
    return path


ALL = ("flux2D (5, 7)", "flux2D_ref (5, 7)", "mask (5, 7)")
SELECTED = ("x-mask 0.0 % - 100.0 %", "y-mask 0.0 % - 100.0 %")


@pytest.mark.parametrize(
    ("header", "blocks"),
    [
        (ALL, 3),
        ((*ALL[:2], *SELECTED), 3),
        (("flux2D (5, 7)", "flux2D_ref", "mask"), 3),
        ((*ALL[:2], SELECTED[0]), 2),
    ],
)
def test_pradreader_stacks_image_reference_and_mask(
    tmp_path: Path, header: tuple[str, ...], blocks: int
) -> None:
    radiograph = read_shot(pradreader(tmp_path / "input.txt", *header, blocks=blocks))
    np.testing.assert_array_equal(radiograph.image, VALUES)
    assert radiograph.source is not None
    np.testing.assert_array_equal(radiograph.source, VALUES + 1)
    expected = np.arange(7) < np.full((5, 1), 5 if blocks == 3 else 7)
    np.testing.assert_array_equal(radiograph.usable, expected)


def test_pradreader_selects_rows_and_columns_by_their_share(tmp_path: Path) -> None:
    header = (*ALL[:2], "x-mask 20 % - 80 %", "y-mask 0.0 % - 100.0 %")
    mask = read_shot(pradreader(tmp_path / "input.txt", *header, blocks=2)).mask
    assert mask is not None
    np.testing.assert_array_equal(mask.all(axis=1), [False, True, True, True, False])
    assert read_shot(pradreader(tmp_path / "all.txt", *ALL[:2], blocks=2)).mask is None


@pytest.mark.parametrize(
    ("header", "blocks"),
    [
        (ALL, 2),
        (ALL, 4),
        (ALL[:2], 3),
        (ALL[:1], 2),
        (("flux2D (4, 7)", "flux2D_ref (4, 7)"), 2),
        (("flux2D (5, 8)", "flux2D_ref (5, 8)"), 2),
        (("flux2D (5, 7)", "flux2D_ref (6, 7)"), 2),
    ],
)
def test_blocks_unlike_the_header_are_refused(
    tmp_path: Path, header: tuple[str, ...], blocks: int
) -> None:
    with pytest.raises(FileFormatError, match=r"rows of 7 numbers, but its header gives flux2D"):
        read_shot(pradreader(tmp_path / "input.txt", *header, blocks=blocks))


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
