"""Status of a watched folder as a JSON file, for the display of a control room: `status_file`."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from napari_shadowinv._system.safety import resolved_path
from napari_shadowinv.errors import InputError
from napari_shadowinv.io.files import check_output, replacing
from napari_shadowinv.stack._arrivals import Arrivals
from napari_shadowinv.stack._run import WATCHING, OnStatus, RunStatus


@contextmanager
def status_file(
    path: Path, arrivals: Arrivals, store: Path, on_progress: OnStatus
) -> Iterator[OnStatus]:
    """Replace a file at the start and end of a block and after each shot in it.

    Yields the function that takes each status. It passes them on to `on_progress`, with a sentence
    if the file cannot be written, once.
    """
    check_output(path, overwrite=True)
    if resolved_path(path.parent) == arrivals.folder and arrivals.matches(path.name):
        raise InputError(
            f"the status file {path} would be taken for a shot of the watched folder: choose "
            "another folder or name"
        )
    content: dict[str, Any] = {"state": "watching", "reason": "", "time": ""}
    content |= {"folder": str(arrivals.folder), "store": str(store), **_numbers(RunStatus())}
    content |= {"newest": None}
    has_failed = False

    def write() -> None:
        nonlocal has_failed
        content["time"] = datetime.now(UTC).isoformat(timespec="milliseconds")
        try:
            with replacing(path, overwrite=True) as draft:
                text = json.dumps(content, indent=2, ensure_ascii=False)
                draft.write_text(text + "\n", encoding="utf-8")
        except OSError as error:
            if not has_failed:
                note = f"the status file cannot be written: {error}"
                on_progress(RunStatus(scheduler=WATCHING, note=note))
            has_failed = True

    def update(status: RunStatus) -> None:
        content.update(_numbers(status))
        if status.outcome is not None:
            content["newest"] = _newest(status, arrivals.folder)
        if status.outcome is not None or not status.ended:
            write()
        on_progress(status)

    write()
    try:
        yield update
    except Exception as error:
        content |= {"state": "failed", "reason": str(error)}
        raise
    finally:
        if content["state"] == "watching":
            content["state"] = "stopped"
        write()


def _numbers(status: RunStatus) -> dict[str, Any]:
    names = ("done", "failed", "skipped", "waiting")
    counts = {name: getattr(status, name) for name in names}
    return {**counts, "with_warnings": status.doubtful, "rate_per_s": round(status.rate, 3)}


def _newest(status: RunStatus, folder: Path) -> dict[str, Any]:
    outcome = status.outcome
    assert outcome is not None
    report, written = outcome.report, None
    with suppress(OSError):  # it may have been put away
        stamp = datetime.fromtimestamp((folder / status.name).stat().st_mtime, UTC)
        written = stamp.isoformat(timespec="milliseconds")
    return {
        "shot": outcome.index,
        "name": status.name,
        "written": written,
        "status": "failed" if outcome.reason else "done",
        "reason": outcome.reason,
        "seconds": round(outcome.seconds, 3),
        **{key: report[key] for key in ("peak", "headline", "level") if key in report},
        "warnings": {each["code"]: each["text"] for each in report.get("warnings", ())},
    }
