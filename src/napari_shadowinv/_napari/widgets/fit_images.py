"""The widget that fits fields to several images of one object: `FitImages`.

- its images, each with a check box and its energy: `ImageTable`
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

from qtpy.QtCore import QSignalBlocker, Qt, Signal
from qtpy.QtWidgets import QHeaderView, QSizePolicy, QTableWidget, QTableWidgetItem

from napari_shadowinv._napari import form as forms
from napari_shadowinv._napari import layer_metadata as about
from napari_shadowinv._napari.jobs import Finished, FitJob, name_of_result
from napari_shadowinv._napari.layer_metadata import kind_of
from napari_shadowinv._napari.run import Run
from napari_shadowinv._napari.widgets import _inputs as inputs
from napari_shadowinv._napari.widgets import _layers as layers
from napari_shadowinv._napari.widgets import _qt as qt
from napari_shadowinv._napari.widgets._panels import ResultView, result_frame
from napari_shadowinv._napari.widgets._qt import side_by_side
from napari_shadowinv._system.validation import labels_of, validate
from napari_shadowinv.errors import InputError
from napari_shadowinv.fitting import Fit
from napari_shadowinv.options import FitChoices, FitOptions
from napari_shadowinv.physics.beam import BeamQuantity, number_in_unit, text_in_unit
from napari_shadowinv.physics.setup import SETUPS, Setup
from napari_shadowinv.pipeline.costs import fit_cost
from napari_shadowinv.preprocessing import FIT_STEPS, Recipe
from napari_shadowinv.shot import Shot

# Choices of a fit that other controls of the window make.
_ELSEWHERE = {"fields", "beam", "source_size", "resolution", "options"}


def _has_recorded_beam(image: Any | None) -> bool:
    """Whether an image belongs to a result with its beam, which no fit of several has found."""
    result = None if image is None else about.result_of(image)
    if result is None or about.source_of(image) is not None:
        return result is not None
    provenance = result.content.provenance
    origins = () if provenance is None else provenance.images
    return bool(origins) and all(origin.source is not None for origin in origins)


class FitImages(inputs.ImagePanel):
    """Choose images of one object at several energies, then press Run."""

    command = "fit"

    def __init__(self, napari_viewer: Any) -> None:
        tip = "Fit the fields, and an unknown beam, to all images together."
        panel = Run("Run", tip)
        super().__init__(napari_viewer, panel)
        self._build()
        self._connect()
        self._on_reference()
        self.view.follow()
        self._ready = True

    def _build(self) -> None:
        self.make_inputs(
            inputs.FIT_SOURCES,
            "The beam without the object. An unknown beam is fitted as a smooth beam, the same in "
            "all images except for its brightness.",
            FitOptions,
            inputs.SetupPicker("fit-images"),
            FIT_STEPS,
        )
        self.images = ImageTable(
            self.viewer, lambda layer: about.may_be_shot(layer) and layer is not self.source.layer
        )
        self.fields = forms.ModelPicker(
            "Fields", {}, "Field that deflects the beam. Two fields require images at two energies."
        )
        fields = FitChoices.model_fields.keys() - _ELSEWHERE
        self.choices = forms.ModelForm(FitChoices, sorted(fields))
        self.setup_section = forms.titled_section(self.setup)
        self.cost = forms.WrappingLabel()
        tip = (
            "Save the selected or last fit: complete with its layers (.shadowinv), or its field "
            "for other programs (.h5)."
        )
        self.view = ResultView(self, Fit, tip)
        self.add(self.images, self.fields, self.source, self.masks, self.choices)
        self.add(self.setup_section, *self.settings)
        self.add(side_by_side((self.keep_earlier, 1), (self.recipes, 0)), self.cost, self.panel)
        self.add(self.view)

    def _connect(self) -> None:
        self.images.reference_changed.connect(self._on_reference)
        self.images.changed.connect(self._show_beams)
        self.source.changed.connect(self.images.fill)
        self.setup.changed.connect(self._on_setup)
        for part in self.parts():
            part.changed.connect(lambda *_: self.compare())
            part.changed.connect(lambda *_: self._show_cost())
        for signal in (self.images.changed, self.images.reference_changed):
            signal.connect(self._show_cost)

    def parts(self) -> tuple[Any, ...]:
        return *super().parts(), self.fields, self.choices

    def recipe(self) -> Recipe:
        """Return the recipe of the controls, without table and layers; or raise an `InputError`."""
        choices = self.choices.model().model_copy(
            update={
                "fields": tuple(self.fields.kind.split(inputs.BOTH)),
                "beam": "unknown" if self.source.kind == inputs.UNKNOWN else "known",
                "options": self.options.model(),
            }
        )
        return self.input_recipe(steps=self.steps.steps(), fit=choices)

    def _instrument(self) -> Any:
        return self.instrument.model()  # each shot says whether its beam was measured

    def chosen_image(self) -> Any | None:
        """Return the layer of the reference, to which masks and source of a recipe belong."""
        return self.images.reference

    def request(self) -> FitJob:
        images = self._images()
        first = images[0]
        recipe = self.recipe()
        if recipe.setup is None:
            raise InputError(
                "there is no setup: select the kind of beam, and enter the lengths; a fit without "
                "lengths, by displacements relative to the first image, is for Python and the "
                "command, as 'strength'"
            )
        shots = self._shots(images, recipe.setup)
        steps = "; ".join(step.summary for step in recipe.steps)
        described = self.describe(first, recipe, (*images, self.masks.layer), steps=steps)
        name = f"{name_of_result(first).removesuffix(' fit')} fit"
        return FitJob(shots=shots, name=name, frame=result_frame(first, recipe), **described)

    def _shots(self, images: Sequence[Any], setup: Setup) -> tuple[Shot, ...]:
        """Return the images, lazy if their layers are, with all their settings."""
        is_measured = self.source.layer is None or not about.is_estimate(self.source.layer)
        return tuple(
            replace(
                self.shot_of(image),
                name=image.name,
                setup=self._setup_of(image, setup),
                measured=is_measured,
                cautions=layers.cautions_of(image),
            )
            for image in images
        )

    def show_result(self, finished: Finished, job: FitJob) -> None:
        self.results = self.view.show_fit(job, finished)
        self._show_cost()

    def _show_cost(self) -> None:
        try:
            images, recipe = self._images(), self.recipe()
            shape = recipe.shape_after(images[0].data.shape)
            assert recipe.fit is not None
            cost = fit_cost(shape, len(images), recipe.fit, recipe.instrument)
        except InputError:
            self.cost.setVisible(False)  # Run reports the problem
            return
        self.cost.show_text(cost.text)

    def _images(self) -> list[Any]:
        images = self.images.used
        if len(images) < 2:
            raise InputError(
                f"{len(images) or 'no'} image{'s are' if not images else ' is'} checked, expected "
                "two or more of one object: open them, split a stack (right click on the layer → "
                "Split Stack), or use 'Refine' in Invert for one image"
            )
        return images

    def _setup_of(self, image: Any, setup: Setup) -> Setup:
        """Return the setup of an image, its own or the reference's, with the beam of its row."""
        if image is self.images.reference:
            return setup
        of_image, beam = about.setup_of(image), self.images.beam
        base = of_image if of_image is not None and of_image.kind == setup.kind else setup
        values = {**base.model_dump(), beam.name: self.images.beam_value(image)}
        model_class = SETUPS[setup.kind]
        names = labels_of(model_class) | {beam.name: f"'{beam.noun.capitalize()}'"}
        return validate(model_class, values, f"the setup of '{image.name}'", names)

    def showEvent(self, event: Any) -> None:
        super().showEvent(event)
        # Another widget may have changed setups; now the rows have the heights of napari's style.
        self.images.fill()
        image = self.images.reference
        setup = None if image is None else about.setup_of(image)
        if self._ready and setup is not None and setup != self.setup.complete_setup():
            self.setup.suggest(setup, about.setup_origin_of(image))

    def _on_reference(self) -> None:
        """Show the setup of a new reference; without a setup it gets the last one."""
        image, old_setup = self.images.reference, self.setup.complete_setup()
        # Other images show the same object: none of them is the beam of another.
        self.source.follow(image if _has_recorded_beam(image) else None)
        self.setup.follow(image)
        if image is not None:
            self.masks.follow(image)
            if about.setup_of(image) is None and old_setup is not None:
                beam = old_setup.beam_quantity().name
                typed = entries_of(image).get(beam)
                self.setup.show_setup(old_setup.model_dump() | ({beam: typed} if typed else {}))
        self.view.empty()
        self._on_setup()
        # A complete setup is folded to show the controls below.
        if self.setup.complete_setup() is None:
            self.setup_section.expand(animate=False)
        else:
            self.setup_section.collapse(animate=False)

    def _on_setup(self) -> None:
        self.fields.offer(inputs.fields_of(self.setup.kind))
        setup = self.setup.complete_setup()
        summary = "none" if setup is None else f"{setup.probe}, {self.setup.origin}"
        self.setup_section.setText(f"Setup: {summary}")
        self.setup_section.setToolTip(f"Setup: {summary}")
        self._show_beams()

    def _show_beams(self) -> None:
        kind, form = self.setup.kind, self.setup.form
        value = None if form is None else form.state().get(beam_of(kind).name)
        self.images.show_beams(kind, value)


