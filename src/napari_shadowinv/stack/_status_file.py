"""Status of a watched folder as a JSON file, for the display of a control room: `StatusFile`."""

from __future__ import annotations

import json
import math
import threading
import time
from collections import deque
from collections.abc import Mapping
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from napari_shadowinv._system.safety import resolved_path
from napari_shadowinv.errors import InputError
from napari_shadowinv.io.files import check_output, replacing
from napari_shadowinv.io.store_columns import FITS, INVERSIONS, column_values
from napari_shadowinv.physics.units import shown_fields
from napari_shadowinv.stack._folder_events import Arrivals
from napari_shadowinv.stack._run import WATCHING, OnStatus, RunStatus

_INTERVAL_S = 1.0  # between two files without a new shot
_MIN_INTERVAL_S = 0.2  # between two files, however fast shots end
_RATE_S = 60.0  # of which the rate is the mean


class StatusFile:
    """A file that is replaced after shots and once a second, in a thread, while its block lasts.

    `on_progress` receives each status, too, and a sentence if the file cannot be written, once.
    """

    def __init__(self, path: Path, arrivals: Arrivals, store: Path, on_progress: OnStatus) -> None:
        self.path = check_output(path, overwrite=True)
        if resolved_path(path.parent) == arrivals.folder and arrivals.matches(path.name):
            raise InputError(
                f"the status file {path} would be taken for a shot of the watched folder: choose "
                "another folder or name"
            )
        self._folder, self._store, self._on_progress = arrivals.folder, store, on_progress
        self._changed = threading.Condition()
        self._counts: dict[str, int] = {}
        self._newest: dict[str, Any] | None = None
        self._written_at = 0.0  # file of the newest shot, in s since 1970
        self._warning: dict[str, Any] | None = None
        self._ends: deque[float] = deque()  # of shots in the last minute
        self._began = time.monotonic()
        self._is_due, self._state, self._reason, self._has_failed = True, "watching", "", False
        self._thread = threading.Thread(target=self._write_regularly, daemon=True, name="status")

    def __enter__(self) -> StatusFile:
        self._write()
        self._thread.start()
        return self

    def __exit__(self, _: Any, error: BaseException | None, __: Any) -> None:
        with self._changed:
            has_failed = isinstance(error, Exception)
            self._state = "failed" if has_failed else "stopped"
            self._reason = str(error) if has_failed else ""
            self._changed.notify_all()
        self._thread.join()
        self._write_or_note()

    def update(self, status: RunStatus) -> None:
        """Take over the numbers of shots and the shot that has just ended; pass the status on."""
        with self._changed:
            names = ("done", "failed", "skipped", "waiting")
            self._counts = {name: getattr(status, name) for name in names}
            self._counts["with_warnings"] = status.doubtful
            if status.outcome is not None:
                self._note_shot(status)
            self._is_due = True
            self._changed.notify_all()
        self._on_progress(status)

    def _note_shot(self, status: RunStatus) -> None:
        outcome, result = status.outcome, status.result
        assert outcome is not None
        self._ends.append(time.monotonic())
        self._written_at = time.time()
        with suppress(OSError):  # it may have been put away
            self._written_at = (self._folder / status.name).stat().st_mtime
        self._newest = {
            "shot": outcome.index,
            "name": status.name,
            "status": "failed" if outcome.reason else "done",
            "reason": outcome.reason,
            "seconds": round(outcome.seconds, 3),
            **({} if result is None else _result_entries(result)),
        }
        for caution in () if result is None else result.cautions[-1:]:
            self._warning = {"name": status.name, "code": caution.code, "text": caution.text}

    def _write_regularly(self) -> None:
        while self._state == "watching":
            self._write_or_note()
            with self._changed:
                self._changed.wait_for(lambda: self._state != "watching", _MIN_INTERVAL_S)
                self._changed.wait_for(
                    lambda: self._is_due or self._state != "watching", _INTERVAL_S
                )

    def _write_or_note(self) -> None:
        try:
            self._write()
        except OSError as error:
            if not self._has_failed:
                self._has_failed = True
                note = f"the status file cannot be written: {error}"
                self._on_progress(RunStatus(engine=WATCHING, note=note))

    def _write(self) -> None:
        with self._changed:
            self._is_due = False
            content = self._content()
        text = json.dumps(content, indent=2, ensure_ascii=False)
        with replacing(self.path, overwrite=True) as draft:
            draft.write_text(text + "\n", encoding="utf-8")

    def _content(self) -> Mapping[str, Any]:
        now, elapsed = time.time(), time.monotonic()
        while self._ends and self._ends[0] < elapsed - _RATE_S:
            self._ends.popleft()
        window = min(_RATE_S, max(elapsed - self._began, _MIN_INTERVAL_S))
        newest = self._newest
        if newest is not None:
            age = {"age_s": round(now - self._written_at, 3), "written": _iso(self._written_at)}
            newest = {**newest, **age}
        return {
            "state": self._state,
            **({"reason": self._reason} if self._reason else {}),
            "time": _iso(now),
            "folder": str(self._folder),
            "store": str(self._store),
            **self._counts,
            "rate_per_s": round(len(self._ends) / window, 3),
            "newest": newest,
            "last_warning": self._warning,
        }


def _iso(seconds: float) -> str:
    return datetime.fromtimestamp(seconds, UTC).isoformat(timespec="milliseconds")


def _result_entries(result: Any) -> dict[str, Any]:
    """Return the peak, the facts in a few words and the numbers of a result."""
    is_fit = hasattr(result, "fields")
    displacement = (result.fields[0] if is_fit else result).displacement
    (field,) = shown_fields([displacement], result.setup)
    numbers = column_values(FITS if is_fit else INVERSIONS, result)
    return {
        "peak": {"symbol": field.symbol, "value": field.largest, "unit": field.unit},
        "facts": {fact.key: fact.short for fact in result.facts if fact.short},
        "numbers": {key: _as_json(value) for key, value in numbers.items()},
    }


def _as_json(value: Any) -> Any:
    """Return a number as JSON knows it, without NaN."""
    plain = value.item() if isinstance(value, np.generic) else value
    return None if isinstance(plain, float) and not math.isfinite(plain) else plain
