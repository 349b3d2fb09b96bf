"""`shadowinv batch` and `shadowinv status`: a run seen live, and what became of each shot."""

from __future__ import annotations

import functools
import json
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import typer
from rich import box, progress
from rich.console import Console
from rich.table import Column, Table

from napari_shadowinv._system.safety import refusing_damage
from napari_shadowinv.cli._tables import Rows, options_text, two_columns
from napari_shadowinv.cli._terminal import (
    EXIT_CANCELLED,
    EXIT_NOT_CONVERGED,
    interrupted,
    plain,
    say,
    say_on_stderr,
)
from napari_shadowinv.errors import InputError, InversionCancelled
from napari_shadowinv.io.store import DONE, FAILED, STATUS_NAMES, StackStore, check_store_path

if TYPE_CHECKING:
    from napari_shadowinv.stack import RunProgress

EXIT_FAILED_SHOTS = 1
_NAMED = 10  # failures that a table names


@dataclass
class _Ledger:
    """What a run has reported so far."""

    start: float = field(default_factory=time.monotonic)
    now: RunProgress | None = None
    ended: int = 0

    def note(self, news: RunProgress) -> None:
        if self.now is None:
            self.start = time.monotonic()  # the workers are there
        self.now = news
        if news.outcome is not None:
            self.ended += 1

    @property
    def rate_text(self) -> str:
        seconds = time.monotonic() - self.start
        if not self.ended:
            return "no shot ended"
        rate = self.ended / seconds
        return f"{rate:.1f} shots/s" if rate >= 1 else f"{60 * rate:.1f} shots/min"

    @property
    def remaining_text(self) -> str:
        if self.now is None or not self.ended:
            return ""
        pending = self.now.total - self.now.done - self.now.failed
        seconds = round(pending * (time.monotonic() - self.start) / self.ended)
        return f"{timedelta(seconds=seconds)} left" if pending else "closing"


def run_batch(
    shots: list[str],
    out: Path,
    *,
    channel: str | None,
    variable: str | None,
    variables: str | None,
    resume: bool,
    quiet: bool,
    **choices: Any,
) -> None:
    """Invert all shots into a store, with `choices` of `run_stack`, and tell how it went."""
    from napari_shadowinv.stack import STORED, read_shot, run_stack

    _check(out, resume or choices["redo_failed"], choices["overwrite"])
    ledger = _Ledger()
    part: dict[str, Any] = {"channel": channel}
    if variable is not None:
        part["variable"] = variable
    try:
        with _display(ledger, quiet) as show:
            run_stack(
                shots[0] if len(shots) == 1 else shots,
                out,
                variables=STORED if variables is None else _names(variables),
                reader=functools.partial(read_shot, **part),
                on_progress=show,
                should_stop=interrupted,
                **choices,
            )
    except (KeyboardInterrupt, InversionCancelled):
        state = _counts_text(StackStore(out)) if out.exists() else "nothing written"
        say_on_stderr(f"Cancelled: {state}. Repeat the command with --resume to continue.")
        raise typer.Exit(EXIT_CANCELLED) from None
    store = StackStore(out)
    if not quiet:
        say(_summary(store, ledger))
    if (store.statuses() != DONE).any():
        raise typer.Exit(EXIT_FAILED_SHOTS)
    if not all(report.get("converged") for report in store.reports()):
        raise typer.Exit(EXIT_NOT_CONVERGED)


def _check(out: Path, resume: bool, overwrite: bool) -> None:
    if resume and overwrite:
        raise InputError("got --resume and --overwrite, expected one of them")
    if check_store_path(out).exists() and not (resume or overwrite):
        raise InputError(
            f"{out} exists ({_counts_text(StackStore(out))}): use --resume to continue, "
            "--overwrite to start again, or another name"
        )


def _names(text: str) -> tuple[str, ...]:
    return tuple(name.strip() for name in text.split(",") if name.strip())


@contextmanager
def _display(ledger: _Ledger, quiet: bool) -> Iterator[Callable[[RunProgress], None]]:
    """A bar with rate and time left, and above it each shot that failed."""
    console = Console(stderr=True)
    columns = (
        progress.SpinnerColumn(),
        progress.TextColumn("{task.description}", markup=False),
        progress.BarColumn(),
        progress.MofNCompleteColumn(),
        progress.TextColumn("{task.fields[rate]}"),
        progress.TextColumn("{task.fields[left]}"),
        progress.TextColumn("{task.fields[failed]}", style="red"),
        progress.TextColumn("{task.fields[last]}", style="dim", markup=False),
    )
    hidden = quiet or not console.is_terminal
    with progress.Progress(*columns, console=console, disable=hidden) as bars:
        task = bars.add_task("starting", total=None, rate="", left="", failed="", last="")

        def show(news: RunProgress) -> None:
            if news.compiling:
                bars.update(task, description=f"compiling, {news.compiling}")
                return
            ledger.note(news)
            outcome = news.outcome
            last = "" if outcome is None else f"{news.name}, {outcome.seconds:.1f} s"
            bars.update(
                task,
                description=news.engine,
                total=news.total,
                completed=news.done + news.failed,
                rate=ledger.rate_text,
                left=ledger.remaining_text,
                failed=f"{news.failed} failed" if news.failed else "",
                last=plain(last).plain,
            )
            if outcome is not None and outcome.reason and not quiet:
                line = plain(f"failed: {news.name}: {outcome.reason}", "red")
                console.print(line, soft_wrap=True)

        yield show


