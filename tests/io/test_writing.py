from pathlib import Path

import numpy as np
import pytest
import tifffile

from napari_shadowinv.errors import FileFormatError, InputError
from napari_shadowinv.inversion import Inversion
from napari_shadowinv.io import read_radiograph, write
from napari_shadowinv.physics.setup import ProtonSetup

IMAGE = np.linspace(0, 7, 30).reshape(5, 6)


def test_image_formats_keep_their_promise(tmp_path: Path) -> None:
    for name, tolerance in (("a.npy", 0), ("a.tif", 1e-7 * 7), ("a.png", 0.5 / 65535 * 7)):
        values = read_radiograph(write(tmp_path / name, IMAGE)).image
        scale = 7 / 65535 if name == "a.png" else 1
        np.testing.assert_allclose(values * scale, IMAGE, rtol=0, atol=tolerance)
    assert tifffile.imread(tmp_path / "a.tif").dtype == np.float32


def test_tiff_knows_its_pixel_size(tmp_path: Path, proton_setup: ProtonSetup) -> None:
    path = write(tmp_path / "a.tif", IMAGE, setup=proton_setup)
    with tifffile.TiffFile(path) as tiff:
        numerator, denominator = tiff.pages.first.tags["XResolution"].value
    assert 0.01 / (numerator / denominator) == pytest.approx(1.5e-6)


def test_sites_as_a_table(tmp_path: Path, inversion: Inversion) -> None:
    path = write(tmp_path / "sites.csv", inversion)
    assert path.read_text().startswith("y_px,x_px,weight_px2,mass,")
    table = np.loadtxt(path, delimiter=",", skiprows=1)
    expected = [
        inversion.sites,
        inversion.weights[:, None],
        inversion.site_mass[:, None],
        inversion.site_flux[:, None],
        inversion.site_displacement,
    ]
    np.testing.assert_array_equal(table, np.hstack(expected))


def test_dataset_is_written_as_well(tmp_path: Path, inversion: Inversion) -> None:
    dataset = inversion.to_dataset()
    first = write(tmp_path / "a.shadowinv", dataset)
    assert first.stat().st_size > 0
    with pytest.raises(InputError, match="dataset has no 'sites'"):
        write(tmp_path / "a.csv", dataset.drop_vars("sites"))
    assert not (tmp_path / "a.csv").exists()


def test_unknown_ending_and_existing_file_are_refused(tmp_path: Path, inversion: Inversion) -> None:
    with pytest.raises(FileFormatError, match=r"its ending is '\.tif', expected one of .*\.h5"):
        write(tmp_path / "a.tif", inversion)
    with pytest.raises(FileFormatError, match="its ending is none"):
        write(tmp_path / "a", IMAGE)
    (tmp_path / "a.shadowinv").write_text("old")
    with pytest.raises(FileFormatError, match="exists"):
        write(tmp_path / "a.shadowinv", inversion)
    assert (tmp_path / "a.shadowinv").read_text() == "old"


def test_error_while_writing_leaves_the_old_result(
    tmp_path: Path, inversion: Inversion, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write(tmp_path / "a.shadowinv", inversion)
    before = path.read_bytes()

    def fail(temporary: Path, dataset: object) -> None:
        temporary.write_text("half")
        raise OSError("no space left on device")

    monkeypatch.setattr("napari_shadowinv.io.writing.write_result", fail)
    with pytest.raises(OSError, match="no space left"):
        write(path, inversion, overwrite=True)
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]
