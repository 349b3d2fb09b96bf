"""The command `shadowinv`: invert one shot or many, predict, look at files, try it out.

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
from napari_shadowinv.cli._forward import predicted, seen_with
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
Variable = Annotated[
    str | None,
    typer.Option(
        "--variable",
        metavar="NAME",
        help="Array to take from a MATLAB file with several images, or from an HDF5 file.",
    ),
]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace existing files.")]

_FILTERS = "Filters before the inversion"
_BOUNDARY = "Flux across the image's edge (docs/boundary.md)"
_ESTIMATES = "Source estimated from the image (docs/sources.md)"

_INVERT_EPILOG = r"""
[bold]Examples[/bold]
shadowinv invert shot.tif
shadowinv invert shot.tif --source reference.tif --setup setup.toml --bin 4
shadowinv invert film.tif --channel red --clip-negative --out film.h5
shadowinv invert shots.mat --variable shot3 --source-variable beam
shadowinv invert shot.tif --hot-pixels 6 --source-from polynomial --source-degree 2

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
\[prepare]                        # the filters and estimates above, with _ for -
hot_pixels = 6                   # standard deviations
source_from = "total-variation"
source_weight = 2                # px

[bold]Exit codes[/bold]
0 done; 2 a mistake in what was given, nothing is written;
3 written, but not converged; 130 cancelled.
"""


@app.command(epilog=_INVERT_EPILOG)
@guarded
def invert(
    image: Annotated[
        Path,
        typer.Argument(
            help=(
                "TIFF, PNG, BMP, JPEG, NPY, MATLAB, text, PCO .b16, SPE or HDF5 (pradformat, or "
                "with --variable)."
            ),
            show_default=False,
        ),
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
    variable: Variable = None,
    source_variable: Annotated[
        str | None,
        typer.Option(
            metavar="NAME",
            help="Array with the undisturbed beam, in the file of --source or else of the image.",
        ),
    ] = None,
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
    boundary: Annotated[
        str | None,
        typer.Option(
            help="'closed': nothing crosses the edge. 'free': flux may leave and enter.",
            rich_help_panel=_BOUNDARY,
        ),
    ] = None,
    margin: Annotated[
        int | None,
        typer.Option(
            metavar="PX",
            help="Of the free boundary: pixels beyond each edge that flux may come from.",
            rich_help_panel=_BOUNDARY,
        ),
    ] = None,
    flux: Annotated[
        str | None,
        typer.Option(
            help=(
                "Of the free boundary: 'conserve' (units of image and source may differ), 'known' "
                "(same exposure) or 'fit'."
            ),
            rich_help_panel=_BOUNDARY,
        ),
    ] = None,
    source_from: Annotated[
        str | None,
        typer.Option(
            metavar="ESTIMATE",
            help=(
                "Guess the undisturbed beam from the (filtered) image: uniform, gaussian, "
                "polynomial, low-pass, total-variation or interpolated."
            ),
            rich_help_panel=_ESTIMATES,
        ),
    ] = None,
    source_degree: Annotated[
        int | None,
        typer.Option(
            help="For polynomial: total degree in y and x, 0 to 10. Default: 2.",
            rich_help_panel=_ESTIMATES,
        ),
    ] = None,
    source_weight: Annotated[
        float | None,
        typer.Option(
            help=(
                "For total-variation: in px (after --bin); c·r/2 removes a disc of contrast c and "
                "radius r px. Default: 2."
            ),
            rich_help_panel=_ESTIMATES,
        ),
    ] = None,
    source_width: Annotated[
        float | None,
        typer.Option(
            help=(
                "For low-pass and interpolated: standard deviation of the blur in px (after "
                "--bin). Default for interpolated: 5."
            ),
            rich_help_panel=_ESTIMATES,
        ),
    ] = None,
    source_mask: Annotated[
        Path | None,
        typer.Option(
            help="Picture of the image's size, 0 where the object hides the bare beam.",
            rich_help_panel=_ESTIMATES,
        ),
    ] = None,
    hot_pixels: Annotated[
        float | None,
        typer.Option(
            metavar="DEVIATIONS",
            help=(
                "Replace hot and dead pixels that differ from their neighbours' median by more "
                "standard deviations of the noise; 6 suits most. Before --bin."
            ),
            rich_help_panel=_FILTERS,
        ),
    ] = None,
    background_degree: Annotated[
        int | None,
        typer.Option(
            metavar="DEGREE",
            help="Divide the image by a polynomial fitted to it, total degree 0 to 10.",
            rich_help_panel=_FILTERS,
        ),
    ] = None,
    high_pass: Annotated[
        float | None,
        typer.Option(
            metavar="PX",
            help="Take away structures much larger than this width in px (after --bin).",
            rich_help_panel=_FILTERS,
        ),
    ] = None,
    low_pass: Annotated[
        float | None,
        typer.Option(
            metavar="PX",
            help=(
                "Blur image and source by a Gaussian of this standard deviation in px (after "
                "--bin)."
            ),
            rich_help_panel=_FILTERS,
        ),
    ] = None,
) -> None:
    """Retrieve the deflection potential of one image.

    Writes potential, displacement, re-projection and residual, with all options,
    to one file, and a figure beside it.
    """
    from napari_shadowinv.io.pradformat import check_pradformat_setup
    from napari_shadowinv.io.writing import RESULT_SUFFIXES

    result, figure = result_and_figure(image, out, report)
    check_outputs({result: RESULT_SUFFIXES, figure: FIGURE_SUFFIXES}, overwrite)
    protect([result, figure], [image, source, mask, setup, options, source_mask])
    from napari_shadowinv.cli._preparing import TABLE, preparation_from

    flags = {
        "n_sites": n_sites,
        "threads": threads,
        "seed": seed,
        "boundary": boundary,
        "margin": margin,
        "flux": flux,
    }
    chosen = options_from(options, flags, clip_negative, other_tables=(TABLE,))
    preparation = preparation_from(
        options,
        {
            "hot_pixels": hot_pixels,
            "background_degree": background_degree,
            "high_pass": high_pass,
            "low_pass": low_pass,
            "source_from": source_from,
            "source_degree": source_degree,
            "source_weight": source_weight,
            "source_width": source_width,
        },
        has_source=source is not None or source_variable is not None,
        has_source_mask=source_mask is not None,
    )
    experiment = experiment_from(
        image,
        source,
        setup,
        channel,
        bin_,
        mask,
        variable=variable,
        source_variable=source_variable,
        preparation=preparation,
        source_mask=source_mask,
    )
    if result.suffix.lower() in (".h5", ".hdf5"):
        check_pradformat_setup(experiment.setup)
    inversion = inverted(experiment, chosen, quiet)
    write_all(inversion, experiment, result, figure, overwrite)
    if not quiet:
        say(summary(inversion, experiment, [result, figure]))
    alarm_unless_converged(inversion.report, result)


_FORWARD_EPILOG = """
[bold]Examples[/bold]
shadowinv forward shot.shadowinv
shadowinv forward shot.shadowinv --setup lower_energy.toml
shadowinv forward shot.shadowinv --setup lower_energy.toml --deflector electric-field
shadowinv forward d.npy --made-with first.toml --setup second.toml

