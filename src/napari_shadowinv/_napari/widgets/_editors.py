"""Editors for the fields of pydantic models, and numbers with units."""

from __future__ import annotations

import math
import re
import types
from collections.abc import Mapping
from contextlib import suppress
from decimal import Decimal
from pathlib import Path
from typing import Any, Literal, Union, get_args, get_origin

from pydantic.fields import FieldInfo
from qtpy.QtCore import QEvent, QObject, QSignalBlocker, Qt, Signal
from qtpy.QtWidgets import QCheckBox, QComboBox, QFileDialog, QLineEdit, QSizePolicy, QWidget
from superqt import QLabeledDoubleSlider, QLabeledSlider, QLargeIntSpinBox

from napari_shadowinv._napari.widgets._qt import side_by_side, small_button
from napari_shadowinv.errors import InputError
from napari_shadowinv.physics.beam import unit_in_title

_MAX_INTEGER = 2**63 - 1
_UNSET = "not set"
_NUMBER = re.compile(r"(?P<number>[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?)\s*(?P<unit>\S*)")
# Units with prefixes; kilopixels are not in use.
_UNITS_WITH_PREFIX = ("m", "eV", "MeV")
_EXAMPLES = {"m": ", such as 1.3 mm", "MeV": ", such as 14.7 MeV"}


def parse_number(text: str, unit: str) -> float:
    """Parse a number such as ``1.3 mm`` or ``inf``; without a unit it is in `unit`."""
    if text.strip().lower() in ("inf", "infinite", "∞"):
        return math.inf
    match = _NUMBER.fullmatch(text.strip())
    if match is not None and match["unit"] in ("", unit):
        return float(match["number"])
    with suppress(Exception):  # whatever pint raises for what is no unit, or another kind of it
        if match is not None and unit:
            import pint

            factor = pint.application_registry.Quantity(1.0, match["unit"]).to(unit).magnitude
            power = round(math.log10(factor)) if factor > 0 else 0
            if math.isclose(factor, 10.0**power, rel_tol=1e-9):
                # In decimals, so that 1.3 mm is exactly 0.0013 m.
                return float(Decimal(match["number"]).scaleb(power))
            return float(match["number"]) * float(factor)
    example = _EXAMPLES.get(unit, "")
    raise InputError(f"{text!r} is not a number{f' in {unit}' if unit else ''}{example}")


def format_number(value: float, unit: str) -> str:
    """Format a number with a suitable prefix of its unit."""
    if math.isinf(value) or not unit:
        return f"{value:.12g}"
    if unit not in _UNITS_WITH_PREFIX or value == 0:
        return f"{value:.12g} {unit}"
    import pint

    compact = pint.application_registry.Quantity(value, unit).to_compact()
    return f"{compact.magnitude:.12g} {compact.units:~P}"


class _WheelGuard(QObject):
    """Keeps the mouse wheel from changing values while it scrolls the form."""

    def eventFilter(self, watched: QObject, event: QEvent) -> bool:
        if event.type() == QEvent.Type.Wheel and not watched.hasFocus():
            event.ignore()
            return True
        return False


def _ignore_wheel(widget: QWidget) -> None:
    widget.setFocusPolicy(Qt.FocusPolicy.StrongFocus)
    widget.installEventFilter(_WheelGuard(widget))


class SteadyComboBox(QComboBox):
    """A narrow combo box that ignores the mouse wheel; `choices` are titles by key."""

    def __init__(self, choices: Mapping[Any, str] | None = None, tip: str = "") -> None:
        super().__init__(minimumContentsLength=6, toolTip=f"<qt>{tip}</qt>" if tip else "")
        for key, title in (choices or {}).items():
            self.addItem(title, key)
        self.setSizeAdjustPolicy(QComboBox.SizeAdjustPolicy.AdjustToMinimumContentsLengthWithIcon)
        self.setSizePolicy(QSizePolicy.Policy.Expanding, QSizePolicy.Policy.Fixed)
        _ignore_wheel(self)


