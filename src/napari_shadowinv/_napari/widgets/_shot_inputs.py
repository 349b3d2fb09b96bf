"""Where the shots of a window come from, and the store that their results go to.

- a layer, files, a table of them, or a folder to watch: `ShotPicker`
- the store, and the choices of a run of many shots: `StoreSection`
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from pydantic import Field, create_model
from qtpy.QtWidgets import QWidget

from napari_shadowinv._napari import form as forms
from napari_shadowinv._napari import layer_metadata as about
from napari_shadowinv._napari.widgets import _layers as layers
from napari_shadowinv._napari.widgets import _qt as qt
from napari_shadowinv._napari.widgets._layers import LAYER
from napari_shadowinv._system.validation import CheckedModel
from napari_shadowinv.errors import InputError
from napari_shadowinv.io.store import STORE_SUFFIX
from napari_shadowinv.pipeline.run_options import RunOptions, WatchOptions
from napari_shadowinv.pipeline.shot_table import is_table

FILES, TABLE, FOLDER = "files", "table", "folder"
_MISSING = {
    FILES: "no files are selected: enter a pattern such as shots/*.tif, or choose files",
    TABLE: "no table is selected: choose a .csv file with a row for each shot, with the columns "
    "file and energy or wavelength",
    FOLDER: "no folder is selected: choose the folder in which the shots appear",
}
_ONCE = {"overwrite", "redo_failed"}  # choices that count for one run


def _place(title: str, dialog: str, example: str, description: str) -> type[CheckedModel]:
    """Return the model of a path."""
    extra: Any = {"path": dialog}
    words: Any = {"title": title, "description": description, "examples": [example]}
    return create_model(
        title, __base__=CheckedModel, path=(str, Field("", json_schema_extra=extra, **words))
    )


_PLACES: forms.Kinds = {
    FILES: (
        "Files…",
        _place(
            "Files",
            "files",
            "shots/*.tif",
            "A pattern such as shots/*.tif, files separated by ;, or a file of frames.",
        ),
    ),
    TABLE: (
        "Table (.csv)…",
        _place(
            "Table",
            "file",
            "shots.csv",
            "A table (.csv) with a row for each shot and the columns file, setup, energy or "
            "wavelength, brightness, mask, source, exclude.",
        ),
    ),
    FOLDER: (
        "Watched folder…",
        _place(
            "Folder",
            "folder",
            "folder",
            "Each new file in this folder is inverted as soon as it is complete, until you press "
            "Cancel.",
        ),
    ),
}
_STORE = _place(
    "Store",
    "new",
    f"results{STORE_SUFFIX}",
    f"Folder for the results, named …{STORE_SUFFIX}. If it exists, the run is resumed.",
)


class ShotPicker(layers.LayerPicker):
    """A layer, or another place that shots come from.

    Until one is chosen, it is the image of an object rather than that of a beam, by names or
    structure, whichever was opened first.
    """

    def __init__(self, viewer: Any) -> None:
        entries: forms.Kinds = {"": ("no image is open", None), LAYER: ("", None), **_PLACES}
        tip = (
            "Layer of a shot, or of a stack of shots; or shots in files, which are inverted into "
            "one store."
        )
        self._compared: list[Any] = []
        super().__init__(viewer, tip, suits=about.may_be_shot, label="Image", entries=entries)

    def _preferred(self, before: Any) -> Any:
        recorded = [layer for layer in self.offered if not about.belongs_to_result(layer)]
        candidates, best = [*recorded], before
        if before in recorded:
            candidates = [layer for layer in recorded if layer not in self._compared]
        elif candidates:
            best = candidates.pop()
        for layer in reversed(candidates):
            if layers.is_rather_shot(layer, best, is_pair=len(recorded) == 2):
                best = layer
        self._compared = recorded
        return self.chosen, best, *super()._preferred(before)

    @property
    def is_stack(self) -> bool:
        return self.kind in _MISSING or (self.layer is not None and self.layer.ndim > 2)

    @property
    def name(self) -> str:
        """The name of the shots, such as a path."""
        if self.form is not None:
            return str(self.form.state().get("path", "")).strip()
        return "" if self.layer is None else str(self.layer.name)

    @property
    def _paths(self) -> list[str]:
        parts = [part.strip() for part in self.name.split(forms.PATH_SEPARATOR.strip())]
        return [os.path.expanduser(part) for part in parts if part]

    @property
    def default_store(self) -> str:
        """The store beside the files; empty for a layer, or without files."""
        if self.form is None or not self._paths:
            return ""
        path = Path(self._paths[0])
        if self.kind == FILES:
            path = path.parent  # shots/*.tif
        return str(path.with_name(path.stem + STORE_SUFFIX)) if path.name else ""

    def choose_path(self) -> None:
        """Ask for the files, the table or the folder."""
        if self.form is not None:
            self.form.entries["path"].choose_path()

    def shots(self) -> Any:
        """Return the shots of a stack for a run, or raise an `InputError`."""
        if self.form is None:
            return layers.stack_of(self.layer)
        paths = self._paths
        if not paths:
            raise InputError(_MISSING[self.kind])
        if self.kind == FILES:
            return paths[0] if len(paths) == 1 else paths
        path = Path(self.name).expanduser()
        if self.kind == TABLE and not (path.is_file() and is_table(path)):
            reason = "is no table" if path.exists() else "does not exist"
            raise InputError(
                f"{path} {reason}: expected a .csv file that begins with names of columns, such as "
                "file and energy"
            )
        return path


class StoreSection(QWidget):
    """The store of a stack's results, and the choices of its run."""

    def __init__(self) -> None:
        super().__init__()
        self.folder = forms.ModelForm(_STORE)
        self.run, self.watch = forms.ModelForm(RunOptions), forms.ModelForm(WatchOptions)
        self._proposed = ""
        qt.column(self, self.folder, forms.section("Run of many shots", self.run, self.watch))

    @property
    def path(self) -> Path:
        """The store, also if the dialog entered it; an `InputError` without one."""
        stated = str(self.folder.state().get("path", "")).strip()
        if not stated:
            raise InputError(
                "no store is selected for the results: choose a folder whose name ends with "
                f"{STORE_SUFFIX}"
            )
        path = Path(stated).expanduser()
        stores = [each for each in (path, *path.parents) if each.name.endswith(STORE_SUFFIX)]
        return stores[0] if stores else path

    def follow(self, shots: ShotPicker) -> None:
        """Show the choices for a kind of shots, and their store unless the user chose another."""
        if self.folder.state().get("path", "") in ("", self._proposed):
            self._proposed = shots.default_store
            self.folder.restore({"path": self._proposed})
        # Watched shots are inverted one by one, as they arrive.
        self.run.setVisible(shots.kind != FOLDER)
        self.watch.setVisible(shots.kind == FOLDER)

    def options(self, kind: str) -> Any:
        """Return the options of a run, or raise an `InputError`."""
        return (self.watch if kind == FOLDER else self.run).model()

    def begin(self) -> None:
        """Uncheck what counts for one run: another must not discard its shots."""
        for form in (self.run, self.watch):
            values = form.state()
            if _ONCE & values.keys():
                form.restore({key: value for key, value in values.items() if key not in _ONCE})