_METADATA_KEY = "fit"  # a row's entries in its layer's metadata
_MAX_HEIGHT_PX = 270  # higher ones scroll
_BEAM_WIDTH_PX = 110
_READABLE = Qt.ItemFlag.ItemIsEnabled
_EDITABLE = _READABLE | Qt.ItemFlag.ItemIsEditable


def beam_of(kind: str) -> BeamQuantity:
    """Return the quantity that differs between images, by default for the first kind of setup."""
    return SETUPS.get(kind, next(iter(SETUPS.values()))).beam_quantity()


def entries_of(layer: Any) -> dict[str, Any]:
    """Return what the user has typed or checked for an image, which its layer keeps."""
    return dict(about.metadata_of(layer).get(_METADATA_KEY, {}))


def store_entries(layer: Any, **values: Any) -> None:
    # New dicts: a duplicate of the layer may share the old ones.
    entries = {**entries_of(layer), **values}
    layer.metadata[about.KEY] = {**about.metadata_of(layer), _METADATA_KEY: entries}


class ImageTable(QTableWidget):
    """The 2-D images of a viewer with their energies; the first in use is the reference.

    A cell keeps the text that the user has typed; others show the value of the image's setup.
    """

    changed = Signal()  # an entry or the selection
    reference_changed = Signal()

    def __init__(self, viewer: Any, suits: Callable[[Any], bool]) -> None:
        super().__init__(0, 2)
        self._viewer, self._suits = viewer, suits
        # The first image in use, whose pixels and units the fields have.
        self.reference: Any = None
        self.images: list[Any] = []
        self.beam = beam_of("")
        self.verticalHeader().setVisible(False)
        self.setSelectionMode(QTableWidget.SelectionMode.NoSelection)
        self.setSizeAdjustPolicy(QTableWidget.SizeAdjustPolicy.AdjustToContents)
        # Or else a high window would spread all controls of its column.
        self.setSizePolicy(QSizePolicy.Policy.Ignored, QSizePolicy.Policy.Fixed)
        self.setMaximumHeight(_MAX_HEIGHT_PX)
        self.setTextElideMode(Qt.TextElideMode.ElideMiddle)
        self.setWordWrap(False)  # it would cut off the end of a name, which tells images apart
        self.setHorizontalScrollBarPolicy(Qt.ScrollBarPolicy.ScrollBarAlwaysOff)
        header = self.horizontalHeader()
        header.setSectionResizeMode(QHeaderView.ResizeMode.Fixed)
        header.setSectionResizeMode(0, QHeaderView.ResizeMode.Stretch)
        header.resizeSection(1, _BEAM_WIDTH_PX)
        self.itemChanged.connect(self._on_edit)
        qt.while_alive(self, viewer.layers, ("inserted", "removed", "reordered"), self.fill)
        qt.layers_while_alive(self, viewer.layers, "name", self.fill)
        self.fill()

    @property
    def used(self) -> list[Any]:
        """The layers of the checked rows, the reference first."""
        return [image for row, image in enumerate(self.images) if self._is_checked(row)]

    def fill(self, _: Any = None) -> None:
        """List the images; the window then shows their energies by `show_beams`."""
        self.images = [layer for layer in self._viewer.layers if self._is_image(layer)]
        shapes = Counter(image.data.shape for image in self.images)
        common_shape = max(shapes, key=lambda shape: shapes[shape], default=None)
        with QSignalBlocker(self):
            self.setRowCount(len(self.images))
            for row, image in enumerate(self.images):
                use = entries_of(image).get("use", image.data.shape == common_shape)
                name = QTableWidgetItem(image.name)
                name.setFlags(_READABLE | Qt.ItemFlag.ItemIsUserCheckable)
                name.setToolTip(image.name)
                name.setCheckState(Qt.CheckState.Checked if use else Qt.CheckState.Unchecked)
                self.setItem(row, 0, name)
                self.setItem(row, 1, QTableWidgetItem())
        self._on_use()

    def show_beams(self, kind: str, value: Any) -> None:
        """Fill the cells; `value` is the reference's energy or wavelength in the shown setup."""
        beam = self.beam = beam_of(kind)
        title = beam.noun.capitalize()
        has_prefix = beam.unit == "m"  # of each number
        self.setHorizontalHeaderLabels(["Image", title if has_prefix else f"{title} ({beam.unit})"])
        with QSignalBlocker(self):
            for row, image in enumerate(self.images):
                is_reference = image is self.reference  # its energy is that of the setup
                shown, cell = value if is_reference else self._stated(image), self.item(row, 1)
                if isinstance(shown, float | int):
                    shown = text_in_unit(shown, "m") if has_prefix else f"{shown:.6g}"
                cell.setText(shown or "")
                cell.setFlags(_READABLE if is_reference else _EDITABLE)
                cell.setToolTip(f"<qt>{beam.description}</qt>")

    def beam_value(self, image: Any) -> float:
        """Return energy or wavelength of an image, or raise an `InputError`."""
        value, noun = self._stated(image), self.beam.noun
        if value is None:
            raise InputError(
                f"'{image.name}' has no {noun}: enter it in the table, or uncheck the image"
            )
        try:
            return number_in_unit(value, self.beam.unit) if isinstance(value, str) else value
        except ValueError as error:
            text = f"{noun} of '{image.name}': received {value!r}, {error}"
            raise InputError(text) from error

    def _stated(self, image: Any) -> Any:
        """Return what was typed, or else the value of the layer's setup, or None."""
        own = getattr(about.setup_of(image), self.beam.name, None)
        return entries_of(image).get(self.beam.name) or own

    def _is_checked(self, row: int) -> bool:
        return bool(self.item(row, 0).checkState() == Qt.CheckState.Checked)

    def _on_edit(self, item: Any) -> None:
        image = self.images[item.row()]
        if item.column() == 0:
            store_entries(image, use=self._is_checked(item.row()))
            self._on_use()
        else:
            store_entries(image, **{self.beam.name: item.text().strip()})
            self.changed.emit()

    def _on_use(self) -> None:
        old_reference, self.reference = self.reference, next(iter(self.used), None)
        if self.reference is not old_reference:
            self.reference_changed.emit()
        self.changed.emit()

    def _is_image(self, layer: Any) -> bool:
        is_grey = kind_of(layer) == "image" and not getattr(layer, "rgb", False)
        return is_grey and layer.ndim == 2 and self._suits(layer)
