"""Forms of pydantic models, the only list of fields, units, limits and defaults.

A form holds what the user stated, and the model reads it; grey text shows the defaults.

- the entry of a field: `Entry`; the entries of a model: `ModelForm`
- one of several models: `ModelPicker`; a list of them: `StepsSection`
"""

from __future__ import annotations

import types
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from magicgui import widgets as magic
from pydantic import BaseModel
from pydantic.fields import FieldInfo
from qtpy import QtWidgets
from qtpy.QtCore import QEvent, QObject, QSignalBlocker, Qt, Signal
from qtpy.QtGui import QColor
from qtpy.QtWidgets import QSizePolicy, QWidget
from superqt import QCollapsible

from napari_shadowinv._napari.widgets import _qt as qt
from napari_shadowinv._system.validation import labels_of, validate
from napari_shadowinv.errors import InputError
from napari_shadowinv.physics.beam import number_in_unit, text_in_unit, unit_in_title
from napari_shadowinv.preprocessing import STEPS, Step

# For each key a title, and the class of its form's model, a widget, or None.
Kinds = dict[str, tuple[str, type[BaseModel] | QWidget | None]]

PROBLEM_COLOUR = QColor("#c8711a")  # as other colours of text, readable on dark and light
PROBLEM_STYLE = f"color: {PROBLEM_COLOUR.name()};"
_LABEL_WIDTH_PX, _ENTRY_WIDTH_PX = 80, 80
_INDENT = 12
TOML = "TOML (*.toml)"
# Fields that exclude each other: stating one empties the other.
_ALTERNATIVES = ("pixel_size", "detector_pixel_size")


class _WheelGuard(QObject):
    """Keeps the mouse wheel from changing values while it scrolls the form."""

    def eventFilter(self, watched: QObject, event: QEvent) -> bool:
        if event.type() == QEvent.Type.Wheel and not watched.hasFocus():
            event.ignore()
            return True
        return False


def steady(widget: QWidget) -> None:
    """Make a widget ignore the mouse wheel, and combo boxes as narrow as the window."""
    if isinstance(widget, QtWidgets.QComboBox):
        widget.setMinimumContentsLength(6)
        policy = QtWidgets.QComboBox.SizeAdjustPolicy.AdjustToMinimumContentsLengthWithIcon
        widget.setSizeAdjustPolicy(policy)
        widget.setSizePolicy(QSizePolicy.Policy.Expanding, QSizePolicy.Policy.Fixed)
    for each in (widget, *widget.findChildren(QWidget)):
        each.setFocusPolicy(Qt.FocusPolicy.StrongFocus)
        each.installEventFilter(_WheelGuard(each))


def combo_box(tip: str, choices: Iterable[tuple[str, Any]] = ()) -> magic.ComboBox:
    """Return a narrow box that ignores the mouse wheel, with a choice of titles and values."""
    box = magic.ComboBox(choices=list(choices), tooltip=f"<qt>{tip}</qt>" if tip else "")
    steady(box.native)
    return box


def labelled(text: str, widget: QtWidgets.QWidget) -> QtWidgets.QWidget:
    """Put a label of the common width before a widget."""
    label = QtWidgets.QLabel(text, minimumWidth=_LABEL_WIDTH_PX)
    return qt.side_by_side((label, 0), (widget, 1))


def section(title: str, *widgets: QtWidgets.QWidget) -> QCollapsible:
    """Put widgets under a title that folds them; initially folded."""
    folded = QCollapsible(title, expandedIcon="▾", collapsedIcon="▸")
    folded.setDuration(0)
    folded.layout().setContentsMargins(0, 0, 0, 0)
    folded.layout().setSpacing(2)
    folded.content().layout().setContentsMargins(6, 2, 0, 4)
    for widget in widgets:
        folded.addWidget(widget)
    return folded


