"""The command `shadowinv`: invert, predict, look at files, try it out.

Every heavy import waits until a command needs it, so that ``--help`` answers at once.
"""

from __future__ import annotations

import functools
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, nullcontext
from io import TextIOWrapper
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ParamSpec

import typer

from napari_shadowinv.errors import FileFormatError, InputError, InversionCancelled

if TYPE_CHECKING:
    import numpy as np
    import xarray
    from numpy.typing import NDArray
    from rich.table import Table

    from napari_shadowinv.inversion import Inversion
    from napari_shadowinv.io import Radiograph
    from napari_shadowinv.options import InversionOptions
    from napari_shadowinv.physics.setup import OpticalSetup, ProtonSetup
    from napari_shadowinv.progress import OnProgress, Progress

__all__ = ["app"]

EXIT_MISTAKE = 2
EXIT_NOT_CONVERGED = 3
EXIT_CANCELLED = 130

P = ParamSpec("P")

app = typer.Typer(
    name="shadowinv",
    help="Shadowgrams and proton radiographs to deflection potentials and fields.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
)


def _guarded(command: Callable[P, None]) -> Callable[P, None]:
    """Turn a user's mistake into one sentence, and Ctrl-C into a word."""

    @functools.wraps(command)
    def run(*args: P.args, **kwargs: P.kwargs) -> None:
        try:
            command(*args, **kwargs)
        except (KeyboardInterrupt, InversionCancelled):
            _say_on_stderr("Cancelled")
            raise typer.Exit(EXIT_CANCELLED) from None
        except (OSError, MemoryError) as error:
            _say_on_stderr(str(error) or "There is not enough memory for this")
            raise typer.Exit(EXIT_MISTAKE) from None
        except ValueError as error:
            if not _is_mistake(error):
                raise
            _say_on_stderr(str(error))
            raise typer.Exit(EXIT_MISTAKE) from None

    return run


def _is_mistake(error: ValueError) -> bool:
    """Tell a user's mistake from one of ours, which deserves its traceback."""
    from pydantic import ValidationError

    return isinstance(error, InputError | ValidationError)


def _say_on_stderr(text: str) -> None:
    from rich.console import Console
    from rich.text import Text

    line = " ".join(text.split())
    Console(stderr=True).print(Text(line, style="bold red"), soft_wrap=True)


