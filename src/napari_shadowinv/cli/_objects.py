"""Objects of the commands `forward` and `plan`: phantoms, and fields in files."""

from __future__ import annotations

import json
import os
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from typer import Option

from napari_shadowinv._system.safety import as_file_errors
from napari_shadowinv.cli import _flags
from napari_shadowinv.cli._inputs import read_setup
from napari_shadowinv.cli._settings import Settings
from napari_shadowinv.errors import FileFormatError, InputError
from napari_shadowinv.io.files import split_address
from napari_shadowinv.io.formats import kind_of
from napari_shadowinv.physics.beam import displacement_from_potential
from napari_shadowinv.physics.trace_options import GridView

if TYPE_CHECKING:
    import xarray

    from napari_shadowinv._typing import AnyArray, FloatArray
    from napari_shadowinv.physics.field_grid import FieldGrid
    from napari_shadowinv.physics.phantom_models import PhantomRecipe
    from napari_shadowinv.pipeline.experiment_object import PlannedObject

HELP = (
    "A phantom such as toroid:peak=60,radius=3e-5, a result, a displacement (2, H, W) in px or "
    "potential (H, W) in px², or a 3-D field (NetCDF)."
)


@dataclass(frozen=True, kw_only=True)
class ObjectFlags:
    """Flags of an object, and of the experiment that it is put into."""

    setup: _flags.SetupFile = None
    recorded_with: Annotated[Path | None, Option(help="TOML file of the object's setup.")] = None
    deflector: _flags.Deflector = None


def file_of(text: str) -> Path | None:
    """Return the file of an object; None for a phantom, such as toroid:peak=1.5."""
    file, _ = split_address(text)
    is_file = os.path.exists(file) or (file.suffix and "=" not in text)
    return file if is_file else None


def object_of(
    text: str, flags: ObjectFlags, settings: Settings, view: GridView
) -> PhantomRecipe | FieldGrid | PlannedObject:
    """Return the phantom of a text, or the object of a file: a 3-D field, or a displacement."""
    from napari_shadowinv.io.field_grids import is_field_grid, read_field_grid
    from napari_shadowinv.pipeline.experiment_object import phantom_of_text

    file, (_, array) = file_of(text), split_address(text)
    is_grid = file is not None and array is None and is_field_grid(file)
    stated = {"--recorded-with": flags.recorded_with, "--deflector": flags.deflector}
    received = [] if file and not is_grid else [flag for flag in stated if stated[flag]]
    sections = () if is_grid else ("view.", "trace.")
    received += [key for key in settings.values if key.startswith(sections)]
    if received:
        kind = "a 3-D field" if is_grid else "a displacement" if file else "a phantom"
        raise InputError(
            f"received {', '.join(received)}, which does not apply to {text}, {kind}: leave it out"
        )
    if file is None:
        return phantom_of_text(text)
    if is_grid:
        return view.apply(read_field_grid(file))
    return _displaced(Path(text), flags)


def _displaced(path: Path, flags: ObjectFlags) -> PlannedObject:
    """Read a displacement from a result, or from an array in px or px²."""
    from napari_shadowinv.io import read_dataset, read_shot
    from napari_shadowinv.io.arrays import read_npy
    from napari_shadowinv.io.hdf5_arrays import read_hdf5
    from napari_shadowinv.pipeline.experiment_object import object_of_displacement

    (file, variable), original = split_address(path), read_setup(flags.recorded_with)
    kind = kind_of(file)
    if variable is None and kind == "shadowinv":
        field = _object_of_result(file, read_dataset(file))
        if field.setup is not None and original is not None:
            raise InputError(f"{file} has its setup: leave out --recorded-with")
        return object_of_displacement(
            field.samples,
            original or field.setup,
            deflector=flags.deflector or field.deflector,
            title=file.name,
            source=field.source,
        )
    if variable is not None and kind in ("hdf5", "pradformat", "shadowinv"):
        array = read_hdf5(file, variable)
    elif variable is not None or kind == "mat":
        array = read_shot(file, variable=variable).image
    elif kind == "npy":
        array = read_npy(file)
    else:
        raise _no_field(file, f"a {kind.upper()} picture")
    return object_of_displacement(
        _displacement(file, array), original, deflector=flags.deflector, title=path.name
    )


@as_file_errors
def _object_of_result(path: Path, dataset: xarray.Dataset) -> PlannedObject:
    from napari_shadowinv.pipeline.experiment_object import object_of_result

    names = json.loads(dataset.attrs.get("fields", "[]"))
    if len(names) > 1:
        raise InputError(
            f"{path} has the fields {', '.join(names)}: choose one, such as "
            f"{path.name}::displacement_{names[0]}"
        )
    return object_of_result(dataset)


def _displacement(path: Path, array: AnyArray) -> FloatArray:
    if array.ndim == 2:
        return displacement_from_potential(array)
    if array.ndim == 3 and array.shape[0] == 2:
        return array.astype(float)
    raise _no_field(path, f"an array of shape {array.shape}")


def _no_field(path: Path, kind: str) -> FileFormatError:
    return FileFormatError(
        f"{path} is {kind}: expected a .shadowinv result, NetCDF with fields on a grid, or "
        "NPY with a displacement (2, height, width) in px or a potential (height, width) in px²"
    )
