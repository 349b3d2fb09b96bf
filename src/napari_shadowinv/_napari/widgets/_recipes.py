"""What the controls ask for as a file, the same as the command's: `RecipeButton`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from qtpy.QtWidgets import QFileDialog, QMenu, QPushButton, QSizePolicy

from napari_shadowinv._napari.layer_metadata import mark_of, source_of
from napari_shadowinv._napari.widgets._forms import TOML
from napari_shadowinv._napari.widgets._layers import new_crop, new_mask
from napari_shadowinv._napari.widgets._qt import notify_errors
from napari_shadowinv._typing import AnyArray, BoolArray
from napari_shadowinv.errors import InputError
from napari_shadowinv.io import check_output, write
from napari_shadowinv.io.formats import NPY, PNG
from napari_shadowinv.pipeline import read_recipe, write_recipe
from napari_shadowinv.pipeline._run import picture_mask, plane_of
from napari_shadowinv.preprocessing import Crop, MeasuredSource, Recipe


class RecipeButton(QPushButton):
    """A menu to load what a tool with `InversionInputs` is to do, or to save it, as TOML."""

    def __init__(self, tool: Any) -> None:
        super().__init__("Recipe")
        self._tool = tool
        self.setToolTip(
            "<qt>Steps, source, masks, setup and options as one TOML file, for here or "
            "<code>shadowinv invert --recipe</code>.</qt>"
        )
        self.setSizePolicy(QSizePolicy.Policy.Fixed, QSizePolicy.Policy.Fixed)
        menu = QMenu(self)
        menu.addAction("Load…").triggered.connect(lambda: self._ask_and_load())
        menu.addAction("Save…").triggered.connect(lambda: self._ask_and_save())
        self.setMenu(menu)

    def _ask_and_load(self) -> None:
        path, _ = QFileDialog.getOpenFileName(self, "Load recipe", "", TOML)
        if path:
            self.load(Path(path))

    def _ask_and_save(self) -> None:
        path, _ = QFileDialog.getSaveFileName(self, "Save recipe", "recipe.toml", TOML)
        if path:
            self.save(Path(path))

    @notify_errors
    def load(self, path: Path) -> None:
        """Show a recipe; nothing changes unless all of it can be used."""
        tool, image = self._tool, self._tool.chosen_image()
        recipe = read_recipe(path)
        shape = None if image is None else tuple(image.data.shape[-2:])
        crop, steps = None, recipe.steps
        if tool.crop is not None and shape is not None and steps and isinstance(steps[0], Crop):
            crop, steps = steps[0].slices((shape[0], shape[1])), steps[1:]
        masks = {
            tool.masks: _read_mask(recipe.mask, shape),
            tool.source_masks: _read_mask(recipe.source_mask, shape),
        }
        source = _usable_source(recipe, image, path)
        tool.steps.show_steps(steps)
        tool.source.show(source)
        tool.options.set_values(recipe.options.model_dump())
        if recipe.setup is not None:
            tool.setup.load(recipe.setup.model_dump(exclude_none=True), str(path))
        for picker, usable in masks.items():
            picker.layer = None
            if usable is not None:
                picker.layer = new_mask(tool.viewer, image, picker.title.lower(), ~usable)
                picker.painted_is_unusable.setChecked(True)
        if tool.crop is not None:
            tool.crop.layer = None if crop is None else new_crop(tool.viewer, image, crop)

    @notify_errors
    def save(self, path: Path) -> None:
        """Write a recipe, with masks and a source that are no files beside it."""
        tool, image = self._tool, self._tool.chosen_image()
        # The dialog has asked about the name that was given, and about no other.
        overwrite = bool(path.suffix) and path.exists()
        path = path if path.suffix else path.with_suffix(".toml")
        recipe = tool.recipe()
        drawn: dict[str, AnyArray | None] = {
            "mask": tool.masks.usable(image),
            "source_mask": tool.hidden_from_source(image),
        }
        pictures = {
            path.with_name(f"{path.stem}_{name}{PNG.suffix}"): (name, pixels)
            for name, pixels in drawn.items()
            if pixels is not None
        }
        beam = None if _is_in_file(recipe, image, tool.source) else tool.source.measured(image)
        beside = path.with_name(f"{path.stem}_source{NPY.suffix}")
        for file in (path, *pictures, *(() if beam is None else (beside,))):
            check_output(file, overwrite)
        changes: dict[str, Any] = {}
        for file, (name, pixels) in pictures.items():
            changes[name] = write(file, pixels.astype(float), overwrite=overwrite)
        if beam is not None:
            write(beside, plane_of(beam.image, "the source"), overwrite=overwrite)
            changes["source"] = MeasuredSource(file=beside)
        write_recipe(path, recipe.model_copy(update=changes), overwrite=overwrite)


def _read_mask(file: Path | None, shape: tuple[int, ...] | None) -> BoolArray | None:
    if file is None:
        return None
    usable = picture_mask(file)
    if shape is not None and usable.shape != shape:
        raise InputError(f"{file}: mask has shape {usable.shape}, image {shape}: they must match")
    return usable


def _usable_source(recipe: Recipe, image: Any, path: Path) -> Any:
    """The source of a recipe as the controls know it; None for uniform."""
    source = recipe.source
    own = image is not None and source_of(image) is not None
    if source is None:
        return MeasuredSource() if own else None
    if not isinstance(source, MeasuredSource) or source.file is not None:
        return source
    if source.variable is not None and image is not None and mark_of(image).get("path"):
        return MeasuredSource(file=mark_of(image)["path"], variable=source.variable)
    if not own:
        raise InputError(
            f"{path} asks for the source in the shot's own file, but there is none in this image: "
            "choose an image with a source"
        )
    return source


def _is_in_file(recipe: Recipe, image: Any, source: Any) -> bool:
    """Whether a command finds the source without the window: estimated, a file, or the shot's."""
    if not isinstance(recipe.source, MeasuredSource) or recipe.source.file is not None:
        return True
    return source.is_own and bool(mark_of(image).get("path"))