def _say(text: str | Table) -> None:
    from rich.console import Console

    Console().print(text, soft_wrap=isinstance(text, str), highlight=False)


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
@_guarded
def invert(
    image: Annotated[
        Path,
        typer.Argument(help="TIFF, PNG, BMP, JPEG, NPY or pradformat HDF5.", show_default=False),
    ],
    source: SourceFile = None,
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
    out_path, report_path = _outputs(image, out, report)
    _check_outputs({out_path: _result_suffixes(), report_path: _FIGURE_SUFFIXES}, overwrite)
    _protect([out_path, report_path], [image, source, setup, options])
    flags = {"n_sites": n_sites, "threads": threads, "seed": seed}
    chosen = _options(options, flags, clip_negative)
    shot, beam, geometry = _load(image, source, setup, channel, bin_)
    if out_path.suffix.lower() in (".h5", ".hdf5"):
        from napari_shadowinv.io.pradformat import check_pradformat_setup

        check_pradformat_setup(geometry)
    inversion = _inverted(shot, beam, chosen, quiet)
    _write_all(inversion, shot, beam, geometry, out_path, report_path, overwrite)
    if not quiet:
        _say(_summary(inversion, shot, beam, geometry, [out_path, report_path]))
    _alarm_unless_converged(inversion, out_path)


@app.command()
@_guarded
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
    from napari_shadowinv.io import read_radiograph, read_toml, write
    from napari_shadowinv.io.writing import IMAGE_SUFFIXES

    path = Path(f"{field.stem}_image.tif") if out is None else out
    _check_outputs({path: IMAGE_SUFFIXES}, overwrite)
    _protect([path], [field, source, setup])
    geometry = None if setup is None else _setup_from(read_toml(setup), {}, str(setup))
    displacement, beam, own_geometry = _field_from(field)
    if source is not None:
        beam = read_radiograph(source, channel=channel).image
    from napari_shadowinv.physics.forward import synthetic_image

    image = synthetic_image(displacement, beam)
    write(path, image, setup=geometry or own_geometry, overwrite=overwrite)
    if not quiet:
        kept = image.sum() / (image.size if beam is None else beam.sum())
        _say(f"Wrote {path}: {_size(image)}, {kept:.2%} of the flux lands inside the image")


@app.command()
@_guarded
def info(
    file: Annotated[Path, typer.Argument(help="An image or a result.", show_default=False)],
) -> None:
    """Tell what a file is and what is in it."""
    _say(_described(file))


@app.command()
@_guarded
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
    chosen = _options(None, {"n_sites": n_sites}, clip_negative=True)
    _make_folder(out)
    from napari_shadowinv.io import Radiograph
    from napari_shadowinv.io.dataset import displacement_from_potential
    from napari_shadowinv.physics.phantoms import paper_setup
    from napari_shadowinv.physics.poisson import poisson_invert

    setup = paper_setup()
    image, truth = _demo_shot(setup, dm, noise)
    inversion = _inverted(Radiograph(image), None, chosen, quiet=False)
    poisson = displacement_from_potential(poisson_invert(image))
    fields = {"True": truth, "Retrieved": inversion.displacement, "Poisson": poisson}
    written = _write_demo(out, f"toroid_{dm:g}", inversion, setup, fields)
    _say(_demo_table(fields, inversion, setup, written))
    _alarm_unless_converged(inversion, written[0])


_FIGURE_SUFFIXES = (".png", ".pdf", ".svg")


def _result_suffixes() -> tuple[str, ...]:
    from napari_shadowinv.io.writing import RESULT_SUFFIXES

    return RESULT_SUFFIXES


def _outputs(image: Path, out: Path | None, report: Path | None) -> tuple[Path, Path]:
    """Choose the names of result and figure; the figure never takes the image's name."""
    result = Path(f"{image.stem}.shadowinv") if out is None else out
    if report is not None:
        return result, report
    figure = result.with_suffix(".png")
    if _is_same(figure, image):
        figure = result.with_name(f"{result.stem}_report.png")
    return result, figure


def _check_outputs(outputs: Mapping[Path, tuple[str, ...]], overwrite: bool) -> None:
    from napari_shadowinv.io import check_output

    for path, suffixes in outputs.items():
        check_output(path, overwrite, suffixes=suffixes)


def _protect(outputs: list[Path], inputs: list[Path | None]) -> None:
    """Refuse to overwrite what is read, whatever --overwrite says."""
    for path in outputs:
        if any(other is not None and _is_same(path, other) for other in inputs):
            raise InputError(f"{path} is both read and written: choose another name for the output")
    if len({path.resolve() for path in outputs}) < len(outputs):
        raise InputError(f"{outputs[0]} is to be written twice: choose two names")


def _is_same(first: Path, second: Path) -> bool:
    return first.resolve() == second.resolve()


def _options(path: Path | None, flags: Mapping[str, Any], clip_negative: bool) -> InversionOptions:
    """Options from a file, with flags on top."""
    from napari_shadowinv.io import read_toml
    from napari_shadowinv.options import InversionOptions
    from napari_shadowinv.validation import validated

    chosen = {} if path is None else read_toml(path)
    chosen |= {name: value for name, value in flags.items() if value is not None}
    if clip_negative:
        chosen["negative"] = "clip"
    return validated(InversionOptions, chosen, "options" if path is None else str(path))


def _load(
    image: Path, source: Path | None, setup: Path | None, channel: str | None, factor: int
) -> tuple[Radiograph, Radiograph | None, ProtonSetup | OpticalSetup | None]:
    """Read what is to be inverted, binned alike."""
    from napari_shadowinv.io import binned_setup, read_radiograph, read_toml

    entries = None if setup is None else read_toml(setup)
    shot = read_radiograph(image, channel=channel)
    beam = None if source is None else read_radiograph(source, channel=channel)
    geometry = shot.setup
    if entries is not None:
        geometry = _setup_from(entries, shot.metadata.get("geometry", {}), str(setup))
    if geometry is not None:
        geometry = binned_setup(geometry, factor)
    return shot.binned(factor), None if beam is None else beam.binned(factor), geometry


def _setup_from(
    entries: Mapping[str, Any], known: Mapping[str, Any], where: str
) -> ProtonSetup | OpticalSetup:
    """Setup from a file's entries; what they leave out comes from the image's own file."""
    from napari_shadowinv.physics.setup import setup_from_dict

    if entries.get("kind", known.get("kind")) != known.get("kind"):
        known = {}
    pixel_sizes = {"pixel_size", "detector_pixel_size"}
    if pixel_sizes & entries.keys():
        known = {name: value for name, value in known.items() if name not in pixel_sizes}
    return setup_from_dict({**known, **entries}, where)


@contextmanager
def _interruptible() -> Iterator[Callable[[], bool]]:
    """Yield a `should_stop` that Ctrl-C makes true.

    The interrupt is raised as usual, too; should a callback of compiled code swallow it,
    the core still stops at its next step.
    """
    asked = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield asked.is_set
        return

    def stop(number: int, frame: object) -> None:
        asked.set()
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGINT, stop)
    try:
        yield asked.is_set
    finally:
        signal.signal(signal.SIGINT, before)


