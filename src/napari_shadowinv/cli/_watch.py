"""`shadowinv watch`: a line for each shot, and how it ended."""

from __future__ import annotations

import functools
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from napari_shadowinv.cautions import Caution
from napari_shadowinv.cli._batch import EXIT_FAILED_SHOTS, exit_unless_good, names_of
from napari_shadowinv.cli._terminal import (
    cancelled_code,
    interrupted,
    plain,
    say,
    say_on_stderr,
)
from napari_shadowinv.errors import InversionCancelled

if TYPE_CHECKING:
    from rich.console import Console

    from napari_shadowinv.fitting import Fit
    from napari_shadowinv.inversion import Inversion
    from napari_shadowinv.stack import WatchProgress

_WIDTH = 100  # columns of a line
_SHORTEST_NAME = 12


@dataclass
class _Lines:
    """Prints what happens, and remembers how things stand."""

    folder: Path
    pattern: str
    quiet: bool
    out: Console
    err: Console
    now: WatchProgress | None = None
    warned: set[str] = field(default_factory=set)
    is_watching: bool = False

    def show(self, news: WatchProgress) -> None:
        self.now = news
        if self.quiet:
            return
        if news.note or news.preparing:
            text = news.note or f"{news.preparing[:1].upper()}{news.preparing[1:]}"
            self._print(self.err, text, "dim")
        elif news.outcome is not None:
            self._show_shot(news)
        elif not self.is_watching:
            self.is_watching = True
            there = f"{news.done} done, {news.failed} failed; " if news.total else ""
            self._print(
                self.out, f"Watching {self.folder} for {self.pattern}; {there}Ctrl-C ends it."
            )

    def _show_shot(self, news: WatchProgress) -> None:
        outcome = news.outcome
        assert outcome is not None
        name = f"{news.name} (again, as it has changed)" if news.again else news.name
        waiting = f"  {news.waiting} waiting" if news.waiting else ""
        if outcome.reason:
            self._print(self.err, f"failed: {name}: {outcome.reason}", "red")
            return
        assert news.result is not None
        told, doubts = _told(news.result)
        told = f"  {told}  {outcome.seconds:.2f} s{waiting}{doubts}"
        self._print(self.out, f"{_shortened(name, _WIDTH - len(told))}{told}", _style(doubts))
        for warning in _warnings_of(news.result):
            if warning.code not in self.warned:
                self.warned.add(warning.code)
                self._print(self.err, f"warning: {news.name}: {warning.text}", "yellow")

    def _print(self, console: Console, text: str, style: str = "") -> None:
        console.print(plain(text, style), soft_wrap=True, highlight=False)


def _style(doubts: str) -> str:
    return "yellow" if doubts else ""


def _shortened(name: str, room: int) -> str:
    """Name of a file in so many columns; its end tells it apart."""
    room = max(room, _SHORTEST_NAME)
    return name if len(name) <= room else f"…{name[1 - room :]}"


def _warnings_of(result: Inversion | Fit) -> tuple[Caution, ...]:
    from napari_shadowinv.fitting import Fit

    if not isinstance(result, Fit):
        return result.report.warnings
    return () if result.verdict_caution is None else (result.verdict_caution,)


def _told(result: Inversion | Fit) -> tuple[str, str]:
    """Return the numbers of a shot, and what casts doubt on them."""
    from napari_shadowinv.facts import Level
    from napari_shadowinv.inversion import Inversion
    from napari_shadowinv.physics.units import shown_fields, with_error

    if not isinstance(result, Inversion):
        doubts = "" if result.report.converged else "  NOT converged"
        return f"{result.verdict}  χ² {result.chi2.max():.3g}", doubts
    report, errors = result.report, result.errors
    (field,) = shown_fields([result.displacement], result.setup, mask=result.mask)
    error = None if errors is None else errors.of_peak
    peak = with_error(field.largest, error.share if error else 0.0)
    count = len(report.warnings)
    warnings = f", {count} warning{'s' if count > 1 else ''}" if count else ""
    level = "" if result.headline.level is Level.SOUND else f"  {result.headline.level.value}"
    return (
        f"peak {field.symbol} {peak} {field.unit}  residual {100 * report.image_residual:.3g} %",
        f"{'' if report.converged else '  NOT converged'}{level}{warnings}",
    )


def run_watch(
    folder: Path,
    out: Path,
    *,
    channel: str | None,
    variable: str | None,
    variables: str | None,
    pattern: str,
    quiet: bool,
    **choices: Any,
) -> None:
    """Watch a folder with `choices` of `watch_stack`, print a line for each shot, and sum up."""
    from rich.console import Console

    from napari_shadowinv.stack import read_shot, watch_stack

    part: dict[str, Any] = {"channel": channel}
    if variable is not None:
        part["variable"] = variable
    lines = _Lines(folder, pattern, quiet, Console(), Console(stderr=True))
    with suppress(KeyboardInterrupt, InversionCancelled):
        watch_stack(
            folder,
            out,
            pattern=pattern,
            variables=None if variables is None else names_of(variables),
            reader=functools.partial(read_shot, **part),
            on_progress=lines.show,
            should_stop=interrupted,
            **choices,
        )
    _sum_up(lines.now, out, quiet)


def _sum_up(now: WatchProgress | None, out: Path, quiet: bool) -> None:
    from napari_shadowinv.io.store import StackStore

    done, failed, waiting = (0, 0, 0) if now is None else (now.done, now.failed, now.waiting)
    stopped = interrupted() and waiting
    left = f", {waiting} not yet inverted" if waiting else ""
    if not done:
        text = f"Ended: {failed} failed, nothing was written" if failed else "Ended: no shot"
        text = f"{text}{left}; repeat the command to watch again."
    else:
        text = f"Ended: {done} done, {failed} failed{left}; repeat the command to go on with {out}."
    if stopped:
        say_on_stderr(text)
        raise typer.Exit(cancelled_code())
    if not quiet:
        say(text)
    if done:
        exit_unless_good(StackStore(out))
    elif failed:
        raise typer.Exit(EXIT_FAILED_SHOTS)
