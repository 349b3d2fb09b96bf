"""What a run over many shots is given.

- which shots: `ShotsPicker`
- which store: `StoreEdit`
- who computes: `EnginePicker`
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from qtpy.QtWidgets import QFileDialog, QLineEdit, QSpinBox

from napari_shadowinv._napari.layer_metadata import may_be_shot
from napari_shadowinv._napari.widgets._base import PathEdit
from napari_shadowinv._napari.widgets._forms import RowPicker, labelled
from napari_shadowinv._napari.widgets._picking import LayerPicker
from napari_shadowinv._napari.widgets._reading import stack_of
from napari_shadowinv.errors import InputError
from napari_shadowinv.io.store import STORE_SUFFIX

__all__ = ["EnginePicker", "ShotsPicker", "StoreEdit"]

_LAYER, _FILES = "layer", "files"
_HERE, _SCHEDULER = "threads", "scheduler"
_BETWEEN = "; "


class _FilesEdit(PathEdit):
    """Files by a pattern, or one by one."""

    def ask(self) -> str:
        paths, _ = QFileDialog.getOpenFileNames(self, self._title)
        return _BETWEEN.join(paths)


class StoreEdit(PathEdit):
    """The folder that shots are written to, new or begun."""

    def __init__(self) -> None:
        super().__init__("Store of the results", f"results{STORE_SUFFIX}")
        self.edit.setToolTip(
            f"<qt>A folder named …{STORE_SUFFIX}. If it exists, the run is resumed.</qt>"
        )

    @property
    def store(self) -> Path:
        """Its path.

        Raises
        ------
        InputError
            If none is given.
        """
        if not self.path:
            raise InputError(
                "no store is selected for the results: choose a folder whose name ends with "
                f"{STORE_SUFFIX}"
            )
        return Path(self.path).expanduser()

    def ask(self) -> str:
        # To go on with what is there is no danger: nothing is replaced without its box.
        path, _ = QFileDialog.getSaveFileName(
            self,
            self._title,
            self.path or f"results{STORE_SUFFIX}",
            f"stores (*{STORE_SUFFIX})",
            options=QFileDialog.Option.DontConfirmOverwrite,
        )
        if not path:
            return ""
        chosen = Path(path)
        # A store is a folder, which a dialog steps into.
        for folder in (chosen, *chosen.parents):
            if folder.name.endswith(STORE_SUFFIX):
                return str(folder)
        return path + STORE_SUFFIX


class ShotsPicker(RowPicker):
    """A stack layer, or files.

    Signals
    -------
    changed
        Other shots were chosen.
    """

    def __init__(self, viewer: Any) -> None:
        self.layers = LayerPicker(viewer, ("image",), suits=may_be_shot)
        self.layers.setToolTip(
            "Image layer (shot, y, x); data on disk are read one shot at a time."
        )
        self.files = _FilesEdit("Files of the shots", "shots/*.tif")
        self.files.edit.setToolTip(
            "<qt>A pattern such as shots/*.tif, files separated by ;, or a multi-page TIFF.</qt>"
        )
        super().__init__(
            "Shots",
            {_LAYER: ("a stack layer", None), _FILES: ("files", None)},
            "Location of the shots.",
            {_LAYER: labelled("", self.layers), _FILES: labelled("", self.files)},
        )
        self.layers.picked.connect(self.changed)
        self.files.changed.connect(self.changed)

    @property
    def layer(self) -> Any | None:
        """The chosen layer; None where files are chosen."""
        return self.layers.layer if self.picker.kind == _LAYER else None

    @property
    def name(self) -> str:
        """What to call the shots."""
        if self.picker.kind == _FILES:
            return self.files.path
        return "" if self.layer is None else str(self.layer.name)

    def shots(self) -> Any:
        """The chosen shots, as `napari_shadowinv.stack.run_stack` takes them.

        Raises
        ------
        InputError
            If there are none, or the layer is no stack.
        """
        if self.picker.kind == _LAYER:
            return stack_of(self.layers.layer)
        parts = [part.strip() for part in self.files.path.split(_BETWEEN.strip())]
        paths = [os.path.expanduser(part) for part in parts if part]
        if not paths:
            raise InputError(
                "no files are selected: enter a pattern such as shots/*.tif, or choose"
            )
        return paths[0] if len(paths) == 1 else paths


class EnginePicker(RowPicker):
    """The computer in front of the user, or a scheduler of dask.

    Signals
    -------
    changed
        Another was chosen.
    """

    def __init__(self) -> None:
        self.workers = QSpinBox()
        self.workers.setRange(0, 1024)
        self.workers.setSuffix(" at once")
        self.workers.setSpecialValueText("one per core")
        self.workers.setToolTip("Number of shots inverted at the same time.")
        self.address = QLineEdit()
        self.address.setPlaceholderText("tcp://host:8786")
        self.address.setToolTip("Address printed by 'dask scheduler' when it starts.")
        self.address.setMinimumWidth(60)
        super().__init__(
            "Run on",
            {_HERE: ("this computer", None), _SCHEDULER: ("a dask cluster", None)},
            "This does not affect the results. Cluster workers must be able to access the shots "
            "and the store at the same paths.",
            {_HERE: labelled("Jobs", self.workers), _SCHEDULER: labelled("Address", self.address)},
        )
        self.workers.valueChanged.connect(lambda _: self.changed.emit())
        self.address.editingFinished.connect(self.changed)

    def engine(self) -> tuple[str, int | None]:
        """Scheduler and number of workers, as `napari_shadowinv.stack.run_stack` takes them.

        Raises
        ------
        InputError
            If no address of a scheduler is given.
        """
        if self.picker.kind == _HERE:
            return "threads", self.workers.value() or None
        address = self.address.text().strip()
        if "://" not in address:
            raise InputError(
                f"the scheduler's address is '{address}': expected one such as tcp://host:8786, "
                "as printed by 'dask scheduler'"
            )
        return address, None

    def state(self) -> dict[str, Any]:
        """What is kept between sessions."""
        return {
            "kind": self.picker.kind,
            "workers": self.workers.value(),
            "address": self.address.text(),
        }

    def restore(self, state: Mapping[str, Any]) -> None:
        """Show what `state` has returned."""
        self.picker.set_kind(str(state.get("kind", _HERE)))
        self.workers.setValue(int(state.get("workers", 0)))
        self.address.setText(str(state.get("address", "")))
