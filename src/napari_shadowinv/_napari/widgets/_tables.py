"""Tables with a row for each image: `NumberTable`, `ImageTable`."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from qtpy.QtCore import QSignalBlocker, Qt, Signal
from qtpy.QtGui import QColor
from qtpy.QtWidgets import QHeaderView, QSizePolicy, QTableWidget, QTableWidgetItem, QWidget

from napari_shadowinv._napari import layer_metadata as about
from napari_shadowinv._napari.widgets._editors import format_number, parse_number, unit_of_title
from napari_shadowinv._napari.widgets._forms import PROBLEM_STYLE, labelled
from napari_shadowinv._napari.widgets._layers import LayerPicker, image_of, kind_of, stack_of
from napari_shadowinv._napari.widgets._qt import column, while_alive
from napari_shadowinv.errors import InputError
from napari_shadowinv.physics.setup import SETUPS, Setup

_MAX_SHOWN_ROWS = 8
_PROBLEM_COLOUR = QColor(PROBLEM_STYLE.removeprefix("color: ").removesuffix(";"))


class NumberTable(QTableWidget):
    """A row for each image; its first cell holds the name and whether it is used."""

    def __init__(self, columns: int, widths: Mapping[int, int]) -> None:
        super().__init__(0, columns)
        self.verticalHeader().setVisible(False)
        self.setSelectionMode(QTableWidget.SelectionMode.NoSelection)
        self.setTextElideMode(Qt.TextElideMode.ElideMiddle)
        self.setHorizontalScrollBarPolicy(Qt.ScrollBarPolicy.ScrollBarAlwaysOff)
        header = self.horizontalHeader()
        header.setSectionResizeMode(0, QHeaderView.ResizeMode.Stretch)
        for number, width in widths.items():
            header.setSectionResizeMode(number, QHeaderView.ResizeMode.Fixed)
            header.resizeSection(number, width)

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

    def number(self, row: int, column: int, unit: str) -> float | None:
        """Return the number in a cell, None if it is empty; or raise an `InputError`."""
        item = self.item(row, column)
        exact, text = item.data(Qt.ItemDataRole.UserRole), item.text().strip()
        if exact is not None:
            return float(exact)
        return parse_number(text, unit) if text else None

    def write(self, row: int, column: int, value: Any, unit: str, tip: str) -> None:
        """Show a number, or text that the user has to correct."""
        item = self.item(row, column)
        is_number = not isinstance(value, str) and value is not None
        # The shown text is rounded.
        item.setData(Qt.ItemDataRole.UserRole, value if is_number else None)
        if not is_number:
            item.setText(value or "")
        else:
            item.setText(format_number(value, unit) if unit not in ("", "MeV") else f"{value:.6g}")
        self._check(item, unit, tip)

    def _check(self, item: QTableWidgetItem, unit: str, tip: str) -> None:
        """Mark an invalid number by its colour and tooltip."""
        try:
            parse_number(item.text() or "0", unit)
        except InputError as error:
            item.setForeground(_PROBLEM_COLOUR)
            item.setToolTip(f"<qt>{error}</qt>")
        else:
            item.setData(Qt.ItemDataRole.ForegroundRole, None)
            item.setToolTip(f"<qt>{tip}</qt>")


_METADATA_KEY = "fit"  # entries of the rows in a layer's metadata
_NAME, _BEAM, _BRIGHTNESS, _PSF = range(4)
_COLUMNS = {_BRIGHTNESS: ("brightness", "Brightness", 1.0), _PSF: ("psf", "PSF σ (px)", 0.0)}
_WIDTHS = {_BEAM: 90, _BRIGHTNESS: 76, _PSF: 72}
_BEAM_FIELDS = {"proton": "energy", "optical": "wavelength"}


@dataclass(frozen=True)
class BeamColumn:
    """The column with the quantity that differs between the images' beams."""

    name: str
    title: str
    unit: str
    tip: str


