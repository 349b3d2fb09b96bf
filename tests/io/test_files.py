import errno
import os
import signal
from pathlib import Path

import numpy as np
import pytest

from napari_shadowinv.errors import FileFormatError
from napari_shadowinv.io.files import check_output, replacing, sha256
from napari_shadowinv.io.formats import kind_of


def test_checksum_is_sha256_of_content_and_a_folder_or_no_file_is_named(tmp_path: Path) -> None:
    path = tmp_path / "abc"
    path.write_bytes(b"abc")
    assert sha256(path) == "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"
    for place, words in ((tmp_path, "is a folder"), (tmp_path / "b.tif", "b.tif does not exist")):
        with pytest.raises(FileFormatError, match=words):
            kind_of(place)


def test_outputs_that_cannot_be_written_are_refused(tmp_path: Path) -> None:
    existing = tmp_path / "there.npy"
    existing.write_text("old")
    assert check_output(existing, overwrite=True) == existing
    for path, overwrite, words in (
        (existing, False, "exists"),
        (tmp_path / "nowhere" / "a.npy", False, r"folder .*nowhere does not exist"),
        (tmp_path, True, "is a folder"),
        (tmp_path / "a.doc", False, r"its ending is '\.doc', expected one of \.npy"),
    ):
        with pytest.raises(FileFormatError, match=words):
            check_output(path, overwrite, suffixes=() if path == tmp_path else (".npy",))


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt])
def test_failed_write_keeps_the_old_file_and_leaves_nothing(
    tmp_path: Path, error: type[BaseException]
) -> None:
    path = tmp_path / "result.bin"
    path.write_text("old")

    def write_half() -> None:
        with replacing(path, overwrite=True) as temporary:
            temporary.write_text("half of the n")
            raise error

    with pytest.raises(error):
        write_half()
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_file_has_its_name_when_it_is_whole_unless_another_has_it(tmp_path: Path) -> None:
    path = tmp_path / "a.npy"
    with replacing(path) as temporary:
        assert (temporary.parent, temporary.suffix) == (path.parent, ".npy")
        assert not path.exists()
        np.save(temporary, np.arange(3))
    assert np.load(path).tolist() == [0, 1, 2]
    path.unlink()

    def write_late() -> None:
        with replacing(path) as temporary:
            temporary.write_text("mine")
            path.write_text("theirs")

    with pytest.raises(FileFormatError, match="exists"):
        write_late()
    assert path.read_text() == "theirs"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.skipif(os.name == "nt", reason="signals to oneself")
@pytest.mark.usefixtures("usual_ctrl_c")
def test_ctrl_c_during_the_clean_up_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    remove = Path.unlink

    def interrupted(path: Path, missing_ok: bool = False) -> None:
        signal.raise_signal(signal.SIGINT)
        remove(path, missing_ok)

    def work() -> None:
        with replacing(tmp_path / "a.txt") as temporary:
            temporary.write_text("half")
            monkeypatch.setattr(Path, "unlink", interrupted)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        work()
    monkeypatch.undo()
    assert list(tmp_path.iterdir()) == []


def test_a_file_takes_its_name_when_the_disk_has_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    names = []

    def fsync(descriptor: int) -> None:
        names.extend(path.name for path in tmp_path.iterdir())
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", fsync)
    with (
        pytest.raises(FileFormatError, match=r"a\.txt cannot be written \(No space left"),
        replacing(tmp_path / "a.txt") as temporary,
    ):
        temporary.write_text("whole")
    assert temporary.name in names
    assert "a.txt" not in names
    assert list(tmp_path.iterdir()) == []