@contextmanager
def _progress_bars() -> Iterator[OnProgress | None]:
    """One bar for each stage, on a terminal only."""
    from rich.console import Console
    from rich.progress import BarColumn, TextColumn, TimeElapsedColumn
    from rich.progress import Progress as Bars

    console = Console(stderr=True)
    if not console.is_terminal:
        yield None
        return
    columns = (
        TextColumn("{task.description:<10}"),
        BarColumn(),
        TimeElapsedColumn(),
        TextColumn("[dim]{task.fields[message]}"),
    )
    with Bars(*columns, console=console) as bars:
        tasks: dict[str, Any] = {}

        def show(progress: Progress) -> None:
            if progress.stage not in tasks:
                for task in tasks.values():
                    bars.update(task, total=1, completed=1)
                    bars.stop_task(task)
                tasks[progress.stage] = bars.add_task(progress.stage, total=None, message="")
            bars.update(
                tasks[progress.stage],
                total=progress.total,
                completed=progress.step,
                message=progress.message,
            )

        yield show
        for task in tasks.values():
            bars.update(task, total=1, completed=1)


def _inverted(
    shot: Radiograph, source: Radiograph | None, options: InversionOptions, quiet: bool
) -> Inversion:
    from napari_shadowinv.inversion import invert

    with _interruptible() as should_stop, nullcontext() if quiet else _progress_bars() as show:
        try:
            return invert(
                shot.image,
                source=None if source is None else source.image,
                options=options,
                on_progress=show,
                should_stop=should_stop,
            )
        except InputError as error:
            raise InputError(f"{shot.path}: {error}" if shot.path else str(error)) from error


def _write_all(
    inversion: Inversion,
    shot: Radiograph,
    source: Radiograph | None,
    setup: ProtonSetup | OpticalSetup | None,
    out: Path,
    report: Path,
    overwrite: bool,
) -> None:
    from napari_shadowinv.io import write
    from napari_shadowinv.plotting import report_figure, save_figure

    title = "" if shot.path is None else shot.path.name
    figure = report_figure(inversion, setup, title=title)
    write(out, inversion, setup=setup, shot=shot, source=source, overwrite=overwrite)
    save_figure(report, figure, overwrite)


