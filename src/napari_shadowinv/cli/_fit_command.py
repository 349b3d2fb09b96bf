"""`shadowinv fit`: fields, and the beam, from several images of one object."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from napari_shadowinv.cli import _flags, _outputs
from napari_shadowinv.cli._terminal import notify_errors, say
from napari_shadowinv.io.formats import IMAGE_TITLES

# Of arguments whose help is longer than a line.
HELP = {
    "images": f"Images of one object ({IMAGE_TITLES}), or one table (.csv) with a row for each.",
    "energies": "Energy of each image in MeV, separated by commas, with --setup for the rest.",
    "strengths": "Displacement of each image relative to the first, separated by commas, where "
    "there are no setups; for two fields '1 1,0.7 0.5'.",
    "setup": "TOML file with the experimental geometry of all images.",
    "fields": "What deflects: B, E, plasma or phase; two of them separated by a comma need images "
    "of two energies. Default: B, and for light phase.",
    "source": "Image of the undisturbed beam, or unknown to fit a smooth one. Default: uniform.",
    "noise": "poisson if images are counts, or the standard deviation in a pixel, after --bin. "
    "Default: estimated from the images.",
    "psf": "Point spread: standard deviation in px, after --bin.",
    "source_size": "Standard deviation of the beam's source in m (FWHM / 2.355); with "
    "--resolution, in place of --psf.",
    "resolution": "Standard deviation of the detector's point spread in m, at the detector.",
    "gains": "known: images are as bright as the source; free: by unknown factors brighter; or "
    "the factors, separated by commas.",
    "mask": "Image of the same size, 0 at pixels that no image can use.",
    "fiducials": "Table (.csv) of known displacements in the first image: columns y, x, dy, dx "
    "and sigma, in px after --bin.",
    "out": "Result file: .shadowinv. Default: the first image's name with _fit.shadowinv, in the "
    "current folder.",
}
EPILOG = r"""
[bold]Examples[/bold]
shadowinv fit a.tif b.tif --energies 14.7,30 --setup setup.toml
shadowinv fit a.tif b.tif --energies 14.7,30 --setup setup.toml --fields B,E --gains free
shadowinv fit a.tif b.tif --strengths 1,0.68 --source unknown --noise poisson
shadowinv fit shots.csv --source-size 10e-6 --resolution 30e-6 --bin 2

[bold]shots.csv[/bold] (files are looked for beside it; flags hold where a cell is empty)
file, energy, setup, source, gain
a.tif, 14.7, setup.toml, beam.tif, 1
b.tif, 30, setup.toml, beam.tif, 1.2
Columns: file, setup, energy, strength, gain, psf, mask, source, noise.

[bold]Verdict[/bold]
Whether the field may be believed is told with each result: "determined", "one of several",
"one image cannot tell", "too uncertain", "reaches the edge" or "does not fit".

[bold]Exit codes[/bold]
0 the field is determined; 2 invalid input, nothing written;
3 result written, but its verdict is another; 130 cancelled.
"""


@notify_errors
@_flags.takes_fit
def fit(
    images: Annotated[list[Path], typer.Argument(help=HELP["images"], show_default=False)],
    energies: Annotated[
        str | None, typer.Option(metavar="MEV,MEV,…", help=HELP["energies"])
    ] = None,
    strengths: Annotated[
        str | None, typer.Option(metavar="NUMBER,NUMBER,…", help=HELP["strengths"])
    ] = None,
    setup: Annotated[Path | None, typer.Option("--setup", help=HELP["setup"])] = None,
    fields: Annotated[str | None, typer.Option(metavar="NAMES", help=HELP["fields"])] = None,
    source: Annotated[
        str | None, typer.Option("--source", metavar="PATH|unknown", help=HELP["source"])
    ] = None,
    noise: Annotated[str | None, typer.Option(metavar="poisson|NUMBER", help=HELP["noise"])] = None,
    psf: Annotated[float | None, typer.Option(metavar="PX", help=HELP["psf"])] = None,
    source_size: Annotated[
        float | None, typer.Option(metavar="M", help=HELP["source_size"])
    ] = None,
    resolution: Annotated[float | None, typer.Option(metavar="M", help=HELP["resolution"])] = None,
    gains: Annotated[str, typer.Option(metavar="known|free|NUMBERS", help=HELP["gains"])] = "known",
    mask: Annotated[Path | None, typer.Option("--mask", help=HELP["mask"])] = None,
    fiducials: Annotated[Path | None, typer.Option(help=HELP["fiducials"])] = None,
    options: Annotated[
        Path | None, typer.Option("--options", help="TOML file with options of the fit.")
    ] = None,
    channel: _flags.Channel = None,
    variable: _flags.Variable = None,
    out: Annotated[Path | None, typer.Option(help=HELP["out"])] = None,
    report: _flags.Figure = None,
    overwrite: _flags.Overwrite = False,
    quiet: _flags.QuietInversion = False,
    *,
    flags: dict[str, Any],
) -> None:
    """Find the fields, and the beam, that explain one or several images of one object.

    Rays may cross, images may be blurred, the beam may be unknown. Writes fields with error
    bars, re-projections, residuals and a verdict to one file, and a figure next to it.
    """
    from napari_shadowinv.cli import _fit_result
    from napari_shadowinv.cli._fit_rows import fiducials_from, shot_rows
    from napari_shadowinv.cli._fit_shots import fields_for, fit_shots
    from napari_shadowinv.io import read_toml
    from napari_shadowinv.io.formats import FIGURE_SUFFIXES, FIT_WRITERS

    lists = {"energy": energies, "strength": strengths}
    if gains not in ("known", "free"):
        lists["gain"] = gains
    shared = {"setup": setup, "source": source, "noise": noise, "psf": psf, "mask": mask}
    rows = shot_rows(images, shared, lists)
    first = rows[0].file
    named = Path(f"{first.stem}_fit{next(iter(FIT_WRITERS))}") if out is None else out
    result, figure = _outputs.result_and_figure(first, named, report)
    _outputs.check_outputs({result: tuple(FIT_WRITERS), figure: FIGURE_SUFFIXES}, overwrite)
    read = [*images, fiducials, options, *(file for row in rows for file in row.files)]
    _outputs.protect([result, figure], read)
    content = {} if options is None else read_toml(options)
    where = "options" if options is None else str(options)
    steps, chosen = _flags.fit_choices_of(flags, content, where)
    shots = fit_shots(
        rows,
        steps,
        channel=channel,
        variable=variable,
        source_size=source_size,
        resolution=resolution,
    )
    found = _fit_result.fitted(
        shots,
        fields=fields_for(fields, shots.setups),
        gains=gains if "gain" not in lists else "known",
        fiducials=None if fiducials is None else fiducials_from(fiducials),
        options=chosen,
        quiet=quiet,
    )
    _fit_result.write_fit(found, shots, result, figure, overwrite, fiducials)
    if not quiet:
        say(_fit_result.fit_table(found, shots, [result, figure]))
    _fit_result.alarm_unless_determined(found, result)
