"""Tables with a row for each image: `ImageTable` of a fit, `ShotTable` of a stack."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from qtpy.QtCore import QSignalBlocker, Qt, Signal
from qtpy.QtWidgets import (
    QFileDialog,
    QHeaderView,
    QSizePolicy,
    QTableWidget,
    QTableWidgetItem,
    QWidget,
)

from napari_shadowinv._napari import layer_metadata as about
from napari_shadowinv._napari.form import PROBLEM_COLOUR, PathEdit, labelled
from napari_shadowinv._napari.widgets import _qt as qt
from napari_shadowinv._napari.widgets._layers import LayerPicker, image_of, kind_of, stack_of
from napari_shadowinv._system.validation import validate
from napari_shadowinv.errors import InputError
from napari_shadowinv.io.formats import SITES
from napari_shadowinv.physics.beam import BeamQuantity, number_in_unit, text_in_unit
from napari_shadowinv.physics.setup import SETUPS, Setup, beam_quantities
from napari_shadowinv.pipeline.shot_table import ShotRow, table_rows, write_table

_MAX_SHOWN_ROWS = 8
_PREFIXED_UNIT = "m"  # cells show it, with the prefix of each number


@dataclass(frozen=True)
class Column:
    """A column of numbers in a unit, or of names of files if the unit is None."""

    name: str
    title: str
    unit: str | None
    tip: str
    width_px: int
    default: float | None = None

    @property
    def heading(self) -> str:
        unit = "" if self.unit == _PREFIXED_UNIT else self.unit
        return f"{self.title} ({unit})" if unit else self.title


class NumberTable(QTableWidget):
    """A row for each image; its first cell holds the name and whether it is used."""

    def __init__(self, title: str, columns: Sequence[Column]) -> None:
        super().__init__(0, len(columns) + 1)
        self._title = title
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
        item.setCheckState(Qt.CheckState.Checked if checked else Qt.CheckState.Unchecked)
        item.setToolTip(f"<qt>{tip}</qt>")
        self.setItem(row, 0, item)
        for number in range(1, self.columnCount()):
            self.setItem(row, number, QTableWidgetItem())

    def fit_height(self) -> None:
        """Fit the height to the rows, up to a maximum."""
        rows = sum(self.rowHeight(row) for row in range(min(self.rowCount(), _MAX_SHOWN_ROWS)))
        header = self.horizontalHeader()
        header.setFixedHeight(header.sizeHint().height())
        self.setFixedHeight(header.height() + rows + 2 * self.frameWidth())

    def is_checked(self, row: int) -> bool:
        return bool(self.item(row, 0).checkState() == Qt.CheckState.Checked)

    def number(self, row: int, column: int) -> float | None:
        """Return the number in a cell, None if it is empty; or raise an `InputError`."""
        item = self.item(row, column)
        exact, text = item.data(Qt.ItemDataRole.UserRole), item.text().strip()
        if exact is not None or not text:
            return None if exact is None else float(exact)
        try:
            return number_in_unit(text, self._columns[column - 1].unit or "")
        except ValueError as error:
            name = self.item(row, 0).text()
            raise InputError(f"'{name}': received {text!r}, {error}") from error

    def write(self, row: int, column: int, value: Any) -> None:
        """Show a number, a file's name, or text that the user has to correct."""
        item, spec = self.item(row, column), self._columns[column - 1]
        is_number = not isinstance(value, str) and value is not None
        with QSignalBlocker(self):
            # The shown text is rounded.
            item.setData(Qt.ItemDataRole.UserRole, value if is_number else None)
            if not is_number:
                item.setText(value or "")
            elif spec.unit == _PREFIXED_UNIT:
                item.setText(text_in_unit(value, spec.unit))
            else:
                item.setText(f"{value:.6g}")
            self._mark(item, spec)

    def enter(self, item: QTableWidgetItem) -> Any:
        """Return the user's entry in a cell: a number, None, or text that is no number."""
        value: Any = item.text().strip() or None
        unit = self._columns[item.column() - 1].unit
        if value is not None and unit is not None:
            with suppress(ValueError):  # the text stays for correction
                value = number_in_unit(value, unit)
        self.write(item.row(), item.column(), value)
        return value

    def _mark(self, item: QTableWidgetItem, spec: Column) -> None:
        """Mark an invalid number by its colour and tooltip."""
        item.setData(Qt.ItemDataRole.ForegroundRole, None)
        item.setToolTip(f"<qt>{spec.tip}</qt>")
        if spec.unit is None:
            return
        try:
            number_in_unit(item.text() or "0", spec.unit)
        except ValueError as error:
            item.setForeground(PROBLEM_COLOUR)
            item.setToolTip(f"<qt>{error}</qt>")


