"""Buttons below Run: `SaveButton` saves a result, `MoreLayersButton` shows its hidden layers."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from napari.utils.notifications import show_info
from qtpy.QtWidgets import QFileDialog, QMessageBox, QPushButton

from napari_shadowinv._napari.layer_metadata import metadata_of, result_of, role_of
from napari_shadowinv._napari.layer_state import missing_layers
from napari_shadowinv._napari.stores import shot_of_store
from napari_shadowinv._napari.viewer_sync import plane_in_view
from napari_shadowinv._napari.widgets._qt import notify_errors
from napari_shadowinv._napari.widgets._results import ResultLayers
from napari_shadowinv._napari.writer import dataset_to_save
from napari_shadowinv.errors import InputError
from napari_shadowinv.facts import ResultKind
from napari_shadowinv.inversion.variables import setup_from_dataset
from napari_shadowinv.io import write
from napari_shadowinv.io.formats import (
    NPY,
    PNG,
    PRADFORMAT,
    RESULT,
    SITES,
    TIFF,
    Format,
    formats_for,
)

if TYPE_CHECKING:
    from napari_shadowinv._napari.widgets._panels import ToolPanel
    from napari_shadowinv.physics.setup import Setup

_TITLES = {
    RESULT: "Complete result",
    PRADFORMAT: "Potential and deflection, pradformat",
    SITES: "Table of sites",
    TIFF: "Image, float32 TIFF",
    NPY: "Image, NumPy array",
    PNG: "Image, 16-bit PNG",
}
IMAGE_FORMATS = (TIFF, NPY, PNG)


@dataclass(frozen=True, eq=False)
class Savable:
    """Content to save, its name, and the available formats, the default first."""

    name: str
    content: Any
    formats: tuple[Format, ...]
    setup: Setup | None = None  # of an image


def shown_result(viewer: Any, preferred: Iterable[Any] = ()) -> Any:
    """Return a layer of the shown result, or raise an `InputError` without one.

    The selected layer comes first, then the preferred layers, then the topmost visible one.
    """
    visible = [layer for layer in reversed(viewer.layers) if layer.visible]
    for layer in (viewer.layers.selection.active, *preferred, *visible):
        metadata = {} if layer is None else metadata_of(layer)
        if metadata.get("result") is not None or metadata.get("store") is not None:
            return layer
    raise InputError("there is no result yet: press Run first, or select a layer of a result")


def result_to_save(viewer: Any, layer: Any) -> Savable:
    """Collect the result that a layer belongs to, with the appearance of its layers."""
    result = result_of(layer)
    if result is None:
        raise InputError(f"'{layer.name}' shows no result: select a layer of a result")
    layer_data = [each.as_layer_data_tuple() for each in viewer.layers if result_of(each) is result]
    formats = _formats_for(result.content.kind, result.setup)
    name = str(metadata_of(layer).get("name") or layer.name)
    return Savable(name, dataset_to_save(layer_data), formats)


def shot_to_save(viewer: Any, layer: Any) -> Savable:
    """Collect the displayed shot of a store."""
    store = metadata_of(layer).get("store")
    if store is None:
        return result_to_save(viewer, layer)
    index = plane_in_view(viewer, layer)
    shots = metadata_of(layer).get("shots", ())
    name = Path(shots[index]).stem if index < len(shots) else str(index)
    dataset = shot_of_store(Path(store), index)
    formats = _formats_for(ResultKind.of(dataset.attrs), setup_from_dataset(dataset))
    return Savable(f"{metadata_of(layer).get('name', '')} {name}", dataset, formats)


def _formats_for(kind: ResultKind, setup: Setup | None) -> tuple[Format, ...]:
    has_particles = setup is not None and setup.in_pradformat
    return tuple(each for each in formats_for(kind) if has_particles or each is not PRADFORMAT)


class SaveButton(QPushButton):
    """Asks for a file, saves the result of `savable`, and reports the path."""

    def __init__(self, tool: ToolPanel, savable: Callable[[], Savable], tip: str) -> None:
        super().__init__("Save result…")
        self._tool, self._savable = tool, savable
        self.setToolTip(f"<qt>{tip}</qt>")
        self.clicked.connect(lambda: self.ask_and_save())

    @notify_errors
    def ask_and_save(self) -> None:
        """Ask for a file and save the content, unless the user cancels."""
        content = self._savable()
        path = self._ask(content)
        if path is not None and self._may_replace(path):
            self._write(content, path)

    def _ask(self, content: Savable) -> Path | None:
        filters = {f"{_TITLES[form]} (*{form.suffix})": form for form in content.formats}
        # _may_replace asks about the complete name, with its suffix.
        text, selected_filter = QFileDialog.getSaveFileName(
            self,
            "Save result",
            _file_name(content.name) + content.formats[0].suffix,
            ";;".join(filters),
            options=QFileDialog.Option.DontConfirmOverwrite,
        )
        if not text:
            return None
        path = Path(text).expanduser()
        suffixes = [suffix for form in content.formats for suffix in form.suffixes]
        if path.suffix.lower() in suffixes:
            return path
        return path.with_name(path.name + filters.get(selected_filter, content.formats[0]).suffix)

    def _may_replace(self, path: Path) -> bool:
        if not path.exists():
            return True
        buttons = QMessageBox.StandardButton
        answer = QMessageBox.question(
            self,
            "Save result",
            f"{path.name} already exists. Replace it?",
            buttons.Yes | buttons.No,
        )
        return bool(answer == buttons.Yes)

    def _write(self, content: Savable, path: Path) -> None:
        write(path, content.content, setup=content.setup, overwrite=True)
        kind = next(form for form in content.formats if path.suffix.lower() in form.suffixes)
        title = _TITLES[kind]
        text = f"Saved {title[:1].lower()}{title[1:]} in {path.absolute()}"
        self._tool.panel.say(text)
        show_info(text)


class MoreLayersButton(QPushButton):
    """Adds the hidden layers of a result."""

    def __init__(self, tool: ToolPanel, results: Callable[[], ResultLayers | None]) -> None:
        super().__init__("More layers")
        self._tool, self._results = tool, results
        self._others = ResultLayers(tool.viewer, self)
        self.setToolTip(
            "<qt>Add further layers of the result: potential, components of the field, "
            "re-projection, sites and others.</qt>"
        )
        self.clicked.connect(lambda: self.add())

    @notify_errors
    def add(self) -> None:
        """Add the layers, hidden, to this result and to later results of the same shot."""
        results = self._results()
        tool_layers = [] if results is None else results.layers
        layer = shown_result(self._tool.viewer, tool_layers)
        missing = missing_layers(self._tool.viewer, layer)
        if not missing:
            show_info("All layers of the result are in the layer list")
        elif results is not None and layer in tool_layers:
            results.extend(missing)
        else:
            self._others = ResultLayers(self._tool.viewer, self)
            self._others.show(missing, select=False)


def field_of(layers: Iterable[Any]) -> list[Any]:
    """Select the layers that show a field's strength."""
    return [layer for layer in layers if role_of(layer) == "field"]


def _file_name(name: str) -> str:
    stem = "".join(c if c.isalnum() or c in "-_. " else "_" for c in name).strip(" .")
    return stem.replace(" ", "_") or "result"
