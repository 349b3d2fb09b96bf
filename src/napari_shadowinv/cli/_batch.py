"""Output of the commands for many shots.

- progress and summary of `shadowinv batch`: `run_batch`
- a line for each shot of `shadowinv watch`, and a summary: `run_watch`
- the tables of `shadowinv info`: `status_tables`
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import typer
from rich import box, progress
from rich.console import Console
from rich.table import Column, Table

from napari_shadowinv._system.safety import as_file_errors
from napari_shadowinv.cautions import Caution
from napari_shadowinv.cli._summary import Rows, options_text, two_columns
from napari_shadowinv.cli._terminal import (
    EXIT_NOT_CONVERGED,
    cancel_exit_code,
    is_interrupted,
    plain,
    say,
    say_on_stderr,
)
from napari_shadowinv.errors import InputError, InversionCancelled
from napari_shadowinv.facts import Verdict, percent
from napari_shadowinv.io.store import (
    DAMAGED,
    DONE,
    FAILED,
    SKIPPED,
    STATUS_NAMES,
    StackStore,
    check_store_path,
)
from napari_shadowinv.physics.setup import beam_quantities

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from napari_shadowinv.io.store_columns import ShotColumn
    from napari_shadowinv.pipeline.run_options import RunOptions, WatchOptions
    from napari_shadowinv.preprocessing import Recipe
    from napari_shadowinv.stack import RunStatus

EXIT_FAILED_SHOTS = 1
_BAR_COLUMNS = 16
_MAX_LISTED = 10  # shots that a row lists
_LINE_COLUMNS = 100
_MIN_NAME_COLUMNS = 12


def _rate_text(status: RunStatus) -> str:
    if not status.ended:
        return "no shot finished"
    rate = status.rate
    return f"{rate:.1f} shots/s" if rate >= 1 else f"{60 * rate:.1f} shots/min"


def run_batch(
    shots: list[str],
    out: Path,
    run: RunOptions,
    *,
    recipe: Recipe,
    reader: Callable[..., ArrayLike],
    resume: bool,
    quiet: bool,
    scheduler: str,
) -> None:
    """Invert all shots into a store, and print a summary."""
    from napari_shadowinv.io.frames import left_out_of
    from napari_shadowinv.stack import run_stack

    if resume and run.overwrite:
        raise InputError("got --resume and --overwrite, expected one of them")
    if check_store_path(out).exists() and not (resume or run.overwrite):
        raise InputError(
            f"{out} exists ({_counts_text(StackStore(out))}): use --resume to continue, "
            "--overwrite to start again, or another name"
        )
    try:
        bar = _ProgressBar(quiet)
        with bar.bars:
            run_stack(
                shots[0] if len(shots) == 1 else shots,
                out,
                recipe,
                reader=reader,
                run=run,
                scheduler=scheduler,
                on_progress=bar.update,
                should_stop=is_interrupted,
            )
    except (KeyboardInterrupt, InversionCancelled):
        counts = _counts_text(StackStore(out)) if out.exists() else "nothing written"
        say_on_stderr(f"Cancelled: {counts}. Repeat the command with --resume to continue.")
        raise typer.Exit(cancel_exit_code()) from None
    folders = [Path(path) for path in shots if os.path.isdir(path)]
    left_out = filter(None, map(left_out_of, folders))
    store, status = StackStore(out), bar.status
    text = "nothing to do"
    if status is not None and status.ended:
        text = f"{status.ended} shots in {status.seconds:.1f} s, {_rate_text(status)}"
    if not quiet:
        rows = [
            ("shots", _counts_text(store)),
            ("this run", text),
            *(("left out", f"{text}; name others as a pattern in quotes") for text in left_out),
            *_site_rows(store),
            *_trouble_rows(store),
            ("written", str(store.path)),
        ]
        say(two_columns("Batch", rows))
    exit_unless_reliable(store)


def exit_unless_reliable(store: StackStore) -> None:
    """Exit with an error code if a shot is not done, or its result is not reliable.

    Shots that were skipped on purpose do not count.
    """
    statuses = store.statuses()
    if not np.isin(statuses, (DONE, SKIPPED)).all():
        raise typer.Exit(EXIT_FAILED_SHOTS)
    for status, report in zip(statuses, store.reports(), strict=True):
        codes = {caution["code"] for caution in report.get("warnings", ())}
        is_sound = _is_success(report.get("verdict", "")) and "samples" not in codes
        if "level" in report:  # an inversion
            is_sound = bool(report.get("converged"))
        if status == DONE and not is_sound:
            raise typer.Exit(EXIT_NOT_CONVERGED)


def _is_success(verdict: str) -> bool:
    return verdict in list(Verdict) and Verdict(verdict).level.is_success


def progress_columns() -> tuple[progress.ProgressColumn, ...]:
    """Return the columns of the progress line; a narrow terminal cuts the last shot's name."""
    flexible = Column(ratio=1, no_wrap=True, overflow="ellipsis")
    rigid = Column(no_wrap=True)
    return (
        progress.SpinnerColumn(),
        progress.TextColumn("{task.description}", markup=False, table_column=rigid),
        progress.BarColumn(bar_width=_BAR_COLUMNS),
        progress.MofNCompleteColumn(table_column=rigid),
        progress.TextColumn("{task.fields[rate]}", table_column=rigid),
        progress.TextColumn("{task.fields[remaining]}", table_column=rigid),
        progress.TextColumn("{task.fields[failed]}", style="red", table_column=rigid),
        progress.TextColumn(
            "{task.fields[last]}", style="dim", markup=False, table_column=flexible
        ),
    )


