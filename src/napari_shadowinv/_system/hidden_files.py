"""Hidden files next to others: temporary files and folders, and locks.

- in the folder of a file that is being written: `hidden_name`; in the system's temporary folder:
  `temporary_folder`
- remove the leftovers of killed processes: `sweep`
- one writer at a time, by a lock that a dead process cannot hold: `locked`

A temporary name holds the machine and user, the process, its start and a random part. So leftovers
of a killed process can be distinguished from files that another process is writing now.
"""

from __future__ import annotations

import getpass
import hashlib
import json
import os
import re
import secrets
import shutil
import socket
import stat
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from functools import cache
from pathlib import Path
from typing import BinaryIO, Literal, cast

from napari_shadowinv._system.machine import defer_interrupts
from napari_shadowinv.errors import FileFormatError

MAX_NAME_BYTES = 255  # of almost all file systems
_NAME = re.compile(
    r"(\..*|shadowinv|film-pack)-(?P<owner>[0-9a-f]{8})-(?P<pid>\d+)-(?P<start>[0-9a-f]{4})"
    r"-[0-9a-z_]{8}(\.[^-]*)?"
)
_UNKNOWN_START = "0000"

_swept: set[Path] = set()


def hidden_name(path: Path, ending: str = "") -> Path:
    """Return an unused hidden name in the folder of a path, however long the path's name is.

    Parameters
    ----------
    path : Path
    ending : str, optional
        Of the name, such as ``.tif``.
    """
    stem = path.name.removesuffix(ending)
    tail = f"-{_signature()}-{secrets.token_hex(4)}{ending}"
    room = MAX_NAME_BYTES - len(os.fsencode(tail)) - 1
    shortened = os.fsencode(stem)[:room].decode("utf-8", errors="ignore")
    return path.with_name(f".{shortened}{tail}")


@contextmanager
def temporary_folder(kind: Literal["shadowinv", "film-pack"]) -> Iterator[Path]:
    """Make a folder in the system's temporary folder, which is removed with the block.

    Parameters
    ----------
    kind : {"shadowinv", "film-pack"}
        Begins its name.
    """
    sweep(Path(tempfile.gettempdir()))
    with tempfile.TemporaryDirectory(prefix=f"{kind}-{_signature()}-") as name:
        yield Path(name)


def sweep(folder: Path) -> None:
    """Remove the leftovers of this user's dead processes from a folder.

    Each process looks into a folder once.
    """
    if folder in _swept:
        return
    _swept.add(folder)
    with suppress(OSError), os.scandir(folder) as entries:
        for entry in entries:
            match = _NAME.fullmatch(entry.name)
            if match and match["owner"] == _owner() and _is_dead(int(match["pid"]), match["start"]):
                _remove(entry)


def _remove(entry: os.DirEntry[str]) -> None:
    with suppress(OSError):
        if entry.is_dir(follow_symlinks=False):
            shutil.rmtree(entry.path, ignore_errors=True)
        else:
            os.unlink(entry.path)


def _signature() -> str:
    pid = os.getpid()
    return f"{_owner()}-{pid}-{_start_of(pid)}"


@cache
def _owner() -> str:
    """Return a code for this machine, its space of process numbers and this user."""
    facts = [socket.gethostname(), str(os.getuid()) if hasattr(os, "getuid") else getpass.getuser()]
    with suppress(OSError):
        facts.append(Path("/etc/machine-id").read_text(encoding="utf-8"))
    with suppress(OSError):
        facts.append(os.readlink("/proc/self/ns/pid"))
    return hashlib.sha256("|".join(facts).encode()).hexdigest()[:8]


def _start_of(pid: int) -> str:
    """Return a code for when a process was started, as numbers of processes are used again."""
    try:
        boot = Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii")
        status = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8", errors="replace")
    except OSError:
        return _UNKNOWN_START
    ticks = status.rpartition(")")[2].split()[19]
    return hashlib.sha256(f"{boot}{ticks}".encode()).hexdigest()[:4]


def _is_dead(pid: int, start: str) -> bool:
    """Return whether a process has ended, or False where the system does not say."""
    if os.name == "nt":  # there, this signal would end the process
        return False
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return True
    except OSError:
        pass
    return _UNKNOWN_START not in (start, now := _start_of(pid)) and start != now


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
    ended = threading.Event()

    def beat() -> None:
        while not ended.wait(_BEAT_S):
            with suppress(OSError):
                os.utime(lock)

    with ExitStack() as stack:
        with defer_interrupts():  # a signal leaves no lock without its release
            file, is_new = _open_lock(path, lock)
            stack.enter_context(file)
            taken = _try_lock(file)
            # No other process can hold a new lock, or one that was left on this machine.
            is_left = taken and _read_owner(file).get("host") in (None, socket.gethostname())
            is_certain = taken is not False and bool(is_new or is_left)
            if is_certain:
                stack.callback(_release, file, lock)
        if taken is False or not (is_certain or _is_silent(lock)):
            raise _lock_error(path, file)
        _sign(path, lock, file, settle=not is_certain)
        if not is_certain:
            stack.callback(_release, file, lock)
        stack.callback(ended.set)
        threading.Thread(target=beat, daemon=True, name="lock").start()
        yield


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


def _sign(path: Path, lock: Path, file: BinaryIO, *, settle: bool) -> None:
    """Write this process into the lock, and see whether another one does so meanwhile."""
    try:
        signature = _write_owner(file)
    except OSError as error:
        _release(file, lock)
        raise _not_writable_error(path, error) from None
    if settle:
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


@defer_interrupts()
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
