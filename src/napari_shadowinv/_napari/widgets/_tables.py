"""Tables with a check box and entries in each row: `NumberTable`.

- a row for each image of a fit: `ImageTable`; for each shot of a stack: `ShotTable`
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from qtpy.QtCore import QSignalBlocker, Qt, Signal
from qtpy.QtWidgets import (
    QHeaderView,
    QSizePolicy,
    QTableWidget,
    QTableWidgetItem,
    QWidget,
)

from napari_shadowinv._napari import layer_metadata as about
from napari_shadowinv._napari.form import PROBLEM_COLOUR, PathEdit, SteadyComboBox, labelled
from napari_shadowinv._napari.widgets import _qt as qt
from napari_shadowinv._napari.widgets._layers import LayerPicker, image_of, kind_of, stack_of
from napari_shadowinv._system.validation import validate
from napari_shadowinv.errors import InputError
from napari_shadowinv.physics.beam import BeamQuantity, number_in_unit, text_in_unit
from napari_shadowinv.physics.setup import SETUPS, Setup, beam_quantities
from napari_shadowinv.pipeline.shot_table import ShotRow, table_rows, write_table

_PREFIXED_UNIT = "m"  # cells show it, with the prefix of each number


@dataclass(frozen=True)
class Column:
    """A column of numbers in a unit, or of texts if the unit is None, perhaps from a list."""

    name: str
    title: str
    unit: str | None
    tip: str
    width_px: int = 90
    default: float | None = None
    choices: tuple[str, ...] = ()

    @property
    def heading(self) -> str:
        unit = "" if self.unit == _PREFIXED_UNIT else self.unit
        return f"{self.title} ({unit})" if unit else self.title

    def read(self, text: str) -> Any:
        """Return a number, None for nothing, or text that is no number."""
        if not text or self.unit is None:
            return text or None
        with suppress(ValueError):  # the text stays for correction
            return number_in_unit(text, self.unit)
        return text

    def show(self, value: Any) -> str:
        """Return the text of a value, rounded."""
        if value is None or isinstance(value, str):
            return value or ""
        return text_in_unit(value, "m") if self.unit == _PREFIXED_UNIT else f"{value:.6g}"

    def problem(self, value: Any) -> str:
        """Return what is wrong with a value, in a sentence; empty for a number."""
        if self.unit is None or not isinstance(value, str):
            return ""
        try:
            number_in_unit(value, self.unit)
        except ValueError as error:
            return f"received {value!r}, {error}"
        return ""


class NumberTable(QTableWidget):
    """Rows with a name and a check box first; more than `max_rows` of them scroll."""

    def __init__(self, title: str, columns: Sequence[Column], max_rows: int = 8) -> None:
        super().__init__(0, len(columns) + 1)
        self._title, self._max_rows = title, max_rows
        self.verticalHeader().setVisible(False)
        self.setSelectionMode(QTableWidget.SelectionMode.NoSelection)
        self.setTextElideMode(Qt.TextElideMode.ElideMiddle)
        self.setHorizontalScrollBarPolicy(Qt.ScrollBarPolicy.ScrollBarAlwaysOff)
        header = self.horizontalHeader()
        header.setSectionResizeMode(0, QHeaderView.ResizeMode.Stretch)
        for number, spec in enumerate(columns, 1):
            header.setSectionResizeMode(number, QHeaderView.ResizeMode.Fixed)
            header.resizeSection(number, spec.width_px)
        self.set_columns(columns)

    def set_columns(self, columns: Sequence[Column]) -> None:
        """Replace the columns after the names by as many others."""
        self._columns = tuple(columns)
        self.setHorizontalHeaderLabels([self._title, *(spec.heading for spec in columns)])

    def fill_row(self, row: int, name: str, tip: str, *, checked: bool) -> None:
        """Create the cells of a row, empty except the first."""
        item = QTableWidgetItem(name)
        item.setFlags(Qt.ItemFlag.ItemIsEnabled | Qt.ItemFlag.ItemIsUserCheckable)
        item.setToolTip(f"<qt>{tip}</qt>")
        self.setItem(row, 0, item)
        self.check(row, checked)
        for number, spec in enumerate(self._columns, 1):
            self.setItem(row, number, QTableWidgetItem())
            if spec.choices:
                box = SteadyComboBox({each: each for each in ("", *spec.choices)}, spec.tip)
                box.currentTextChanged.connect(self.item(row, number).setText)
                self.setCellWidget(row, number, box)

    def fit_height(self) -> None:
        """Fit the height to the rows, up to a maximum."""
        rows = sum(self.rowHeight(row) for row in range(min(self.rowCount(), self._max_rows)))
        header = self.horizontalHeader()
        header.setFixedHeight(header.sizeHint().height())
        self.setFixedHeight(header.height() + rows + 2 * self.frameWidth())

    def showEvent(self, event: Any) -> None:
        super().showEvent(event)
        self.fit_height()  # the rows get the heights of napari's style only now

    def is_checked(self, row: int) -> bool:
        return bool(self.item(row, 0).checkState() == Qt.CheckState.Checked)

    def check(self, row: int, on: bool) -> None:
        self.item(row, 0).setCheckState(Qt.CheckState.Checked if on else Qt.CheckState.Unchecked)

    def values(self, row: int) -> dict[str, Any]:
        """Return the values of a row by column, None where empty; or raise an `InputError`."""
        values = {}
        for number, spec in enumerate(self._columns, 1):
            values[spec.name] = self.item(row, number).data(Qt.ItemDataRole.UserRole)
            if problem := spec.problem(values[spec.name]):
                raise InputError(f"'{self.item(row, 0).text()}': {problem}")
        return values

    def write_row(self, row: int, values: Mapping[str, Any]) -> None:
        """Show the values of a row by column, and the defaults of others."""
        for number, spec in enumerate(self._columns, 1):
            self._write(row, number, values.get(spec.name, spec.default))

    def enter(self, item: QTableWidgetItem) -> tuple[str, Any]:
        """Return the column of a cell, and the user's entry: a number, None, or text."""
        spec = self._columns[item.column() - 1]
        value = spec.read(item.text().strip())
        self._write(item.row(), item.column(), value)
        return spec.name, value

    def _write(self, row: int, column: int, value: Any) -> None:
        """Show a number or a text, which the user has to correct if it is no number."""
        item, spec = self.item(row, column), self._columns[column - 1]
        problem = spec.problem(value)
        with QSignalBlocker(self):
            # The shown text is rounded.
            item.setData(Qt.ItemDataRole.UserRole, value)
            item.setText(spec.show(value))
            if spec.choices:
                self.cellWidget(row, column).setCurrentText(spec.show(value))
            item.setData(Qt.ItemDataRole.ForegroundRole, PROBLEM_COLOUR if problem else None)
            item.setToolTip(f"<qt>{problem or spec.tip}</qt>")


