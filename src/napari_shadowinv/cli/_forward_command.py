"""The command `forward`: the image of a displacement field, or of a 3-D field."""

from __future__ import annotations

import json
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from typer import Option

from napari_shadowinv._system.safety import as_file_errors
from napari_shadowinv.cli import _flags
from napari_shadowinv.cli._inputs import read_setup
from napari_shadowinv.cli._outputs import Outputs
from napari_shadowinv.cli._settings import Sections, Settings, settings_of
from napari_shadowinv.cli._summary import Rows, fact_rows, setup_text, size_text
from napari_shadowinv.cli._terminal import notify_errors, work_callbacks
from napari_shadowinv.errors import FileFormatError, InputError
from napari_shadowinv.facts import percent
from napari_shadowinv.io.files import split_address
from napari_shadowinv.io.formats import IMAGE_WRITERS, NETCDF_SUFFIX, TIFF, kind_of
from napari_shadowinv.physics.beam import displacement_from_potential
from napari_shadowinv.physics.trace_options import SizedView, TraceOptions

if TYPE_CHECKING:
    import xarray

    from napari_shadowinv._typing import AnyArray, FloatArray
    from napari_shadowinv.physics.setup import Setup
    from napari_shadowinv.physics.tracing import TracedImage

# Help of arguments, where it is longer than a line.
HELP = {
    "field": "Result, displacement (2, H, W) in px, potential (H, W) in px², or 3-D field "
    "(openPMD, also fields.h5::iteration, NetCDF).",
    "recorded_with": "TOML file of the geometry in which the field was measured.",
}
SECTIONS: Sections = {"view": SizedView, "trace": TraceOptions}
EPILOG = """
shadowinv forward shot.shadowinv --setup lower.toml --deflector plasma

shadowinv forward fields.h5 --setup setup.toml --set view.beam=x

Causes: magnetic-field, electric-field, plasma, refractive-index.
"""


@dataclass(frozen=True, kw_only=True)
class ExperimentFlags:
    """Flags of the experiment that an image is predicted for."""

    setup: Annotated[Path | None, Option(help="TOML file of the geometry to predict for.")] = None
    recorded_with: Annotated[Path | None, Option(help=HELP["recorded_with"])] = None
    deflector: _flags.Deflector = None
    dispersion: Annotated[float, Option(help="New ln η / old ln η of an index.")] = 1.0
    source: _flags.SourceFile = None
    channel: _flags.Channel = None


@notify_errors
@_flags.takes_flags
def forward(
    field: Annotated[Path, _flags.argument(help=HELP["field"])],
    flags: ExperimentFlags,
    settings: Annotated[list[str] | None, _flags.setting(SECTIONS, "trace.output=counts")] = None,
    out: Annotated[Path | None, Option(help="Image: .tif, .npy or .png.")] = None,
    truth: Annotated[Path | None, Option(help="NetCDF file of line integrals.")] = None,
    overwrite: _flags.Overwrite = False,
    quiet: _flags.Quiet = False,
) -> None:
    """Predict the image of a displacement field or of a 3-D field, for any setup.

    The source is the result's own if the setup is the same, else uniform.
    """
    from napari_shadowinv.io import is_field_grid, read_shot, replacing, write

    outputs = Outputs(overwrite, quiet)
    path = Path(f"{field.stem}_image{TIFF.suffix}") if out is None else out
    outputs.check(
        [(path, tuple(IMAGE_WRITERS)), (truth, (NETCDF_SUFFIX,))],
        [field, flags.source, flags.setup, flags.recorded_with],
    )
    chosen = settings_of(settings or (), SECTIONS, {})
    setup = read_setup(flags.setup)
    outputs.warn_of_setups([(setup, None)])
    beam = None
    if flags.source is not None:
        beam = read_shot(flags.source, channel=flags.channel).image
    if is_field_grid(split_address(field)[0]):
        with work_callbacks(quiet) as callbacks:
            traced = _trace(field, setup, beam, flags, chosen, callbacks)
        image, setup, rows = traced.image, traced.setup, fact_rows(traced.facts)
    elif chosen.values or truth is not None:
        names = ", ".join(chosen.values) or "--truth"
        raise InputError(f"received {names}, but {field} is no 3-D field: leave them out")
    else:
        image, setup, rows = _predict(field, setup, beam, flags)
    with ExitStack() as both:  # files, or none
        if truth is not None:
            temporary = both.enter_context(replacing(truth, overwrite))
            traced.to_dataset().to_netcdf(temporary, engine="h5netcdf")
        write(path, image, setup=setup, overwrite=overwrite)
    outputs.show(size_text(image.shape), [("setup", setup_text(setup, shape=image.shape)), *rows])


