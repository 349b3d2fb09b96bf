"""The command `fit`: fields, and the beam, from several images of one object."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

from typer import Option

from napari_shadowinv.cli import _flags, _inputs
from napari_shadowinv.cli._summary import fact_rows, two_columns, written_rows
from napari_shadowinv.cli._terminal import (
    exit_unless_sound,
    notify_errors,
    say,
    warn_of_setups,
    work_callbacks,
)
from napari_shadowinv.facts import ResultKind
from napari_shadowinv.io.formats import IMAGE_TITLES, RESULT

# Help of arguments, where it is longer than a line.
HELP = {
    "images": f"Images of one object ({IMAGE_TITLES}), or one table (.csv) with a row for each.",
    "energies": "Energy of each image in MeV, separated by commas; --setup gives the geometry.",
    "strengths": "Displacement of each image relative to the first, separated by commas, if "
    "there are no setups; for two fields '1 1,0.7 0.5'.",
    "setup": "TOML file with the experimental geometry of all images.",
    "source": "Image of the undisturbed beam, or unknown to fit a smooth beam. Default: uniform.",
    "compare": "Fit B alone, E alone and both, and report which explains the images best; needs "
    "setups. Writes the likeliest fit, or the one that --fields names.",
    "leave_one_out": "Also predict each image from a fit of the others, and list the images that "
    "one static field does not explain.",
    "brightness": "known: images are as bright as the source; free: fit the brightness of each "
    "image; or the brightness of each relative to the source, separated by commas.",
    "mask": "Image of the same size, 0 at pixels to ignore in all images.",
    "fiducials": "Table (.csv) of known displacements in the first image, with columns y, x, dy, "
    "dx and sigma, in px after --bin.",
    "out": "Result file: .shadowinv, or .h5 for one field alone (pradformat). Default: the first "
    "image's name with _fit.shadowinv, in the current folder.",
}
EPILOG = r"""
[bold]Examples[/bold]
shadowinv fit a.tif b.tif --energies 14.7,30 --setup setup.toml
shadowinv fit a.tif b.tif --energies 14.7,30 --setup setup.toml --fields B,E --brightness free
shadowinv fit a.tif b.tif --strengths 1,0.68 --source unknown --noise poisson
shadowinv fit shots.csv --source-size 10e-6 --resolution 30e-6 --bin 2
shadowinv fit shots.csv --setup setup.toml --compare
shadowinv fit shots.csv --setup setup.toml --leave-one-out
shadowinv fit next.csv --recipe recipe.toml

[bold]shots.csv[/bold] (paths are relative to this file; flags apply where a cell is empty)
file, energy, setup, source, brightness
a.tif, 14.7, setup.toml, beam.tif, 1
b.tif, 30, setup.toml, beam.tif, 1.2
Columns: file, setup, energy (MeV) or wavelength (m), strength, brightness, psf, mask, source,
noise; exclude (yes to skip the image); shot, for shadowinv batch.

[bold]Verdict[/bold]
Each result states whether its field can be trusted: "determined", "depends on the beam" or "the
detector" (which nobody recorded or stated), "one of several", "one image cannot tell", "too
uncertain", "reaches the edge" or "does not fit".