class Editor(QWidget):
    """A widget for the value of one field, None if it is unset."""

    changed = Signal()
    # Whether the value is shown with its unit, so that the label can omit it.
    shows_unit = False

    def __init__(self, inner: QWidget) -> None:
        super().__init__()
        self.inner = inner
        side_by_side((inner, 0), holder=self)

    @property
    def checked(self) -> bool:
        """Whether the field is set; False only for an unchecked optional field."""
        return True

    def value(self) -> Any:
        raise NotImplementedError

    def set_value(self, value: Any) -> None:
        raise NotImplementedError


class _Flag(Editor):
    def __init__(self) -> None:
        super().__init__(QCheckBox())
        self.inner.toggled.connect(self.changed)

    def value(self) -> bool:
        return bool(self.inner.isChecked())

    def set_value(self, value: Any) -> None:
        self.inner.setChecked(bool(value))


class _Choice(Editor):
    """A choice, of which None is an empty entry."""

    def __init__(self, choices: tuple[Any, ...]) -> None:
        super().__init__(SteadyComboBox())
        self._choices = choices
        self.inner.addItems(["" if choice is None else str(choice) for choice in choices])
        self.inner.currentIndexChanged.connect(self.changed)

    def value(self) -> Any:
        return self._choices[self.inner.currentIndex()]

    def set_value(self, value: Any) -> None:
        if value in self._choices:
            self.inner.setCurrentIndex(self._choices.index(value))


class _Number(Editor):
    """A spin box or a slider."""

    def __init__(self, inner: Any, number: type[int] | type[float]) -> None:
        super().__init__(inner)
        self._number = number
        _ignore_wheel(inner)
        inner.valueChanged.connect(lambda _: self.changed.emit())

    def value(self) -> float:
        return self._number(self.inner.value())

    def set_value(self, value: Any) -> None:
        self.inner.setValue(self._number(value))


def _spin_box(low: int | None, high: int | None) -> _Number:
    box = QLargeIntSpinBox()
    box.setMinimum(-_MAX_INTEGER if low is None else low)
    box.setMaximum(_MAX_INTEGER if high is None else high)
    box.setKeyboardTracking(False)  # typing a long number is one change
    box.setMinimumWidth(80)
    box.setSizePolicy(QSizePolicy.Policy.Expanding, QSizePolicy.Policy.Fixed)
    return _Number(box, int)


def _slider(low: float, high: float, number: type[int] | type[float]) -> _Number:
    """Create a number with both bounds, to be adjusted by eye."""
    slider = (QLabeledSlider if number is int else QLabeledDoubleSlider)(Qt.Orientation.Horizontal)
    if number is float:
        slider.setDecimals(2)
    slider.setRange(low, high)
    return _Number(slider, number)


class _Quantity(Editor):
    """A number of any magnitude with its unit, as text."""

    shows_unit = True

    def __init__(self, unit: str) -> None:
        hint = f"in {unit}" if unit else "a number"
        super().__init__(QLineEdit(placeholderText=hint, minimumWidth=80))
        self._unit = unit
        self._value: float | None = None
        self.inner.editingFinished.connect(self._read_text)

    def value(self) -> float | str | None:
        """Return the number, or text that is not a number, which the model refuses."""
        return self.inner.text() if self._value is None and self.inner.text() else self._value

    def set_value(self, value: Any) -> None:
        self._value = None if value is None else float(value)
        self._show()
        self.changed.emit()

    def _read_text(self) -> None:
        text = self.inner.text().strip()
        if self._value is not None and text == format_number(self._value, self._unit):
            return
        try:
            self._value = parse_number(text, self._unit) if text else None
        except InputError as error:
            self._value = None
            self.inner.setToolTip(str(error))
        else:
            self._show()
        self.changed.emit()

    def _show(self) -> None:
        self.inner.setToolTip("")
        self.inner.setText("" if self._value is None else format_number(self._value, self._unit))
        self.inner.setCursorPosition(0)


