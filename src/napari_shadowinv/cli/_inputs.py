"""Inputs and outputs of a command.

Inputs are a recipe, options, the setup and images. Names of outputs are chosen and checked before
the work, and their files are written after it.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from typer import Exit

from napari_shadowinv._system.safety import resolved_path
from napari_shadowinv.cli._flags import FitFlags, InversionFlags, ShotFlags
from napari_shadowinv.cli._settings import FILE_KEYS, Settings, source_from, with_steps
from napari_shadowinv.cli._terminal import is_interrupted, say_on_stderr
from napari_shadowinv.errors import InputError
from napari_shadowinv.io.files import split_address
from napari_shadowinv.io.formats import FIGURE_SUFFIXES, PNG, PRADFORMAT, RESULT, suffixes_for
from napari_shadowinv.options import FitChoices
from napari_shadowinv.preprocessing import MeasuredSource, Recipe
from napari_shadowinv.shot import Shot

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from napari_shadowinv.facts import ResultKind
    from napari_shadowinv.fitting import LeaveOneOut
    from napari_shadowinv.physics.setup import Setup
    from napari_shadowinv.results import AnyResult

EXIT_NO_FIGURE = 1
Output = tuple[Path | None, tuple[str, ...]]  # a file and the endings that it may have


def result_and_figure(image: Path, out: Path | None, report: Path | None) -> tuple[Path, Path]:
    """Choose the names of result and figure; the figure never replaces the image."""
    if not image.stem:
        raise InputError(f"{image} is a folder: expected an image; give the name of a file")
    result = Path(f"{image.stem}{RESULT.suffix}") if out is None else out
    if report is not None:
        return result, report
    figure = figure_beside(result)
    if resolved_path(figure) == resolved_path(image):
        figure = result.with_name(f"{result.stem}_report{PNG.suffix}")
    return result, figure


def figure_beside(result: Path) -> Path:
    """Name a figure after a result, which must have a name itself."""
    if not result.name:
        raise InputError(f"{result} is a folder: expected the name of a file; add it to --out")
    return result.with_suffix(PNG.suffix)


def result_outputs(kind: ResultKind, result: Path, *figures: Path) -> list[Output]:
    """Return the files of a result and its figures, with the endings that they may have."""
    return [(result, suffixes_for(kind)), *((figure, FIGURE_SUFFIXES) for figure in figures)]


def check_outputs(outputs: Iterable[Output], overwrite: bool) -> list[Path]:
    """Return the files to be written; refuse, before any work, one that cannot be."""
    from napari_shadowinv.io import check_output

    files = [(path, suffixes) for path, suffixes in outputs if path is not None]
    for path, suffixes in files:
        check_output(path, overwrite, suffixes=suffixes)
    return [path for path, _ in files]


def protect(outputs: list[Path], inputs: list[Path | None]) -> None:
    """Refuse to overwrite an input, even with --overwrite."""
    sources = {resolved_path(split_address(file)[0]) for file in inputs if file is not None}
    for path in outputs:
        if resolved_path(path) in sources:
            raise InputError(f"{path} is both read and written: choose another name for the output")
    files = [resolved_path(path) for path in outputs]
    for path, file in zip(outputs, files, strict=True):
        if files.count(file) > 1:
            raise InputError(f"{path} would be written twice: choose two names")


def protect_files_of(recipe: Recipe, outputs: list[Path]) -> None:
    """Refuse to overwrite a file that a recipe names."""
    protect(outputs, [recipe.mask, recipe.source_mask, getattr(recipe.source, "file", None)])


def protect_store(store: Path, output: Path) -> None:
    """Refuse to write into a store that is read."""
    if resolved_path(output).is_relative_to(resolved_path(store)):
        raise InputError(
            f"{output} is inside the store being read: choose another name for the output"
        )


def check_setup(result: Path, setup: Setup | None, fields: Sequence[str] | None = None) -> None:
    """Refuse a setup, or fields, that the result's format cannot store."""
    from napari_shadowinv.io.pradformat import check_pradformat_fields, check_pradformat_setup

    if result.suffix.lower() in PRADFORMAT.suffixes:
        check_pradformat_setup(setup)
        check_pradformat_fields(fields or ())


