"""Repeated results as `shadowinv rerun` writes and prints them."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from napari_shadowinv.cli import _outputs
from napari_shadowinv.cli._summary import (
    Rows,
    fact_rows,
    headline_row,
    size_text,
    two_columns,
    written_rows,
)
from napari_shadowinv.cli._terminal import exit_unless_converged
from napari_shadowinv.fitting import Fit
from napari_shadowinv.inversion import Inversion

if TYPE_CHECKING:
    from rich.table import Table

    from napari_shadowinv.pipeline.rerun import Rerun, RerunInputs


def check_rerun(
    inputs: RerunInputs, result: Path, out: Path, figure: Path, overwrite: bool
) -> None:
    """Refuse, before any work, outputs that cannot be written or would replace an input."""
    from napari_shadowinv.cli._static_result import static_figures
    from napari_shadowinv.io.formats import FIGURE_SUFFIXES, FIT_WRITERS, PACK_WRITERS

    writers = {"fit": FIT_WRITERS, "film pack": PACK_WRITERS}.get(inputs.provenance.kind)
    if writers is not None:
        _outputs.check_outputs({out: tuple(writers)}, overwrite)
    figures = static_figures(figure, left_out=inputs.has_left_out, window=inputs.window)
    _outputs.check_outputs(dict.fromkeys(figures, FIGURE_SUFFIXES), overwrite)
    _outputs.protect([out, figure, *figures], [result, *inputs.files])


def write_rerun(
    again: Rerun, inputs: RerunInputs, result: Path, out: Path, figure: Path, overwrite: bool
) -> None:
    """Write a repeated result with its figures, all or none."""
    from napari_shadowinv.cli._film_command import write_pack
    from napari_shadowinv.cli._fit_result import write_fit

    if isinstance(again.content, Inversion):
        image: Any = inputs.shots[0].image
        _outputs.write_inversion(again.content, image, out, figure, overwrite)
    elif isinstance(again.content, Fit):
        names = [str(file) for file in inputs.files[: len(inputs.shots)]]
        write_fit(again.content, names, out, figure, overwrite, again.checks)
    else:
        write_pack(again.content, result.name, out, figure, overwrite)


def rerun_table(again: Rerun, inputs: RerunInputs, written: list[Path]) -> Table:
    """Build the table of a repeated result: the changes since the first one."""
    content = again.content
    changes: Rows = [("changed", text) for text in again.changes or ("nothing",)]
    rows = [*changes, ("difference", again.difference)]
    if isinstance(content, Inversion):
        image = ("image", f"{inputs.files[0]}, {size_text(content.image)}")
        rows = [headline_row(content, content.setup), image, *rows, *fact_rows(content.facts)]
    elif isinstance(content, Fit):
        names = [(f"image {k + 1}", str(inputs.files[k])) for k in range(len(inputs.shots))]
        rows = [*names, *rows, ("verdict", str(content.verdict))]
    return two_columns("Rerun", [*rows, *written_rows(written)])


def exit_unless_sound(again: Rerun, out: Path) -> None:
    """Exit with an error code if an inversion did not converge or a fit is not determined."""
    from napari_shadowinv.cli._fit_result import exit_unless_determined
    from napari_shadowinv.cli._static_result import exit_unless_static

    if isinstance(again.content, Inversion):
        exit_unless_converged(again.content.report, out)
    elif isinstance(again.content, Fit):
        exit_unless_static(again.checks, out)
        exit_unless_determined(again.content, out)