[bold]Another experiment[/bold]
A deflection belongs to its beam. What both experiments have in common is the object's line
integral, so say what deflects: a magnetic field (∫B dl, angles go with charge / momentum;
the default for particles), an electric field (∫E dl, with charge / (momentum velocity)), a
plasma (∫n dz, with the wavelength squared) or a refractive index (∫ln η dz, alike but for
dispersion). Both images have the same middle; the predicted one has the pixels of --setup
and covers what is known.
"""


@app.command(epilog=_FORWARD_EPILOG)
@guarded
def forward(
    field: Annotated[
        Path,
        typer.Argument(
            help=(
                ".shadowinv or pradformat result, or NPY, MATLAB or HDF5 (with --variable) with a "
                "displacement (2, H, W) in px or a potential (H, W) in px²."
            ),
            show_default=False,
        ),
    ],
    source: SourceFile = None,
    setup: Annotated[
        Path | None,
        typer.Option(
            "--setup",
            help=(
                "TOML file with the experiment to predict, such as another energy. Default: that "
                "of the field."
            ),
        ),
    ] = None,
    made_with: Annotated[
        Path | None,
        typer.Option(
            help="TOML file with the experiment that the field is from, if its file does not tell."
        ),
    ] = None,
    deflector: Annotated[
        str | None,
        typer.Option(
            metavar="WHAT",
            help=(
                "What deflects, if --setup is another experiment: magnetic-field, electric-field, "
                "plasma or refractive-index."
            ),
        ),
    ] = None,
    dispersion: Annotated[
        float,
        typer.Option(
            help="For a refractive index: ln η at the new wavelength over that at the old one."
        ),
    ] = 1.0,
    channel: Channel = None,
    variable: Variable = None,
    source_variable: Annotated[
        str | None, typer.Option(metavar="NAME", help="Array to take from the source's file.")
    ] = None,
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
    """Predict the image that a displacement makes of a source, here or in another experiment.

    Without --source, a result's own source is used, or a uniform one; in another experiment a
    uniform one.
    """
    from napari_shadowinv.io import read_radiograph, write
    from napari_shadowinv.io.writing import IMAGE_SUFFIXES

    path = Path(f"{field.stem}_image.tif") if out is None else out
    check_outputs({path: IMAGE_SUFFIXES}, overwrite)
    protect([path], [field, source, setup, made_with])
    if source_variable is not None and source is None:
        raise InputError("received --source-variable: it needs --source, the file to look in")
    seen = None if setup is None else setup_from(setup)
    told = None if made_with is None else setup_from(made_with)
    known = seen_with(field_from(field, variable), seen, told, deflector, dispersion)
    beam = known.source
    if source is not None:
        beam = read_radiograph(source, channel=channel, variable=source_variable).image
    image, note = predicted(known, beam)
    write(path, image, setup=known.seen, overwrite=overwrite)
    if not quiet:
        kept = image.sum() / (image.size if beam is None else beam.sum())
        say(f"Wrote {path}: {size_text(image)}, {kept:.2%} of the flux lands inside the image")
        if note:
            say(note)


@app.command()
@guarded
def info(
    file: Annotated[Path, typer.Argument(help="An image or a result.", show_default=False)],
    variable: Variable = None,
) -> None:
    """Tell what a file is and what is in it."""
    say(described(file, variable))


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


_BATCH_EPILOG = """
[bold]Examples[/bold]
shadowinv batch 'shots/*.tif' --source reference.tif --out night.shadowinv.zarr
shadowinv batch 'shots/*.tif' --source reference.tif --out night.shadowinv.zarr --resume
shadowinv batch movie.tif --out movie.shadowinv.zarr --scheduler tcp://head:8786

