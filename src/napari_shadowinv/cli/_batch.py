"""Output of the commands for many shots.

- progress and summary of `shadowinv batch`: `run_batch`
- a line for each shot of `shadowinv watch`, and a summary: `run_watch`
- the table of `shadowinv info`: `status_table`
"""

from __future__ import annotations

import json
import os
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import typer
from rich.table import Table

from napari_shadowinv._system.progress import Progress
from napari_shadowinv._system.safety import as_file_errors
from napari_shadowinv.cautions import Caution
from napari_shadowinv.cli._outputs import flaw_of
from napari_shadowinv.cli._summary import Rows, options_text, provenance_rows, two_columns
from napari_shadowinv.cli._terminal import (
    EXIT_FAILED_SHOTS,
    EXIT_NOT_CONVERGED,
    cancel_exit_code,
    is_interrupted,
    say,
    say_on_stderr,
    work_callbacks,
)
from napari_shadowinv.errors import InputError, InversionCancelled
from napari_shadowinv.facts import Level, Verdict
from napari_shadowinv.io.store import (
    DAMAGED,
    DONE,
    FAILED,
    PENDING,
    STATUS_NAMES,
    StackStore,
    check_store_path,
)
from napari_shadowinv.provenance import Provenance

if TYPE_CHECKING:
    from napari_shadowinv._system.progress import OnProgress
    from napari_shadowinv.pipeline.run_options import RunOptions, WatchOptions
    from napari_shadowinv.preprocessing import Recipe
    from napari_shadowinv.stack import RunStatus

_MAX_LISTED = 10  # shots, or reasons, that a row lists


@dataclass
class _Printer:
    """Printer of a run, by a bar or a line for each shot, with its latest status."""

    quiet: bool  # print only shots that fail, and warnings
    watched: str = ""  # folder of a watch and its files in words, empty for another run
    show: OnProgress | None = None  # the progress of all shots
    status: RunStatus | None = None
    warned: set[str] = field(default_factory=set)  # codes of cautions

    def update(self, status: RunStatus) -> None:
        is_first = self.status is None
        if not status.stage:
            self.status = status
        if self.show is not None:
            stage, ended = status.stage or status.scheduler, status.done + status.failed
            self.show(Progress(stage, ended, status.total or None, f"{status.text}; {status.name}"))
        if status.outcome is not None and status.outcome.reason:
            say_on_stderr(f"failed: {status.name}: {status.outcome.reason}", "red")
        elif not self.watched:
            return
        elif status.outcome is not None:
            self._print_shot(status)
        elif self.quiet:
            return
        elif status.note or status.stage:
            text = status.note or f"{status.stage[:1].upper()}{status.stage[1:]}"
            say_on_stderr(text, "dim")
        elif is_first:
            counts = f"{status.text}; " if status.total else ""
            say(f"Watching {self.watched}; {counts}press Ctrl-C to stop.")

    def _print_shot(self, status: RunStatus) -> None:
        assert status.outcome is not None
        report, level = status.outcome.report, Level(status.outcome.report["level"])
        cautions = list(map(Caution.from_json, report["warnings"]))
        texts = [report["headline"], f"{status.outcome.seconds:.2f} s"]
        texts += [f"{status.waiting} waiting"] if status.waiting else []
        if not self.quiet:
            say("  ".join([status.name, *texts]), "" if level.is_success else "yellow")
        for warning in cautions:
            if warning.code not in self.warned:
                self.warned.add(warning.code)
                say_on_stderr(f"warning: {status.name}: {warning.text}", "yellow")


def run_batch(
    shots: list[str],
    out: Path,
    run: RunOptions,
    *,
    recipe: Recipe,
    channel: str | None,
    resume: bool,
    quiet: bool,
    scheduler: str,
) -> None:
    """Invert all shots into a store, and print a summary."""
    from napari_shadowinv.io.frames import left_out_of
    from napari_shadowinv.stack import FileReader, run_stack

    if resume and run.overwrite:
        raise InputError(
            "received --overwrite with --resume or run.redo_failed, which continue a store: use "
            "one of them"
        )
    if check_store_path(out).exists() and not (resume or run.overwrite):
        raise InputError(
            f"{out} exists ({_counts_text(StackStore(out))}): use --resume to continue, "
            "--overwrite to start again, or another name"
        )
    printer = _Printer(quiet)
    try:
        with work_callbacks(quiet) as callbacks:
            printer.show = callbacks["on_progress"]
            run_stack(
                shots[0] if len(shots) == 1 else shots,
                out,
                recipe,
                reader=FileReader(channel=channel),
                run=run,
                scheduler=scheduler,
                on_progress=printer.update,
                should_stop=is_interrupted,
            )
    except (KeyboardInterrupt, InversionCancelled):
        counts = _counts_text(StackStore(out)) if out.exists() else "nothing written"
        say_on_stderr(f"Cancelled: {counts}. Repeat the command with --resume to continue.")
        raise typer.Exit(cancel_exit_code()) from None
    folders = [Path(path) for path in shots if os.path.isdir(path)]
    store, status, text = StackStore(out), printer.status, "nothing to do"
    if status is not None and status.ended:
        shots_text = f"{status.ended} shot{'s' * (status.ended != 1)}"
        text = f"{shots_text} in {status.seconds:.1f} s, {status.rate:.2g} shots/s"
    if not quiet:
        rows = [
            ("shots", _counts_text(store)),
            ("this run", text),
            *(
                ("left out", f"{counts}; name others as a pattern in quotes")
                for counts in map(left_out_of, folders)
                if counts
            ),
            *_trouble_rows(store),
            ("written", str(store.path)),
        ]
        say(two_columns("Batch", rows))
    exit_unless_reliable(store)