def _counts_text(store: StackStore) -> str:
    statuses = store.statuses()
    counts = {name: np.sum(statuses == status) for status, name in enumerate(STATUS_NAMES)}
    return ", ".join(f"{counts[name]} {name}" for name in ("done", "failed", "pending"))


def _summary(store: StackStore, ledger: _Ledger) -> Table:
    seconds = time.monotonic() - ledger.start
    this_run = f"{ledger.ended} shots in {seconds:.1f} s, {ledger.rate_text}"
    rows = [
        ("shots", _counts_text(store)),
        ("this run", this_run if ledger.ended else "nothing to do"),
        *_trouble_rows(store),
        ("written", str(store.path)),
    ]
    return two_columns("Batch", rows)


def _recipe_rows(attributes: Mapping[str, Any]) -> Rows:
    """Where the source came from, and what was done to each shot."""
    from napari_shadowinv.preprocessing import Provenance

    provenance = Provenance.of(attributes)
    measured = None if provenance is None else provenance.source
    source = measured.file if measured is not None else ""
    rows = [("source", source or str(attributes["source_image"]))]
    steps = () if provenance is None else provenance.recipe.steps
    return rows + [("step", step.described) for step in steps]


def _trouble_rows(store: StackStore) -> Rows:
    """Shots that failed, and those that are not to be trusted."""
    statuses = store.statuses()
    failed = [int(index) for index in np.flatnonzero(statuses == FAILED)]
    rows = [
        ("failed", f"{store.names[i]}: {store.report(i).get('reason', 'its report is missing')}")
        for i in failed[:_NAMED]
    ]
    if len(failed) > _NAMED:
        rows.append(
            ("failed", f"and {len(failed) - _NAMED} more: shadowinv status {store.path} --all")
        )
    rough = [
        store.names[index]
        for index, report in enumerate(store.reports())
        if statuses[index] == DONE and not report.get("converged")
    ]
    if rough:
        named = ", ".join(rough[:_NAMED]) + (", …" if len(rough) > _NAMED else "")
        rows.append(("warning", f"{len(rough)} shots did not converge: {named}"))
    return rows


@refusing_damage
def status_tables(path: Path, every: bool) -> list[Table]:
    """Tell what a store is, and what became of each shot."""
    tables = [two_columns(str(path), store_rows(path, trouble=not every))]
    if not every:
        return tables
    store = StackStore(path)
    headings = "shot", "name", "status", "seconds", "iterations", "image residual", "how it went"
    shots = Table(*(Column(heading, overflow="fold") for heading in headings), box=box.SIMPLE)
    for index, (status, report) in enumerate(zip(store.statuses(), store.reports(), strict=True)):
        shots.add_row(
            str(index),
            plain(store.names[index]),
            STATUS_NAMES[status],
            f"{report['seconds']:.1f}" if "seconds" in report else "",
            plain(report.get("iterations", "")),
            f"{report['image_residual']:.2%}" if "image_residual" in report else "",
            plain(report.get("reason") or "; ".join(report.get("warnings", ()))),
            style="red" if STATUS_NAMES[status] == "failed" else "",
        )
    return [*tables, shots]


@refusing_damage
def store_rows(path: Path, *, trouble: bool = True) -> Rows:
    store = StackStore(path)
    attributes = store.attributes
    seconds = [report["seconds"] for report in store.reports() if "stages" in report]
    rows = [
        ("kind", f"stack of {len(store.names)} shots, shadowinv {attributes['package_version']}"),
        ("created", str(attributes["created"])),
        ("shots", _counts_text(store)),
        ("image", str(attributes["image_size"])),
        *_recipe_rows(attributes),
        ("stored", str(attributes["stored"])),
        ("options", options_text(json.loads(attributes["options"]))),
    ]
    if seconds:
        mean = sum(seconds) / len(seconds)
        rows.append(("time per shot", f"{mean:.2f} s on one worker, on average"))
    return rows + (_trouble_rows(store) if trouble else [])
