"""Controls for a 3-D field in a file, through which particles are traced: `GridFileEdit`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from napari_shadowinv._napari.widgets import _forms as forms
from napari_shadowinv.errors import InputError
from napari_shadowinv.physics.trace_options import GridView

GRID = "grid"
GRID_KIND = {GRID: ("a 3-D field from a file", GridView)}
"""Entry of a `ModelPicker` of objects, whose form has the direction of the view."""


@dataclass(frozen=True)
class GridFile:
    """A 3-D field in a file, and the direction from which it is seen."""

    path: str
    view: GridView

    @property
    def title(self) -> str:
        """Name of the file without its ending."""
        return Path(self.path).stem


class GridFileEdit(forms.PathEdit):
    """The file of a 3-D field."""

    def __init__(self) -> None:
        super().__init__(
            "Choose a 3-D field", "openPMD or NetCDF file", "3-D fields (*.h5 *.hdf5 *.nc)"
        )
        self.setToolTip(
            "<qt>openPMD file (HDF5), or NetCDF 4 file with Bx, By, Bz or Ex, Ey, Ez; particles "
            "are traced through it.</qt>"
        )

    def grid_file(self, view: Any) -> GridFile:
        """Return the chosen file with a `GridView`, or raise an `InputError` without a file."""
        if not self.path:
            raise InputError("there is no file with a 3-D field: choose one")
        return GridFile(self.path, view)