def beam_column(kind: str) -> BeamColumn:
    """Return the column for a kind of setup; without a setup, the relative displacement."""
    if kind not in _BEAM_FIELDS:
        tip = "Displacement in this image relative to the first image, such as 0.6."
        return BeamColumn("strength", "Strength", "", tip)
    name = _BEAM_FIELDS[kind]
    field = SETUPS[kind].model_fields[name]
    title, unit = unit_of_title(field.title or name)
    last_word = title.split()[-1].capitalize()
    return BeamColumn(name, last_word, unit, str(field.description))


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
        self._reference: ImageRow | None = None
        self.beam = beam_column("")
        self.rows: list[ImageRow] = []
        self.stacks = LayerPicker(
            viewer,
            ("image",),
            "<qt>All 2-D image layers, or the planes of a stack.</qt>",
            "2-D image layers",
            lambda layer: layer.ndim == 3 and suits(layer),
        )
        self.table = NumberTable(4, _WIDTHS)
        self.setSizePolicy(QSizePolicy.Policy.Preferred, QSizePolicy.Policy.Maximum)
        column(self, labelled("Images", self.stacks), self.table)
        self.stacks.picked.connect(self.fill)
        self.table.itemChanged.connect(self._on_edit)
        for emitter in (viewer.layers.events.removed, viewer.layers.events.reordered):
            while_alive(self, emitter, self.fill)
        while_alive(self, viewer.layers.events.inserted, self._on_insertion)
        for layer in viewer.layers:
            while_alive(self, layer.events.name, self.fill)
        self.fill()

    @property
    def used(self) -> list[ImageRow]:
        """The checked rows, the reference first."""
        return [row for number, row in enumerate(self.rows) if self.table.is_checked(number)]

    @property
    def reference(self) -> ImageRow | None:
        """The first image in use, whose pixels and units the fields have."""
        return self._reference

    def fill(self, event: Any = None) -> None:
        """Show the viewer's current images."""
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
        reference = self._reference
        if reference is not None and reference.plane is not None and isinstance(value, float):
            reference.store(**{self.beam.name: value})  # the planes of a stack share a setup
        with QSignalBlocker(self.table):
            titles = ["Image", self.beam.title, *(title for _, title, _ in _COLUMNS.values())]
            unit = f" ({self.beam.unit})" if self.beam.unit == "MeV" else ""
            titles[_BEAM] = f"{self.beam.title}{unit}"
            self.table.setHorizontalHeaderLabels(titles)
            for number, row in enumerate(self.rows):
                is_reference = row == self._reference
                beam = value if is_reference and kind in _BEAM_FIELDS else self._beam_of(row)
                if is_reference and kind not in _BEAM_FIELDS:
                    beam = 1.0
                self.table.write(number, _BEAM, beam, self.beam.unit, self.beam.tip)
                for column, (name, _, default) in _COLUMNS.items():
                    entry = row.entries().get(name, default)
                    self.table.write(number, column, entry, "", _TIPS[name])
                cell = self.table.item(number, _BRIGHTNESS)
                editable = Qt.ItemFlag.ItemIsEnabled | Qt.ItemFlag.ItemIsEditable
                cell.setFlags(editable if is_brightness_known else Qt.ItemFlag.NoItemFlags)
                if not is_brightness_known:
                    cell.setText("free")

    def beam_value(self, row: ImageRow) -> float:
        """Return energy, wavelength or strength of a row, or raise an `InputError`."""
        value = self._value(row, _BEAM, self.beam.unit)
        if value is None:
            quantity = self.beam.title.lower()
            raise InputError(
                f"'{row.name}' has no {quantity}: enter it in the table, or uncheck the image"
            )
        return value

    def brightness(self, row: ImageRow) -> float:
        value = self._value(row, _BRIGHTNESS, "")
        return 1.0 if value is None else value

    def psf(self, row: ImageRow) -> float:
        return self._value(row, _PSF, "px") or 0.0

    def _value(self, row: ImageRow, column: int, unit: str) -> float | None:
        try:
            return self.table.number(self.rows.index(row), column, unit)
        except InputError as error:
            raise InputError(f"'{row.name}': {error}") from error

    def _beam_of(self, row: ImageRow) -> Any:
        """Return the user's entry, or else the value in the layer's setup."""
        entry = row.entries().get(self.beam.name)
        if entry is not None or row.plane is not None:
            return entry
        if self.beam.name == "strength" and self._reference is not None:
            own_strength, first_strength = (
                about.metadata_of(image.layer).get("strength") for image in (row, self._reference)
            )
            return own_strength / first_strength if own_strength and first_strength else None
        return getattr(row.setup, self.beam.name, None)

    def _on_edit(self, item: Any) -> None:
        row, column = self.rows[item.row()], item.column()
        if column == _NAME:
            row.store(use=self.table.is_checked(item.row()))
            self._on_use()
            return
        name = self.beam.name if column == _BEAM else _COLUMNS[column][0]
        unit = self.beam.unit if column == _BEAM else ""
        text = item.text().strip()
        try:
            value: Any = parse_number(text, unit) if text else None
        except InputError:
            value = text  # stays for correction
        is_beam = column == _BEAM
        is_number = isinstance(value, float)
        if is_beam and row == self._reference and is_number and name != "strength":
            self.reference_beam_entered.emit(value)
        else:
            row.store(**{name: value})
        with QSignalBlocker(self.table):
            tip = self.beam.tip if is_beam else _TIPS[name]
            self.table.write(item.row(), column, value, unit, tip)
        self.changed.emit()

    def _on_use(self) -> None:
        used = self.used
        old_reference = self._reference
        self._reference = used[0] if used else None
        if self._reference != old_reference:
            self.reference_changed.emit()
        self.changed.emit()

    def _on_insertion(self, event: Any) -> None:
        while_alive(self, event.value.events.name, self.fill)
        self.fill()

    def _is_image(self, layer: Any) -> bool:
        is_grey = kind_of(layer) == "image" and not getattr(layer, "rgb", False)
        return is_grey and layer.ndim == 2 and self._suits(layer)


def _setup_summary(row: ImageRow) -> str:
    """Return the origin of an image's setup, for the tooltip."""
    if row.setup is None or row.plane is not None:
        return "with the setup below"
    origin = about.setup_origin_of(row.layer)
    return f"with its own setup ({row.setup.probe}{f', {origin}' if origin else ''})"


_TIPS = {
    "brightness": "Brightness of the image relative to the source; 1 if they are equally bright.",
    "psf": "Standard deviation of the image's blur, in pixels after the steps; 0 without blur.",
}