[bold]Exit codes[/bold]
0 all done; 1 some shot failed, the others are written; 2 a mistake in what was given;
3 all done, but some did not converge; 130 cancelled, --resume goes on.
"""

StoreFolder = Annotated[
    Path, typer.Argument(help="name.shadowinv.zarr, from shadowinv batch.", show_default=False)
]
ChosenShots = Annotated[
    str | None,
    typer.Option("--shots", help="Which, from 0: 3, 3:20, ::10 or 1,4,9. Default: all done."),
]


@app.command(epilog=_BATCH_EPILOG)
@guarded
def batch(
    shots: Annotated[
        list[str],
        typer.Argument(
            help="A glob in quotes, files, or one TIFF with a page for each shot.",
            show_default=False,
        ),
    ],
    out: Annotated[Path, typer.Option(help="The store to write: name.shadowinv.zarr.")],
    source: Annotated[
        str | None,
        typer.Option(
            "--source",
            help="Undisturbed beam: one image, or a glob with one for each shot. Default: uniform.",
        ),
    ] = None,
    mask: Annotated[
        Path | None,
        typer.Option("--mask", help="Picture of the images' size, 0 where a pixel is unusable."),
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
    variables: Annotated[
        str | None,
        typer.Option(help="What to store, with commas. Default: potential,displacement,caustic."),
    ] = None,
    warm_start: Annotated[
        int, typer.Option(help="Start from the shot before, in runs of so many shots.")
    ] = 1,
    scheduler: Annotated[
        str | None,
        typer.Option(
            help="Address of a dask scheduler (tcp://host:8786), threads, or processes (default)."
        ),
    ] = None,
    workers: Annotated[
        int | None, typer.Option(help="Shots at once on this machine. Default: one for each core.")
    ] = None,
    resume: Annotated[
        bool,
        typer.Option("--resume", help="Go on where a run stopped; append shots that came since."),
    ] = False,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Throw away an earlier run.")
    ] = False,
    redo_failed: Annotated[
        bool, typer.Option("--redo-failed", help="As --resume, and try failed shots again.")
    ] = False,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Print nothing but errors.")] = False,
) -> None:
    """Invert many shots into one store that survives a crash."""
    from napari_shadowinv.cli._batch import run_batch

    run_batch(
        shots,
        out,
        source=source,
        mask=mask,
        setup=setup,
        options=options_from(options, {"n_sites": n_sites}, clip_negative),
        factor=bin_,
        channel=channel,
        variables=variables,
        warm_start=warm_start,
        scheduler=scheduler,
        workers=workers,
        resume=resume,
        overwrite=overwrite,
        redo_failed=redo_failed,
        quiet=quiet,
    )


@app.command()
@guarded
def status(
    store: StoreFolder,
    every: Annotated[bool, typer.Option("--all", help="A line for each shot.")] = False,
) -> None:
    """Tell which shots of a store are done, failed and why, or pending."""
    from napari_shadowinv.cli._batch import status_tables

    for table in status_tables(store, every):
        say(table)


@app.command()
@guarded
def export(
    store: StoreFolder,
    form: Annotated[
        str,
        typer.Option(
            "--format",
            help=(
                "tiff (float32, a file for each shot and component), pradformat (a file for each "
                "shot), or csv (a table with a row for each shot)."
            ),
        ),
    ],
    shots: ChosenShots = None,
    variables: Annotated[
        str, typer.Option(help="Of TIFF: which images, with commas.")
    ] = "potential",
    out: Annotated[
        Path | None,
        typer.Option(help="Folder, or file for csv. Default: the store's name, here."),
    ] = None,
    overwrite: Overwrite = False,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Print nothing but errors.")] = False,
) -> None:
    """Write shots of a store in another format."""
    from napari_shadowinv.cli._export import export_shots
    from napari_shadowinv.io.store import STORE_SUFFIX

    stem = store.name.removesuffix(STORE_SUFFIX)
    target = Path(f"{stem}.csv" if form == "csv" else stem) if out is None else out
    names = [name.strip() for name in variables.split(",")]
    written = export_shots(store, target, form, shots, names, overwrite)
    if not quiet:
        say(f"Wrote {target}: {len(written)} {'file' if len(written) == 1 else 'files'}")


@app.command()
@guarded
def movie(
    store: StoreFolder,
    out: Annotated[Path, typer.Option("--out", "-o", help="The film: .mp4 or .gif.")],
    variable: Annotated[
        str | None,
        typer.Option(help="What to show; of vectors the magnitude. Default: the potential."),
    ] = None,
    shots: ChosenShots = None,
    rate: Annotated[float, typer.Option(help="Shots a second.")] = 10.0,
    limits: Annotated[
        tuple[float, float] | None,
        typer.Option(help="Ends of the colour scale. Default: those of all shots."),
    ] = None,
    overwrite: Overwrite = False,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Print nothing but errors.")] = False,
) -> None:
    """Make a film of a store, all shots on one colour scale."""
    from napari_shadowinv.cli._export import write_movie

    frames = write_movie(
        store,
        out,
        variable=variable,
        shots=shots,
        rate=rate,
        limits=limits,
        overwrite=overwrite,
    )
    if not quiet:
        say(f"Wrote {out}: {frames} shots, {frames / rate:.1f} s")