def titled_section(*widgets: QtWidgets.QWidget) -> QCollapsible:
    """Create a section for a title that summarises it; a long title does not widen the window."""
    folded = section("", *widgets)
    folded.toggleButton().setSizePolicy(QSizePolicy.Policy.Ignored, QSizePolicy.Policy.Fixed)
    return folded


class WrappingLabel(QtWidgets.QLabel):
    """A label that wraps at the available width, and is hidden without text."""

    def __init__(self, text: str = "", style: str = "") -> None:
        super().__init__(wordWrap=True)
        self.setSizePolicy(QSizePolicy.Policy.Ignored, QSizePolicy.Policy.Minimum)
        self.setTextInteractionFlags(Qt.TextInteractionFlag.TextSelectableByMouse)
        self.show_text(text, style)

    def show_text(self, text: str, style: str | None = None) -> None:
        """Show another text, by default in the same style."""
        self.setText(text)
        # A new style redraws the whole window, with its canvas.
        if style not in (None, self.styleSheet()):
            self.setStyleSheet(style)
        self.setVisible(bool(text))


def text_line(example: str, tip: str) -> QtWidgets.QLineEdit:
    return QtWidgets.QLineEdit(placeholderText=example, toolTip=f"<qt>{tip}</qt>")


# Dialogs of Qt for the path of a field, by the field's ``path``.
_DIALOGS = {
    "file": "getOpenFileName",
    "files": "getOpenFileNames",
    "folder": "getExistingDirectory",
    "new": "getSaveFileName",
}
PATH_SEPARATOR = "; "
"""Between several files in one entry."""


