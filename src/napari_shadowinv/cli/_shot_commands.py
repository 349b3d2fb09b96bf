"""Commands for one shot: `invert`, `rerun`, `forward`, `info` and `demo`."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from typer import Exit, Option, echo

from napari_shadowinv._system.safety import as_file_errors
from napari_shadowinv.cli import _flags, _inputs
from napari_shadowinv.cli._settings import (
    FILE_KEYS,
    INVERSION_SECTIONS,
    Sections,
    Settings,
    settings_of,
)
from napari_shadowinv.cli._summary import (
    fact_rows,
    headline_row,
    setup_text,
    size_text,
    two_columns,
    written_rows,
)
from napari_shadowinv.cli._terminal import (
    exit_unless_sound,
    invert_shot,
    notify_errors,
    say,
    warn_of_setups,
    work_callbacks,
)
from napari_shadowinv.errors import FileFormatError, InputError
from napari_shadowinv.facts import ResultKind, percent
from napari_shadowinv.io.formats import IMAGE_WRITERS, NETCDF_SUFFIX, PNG, RESULT, TIFF, kind_of
from napari_shadowinv.physics.beam import displacement_from_potential
from napari_shadowinv.physics.trace_options import SizedView, TraceOptions
from napari_shadowinv.preprocessing import MeasuredSource
from napari_shadowinv.shot import Shot

if TYPE_CHECKING:
    import xarray

    from napari_shadowinv._typing import AnyArray, FloatArray
    from napari_shadowinv.physics.setup import Setup
    from napari_shadowinv.physics.tracing import TracedImage

# Help of arguments, where it is longer than a line.
HELP = {
    "out": "Result: .shadowinv, .h5 or .csv.",
    "image": "The image, if it has moved or changed; for a fit, all images in their order. "
    "Default: the files named in the result, in its folder or the current one.",
    "rerun_out": "Result file. Default: the result's name with _again, in the current folder.",
    "other_folders": "Also read the files in other folders that the result names.",
    "field": "Result, displacement (2, H, W) in px, potential (H, W) in px², or 3-D field "
    "(openPMD, NetCDF).",
    "truth": "NetCDF file of line integrals.",
    "setup": "TOML file of the prediction's geometry.",
    "recorded_with": "TOML file of the measurement's.",
    "deflector": "Cause of the deflection.",
    "dispersion": "New ln η / old ln η of an index.",
    "system": "Print the versions and the system instead, for a bug report.",
    "noise": "Standard deviation of the noise, as a fraction of the mean.",
    "predicted_image": "Image: .tif, .npy or .png.",
    "all": "List each shot of a store.",
    "verify": "Compare all files of a store with their checksums; exit code 1 if one is damaged.",
}
_DEMO_PEAK = 97.0  # MG·µm; caustics form from about 185
INVERT_EPILOG = """
shadowinv invert shot.tif --source reference.tif --setup setup.toml --bin 4

shadowinv invert shot.tif --step 'hot-pixels 6' --set options.tolerance=1e-4