_METADATA_KEY = "fit"  # entries of the rows in a layer's metadata
_NAME, _BEAM, _BRIGHTNESS, _PSF = range(4)
_BEAM_WIDTH_PX = 90
_IMAGE_COLUMNS = (
    Column(
        "brightness",
        "Brightness",
        "",
        "Brightness of the image relative to the source; 1 if they are equally bright.",
        76,
        1.0,
    ),
    Column(
        "psf",
        "PSF σ",
        "px",
        "Standard deviation of the image's blur, in pixels after the steps; 0 without blur.",
        72,
        0.0,
    ),
)


def beam_column(kind: str) -> Column:
    """Return the column for a kind of setup; without a setup, the relative displacement."""
    if kind not in SETUPS:
        tip = "Displacement in this image relative to the first image, such as 0.6."
        return Column("strength", "Strength", "", tip, _BEAM_WIDTH_PX)
    quantity = SETUPS[kind].beam_quantity()
    return _quantity_column(quantity, quantity.description)


def _quantity_column(quantity: BeamQuantity, tip: str) -> Column:
    return Column(quantity.name, quantity.noun.capitalize(), quantity.unit, tip, _BEAM_WIDTH_PX)


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
        # The rows get the heights of napari's style only now, and another widget may have changed
        # a layer's setup.
        self.fill()

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
            self.table.write(number, _BEAM, beam)
            for cell, spec in enumerate(_IMAGE_COLUMNS, _BRIGHTNESS):
                self.table.write(number, cell, row.entries().get(spec.name, spec.default))
            with QSignalBlocker(self.table):
                brightness = self.table.item(number, _BRIGHTNESS)
                brightness.setFlags(editable if is_brightness_known else Qt.ItemFlag.NoItemFlags)
                if not is_brightness_known:
                    brightness.setText("free")

    def beam_value(self, row: ImageRow) -> float:
        """Return energy, wavelength or strength of a row, or raise an `InputError`."""
        value = self._number(row, _BEAM)
        if value is None:
            quantity = self.beam.title.lower()
            raise InputError(
                f"'{row.name}' has no {quantity}: enter it in the table, or uncheck the image"
            )
        return value

    def brightness(self, row: ImageRow) -> float:
        value = self._number(row, _BRIGHTNESS)
        return 1.0 if value is None else value

    def psf(self, row: ImageRow) -> float:
        return self._number(row, _PSF) or 0.0

    def _number(self, row: ImageRow, column: int) -> float | None:
        return self.table.number(self.rows.index(row), column)

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
        row, column = self.rows[item.row()], item.column()
        if column == _NAME:
            row.store(use=self.table.is_checked(item.row()))
            self._on_use()
            return
        name = self.beam.name if column == _BEAM else _IMAGE_COLUMNS[column - _BRIGHTNESS].name
        value = self.table.enter(item)
        is_setup = column == _BEAM and name != "strength" and row == self.reference
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


_SHOT_COLUMNS = (
    Column(
        "brightness",
        "Brightness",
        "",
        "Brightness of the image relative to the source, by which it is divided; empty for 1.",
        76,
    ),
    Column(
        "mask",
        "Mask",
        None,
        "Image of the same size, 0 at unusable pixels, with a path relative to the table; empty "
        "for the common mask.",
        90,
    ),
)
_MASK = 1 + len(_SHOT_COLUMNS)
_FILE_FILTER = "tables (*.csv)"


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
            _FILE_FILTER,
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
        changes: dict[str, Any] = {"exclude": not self.table.is_checked(number)}
        for cell, spec in enumerate(self._columns[:-1], 1):
            changes[spec.name] = self.table.number(number, cell)
        mask = self.table.item(number, _MASK).text().strip()
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
        columns = self._columns
        self.table.set_columns(columns)
        with QSignalBlocker(self.table):
            self.table.setRowCount(len(self._rows))
            for number, row in enumerate(self._rows):
                values = {"brightness": row.brightness, **row.beam}
                self.table.fill_row(number, row.file.name, _tip(row), checked=not row.exclude)
                for cell, spec in enumerate(columns[:-1], 1):
                    self.table.write(number, cell, values.get(spec.name))
                self.table.write(number, _MASK, "" if row.mask is None else row.mask.name)
        self.table.setVisible(bool(self._rows))
        self.save_button.setEnabled(bool(self._rows))
        self.table.fit_height()

    def showEvent(self, event: Any) -> None:
        super().showEvent(event)
        # The rows get the heights of napari's style only now.
        self.table.fit_height()

    def _on_edit(self, item: Any) -> None:
        if item.column():
            self.table.enter(item)
        self.changed.emit()

    @qt.notify_errors
    def _save(self) -> None:
        rows = self.shots()
        path, _ = QFileDialog.getSaveFileName(
            self, "Save the table", self._loaded or "shots.csv", _FILE_FILTER
        )
        if path:
            target = Path(path)
            write_table(target if target.suffix else target.with_suffix(SITES.suffix), rows)


def _tip(row: ShotRow) -> str:
    """Return a row's file and its entries without a cell."""
    files = {"setup": row.setup, "source": row.source}
    entries = [f"with its own {name} ({file})" for name, file in files.items() if file is not None]
    return f"{', '.join([str(row.file), *entries])}. Uncheck the shot to exclude it."