def _alarm_unless_converged(inversion: Inversion, out: Path) -> None:
    report = inversion.report
    if not report.converged:
        _say_on_stderr(
            f"NOT CONVERGED: {out} is written, but its flux residual is {report.residual:.2g} "
            f"where {report.tolerance:.2g} was asked for: do not trust the field"
        )
        raise typer.Exit(EXIT_NOT_CONVERGED)


def _two_columns(title: str, rows: list[tuple[str, str]]) -> Table:
    from rich import box
    from rich.table import Table
    from rich.text import Text

    table = Table(title=title, title_justify="left", box=box.SIMPLE, show_header=False)
    table.add_column(style="bold", no_wrap=True)
    table.add_column(overflow="fold")
    for name, value in rows:
        table.add_row(name, Text(value, style="yellow" if name == "warning" else ""))
    return table


def _size(array: NDArray[Any]) -> str:
    """Height and width are given as people do, width first."""
    return f"{array.shape[1]} × {array.shape[0]} px (width × height)"


def _summary(
    inversion: Inversion,
    shot: Radiograph,
    source: Radiograph | None,
    setup: ProtonSetup | OpticalSetup | None,
    written: list[Path],
) -> Table:
    report = inversion.report
    rows = [
        ("image", f"{shot.path}, {_size(inversion.image)}{_binning(shot)}"),
        ("source", "uniform" if source is None else str(source.path)),
        ("setup", _setup_text(setup, shot)),
        ("sites", f"{report.n_sites:,}"),
        *_quality_rows(inversion),
        *_peak_rows(inversion.displacement, setup),
        ("time", _times(report.seconds)),
        *[("warning", warning) for warning in report.warnings],
        *[("written", str(path)) for path in written],
    ]
    return _two_columns("Inversion", rows)


def _binning(shot: Radiograph) -> str:
    factor = shot.metadata.get("bin", 1)
    if factor == 1:
        return ""
    rows, columns = shot.metadata["cropped"]
    cut = f", {rows} rows and {columns} columns cut off" if rows or columns else ""
    return f", binned {factor} × {factor}{cut}"


def _setup_text(setup: ProtonSetup | OpticalSetup | None, shot: Radiograph | None = None) -> str:
    if setup is not None:
        probe = (
            f"{setup.energy:g} MeV {setup.species}"
            if setup.kind == "proton"
            else (f"light of {setup.wavelength * 1e9:g} nm")
        )
        return (
            f"{probe}, magnification {setup.magnification:.4g}, "
            f"pixel {setup.object_pixel_size * 1e6:.4g} µm at the object"
        )
    known = {} if shot is None else shot.metadata.get("geometry", {})
    if known:
        return "none: the file tells the geometry but not the energy; give it with --setup"
    return "none: results in pixels; give --setup for SI units"


def _quality_rows(inversion: Inversion) -> list[tuple[str, str]]:
    report = inversion.report
    residual = 100 * float((inversion.residual**2).mean() ** 0.5 / inversion.source.mean())
    verdict = "converged" if report.converged else "NOT converged"
    return [
        (
            "flux residual",
            f"{report.residual:.2g} of a cell, asked for {report.tolerance:.2g}: {verdict}",
        ),
        ("image residual", f"{residual:.2g} % of the mean (root mean square)"),
        ("iterations", f"{report.iterations} on {len(report.levels)} levels"),
        (
            "floor",
            f"{report.floor:g} of the mean: {report.floored_pixels} pixels raised, "
            f"{report.clipped_pixels} clipped",
        ),
        ("caustics", f"{inversion.caustic.mean():.2%} of the pixels"),
    ]


def _peak_rows(
    displacement: NDArray[np.float64], setup: ProtonSetup | OpticalSetup | None
) -> list[tuple[str, str]]:
    from napari_shadowinv.plotting import shown_fields

    (pixels,) = shown_fields([displacement], None)
    row, column = pixels.peak
    rows = [("displacement", f"{pixels.peak_text}, at y = {row}, x = {column} px")]
    if setup is not None:
        (field,) = shown_fields([displacement], setup)
        rows.append(("field", field.peak_text))
    return rows