class Entry:
    """The widget of a field; `value` is what was stated, None while the `default` applies.

    `on_change` is called when the user has changed the value.
    """

    def __init__(self, field: FieldInfo, default: Any, on_change: Callable[[], Any]) -> None:
        self._field, self._on_change = field, on_change
        self._unit = unit_in_title(field.title)
        self._default = self._plain(default)
        self._kinds = _kinds_in(field.annotation)
        extra = field.json_schema_extra
        self._extra: Mapping[str, Any] = extra if isinstance(extra, dict) else {}
        self._dialog = str(self._extra.get("path", "file" if Path in self._kinds else ""))
        self.widget = self._make(str(field.title))
        self._stated: Any = None
        self._entry = self.line.value
        if self._is_text:
            self.line.native.editingFinished.connect(self._read)
        else:
            self.line.changed.connect(self._read)

    @property
    def line(self) -> Any:
        """The widget with the value, which may have a button beside it."""
        return self.widget[0] if isinstance(self.widget, magic.Container) else self.widget

    @property
    def value(self) -> Any:
        """The stated value exactly, or text that only the model can read."""
        entry = self.line.value
        if entry == self._entry:
            return self._stated
        if isinstance(self.line, magic.FloatSlider):
            entry = round(entry, 5)  # it cuts off the sixth decimal
        if not self._is_text:
            return None if entry == self._default else entry
        return self._number_in(entry.strip()) if entry.strip() else None

    @value.setter
    def value(self, value: Any) -> None:
        value = self._plain(value)
        self._show(None if value == self._default else value)

    def _show(self, value: Any) -> None:
        self._stated = value
        entry = self._default if value is None else value
        if self._is_text:
            self.line.value = "" if value is None else _text_of(value, self._unit)
        elif isinstance(self.line, magic.Slider | magic.FloatSlider):
            self._show_on_slider(entry)
        elif not isinstance(self.line, magic.ComboBox) or entry in self.line.choices:
            self.line.value = entry
        else:
            self._stated = None
        self._entry = self.line.value

    def _plain(self, value: Any) -> Any:
        """Return paths and ranges as text, which files and settings can hold."""
        return _text_of(value, self._unit) if isinstance(value, list | tuple | Path) else value

    def show_default(self, text: str) -> None:
        """Show in grey what applies while the entry is empty."""
        self.line.native.setPlaceholderText(text)

    @property
    def _is_text(self) -> bool:
        return isinstance(self.line, magic.LineEdit)

    def _make(self, title: str) -> Any:
        ends = self._extra.get("slider")
        # Qt wraps rich text only.
        tip = f"<qt>{self._field.description}</qt>" if self._field.description else ""
        texts = {"label": title, "tooltip": tip}
        if self._kinds == {bool}:
            box = magic.CheckBox(value=bool(self._default), **texts)
            box.text = ""  # its label stands before it
            return box
        if choices := _choices_in(self._field.annotation):
            widget: Any = magic.ComboBox(choices=[(str(c or ""), c) for c in choices], **texts)
            widget.value = self._default
        elif isinstance(ends, list | tuple):
            kind = magic.FloatSlider if float in self._kinds else magic.Slider
            widget = kind(min=ends[0], max=ends[1], value=self._default, **texts)
        else:
            texts["label"] = title.removesuffix(f" ({self._unit})")
            return self._make_line(texts)
        steady(widget.native)
        return widget

    def _make_line(self, texts: dict[str, str]) -> Any:
        is_number = bool(self._kinds & {int, float})
        words = ", ".join(_words_in(self._field.annotation))
        kinds = {words: words, "a number": is_number, "a file": Path in self._kinds}
        content = " or ".join(title for title, is_kind in kinds.items() if is_kind)
        content = f"in {self._unit}" if self._unit else content
        hint = content if self._field.is_required() else f"not set ({content})"
        if self._field.examples:
            hint = str(self._field.examples[0])
        elif tuple in self._kinds:
            hint = "all, or a range such as 10:200"
        elif self._default is not None:
            hint = _text_of(self._default, self._unit) if is_number else str(self._default)
        elif not content:
            hint = "default"
        line = magic.LineEdit(**texts)
        line.native.setPlaceholderText(hint)
        line.native.setMinimumWidth(_ENTRY_WIDTH_PX)
        if not self._dialog:
            return line
        button = magic.PushButton(text="…", tooltip="Choose a file or folder.")
        button.native.setMaximumWidth(30)
        button.changed.connect(self.choose_path)
        row = magic.Container(widgets=[line, button], layout="horizontal", labels=False, **texts)
        row.margins = (0, 0, 0, 0)
        return row

    def choose_path(self) -> None:
        """Ask for the path of a file, of several or of a folder."""
        ask = getattr(QtWidgets.QFileDialog, _DIALOGS[self._dialog])
        answer = ask(self.line.native, str(self._field.title))
        chosen = answer if isinstance(answer, str) else answer[0]
        if chosen:
            self.line.value = chosen if isinstance(chosen, str) else PATH_SEPARATOR.join(chosen)
            self._read()

    def _show_on_slider(self, value: Any) -> None:
        if isinstance(value, int | float):
            self.line.min, self.line.max = min(self.line.min, value), max(self.line.max, value)
            self.line.value = value

    def _number_in(self, text: str) -> Any:
        """Return the number in a text, or the text, which the model reads or refuses."""
        if not self._kinds & {int, float}:
            return text
        for read in (int, partial(number_in_unit, unit=self._unit)):
            if read is not int or int in self._kinds:
                with suppress(ValueError):
                    return read(text)
        return text

    def _read(self) -> None:
        """Read what the user has entered, and show a number with its unit."""
        if self.line.value != self._entry:
            self._show(self.value)
            self._on_change()


def _kinds_in(annotation: Any) -> set[Any]:
    """Return the types of a field without None."""
    if get_origin(annotation) is Annotated:
        return _kinds_in(get_args(annotation)[0])
    if get_origin(annotation) in (Union, types.UnionType):
        return set().union(*(_kinds_in(each) for each in get_args(annotation)))
    return set() if annotation is type(None) else {get_origin(annotation) or annotation}


def _words_in(annotation: Any) -> tuple[str, ...]:
    """Return the words among the types of a field."""
    if get_origin(annotation) is Literal:
        return get_args(annotation)
    return tuple(word for each in get_args(annotation) for word in _words_in(each))


