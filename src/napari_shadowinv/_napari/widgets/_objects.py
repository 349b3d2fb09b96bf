"""Controls for an object that deflects the beam: `ObjectPanel`, also for a 3-D field in a file."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from napari_shadowinv._napari import form as forms
from napari_shadowinv._napari.run import Run
from napari_shadowinv._napari.widgets._inputs import SetupPicker
from napari_shadowinv._napari.widgets._panels import ToolPanel
from napari_shadowinv.errors import InputError
from napari_shadowinv.physics.phantom_models import PHANTOMS, PhantomRecipe
from napari_shadowinv.physics.trace_options import GridView

GRID, LAYER = "grid", "layer"
"""Kinds of objects that are no phantoms."""


@dataclass(frozen=True)
class GridFile:
    """A 3-D field in a file, and the direction from which it is seen."""

    path: str
    view: GridView

    @property
    def title(self) -> str:
        """Name of the file without its ending."""
        return Path(self.path).stem


class ObjectPanel(ToolPanel):
    """A panel for an object that deflects the beam: a phantom, a 3-D field, or a layer's field."""

    def __init__(self, viewer: Any, name: str, panel: Run, layer_title: str) -> None:
        super().__init__(viewer, name, panel)
        kinds: forms.Kinds = {
            **forms.kinds_of(PHANTOMS),
            GRID: ("a 3-D field from a file", GridView),
            LAYER: (layer_title, None),
        }
        self.object = forms.ModelPicker("Object", kinds)
        self.object.choice.setToolTip("Object that deflects the beam.")
        self.file = forms.PathEdit(
            "Choose a 3-D field", "openPMD or NetCDF file", files="3-D fields (*.h5 *.hdf5 *.nc)"
        )
        self.file.setToolTip(
            "<qt>openPMD file (HDF5), or NetCDF 4 file with Bx, By, Bz or Ex, Ey, Ez; particles "
            "are traced through it.</qt>"
        )
        self.file_row = forms.labelled("File", self.file)
        self.file.changed.connect(self.keep)
        self.setup = SetupPicker()

    def parts(self) -> dict[str, Any]:
        return {"setup": self.setup, "object": self.object, "file": self.file}

    def state(self) -> dict[str, Any]:
        return {**super().state(), "setup": {**self.setup.state(), "kind": self.setup.picker.kind}}

    def simulated_object(self) -> PhantomRecipe | GridFile:
        """Return the phantom or the file, or raise an `InputError`."""
        recipe: Any = self.object.model()
        if self.object.kind != GRID:
            return recipe
        if not self.file.path:
            raise InputError("there is no file with a 3-D field: choose one")
        return GridFile(self.file.path, recipe)

    def choose_setup(self) -> None:
        """Select the kind of setup that the object requires, keeping its entries."""
        recipe = PHANTOMS.get(self.object.kind)
        probe = "" if recipe is None else recipe.probe
        if self.object.kind == GRID:
            probe = "proton"
        if self._ready and probe:
            self.setup.choose_kind(probe)
