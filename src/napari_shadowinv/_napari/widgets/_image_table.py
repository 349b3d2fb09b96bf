"""The images of a fit in a table, a row each, with what is known of each: `ImageTable`."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from qtpy.QtCore import QSignalBlocker, Qt, Signal
from qtpy.QtWidgets import QSizePolicy, QWidget

from napari_shadowinv._napari import layer_metadata as about
from napari_shadowinv._napari.widgets._fields import parsed, unit_of_title
from napari_shadowinv._napari.widgets._forms import labelled
from napari_shadowinv._napari.widgets._layers import LayerPicker, image_of, kind_of, stack_of
from napari_shadowinv._napari.widgets._number_table import NumberTable
from napari_shadowinv._napari.widgets._qt import column, while_alive
from napari_shadowinv.errors import InputError
from napari_shadowinv.physics.setup import SETUPS, Setup

_KEPT = "fit"  # what a layer's metadata keep of its rows
_NAME, _BEAM, _GAIN, _PSF = range(4)
_COLUMNS = {_GAIN: ("gain", "Gain", 1.0), _PSF: ("psf", "PSF σ (px)", 0.0)}
_WIDTHS = {_BEAM: 90, _GAIN: 44, _PSF: 72}
_BEAM_FIELDS = {"proton": "energy", "optical": "wavelength"}


@dataclass(frozen=True)
class BeamColumn:
    """What tells one image's beam from another's."""

    name: str
    title: str
    unit: str
    tip: str


def beam_column(kind: str) -> BeamColumn:
    """The column for a kind of setup; without one, how strong the images are displaced."""
    if kind not in _BEAM_FIELDS:
        tip = "Displacement in this image relative to the first one, such as 0.6."
        return BeamColumn("strength", "Strength", "", tip)
    name = _BEAM_FIELDS[kind]
    field = SETUPS[kind].model_fields[name]
    title, unit = unit_of_title(field.title or name)
    short = title.split()[-1].capitalize()
    return BeamColumn(name, short, unit, str(field.description))


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
        """Its pixels, not read yet if they are lazy; or an `InputError`."""
        if self.plane is None:
            return image_of(self.layer)
        return stack_of(self.layer)[self.plane]

    @property
    def setup(self) -> Setup | None:
        return about.setup_of(self.layer)

    def kept(self) -> dict[str, Any]:
        """What the user gave in this row."""
        rows = about.mark_of(self.layer).get(_KEPT, {})
        return dict(rows.get(self.plane or 0, {}))

    def keep(self, **values: Any) -> None:
        # New dicts: a duplicate of the layer may share the old ones.
        mark = about.mark_of(self.layer)
        rows = {**mark.get(_KEPT, {}), self.plane or 0: {**self.kept(), **values}}
        self.layer.metadata[about.KEY] = {**mark, _KEPT: rows}


class ImageTable(QWidget):
    """The 2-D images of a viewer, or the planes of a stack; the first used is the reference."""

    changed = Signal()  # something in it
    first_changed = Signal()  # another image is the reference
    first_beam = Signal(float)  # the user has given the reference's energy or wavelength

    def __init__(self, viewer: Any, suits: Callable[[Any], bool]) -> None:
        super().__init__()
        self._viewer, self._suits = viewer, suits
        self._first: ImageRow | None = None
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
        """The rows that are checked, the reference first."""
        return [row for number, row in enumerate(self.rows) if self.table.is_checked(number)]

    @property
    def reference(self) -> ImageRow | None:
        """The first image in use, in whose pixels and units the fields are told."""
        return self._first

    def fill(self, event: Any = None) -> None:
        """Show what the viewer has now."""
        stack = self.stacks.layer
        if stack is not None:
            self.rows = [ImageRow(stack, plane) for plane in range(stack.data.shape[0])]
        else:
            self.rows = [ImageRow(layer) for layer in self._viewer.layers if self._is_image(layer)]
        shapes = Counter(row.layer.data.shape for row in self.rows)
        usual = max(shapes, key=lambda shape: shapes[shape], default=None)
        with QSignalBlocker(self.table):
            self.table.setRowCount(len(self.rows))
            for number, row in enumerate(self.rows):
                use = row.kept().get("use", row.layer.data.shape == usual)
                tip = f"{row.name}: {_setup_in_words(row)}."
                self.table.fill_row(number, row.name, tip, checked=use)
        self.table.fit_height()
        self._on_use()

    def showEvent(self, event: Any) -> None:
        super().showEvent(event)
        # Only now the rows have the heights of napari's style, and another widget may have
        # changed a layer's setup.
        self.fill()

    def show_beams(self, kind: str, value: Any, gains_known: bool) -> None:
        """Fill the cells; the reference has the energy `value` of the setup that is shown."""
        self.beam = beam_column(kind)
        first = self._first
        if first is not None and first.plane is not None and isinstance(value, float):
            first.keep(**{self.beam.name: value})  # a stack has one setup for all its planes
        with QSignalBlocker(self.table):
            titles = ["Image", self.beam.title, *(title for _, title, _ in _COLUMNS.values())]
            unit = f" ({self.beam.unit})" if self.beam.unit == "MeV" else ""
            titles[_BEAM] = f"{self.beam.title}{unit}"
            self.table.setHorizontalHeaderLabels(titles)
            for number, row in enumerate(self.rows):
                at_first = row == self._first
                beam = value if at_first and kind in _BEAM_FIELDS else self._beam_of(row)
                if at_first and kind not in _BEAM_FIELDS:
                    beam = 1.0
                self.table.write(number, _BEAM, beam, self.beam.unit, self.beam.tip)
                for at, (name, _, usual) in _COLUMNS.items():
                    self.table.write(number, at, row.kept().get(name, usual), "", _TIPS[name])
                gain = self.table.item(number, _GAIN)
                editable = Qt.ItemFlag.ItemIsEnabled | Qt.ItemFlag.ItemIsEditable
                gain.setFlags(editable if gains_known else Qt.ItemFlag.NoItemFlags)
                if not gains_known:
                    gain.setText("free")

    def beam_value(self, row: ImageRow) -> float:
        """Energy, wavelength or strength of a row, or an `InputError`."""
        value = self._value(row, _BEAM, self.beam.unit)
        if value is None:
            what = self.beam.title.lower()
            raise InputError(f"'{row.name}' has no {what}: type it in the table, or uncheck it")
        return value

    def gain(self, row: ImageRow) -> float:
        value = self._value(row, _GAIN, "")
        return 1.0 if value is None else value

    def psf(self, row: ImageRow) -> float:
        return self._value(row, _PSF, "px") or 0.0

    def _value(self, row: ImageRow, at: int, unit: str) -> float | None:
        try:
            return self.table.number(self.rows.index(row), at, unit)
        except InputError as error:
            raise InputError(f"'{row.name}': {error}") from error

    def _beam_of(self, row: ImageRow) -> Any:
        """What the user gave, or what the layer's own setup tells."""
        given = row.kept().get(self.beam.name)
        if given is not None or row.plane is not None:
            return given
        if self.beam.name == "strength" and self._first is not None:
            own, first = (about.mark_of(one.layer).get("strength") for one in (row, self._first))
            return own / first if own and first else None
        return getattr(row.setup, self.beam.name, None)

    def _on_edit(self, item: Any) -> None:
        row, at = self.rows[item.row()], item.column()
        if at == _NAME:
            row.keep(use=self.table.is_checked(item.row()))
            self._on_use()
            return
        name = self.beam.name if at == _BEAM else _COLUMNS[at][0]
        unit = self.beam.unit if at == _BEAM else ""
        text = item.text().strip()
        try:
            value: Any = parsed(text, unit) if text else None
        except InputError:
            value = text  # stays to be mended
        if at == _BEAM and row == self._first and isinstance(value, float) and name != "strength":
            self.first_beam.emit(value)
        else:
            row.keep(**{name: value})
        with QSignalBlocker(self.table):
            tip = self.beam.tip if at == _BEAM else _TIPS[name]
            self.table.write(item.row(), at, value, unit, tip)
        self.changed.emit()

    def _on_use(self) -> None:
        used = self.used
        before = self._first
        self._first = used[0] if used else None
        if self._first != before:
            self.first_changed.emit()
        self.changed.emit()

    def _on_insertion(self, event: Any) -> None:
        while_alive(self, event.value.events.name, self.fill)
        self.fill()

    def _is_image(self, layer: Any) -> bool:
        grey = kind_of(layer) == "image" and not getattr(layer, "rgb", False)
        return grey and layer.ndim == 2 and self._suits(layer)


def _setup_in_words(row: ImageRow) -> str:
    """Where the distances of its experiment come from."""
    if row.setup is None or row.plane is not None:
        return "with the setup below"
    origin = about.setup_origin_of(row.layer)
    return f"with a setup of its own ({row.setup.probe}{f', {origin}' if origin else ''})"


_TIPS = {
    "gain": "By how much the image is brighter than the source; 1 if it is as bright.",
    "psf": "Standard deviation of the image's blur, in pixels after the steps; 0 for none.",
}