def _times(seconds: Mapping[str, float]) -> str:
    stages = ", ".join(f"{stage} {value:.2f}" for stage, value in seconds.items())
    return f"{sum(seconds.values()):.2f} s ({stages})"


def _field_from(
    path: Path,
) -> tuple[NDArray[np.float64], NDArray[np.float64] | None, ProtonSetup | OpticalSetup | None]:
    """Displacement, and where the file has them its source and setup."""
    from napari_shadowinv.io import read_dataset, setup_from_dataset
    from napari_shadowinv.io.arrays import read_npy
    from napari_shadowinv.io.dataset import displacement_from_potential
    from napari_shadowinv.io.files import kind_of

    kind = kind_of(path)
    if kind == "hdf5":
        dataset = read_dataset(path)
        source = dataset["source"].values if "source" in dataset else None
        return dataset["displacement"].values, source, setup_from_dataset(dataset)
    array = read_npy(path) if kind == "npy" else None
    if array is not None and array.ndim == 2:
        return displacement_from_potential(array), None, None
    if array is not None and array.ndim == 3 and array.shape[0] == 2:
        return array.astype(float), None, None
    found = f"a {kind.upper()} picture" if array is None else f"an array of shape {array.shape}"
    raise FileFormatError(
        f"{path} is {found}: expected a .shadowinv result, or NPY with a displacement "
        "(2, height, width) in px or a potential (height, width) in px²"
    )


def _described(path: Path) -> Table:
    from napari_shadowinv.io import Radiograph, read
    from napari_shadowinv.io.arrays import read_npy
    from napari_shadowinv.io.files import kind_of
    from napari_shadowinv.io.images import read_picture

    kind = kind_of(path)
    if kind == "npy":
        return _two_columns(str(path), [("kind", "NPY array"), *_array_rows(read_npy(path))])
    if kind != "hdf5":
        array, metadata = read_picture(path, kind)
        rows = [("kind", f"{kind.upper()} picture, {metadata['bits']} bits per sample")]
        if array.ndim == 3:
            rows.append(("channels", f"{array.shape[-1]}: choose with --channel if they differ"))
        return _two_columns(str(path), rows + _array_rows(array))
    content = read(path)
    if isinstance(content, Radiograph):
        rows = [("kind", "pradformat radiograph"), *_array_rows(content.image)]
        rows += [(key, f"{value:g}") for key, value in _lengths(content.metadata["geometry"])]
        return _two_columns(str(path), [*rows, ("setup", _setup_text(content.setup, content))])
    return _two_columns(str(path), _result_rows(content))


def _lengths(geometry: Mapping[str, Any]) -> list[tuple[str, float]]:
    units = {"energy": "MeV"}
    return [
        (f"{name.replace('_', ' ')} ({units.get(name, 'm')})", value)
        for name, value in geometry.items()
        if isinstance(value, int | float)
    ]


def _array_rows(array: NDArray[Any]) -> list[tuple[str, str]]:
    import numpy as np

    values = array.astype(np.float64)
    finite = values[np.isfinite(values)]
    rows = [("shape", f"{array.shape}, [y, x]" if array.ndim == 2 else str(array.shape))]
    rows.append(("dtype", str(array.dtype)))
    if finite.size:
        rows.append(("min, mean, max", f"{finite.min():g}, {finite.mean():g}, {finite.max():g}"))
    rows.append(("negative", f"{np.count_nonzero(finite < 0)} values"))
    rows.append(("NaN or infinite", f"{values.size - finite.size} values"))
    return rows