class _ProgressBar:
    """Bar with the rate and the time that remains; failures are printed above it."""

    def __init__(self, quiet: bool) -> None:
        self._console = Console(stderr=True)
        self._quiet = quiet
        hidden = quiet or not self._console.is_terminal
        self.bars = progress.Progress(
            *progress_columns(), console=self._console, disable=hidden, expand=True
        )
        fields: dict[str, Any] = {"rate": "", "remaining": "", "failed": "", "last": ""}
        self._task = self.bars.add_task("starting", total=None, **fields)
        self.status: RunStatus | None = None

    def update(self, status: RunStatus) -> None:
        if status.stage:
            self.bars.update(self._task, description=status.stage)
            return
        self.status, outcome = status, status.outcome
        last = "" if outcome is None else f"{status.name}, {outcome.seconds:.1f} s"
        remaining = ""
        if status.remaining is not None:
            time_left = timedelta(seconds=round(status.remaining))
            remaining = f"{time_left} left" if status.waiting else "finishing"
        self.bars.update(
            self._task,
            description=status.scheduler,
            total=status.total,
            completed=status.done + status.failed,
            rate=_rate_text(status),
            remaining=remaining,
            failed=f"{status.failed} failed" if status.failed else "",
            last=plain(last).plain,
        )
        if outcome is not None and outcome.reason and not self._quiet:
            line = plain(f"failed: {status.name}: {outcome.reason}", "red")
            self._console.print(line, soft_wrap=True)


def _counts_text(store: StackStore) -> str:
    statuses = store.statuses()
    counts = {name: np.sum(statuses == status) for status, name in enumerate(STATUS_NAMES)}
    names = ["done", "failed", "pending"]
    names += [name for name in ("skipped", "damaged") if counts[name]]
    return ", ".join(f"{counts[name]} {name}" for name in names)