def exit_unless_reliable(store: StackStore) -> None:
    """Exit with an error code if a shot is not done, or its result is not reliable.

    Shots that wait, of a watch that has ended, do not count.
    """
    statuses = store.statuses()
    if np.isin(statuses, (FAILED, DAMAGED)).any():
        raise typer.Exit(EXIT_FAILED_SHOTS)
    for status, report in zip(statuses, store.reports(), strict=True):
        if status != DONE:
            continue
        codes = {caution["code"] for caution in report.get("warnings", ())}
        if flaw_of(report["converged"], None, codes):
            raise typer.Exit(EXIT_NOT_CONVERGED)


def _is_success(verdict: str) -> bool:
    return verdict in list(Verdict) and Verdict(verdict).level.is_success


def _counts_text(store: StackStore) -> str:
    statuses = store.statuses()
    counts = {name: np.sum(statuses == status) for status, name in enumerate(STATUS_NAMES)}
    names = ["done", "failed", "pending"]
    names += ["damaged"] if counts["damaged"] else []
    return ", ".join(f"{counts[name]} {name}" for name in names)


def _troubles(store: StackStore) -> Iterator[tuple[str, str, str, str]]:
    """Yield name, label, code and text of each reason to look at a shot."""
    for name, status, report in zip(store.names, store.statuses(), store.reports(), strict=True):
        if status in (FAILED, DAMAGED):
            reason = report.get("reason", "its report is missing")
            yield name, STATUS_NAMES[status], reason, reason
        elif status == DONE:
            if not _is_success(verdict := str(report["verdict"])):
                yield name, "warning", verdict, verdict
            for caution in map(Caution.from_json, report["warnings"]):
                code = caution.text if caution.code == "other" else caution.code
                yield name, "warning", code, caution.text
            if not report["converged"]:
                yield name, "warning", "not-converged", "the solver did not converge"


def _trouble_rows(store: StackStore) -> Rows:
    """Count the verdicts, and list the shots that failed, are damaged or doubtful, by reason."""
    troubles: dict[tuple[str, str], tuple[str, dict[str, None]]] = {}
    for name, label, code, text in _troubles(store):
        troubles.setdefault((label, code), (text, {}))[1][name] = None
    verdicts = Counter(report["verdict"] for report in store.reports() if "verdict" in report)
    counts = ", ".join(f"{count} {verdict}" for verdict, count in verdicts.items())
    rows: Rows = [("verdicts", counts)] if counts else []
    for label in (STATUS_NAMES[FAILED], STATUS_NAMES[DAMAGED], "warning"):
        listed = [
            f"{_list_text([*names])}: {text}"
            for (each, _), (text, names) in troubles.items()
            if each == label
        ]
        rows += [(label, text) for text in listed[:_MAX_LISTED]]
        if len(listed) > _MAX_LISTED:
            command = f"shadowinv export {store.path} --format csv"
            more = f"and {len(listed) - _MAX_LISTED} more: {command}"
            rows.append((label, more))
    rows += [(STATUS_NAMES[DAMAGED], problem) for problem in store.damage.files[:_MAX_LISTED]]
    if store.damage.shots:
        rows.append(("warning", "repeat the run with --resume to repair the damage"))
    return rows


def _list_text(names: Sequence[str]) -> str:
    return ", ".join(names[:_MAX_LISTED]) + (", …" if len(names) > _MAX_LISTED else "")


@as_file_errors
def status_table(path: Path, verify: bool = False) -> tuple[Table, bool]:
    """Describe a store, and return whether anything is damaged.

    With `verify`, read all files and compare them with their checksums.
    """
    store = StackStore(path, every_byte=verify)
    rows = [*_store_rows(store), *_trouble_rows(store)]
    if verify:
        count = len(store.damage.shots) + len(store.damage.files)
        text = f"{count} do not match" if count else "all files match"
        rows.append(("checksums", text))
    return two_columns(str(path), rows), bool(store.damage.shots or store.damage.files)


def _store_rows(store: StackStore) -> Rows:
    """Describe a store."""
    attributes, count = store.attributes, len(store.names)
    return [
        (
            "kind",
            f"stack of {count} shot{'s' * (count != 1)}, shadowinv {attributes['package_version']}",
        ),
        ("created", str(attributes["created"])),
        ("shots", _counts_text(store)),
        ("size", str(attributes["image_size"])),
        *provenance_rows(Provenance.of(attributes)),
        ("stored", str(attributes["stored"])),
        ("options", options_text(json.loads(attributes["options"]))),
    ]


def run_watch(
    folder: Path,
    out: Path,
    watch: WatchOptions,
    *,
    recipe: Recipe,
    channel: str | None,
    quiet: bool,
) -> None:
    """Watch a folder; print a line for each shot and a summary."""
    from napari_shadowinv.stack import FileReader, watch_stack

    names = "images" if watch.pattern == "*" else watch.pattern
    printer = _Printer(quiet, watched=f"{folder} for {names}")
    with suppress(KeyboardInterrupt, InversionCancelled):
        watch_stack(
            folder,
            out,
            recipe,
            reader=FileReader(channel=channel),
            watch=watch,
            on_progress=printer.update,
            should_stop=is_interrupted,
        )
    if not out.exists():  # no shot could be read
        if not quiet:
            say("Stopped: no shots; repeat the command to watch again.")
        raise typer.Exit(EXIT_FAILED_SHOTS if printer.status and printer.status.waiting else 0)
    store = StackStore(out)
    text = f"Stopped: {_counts_text(store)}; repeat the command to go on."
    if is_interrupted() and np.any(store.statuses() == PENDING):
        say_on_stderr(text)
        raise typer.Exit(cancel_exit_code())
    if not quiet:
        say(text)
    exit_unless_reliable(store)