_METADATA_KEY = "fit"  # entries of the rows in a layer's metadata
_BRIGHTNESS = 2  # column


def _column(name: str, title: str, unit: str | None, default: float | None = None) -> Column:
    """Return the column of a field of a row of shots."""
    tip = str(ShotRow.model_fields[name].description)
    return Column(name, title, unit, tip, _WIDTHS_PX[name], default)


_WIDTHS_PX = {"brightness": 76, "psf": 72, "mask": 90}
_IMAGE_COLUMNS = (
    _column("brightness", "Brightness", "", 1.0),
    _column("psf", "PSF σ", "px", 0.0),
)
_SHOT_COLUMNS = (_column("brightness", "Brightness", ""), _column("mask", "Mask", None))


def beam_column(kind: str) -> Column:
    """Return the column for a kind of setup; without a setup, the relative displacement."""
    if kind not in SETUPS:
        tip = "Displacement in this image relative to the first image, such as 0.6."
        return Column("strength", "Strength", "", tip)
    quantity = SETUPS[kind].beam_quantity()
    return _quantity_column(quantity, quantity.description)


def _quantity_column(quantity: BeamQuantity, tip: str) -> Column:
    return Column(quantity.name, quantity.noun.capitalize(), quantity.unit, tip)


@dataclass(frozen=True)
class ImageRow:
    """One image: a 2-D layer, or a plane of a stack."""

    layer: Any
    plane: int | None = None

    @property
    def name(self) -> str:
        return str(self.layer.name) if self.plane is None else f"{self.layer.name} {self.plane}"

    @property
    def data(self) -> Any:
        """The pixels, lazy if the layer is; or an `InputError`."""
        if self.plane is None:
            return image_of(self.layer)
        return stack_of(self.layer)[self.plane]

    @property
    def setup(self) -> Setup | None:
        return about.setup_of(self.layer)

    def entries(self) -> dict[str, Any]:
        """Return the entries of the user in this row."""
        rows = about.metadata_of(self.layer).get(_METADATA_KEY, {})
        return dict(rows.get(self.plane or 0, {}))

    def store(self, **values: Any) -> None:
        # New dicts: a duplicate of the layer may share the old ones.
        metadata = about.metadata_of(self.layer)
        rows = {**metadata.get(_METADATA_KEY, {}), self.plane or 0: {**self.entries(), **values}}
        self.layer.metadata[about.KEY] = {**metadata, _METADATA_KEY: rows}


