"""Temporary files: no process leaves any behind that the next one would not remove."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

from helpers.signals import start
from napari_shadowinv._system import hidden_files
from napari_shadowinv._system.hidden_files import hidden_name, locked, sweep, temporary_folder
from napari_shadowinv.errors import FileFormatError
from napari_shadowinv.io.files import check_output, replacing

pytestmark = pytest.mark.skipif(os.name == "nt", reason="signals of POSIX")


@pytest.fixture(autouse=True)
def unswept(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let this process look into a folder again."""
    monkeypatch.setattr(hidden_files, "_swept", set())


# A process started by nohup ignores SIGHUP, as do the ones it starts.
DEFAULT_SIGNALS = """
    import signal
    for number in (signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_DFL)
"""
IGNORED_HANGUP = """
    import signal
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
"""
WRITE = """
    import sys
    from napari_shadowinv.io.files import replacing
    with replacing(sys.argv[1]) as draft:
        draft.write_text("half")
        stall()
"""
KEEP = """
    import sys, tempfile
    tempfile.tempdir = sys.argv[1]
    from napari_shadowinv._system.hidden_files import temporary_folder
    with temporary_folder("shadowinv") as folder:
        (folder / "inner").mkdir()
        stall()
"""


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_signal_while_writing_leaves_nothing(tmp_path: Path, number: int) -> None:
    process = start(DEFAULT_SIGNALS + WRITE, tmp_path / "a.tif")
    process.send_signal(number)
    assert process.wait(60) == 128 + number
    assert list(tmp_path.iterdir()) == []


def test_ignored_signal_does_not_stop_writing(tmp_path: Path) -> None:
    process = start(IGNORED_HANGUP + WRITE.replace("stall()", "stall(1)"), tmp_path / "a.tif")
    process.send_signal(signal.SIGHUP)
    assert process.wait(60) == 0
    assert (tmp_path / "a.tif").read_text() == "half"


@pytest.mark.parametrize("body", [WRITE, KEEP])
def test_litter_of_a_killed_process_is_swept(tmp_path: Path, body: str) -> None:
    process = start(body, tmp_path / "a.tif" if body is WRITE else tmp_path)
    (litter,) = tmp_path.iterdir()
    sweep(tmp_path)
    assert litter.exists()
    process.kill()
    process.wait()
    hidden_files._swept.clear()
    with replacing(tmp_path / "b.tif") as draft:
        draft.write_text("all")
    assert [path.name for path in tmp_path.iterdir()] == ["b.tif"]


@pytest.mark.parametrize(
    ("holder", "step"),
    [
        (hidden_files, "_open_lock"),
        (hidden_files, "_try_lock"),
        (hidden_files, "_write_owner"),
        (Path, "unlink"),
    ],
)
@pytest.mark.usefixtures("usual_ctrl_c")
def test_lock_is_removed_whenever_a_signal_comes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, holder: object, step: str
) -> None:
    work = getattr(holder, step)

    def interrupted(*arguments: object) -> object:
        if step == "unlink":
            signal.raise_signal(signal.SIGINT)
            return work(*arguments)
        result = work(*arguments)
        signal.raise_signal(signal.SIGINT)
        return result

    monkeypatch.setattr(holder, step, interrupted)
    with pytest.raises(KeyboardInterrupt), locked(tmp_path / "a.shadowinv.zarr"):
        pass
    assert list(tmp_path.iterdir()) == []


def dead_process() -> int:
    process = subprocess.Popen([sys.executable, "-c", ""])
    process.wait()
    return process.pid


def test_sweep_keeps_files_of_others(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pid, owner, start_code = dead_process(), hidden_files._owner(), "abcd"
    names = [
        f".a-{owner}-{os.getpid()}-{hidden_files._start_of(os.getpid())}-01234567.tif",
        f".a-{'0' * 8}-{pid}-{start_code}-01234567.tif",
        f"a-{owner}-{pid}-{start_code}-01234567.tif",
        ".a-01234567.tif",
        ".hidden",
    ]
    for name in names:
        (tmp_path / name).write_text("theirs")
    ours = tmp_path / f".a-{owner}-{pid}-{start_code}-01234567.tif"
    ours.write_text("ours")
    sweep(tmp_path)
    assert not ours.exists()
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(names)


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux reports starts of processes")
def test_number_of_a_process_may_be_used_again(tmp_path: Path) -> None:
    owner = hidden_files._owner()
    stale = tmp_path / f".a-{owner}-{os.getpid()}-ffff-01234567"
    stale.mkdir()
    (stale / "file").touch()
    sweep(tmp_path)
    assert not stale.exists()


def test_link_is_removed_and_not_followed(tmp_path: Path) -> None:
    target = tmp_path / "target"
    target.mkdir()
    (target / "file").touch()
    link = tmp_path / f".a-{hidden_files._owner()}-{dead_process()}-abcd-01234567"
    link.symlink_to(target)
    sweep(tmp_path)
    assert not os.path.lexists(link)
    assert (target / "file").exists()


@pytest.mark.parametrize("name", ["a" * 251 + ".tif", "ä" * 125 + ".tif", "x.shadowinv.zarr"])
def test_hidden_name_fits_the_file_system(tmp_path: Path, name: str) -> None:
    hidden = hidden_name(tmp_path / name, Path(name).suffix)
    assert len(os.fsencode(hidden.name)) <= 255
    assert hidden.suffix == Path(name).suffix
    hidden.touch()


def test_long_name_is_written_and_one_too_long_refused(tmp_path: Path) -> None:
    path = tmp_path / ("n" * 251 + ".txt")
    with replacing(path) as draft:
        draft.write_text("all")
    assert path.read_text() == "all"
    with pytest.raises(FileFormatError, match="its name has 256 bytes, expected at most 255"):
        check_output(tmp_path / ("n" * 252 + ".txt"))


def test_temporary_folder_ends_with_its_block(monkeypatch, tmp_path: Path) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    with temporary_folder("shadowinv") as folder:
        assert folder.parent == tmp_path
    assert list(tmp_path.iterdir()) == []
