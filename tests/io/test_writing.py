import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import tifffile

from napari_shadowinv.errors import FileFormatError, InputError
from napari_shadowinv.inversion import Inversion
from napari_shadowinv.io import read_shot, write
from napari_shadowinv.physics.setup import ProtonSetup

Disk = tuple[Path, Callable[[str], bool]]

IMAGE = np.linspace(0, 7, 30).reshape(5, 6)


def test_image_formats_keep_their_promise(tmp_path: Path) -> None:
    for name, tolerance in (("a.npy", 0), ("a.tif", 1e-7 * 7), ("a.png", 0.5 / 65535 * 7)):
        values = read_shot(write(tmp_path / name, IMAGE)).image
        scale = 7 / 65535 if name == "a.png" else 1
        np.testing.assert_allclose(values * scale, IMAGE, rtol=0, atol=tolerance)
    assert tifffile.imread(tmp_path / "a.tif").dtype == np.float32


def test_tiff_knows_its_pixel_size(tmp_path: Path, proton_setup: ProtonSetup) -> None:
    path = write(tmp_path / "a.tif", IMAGE, setup=proton_setup)
    with tifffile.TiffFile(path) as tiff:
        numerator, denominator = tiff.pages.first.tags["XResolution"].value
    assert 0.01 / (numerator / denominator) == pytest.approx(1.5e-6)


def test_what_cannot_be_written_leaves_what_is_there(tmp_path: Path, inversion: Inversion) -> None:
    with pytest.raises(InputError, match="dataset has no 'potential'"):
        write(tmp_path / "a.h5", inversion.to_dataset().drop_vars("potential"))
    with pytest.raises(FileFormatError, match="its ending is none"):
        write(tmp_path / "a", IMAGE)
    (tmp_path / "a.shadowinv").write_text("old")
    with pytest.raises(FileFormatError, match="exists"):
        write(tmp_path / "a.shadowinv", inversion)
    assert [path.read_text() for path in tmp_path.iterdir()] == ["old"]


@pytest.mark.parametrize("name", ["a.shadowinv", "a.h5", "a.tif", "a.npy", "a.png"])
def test_a_full_disk_is_reported_and_keeps_the_old_file(
    name: str, small_disk: Disk, inversion: Inversion, proton_setup: ProtonSetup
) -> None:
    folder, _ = small_disk
    result = inversion if name.endswith((".shadowinv", ".h5")) else IMAGE
    old = write(folder / name, result, setup=proton_setup).read_bytes()
    (folder / "other").write_bytes(bytes(_left(folder)))
    with pytest.raises(FileFormatError, match=rf"{name} cannot be written \(No space left on dev"):
        write(folder / name, result, setup=proton_setup, overwrite=True)
    assert (folder / name).read_bytes() == old
    assert sorted(path.name for path in folder.iterdir()) == [name, "other"]


def _left(folder: Path) -> int:
    import shutil

    return shutil.disk_usage(folder).free


# A process of its own: HDF5 would take this one with it, and what remains of a writer of films
# shows as it ends.
_LONGEST = """
import resource, sys
from pathlib import Path
import numpy as np
from napari_shadowinv.io import read, write
from napari_shadowinv.plotting import write_film

path = Path(sys.argv[1])
dataset = read(path)
frames = np.random.default_rng(0).integers(0, 255, (4, 50, 50, 3), np.uint8)
_, most = resource.getrlimit(resource.RLIMIT_FSIZE)
resource.setrlimit(resource.RLIMIT_FSIZE, (4096, most))
for name in ("b.shadowinv", "b.h5", "b.gif"):
    try:
        target = path.with_name(name)
        write_film(target, frames, 10.0) if name == "b.gif" else write(target, dataset)
    except OSError as error:
        print(error)
"""


@pytest.mark.skipif(sys.platform == "win32", reason="files have no limit there")
def test_a_file_that_finds_no_room_is_refused_in_one_line(
    tmp_path: Path, inversion: Inversion, proton_setup: ProtonSetup
) -> None:
    complete_file = write(tmp_path / "a.shadowinv", inversion, setup=proton_setup)
    command = [sys.executable, "-c", _LONGEST, str(complete_file)]
    printed = subprocess.run(command, capture_output=True, text=True)
    assert (printed.returncode, printed.stderr) == (0, "")
    assert [line.split(" (")[0] for line in printed.stdout.splitlines()] == [
        f"{tmp_path / name} cannot be written" for name in ("b.shadowinv", "b.h5", "b.gif")
    ]
    assert list(tmp_path.iterdir()) == [complete_file]