class ImageTable(QWidget):
    """The 2-D images of a viewer, or the planes of a stack; the first in use is the reference."""

    changed = Signal()  # an entry or the selection
    reference_changed = Signal()
    reference_beam_entered = Signal(float)  # energy or wavelength of the reference

    def __init__(self, viewer: Any, suits: Callable[[Any], bool]) -> None:
        super().__init__()
        self._viewer, self._suits = viewer, suits
        # The first image in use, whose pixels and units the fields have.
        self.reference: ImageRow | None = None
        self.beam = beam_column("")
        self.rows: list[ImageRow] = []
        self.stacks = LayerPicker(
            viewer,
            "<qt>All 2-D image layers, or the planes of a stack.</qt>",
            "2-D image layers",
            lambda layer: layer.ndim == 3 and suits(layer),
        )
        self.table = NumberTable("Image", (self.beam, *_IMAGE_COLUMNS))
        self.setSizePolicy(QSizePolicy.Policy.Preferred, QSizePolicy.Policy.Maximum)
        qt.column(self, labelled("Images", self.stacks), self.table)
        self.stacks.picked.connect(self.fill)
        self.table.itemChanged.connect(self._on_edit)
        qt.while_alive(self, viewer.layers, ("inserted", "removed", "reordered"), self.fill)
        qt.layers_while_alive(self, viewer.layers, "name", self.fill)
        self.fill()

    @property
    def used(self) -> list[ImageRow]:
        """The checked rows, the reference first."""
        return [row for number, row in enumerate(self.rows) if self.table.is_checked(number)]

    def fill(self, _: Any = None) -> None:
        stack = self.stacks.layer
        if stack is not None:
            self.rows = [ImageRow(stack, plane) for plane in range(stack.data.shape[0])]
        else:
            self.rows = [ImageRow(layer) for layer in self._viewer.layers if self._is_image(layer)]
        shapes = Counter(row.layer.data.shape for row in self.rows)
        common_shape = max(shapes, key=lambda shape: shapes[shape], default=None)
        with QSignalBlocker(self.table):
            self.table.setRowCount(len(self.rows))
            for number, row in enumerate(self.rows):
                use = row.entries().get("use", row.layer.data.shape == common_shape)
                tip = f"{row.name}: {_setup_summary(row)}."
                self.table.fill_row(number, row.name, tip, checked=use)
        self.table.fit_height()
        self._on_use()

    def showEvent(self, event: Any) -> None:
        super().showEvent(event)
        self.fill()  # another widget may have changed a layer's setup

    def show_beams(self, kind: str, value: Any, is_brightness_known: bool) -> None:
        """Fill the cells; `value` is the reference's energy or wavelength in the shown setup."""
        self.beam = beam_column(kind)
        reference = self.reference
        if reference is not None and reference.plane is not None and isinstance(value, float):
            reference.store(**{self.beam.name: value})  # the planes of a stack share a setup
        self.table.set_columns((self.beam, *_IMAGE_COLUMNS))
        editable = Qt.ItemFlag.ItemIsEnabled | Qt.ItemFlag.ItemIsEditable
        reference_beam = value if kind in SETUPS else 1.0
        for number, row in enumerate(self.rows):
            beam = reference_beam if row == reference else self._beam_of(row)
            self.table.write_row(number, {**row.entries(), self.beam.name: beam})
            with QSignalBlocker(self.table):
                brightness = self.table.item(number, _BRIGHTNESS)
                brightness.setFlags(editable if is_brightness_known else Qt.ItemFlag.NoItemFlags)
                if not is_brightness_known:
                    brightness.setText("free")

    def beam_value(self, row: ImageRow) -> float:
        """Return energy, wavelength or strength of a row, or raise an `InputError`."""
        value = self._values(row)[self.beam.name]
        if value is None:
            quantity = self.beam.title.lower()
            raise InputError(
                f"'{row.name}' has no {quantity}: enter it in the table, or uncheck the image"
            )
        return float(value)

    def brightness(self, row: ImageRow) -> float:
        value = self._values(row)["brightness"]
        return 1.0 if value is None else float(value)

    def psf(self, row: ImageRow) -> float:
        return self._values(row)["psf"] or 0.0

    def _values(self, row: ImageRow) -> dict[str, Any]:
        return self.table.values(self.rows.index(row))

    def _beam_of(self, row: ImageRow) -> Any:
        """Return the user's entry, or else the value in the layer's setup."""
        entry = row.entries().get(self.beam.name)
        if entry is not None or row.plane is not None:
            return entry
        if self.beam.name == "strength" and self.reference is not None:
            own_strength, first_strength = (
                about.metadata_of(image.layer).get("strength") for image in (row, self.reference)
            )
            return own_strength / first_strength if own_strength and first_strength else None
        return getattr(row.setup, self.beam.name, None)

    def _on_edit(self, item: Any) -> None:
        row = self.rows[item.row()]
        if item.column() == 0:
            row.store(use=self.table.is_checked(item.row()))
            self._on_use()
            return
        name, value = self.table.enter(item)
        is_setup = name == self.beam.name != "strength" and row == self.reference
        if is_setup and isinstance(value, float):
            self.reference_beam_entered.emit(value)
        else:
            row.store(**{name: value})
        self.changed.emit()

    def _on_use(self) -> None:
        used = self.used
        old_reference = self.reference
        self.reference = used[0] if used else None
        if self.reference != old_reference:
            self.reference_changed.emit()
        self.changed.emit()

    def _is_image(self, layer: Any) -> bool:
        is_grey = kind_of(layer) == "image" and not getattr(layer, "rgb", False)
        return is_grey and layer.ndim == 2 and self._suits(layer)


