"""A folder watched in a thread, and the shots that a test puts there."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from helpers.night import OPTIONS, grouped, make_shots
from napari_shadowinv.pipeline import WatchOptions
from napari_shadowinv.stack import RunStatus, watch_stack

IMAGES, SOURCE = make_shots(6)
SETTLE = 0.1


class Watched:
    """A folder watched in a thread, and its progress."""

    def __init__(self, folder: Path, out: Path, **choices: Any) -> None:
        self.out = out
        self.events: list[RunStatus] = []
        self.error: Exception | None = None
        self._stop = threading.Event()
        defaults = {"source": SOURCE, "options": OPTIONS, "pattern": "*.npy", "settle": SETTLE}
        self._shots, self._choices = grouped(folder, defaults | choices, WatchOptions)
        self._thread = threading.Thread(target=self._watch)

    def _watch(self) -> None:
        try:
            self.result = watch_stack(
                self._shots,
                self.out,
                on_progress=self.events.append,
                should_stop=self._stop.is_set,
                **self._choices,
            )
        except Exception as error:
            self.error = error

    def __enter__(self) -> Watched:
        self._thread.start()
        self.until(lambda: any(not event.stage for event in self.events) or self.error)
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join(30)
        assert not self._thread.is_alive()

    def until(self, condition: Callable[[], Any]) -> None:
        end = time.monotonic() + 30
        while not condition():
            assert time.monotonic() < end, self.events
            time.sleep(0.005)

    def ended(self, count: int) -> list[RunStatus]:
        """Wait until a number of shots have ended."""
        self.until(lambda: self.error or len(self.shots) >= count)
        if self.error is not None:
            raise self.error
        return self.shots

    @property
    def shots(self) -> list[RunStatus]:
        return [event for event in self.events if event.outcome is not None]


def put(folder: Path, *indices: int) -> None:
    for index in indices:
        np.save(folder / f"shot_{index}.npy", IMAGES[index])


def whole(index: int) -> bytes:
    """The content of a shot's file."""
    file = BytesIO()
    np.save(file, IMAGES[index])
    return file.getvalue()


def watched_once(folder: Path, out: Path, **choices: Any) -> Any:
    """Invert the existing files and return the store."""
    with Watched(folder, out, idle=0.2, **choices) as watch:
        watch.until(lambda: not watch._thread.is_alive())
    if watch.error is not None:
        raise watch.error
    return watch.result
