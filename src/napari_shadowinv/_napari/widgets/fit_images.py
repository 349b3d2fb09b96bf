"""The widget that fits fields to several images of one object: `FitImages`.

- its images, each with a check box and its numbers: `ImageTable`
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

from qtpy.QtCore import QSignalBlocker, Qt, Signal
from qtpy.QtWidgets import QHeaderView, QSizePolicy, QTableWidget, QTableWidgetItem

from napari_shadowinv._napari import form as forms
from napari_shadowinv._napari import layer_metadata as about
from napari_shadowinv._napari.form import PROBLEM_COLOUR
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
from napari_shadowinv.physics.beam import number_in_unit, text_in_unit
from napari_shadowinv.physics.setup import SETUPS, Setup
from napari_shadowinv.pipeline.costs import fit_cost
from napari_shadowinv.pipeline.shot_table import ShotRow
from napari_shadowinv.preprocessing import FIT_STEPS, Recipe
from napari_shadowinv.shot import Shot

# Choices of a fit that other controls of the window make.
_ELSEWHERE = {"fields", "beam", "psf", "source_size", "resolution", "options"}


def _cautions_of(images: Sequence[Any]) -> dict[str, str]:
    """Return the warnings of the images' readers as a row of the report."""
    texts = [
        f"'{image.name}': {caution.text}"
        for image in images
        for caution in layers.cautions_of(image)
    ]
    return {"Warning": "; ".join(texts)} if texts else {}


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
        self.view = ResultView(self, self._last, Fit, tip)
        self.add(self.images, self.fields, self.source, self.masks, self.choices)
        self.add(self.setup_section, *self.settings)
        self.add(side_by_side((self.keep_earlier, 1), (self.recipes, 0)), self.cost, self.panel)
        self.add(self.view)

    def _connect(self) -> None:
        self.images.reference_changed.connect(self._on_reference)
        self.images.changed.connect(self._show_beams)
        self.source.changed.connect(self.images.fill)
        self.setup.changed.connect(self._on_setup)
        self.choices.changed.connect(self._show_beams)
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

    def recipe_to_save(self) -> Recipe:
        recipe = self.recipe()
        assert recipe.fit is not None
        choices = recipe.fit.model_copy(update={"psf": self.common_psf()})
        return recipe.model_copy(update={"fit": choices})

    def chosen_image(self) -> Any | None:
        """Return the layer of the reference, to which masks and source of a recipe belong."""
        return self.images.reference

    def common_psf(self) -> float | None:
        """Return the common point spread of all images; None if they differ."""
        widths = {self.images.values(image)["psf"] for image in self.images.used}
        return widths.pop() if len(widths) == 1 else None

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
        described["origins"] |= _cautions_of(images)
        name = f"{name_of_result(first).removesuffix(' fit')} fit"
        return FitJob(shots=shots, name=name, frame=result_frame(first, recipe), **described)

    def _shots(self, images: Sequence[Any], setup: Setup) -> tuple[Shot, ...]:
        """Return the images, lazy if their layers are, with all their settings."""
        rows = [self.images.values(image) for image in images]
        # One that is 1 for all need not be said.
        is_known = self._is_brightness_known and any(row["brightness"] != 1 for row in rows)
        return tuple(
            replace(
                self.shot_of(image),
                name=image.name,
                setup=self._setup_of(image, setup),
                brightness=row["brightness"] if is_known else None,
                psf=row["psf"],
                measured=self.source.layer is None or not about.is_estimate(self.source.layer),
            )
            for image, row in zip(images, rows, strict=True)
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
        shape = tuple(images[0].data.shape)
        for image in images[1:]:
            if tuple(image.data.shape) != shape:
                raise InputError(
                    f"'{image.name}' has shape {tuple(image.data.shape)}, '{images[0].name}' "
                    f"{shape}: all images must have the same shape; crop or uncheck the image that "
                    "differs"
                )
        return images

    def _setup_of(self, image: Any, setup: Setup) -> Setup:
        """Return the setup of an image, its own or the reference's, with the beam of its row."""
        beam, base = self.images.beam, self._base_setup(image, setup)
        values = {**base.model_dump(), beam.name: self.images.beam_value(image)}
        model_class = SETUPS[setup.kind]
        names = labels_of(model_class) | {beam.name: f"'{beam.title}'"}
        return validate(model_class, values, f"the setup of '{image.name}'", names)

    def _base_setup(self, image: Any, setup: Setup) -> Setup:
        own = about.setup_of(image)
        is_of_kind = own is not None and own.kind == setup.kind
        return own if own and is_of_kind and image is not self.images.reference else setup

    def showEvent(self, event: Any) -> None:
        super().showEvent(event)
        # Another widget may have changed the setup of the reference.
        setup = self._setup_of_reference()
        if self._ready and setup not in (None, self.setup.complete_setup()):
            self.setup.suggest(setup, about.setup_origin_of(self.images.reference))

    def _setup_of_reference(self) -> Any:
        image = self.images.reference
        return None if image is None else about.setup_of(image)

    def _on_reference(self) -> None:
        """Show the setup of a new reference; without a setup it gets the last one."""
        image, old_setup = self.images.reference, self.setup.complete_setup()
        # Other images show the same object: none of them is the beam of another.
        self.source.follow(image if _has_recorded_beam(image) else None)
        self.setup.follow(image)
        if image is not None:
            self.masks.follow(image)
            own = self._setup_of_reference()
            if (base := own or old_setup) is not None:
                values, beam = base.model_dump(), beam_column(base.kind).name
                entry = entries_of(image).get(beam)
                if isinstance(entry, float) and own is None:
                    values[beam] = entry
                setup = self.setup.complete_setup()
                if setup is None or values != setup.model_dump():
                    self.setup.show_setup(values)
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
        form = self.setup.form
        beam = None if form is None else form.state().get(self.images.beam.name)
        self.images.show_beams(self.setup.kind, beam, self._is_brightness_known)

    @property
    def _is_brightness_known(self) -> bool:
        return self.choices.state().get("brightness") != "free"


_PREFIXED_UNIT = "m"  # cells show it, with the prefix of each number
_METADATA_KEY = "fit"  # a row's entries in its layer's metadata
_MAX_ROWS = 8  # more of them scroll
_BEAM, _BRIGHTNESS = 1, 2  # columns
_READABLE = Qt.ItemFlag.ItemIsEnabled
_EDITABLE = _READABLE | Qt.ItemFlag.ItemIsEditable


@dataclass(frozen=True)
class Column:
    """A column of numbers in a unit."""

    name: str
    title: str
    unit: str
    tip: str
    width_px: int = 90
    default: float | None = None

    @property
    def heading(self) -> str:
        unit = "" if self.unit == _PREFIXED_UNIT else self.unit
        return f"{self.title} ({unit})" if unit else self.title

    def read(self, text: str) -> Any:
        """Return a number, None for nothing, or text that is no number."""
        with suppress(ValueError):  # the text stays for correction
            return number_in_unit(text, self.unit) if text else None
        return text

    def show(self, value: Any) -> str:
        """Return the text of a value, rounded."""
        if value is None or isinstance(value, str):
            return value or ""
        return text_in_unit(value, "m") if self.unit == _PREFIXED_UNIT else f"{value:.6g}"

    def problem(self, value: Any) -> str:
        """Return what is wrong with a value, in a sentence; empty for a number."""
        try:
            if isinstance(value, str):
                number_in_unit(value, self.unit)
        except ValueError as error:
            return f"received {value!r}, {error}"
        return ""


def _column(name: str, title: str, unit: str, width_px: int, default: float) -> Column:
    """Return the column of a field of a row of shots."""
    return Column(name, title, unit, str(ShotRow.model_fields[name].description), width_px, default)


_OTHER_COLUMNS = (
    _column("brightness", "Brightness", "", 76, 1.0),
    _column("psf", "PSF σ", "px", 72, 0.0),
)


def beam_column(kind: str) -> Column:
    """Return the column for a kind of setup, by default for the first."""
    quantity = SETUPS.get(kind, next(iter(SETUPS.values()))).beam_quantity()
    title = quantity.noun.capitalize()
    return Column(quantity.name, title, quantity.unit, quantity.description)


def entries_of(layer: Any) -> dict[str, Any]:
    """Return the user's entries for an image, which its layer keeps."""
    return dict(about.metadata_of(layer).get(_METADATA_KEY, {}))


def store_entries(layer: Any, **values: Any) -> None:
    # New dicts: a duplicate of the layer may share the old ones.
    entries = {**entries_of(layer), **values}
    layer.metadata[about.KEY] = {**about.metadata_of(layer), _METADATA_KEY: entries}


class ImageTable(QTableWidget):
    """The 2-D images of a viewer; the first in use is the reference."""

    changed = Signal()  # an entry or the selection
    reference_changed = Signal()

    def __init__(self, viewer: Any, suits: Callable[[Any], bool]) -> None:
        super().__init__(0, 2 + len(_OTHER_COLUMNS))
        self._viewer, self._suits = viewer, suits
        # The first image in use, whose pixels and units the fields have.
        self.reference: Any = None
        self.images: list[Any] = []
        self.verticalHeader().setVisible(False)
        self.setSelectionMode(QTableWidget.SelectionMode.NoSelection)
        # Or else a high window would spread all controls of its column.
        self.setSizePolicy(QSizePolicy.Policy.Expanding, QSizePolicy.Policy.Fixed)
        self.setTextElideMode(Qt.TextElideMode.ElideMiddle)
        self.setWordWrap(False)  # it would cut off the end of a name, which tells images apart
        self.setHorizontalScrollBarPolicy(Qt.ScrollBarPolicy.ScrollBarAlwaysOff)
        header = self.horizontalHeader()
        header.setSectionResizeMode(QHeaderView.ResizeMode.Fixed)
        header.setSectionResizeMode(0, QHeaderView.ResizeMode.Stretch)
        self._set_beam(beam_column(""))
        for number, spec in enumerate(self._columns, 1):
            header.resizeSection(number, spec.width_px)
        self.itemChanged.connect(self._on_edit)
        qt.while_alive(self, viewer.layers, ("inserted", "removed", "reordered"), self.fill)
        qt.layers_while_alive(self, viewer.layers, "name", self.fill)
        self.fill()

    @property
    def used(self) -> list[Any]:
        """The layers of the checked rows, the reference first."""
        return [image for row, image in enumerate(self.images) if self._is_checked(row)]

    def fill(self, _: Any = None) -> None:
        self.images = [layer for layer in self._viewer.layers if self._is_image(layer)]
        shapes = Counter(image.data.shape for image in self.images)
        common_shape = max(shapes, key=lambda shape: shapes[shape], default=None)
        with QSignalBlocker(self):
            self.setRowCount(len(self.images))
            for row, image in enumerate(self.images):
                use = entries_of(image).get("use", image.data.shape == common_shape)
                name = QTableWidgetItem(image.name)
                name.setFlags(Qt.ItemFlag.ItemIsEnabled | Qt.ItemFlag.ItemIsUserCheckable)
                name.setToolTip(f"<qt>{image.name}: {_setup_summary(image)}.</qt>")
                name.setCheckState(Qt.CheckState.Checked if use else Qt.CheckState.Unchecked)
                self.setItem(row, 0, name)
                for number in range(1, self.columnCount()):
                    self.setItem(row, number, QTableWidgetItem())
        self._fit_height()
        self._on_use()

    def showEvent(self, event: Any) -> None:
        super().showEvent(event)
        # The rows have the heights of napari's style only now, and another widget may have changed
        # a layer's setup.
        self.fill()

    def show_beams(self, kind: str, value: Any, is_brightness_known: bool) -> None:
        """Fill the cells; `value` is the reference's energy or wavelength in the shown setup."""
        self._set_beam(beam_column(kind))
        for row, image in enumerate(self.images):
            beam = value if image is self.reference else self._beam_of(image)
            values = {**entries_of(image), self.beam.name: beam}
            for number, spec in enumerate(self._columns, 1):
                self._write(row, number, values.get(spec.name, spec.default))
            with QSignalBlocker(self):
                # Energy or wavelength of the reference are those of the setup.
                is_reference = image is self.reference
                self.item(row, _BEAM).setFlags(_READABLE if is_reference else _EDITABLE)
                brightness = self.item(row, _BRIGHTNESS)
                brightness.setFlags(_EDITABLE if is_brightness_known else Qt.ItemFlag.NoItemFlags)
                if not is_brightness_known:
                    brightness.setText("free")

    def values(self, image: Any) -> dict[str, Any]:
        """Return the numbers of an image by column, or raise an `InputError`."""
        values = {}
        for number, spec in enumerate(self._columns, 1):
            cell = self.item(self.images.index(image), number)
            value = cell.data(Qt.ItemDataRole.UserRole)
            if problem := spec.problem(value):
                raise InputError(f"{spec.title} of '{image.name}': {problem}")
            values[spec.name] = spec.default if value is None else float(value)
        return values

    def beam_value(self, image: Any) -> float:
        """Return energy or wavelength of an image, or raise an `InputError`."""
        value = self.values(image)[self.beam.name]
        if value is None:
            raise InputError(
                f"'{image.name}' has no {self.beam.title.lower()}: enter it in the table, or "
                "uncheck the image"
            )
        return float(value)

    @property
    def _columns(self) -> tuple[Column, ...]:
        return self.beam, *_OTHER_COLUMNS

    def _set_beam(self, column: Column) -> None:
        self.beam = column
        self.setHorizontalHeaderLabels(["Image", *(spec.heading for spec in self._columns)])

    def _is_checked(self, row: int) -> bool:
        return bool(self.item(row, 0).checkState() == Qt.CheckState.Checked)

    def _beam_of(self, image: Any) -> Any:
        """Return the user's entry, or else the value in the layer's setup."""
        entry = entries_of(image).get(self.beam.name)
        if entry is not None:
            return entry
        return getattr(about.setup_of(image), self.beam.name, None)

    def _write(self, row: int, number: int, value: Any) -> None:
        """Show a number or a text, which the user has to correct if it is no number."""
        item, spec = self.item(row, number), self._columns[number - 1]
        problem = spec.problem(value)
        with QSignalBlocker(self):
            # The shown text is rounded.
            item.setData(Qt.ItemDataRole.UserRole, value)
            item.setText(spec.show(value))
            item.setData(Qt.ItemDataRole.ForegroundRole, PROBLEM_COLOUR if problem else None)
            item.setToolTip(f"<qt>{problem or spec.tip}</qt>")

    def _on_edit(self, item: Any) -> None:
        row, image = item.row(), self.images[item.row()]
        if item.column() == 0:
            store_entries(image, use=self._is_checked(row))
            self._on_use()
            return
        spec = self._columns[item.column() - 1]
        value = spec.read(item.text().strip())
        self._write(row, item.column(), value)
        store_entries(image, **{spec.name: value})
        self.changed.emit()

    def _on_use(self) -> None:
        old_reference, self.reference = self.reference, next(iter(self.used), None)
        if self.reference is not old_reference:
            self.reference_changed.emit()
        self.changed.emit()

    def _is_image(self, layer: Any) -> bool:
        is_grey = kind_of(layer) == "image" and not getattr(layer, "rgb", False)
        return is_grey and layer.ndim == 2 and self._suits(layer)

    def _fit_height(self) -> None:
        rows = sum(self.rowHeight(row) for row in range(min(self.rowCount(), _MAX_ROWS)))
        header = self.horizontalHeader()
        header.setFixedHeight(header.sizeHint().height())
        self.setFixedHeight(header.height() + rows + 2 * self.frameWidth())


def _setup_summary(image: Any) -> str:
    """Return the origin of an image's setup, for the tooltip."""
    setup, origin = about.setup_of(image), about.setup_origin_of(image)
    if setup is None:
        return "with the setup below"
    return f"with its own setup ({setup.probe}{f', {origin}' if origin else ''})"
