"""Hidden files: no process leaves any behind that stops the next one or stays after it."""

from __future__ import annotations

import errno
import os
import signal
import subprocess
from pathlib import Path

import pytest

from helpers.signals import start
from napari_shadowinv._system.hidden_files import locked
from napari_shadowinv.errors import FileFormatError
from napari_shadowinv.io.files import replacing

pytestmark = pytest.mark.skipif(os.name == "nt", reason="signals of POSIX")

REFUSED = r"store is being written by another process, which holds \S+\.store\.lock: wait for"

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
WITHOUT_LOCKS = """
    import errno, fcntl, warnings
    def flock(*arguments):
        raise OSError(errno.ENOSYS, "Function not implemented")
    fcntl.flock = flock
    warnings.simplefilter("ignore")
"""
HOLD = """
    import sys
    from pathlib import Path
    from napari_shadowinv._system.hidden_files import locked
    with locked(Path(sys.argv[1])):
        stall()
"""


def names_in(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def end(process: subprocess.Popen[str]) -> None:
    process.kill()
    process.wait()


def check_refused(path: Path, words: str = REFUSED) -> None:
    with pytest.raises(FileFormatError, match=words), locked(path):
        pass


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_signal_while_writing_leaves_nothing(tmp_path: Path, number: int) -> None:
    process = start(DEFAULT_SIGNALS + WRITE, tmp_path / "a.tif")
    process.send_signal(number)
    assert process.wait(60) == 128 + number
    assert names_in(tmp_path) == []


def test_ignored_signal_does_not_stop_writing(tmp_path: Path) -> None:
    process = start(IGNORED_HANGUP + WRITE.replace("stall()", "stall(1)"), tmp_path / "a.tif")
    process.send_signal(signal.SIGHUP)
    assert process.wait(60) == 0
    assert (tmp_path / "a.tif").read_text() == "half"


def test_who_writes_a_file_next_removes_what_a_killed_process_left(tmp_path: Path) -> None:
    name = "a.tif"
    process = start(WRITE, tmp_path / name)
    with (
        pytest.raises(FileFormatError, match="is being written by another process"),
        replacing(tmp_path / name),
    ):
        pass
    end(process)
    assert len(names_in(tmp_path)) == 2
    with replacing(tmp_path / name) as draft:
        assert not draft.exists()
        draft.write_text("all")
    assert names_in(tmp_path) == [name]
    assert (tmp_path / name).read_text() == "all"


@pytest.mark.parametrize("preamble", ["", WITHOUT_LOCKS])
def test_lock_of_a_killed_process_is_none(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, preamble: str
) -> None:
    if preamble:
        without_locks(monkeypatch, errno.ENOSYS)
    process = start(preamble + HOLD, tmp_path / "store")
    check_refused(tmp_path / "store")
    end(process)
    with locked(tmp_path / "store"):
        assert names_in(tmp_path) == [".store.lock"]
    assert names_in(tmp_path) == []


def without_locks(monkeypatch: pytest.MonkeyPatch, number: int) -> None:
    def flock(*arguments: object) -> None:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr("fcntl.flock", flock)


def test_file_system_that_refuses_a_lock_is_named_with_its_reason(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    without_locks(monkeypatch, errno.ENOLCK)
    check_refused(tmp_path / "store", r"\.store\.lock cannot be locked \(No locks available\)")


def test_one_process_cannot_take_a_lock_twice(tmp_path: Path) -> None:
    with locked(tmp_path / "store"):
        check_refused(tmp_path / "store")
    with locked(tmp_path / "store"):
        check_refused(tmp_path / "store")


def test_links_are_not_followed(tmp_path: Path) -> None:
    lock, theirs = tmp_path / ".store.lock", tmp_path / "theirs"
    theirs.write_text("theirs")
    lock.hardlink_to(theirs)
    with locked(tmp_path / "store"):
        pass
    assert theirs.read_text() == "theirs"
    for target in (theirs, tmp_path / "nowhere"):
        lock.symlink_to(target)
        check_refused(tmp_path / "store", r"\.store\.lock cannot be locked .*: remove that file")
        lock.unlink()
    assert names_in(tmp_path) == ["theirs"]
    assert theirs.read_text() == "theirs"
