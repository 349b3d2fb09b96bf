"""The command `fit`: fields, and the beam, from several images of one object."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated

from typer import Option

from napari_shadowinv.cli import _flags
from napari_shadowinv.cli._inputs import recipe_from
from napari_shadowinv.cli._outputs import (
    Outputs,
    check_setup,
    result_and_figure,
)
from napari_shadowinv.cli._settings import FILE_KEYS, FIT_SECTIONS, settings_of
from napari_shadowinv.cli._summary import result_rows
from napari_shadowinv.cli._terminal import notify_errors, work_callbacks
from napari_shadowinv.facts import ResultKind
from napari_shadowinv.io.files import split_address
from napari_shadowinv.io.formats import RESULT

EPILOG = """
shadowinv fit a.tif b.tif --energies 14.7,30 --setup setup.toml --set fit.fields=B,E

shadowinv fit shots.csv --setup setup.toml --source unknown --noise poisson

Exit codes: 0 determined; 2 invalid input; 3 another verdict; 130 cancelled.
"""


@notify_errors
@_flags.takes_flags
def fit(
    images: Annotated[list[Path], _flags.argument(help="Images, or a table (.csv) of them.")],
    flags: _flags.FitFlags,
    outputs: Outputs,
    settings: Annotated[
        list[str] | None,
        _flags.setting(FIT_SECTIONS, "fit.options.samples=0", FILE_KEYS[:1]),
    ] = None,
    save_recipe: _flags.SaveRecipe = None,
    out: Annotated[Path | None, Option(help="Result: .shadowinv, or .h5 for one field.")] = None,
    figure: _flags.Figure = None,
) -> None:
    """Fit the fields, and the beam, to one or several images of an object.

    Rays may cross, images may be blurred, and the beam may be unknown.
    """
    from napari_shadowinv.pipeline import run_fit, write_recipe
    from napari_shadowinv.pipeline.fit_run import read_row_images
    from napari_shadowinv.pipeline.shot_table import shot_rows

    rows = shot_rows(images, flags.setup, flags.energies, "--energies")
    first, _ = split_address(rows[0].file)
    target = Path(f"{first.stem}_fit{RESULT.suffix}") if out is None else out
    file, figure = result_and_figure(first, target, figure)
    inputs = [*images, flags.fiducials, flags.recipe]
    inputs += [file for row in rows for file in row.files.values()]
    outputs.check_result(ResultKind.FIT, file, figure, recipe=save_recipe, inputs=inputs)
    stated = settings_of(settings or (), FIT_SECTIONS, flags.by_key, FILE_KEYS[:1])
    recipe = recipe_from(flags, stated)
    outputs.protect_files_of(recipe)
    shots = read_row_images(rows, recipe, channel=flags.channel)
    shots = (replace(shots[0], fiducials=flags.fiducials), *shots[1:])
    check_setup(file, shots[0].setup, recipe.fit.fields if recipe.fit else None)
    outputs.warn_of_setups((shot.setup, getattr(shot.image, "shape", None)) for shot in shots)
    names = [str(row.file) for row in rows]
    with work_callbacks(outputs.quiet) as callbacks:
        result = run_fit(recipe, shots, **callbacks)
    outputs.write_result(result, names, file, figure)
    if save_recipe is not None:
        setups = {shot.setup for shot in shots}
        common = recipe.model_copy(update={"setup": setups.pop() if len(setups) == 1 else None})
        write_recipe(save_recipe, common, overwrite=outputs.overwrite)
    outputs.show("Fit", result_rows(result, names=names))
    outputs.exit_unless_sound(result, file)