def _recipe_rows(store: StackStore) -> Rows:
    """Return the origin of the source and the steps before the inversion."""
    from napari_shadowinv.provenance import Provenance

    provenance = Provenance.of(store.attributes)
    common = None if provenance is None else provenance.image.source
    source = common.file if common is not None else ""
    # Each row of a table may name another source.
    origins = map(Provenance.of, store.reports())
    sources = [origin.image.source for origin in origins if origin is not None]
    files = list(dict.fromkeys(source.file for source in sources if source and source.file))
    rows: Rows = [("source", _list_text(files) or source or str(store.attributes["source_image"]))]
    steps = () if provenance is None else provenance.recipe.steps
    return [*rows, *(("step", step.summary) for step in steps)]


def _beam_rows(store: StackStore) -> Rows:
    """Return energies or wavelengths of the finished shots, if they come from rows of a table."""
    rows: Rows = []
    for name, quantity in beam_quantities().items():
        values = sorted({report[name] for report in store.reports() if name in report})
        rows += [(quantity.plural, quantity.text(*values, digits=6))] if values else []
    return rows


def _site_rows(store: StackStore) -> Rows:
    """Return the number of sites with its reason, and the typical errors."""
    reports = [report for report in store.reports() if "n_sites" in report]
    if not reports:
        return []
    counts = sorted({report["n_sites"] for report in reports})
    least, most = f"{counts[0]:,}", f"{counts[-1]:,}"
    reasons = dict.fromkeys(report.get("sites_reason") or "as requested" for report in reports)
    reason = next(iter(reasons)) if len(reasons) == 1 else "for different reasons"
    rows: Rows = [("sites", f"{least if least == most else f'{least} to {most}'}; {reason}")]
    if totals := [total for report in reports if (total := report.get("total_error"))]:
        median = percent(float(np.median(totals)))
        rows.append(("errors", f"{median} of the displacement (r.m.s., median of the shots)"))
    return rows


def _trouble_rows(store: StackStore) -> Rows:
    """List the shots that failed, are damaged or have doubtful results."""
    statuses = store.statuses()
    rows = []
    for status in (FAILED, DAMAGED):
        label, indices = STATUS_NAMES[status], np.flatnonzero(statuses == status).tolist()
        rows += [
            (label, f"{store.names[i]}: {store.report(i).get('reason', 'its report is missing')}")
            for i in indices[:_MAX_LISTED]
        ]
        if len(indices) > _MAX_LISTED:
            hidden = len(indices) - _MAX_LISTED
            rows.append((label, f"and {hidden} more: shadowinv info {store.path} --all"))
    skipped = [store.names[index] for index in np.flatnonzero(statuses == SKIPPED)]
    if skipped:
        rows.append(("skipped", f"{_list_text(skipped)}; a watch without --latest inverts them"))
    rows += [(STATUS_NAMES[DAMAGED], problem) for problem in store.damage.files[:_MAX_LISTED]]
    if store.damage.shots or store.damage.files:
        rows.append(("warning", "repeat the run with --resume to repair the damage"))
    unconverged = [
        store.names[index]
        for index, report in enumerate(store.reports())
        if statuses[index] == DONE and not report.get("converged")
    ]
    if unconverged:
        text = f"{len(unconverged)} shots did not converge: {_list_text(unconverged)}"
        rows.append(("warning", text))
    return [*rows, *_verdict_rows(store), *_warning_rows(store)]


def _warning_rows(store: StackStore) -> Rows:
    """List each kind of warning with its shots, but for the verdicts of fits."""
    warned: dict[str, tuple[str, list[str]]] = {}
    for name, report in zip(store.names, store.reports(), strict=True):
        for caution in map(Caution.from_json, report.get("warnings", ())):
            if caution.code == "verdict":
                continue
            key = caution.text if caution.code == "other" else caution.code
            warned.setdefault(key, (caution.text, []))[1].append(name)
    return [("warning", f"{_list_text(names)}: {warning}") for warning, names in warned.values()]


def _list_text(names: Sequence[str]) -> str:
    return ", ".join(names[:_MAX_LISTED]) + (", …" if len(names) > _MAX_LISTED else "")