def _result_rows(dataset: xarray.Dataset) -> list[tuple[str, str]]:
    from napari_shadowinv.io import inversion_from_dataset, setup_from_dataset

    setup = setup_from_dataset(dataset)
    displacement = dataset["displacement"].values
    peaks = _peak_rows(displacement, setup)
    size = ("image", _size(displacement[0]))
    if "options" not in dataset.attrs:
        return [("kind", "pradformat inversion"), size, ("setup", _setup_text(setup)), *peaks]
    inversion = inversion_from_dataset(dataset)
    report = inversion.report
    return [
        ("kind", f"result of shadowinv {dataset.attrs['package_version']}"),
        ("created", str(dataset.attrs["created"])),
        *[
            (name.replace("_", " "), str(dataset.attrs[name]))
            for name in ("input_file", "input_sha256", "source_file", "source_sha256")
            if name in dataset.attrs
        ],
        size,
        ("setup", _setup_text(setup)),
        ("sites", f"{report.n_sites:,}"),
        *_quality_rows(inversion),
        *peaks,
        ("time", _times(report.seconds)),
        *[("warning", warning) for warning in report.warnings],
        ("options", ", ".join(f"{k} = {v}" for k, v in inversion.options.model_dump().items())),
    ]


_DEMO_SHAPE = (200, 200)
_DEMO_SIGMA = 30e-6
_DEMO_SEED = 0


def _demo_shot(
    setup: ProtonSetup, dm: float, noise: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Image with noise, and the displacement that made it."""
    import numpy as np

    from napari_shadowinv.physics.forward import synthetic_image
    from napari_shadowinv.physics.phantoms import toroid

    truth = toroid(_DEMO_SHAPE, setup, peak=dm, sigma=_DEMO_SIGMA).displacement
    image = synthetic_image(truth)
    grain = np.random.default_rng(_DEMO_SEED).normal(size=image.shape)
    return image + noise * image.mean() * grain, truth


def _make_folder(path: Path) -> None:
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise FileFormatError(
            f"{path} cannot be made a folder ({error.strerror}): choose another name"
        ) from None


def _write_demo(
    folder: Path,
    name: str,
    inversion: Inversion,
    setup: ProtonSetup,
    fields: Mapping[str, NDArray[np.float64]],
) -> list[Path]:
    from napari_shadowinv.io import write
    from napari_shadowinv.plotting import comparison_figure, report_figure, save_figure

    caption = "Errors: " + "; ".join(
        f"{which} {_errors_text(fields, which)}" for which in ("Retrieved", "Poisson")
    )
    comparison = comparison_figure(fields, setup, title="True and retrieved", caption=caption)
    report = report_figure(inversion, setup, title=f"Demo {name}")
    return [
        write(folder / f"{name}.shadowinv", inversion, setup=setup, overwrite=True),
        save_figure(folder / f"{name}.png", report, overwrite=True),
        save_figure(folder / f"{name}_comparison.png", comparison, overwrite=True),
    ]


def _errors_text(fields: Mapping[str, NDArray[np.float64]], name: str) -> str:
    import numpy as np

    truth, found = fields["True"], fields[name]
    largest, strongest = (float(np.hypot(*field).max()) for field in (truth, found))
    if not largest:
        return f"peak {strongest:.3g} px where the truth is zero"
    distance = float(np.linalg.norm(found - truth) / np.linalg.norm(truth))
    return f"peak {strongest / largest - 1:+.1%}, L2 {distance:.1%}"


def _demo_table(
    fields: Mapping[str, NDArray[np.float64]],
    inversion: Inversion,
    setup: ProtonSetup,
    written: list[Path],
) -> Table:
    report = inversion.report
    rows = [
        ("setup", _setup_text(setup)),
        ("sites", f"{report.n_sites:,}"),
        *_quality_rows(inversion),
        *_peak_rows(inversion.displacement, setup),
        ("error", _errors_text(fields, "Retrieved")),
        ("error of Poisson", _errors_text(fields, "Poisson")),
        ("time", _times(report.seconds)),
        *[("warning", warning) for warning in report.warnings],
        *[("written", str(path)) for path in written],
    ]
    return _two_columns("Demo", rows)
