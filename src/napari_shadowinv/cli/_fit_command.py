"""The command `fit`: fields, and the beam, from several images of one object."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated

from typer import Option

from napari_shadowinv.cli import _flags, _inputs
from napari_shadowinv.cli._settings import FILE_KEYS, FIT_SECTIONS, settings_of
from napari_shadowinv.cli._summary import fact_rows, two_columns, written_rows
from napari_shadowinv.cli._terminal import (
    exit_unless_sound,
    notify_errors,
    say,
    warn_of_setups,
    work_callbacks,
)
from napari_shadowinv.facts import ResultKind
from napari_shadowinv.io.formats import RESULT

EPILOG = """
shadowinv fit a.tif b.tif --energies 14.7,30 --setup setup.toml --set fit.fields=B,E

shadowinv fit shots.csv --setup setup.toml --source unknown --noise poisson

Exit codes: 0 determined; 1 no figure; 2 invalid input; 3 another verdict; 130 cancelled.
"""


@notify_errors
@_flags.takes_flags
def fit(
    images: Annotated[list[Path], _flags.argument(help="Images, or a table (.csv) of them.")],
    flags: _flags.FitFlags,
    settings: Annotated[
        list[str] | None,
        _flags.setting(FIT_SECTIONS, "fit.options.samples=0", FILE_KEYS[:1]),
    ] = None,
    save_recipe: _flags.SaveRecipe = None,
    out: Annotated[Path | None, Option(help="Result: .shadowinv, or .h5 for one field.")] = None,
    figure: _flags.Figure = None,
    overwrite: _flags.Overwrite = False,
    quiet: _flags.QuietInversion = False,
) -> None:
    """Fit the fields, and the beam, to one or several images of an object.

    Rays may cross, images may be blurred, and the beam may be unknown.
    """
    from napari_shadowinv.cli import _fit_result
    from napari_shadowinv.pipeline import run_fit, run_leave_one_out, write_recipe
    from napari_shadowinv.pipeline.fit_run import read_row_images
    from napari_shadowinv.pipeline.shot_table import shot_rows

    rows = shot_rows(
        images, {"setup": flags.setup}, {"energy": flags.energies}, {"energy": "--energies"}
    )
    first = rows[0].file
    target = Path(f"{first.stem}_fit{RESULT.suffix}") if out is None else out
    result, figure = _inputs.result_and_figure(first, target, figure)
    figures = [figure]
    if flags.leave_one_out:
        _fit_result.check_leave_one_out(len(rows), flags.fiducials, result)
        figures.append(_inputs.left_out_path(figure))
    files = _inputs.result_outputs(ResultKind.FIT, result, *figures)
    outputs = _inputs.check_outputs([*files, (save_recipe, (".toml",))], overwrite)
    row_files = [file for row in rows for file in row.files.values()]
    _inputs.protect(outputs, [*images, flags.fiducials, flags.recipe, *row_files])
    stated = settings_of(settings or (), FIT_SECTIONS, flags.by_key, FILE_KEYS[:1])
    chosen = _inputs.fit_recipe_from(flags, stated)
    _inputs.protect_files_of(chosen, outputs)
    shots = read_row_images(rows, chosen, channel=flags.channel, variable=flags.variable)
    shots = (replace(shots[0], fiducials=flags.fiducials), *shots[1:])
    _inputs.check_setup(result, shots[0].setup, chosen.fit.fields if chosen.fit else None)
    printed = warn_of_setups((shot.setup, getattr(shot.image, "shape", None)) for shot in shots)
    names = [str(row.file) for row in rows]
    beams = ["" if shot.setup else row.beam_text for row, shot in zip(rows, shots, strict=True)]
    short = _fit_result.short_names(names, beams)
    if flags.compare:
        written = stated.values.get("fit.fields")
        result_fit = _fit_result.compare_fields(chosen, shots, quiet, written=written)
    else:
        with work_callbacks(quiet) as callbacks:
            result_fit = run_fit(chosen, shots, **callbacks)
    left_out = None
    if flags.leave_one_out:
        named_shots = [replace(shot, name=name) for shot, name in zip(shots, short, strict=True)]
        fields = [field.name for field in result_fit.fields]
        with work_callbacks(quiet) as callbacks:
            left_out = run_leave_one_out(chosen, named_shots, fields, **callbacks)
    failed = _inputs.write_result(result_fit, names, result, figure, overwrite, left_out)
    if save_recipe is not None:
        setups = {shot.setup for shot in shots}
        (common,) = setups if len(setups) == 1 else (None,)
        write_recipe(save_recipe, chosen.model_copy(update={"setup": common}), overwrite=overwrite)
    if not quiet:
        if left_out is not None:
            say(two_columns("Left out", fact_rows(left_out.facts)))
        fit_rows = _fit_result.fit_rows(result_fit, names, printed)
        say(two_columns("Fit", [*fit_rows, *written_rows(outputs, failed)]))
    exit_unless_sound(result_fit, result, left_out)
    _inputs.exit_unless_drawn(failed)