def _verdict_rows(store: StackStore) -> Rows:
    """Count the shots whose verdict is a success, and list the others by their verdict."""
    shots: dict[str, list[str]] = {}
    for name, report in zip(store.names, store.reports(), strict=True):
        if "verdict" in report:
            shots.setdefault(str(report["verdict"]), []).append(name)
    if not shots:
        return []
    shots = {Verdict.DETERMINED.value: [], **shots}
    listed = [f"{len(shots[each])} {each}" for each in shots if _is_success(each)]
    doubtful = {verdict: names for verdict, names in shots.items() if not _is_success(verdict)}
    warnings = (f"{len(n)} {verdict}: {_list_text(n)}" for verdict, n in doubtful.items())
    return [("verdicts", ", ".join(listed)), *(("warning", text) for text in warnings)]


@as_file_errors
def status_tables(path: Path, every: bool, verify: bool = False) -> tuple[list[Table], bool]:
    """Describe a store and each shot, and return whether anything is damaged.

    With `verify`, read all files and compare them with their checksums.
    """
    store = StackStore(path, every_byte=verify)
    rows = store_rows(store, trouble=not every)
    if verify:
        count = len(store.damage.shots) + len(store.damage.files)
        text = f"{count} do not match" if count else "all files match"
        rows.append(("checksums", text))
    tables = [two_columns(str(path), rows)]
    is_damaged = bool(store.damage.shots or store.damage.files)
    if not every:
        return tables, is_damaged
    listed = _column_table(store, [column for column in store.columns if column.format])
    # A column of the table above would leave them a few letters a line.
    notes: Rows = []
    for index, report in enumerate(store.reports()):
        cautions = map(Caution.from_json, report.get("warnings", ()))
        reason = report.get("reason")
        texts = [reason] if reason else [caution.text for caution in cautions]
        notes += [(f"shot {index}", text) for text in texts]
    tables += [listed, *([two_columns("Reasons and warnings", notes)] if notes else [])]
    return tables, is_damaged


def _column_table(store: StackStore, columns: Sequence[ShotColumn]) -> Table:
    shots = Table(box=box.SIMPLE, pad_edge=False)
    for heading in ("shot", "name"):
        shots.add_column(heading, overflow="fold")
    for column in columns:
        shots.add_column(column.title, overflow="fold", min_width=column.width or None)
    for index, (status, report) in enumerate(zip(store.statuses(), store.reports(), strict=True)):
        shots.add_row(
            str(index),
            plain(store.names[index]),
            *(
                STATUS_NAMES[status]
                if column.key == "verdict" and status != DONE
                else plain(column.text(report))
                for column in columns
            ),
            style="red" if status in (FAILED, DAMAGED) else "",
        )
    return shots


def store_rows(store: StackStore, *, trouble: bool = True) -> Rows:
    """Describe a store."""
    attributes = store.attributes
    seconds = [report["seconds"] for report in store.reports() if "stages" in report]
    fit = {}
    if store.field is not None:
        fit = {**json.loads(attributes["fit"]), "fields": json.loads(attributes["fields"])}
    rows = [
        ("kind", f"stack of {len(store.names)} shots, shadowinv {attributes['package_version']}"),
        ("created", str(attributes["created"])),
        ("shots", _counts_text(store)),
        ("image", str(attributes["image_size"])),
        *_recipe_rows(store),
        *_beam_rows(store),
        ("stored", str(attributes["stored"])),
        *([("fit", options_text(fit))] if fit else []),
        ("options", options_text(json.loads(attributes["options"]))),
        *_site_rows(store),
    ]
    if seconds:
        mean = sum(seconds) / len(seconds)
        rows.append(("time per shot", f"{mean:.2f} s on one worker, on average"))
    return rows + (_trouble_rows(store) if trouble else [])


