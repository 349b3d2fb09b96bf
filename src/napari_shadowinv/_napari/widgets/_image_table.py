"""The images of a fit, each with a check box and its numbers: `ImageTable`."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

from qtpy.QtCore import QSignalBlocker, Qt, Signal
from qtpy.QtWidgets import QHeaderView, QSizePolicy, QTableWidget, QTableWidgetItem

from napari_shadowinv._napari import layer_metadata as about
from napari_shadowinv._napari.form import PROBLEM_COLOUR
from napari_shadowinv._napari.layer_metadata import kind_of
from napari_shadowinv._napari.widgets import _qt as qt
from napari_shadowinv.errors import InputError
from napari_shadowinv.physics.beam import number_in_unit, text_in_unit
from napari_shadowinv.physics.setup import SETUPS, ProtonSetup
from napari_shadowinv.pipeline.shot_table import ShotRow

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
    """Return the column for a kind of setup, by default of protons."""
    quantity = SETUPS.get(kind, ProtonSetup).beam_quantity()
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
