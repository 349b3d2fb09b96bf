"""`shadowinv batch` and `shadowinv status`: a run seen live, and what became of each shot."""

from __future__ import annotations

import functools
import json
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
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
from napari_shadowinv.cautions import Caution
from napari_shadowinv.cli._summary import Rows, options_text, two_columns
from napari_shadowinv.cli._terminal import (
    EXIT_NOT_CONVERGED,
    cancelled_code,
    interrupted,
    plain,
    say,
    say_on_stderr,
)
from napari_shadowinv.errors import InputError, InversionCancelled
from napari_shadowinv.io.store import (
    DAMAGED,
    DONE,
    FAILED,
    STATUS_NAMES,
    StackStore,
    check_store_path,
)

if TYPE_CHECKING:
    from napari_shadowinv.stack import RunProgress

EXIT_FAILED_SHOTS = 1
_BAR_COLUMNS = 16
_NAMED = 10  # failures that a table names
_DETERMINED = "determined"  # the verdict on a fit that may be believed


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
    from napari_shadowinv.stack import read_shot, run_stack

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
                variables=None if variables is None else names_of(variables),
                reader=functools.partial(read_shot, **part),
                on_progress=show,
                should_stop=interrupted,
                **choices,
            )
    except (KeyboardInterrupt, InversionCancelled):
        state = _counts_text(StackStore(out)) if out.exists() else "nothing written"
        say_on_stderr(f"Cancelled: {state}. Repeat the command with --resume to continue.")
        raise typer.Exit(cancelled_code()) from None
    store = StackStore(out)
    if not quiet:
        say(_summary(store, ledger))
    exit_unless_good(store)


def exit_unless_good(store: StackStore) -> None:
    """End with an exit code of its own if not all shots are done, or to be trusted."""
    if (store.statuses() != DONE).any():
        raise typer.Exit(EXIT_FAILED_SHOTS)
    if not all(_is_good(report) for report in store.reports()):
        raise typer.Exit(EXIT_NOT_CONVERGED)


def names_of(text: str) -> tuple[str, ...]:
    """Names that are separated by commas."""
    return tuple(name.strip() for name in text.split(",") if name.strip())


def _is_good(report: Mapping[str, Any]) -> bool:
    """Whether a shot that is done may be believed, as far as that is known."""
    if "verdict" in report:
        return bool(report["verdict"] == _DETERMINED)
    return bool(report.get("converged"))


def _check(out: Path, resume: bool, overwrite: bool) -> None:
    if resume and overwrite:
        raise InputError("got --resume and --overwrite, expected one of them")
    if check_store_path(out).exists() and not (resume or overwrite):
        raise InputError(
            f"{out} exists ({_counts_text(StackStore(out))}): use --resume to continue, "
            "--overwrite to start again, or another name"
        )


def progress_columns() -> tuple[progress.ProgressColumn, ...]:
    """Columns of the progress line; in a narrow terminal the last shot's name is cut."""
    cut = Column(ratio=1, no_wrap=True, overflow="ellipsis")
    kept = Column(no_wrap=True)
    return (
        progress.SpinnerColumn(),
        progress.TextColumn("{task.description}", markup=False, table_column=kept),
        progress.BarColumn(bar_width=_BAR_COLUMNS),
        progress.MofNCompleteColumn(table_column=kept),
        progress.TextColumn("{task.fields[rate]}", table_column=kept),
        progress.TextColumn("{task.fields[left]}", table_column=kept),
        progress.TextColumn("{task.fields[failed]}", style="red", table_column=kept),
        progress.TextColumn("{task.fields[last]}", style="dim", markup=False, table_column=cut),
    )


@contextmanager
def _display(ledger: _Ledger, quiet: bool) -> Iterator[Callable[[RunProgress], None]]:
    """A bar with rate and time left, and above it each shot that failed."""
    console = Console(stderr=True)
    hidden = quiet or not console.is_terminal
    with progress.Progress(
        *progress_columns(), console=console, disable=hidden, expand=True
    ) as bars:
        task = bars.add_task("starting", total=None, rate="", left="", failed="", last="")

        def show(news: RunProgress) -> None:
            if news.preparing:
                bars.update(task, description=news.preparing)
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
    shown = ["done", "failed", "pending", *(["damaged"] if counts["damaged"] else [])]
    return ", ".join(f"{counts[name]} {name}" for name in shown)


