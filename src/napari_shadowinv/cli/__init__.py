"""The command `shadowinv`: invert, predict, look at files, try it out.

Every heavy import waits until a command needs it, so that ``--help`` and the refusal of a
mistake answer at once.
"""

from __future__ import annotations

import sys
from io import TextIOWrapper
from pathlib import Path
from typing import Annotated

import typer

from napari_shadowinv.cli._demo import compared_fields, demo_table, simulated_shot, write_demo
from napari_shadowinv.cli._guard import alarm_unless_converged, guarded
from napari_shadowinv.cli._info import described
from napari_shadowinv.cli._inputs import (
    Experiment,
    experiment_from,
    field_from,
    options_from,
    setup_from,
)
from napari_shadowinv.cli._outputs import (
    FIGURE_SUFFIXES,
    check_outputs,
    make_folder,
    protect,
    result_and_figure,
    write_all,
)
from napari_shadowinv.cli._progress import inverted
from napari_shadowinv.cli._tables import say, size_text, summary
from napari_shadowinv.errors import InputError

__all__ = ["app"]

app = typer.Typer(
    name="shadowinv",
    help="Shadowgrams and proton radiographs to deflection potentials and fields.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
)


def _show_version(asked: bool) -> None:
    if asked:
        from importlib.metadata import version

        typer.echo(f"shadowinv {version('napari-shadowinv')}")
        raise typer.Exit


@app.callback()
def main(
    version: Annotated[
        bool,
        typer.Option(
            "--version", callback=_show_version, is_eager=True, help="Show the version and exit."
        ),
    ] = False,
) -> None:
    """Shadowgrams and proton radiographs to deflection potentials and fields."""
    for stream in (sys.stdout, sys.stderr):
        # A terminal that knows no ∫ or µ is no reason to fail after the work is done.
        if isinstance(stream, TextIOWrapper):
            stream.reconfigure(errors="replace")


SourceFile = Annotated[
    Path | None,
    typer.Option("--source", help="Image of the undisturbed beam. Default: uniform."),
]
SetupFile = Annotated[
    Path | None,
    typer.Option("--setup", help="TOML file with the experiment's geometry, for SI units."),
]
Channel = Annotated[
    str | None,
    typer.Option(help="Of a colour image: red, green, blue, mean or a number from 0."),
]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace existing files.")]

_INVERT_EPILOG = """
[bold]Examples[/bold]
shadowinv invert shot.tif
shadowinv invert shot.tif --source reference.tif --setup setup.toml --bin 4
shadowinv invert film.tif --channel red --clip-negative --out film.h5

[bold]setup.toml[/bold]
kind = "proton"                  # or "optical"
energy = 14.7                    # MeV; for light: wavelength = 532e-9 (m)
source_object_distance = 0.01    # m; inf for a collimated beam
object_image_distance = 0.28     # m
detector_pixel_size = 145e-6     # m; or pixel_size at the object

[bold]options.toml[/bold] (any of these and more, see InversionOptions)
n_sites = 100000
tolerance = 1e-4
floor = 1e-3

[bold]Exit codes[/bold]
0 done; 2 a mistake in what was given, nothing is written;
3 written, but not converged; 130 cancelled.
"""


@app.command(epilog=_INVERT_EPILOG)
@guarded
def invert(
    image: Annotated[
        Path,
        typer.Argument(help="TIFF, PNG, BMP, JPEG, NPY or pradformat HDF5.", show_default=False),
    ],
    source: SourceFile = None,
    mask: Annotated[
        Path | None,
        typer.Option("--mask", help="Picture of the image's size, 0 where a pixel is unusable."),
    ] = None,
    setup: SetupFile = None,
    options: Annotated[
        Path | None, typer.Option("--options", help="TOML file with inversion options.")
    ] = None,
    n_sites: Annotated[
        int | None, typer.Option(help="Number of sites. Default: as many as pixels.")
    ] = None,
    bin_: Annotated[
        int, typer.Option("--bin", help="Sum blocks of so many pixels squared first.")
    ] = 1,
    channel: Channel = None,
    clip_negative: Annotated[
        bool, typer.Option("--clip-negative", help="Set negative pixels to zero and count them.")
    ] = False,
    out: Annotated[
        Path | None,
        typer.Option(
            help=(
                "Result: .shadowinv (all of it), .h5 (pradformat) or .csv (sites). "
                "Default: the image's name with .shadowinv, in the current folder."
            )
        ),
    ] = None,
    report: Annotated[
        Path | None,
        typer.Option(help="Figure: .png, .pdf or .svg. Default: a PNG beside the result."),
    ] = None,
    overwrite: Overwrite = False,
    threads: Annotated[int | None, typer.Option(help="Threads. Default: all cores.")] = None,
    seed: Annotated[int | None, typer.Option(help="Seed of the random site positions.")] = None,
    quiet: Annotated[
        bool, typer.Option("--quiet", "-q", help="Print nothing but errors and alarms.")
    ] = False,
) -> None:
    """Retrieve the deflection potential of one image.

    Writes potential, displacement, re-projection and residual, with all options,
    to one file, and a figure beside it.
    """
    from napari_shadowinv.io.pradformat import check_pradformat_setup
    from napari_shadowinv.io.writing import RESULT_SUFFIXES

    result, figure = result_and_figure(image, out, report)
    check_outputs({result: RESULT_SUFFIXES, figure: FIGURE_SUFFIXES}, overwrite)
    protect([result, figure], [image, source, mask, setup, options])
    flags = {"n_sites": n_sites, "threads": threads, "seed": seed}
    chosen = options_from(options, flags, clip_negative)
    experiment = experiment_from(image, source, setup, channel, bin_, mask)
    if result.suffix.lower() in (".h5", ".hdf5"):
        check_pradformat_setup(experiment.setup)
    inversion = inverted(experiment, chosen, quiet)
    write_all(inversion, experiment, result, figure, overwrite)
    if not quiet:
        say(summary(inversion, experiment, [result, figure]))
    alarm_unless_converged(inversion.report, result)


