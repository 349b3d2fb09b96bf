"""Repeated results as `shadowinv rerun` checks and prints them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from napari_shadowinv.cli import _inputs
from napari_shadowinv.cli._summary import fact_rows, headline_row, two_columns, written_rows
from napari_shadowinv.cli._terminal import exit_unless_converged
from napari_shadowinv.facts import ResultKind

if TYPE_CHECKING:
    from rich.table import Table

    from napari_shadowinv.pipeline.rerun import Rerun, RerunInputs


def check_rerun(
    inputs: RerunInputs, result: Path, out: Path, figure: Path, overwrite: bool
) -> None:
    """Refuse, before any work, outputs that cannot be written or would replace an input."""
    from napari_shadowinv.cli._static_result import static_figures
    from napari_shadowinv.io.formats import FIGURE_SUFFIXES, suffixes_for

    _inputs.check_outputs({out: suffixes_for(inputs.kind)}, overwrite)
    figures = static_figures(figure, left_out=inputs.has_left_out, window=inputs.window)
    _inputs.check_outputs(dict.fromkeys(figures, FIGURE_SUFFIXES), overwrite)
    _inputs.protect([out, figure, *figures], [result, *inputs.files])


def rerun_table(again: Rerun, names: Sequence[str], written: list[Path]) -> Table:
    """Build the table of a repeated result: the changes since the first one, and its facts."""
    rows = [
        *[("file", name) for name in names],
        *[("changed", text) for text in again.changes or ("nothing",)],
        ("difference", again.difference),
        headline_row(again.content.headline),
        *fact_rows(again.content.facts),
        *written_rows(written),
    ]
    return two_columns("Rerun", rows)


def exit_unless_sound(again: Rerun, out: Path) -> None:
    """Exit with an error code if an inversion did not converge or a fit is not determined."""
    from napari_shadowinv.cli._fit_result import exit_unless_determined
    from napari_shadowinv.cli._static_result import exit_unless_static

    exit_unless_static(again.checks, out)
    exits: dict[ResultKind, Callable[[Any, Path], None]] = {
        ResultKind.INVERSION: lambda inversion, out: exit_unless_converged(inversion.report, out),
        ResultKind.FIT: exit_unless_determined,
    }
    exit_unless = exits.get(again.content.kind)
    if exit_unless is not None:
        exit_unless(again.content, out)