def _summary(store: StackStore, ledger: _Ledger) -> Table:
    seconds = time.monotonic() - ledger.start
    this_run = f"{ledger.ended} shots in {seconds:.1f} s, {ledger.rate_text}"
    rows = [
        ("shots", _counts_text(store)),
        ("this run", this_run if ledger.ended else "nothing to do"),
        *_site_rows(store),
        *_trouble_rows(store),
        ("written", str(store.path)),
    ]
    return two_columns("Batch", rows)


def _recipe_rows(store: StackStore) -> Rows:
    """Where the source came from, and what was done to each shot."""
    from napari_shadowinv.preprocessing import Provenance

    provenance = Provenance.of(store.attributes)
    measured = None if provenance is None else provenance.source
    source = measured.file if measured is not None else ""
    # Rows of a table may have their own.
    made = [report.get("provenance", {}).get("source", {}) for report in store.reports()]
    own = list(dict.fromkeys(one["file"] for one in made if one.get("file")))
    rows = [("source", _listed(own) or source or str(store.attributes["source_image"]))]
    steps = () if provenance is None else provenance.recipe.steps
    return rows + [("step", step.described) for step in steps]


def _energy_rows(store: StackStore) -> Rows:
    """Energies of the shots that are done, where they are those of rows of a table."""
    found = sorted({report["energy"] for report in store.reports() if "energy" in report})
    return [("energies", f"{', '.join(f'{one:g}' for one in found)} MeV")] if found else []


def _fit_rows(attributes: Mapping[str, Any]) -> Rows:
    """What was fitted to each shot."""
    choices = {**json.loads(attributes["fit"]), "fields": json.loads(attributes["fields"])}
    return [("fit", options_text(choices))]


def _site_rows(store: StackStore) -> Rows:
    """How many sites the shots have, and why; and what errors are typical."""
    reports = [report for report in store.reports() if "n_sites" in report]
    if not reports:
        return []
    counts = sorted({report["n_sites"] for report in reports})
    least, most = f"{counts[0]:,}", f"{counts[-1]:,}"
    reasons = dict.fromkeys(report.get("sites_reason") or "as given" for report in reports)
    reason = next(iter(reasons)) if len(reasons) == 1 else "each for its own reason"
    rows = [("sites", f"{least if least == most else f'{least} to {most}'}; {reason}")]
    errors = [report["errors"] for report in reports if report.get("errors")]
    told = [
        f"{name} {np.median(values):.2g} px"
        for name in ("noise", "discretisation")
        if (values := [one[name][0] for one in errors if np.isfinite(one[name][0])])
    ]
    if told:
        rows.append(("errors", f"{', '.join(told)} (r.m.s., median of the shots)"))
    return rows


def _trouble_rows(store: StackStore) -> Rows:
    """Shots that failed or are damaged, and those that are not to be trusted."""
    statuses = store.statuses()
    rows = []
    for status in (FAILED, DAMAGED):
        label = STATUS_NAMES[status]
        indices = [int(index) for index in np.flatnonzero(statuses == status)]
        rows += [
            (label, f"{store.names[i]}: {store.report(i).get('reason', 'its report is missing')}")
            for i in indices[:_NAMED]
        ]
        if len(indices) > _NAMED:
            rest = len(indices) - _NAMED
            rows.append((label, f"and {rest} more: shadowinv status {store.path} --all"))
    rows += [(STATUS_NAMES[DAMAGED], problem) for problem in store.damage.files[:_NAMED]]
    if store.damage.shots or store.damage.files:
        rows.append(("warning", "repeat the run with --resume to repair what is damaged"))
    rough = [
        store.names[index]
        for index, report in enumerate(store.reports())
        if statuses[index] == DONE and not report.get("converged")
    ]
    if rough:
        rows.append(("warning", f"{len(rough)} shots did not converge: {_listed(rough)}"))
    return [*rows, *_verdict_rows(store), *_level_rows(store)]


def _level_rows(store: StackStore) -> Rows:
    """Count the shots of each level of trust, and list each kind of warning with its shots."""
    levels: Counter[str] = Counter()
    warned: dict[str, tuple[str, list[str]]] = {}
    for name, report in zip(store.names, store.reports(), strict=True):
        if "level" not in report:
            continue
        levels[report["level"]] += 1
        for caution in map(Caution.from_json, report.get("warnings", ())):
            key = caution.text if caution.code == "other" else caution.code
            warned.setdefault(key, (caution.text, []))[1].append(name)
    if not levels:
        return []
    counts = ", ".join(f"{count} {level}" for level, count in levels.most_common())
    return [
        ("levels", counts),
        *[("warning", f"{_listed(names)}: {warning}") for warning, names in warned.values()],
    ]