[bold]Exit codes[/bold]
0 the field is determined, or depends on beam or detector; 2 invalid input, nothing written;
3 result written, but with another verdict, or an image left out is not explained;
130 cancelled.
"""


@notify_errors
@_flags.takes_fit
def fit(
    images: Annotated[list[Path], _flags.argument(help=HELP["images"])],
    energies: Annotated[str | None, Option(metavar="MEV,MEV,…", help=HELP["energies"])] = None,
    strengths: Annotated[
        str | None, Option(metavar="NUMBER,NUMBER,…", help=HELP["strengths"])
    ] = None,
    setup: Annotated[Path | None, Option(help=HELP["setup"])] = None,
    source: Annotated[str | None, Option(metavar="PATH|unknown", help=HELP["source"])] = None,
    brightness: Annotated[
        str | None, Option(metavar="known|free|NUMBERS", help=HELP["brightness"])
    ] = None,
    mask: Annotated[Path | None, Option(help=HELP["mask"])] = None,
    fiducials: Annotated[Path | None, Option(help=HELP["fiducials"])] = None,
    compare: Annotated[bool, Option("--compare", help=HELP["compare"])] = False,
    leave_one_out: Annotated[bool, Option("--leave-one-out", help=HELP["leave_one_out"])] = False,
    recipe: _flags.RecipeFile = None,
    save_recipe: _flags.SaveRecipe = None,
    options: Annotated[Path | None, Option(help="TOML file with options of the fit.")] = None,
    channel: _flags.Channel = None,
    variable: _flags.Variable = None,
    out: Annotated[Path | None, Option(help=HELP["out"])] = None,
    figure: _flags.Figure = None,
    overwrite: _flags.Overwrite = False,
    quiet: _flags.QuietInversion = False,
    *,
    flags: dict[str, Any],
) -> None:
    """Fit the fields, and the beam, to one or several images of an object.

    Rays may cross, images may be blurred, and the beam may be unknown. Writes fields with error
    bars, re-projections, residuals and a verdict to one file, and a figure next to it.
    """
    from napari_shadowinv.cli import _fit_result
    from napari_shadowinv.pipeline import run_fit, run_leave_one_out, write_recipe
    from napari_shadowinv.pipeline.fit_run import read_row_images
    from napari_shadowinv.pipeline.shot_table import shot_rows

    lists = {"energy": energies, "strength": strengths}
    if brightness not in (None, "known", "free"):
        lists["brightness"], brightness = brightness, None
    list_flags = {"energy": "--energies", "strength": "--strengths", "brightness": "--brightness"}
    rows = shot_rows(images, {"setup": setup}, lists, list_flags)
    first = rows[0].file
    target = Path(f"{first.stem}_fit{RESULT.suffix}") if out is None else out
    result, figure = _inputs.result_and_figure(first, target, figure)
    figures = [figure]
    if leave_one_out:
        _fit_result.check_leave_one_out(len(rows), fiducials, result)
        figures.append(_inputs.left_out_path(figure))
    files = _inputs.result_outputs(ResultKind.FIT, result, *figures)
    outputs = _inputs.check_outputs([*files, (save_recipe, (".toml",))], overwrite)
    row_files = [file for row in rows for file in row.files.values()]
    _inputs.protect(outputs, [*images, fiducials, options, recipe, *row_files])
    chosen = _inputs.fit_recipe_from(
        flags, recipe, options, source=source, brightness=brightness, mask=mask
    )
    _inputs.protect_files_of(chosen, outputs)
    shots = read_row_images(rows, chosen, channel=channel, variable=variable)
    shots = (replace(shots[0], fiducials=fiducials), *shots[1:])
    _inputs.check_setup(result, shots[0].setup, chosen.fit.fields if chosen.fit else None)
    printed = warn_of_setups((shot.setup, getattr(shot.image, "shape", None)) for shot in shots)
    names = [str(row.file) for row in rows]
    beams = ["" if shot.setup else row.beam_text for row, shot in zip(rows, shots, strict=True)]
    short = _fit_result.short_names(names, beams)
    if compare:
        result_fit = _fit_result.compare_fields(chosen, shots, quiet, written=flags.get("fields"))
    else:
        with work_callbacks(quiet) as callbacks:
            result_fit = run_fit(chosen, shots, **callbacks)
    left_out = None
    if leave_one_out:
        named = [replace(shot, name=name) for shot, name in zip(shots, short, strict=True)]
        fields = [field.name for field in result_fit.fields]
        with work_callbacks(quiet) as callbacks:
            left_out = run_leave_one_out(chosen, named, fields, **callbacks)
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
