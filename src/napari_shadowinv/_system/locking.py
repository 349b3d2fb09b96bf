"""One writer at a time: a lock that a dead process cannot hold."""

from __future__ import annotations

import hashlib
import json
import os
import secrets
import socket
import stat
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO, cast

from napari_shadowinv._system.hidden_files import MAX_NAME_BYTES
from napari_shadowinv.errors import FileFormatError

_MAX_LOCKED_BYTES = MAX_NAME_BYTES - len("..lock")
_BEAT_S = 2.0  # between two signs of life
_WATCH_S = 30.0  # without one after which a lock is stale
_SETTLE_S = 1.0  # in which another process that took the same stale lock has signed it


@contextmanager
def locked(path: Path) -> Iterator[None]:
    """Keep other processes from writing to a path within a block, by a hidden file next to it."""
    # The operating system takes the lock from a process that dies. Where a file system has no
    # locks, or is shared and they do not reach other hosts, signs of life stand in for them: a
    # lock whose file does not change while one watches is stale, whatever the clocks say.
    lock = path.with_name(f".{_shorten_name(path.name)}.lock")
    file, is_new = _open_lock(path, lock)
    with file:
        _take_lock(path, lock, file, is_new)
        ended = threading.Event()

        def beat() -> None:
            while not ended.wait(_BEAT_S):
                with suppress(OSError):
                    os.utime(lock)

        threading.Thread(target=beat, daemon=True, name="lock").start()
        try:
            yield
        finally:
            ended.set()
            _release(file, lock)


def _shorten_name(name: str) -> str:
    """Return a name that leaves room for the ending of its lock."""
    raw = os.fsencode(name)
    if len(raw) <= _MAX_LOCKED_BYTES:
        return name
    digest = hashlib.sha256(raw).hexdigest()[:16]
    return raw[: _MAX_LOCKED_BYTES - len(digest)].decode("utf-8", errors="ignore") + digest


def _open_lock(path: Path, lock: Path) -> tuple[BinaryIO, bool]:
    """Open the lock file without following links, and return whether it is new."""
    flags = os.O_RDWR | getattr(os, "O_NOFOLLOW", 0)
    try:
        while True:
            with suppress(FileExistsError):
                number, is_new = os.open(lock, flags | os.O_CREAT | os.O_EXCL, 0o666), True
                break
            with suppress(FileNotFoundError):
                # Not truncated: it names its holder.
                number, is_new = os.open(lock, flags), False
                break
    except OSError as error:
        if lock.is_symlink():
            raise _not_a_file_error(path, lock) from None
        raise _not_writable_error(path, error) from None
    file = cast(BinaryIO, os.fdopen(number, "r+b", buffering=0))
    status = os.fstat(number)
    if not stat.S_ISREG(status.st_mode) or status.st_nlink > 1:
        file.close()
        raise _not_a_file_error(path, lock)
    return file, is_new


def _not_writable_error(path: Path, error: OSError) -> FileFormatError:
    return FileFormatError(f"{path} cannot be written ({error.strerror}): choose a writable folder")


def _not_a_file_error(path: Path, lock: Path) -> FileFormatError:
    return FileFormatError(
        f"{path} cannot be written: its lock {lock} is a link or not a file; remove it"
    )


def _take_lock(path: Path, lock: Path, file: BinaryIO, is_new: bool) -> None:
    """Make the lock this process's own."""
    taken = _try_lock(file)
    is_certain = is_new or (taken and _read_owner(file).get("host") in (None, socket.gethostname()))
    if taken is False or not (is_certain or _is_silent(lock)):
        raise _lock_error(path, file)
    try:
        signature = _write_owner(file)
    except OSError as error:
        _release(file, lock)
        raise _not_writable_error(path, error) from None
    if not is_certain:
        time.sleep(_SETTLE_S)
        if _read_owner(file) != signature:
            raise _lock_error(path, file)


def _lock_error(path: Path, file: BinaryIO) -> FileFormatError:
    owner = _read_owner(file)
    holder = f"process {owner.get('pid')} on {owner.get('host')}" if owner else "another process"
    return FileFormatError(
        f"{path} is being written by {holder}: wait for that process, or stop it first"
    )


def _is_silent(lock: Path) -> bool:
    """Return whether a lock stays unchanged while it is watched."""
    before = _read_lock(lock)
    end = time.monotonic() + _WATCH_S
    while time.monotonic() < end:
        time.sleep(_BEAT_S / 4)
        if _read_lock(lock) != before:
            return False
    return True


def _read_lock(lock: Path) -> tuple[int, bytes] | None:
    """Return time stamp and content, opening the file anew to refresh a network file system."""
    try:
        with lock.open("rb") as file:
            return os.fstat(file.fileno()).st_mtime_ns, file.read()
    except OSError:
        return None


def _release(file: BinaryIO, lock: Path) -> None:
    with suppress(OSError):
        if os.path.samestat(os.fstat(file.fileno()), os.stat(lock)):
            file.seek(0)
            file.truncate()
            if os.name != "nt":
                lock.unlink()
    with suppress(OSError):
        _unlock(file)


def _write_owner(file: BinaryIO) -> dict[str, object]:
    run = secrets.token_hex(8)
    signature: dict[str, object] = {"host": socket.gethostname(), "pid": os.getpid(), "run": run}
    file.seek(0)
    file.truncate()
    file.write(json.dumps(signature).encode())
    return signature


def _read_owner(file: BinaryIO) -> dict[str, object]:
    file.seek(0)
    try:
        owner = json.loads(file.read() or b"{}")
    except (ValueError, OSError):
        return {}
    return owner if isinstance(owner, dict) else {}


# `_try_lock` returns whether the operating system gave the lock; None where it has no locks.
if os.name == "nt":  # pragma: no cover - Windows only
    import msvcrt

    _BEYOND = 1 << 30  # locks there are mandatory: one on the text would forbid to read it

    def _try_lock(file: BinaryIO) -> bool | None:
        file.seek(_BEYOND)
        try:
            msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)  # type: ignore[attr-defined]
        except OSError:
            return False
        return True

    def _unlock(file: BinaryIO) -> None:
        file.seek(_BEYOND)
        msvcrt.locking(file.fileno(), msvcrt.LK_UNLCK, 1)  # type: ignore[attr-defined]

else:
    import errno
    import fcntl

    def _try_lock(file: BinaryIO) -> bool | None:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            has_none = error.errno in (errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOSYS)
            return None if has_none else False
        # The previous holder may have removed the file after it was opened here.
        return os.fstat(file.fileno()).st_nlink > 0

    def _unlock(file: BinaryIO) -> None:
        fcntl.flock(file, fcntl.LOCK_UN)
