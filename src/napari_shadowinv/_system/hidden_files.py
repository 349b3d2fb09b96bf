"""Temporary files and folders, named after the process that writes them.

- in the folder of a file that is being written: `hidden_name`; in the system's temporary folder:
  `temporary_folder`
- remove the leftovers of killed processes: `sweep`

A name holds the machine and user, the process, its start and a random part. So leftovers of a
killed process can be distinguished from files that another process is writing now.
"""

from __future__ import annotations

import getpass
import hashlib
import os
import re
import secrets
import shutil
import socket
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path

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
def temporary_folder(kind: str) -> Iterator[Path]:
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
