"""Files that a command writes, and the end of its work: `Outputs`.

Their names are chosen and checked before the work. Afterwards they are written and listed below the
facts of the result, and a result that is not sound ends the command with an exit code.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from typer import Exit, Option

from napari_shadowinv._system.safety import resolved_path
from napari_shadowinv.cli._summary import Rows, two_columns
from napari_shadowinv.cli._terminal import (
    EXIT_NOT_CONVERGED,
    say,
    say_on_stderr,
)
from napari_shadowinv.errors import InputError
from napari_shadowinv.facts import ResultKind, Verdict, to_figures
from napari_shadowinv.io.files import split_address
from napari_shadowinv.io.formats import FIGURE_SUFFIXES, PNG, PRADFORMAT, RESULT, suffixes_for
from napari_shadowinv.physics.beam import setup_cautions

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from napari_shadowinv.physics.setup import Setup
    from napari_shadowinv.preprocessing import Recipe
    from napari_shadowinv.results import AnyResult

_NOT_CONVERGED, _BAD_SAMPLES = "not converged", "unreliable error bars"
Output = tuple[Path | None, tuple[str, ...]]
"""A file, or None, and the endings that it may have."""


@dataclass
class Outputs:
    """Files of a command, with its flags about all that it writes and prints."""

    overwrite: Annotated[bool, Option("--overwrite", help="Replace existing files.")] = False
    quiet: Annotated[bool, Option("--quiet", "-q", help="Print errors and warnings only.")] = False
    files: list[Path] = field(default_factory=list, init=False)  # to write

    def check(self, outputs: Iterable[Output], inputs: Iterable[Path | None]) -> None:
        """Add files to be written; refuse, before any work, one that cannot be, or is read."""
        from napari_shadowinv.io import check_output

        for path, suffixes in outputs:
            if path is not None:
                check_output(path, self.overwrite, suffixes=suffixes)
                self.files.append(path)
        self.protect(inputs)

    def check_result(
        self,
        kind: ResultKind,
        result: Path,
        figure: Path,
        *,
        recipe: Path | None = None,
        inputs: Iterable[Path | None] = (),
    ) -> None:
        """Add a result with its figure and its recipe, as `check` does."""
        page = figure, FIGURE_SUFFIXES
        self.check([(result, suffixes_for(kind)), page, (recipe, (".toml",))], inputs)

    def protect(self, inputs: Iterable[Path | None]) -> None:
        """Refuse to overwrite an input, even with --overwrite, or to write a file twice."""
        sources = {resolved_path(split_address(file)[0]) for file in inputs if file is not None}
        targets: set[Path] = set()
        for path in self.files:
            file = resolved_path(path)
            if file in sources:
                text = f"{path} is both read and written: choose another name for the output"
                raise InputError(text)
            if file in targets:
                raise InputError(f"{path} would be written twice: choose two names")
            targets.add(file)

    def protect_files_of(self, recipe: Recipe) -> None:
        """Refuse to overwrite a file that a recipe names."""
        self.protect([recipe.mask, recipe.source_mask, getattr(recipe.source, "file", None)])

    def warn_of_setups(
        self, experiments: Iterable[tuple[Setup | None, tuple[int, int] | None]]
    ) -> None:
        """Print the doubts about setups and their images' shapes, before the work begins."""
        texts = dict.fromkeys(
            caution.text
            for setup, shape in experiments
            if setup is not None
            for caution in setup_cautions(setup, shape)
        )
        for text in texts:
            say_on_stderr(text, "yellow")

    def write_result(
        self,
        result: AnyResult,
        names: Sequence[str],
        out: Path,
        figure: Path,
    ) -> None:
        """Write a result, then its figure, whose title is the names of its files."""
        from napari_shadowinv.io import write
        from napari_shadowinv.io.files import name_of
        from napari_shadowinv.plotting import result_figure

        title = ", ".join(name_of(name) for name in names)
        write(out, result, overwrite=self.overwrite)
        self.write_figures({figure: partial(result_figure, result, title=title)})

    def write_figures(self, figures: Mapping[Path, Callable[[], Figure]]) -> None:
        """Draw and write figures."""
        from napari_shadowinv.plotting import save_figure

        for path, draw in figures.items():
            save_figure(path, draw(), self.overwrite)

    def show(self, title: str, rows: Rows) -> None:
        """Print facts, and below them the files that were written."""
        if not self.quiet:
            written = [("written", str(path)) for path in self.files]
            say(two_columns(title, [*rows, *written]))

    def exit_unless_sound(self, result: Any, out: Path) -> None:
        """Exit with an error code if a result has a flaw."""
        doubts = {each.code: each.text for each in result.cautions}
        is_inversion = result.kind is ResultKind.INVERSION
        verdict = None if is_inversion else getattr(result, "verdict", None)
        flaw = flaw_of(not is_inversion or result.report.converged, verdict, doubts)
        if not flaw:
            return
        reason = doubts["samples"] if flaw == _BAD_SAMPLES else getattr(result, "explanation", "")
        if flaw == _NOT_CONVERGED:
            reason = (
                f"its flux residual is {to_figures(result.report.residual)} (tolerance "
                f"{to_figures(result.report.tolerance)}): do not trust the field"
            )
        say_on_stderr(f"{flaw.upper()}: {out} was written, but {reason}")
        raise Exit(EXIT_NOT_CONVERGED)


def flaw_of(converged: bool, verdict: str | None, codes: Collection[str]) -> str:
    """Return the flaw by which a shot's result ends its command with an error code, or "".

    An inversion has to converge, and has no `verdict` here; the field of a fit has to be known.
    """
    if not converged:
        return _NOT_CONVERGED
    if verdict is not None and not Verdict(verdict).level.is_success:
        return verdict
    return _BAD_SAMPLES if "samples" in codes else ""


def result_and_figure(image: Path, out: Path | None, figure: Path | None) -> tuple[Path, Path]:
    """Choose the names of result and figure; the figure never replaces the image."""
    image, _ = split_address(image)
    if not image.stem:
        raise InputError(f"{image} is a folder: expected an image; give the name of a file")
    result = Path(f"{image.stem}{RESULT.suffix}") if out is None else out
    if figure is not None:
        return result, figure
    figure = figure_beside(result)
    if resolved_path(figure) == resolved_path(image):
        figure = result.with_name(f"{result.stem}_report{PNG.suffix}")
    return result, figure


def figure_beside(result: Path) -> Path:
    """Name a figure after a result, which must have a name itself."""
    if not result.name:
        raise InputError(f"{result} is a folder: expected the name of a file; add it to --out")
    return result.with_suffix(PNG.suffix)


def check_setup(result: Path, setup: Setup | None, fields: Sequence[str] | None = None) -> None:
    """Refuse a setup, or fields, that the result's format cannot store."""
    from napari_shadowinv.io.pradformat import check_pradformat_fields, check_pradformat_setup

    if result.suffix.lower() in PRADFORMAT.suffixes:
        check_pradformat_setup(setup)
        check_pradformat_fields(fields or ())