def _trace(
    path: Path,
    setup: Setup | None,
    source: AnyArray | None,
    flags: ExperimentFlags,
    settings: Settings,
    callbacks: dict[str, Any],
) -> TracedImage:
    """Trace particles through the 3-D field in a file."""
    from napari_shadowinv.io.field_grids import read_field_grid
    from napari_shadowinv.physics.particle_flight import check_particles
    from napari_shadowinv.physics.tracing import trace

    if flags.recorded_with is not None or flags.deflector is not None or flags.dispersion != 1:
        raise InputError(
            f"received --recorded-with, --deflector or --dispersion, but {path} is a 3-D "
            "field, which needs only --setup: leave them out"
        )
    if source is not None and {"view.height", "view.width"} & settings.values.keys():
        raise InputError(
            "received view.height or view.width, but --source sets the size: leave it out"
        )
    view = settings.change("view", SizedView())
    shape: Any = (view.height, view.width) if source is None else source.shape
    particles = check_particles(setup)
    file, iteration = split_address(path)
    return trace(
        view.apply(read_field_grid(file, iteration=iteration)),
        particles,
        shape,
        options=settings.change("trace", TraceOptions()),
        profile=source,
        **callbacks,
    )


def _predict(
    path: Path, setup: Setup | None, beam: AnyArray | None, flags: ExperimentFlags
) -> tuple[FloatArray, Setup | None, Rows]:
    """Return the image of the field in a file, its setup, and the facts about it."""
    from napari_shadowinv.physics.forward import synthetic_image
    from napari_shadowinv.physics.projection import default_deflector, predict_image

    field = field_from(path)
    stated = read_setup(flags.recorded_with)
    if stated is not None and field.setup is not None and stated != field.setup:
        raise InputError(
            "received --recorded-with, but the field's file contains its own setup, "
            f"{setup_text(field.setup)}: leave it out"
        )
    original = stated or field.setup or setup
    target = setup or original
    rows: Rows = []
    if original is None or target is None or original == target:
        if flags.deflector is not None or flags.dispersion != 1:
            raise InputError(
                "received --deflector or --dispersion, but only one setup: expected a different "
                "one with --setup, and for a field in px also --recorded-with"
            )
        beam = field.source if beam is None else beam
        image = synthetic_image(field.displacement, beam)
    else:  # the beam of another experiment is not known
        cause = flags.deflector or field.deflector or default_deflector(original, target)
        image = predict_image(
            field.displacement,
            original,
            target,
            deflector=cause,
            dispersion=flags.dispersion,
            source=beam,
        )
        rows.append(("measured", setup_text(original)))
        rows.append(("assumed", f"the {cause} alone deflects the beam"))
    inside = image.sum() / (image.size if beam is None else beam.sum())
    return image, target, [*rows, ("flux", f"{percent(inside)} lands inside the image")]


@dataclass(frozen=True)
class Field:
    """A displacement in px, with its source, setup and cause if the file contains them."""

    displacement: FloatArray
    source: FloatArray | None = None
    setup: Setup | None = None
    deflector: str | None = None


def field_from(path: Path) -> Field:
    """Read a displacement from a result, or from an array in px or px²."""
    from napari_shadowinv.io import read_dataset, read_shot
    from napari_shadowinv.io.arrays import read_npy
    from napari_shadowinv.io.hdf5_arrays import read_hdf5

    path, variable = split_address(path)
    kind = kind_of(path)
    if variable is not None and kind in ("hdf5", "pradformat", "shadowinv"):
        return Field(_displacement(path, read_hdf5(path, variable)))
    if variable is not None or kind == "mat":
        return Field(_displacement(path, read_shot(path, variable=variable).image))
    if kind in ("pradformat", "shadowinv"):
        return _field_of_result(path, read_dataset(path))
    if kind == "npy":
        return Field(_displacement(path, read_npy(path)))
    raise _no_field(path, f"a {kind.upper()} picture")


@as_file_errors
def _field_of_result(path: Path, dataset: xarray.Dataset) -> Field:
    """Return the only field in the dataset of a result, with the beam of its first image."""
    from napari_shadowinv.physics.setup import deflector_titles
    from napari_shadowinv.results import unpack_result

    result = unpack_result(dataset)
    names = json.loads(dataset.attrs.get("fields", "[]"))
    if len(names) > 1:
        raise InputError(
            f"{path} has the fields {', '.join(names)}: choose one, such as "
            f"{path.name}::displacement_{names[0]}"
        )
    if "displacement" not in dataset:
        raise _no_field(path, f"a {result.kind.noun}")
    displacement = _displacement(path, dataset["displacement"].values)
    source = dataset["source"].values if "source" in dataset else None
    if source is not None and source.ndim == 3:
        source = source[0]
    cause = deflector_titles().get(names[0]) if names else None
    return Field(displacement, source, result.setup, cause)


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
