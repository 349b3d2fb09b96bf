"""Fields of shots as openPMD files, an iteration in each: `write_openpmd`.

References
----------
openPMD standard 1.1.0, https://github.com/openPMD/openPMD-standard
"""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from napari_shadowinv import __version__
from napari_shadowinv.errors import InputError
from napari_shadowinv.io.hdf5 import hdf5_in_memory

if TYPE_CHECKING:
    import xarray

    from napari_shadowinv.physics.setup import Setup

# Powers of length, mass, time, current, temperature, amount and luminous intensity.
_DIMENSIONS = {
    "1": (0, 0, 0, 0, 0, 0, 0),
    "rad": (0, 0, 0, 0, 0, 0, 0),
    "m": (1, 0, 0, 0, 0, 0, 0),
    "m⁻²": (-2, 0, 0, 0, 0, 0, 0),
    "T m": (1, 1, -2, -1, 0, 0, 0),
    "V": (2, 1, -3, -1, 0, 0, 0),
}
_PLANE = ("y", "x")


def check_openpmd_setup(setup: Setup | None) -> Setup:
    """Refuse to write fields without a setup, as openPMD has SI units only."""
    if setup is None:
        raise InputError("openPMD holds fields in SI units, received no setup: give a setup")
    return setup


def write_openpmd(path: Path, shot: xarray.Dataset, setup: Setup, series: str, number: int) -> None:
    """Write the fields of a shot in SI units as one file of a series.

    Parameters
    ----------
    path : Path
    shot : xarray.Dataset
        Fields by the names of the setup's `si_fields`, and perhaps ``image`` in its own unit.
    setup : Setup
        Gives the size of a pixel in the object plane.
    series : str
        Names of the files of the series, with ``%T`` in place of the number, such as
        ``night_%06T.h5``.
    number : int
        Of the shot, which becomes the iteration.
    """
    import h5py

    units = {field.name: field.unit for field in setup.si_fields} | {"image": "1"}
    with hdf5_in_memory(path) as content, h5py.File(content, "w") as file:
        file.attrs.update(
            _texts(
                openPMD="1.1.0",
                basePath="/data/%T/",
                meshesPath="meshes/",
                iterationEncoding="fileBased",
                iterationFormat=series,
                software="napari-shadowinv",
                softwareVersion=__version__,
                date=datetime.now(UTC).strftime("%Y-%m-%d %H:%M:%S %z"),
            ),
            openPMDextension=np.uint32(0),
        )
        iteration = file.create_group(f"data/{number}")
        # A shot is one moment, and when it was is not known.
        iteration.attrs.update({"time": 0.0, "dt": 0.0, "timeUnitSI": 1.0})
        meshes = iteration.create_group("meshes")
        for name in filter(units.__contains__, shot.data_vars):
            _write_mesh(meshes, shot[name], units[str(name)], setup.object_pixel_size)


def _write_mesh(meshes: Any, field: xarray.DataArray, unit: str, pixel_size: float) -> None:
    values, name = np.asarray(field.values, dtype=np.float64), str(field.name)
    components = {name: values}
    record = meshes
    if "component" in field.dims:
        record = meshes.create_group(name)
        components = dict(zip(map(str, field["component"].values), values, strict=True))
    for key, plane in components.items():
        component = record.create_dataset(key, data=plane, compression="gzip", compression_opts=4)
        component.attrs.update({"unitSI": 1.0, "position": np.zeros(len(_PLANE))})
    meshes[name].attrs.update(
        _texts(geometry="cartesian", dataOrder="C", comment=str(field.attrs["long_name"])),
        axisLabels=np.array([label.encode() for label in _PLANE]),
        gridSpacing=np.full(len(_PLANE), pixel_size),
        gridGlobalOffset=np.zeros(len(_PLANE)),
        gridUnitSI=1.0,
        unitDimension=np.array(_DIMENSIONS[unit], dtype=np.float64),
        timeOffset=0.0,
    )


def _texts(**attributes: str) -> dict[str, Any]:
    """Return texts of fixed length, as the standard asks for."""
    return {name: np.bytes_(text.encode()) for name, text in attributes.items()}