@app.command()
@guarded
def forward(
    field: Annotated[
        Path,
        typer.Argument(
            help=(
                ".shadowinv or pradformat result, or NPY with a displacement (2, H, W) in px "
                "or a potential (H, W) in px²."
            ),
            show_default=False,
        ),
    ],
    source: SourceFile = None,
    setup: Annotated[
        Path | None,
        typer.Option("--setup", help="TOML file; its pixel size is stored in the TIFF."),
    ] = None,
    channel: Channel = None,
    out: Annotated[
        Path | None,
        typer.Option(
            help=(
                "Image: .tif (float32), .npy or .png (16 bits, scaled to its maximum). "
                "Default: the field's name with _image.tif, in the current folder."
            )
        ),
    ] = None,
    overwrite: Overwrite = False,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Print nothing but errors.")] = False,
) -> None:
    """Predict the image that a displacement makes of a source.

    Without --source, a result's own source is used, or a uniform one.
    """
    from napari_shadowinv.io import read_radiograph, write
    from napari_shadowinv.io.writing import IMAGE_SUFFIXES

    path = Path(f"{field.stem}_image.tif") if out is None else out
    check_outputs({path: IMAGE_SUFFIXES}, overwrite)
    protect([path], [field, source, setup])
    geometry = None if setup is None else setup_from(setup)
    displacement, beam, own_geometry = field_from(field)
    if source is not None:
        beam = read_radiograph(source, channel=channel).image
    from napari_shadowinv.physics.forward import synthetic_image

    image = synthetic_image(displacement, beam)
    write(path, image, setup=geometry or own_geometry, overwrite=overwrite)
    if not quiet:
        kept = image.sum() / (image.size if beam is None else beam.sum())
        say(f"Wrote {path}: {size_text(image)}, {kept:.2%} of the flux lands inside the image")


@app.command()
@guarded
def info(
    file: Annotated[Path, typer.Argument(help="An image or a result.", show_default=False)],
) -> None:
    """Tell what a file is and what is in it."""
    say(described(file))


@app.command()
@guarded
def demo(
    out: Annotated[Path, typer.Option(help="Folder for the files.")] = Path("demo"),
    dm: Annotated[float, typer.Option(help="Peak path-integrated field in MG·µm.")] = 97.0,
    noise: Annotated[float, typer.Option(help="Noise, as a share of the mean.")] = 0.1,
    n_sites: Annotated[
        int | None, typer.Option(help="Number of sites. Default: as many as pixels.")
    ] = None,
) -> None:
    """Simulate a toroidal field in a proton beam, invert the image, compare with the truth.

    The experiment is that of Kasim et al., arXiv:1607.04179, Section IV. Caustics start
    at about 185 MG·µm.
    """
    if not 0 <= noise < float("inf"):
        raise InputError(f"noise is {noise:g}: it must be 0 or more, as a share of the mean")
    chosen = options_from(None, {"n_sites": n_sites}, clip_negative=True)
    make_folder(out)
    from napari_shadowinv.io import Radiograph
    from napari_shadowinv.physics.phantoms import paper_setup

    setup = paper_setup()
    image, truth = simulated_shot(setup, dm, noise)
    inversion = inverted(Experiment(Radiograph(image), setup=setup), chosen)
    fields = compared_fields(image, truth, inversion)
    written = write_demo(out, f"toroid_{dm:g}", inversion, setup, fields)
    say(demo_table(inversion, setup, fields, written))
    alarm_unless_converged(inversion.report, written[0])
