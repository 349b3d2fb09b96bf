"""Output of `shadowinv watch`: a line for each shot, and a summary."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from napari_shadowinv.cli._batch import (
    EXIT_FAILED_SHOTS,
    exit_unless_reliable,
    shot_reader,
)
from napari_shadowinv.cli._terminal import (
    cancel_exit_code,
    is_interrupted,
    plain,
    say,
    say_on_stderr,
)
from napari_shadowinv.errors import InversionCancelled

if TYPE_CHECKING:
    from rich.console import Console

    from napari_shadowinv.fitting import Fit
    from napari_shadowinv.inversion import Inversion
    from napari_shadowinv.pipeline.run_options import WatchOptions
    from napari_shadowinv.preprocessing import Recipe
    from napari_shadowinv.stack import RunStatus

_LINE_COLUMNS = 100
_MIN_NAME_COLUMNS = 12


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
            counts = f"{status.done} done, {status.failed} failed; " if status.total else ""
            self._print(
                self.out,
                f"Watching {self.folder} for {self.pattern}; {counts}press Ctrl-C to stop.",
            )

    def _print_shot(self, status: RunStatus) -> None:
        outcome = status.outcome
        assert outcome is not None
        name = f"{status.name} (again, as the file has changed)" if status.again else status.name
        waiting = f"  {status.waiting} waiting" if status.waiting else ""
        if outcome.reason:
            self._print(self.err, f"failed: {name}: {outcome.reason}", "red")
            return
        assert status.result is not None
        summary, doubts = _shot_summary(status.result)
        summary = f"  {summary}  {outcome.seconds:.2f} s{waiting}{doubts}"
        name = _shorten_name(name, _LINE_COLUMNS - len(summary))
        self._print(self.out, f"{name}{summary}", _style(doubts))
        for warning in status.result.cautions:
            if warning.code not in self.warned:
                self.warned.add(warning.code)
                self._print(self.err, f"warning: {status.name}: {warning.text}", "yellow")

    def _print(self, console: Console, text: str, style: str = "") -> None:
        console.print(plain(text, style), soft_wrap=True, highlight=False)


def _style(doubts: str) -> str:
    return "yellow" if doubts else ""


def _shorten_name(name: str, columns: int) -> str:
    """Cut the start of a long name; its end identifies the file."""
    columns = max(columns, _MIN_NAME_COLUMNS)
    return name if len(name) <= columns else f"…{name[1 - columns :]}"


def _shot_summary(result: Inversion | Fit) -> tuple[str, str]:
    """Return the facts of a shot in a few words, and the doubts about them."""
    from napari_shadowinv.facts import Level

    level, count = result.headline.level, len(result.cautions)
    doubts = "" if level is Level.SOUND else f"  {level}"
    if count:
        doubts += f", {count} warning{'s' if count > 1 else ''}"
    return "  ".join(fact.short for fact in result.facts if fact.short), doubts


def run_watch(
    folder: Path,
    out: Path,
    recipe: Recipe,
    watch: WatchOptions,
    *,
    channel: str | None,
    variable: str | None,
    quiet: bool,
) -> None:
    """Watch a folder; print a line for each shot and a summary."""
    from rich.console import Console

    from napari_shadowinv.stack import watch_stack

    printer = _WatchPrinter(folder, watch.pattern, quiet, Console(), Console(stderr=True))
    with suppress(KeyboardInterrupt, InversionCancelled):
        watch_stack(
            folder,
            out,
            recipe,
            reader=shot_reader(channel, variable),
            watch=watch,
            on_progress=printer.update,
            should_stop=is_interrupted,
        )
    _print_summary(printer.status, out, quiet)


def _print_summary(status: RunStatus | None, out: Path, quiet: bool) -> None:
    from napari_shadowinv.io.store import StackStore

    done, failed, waiting = 0, 0, 0
    if status is not None:
        done, failed, waiting = status.done, status.failed, status.waiting
    remaining = f", {waiting} not yet inverted" if waiting else ""
    if not done:
        text = f"Stopped: {failed} failed, nothing written" if failed else "Stopped: no shots"
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
    elif failed:
        raise typer.Exit(EXIT_FAILED_SHOTS)