def _listed(names: Sequence[str]) -> str:
    return ", ".join(names[:_NAMED]) + (", …" if len(names) > _NAMED else "")


def _verdict_rows(store: StackStore) -> Rows:
    """Which fits may be believed, and which not."""
    found: dict[str, list[str]] = {}
    for name, report in zip(store.names, store.reports(), strict=True):
        if "verdict" in report:
            found.setdefault(str(report["verdict"]), []).append(name)
    good = found.pop(_DETERMINED, [])
    told = f"{len(good)} {_DETERMINED}"
    rows = [("verdicts", told)] if good or found else []
    return rows + [
        ("warning", f"{len(names)} {verdict}: {_listed(names)}") for verdict, names in found.items()
    ]


_SHOT_COLUMNS: dict[str, tuple[str, Callable[[Any], str]]] = {
    "iterations": ("iterations", str),
    "image residual": ("image_residual", "{:.2%}".format),
}
_ROW_COLUMNS = {"MeV": ("energy", "{:g}".format), **_SHOT_COLUMNS}
_FIT_COLUMNS: dict[str, tuple[str, Callable[[Any], str]]] = {
    "verdict": ("verdict", str),
    "χ²": ("chi2", "{:.3g}".format),
    "crossed": ("folded", "{:.1%}".format),
    "error bars": ("uncertainty", "{:.2%}".format),
}


@refusing_damage
def status_tables(path: Path, every: bool, verify: bool = False) -> tuple[list[Table], bool]:
    """Describe a store and what became of each shot, and return whether anything is damaged.

    With `verify`, all files are read and compared with their checksums.
    """
    store = StackStore(path, every_byte=verify)
    rows = store_rows(store, trouble=not every)
    if verify:
        rows.append(("checksums", _checksums_text(store)))
    tables = [two_columns(str(path), rows)]
    is_damaged = bool(store.damage.shots or store.damage.files)
    if not every:
        return tables, is_damaged
    own = _ROW_COLUMNS if store.own_setups else _SHOT_COLUMNS
    columns = own if store.field is None else _FIT_COLUMNS
    headings = "shot", "name", "status", "seconds", *columns
    shots = Table(box=box.SIMPLE)
    for heading in headings:
        # Wide enough for the words of a verdict.
        width = len(_DETERMINED) if heading == "verdict" else None
        shots.add_column(heading, overflow="fold", min_width=width)
    for index, (status, report) in enumerate(zip(store.statuses(), store.reports(), strict=True)):
        shots.add_row(
            str(index),
            plain(store.names[index]),
            STATUS_NAMES[status],
            f"{report['seconds']:.1f}" if "seconds" in report else "",
            *(show(report[key]) if key in report else "" for key, show in columns.values()),
            style="red" if status in (FAILED, DAMAGED) else "",
        )
    # In the table above they would be squeezed into a few letters a line.
    notes = [(f"shot {index}", note) for index, note in _notes(store)]
    tables += [shots, *([two_columns("Reasons and warnings", notes)] if notes else [])]
    return tables, is_damaged


def _notes(store: StackStore) -> Iterator[tuple[int, str]]:
    """The reason of each failed shot, the warnings of the others."""
    for index, report in enumerate(store.reports()):
        if reason := report.get("reason"):
            yield index, reason
            continue
        cautions = map(Caution.from_json, report.get("warnings", ()))
        yield from ((index, caution.text) for caution in cautions)


def _checksums_text(store: StackStore) -> str:
    if not store.has_checksums:
        return "none: the store was written by an earlier version, and damage cannot be noticed"
    count = len(store.damage.shots) + len(store.damage.files)
    return f"{count} do not match" if count else "all files match"


def store_rows(store: StackStore, *, trouble: bool = True) -> Rows:
    """Describe a store in names and texts."""
    attributes = store.attributes
    seconds = [report["seconds"] for report in store.reports() if "stages" in report]
    rows = [
        ("kind", f"stack of {len(store.names)} shots, shadowinv {attributes['package_version']}"),
        ("created", str(attributes["created"])),
        ("shots", _counts_text(store)),
        ("image", str(attributes["image_size"])),
        *_recipe_rows(store),
        *_energy_rows(store),
        ("stored", str(attributes["stored"])),
        *([] if store.field is None else _fit_rows(attributes)),
        ("options", options_text(json.loads(attributes["options"]))),
        *_site_rows(store),
    ]
    if seconds:
        mean = sum(seconds) / len(seconds)
        rows.append(("time per shot", f"{mean:.2f} s on one worker, on average"))
    return rows + (_trouble_rows(store) if trouble else [])