def _setup_summary(row: ImageRow) -> str:
    """Return the origin of an image's setup, for the tooltip."""
    if row.setup is None or row.plane is not None:
        return "with the setup below"
    origin = about.setup_origin_of(row.layer)
    return f"with its own setup ({row.setup.probe}{f', {origin}' if origin else ''})"


class ShotTable(QWidget):
    """The rows of a table of shots; changes are written to the file only by Save."""

    changed = Signal()

    def __init__(self) -> None:
        super().__init__()
        self._rows: list[ShotRow] = []
        self._loaded = ""
        self.file = PathEdit(
            "Table of the shots",
            "shots.csv",
            "A table (.csv) with a row for each shot and the columns file, setup, energy or "
            "wavelength, brightness, mask, source, exclude.",
            qt.TABLES,
        )
        self.save_button = qt.small_button("Save…", "Save the rows as a table (.csv).", self._save)
        self._kind = "proton"
        self.table = NumberTable("Shot", self._columns)
        self.setSizePolicy(QSizePolicy.Policy.Preferred, QSizePolicy.Policy.Maximum)
        file = qt.side_by_side((self.file, 1), (self.save_button, 0))
        qt.column(self, labelled("", file), self.table)
        self.file.changed.connect(self._load)
        self.table.itemChanged.connect(self._on_edit)
        self._fill()

    def shots(self) -> list[ShotRow]:
        """Return the shown rows, unchecked ones as excluded; or raise an `InputError`."""
        if self.file.path != self._loaded:
            self._read()
        if not self._rows:
            raise InputError(
                "no table is selected: choose a .csv file with a row for each shot, with the "
                "columns file and energy or wavelength"
            )
        return [self._row(number) for number in range(len(self._rows))]

    def show_kind(self, kind: str) -> None:
        """Show the column for the beams of a kind of setup, unless the table has another."""
        if kind not in SETUPS or kind == self._kind:
            return
        try:
            rows = [self._row(number) for number in range(len(self._rows))]
        except InputError:
            return  # entries stay for correction
        self._kind, self._rows = kind, rows
        self._fill()

    @property
    def _columns(self) -> tuple[Column, ...]:
        names = [name for row in self._rows for name in row.beam]
        quantity = beam_quantities()[[*names, SETUPS[self._kind].beam_field][0]]
        tip = f"{quantity.long_name}; empty for the setup's {quantity.noun}."
        return (_quantity_column(quantity, tip), *_SHOT_COLUMNS)

    def _row(self, number: int) -> ShotRow:
        row = self._rows[number]
        changes = {"exclude": not self.table.is_checked(number), **self.table.values(number)}
        mask = changes.pop("mask")
        if not mask or row.mask is None or mask != row.mask.name:
            changes["mask"] = self._folder / mask if mask else None
        entries = row.model_dump(exclude={"strength"})  # tables have another form of it
        names = {spec.name: f"'{spec.title}'" for spec in self._columns}
        edited = validate(ShotRow, {**entries, **changes}, f"'{row.file.name}'", names)
        return edited.model_copy(update={"strength": row.strength})

    @property
    def _folder(self) -> Path:
        return Path(self._loaded).expanduser().parent

    @qt.notify_errors
    def _load(self) -> None:
        if self.file.path != self._loaded:
            self._read()
            self.changed.emit()

    def _read(self) -> None:
        self._rows, self._loaded = [], self.file.path
        try:
            if self._loaded:
                self._rows = table_rows(Path(self._loaded).expanduser())
        finally:
            self._fill()

    def _fill(self) -> None:
        self.table.set_columns(self._columns)
        with QSignalBlocker(self.table):
            self.table.setRowCount(len(self._rows))
            for number, row in enumerate(self._rows):
                mask = None if row.mask is None else row.mask.name
                values = {"brightness": row.brightness, "mask": mask, **row.beam}
                self.table.fill_row(number, row.file.name, _tip(row), checked=not row.exclude)
                self.table.write_row(number, values)
        self.table.setVisible(bool(self._rows))
        self.save_button.setEnabled(bool(self._rows))
        self.table.fit_height()

    def _on_edit(self, item: Any) -> None:
        if item.column():
            self.table.enter(item)
        self.changed.emit()

    @qt.notify_errors
    def _save(self) -> None:
        rows = self.shots()
        if path := qt.ask_file(self, "Save the table", self._loaded or "shots.csv", qt.TABLES):
            write_table(path, rows)


def _tip(row: ShotRow) -> str:
    """Return a row's file and its entries without a cell."""
    files = {"setup": row.setup, "source": row.source}
    entries = [f"with its own {name} ({file})" for name, file in files.items() if file is not None]
    return f"{', '.join([str(row.file), *entries])}. Uncheck the shot to exclude it."
