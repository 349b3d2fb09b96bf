"""Readers of shots for tests; workers import them by name."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path

import numpy as np

PATIENCE = 60.0


def log_and_read(path: Path) -> np.ndarray:
    """Read a shot and note that it was read."""
    with path.with_name("reads.txt").open("a") as log:
        log.write(f"{path.stem}\n")
    return np.load(path)


def die(path: Path) -> np.ndarray:
    """Take the worker down, as a shot does that needs more memory than there is."""
    os.kill(os.getpid(), signal.SIGKILL)
    return log_and_read(path)


def hang_once(path: Path) -> np.ndarray:
    """Read a shot; the one that ``hang.txt`` names waits, the first time, for ``release``.

    While it waits there is a file ``hanging`` with the id of the process.
    """
    hanging = path.with_name("hang.txt")
    marker = path.with_name("hanging")
    if hanging.exists() and hanging.read_text() == path.stem and not marker.exists():
        draft = path.with_name("hanging.draft")
        draft.write_text(str(os.getpid()))
        draft.replace(marker)
        end = time.monotonic() + PATIENCE
        while not path.with_name("release").exists() and time.monotonic() < end:
            time.sleep(0.02)
    return log_and_read(path)
