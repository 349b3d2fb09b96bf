"""Hidden files next to others: what is being written, and the lock of who writes it.

- in the folder of a file that is being written: `hidden_name`
- one writer at a time: `locked`

The names follow from the file's, so who writes it next finds what a killed process left.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from napari_shadowinv.errors import FileFormatError


def hidden_name(path: Path, ending: str) -> Path:
    """Return the hidden name of a path with another ending."""
    return path.with_name(f".{path.name}{ending}")


@contextmanager
def locked(path: Path) -> Iterator[None]:
    """Keep others from writing to a path within a block; the lock of a dead process is none."""
    from filelock import FileLock, Timeout

    lock = FileLock(hidden_name(path, ".lock"), timeout=0)
    try:
        lock.acquire()
    except Timeout:
        raise FileFormatError(
            f"{path} is being written by another process, which holds {lock.lock_file}: wait for "
            "that process, or stop it first"
        ) from None
    except OSError as error:
        raise FileFormatError(
            f"{path} cannot be written, as {lock.lock_file} cannot be locked ({error.strerror}): "
            "remove that file, or choose another folder"
        ) from None
    try:
        yield
    finally:
        # Removed while it is held: afterwards it may be another's. Windows removes it by itself.
        with suppress(OSError):
            os.unlink(lock.lock_file)
        lock.release()
