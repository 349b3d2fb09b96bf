"""Files of a tool: recipes of its controls, and results to save or to repeat.

- recipes, as for the commands: `RecipeButton`
- a result to save: `result_to_save`, `save_as`
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from napari.utils.notifications import show_info
from qtpy.QtWidgets import QApplication, QFileDialog, QMenu, QPushButton, QSizePolicy

from napari_shadowinv._napari import layer_metadata as about
from napari_shadowinv._napari.form import TOML
from napari_shadowinv._napari.jobs import Job, name_of_result
from napari_shadowinv._napari.layers import add_layers
from napari_shadowinv._napari.result_files import (
    dataset_to_save,
    layers_of_result,
    shot_of_store,
)
from napari_shadowinv._napari.viewer_sync import plane_in_view
from napari_shadowinv._napari.widgets._layers import new_mask
from napari_shadowinv._napari.widgets._qt import ask_file, filter_of, notify_errors
from napari_shadowinv._system.progress import OnProgress, ShouldStop
from napari_shadowinv._typing import BoolArray
from napari_shadowinv.errors import InputError
from napari_shadowinv.facts import ResultKind
from napari_shadowinv.inversion.variables import setup_from_dataset
from napari_shadowinv.io import check_output, write
from napari_shadowinv.io.formats import (
    NPY,
    PNG,
    PRADFORMAT,
    RESULT,
    Format,
    formats_for,
)
from napari_shadowinv.pipeline import read_recipe, write_recipe
from napari_shadowinv.pipeline.files import command_of, recipe_entries
from napari_shadowinv.pipeline.inversion_run import picture_mask, plane_of
from napari_shadowinv.pipeline.rerun import Rerun, collect_rerun
from napari_shadowinv.preprocessing import MeasuredSource, Recipe


@dataclass(eq=False)
class _Repetition(Job):
    """A result to repeat, the folder of its files, and the place of its layers."""

    result: about.Result[Any]
    folder: Path
    frame: about.Frame
    name: str

    @classmethod
    def of(cls, layer: Any, viewer: Any) -> _Repetition:
        """Return the repetition of a layer's result; an `InputError` if it has none."""
        result = None if layer is None else about.result_of(layer)
        if result is None:
            raise InputError("select a layer of the result to repeat")
        provenance = result.content.provenance
        names = () if provenance is None else [origin.file for origin in provenance.images]
        paths = [about.metadata_of(each).get("path") or each.source.path for each in viewer.layers]
        opened = [path for path in paths if path and Path(path).name in names]
        folder = Path(next(iter(opened), layer.source.path or "")).parent
        return cls(result, folder, about.frame_of(layer), f"{name_of_result(layer)} repeated")

    def work(self, on_progress: OnProgress, should_stop: ShouldStop) -> Rerun:  # type: ignore[override]
        inputs = collect_rerun(self.result.content, folder=self.folder)
        return inputs.run(on_progress, should_stop)

    def add_to(self, viewer: Any, again: Rerun, job: Job) -> None:
        """Add the layers of the repeated result, and report the difference."""
        repeated = about.Result(again.content, self.result.origins)
        add_layers(viewer, about.main_layers(layers_of_result(repeated, self.frame, self.name)))
        changes = "; ".join(again.changes) or "nothing"
        show_info(f"Difference: {again.difference}. Changed: {changes}")


class RecipeButton(QPushButton):
    """A menu to load, save and copy the recipe of an `ImagePanel`, and to repeat a result."""

    def __init__(self, tool: Any) -> None:
        super().__init__("Recipe")
        self._tool = tool
        self.setToolTip(
            "<qt>Save steps, source, masks, setup and options as one TOML file, which also works "
            f"with <code>shadowinv {tool.command} --recipe</code>.</qt>"
        )
        self.setSizePolicy(QSizePolicy.Policy.Fixed, QSizePolicy.Policy.Fixed)
        menu = QMenu(self)
        if tool.command == "invert":
            menu.addAction("Load recipe…").triggered.connect(lambda: self._ask_and_load())
        menu.addAction("Save…").triggered.connect(lambda: self._ask_and_save())
        if tool.command == "invert":
            menu.addAction("Copy as Python").triggered.connect(lambda: self.copy(_python_of))
            menu.addAction("Copy as command").triggered.connect(lambda: self.copy(command_of))
        menu.addAction("Repeat").triggered.connect(lambda: self.repeat())
        self.setMenu(menu)

    def _ask_and_load(self) -> None:
        path, _ = QFileDialog.getOpenFileName(self, "Load recipe", "", TOML)
        if path:
            self.load(Path(path))

    @notify_errors
    def _ask_and_save(self) -> None:
        if path := ask_file(self, "Save recipe", "recipe.toml", TOML):
            self.save(path)

    @notify_errors
    def copy(self, text_of: Callable[[Recipe, str], str]) -> None:
        """Put the text on the clipboard that makes the same result from the image's file."""
        tool = self._tool
        image = tool.chosen_image()
        path = None if image is None else about.metadata_of(image).get("path") or image.source.path
        if not path or tool.image.is_stack:
            raise InputError("only choices for a single image from a file are copied: open one")
        recipe = tool.recipe_to_save()
        masks = (each.usable(image) for each in tool.mask_pickers.values() if not each.isHidden())
        is_drawn = any(mask is not None for mask in masks)
        if is_drawn or tool.source.to_write(recipe, image) is not None:
            raise InputError(
                "masks or the source are in no file: save the recipe, which writes them, and use "
                "it with read_recipe or --recipe"
            )
        QApplication.clipboard().setText(text_of(recipe, str(path)))
        show_info("Copied to the clipboard")

    @notify_errors
    def repeat(self) -> None:
        """Repeat the result of the selected layer from its files, as further layers."""
        tool = self._tool
        if tool.panel.running:
            raise InputError("a run is under way: wait until it finishes, or press Cancel")
        job = _Repetition.of(tool.viewer.layers.selection.active, tool.viewer)
        tool.start(job, partial(job.add_to, tool.viewer))

    @notify_errors
    def load(self, path: Path) -> None:
        """Show a recipe; change nothing unless all of it is usable."""
        tool, image = self._tool, self._tool.chosen_image()
        recipe = read_recipe(path)
        shape = None if image is None else tuple(image.data.shape[-2:])
        usable = {key: _read_mask(getattr(recipe, key), shape) for key in tool.mask_pickers}
        tool.show_recipe(recipe, path)
        for key, picker in tool.mask_pickers.items():
            _show_mask(picker, usable[key], tool.viewer, image)

    @notify_errors
    def save(self, path: Path) -> None:
        """Write a recipe, with drawn masks and a source layer as files next to it."""
        tool, image = self._tool, self._tool.chosen_image()
        overwrite = path.exists()  # the dialog has asked
        recipe = tool.recipe_to_save()
        pickers = {key: each for key, each in tool.mask_pickers.items() if not each.isHidden()}
        masks = {key: picker.usable(image) for key, picker in pickers.items()}
        beam = tool.source.to_write(recipe, image)
        pictures = {
            path.with_name(f"{path.stem}_{key}{PNG.suffix}"): (key, pixels)
            for key, pixels in masks.items()
            if pixels is not None
        }
        source_file = path.with_name(f"{path.stem}_source{NPY.suffix}")
        for file in (path, *pictures, *(() if beam is None else (source_file,))):
            check_output(file, overwrite)
        changes: dict[str, Any] = {}
        for file, (key, pixels) in pictures.items():
            changes[key] = write(file, pixels.astype(float), overwrite=overwrite)
        if beam is not None:
            write(source_file, plane_of(beam.image, "the source"), overwrite=overwrite)
            changes["source"] = MeasuredSource(file=source_file)
        write_recipe(path, recipe.model_copy(update=changes), overwrite=overwrite)
        tool.panel.say(f"Saved the recipe in {path.absolute()}")