class _Text(Editor):
    """Text that the model validates; empty if the field is unset."""

    def __init__(self, hint: str) -> None:
        super().__init__(QLineEdit(placeholderText=hint, minimumWidth=80))
        self.inner.editingFinished.connect(self.changed)

    def value(self) -> str | None:
        return self.inner.text().strip() or None

    def set_value(self, value: Any) -> None:
        if isinstance(value, tuple):  # of pixels, first and end
            start, stop = value
            value = f"{start}:{'' if stop is None else stop}" if start or stop else None
        if isinstance(value, float):
            value = f"{value:.10g}"
        self.inner.setText("" if value is None else str(value))
        self.changed.emit()


class _NumberOrFile(_Text):
    """A number or a file name, with a button to choose the file."""

    def __init__(self, title: str) -> None:
        super().__init__("a number, or a file")
        self._title = title
        self.layout().addWidget(small_button("…", "Choose a file.", self._choose))

    def _choose(self) -> None:
        path, _ = QFileDialog.getOpenFileName(self, self._title)
        if path:
            self.set_value(path)


class _Optional(Editor):
    """An editor behind a check box; the value is None while it is unchecked."""

    def __init__(self, editor: Editor) -> None:
        super().__init__(QCheckBox(_UNSET))
        self.editor = editor
        self.shows_unit = editor.shows_unit
        self.layout().addWidget(editor, 1)
        editor.setVisible(False)
        self.inner.toggled.connect(self._on_toggle)
        editor.changed.connect(self.changed)

    @property
    def checked(self) -> bool:
        return bool(self.inner.isChecked())

    def value(self) -> Any:
        return self.editor.value() if self.checked else None

    def set_value(self, value: Any) -> None:
        with QSignalBlocker(self):
            if value is not None:
                self.editor.set_value(value)
            self.inner.setChecked(value is not None)
        self.changed.emit()

    def _on_toggle(self, checked: bool) -> None:
        self.inner.setText("" if checked else _UNSET)
        self.editor.setVisible(checked)
        self.changed.emit()


def editor_for(field: FieldInfo, initial: Any = None, *, leave_empty: bool = False) -> Editor:
    """Create the editor of a field; `initial` is an optional field's value when first checked.

    With `leave_empty` the editor of a number or an optional field is empty until it is set.
    """
    kind, is_optional = _without_none(field.annotation)
    if get_origin(kind) is Literal and is_optional:
        return _Choice((None, *get_args(kind)))
    editor = _plain_editor(kind, field)
    if leave_empty:
        return editor
    if is_optional:
        if initial is not None:
            editor.set_value(initial)
        editor = _Optional(editor)
    if not field.is_required():
        editor.set_value(field.get_default())
    return editor


def _plain_editor(kind: Any, field: FieldInfo) -> Editor:
    if get_origin(kind) is Literal:
        return _Choice(get_args(kind))
    if kind is bool:
        return _Flag()
    extra = field.json_schema_extra
    slider = extra.get("slider") if isinstance(extra, dict) else None
    if isinstance(slider, (tuple, list)):
        return _slider(slider[0], slider[1], kind)  # type: ignore[arg-type]
    if kind is int:
        return _spin_box(*_integer_bounds(field))
    if kind is float:
        return _Quantity(unit_in_title(field.title))
    if get_origin(kind) is tuple:
        return _Text("all, or a range such as 10:200")
    if Path in get_args(kind):
        return _NumberOrFile(field.title or "")
    raise TypeError(f"no editor for a field of type {kind}")


def _without_none(annotation: Any) -> tuple[Any, bool]:
    if get_origin(annotation) in (Union, types.UnionType):
        kinds = [kind for kind in get_args(annotation) if kind is not type(None)]
        if len(kinds) == 1:
            return kinds[0], True
    return annotation, False


def _integer_bounds(field: FieldInfo) -> tuple[int | None, int | None]:
    low = high = None
    for bound in field.metadata:
        if hasattr(bound, "ge"):
            low = bound.ge
        elif hasattr(bound, "gt"):
            low = bound.gt + 1
        elif hasattr(bound, "le"):
            high = bound.le
        elif hasattr(bound, "lt"):
            high = bound.lt - 1
    return low, high