def write_result(
    result: AnyResult,
    names: Sequence[str],
    out: Path,
    figure: Path,
    overwrite: bool,
    left_out: LeaveOneOut | None = None,
) -> list[Path]:
    """Write a result, then its figures, whose title is the names of its files.

    Returns the figures that could not be drawn; see `write_figures`.
    """
    from napari_shadowinv.io import write
    from napari_shadowinv.io.files import name_of
    from napari_shadowinv.plotting import left_out_figure, result_figure

    title = ", ".join(name_of(name) for name in names)
    dataset = result.to_dataset()
    figures: dict[Path, Callable[[], Figure]] = {
        figure: partial(result_figure, result, title=title)
    }
    if left_out is not None:
        dataset = left_out.added_to(dataset)
        figures[left_out_path(figure)] = partial(left_out_figure, left_out, title=title)
    write(out, dataset, overwrite=overwrite)
    return write_figures(figures, overwrite)


def left_out_path(figure: Path) -> Path:
    """Return the file of the figure of images that were left out."""
    return figure.with_name(f"{figure.stem}_left_out{figure.suffix}")


def write_figures(figures: Mapping[Path, Callable[[], Figure]], overwrite: bool) -> list[Path]:
    """Draw and write figures; print a caution for each that fails, and return their files."""
    from napari_shadowinv.plotting import save_figure

    failed = []
    for path, draw in figures.items():
        try:
            save_figure(path, draw(), overwrite)
        except Exception as error:
            if is_interrupted():
                raise
            failed.append(path)
            reason = str(error) or type(error).__name__
            text = f"the figure {path} could not be drawn, everything else is written: {reason}"
            say_on_stderr(text, "yellow")
    return failed


def exit_unless_drawn(failed: Collection[Path]) -> None:
    """Exit with an error code if `write_figures` could not write a figure."""
    if failed:
        raise Exit(EXIT_NO_FIGURE)


def recipe_from(flags: InversionFlags, settings: Settings) -> Recipe:
    """Read a recipe, and override it with flags and settings."""
    recipe = _with_settings(flags, settings, {"dark": flags.dark, "bin": flags.bin})
    options = settings.change("options", recipe.options)
    if "options.margin" in settings.values and options.boundary != "free":
        raise InputError("received options.margin: it needs --boundary free")
    recipe = recipe.model_copy(update={"options": options})
    if flags.source is not None and flags.source_from is not None:
        raise InputError(
            f"received --source and --source-from {flags.source_from}: choose one of them"
        )
    if flags.source is not None:
        return recipe.model_copy(update={"source": MeasuredSource(file=flags.source)})
    if flags.source_from is not None:
        estimate = source_from(flags.source_from, recipe.estimate)
        return recipe.model_copy(update={"source": estimate})
    return recipe


def fit_recipe_from(flags: FitFlags, settings: Settings) -> Recipe:
    """Read the recipe of a fit, and override it with flags and settings."""
    recipe = _with_settings(flags, settings, {"bin": flags.bin})
    changes: dict[str, Any] = {"fit": settings.change("fit", recipe.fit or FitChoices())}
    if flags.source is not None:
        is_known = flags.source != "unknown"
        changes["source"] = MeasuredSource(file=Path(flags.source)) if is_known else None
    return recipe.model_copy(update=changes)


def shots_recipe_from(flags: InversionFlags, settings: Settings) -> Recipe:
    """Return the recipe for shots to be inverted, or fitted if it has choices of a fit."""
    recipe = recipe_from(flags, settings)
    if recipe.fit is None and not any(key.startswith("fit.") for key in settings.values):
        return recipe
    if refused := [key for key in settings.values if key.startswith("options.")]:
        raise InputError(
            f"received {settings.flags.get(refused[0], refused[0])}, an option of inversions, for "
            "a fit: set its own options, such as fit.options.samples"
        )
    choices = settings.change("fit", recipe.fit or FitChoices())
    return recipe.model_copy(update={"fit": choices})


def _with_settings(flags: ShotFlags, settings: Settings, steps: Mapping[str, Any]) -> Recipe:
    """Read a recipe, and override its files, steps and instrument."""
    from napari_shadowinv.pipeline import read_recipe

    recipe = Recipe() if flags.recipe is None else read_recipe(flags.recipe)
    files = {name: settings.values[name] for name in FILE_KEYS if name in settings.values}
    changes: dict[str, Any] = {name: Path(file) if file else None for name, file in files.items()}
    changes["steps"] = with_steps(recipe.steps, flags.steps or (), steps)
    changes["instrument"] = settings.change("instrument", recipe.instrument)
    return recipe.model_copy(update=changes)


def setup_for(path: Path | None, shot: Shot, recipe: Recipe) -> Setup | None:
    """Read a setup, and complete it with the geometry in the image's file."""
    from napari_shadowinv.pipeline.files import setup_from

    if path is None:
        return recipe.setup or shot.setup
    return setup_from(path, shot.metadata.get("geometry"))