def _choices_in(annotation: Any) -> tuple[Any, ...]:
    """Return the choices of a field, None for an empty one; no choices for other fields."""
    if get_origin(annotation) is Literal:
        return get_args(annotation)
    if _kinds_in(annotation) == {Literal}:
        (choices,) = (each for each in get_args(annotation) if each is not type(None))
        return (None, *get_args(choices))
    return ()


def _text_of(value: Any, unit: str) -> str:
    if isinstance(value, tuple | list):
        if value and isinstance(value[0], str):
            return ", ".join(value)
        start, stop = value  # pixels, first and end
        return f"{start}:{'' if stop is None else stop}"
    is_number = isinstance(value, int | float)
    return text_in_unit(value, unit) if is_number else str(value)


class ModelForm(QWidget):
    """Entries for a model's fields; its state has those that are stated, as in a TOML file.

    With `names`, only for these fields.
    """

    changed = Signal()
    defaults_vary = False  # with the stated values, so that a default may be stated, too

    def __init__(self, model_class: type[BaseModel], names: Sequence[str] | None = None) -> None:
        super().__init__()
        self._model_class = model_class
        self._fixed: dict[str, Any] = {}
        self.entries: dict[str, Entry] = {}
        self._rare: list[str] = []  # have a row only while they are stated
        self._rows = rows = QtWidgets.QFormLayout()
        rows.setContentsMargins(0, 0, 0, 0)
        rows.setFieldGrowthPolicy(QtWidgets.QFormLayout.FieldGrowthPolicy.AllNonFixedFieldsGrow)
        rows.setLabelAlignment(Qt.AlignmentFlag.AlignLeft | Qt.AlignmentFlag.AlignVCenter)
        for name, field in model_class.model_fields.items():
            if names is not None and name not in names:
                continue
            choices = _choices_in(field.annotation)
            if len(choices) == 1:
                self._fixed[name] = choices[0]
                continue
            is_open = self.defaults_vary or field.is_required()
            default = None if is_open else field.get_default()
            self.entries[name] = Entry(field, default, partial(self._on_edit, name))
            widget = self.entries[name].widget
            label = QtWidgets.QLabel(widget.label, toolTip=widget.tooltip)
            label.setMinimumWidth(_LABEL_WIDTH_PX)
            rows.addRow(label, widget.native)
            extra = field.json_schema_extra
            if isinstance(extra, dict) and extra.get("rare"):
                self._rare.append(name)
                rows.setRowVisible(widget.native, False)
        self._problem = WrappingLabel(style=PROBLEM_STYLE)
        qt.column(self).addLayout(rows)
        self.layout().addWidget(self._problem)

    @property
    def is_empty(self) -> bool:
        """Whether there are required fields, all of them empty."""
        fields = self._model_class.model_fields
        required = [entry for name, entry in self.entries.items() if fields[name].is_required()]
        return bool(required) and all(entry.value is None for entry in required)

    def state(self) -> dict[str, Any]:
        """Return the stated values by key, which are JSON values."""
        values = {name: entry.value for name, entry in self.entries.items()}
        return self._fixed | {name: value for name, value in values.items() if value is not None}

    def restore(self, values: Mapping[str, Any]) -> None:
        """Show values; missing fields get their defaults."""
        for name, entry in self.entries.items():
            entry.value = values.get(name)
        self._on_change()

    def model(self) -> BaseModel:
        """Return the validated model, or raise an `InputError`."""
        title = getattr(self._model_class, "title", None)  # of some an attribute of each model
        name = title if isinstance(title, str) else "options"
        return validate(self._model_class, self.state(), name, labels_of(self._model_class))

    def _on_edit(self, name: str) -> None:
        if name in _ALTERNATIVES and self.entries[name].value is not None:
            for other in set(_ALTERNATIVES) - {name}:
                self.entries[other].value = None
        self._on_change()

    def _on_change(self) -> None:
        for name in self._rare:
            entry = self.entries[name]
            self._rows.setRowVisible(entry.widget.native, entry.value is not None)
        problem = ""
        try:
            self.model()
        except InputError as error:
            # A form without any entries is not an error yet.
            problem = "" if self.is_empty else str(error)
        self._problem.show_text(problem)
        self.changed.emit()