def _python_of(recipe: Recipe, path: str) -> str:
    lines = (
        "from napari_shadowinv import Recipe",
        "from napari_shadowinv.pipeline import run",
        "",
        f"recipe = Recipe.model_validate({recipe_entries(recipe)!r})",
        f"inversion = run(recipe, {path!r})",
    )
    return "\n".join([*lines, ""])


def _show_mask(picker: Any, usable: BoolArray | None, viewer: Any, image: Any) -> None:
    picker.layer = None
    if usable is not None:
        picker.layer = new_mask(viewer, image, picker.title.lower(), ~usable)


def _read_mask(file: Path | None, shape: tuple[int, ...] | None) -> BoolArray | None:
    if file is None:
        return None
    usable = picture_mask(file)
    if shape is not None and usable.shape != shape:
        raise InputError(f"{file}: mask has shape {usable.shape}, image {shape}: they must match")
    return usable


_TITLES = {
    RESULT: "Complete result",
    PRADFORMAT: "Potential and deflection, pradformat",
}


@dataclass(frozen=True, eq=False)
class Savable:
    """Content to save, its name, and the available formats, the default first."""

    name: str
    content: Any
    formats: tuple[Format, ...]


def shown_result(viewer: Any, preferred: Iterable[Any] = ()) -> Any:
    """Return a layer of the shown result, or raise an `InputError` without one.

    The selected layer comes first, then the preferred layers, then the topmost visible one.
    """
    visible = [layer for layer in reversed(viewer.layers) if layer.visible]
    for layer in (viewer.layers.selection.active, *preferred, *visible):
        if layer is not None and about.belongs_to_result(layer):
            return layer
    raise InputError("there is no result yet: press Run first, or select a layer of a result")


def result_to_save(viewer: Any, layer: Any) -> Savable:
    """Collect the result of a layer; of a store, its shot."""
    result, facts = about.result_of(layer), about.metadata_of(layer)
    content: Any
    if result is not None:
        content = dataset_to_save(result, layer)
        name, kind, setup = name_of_result(layer), result.content.kind, result.content.setup
    else:
        index, shots = plane_in_view(viewer, layer), facts.get("shots", ())
        content = shot_of_store(Path(facts["store"]), index)
        shot = Path(shots[index]).stem if index < len(shots) else str(index)
        name, kind = f"{facts.get('name', '')} {shot}", ResultKind.of(content.attrs)
        setup = setup_from_dataset(content)
    has_particles = setup is not None and setup.in_pradformat
    formats = [each for each in formats_for(kind) if has_particles or each is not PRADFORMAT]
    return Savable(name, content, tuple(formats))


def save_as(parent: Any, content: Savable, say: Callable[[str], Any]) -> None:
    """Ask for a file, save the content unless the user cancels, and say where it is."""
    filters = ";;".join(filter_of(_TITLES[form], form.suffixes) for form in content.formats)
    path = ask_file(parent, "Save result", _file_name(content.name), filters)
    if path is None:
        return
    write(path, content.content, overwrite=True)
    suffix = path.suffix.lower()
    title = next(_TITLES[form] for form in content.formats if suffix in form.suffixes)
    text = f"Saved {title[:1].lower()}{title[1:]} in {path.absolute()}"
    say(text)
    show_info(text)


def field_of(layers: Iterable[Any]) -> list[Any]:
    """Select the layers that show a field's strength."""
    return [layer for layer in layers if about.role_of(layer) == "field"]


def _file_name(name: str) -> str:
    stem = "".join(c if c.isalnum() or c in "-_. " else "_" for c in name).strip(" .")
    return stem.replace(" ", "_") or "result"
