"""The prediction of `shadowinv forward`: a field's image in its own or another setup."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from napari_shadowinv._system.safety import as_file_errors
from napari_shadowinv.cli._summary import setup_text
from napari_shadowinv.errors import FileFormatError, InputError

if TYPE_CHECKING:
    import xarray

    from napari_shadowinv._typing import AnyArray, FloatArray
    from napari_shadowinv.physics.setup import Setup


@dataclass(frozen=True)
class Field:
    """A displacement in px, with its source and setup if the file contains them."""

    displacement: FloatArray
    source: FloatArray | None = None
    setup: Setup | None = None


def field_from(path: Path, variable: str | None = None) -> Field:
    """Read a displacement from a result, or from an array in px or px²."""
    from napari_shadowinv.io import read_dataset, read_radiograph
    from napari_shadowinv.io.formats import kind_of
    from napari_shadowinv.io.hdf5 import read_hdf5
    from napari_shadowinv.io.images import read_npy

    kind = kind_of(path)
    if variable is not None and kind in ("hdf5", "shadowinv"):
        return Field(_displacement(path, read_hdf5(path, variable)))
    if variable is not None or kind == "mat":
        return Field(_displacement(path, read_radiograph(path, variable=variable).image))
    if kind in ("hdf5", "shadowinv"):
        return _field_of_result(path, read_dataset(path))
    if kind == "npy":
        return Field(_displacement(path, read_npy(path)))
    raise _no_field(path, f"a {kind.upper()} picture")


@as_file_errors
def _field_of_result(path: Path, dataset: xarray.Dataset) -> Field:
    """Return the only field in the dataset of a result, with the beam of its first image."""
    import numpy as np

    from napari_shadowinv.inversion.variables import setup_from_dataset
    from napari_shadowinv.io.results import result_from_dataset

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
    from napari_shadowinv.physics.setup import displacement_from_potential

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
    from napari_shadowinv.physics.projection import default_deflector, project

    if recorded_with is None or target is None or recorded_with == target:
        return synthetic_image(displacement, source), ""
    # Names of two words have a hyphen on the command line.
    name = deflector and deflector.replace("-", " ")
    name = name or default_deflector(recorded_with, target)
    image = project(
        displacement, recorded_with, target, deflector=name, dispersion=dispersion, source=source
    )
    return image, (
        f"From {setup_text(recorded_with)} to {setup_text(target)}, assuming that only a {name} "
        "deflects the beam"
    )