def kinds_of(models: Mapping[str, Any]) -> Kinds:
    """Return the kinds of a `ModelPicker` from model classes with titles."""
    return {name: (model.title, model) for name, model in models.items()}


class ModelPicker(QWidget):
    """A choice between kinds, each with its form or widget below, or with none.

    What the user has `chosen` stays selected while it is offered.
    """

    picked = Signal()  # another kind
    changed = Signal()  # the kind, or an entry of its form

    def __init__(self, label: str | None, kinds: Kinds, tip: str = "") -> None:
        super().__init__()
        self._kinds = dict(kinds)
        self._rows = {kind: row for kind, (_, row) in kinds.items() if isinstance(row, QWidget)}
        self._forms: dict[str, ModelForm] = {}
        self.chosen: Any = None
        self.choice = combo_box(tip)
        box = self.choice.native
        self._line = qt.side_by_side((box, 1)) if label is None else labelled(label, box)
        self._below = QtWidgets.QVBoxLayout()
        qt.column(self, self._line).addLayout(self._below)
        for row in self._rows.values():
            self._below.addWidget(row)
        self.fill()
        self.choice.changed.connect(self._on_choice)

    @property
    def kind(self) -> str:
        return str(self.choice.value)

    @property
    def form(self) -> ModelForm | None:
        return self._forms.get(self.kind)

    def add_button(self, text: str, tip: str, action: Callable[[], Any]) -> None:
        """Put a small button on the right of the choice."""
        self._line.layout().addWidget(qt.small_button(text, tip, action))

    def offer(self, kinds: Kinds) -> None:
        """Replace the kinds; the chosen one stays, or comes back once it is offered again."""
        self._kinds = dict(kinds)
        self.fill()

    def fill(self, _: Any = None) -> None:
        """Offer what there is now, and select what is preferred."""
        before = self.choice.value
        with self.choice.changed.blocked():
            self.choice.choices = ()  # new entries would otherwise come last
            self.choice.choices = self._choices
            offered = self.choice.choices
            preferred = [value for value in self._preferred(before) if value in offered]
            if preferred:
                self.choice.value = preferred[0]
        if self.choice.value != before:
            self._show()

    def _choices(self, _: Any) -> list[tuple[str, Any]]:
        return [entry for kind in self._kinds for entry in self._entries(kind)]

    def _entries(self, kind: str) -> list[tuple[str, Any]]:
        """Return titles and values of the entries that stand for a kind."""
        return [(self._kinds[kind][0], kind)]

    def _preferred(self, before: Any) -> Sequence[Any]:
        """Return the values to select if they are offered, the best first."""
        return self.chosen, before, *self._kinds

    def set_kind(self, kind: Any) -> None:
        """Choose a kind, now or once it is offered."""
        self._remember(kind)
        self.fill()

    def model(self) -> BaseModel | None:
        """Return the validated model of the selected kind; None without a form."""
        return None if self.form is None else self.form.model()

    def restore(self, kind: str, values: Mapping[str, Mapping[str, Any]]) -> None:
        """Choose a kind, and show values in the forms of kinds."""
        for each, stated in values.items():
            form = self._form_of(each) if each in self._kinds else None
            if form is not None:
                form.restore(stated)
        self.set_kind(kind)

    def _remember(self, choice: Any) -> None:
        self.chosen = choice

    def _on_choice(self, value: Any) -> None:
        self._remember(value)
        self._show()

    def _show(self) -> None:
        """Show the form of another kind."""
        self._form_of(self.kind)
        for kind, widget in (*self._rows.items(), *self._forms.items()):
            widget.setVisible(kind == self.kind)
        self.picked.emit()
        self._on_entry()

    def _on_entry(self) -> None:
        self.changed.emit()

    def _form_of(self, kind: str) -> ModelForm | None:
        _, model_class = self._kinds.get(kind, ("", None))
        if isinstance(model_class, type) and kind not in self._forms:
            form = ModelForm(model_class)
            form.layout().setContentsMargins(_INDENT, 0, 0, 0)
            form.setVisible(False)
            form.changed.connect(self._on_entry)
            self._forms[kind] = form
            self._below.addWidget(form)
        return self._forms.get(kind)