Exit codes: 0 success; 1 no figure; 2 invalid input; 3 written, but not converged; 130 cancelled.
"""


@notify_errors
@_flags.takes_flags
def invert(
    image: _flags.ImageFile,
    flags: _flags.InversionFlags,
    settings: Annotated[
        list[str] | None,
        _flags.setting(INVERSION_SECTIONS, "options.tolerance=1e-4", FILE_KEYS),
    ] = None,
    save_recipe: _flags.SaveRecipe = None,
    out: Annotated[Path | None, Option(help=HELP["out"])] = None,
    figure: _flags.Figure = None,
    overwrite: _flags.Overwrite = False,
    quiet: _flags.QuietInversion = False,
) -> None:
    """Retrieve the deflection potential of one image.

    Writes a result with all options, and a figure next to it.
    """
    from napari_shadowinv.pipeline.files import read_part, write_recipe

    result, figure = _inputs.result_and_figure(image, out, figure)
    files = _inputs.result_outputs(ResultKind.INVERSION, result, figure)
    outputs = _inputs.check_outputs([*files, (save_recipe, (".toml",))], overwrite)
    _inputs.protect(outputs, [image, flags.recipe, flags.setup])
    chosen = _inputs.recipe_from(
        flags, settings_of(settings or (), INVERSION_SECTIONS, flags.by_key, FILE_KEYS)
    )
    _inputs.protect_files_of(chosen, outputs)
    shot = read_part(image, flags.channel, flags.variable)
    chosen = chosen.model_copy(update={"setup": _inputs.setup_for(flags.setup, shot, chosen)})
    _inputs.check_setup(result, chosen.setup)
    measured = chosen.source
    if isinstance(measured, MeasuredSource) and measured != MeasuredSource():
        # In its own file or in the image's; the channel is that of both.
        beam = read_part(measured.file or image, flags.channel, measured.variable)
        shot = replace(shot, source=beam)
    printed = warn_of_setups([(chosen.setup or shot.setup, shot.shape)])
    inversion = invert_shot(chosen, shot, quiet)
    failed = _inputs.write_result(inversion, [str(image)], result, figure, overwrite)
    if save_recipe is not None:
        write_recipe(save_recipe, chosen, overwrite=overwrite)
    if not quiet:
        rows = [
            headline_row(inversion.headline),
            *fact_rows(inversion.facts, printed),
            ("setup", setup_text(inversion.setup, shot, inversion.image.shape)),
            *written_rows(outputs, failed),
        ]
        say(two_columns(f"{shot.path}, {size_text(inversion.image)}", rows))
    exit_unless_sound(inversion, result)
    _inputs.exit_unless_drawn(failed)


@notify_errors
def rerun(
    result: Annotated[Path, _flags.argument(help="A .shadowinv result of this program.")],
    image: Annotated[list[Path] | None, _flags.argument(help=HELP["image"])] = None,
    source: Annotated[Path | None, Option(help="The measured source, if it has moved.")] = None,
    out: Annotated[Path | None, Option(help=HELP["rerun_out"])] = None,
    figure: _flags.Figure = None,
    other_folders: Annotated[bool, Option("--other-folders", help=HELP["other_folders"])] = False,
    overwrite: _flags.Overwrite = False,
    quiet: _flags.QuietInversion = False,
) -> None:
    """Repeat a result from the recipe it contains, and report the changes.

    With the same files and version, the result is identical bit for bit.
    """
    from napari_shadowinv.pipeline.rerun import collect_rerun

    target = out or Path(f"{result.stem}_again{RESULT.suffix}")
    again_out, figure = _inputs.result_and_figure(result, target, figure)
    files = _inputs.result_outputs(ResultKind.INVERSION, again_out, figure)
    _inputs.check_outputs(files, overwrite)
    inputs = collect_rerun(result, image, source=source, other_folders=other_folders)
    figures = [_inputs.left_out_path(figure)] if inputs.leaves_out else []
    files = _inputs.result_outputs(inputs.kind, again_out, *figures)
    _inputs.check_outputs(files, overwrite)
    _inputs.protect([again_out, figure, *figures], [result, *inputs.files])
    setups = [(shot.setup, getattr(shot.image, "shape", None)) for shot in inputs.shots]
    printed = warn_of_setups(setups)
    with work_callbacks(quiet) as callbacks:
        again = inputs.run(**callbacks)
    names = [str(file) for file in inputs.files[: len(inputs.shots)]] or [str(result)]
    failed = _inputs.write_result(
        again.content, names, again_out, figure, overwrite, again.left_out
    )
    content: Any = again.content
    if not quiet:
        rows = [
            *[("file", name) for name in names],
            *[("changed", text) for text in again.changes or ("nothing",)],
            ("difference", again.difference),
            headline_row(content.headline),
            *fact_rows(content.facts, printed),
            *written_rows([again_out, figure], failed),
        ]
        say(two_columns("Rerun", rows))
    exit_unless_sound(content, again_out, again.left_out)
    _inputs.exit_unless_drawn(failed)


FORWARD_SECTIONS: Sections = {"view": SizedView, "trace": TraceOptions}
FORWARD_EPILOG = """
shadowinv forward shot.shadowinv --setup lower.toml --deflector plasma

shadowinv forward fields.h5 --setup setup.toml --set view.beam=x

