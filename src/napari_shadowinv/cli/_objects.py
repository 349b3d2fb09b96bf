"""Objects of the commands `forward` and `plan`: phantoms, results, and 3-D fields."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from napari_shadowinv._system.safety import as_file_errors
from napari_shadowinv.cli._settings import Settings
from napari_shadowinv.errors import InputError
from napari_shadowinv.io.files import split_address
from napari_shadowinv.physics.trace_options import GridView

if TYPE_CHECKING:
    from napari_shadowinv.physics.field_grid import FieldGrid
    from napari_shadowinv.physics.phantom_models import PhantomRecipe
    from napari_shadowinv.pipeline.experiment_object import PlannedObject

HELP = "A phantom such as toroid:peak=60,radius=3e-5, a result, or a 3-D field (NetCDF)."


def file_of(text: str) -> Path | None:
    """Return the file of an object; None for a phantom, such as toroid:peak=1.5."""
    file, _ = split_address(text)
    is_file = os.path.exists(file) or (file.suffix and "=" not in text)
    return file if is_file else None


def object_of(
    text: str, deflector: str | None, settings: Settings, view: GridView
) -> PhantomRecipe | FieldGrid | PlannedObject:
    """Return the phantom of a text, or the object of a file: a 3-D field, or a result."""
    from napari_shadowinv.io.field_grids import is_field_grid, read_field_grid
    from napari_shadowinv.pipeline.experiment_object import phantom_of_text

    file = file_of(text)
    is_grid = file is not None and is_field_grid(file)
    received = ["--deflector"] if deflector and (file is None or is_grid) else []
    sections = () if is_grid else ("view.", "trace.")
    received += [key for key in settings.values if key.startswith(sections)]
    if is_grid and (name := split_address(text)[1]):
        received.append(f"::{name}")
    if received:
        kind = "a 3-D field" if is_grid else "a result" if file else "a phantom"
        raise InputError(
            f"received {', '.join(received)}, which does not apply to {text}, {kind}: leave it out"
        )
    if file is None:
        return phantom_of_text(text)
    if is_grid:
        return view.apply(read_field_grid(file))
    found = _object_of_result(Path(text))
    return replace(found, title=file.name, deflector=deflector or found.deflector)


@as_file_errors
def _object_of_result(path: Path) -> PlannedObject:
    from napari_shadowinv.io import read_dataset
    from napari_shadowinv.pipeline.experiment_object import object_of_result

    dataset = read_dataset(path)
    try:
        return object_of_result(dataset)
    except InputError as error:
        raise error.about(path) from error