@dataclass
class _WatchPrinter:
    """Printer of the shots, with the latest status of the run."""

    folder: Path
    pattern: str
    quiet: bool
    out: Console
    err: Console
    status: RunStatus | None = None
    warned: set[str] = field(default_factory=set)
    is_watching: bool = False

    def update(self, status: RunStatus) -> None:
        self.status = status
        if self.quiet:
            return
        if status.note or status.stage:
            text = status.note or f"{status.stage[:1].upper()}{status.stage[1:]}"
            self._print(self.err, text, "dim")
        elif status.outcome is not None:
            self._print_shot(status)
        elif not self.is_watching:
            self.is_watching = True
            skipped = f", {status.skipped} skipped" if status.skipped else ""
            counts = f"{status.done} done, {status.failed} failed{skipped}; "
            counts = counts if status.total else ""
            names = "images" if self.pattern == "*" else self.pattern
            self._print(
                self.out, f"Watching {self.folder} for {names}; {counts}press Ctrl-C to stop."
            )

    def _print_shot(self, status: RunStatus) -> None:
        outcome = status.outcome
        assert outcome is not None
        name = f"{status.name} (again, as the file has changed)" if status.again else status.name
        waiting = f"  {status.waiting} waiting" if status.waiting else ""
        waiting += f"  {status.skipped} skipped" if status.skipped else ""
        if outcome.reason:
            self._print(self.err, f"failed: {name}: {outcome.reason}", "red")
            return
        result = status.result
        assert result is not None
        summary = "  ".join(fact.short for fact in result.facts if fact.short)
        summary = f"  {summary}  {outcome.seconds:.2f} s{waiting}"
        # A verdict that is no success implies its warnings.
        if result.verdict.level.is_success and (count := len(result.cautions)):
            summary += f", {count} warning{'s' if count > 1 else ''}"
        columns = max(_LINE_COLUMNS - len(summary), _MIN_NAME_COLUMNS)
        if len(name) > columns:  # its end identifies the file
            name = f"…{name[1 - columns :]}"
        is_success = result.headline.level.is_success
        self._print(self.out, f"{name}{summary}", "" if is_success else "yellow")
        for warning in result.cautions:
            if warning.code not in self.warned:
                self.warned.add(warning.code)
                self._print(self.err, f"warning: {status.name}: {warning.text}", "yellow")

    def _print(self, console: Console, text: str, style: str = "") -> None:
        console.print(plain(text, style), soft_wrap=True, highlight=False)


def run_watch(
    folder: Path,
    out: Path,
    watch: WatchOptions,
    *,
    recipe: Recipe,
    reader: Callable[..., ArrayLike],
    quiet: bool,
) -> None:
    """Watch a folder; print a line for each shot and a summary."""
    from napari_shadowinv.stack import RunStatus, watch_stack

    printer = _WatchPrinter(folder, watch.pattern, quiet, Console(), Console(stderr=True))
    with suppress(KeyboardInterrupt, InversionCancelled):
        watch_stack(
            folder,
            out,
            recipe,
            reader=reader,
            watch=watch,
            on_progress=printer.update,
            should_stop=is_interrupted,
        )
    status = printer.status or RunStatus()
    done, failed, waiting = status.done, status.failed, status.waiting
    remaining = f", {status.skipped} skipped" if status.skipped else ""
    remaining += f", {waiting} not yet inverted" if waiting else ""
    if not done:
        text = f"Stopped: {failed} failed" if failed else "Stopped: no shots"
        text = f"{text}{remaining}; repeat the command to watch again."
    else:
        text = f"Stopped: {done} done, {failed} failed{remaining}"
        text = f"{text}; repeat the command to continue {out}."
    if is_interrupted() and waiting:
        say_on_stderr(text)
        raise typer.Exit(cancel_exit_code())
    if not quiet:
        say(text)
    if done:
        exit_unless_reliable(StackStore(out))
    elif failed or waiting:
        raise typer.Exit(EXIT_FAILED_SHOTS)