Causes: magnetic-field, electric-field, plasma, refractive-index.
"""


@dataclass(frozen=True, kw_only=True)
class ExperimentFlags:
    """Flags of the experiment that an image is predicted for."""

    setup: Annotated[Path | None, Option(help=HELP["setup"])] = None
    recorded_with: Annotated[Path | None, Option(help=HELP["recorded_with"])] = None
    deflector: Annotated[str | None, Option(metavar="CAUSE", help=HELP["deflector"])] = None
    dispersion: Annotated[float, Option(help=HELP["dispersion"])] = 1.0
    source: _flags.SourceFile = None
    channel: _flags.Channel = None
    variable: _flags.Variable = None


@notify_errors
@_flags.takes_flags
def forward(
    field: Annotated[Path, _flags.argument(help=HELP["field"])],
    flags: ExperimentFlags,
    settings: Annotated[
        list[str] | None, _flags.setting(FORWARD_SECTIONS, "trace.output=counts")
    ] = None,
    out: Annotated[Path | None, Option(help=HELP["predicted_image"])] = None,
    truth: Annotated[Path | None, Option(help=HELP["truth"])] = None,
    overwrite: _flags.Overwrite = False,
    quiet: _flags.Quiet = False,
) -> None:
    """Predict the image of a displacement field or of a 3-D field, for any setup.

    The source is the result's own if the setup is the same, else uniform.
    """
    from napari_shadowinv.io import is_field_grid, read_radiograph, replacing, write
    from napari_shadowinv.pipeline.files import setup_from

    path = Path(f"{field.stem}_image{TIFF.suffix}") if out is None else out
    outputs = _inputs.check_outputs(
        [(path, tuple(IMAGE_WRITERS)), (truth, (NETCDF_SUFFIX,))], overwrite
    )
    _inputs.protect(outputs, [field, flags.source, flags.setup, flags.recorded_with])
    chosen = settings_of(settings or (), FORWARD_SECTIONS, {})
    setup = None if flags.setup is None else setup_from(flags.setup)
    original = None if flags.recorded_with is None else setup_from(flags.recorded_with)
    beam = None
    if flags.source is not None:
        beam = read_radiograph(flags.source, channel=flags.channel).image
    if is_field_grid(field):
        if original is not None or flags.deflector is not None or flags.dispersion != 1:
            raise InputError(
                f"received --recorded-with, --deflector or --dispersion, but {field} is a 3-D "
                "field, which needs only --setup: leave them out"
            )
        traced = trace_field(field, setup, beam, flags, chosen, quiet)
        write(path, traced.image, setup=traced.setup, overwrite=overwrite)
        if truth is not None:
            with replacing(truth, overwrite) as temporary:
                traced.to_dataset().to_netcdf(temporary, engine="h5netcdf")
        if not quiet:
            rows = [
                ("setup", setup_text(traced.setup, shape=traced.image.shape)),
                *fact_rows(traced.facts),
                *written_rows(outputs),
            ]
            say(two_columns("Traced field", rows))
        return
    if chosen.values or truth is not None:
        names = ", ".join(chosen.values) or "--truth"
        raise InputError(f"received {names}, but {field} is no 3-D field: leave them out")
    content = field_from(field, flags.variable)
    original, target = choose_setups(content, setup, original, flags.deflector, flags.dispersion)
    # The beam of another experiment is not known.
    if beam is None and original == target:
        beam = content.source
    image, note = predict_image(
        content.displacement, beam, original, target, flags.deflector, flags.dispersion
    )
    write(path, image, setup=target, overwrite=overwrite)
    if not quiet:
        inside = image.sum() / (image.size if beam is None else beam.sum())
        say(
            f"Wrote {path}: {size_text(image)}, {percent(inside)} of the flux lands inside the "
            "image"
        )
        if note:
            say(note)


@notify_errors
def info(
    file: Annotated[Path | None, _flags.argument(help="An image, a result or a store.")] = None,
    variable: _flags.Variable = None,
    every: Annotated[bool, Option("--all", help=HELP["all"])] = False,
    verify: Annotated[bool, Option("--verify", help=HELP["verify"])] = False,
    system: Annotated[bool, Option("--system", help=HELP["system"])] = False,
) -> None:
    """Describe a file and its contents, or the shots of a store and why some failed."""
    from napari_shadowinv.cli import _info
    from napari_shadowinv.io import is_stack

    if system:
        if file is not None or variable is not None:
            raise InputError("--system describes the installation: it takes no file or variable")
        echo(_info.system_report())
        return
    if file is None:
        raise InputError("no file given: name an image or a result, or use --system")
    if is_stack(file):
        from napari_shadowinv.cli._batch import EXIT_FAILED_SHOTS, status_tables

        tables, is_damaged = status_tables(file, every, verify)
        for table in tables:
            say(table)
        if verify and is_damaged:
            raise Exit(EXIT_FAILED_SHOTS)
        return
    if every or verify:
        raise InputError(f"{file} is not a stack of shots: --all and --verify describe a store")
    say(_info.file_table(file, variable))


@notify_errors
def demo(
    out: Annotated[Path, Option(help="Output folder.")] = Path("demo"),
    noise: Annotated[float, Option(help=HELP["noise"])] = 0.1,
    settings: Annotated[
        list[str] | None, _flags.setting(INVERSION_SECTIONS, "options.n_sites=6000")
    ] = None,
) -> None:
    """Simulate a proton radiograph of a toroidal field, invert it and compare with the truth.

    The setup follows Kasim et al., arXiv:1607.04179, section IV.
    """
    if not 0 <= noise < float("inf"):
        raise InputError(f"--noise is {noise:g}: it must be 0 or more, as a fraction of the mean")
    from napari_shadowinv.io.files import make_folder

    chosen = _inputs.recipe_from(
        _flags.InversionFlags(),
        settings_of(settings or (), INVERSION_SECTIONS, {"options.negative": ("", "clip")}),
    )
    make_folder(out)
    from napari_shadowinv.io import write
    from napari_shadowinv.physics.forward import synthetic_image
    from napari_shadowinv.physics.phantoms import paper_setup, toroid
    from napari_shadowinv.physics.poisson import poisson_invert
    from napari_shadowinv.plotting import comparison_figure, report_figure

    setup = paper_setup()
    truth = toroid((200, 200), setup, peak=_DEMO_PEAK, sigma=30e-6).displacement
    image = synthetic_image(truth)
    grain = np.random.default_rng(0).normal(size=image.shape)
    image = image + noise * image.mean() * grain
    # The simulated beam is known: it is flat.
    shot = Shot(image, source=np.ones(image.shape))
    inversion = invert_shot(chosen.model_copy(update={"setup": setup}), shot)
    poisson = displacement_from_potential(poisson_invert(image))
    fields = {"True": truth, "Retrieved": inversion.displacement, "Poisson": poisson}
    errors = {name: _error_text(fields[name], truth) for name in ("Retrieved", "Poisson")}
    caption = "Errors: " + "; ".join(f"{field} {error}" for field, error in errors.items())
    name = f"toroid_{_DEMO_PEAK:g}"
    figures = {
        out / f"{name}{PNG.suffix}": lambda: report_figure(inversion, setup, title=f"Demo {name}"),
        out / f"{name}_comparison{PNG.suffix}": lambda: comparison_figure(
            fields, setup, title="True and retrieved", caption=caption
        ),
    }
    result = write(out / f"{name}{RESULT.suffix}", inversion, setup=setup, overwrite=True)
    failed = _inputs.write_figures(figures, overwrite=True)
    rows = [
        headline_row(inversion.in_units(setup).headline),
        *fact_rows(inversion.in_units(setup).facts),
        ("setup", setup_text(setup, shape=image.shape)),
        ("error", errors["Retrieved"]),
        ("error of Poisson", errors["Poisson"]),
        *written_rows([result, *figures], failed),
    ]
    say(two_columns("Demo", rows))
    exit_unless_sound(inversion, result)
    _inputs.exit_unless_drawn(failed)


def _error_text(estimate: FloatArray, truth: FloatArray) -> str:
    true_peak, peak = (float(np.hypot(*field).max()) for field in (truth, estimate))
    if not true_peak:
        return f"peak {peak:.3g} px where the truth is zero"
    distance = float(np.linalg.norm(estimate - truth) / np.linalg.norm(truth))
    return f"peak {100 * (peak / true_peak - 1):+.1f} %, L2 {percent(distance)}"


def trace_field(
    path: Path,
    setup: Setup | None,
    source: AnyArray | None,
    flags: ExperimentFlags,
    settings: Settings,
    quiet: bool,
) -> TracedImage:
    """Trace particles through the 3-D field in a file."""
    from napari_shadowinv.pipeline.traced_file import trace_file

    view = settings.change("view", SizedView())
    if source is not None and {"view.height", "view.width"} & settings.values.keys():
        raise InputError(
            "received view.height or view.width, but --source sets the size: leave it out"
        )
    with work_callbacks(quiet) as callbacks:
        return trace_file(
            path,
            setup,
            view=view,
            options=settings.change("trace", TraceOptions()),
            source=source,
            iteration=flags.variable,
            **callbacks,
        )


@dataclass(frozen=True)
class Field:
    """A displacement in px, with its source and setup if the file contains them."""

    displacement: FloatArray
    source: FloatArray | None = None
    setup: Setup | None = None


def field_from(path: Path, variable: str | None = None) -> Field:
    """Read a displacement from a result, or from an array in px or px²."""
    from napari_shadowinv.io import read_dataset, read_radiograph
    from napari_shadowinv.io.arrays import read_npy
    from napari_shadowinv.io.files import split_address
    from napari_shadowinv.io.hdf5_arrays import read_hdf5

    path, variable = split_address(path, variable)
    kind = kind_of(path)
    if variable is not None and kind in ("hdf5", "pradformat", "shadowinv"):
        return Field(_displacement(path, read_hdf5(path, variable)))
    if variable is not None or kind in ("mat", "hdf5"):
        return Field(_displacement(path, read_radiograph(path, variable=variable).image))
    if kind in ("pradformat", "shadowinv"):
        return _field_of_result(path, read_dataset(path))
    if kind == "npy":
        return Field(_displacement(path, read_npy(path)))
    raise _no_field(path, f"a {kind.upper()} picture")


@as_file_errors
def _field_of_result(path: Path, dataset: xarray.Dataset) -> Field:
    """Return the only field in the dataset of a result, with the beam of its first image."""
    from napari_shadowinv.inversion.variables import setup_from_dataset
    from napari_shadowinv.results import result_from_dataset

    result = result_from_dataset(dataset)
    names = json.loads(dataset.attrs.get("fields", "[]"))
    if len(names) > 1:
        raise InputError(
            f"{path} has the fields {', '.join(names)}: choose one with --variable "
            f"displacement_{names[0]}"
        )
    if "displacement" not in dataset:
        raise _no_field(path, f"a {result.kind.noun}")
    displacement = _displacement(path, dataset["displacement"].values)
    source = dataset["source"].values if "source" in dataset else None
    if source is not None and source.ndim == 3:
        source = np.asarray(source[0])
    return Field(displacement, source, setup_from_dataset(dataset) or result.setup)


def _displacement(path: Path, array: AnyArray) -> FloatArray:
    if array.ndim == 2:
        return displacement_from_potential(array)
    if array.ndim == 3 and array.shape[0] == 2:
        return array.astype(float)
    raise _no_field(path, f"an array of shape {array.shape}")


def _no_field(path: Path, kind: str) -> FileFormatError:
    return FileFormatError(
        f"{path} is {kind}: expected a .shadowinv result, or NPY with a displacement "
        "(2, height, width) in px or a potential (height, width) in px²"
    )


def choose_setups(
    field: Field,
    target: Setup | None,
    recorded_with: Setup | None,
    deflector: str | None,
    dispersion: float,
) -> tuple[Setup | None, Setup | None]:
    """Return the setup that a field was measured with, and the one to predict it for."""
    if recorded_with is not None and field.setup is not None and recorded_with != field.setup:
        raise InputError(
            "received --recorded-with, but the field's file contains its own setup, "
            f"{setup_text(field.setup)}: leave it out"
        )
    original = recorded_with or field.setup or target
    target = target or original
    if (deflector is not None or dispersion != 1) and original == target:
        raise InputError(
            "received --deflector or --dispersion, but only one setup: expected a different one "
            "with --setup, and for a field in px also --recorded-with"
        )
    return original, target


def predict_image(
    displacement: FloatArray,
    source: FloatArray | None,
    recorded_with: Setup | None,
    target: Setup | None,
    deflector: str | None,
    dispersion: float,
) -> tuple[FloatArray, str]:
    """Return the image, and a sentence with the assumptions."""
    from napari_shadowinv.physics.forward import synthetic_image
    from napari_shadowinv.physics.projection import default_deflector, predict_image

    if recorded_with is None or target is None or recorded_with == target:
        return synthetic_image(displacement, source), ""
    # Names of two words have a hyphen on the command line.
    name = deflector and deflector.replace("-", " ")
    name = name or default_deflector(recorded_with, target)
    image = predict_image(
        displacement, recorded_with, target, deflector=name, dispersion=dispersion, source=source
    )
    return image, (
        f"From {setup_text(recorded_with)} to {setup_text(target)}, assuming that only a {name} "
        "deflects the beam"
    )
