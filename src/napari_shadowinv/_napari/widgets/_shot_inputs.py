"""Where the shots of a window come from, and the store that their results go to.

- a layer, files, a table of them, or a folder to watch: `ShotsPicker`
- the store, and the choices of a run of many shots: `StoreSection`
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from qtpy.QtCore import QSignalBlocker, Signal
from qtpy.QtWidgets import QFileDialog, QWidget

from napari_shadowinv._napari import form as forms
from napari_shadowinv._napari import layer_metadata as about
from napari_shadowinv._napari.widgets import _layers as layers
from napari_shadowinv._napari.widgets import _qt as qt
from napari_shadowinv.errors import InputError
from napari_shadowinv.io.store import STORE_SUFFIX
from napari_shadowinv.pipeline.run_options import RunOptions, WatchOptions
from napari_shadowinv.pipeline.shot_table import is_table

LAYER, FILES, TABLE, FOLDER = "layer", "files", "table", "folder"
_PLACES = {FILES: "Files…", TABLE: "Table (.csv)…", FOLDER: "Watched folder…"}
_MISSING = {
    TABLE: "no table is selected: choose a .csv file with a row for each shot, with the columns "
    "file and energy or wavelength",
    FOLDER: "no folder is selected: choose the folder in which the shots appear",
}
_SEPARATOR = "; "
ONCE = {"overwrite", "redo_failed"}
"""Choices that count for one run."""


def lasting(values: dict[str, Any]) -> dict[str, Any]:
    """Return the choices of runs but for those that count once."""
    return {key: value for key, value in values.items() if key not in ONCE}


def _ask_for_files(edit: forms.PathEdit) -> str:
    return _SEPARATOR.join(QFileDialog.getOpenFileNames(edit, edit.title)[0])


def _ask_for_folder(edit: forms.PathEdit) -> str:
    return str(QFileDialog.getExistingDirectory(edit, edit.title, edit.path))


def _ask_for_store(edit: forms.PathEdit) -> str:
    # Choosing an existing store is safe: it is resumed unless 'Overwrite' is checked.
    path, _ = QFileDialog.getSaveFileName(
        edit,
        edit.title,
        edit.path or f"results{STORE_SUFFIX}",
        f"stores (*{STORE_SUFFIX})",
        options=QFileDialog.Option.DontConfirmOverwrite,
    )
    # A store is a folder, which the dialog enters.
    for folder in (Path(path), *Path(path).parents) if path else ():
        if folder.name.endswith(STORE_SUFFIX):
            return str(folder)
    return path + STORE_SUFFIX if path else ""


class _ShotChoice(layers.LayerPicker):
    """A layer, or another place that shots come from.

    Until one is chosen, it is the image of an object rather than that of a beam, by names or
    structure, whichever was opened first.
    """

    def __init__(self, viewer: Any) -> None:
        tip = (
            "<qt>Layer of a shot, or of a stack of shots; or shots in files, which are inverted "
            "into one store.</qt>"
        )
        super().__init__(viewer, tip, suits=about.may_be_shot)
        self.setPlaceholderText("no image is open")
        qt.while_alive(self, viewer.layers, "inserted", self._on_insertion)

    def _default(self) -> Any:
        *earlier, best = self._recorded or self.offered
        for layer in reversed(earlier):
            if self._is_better(layer, best):
                best = layer
        return best

    def _on_insertion(self, event: Any) -> None:
        current, new = self.layer, event.value
        if self.is_chosen or current is None or new is current or new not in self.offered:
            return
        if self._is_better(new, current):
            self._select(new)

    @property
    def _recorded(self) -> list[Any]:
        return [layer for layer in self.offered if not about.belongs_to_result(layer)]

    def _is_better(self, layer: Any, other: Any) -> bool:
        return layers.is_rather_shot(layer, other, is_pair=len(self._recorded) == 2)

    @property
    def kind(self) -> str:
        return str(self.currentData() or LAYER)

    def fill(self, _: Any = None) -> None:
        layer, kind = self.layer, self.kind
        with QSignalBlocker(self):
            super().fill()
            if self.offered:
                self.insertSeparator(self.count())
            for key, title in _PLACES.items():
                self.addItem(title, key)
            if kind != LAYER:
                self.setCurrentIndex(self.findData(kind))
            elif not self.offered:
                self.setCurrentIndex(-1)
        if self.layer is not layer:
            self.picked.emit()


class ShotsPicker(QWidget):
    """Where shots come from: a layer, files, a table of them, or a folder to watch."""

    changed = Signal()

    def __init__(self, viewer: Any) -> None:
        super().__init__()
        self.layers = _ShotChoice(viewer)
        self.files = forms.PathEdit(
            "Files of the shots",
            "shots/*.tif",
            "A pattern such as shots/*.tif, files separated by ;, or a file of frames.",
            ask=_ask_for_files,
        )
        self.table = forms.PathEdit(
            "Table of the shots",
            "shots.csv",
            "A table (.csv) with a row for each shot and the columns file, setup, energy or "
            "wavelength, brightness, mask, source, exclude.",
            qt.TABLES,
        )
        self.folder = forms.PathEdit(
            "Folder to watch",
            "folder",
            "Each new file in this folder is inverted as soon as it is complete, until you press "
            "Cancel.",
            ask=_ask_for_folder,
        )
        self.paths = {FILES: self.files, TABLE: self.table, FOLDER: self.folder}
        self._rows = {kind: forms.labelled("", path) for kind, path in self.paths.items()}
        qt.column(self, forms.labelled("Image", self.layers), *self._rows.values())
        self.layers.picked.connect(self._on_choice)
        for path in self.paths.values():
            path.changed.connect(self.changed)
        self._on_choice()

    @property
    def kind(self) -> str:
        return self.layers.kind

    def set_kind(self, kind: str) -> None:
        """Take the shots from files, a table or a folder."""
        self.layers.setCurrentIndex(self.layers.findData(kind))

    def _on_choice(self) -> None:
        for kind, row in self._rows.items():
            row.setVisible(kind == self.kind)
        self.changed.emit()

    @property
    def is_stack(self) -> bool:
        layer = self.layers.layer
        return self.kind != LAYER or (layer is not None and layer.ndim > 2)

    @property
    def name(self) -> str:
        """The name of the shots, such as a path."""
        if self.kind in self.paths:
            return self.paths[self.kind].path
        return "" if self.layers.layer is None else str(self.layers.layer.name)

    @property
    def default_store(self) -> str:
        """The store beside the files; empty for a layer, or without files."""
        path = Path(self.name.split(_SEPARATOR.strip())[0].strip()).expanduser()
        if self.kind == FILES:
            path = path.parent  # shots/*.tif
        has_name = self.kind != LAYER and path.name
        return str(path.with_name(path.stem + STORE_SUFFIX)) if has_name else ""

    def shots(self) -> Any:
        """Return the shots of a stack for a run, or raise an `InputError`."""
        if self.kind == LAYER:
            return layers.stack_of(self.layers.layer)
        if self.kind in _MISSING:
            if not self.name:
                raise InputError(_MISSING[self.kind])
            path = Path(self.name).expanduser()
            if self.kind == TABLE and not (path.is_file() and is_table(path)):
                found = "is no table" if path.is_file() else "does not exist"
                raise InputError(
                    f"{path} {found}: expected a .csv file that begins with names of "
                    "columns, such as file and energy"
                )
            return path
        parts = [part.strip() for part in self.files.path.split(_SEPARATOR.strip())]
        paths = [os.path.expanduser(part) for part in parts if part]
        if not paths:
            raise InputError(
                "no files are selected: enter a pattern such as shots/*.tif, or choose files"
            )
        return paths[0] if len(paths) == 1 else paths


class StoreSection(QWidget):
    """The store of a stack's results, and the choices of its run."""

    def __init__(self) -> None:
        super().__init__()
        tip = f"Folder for the results, named …{STORE_SUFFIX}. If it exists, the run is resumed."
        self.folder = forms.PathEdit(
            "Store of the results", f"results{STORE_SUFFIX}", tip, ask=_ask_for_store
        )
        self.run, self.watch = forms.ModelForm(RunOptions), forms.ModelForm(WatchOptions)
        run = forms.section("Run of many shots", self.run, self.watch)
        self._proposed = ""
        qt.column(self, forms.labelled("Store", self.folder), run)

    @property
    def path(self) -> Path:
        if not self.folder.path:
            raise InputError(
                "no store is selected for the results: choose a folder whose name ends with "
                f"{STORE_SUFFIX}"
            )
        return Path(self.folder.path).expanduser()

    def follow(self, shots: ShotsPicker) -> None:
        """Show the choices for a kind of shots, and their store unless the user chose another."""
        kind = shots.kind
        if self.folder.path in ("", self._proposed):
            self._proposed = shots.default_store
            self.folder.restore(self._proposed)
        # Watched shots are inverted one by one, as they arrive.
        self.run.setVisible(kind != FOLDER)
        self.watch.setVisible(kind == FOLDER)

    def options(self, kind: str) -> Any:
        """Return the options of a run, or raise an `InputError`."""
        return (self.watch if kind == FOLDER else self.run).model()

    def begin(self) -> None:
        """Uncheck what counts for one run: another must not discard its shots."""
        for form in (self.run, self.watch):
            if ONCE & form.state().keys():
                form.restore(lasting(form.state()))
