"""One writer at a time: a lock that a dead process cannot hold.

- hold it during a block: `locked`
"""

from __future__ import annotations

import json
import os
import socket
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO

from napari_shadowinv.errors import FileFormatError

__all__ = ["locked"]

_SILENT_AFTER = 120.0  # seconds without a sign of life after which another host's lock is stale


@contextmanager
def locked(path: Path) -> Iterator[Callable[[], None]]:
    """Keep other processes from writing to something, until the block ends.

    The operating system takes the lock from a process that dies. Where a file system is
    shared and its locks do not reach other hosts, signs of life stand in for them.

    Parameters
    ----------
    path : Path
        What is written to; the lock is a hidden file beside it.

    Yields
    ------
    callable
        To be called now and then as a sign of life.

    Raises
    ------
    FileFormatError
        If a living process holds the lock; the sentence names it.
    """
    lock = path.with_name(f".{path.name}.lock")
    with _opened(path, lock) as file:
        if not _taken(file) or _alive_elsewhere(file):
            raise FileFormatError(
                f"{path} is being written by {_holder(file)}: wait for it, or stop it first"
            )
        _sign(file)

        def live() -> None:
            with suppress(OSError):
                os.utime(lock)

        try:
            yield live
        finally:
            _give_back(file, lock)


def _opened(path: Path, lock: Path) -> IO[str]:
    try:
        # Not truncated: who holds it is told in it.
        return os.fdopen(os.open(lock, os.O_RDWR | os.O_CREAT, 0o666), "r+", encoding="utf-8")
    except OSError as error:
        raise FileFormatError(
            f"{path} cannot be written ({error.strerror}): choose a folder that can"
        ) from None


def _give_back(file: IO[str], lock: Path) -> None:
    with suppress(OSError):
        file.seek(0)
        file.truncate()
        if os.name != "nt":
            lock.unlink()
    with suppress(OSError):
        _free(file)


def _sign(file: IO[str]) -> None:
    file.seek(0)
    file.truncate()
    json.dump({"host": socket.gethostname(), "pid": os.getpid()}, file)
    file.flush()


def _content(file: IO[str]) -> dict[str, object]:
    file.seek(0)
    try:
        found = json.loads(file.read() or "{}")
    except (ValueError, OSError):
        return {}
    return found if isinstance(found, dict) else {}


def _alive_elsewhere(file: IO[str]) -> bool:
    found = _content(file)
    if not found or found.get("host") == socket.gethostname():
        return False
    return time.time() - os.fstat(file.fileno()).st_mtime < _SILENT_AFTER


def _holder(file: IO[str]) -> str:
    found = _content(file)
    if not found:
        return "another process"
    return f"process {found.get('pid')} on {found.get('host')}"


if os.name == "nt":  # pragma: no cover - Windows only
    import msvcrt

    _BEYOND = 1 << 30  # locks there are mandatory: one on the text would forbid to read it

    def _taken(file: IO[str]) -> bool:
        file.seek(_BEYOND)
        try:
            msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)  # type: ignore[attr-defined]
        except OSError:
            return False
        return True

    def _free(file: IO[str]) -> None:
        file.seek(_BEYOND)
        msvcrt.locking(file.fileno(), msvcrt.LK_UNLCK, 1)  # type: ignore[attr-defined]

else:
    import errno
    import fcntl

    def _taken(file: IO[str]) -> bool:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            # A file system without locks: signs of life must do.
            return error.errno in (errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOSYS)
        # Whoever had it may have removed the file after it was opened here.
        return os.fstat(file.fileno()).st_nlink > 0

    def _free(file: IO[str]) -> None:
        fcntl.flock(file, fcntl.LOCK_UN)
