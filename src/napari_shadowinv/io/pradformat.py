"""pradformat, the HDF5 layout in which codes for proton radiography exchange files.

Radiographs are read, inversions are written.
It differs from this package in its conventions: energies are in eV; a radiograph's ``pixel_width``
is in the detector plane; axis 1 is the first of the array, here y; an inversion's ``phi`` (m) has
the deflection angle as its gradient, where here the angle is *minus* the gradient.

References
----------
Feister, S. pradformat, https://github.com/sfeister/pradformat
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from datetime import UTC, datetime
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy import constants

from napari_shadowinv._typing import AnyArray
from napari_shadowinv.errors import FileFormatError, InputError
from napari_shadowinv.facts import ResultKind
from napari_shadowinv.inversion.variables import setup_from_dataset
from napari_shadowinv.io.hdf5 import load_dataset, member, open_hdf5, plain_value
from napari_shadowinv.physics.setup import Setup, Species
from napari_shadowinv.physics.units import refuse_missing
from napari_shadowinv.provenance import Provenance

if TYPE_CHECKING:
    import xarray

_VERSION = "0.2.0"
_OBJECT_TYPES = ("radiograph", "inversion")
_SYMBOLS: dict[Species, str] = {
    "proton": "p+",
    "deuteron": "D 1+",
    "triton": "T 1+",
    "helion": "He-3 2+",
    "alpha": "He-4 2+",
    "electron": "e-",
}


def is_result(path: Path) -> bool:
    """Return whether a file that begins like HDF5 or a MAT-file is a ``.shadowinv`` result."""
    import h5py

    if not h5py.is_hdf5(path):
        return False
    return str(_root_attributes(path).get("format", "")).startswith(tuple(ResultKind))


def is_pradformat(path: Path) -> bool:
    """Return whether a file that begins like HDF5 or a MAT-file is of this format."""
    import h5py

    return h5py.is_hdf5(path) and _root_attributes(path).get("object_type") in _OBJECT_TYPES


# They are looked up by name: walking all attributes of a damaged file may never end.
_ATTRIBUTES = """
    format object_type radiograph_type inversion_type pradformat_version pixel_width
    pixel_width_ax2 scale_factor source_object_dist object_image_dist spec_name spec_mass
    spec_charge spec_energy label description experiment_date file_date
"""


def _root_attributes(path: Path) -> dict[str, Any]:
    with open_hdf5(path) as file:
        names = [name for name in _ATTRIBUTES.split() if name in file.attrs]
        return {name: plain_value(file.attrs[name]) for name in names}


def read_pradformat(path: Path) -> tuple[AnyArray, dict[str, Any]]:
    """Read a radiograph, with its ``geometry``."""
    attributes = _root_attributes(path)
    if attributes["object_type"] == "inversion":
        raise FileFormatError(
            f"{path} is a pradformat inversion, which is only written here: expected a radiograph, "
            "or the result as .shadowinv"
        )
    with open_hdf5(path) as file:
        item = member(file, "image")
        image = None if item is None else load_dataset(path, item)
    if image is None or image.ndim != 2:
        content = "no image" if image is None else f"an image of shape {image.shape}"
        raise FileFormatError(
            f"{path} is a pradformat radiograph with {content}: expected a dataset 'image' of "
            "shape (height, width); export it again"
        )
    return image, {**attributes, "geometry": _read_geometry(path, attributes)}


def _read_geometry(path: Path, attributes: dict[str, Any]) -> dict[str, Any]:
    """Return the fields of a particle setup that the attributes contain."""
    species = {symbol: name for name, symbol in _SYMBOLS.items()}.get(
        attributes.get("spec_name", _SYMBOLS["proton"])
    )
    energy = attributes.get("spec_energy")
    geometry = {
        "kind": "proton",
        "source_object_distance": attributes.get("source_object_dist"),
        "object_image_distance": attributes.get("object_image_dist"),
        "detector_pixel_size": attributes.get("pixel_width"),
        "species": species if "spec_name" in attributes else None,
        # The energy of a species that nobody here knows gives no field.
        "energy": energy / constants.mega if energy is not None and species else None,
    }
    first, second = attributes.get("pixel_width"), attributes.get("pixel_width_ax2")
    if first is not None and second is not None and not np.isclose(first, second, rtol=1e-6):
        raise FileFormatError(
            f"{path} has pixels of {first:g} m by {second:g} m: expected square pixels; resample it"
        )
    return {name: value for name, value in geometry.items() if value is not None}


def write_pradformat(content: BytesIO, dataset: xarray.Dataset) -> None:
    """Write a result's potential and deflection angles as a pradformat "simple inversion".

    Of a fit's other parts, only the verdict is kept, in the description.
    """
    import h5py

    check_pradformat_fields(json.loads(dataset.attrs.get("fields", "[]")))
    refuse_missing(dataset, "result of an inversion", ("displacement", "potential"))
    setup = check_pradformat_setup(setup_from_dataset(dataset))
    angle = setup.deflection_angle(dataset["displacement"].values)
    potential = -setup.potential(dataset["potential"].values)
    datasets = {"phi": potential, "defl_ax1": angle[0], "defl_ax2": angle[1]}
    attributes: dict[str, Any] = {
        "object_type": "inversion",
        "inversion_type": "simple",
        "dr": setup.object_pixel_size,
        "pradformat_version": _VERSION,
        "source_object_dist": setup.source_object_distance,
        "object_image_dist": setup.object_image_distance,
        "spec_name": _SYMBOLS[setup.species],
        "spec_mass": setup.particle.mass,
        "spec_charge": setup.particle.charge,
        "spec_energy": setup.energy * constants.mega,
        "file_date": datetime.now(UTC).date().isoformat(),
    }
    method = ResultKind.of(dataset.attrs).noun.capitalize()
    verdict = dataset.attrs.get("verdict")
    attributes["description"] = ": ".join(
        filter(None, [f"{method} by napari-shadowinv", verdict and str(verdict)])
    )
    provenance = Provenance.of(dataset.attrs, dataset.variables)
    if provenance is not None:
        attributes["provenance"] = provenance.to_json()
        if provenance.images and provenance.image.file:
            attributes["radiograph_filename"] = provenance.image.file
    with h5py.File(content, "w") as file:
        for name, values in datasets.items():
            file.create_dataset(name, data=values, compression="gzip", compression_opts=4)
        file.attrs.update(attributes)


def check_pradformat_fields(names: Sequence[str]) -> None:
    """Refuse several fields, because a pradformat inversion holds one."""
    if len(names) > 1:
        raise InputError(
            f"a pradformat inversion holds one field, received {' and '.join(names)}: write "
            ".shadowinv"
        )


def check_pradformat_setup(setup: Setup | None) -> Any:
    """Refuse a setup of a kind without all the attributes that pradformat needs."""
    if setup is None or not setup.in_pradformat:
        kind = "none" if setup is None else f"kind '{setup.kind}'"
        raise InputError(
            f"a pradformat inversion needs a setup of kind 'proton', received {kind}: give one, "
            "or write .shadowinv"
        )
    return setup