class StepForm(QWidget):
    """A step: a section with its name and form, and buttons to move or remove it."""

    def __init__(self, kind: type[Step], move: Callable[..., None]) -> None:
        super().__init__()
        self.kind, self.form = kind, ModelForm(kind)
        self.folded = section(kind.title, self.form)
        self.up = qt.small_button("↑", "Move this step up.", lambda: move(self, -1))
        self.down = qt.small_button("↓", "Move this step down.", lambda: move(self, 1))
        self.remove = qt.small_button("✕", "Remove this step.", lambda: move(self, None))
        buttons = [(button, 0) for button in (self.up, self.down, self.remove)]
        line = qt.side_by_side((self.folded.toggleButton(), 1), *buttons)
        self.folded.layout().insertWidget(0, line)
        self.folded.expand(animate=False)
        qt.column(self, self.folded)


class StepsSection(QWidget):
    """A folded list of steps under a title with their names."""

    changed = Signal()

    def __init__(self, kinds: Mapping[str, type[Step]] = STEPS) -> None:
        super().__init__()
        self.forms: list[StepForm] = []
        self.choice = combo_box(
            "Processing of image, source and masks before the inversion or fit.",
            [("add a step…", ""), *((kind.title, name) for name, kind in kinds.items())],
        )
        self._list = QWidget()
        qt.column(self._list)
        self.folded = titled_section(self._list, labelled("", self.choice.native))
        qt.column(self, self.folded)
        self.choice.changed.connect(self._on_choice)
        self._on_change()

    def steps(self) -> tuple[Step, ...]:
        """Return the validated steps, or raise an `InputError`."""
        return tuple(form.form.model() for form in self.forms)  # type: ignore[misc]

    def add(self, name: str, values: Mapping[str, Any] | None = None) -> StepForm:
        """Append a step by name, with its defaults or other values."""
        step_form = StepForm(STEPS[name], self._move)
        if values is not None:
            step_form.form.restore(values)
        step_form.form.changed.connect(self._on_change)
        self.forms.append(step_form)
        self._list.layout().addWidget(step_form)
        self._on_change()
        return step_form

    def show_steps(self, steps: Sequence[Step]) -> None:
        """Replace the steps by others, folded."""
        with QSignalBlocker(self):
            for form in list(self.forms):
                self._move(form, None)
            for step in steps:
                self.add(step.name(), step.model_dump()).folded.collapse(animate=False)
        self._on_change()

    def _on_choice(self, name: str) -> None:
        if name:
            self.choice.value = ""
            self.add(name)

    def _move(self, form: StepForm, offset: int | None) -> None:
        """Move a step down by `offset` places; remove it if that is None."""
        index = self.forms.index(form)
        self.forms.remove(form)
        self._list.layout().removeWidget(form)
        if offset is None:
            form.setVisible(False)
            form.deleteLater()
            if not self.forms:
                self.folded.collapse(animate=False)
        else:
            self.forms.insert(index + offset, form)
            self._list.layout().insertWidget(index + offset, form)
        self._on_change()

    def _on_change(self) -> None:
        # A folded section must show that there are steps.
        names = ", ".join(form.kind.title for form in self.forms)
        title = f"Steps: {names or 'none'}"
        if self.folded.text() != title:
            self.folded.setText(title)
            self.folded.setToolTip(title)
        for form in self.forms:
            form.up.setEnabled(form is not self.forms[0])
            form.down.setEnabled(form is not self.forms[-1])
        self.changed.emit()
