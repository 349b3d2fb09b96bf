"""Forms generated from pydantic models, the only list of fields and defaults."""

from __future__ import annotations

import html
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, get_args, get_origin

import tomli_w
from pydantic import BaseModel
from qtpy import QtWidgets
from qtpy.QtCore import QSignalBlocker, Qt, Signal
from qtpy.QtGui import QColor
from qtpy.QtWidgets import QSizePolicy, QWidget
from superqt import QCollapsible

from napari_shadowinv._napari.widgets import _qt as qt
from napari_shadowinv._napari.widgets._editors import Editor, SteadyComboBox, editor_for
from napari_shadowinv._system.validation import labels_of, validate
from napari_shadowinv.errors import InputError
from napari_shadowinv.io import read_toml, replacing
from napari_shadowinv.physics.beam import unit_in_title
from napari_shadowinv.preprocessing import STEPS, Step

# For each key a title, and the class of its form's model, a widget, or None.
Kinds = dict[str, tuple[str, type[BaseModel] | QWidget | None]]

PROBLEM_COLOUR = QColor("#d9822b")
PROBLEM_STYLE = f"color: {PROBLEM_COLOUR.name()};"
_LABEL_WIDTH_PX = 80
INDENT = 12
TOML = "TOML (*.toml)"
# Optional fields that exclude each other: checking one unchecks the other.
_ALTERNATIVES = ("pixel_size", "detector_pixel_size")


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

    def show_titled(self, title: str, text: str, style: str) -> None:
        """Show a sentence below a bold title."""
        sentence = html.escape(f"{text[:1].upper()}{text[1:]}")
        self.show_text(f"<b>{html.escape(title)}</b><br>{sentence}", style)


class LineEdit(QtWidgets.QLineEdit):
    """An entry that can be saved between sessions."""

    def __init__(self, example: str, tip: str) -> None:
        super().__init__(placeholderText=example, toolTip=f"<qt>{tip}</qt>" if tip else "")

    def state(self) -> str:
        return str(self.text())

    def restore(self, text: Any) -> None:
        self.setText(str(text))


class PathEdit(QtWidgets.QWidget):
    changed = Signal()

    def __init__(
        self, title: str, example: str = "path of a file", tip: str = "", files: str = ""
    ) -> None:
        super().__init__()
        self._title, self._files = title, files
        self.edit = LineEdit(example, tip)
        self.edit.setMinimumWidth(60)
        qt.side_by_side((qt.with_button(self.edit, "…", title, self.choose), 0), holder=self)
        self.edit.editingFinished.connect(self.changed)

    @property
    def path(self) -> str:
        return str(self.edit.text()).strip()

    def state(self) -> str:
        return self.path

    def restore(self, path: Any) -> None:
        self.edit.setText(str(path))

    def ask(self) -> str:
        """Open a dialog and return the chosen path, or an empty string."""
        path, _ = QtWidgets.QFileDialog.getOpenFileName(self, self._title, "", self._files)
        return str(path)

    def choose(self) -> None:
        path = self.ask()
        if path:
            self.edit.setText(path)
            self.changed.emit()


class ModelForm(QtWidgets.QWidget):
    """Editors for a model's fields; `initial` holds the first values of optional fields."""

    changed = Signal()
    leaves_empty = False  # whether fields are empty until they are set, instead of their defaults

    def __init__(
        self, model_class: type[BaseModel], initial: Mapping[str, Any] | None = None
    ) -> None:
        super().__init__()
        self._model_class = model_class
        self._fixed: dict[str, Any] = {}
        self.editors: dict[str, Editor] = {}
        rows = QtWidgets.QFormLayout()
        rows.setContentsMargins(0, 0, 0, 0)
        rows.setRowWrapPolicy(QtWidgets.QFormLayout.RowWrapPolicy.DontWrapRows)
        rows.setFieldGrowthPolicy(QtWidgets.QFormLayout.FieldGrowthPolicy.AllNonFixedFieldsGrow)
        rows.setLabelAlignment(Qt.AlignmentFlag.AlignLeft | Qt.AlignmentFlag.AlignVCenter)
        layout = qt.column(self)
        layout.addLayout(rows)
        for name, field in model_class.model_fields.items():
            if get_origin(field.annotation) is Literal and len(get_args(field.annotation)) == 1:
                self._fixed[name] = get_args(field.annotation)[0]
                continue
            editor = editor_for(field, (initial or {}).get(name), leave_empty=self.leaves_empty)
            title = field.title or name
            unit = unit_in_title(title) if editor.shows_unit else ""
            label = QtWidgets.QLabel(title.removesuffix(f" ({unit})"))
            for widget in (label, editor):
                # Qt wraps rich text only.
                widget.setToolTip(f"<qt>{field.description}</qt>" if field.description else "")
            rows.addRow(label, editor)
            editor.changed.connect(self._on_change)
            self.editors[name] = editor
        self._problem = WrappingLabel(style=PROBLEM_STYLE)
        layout.addWidget(self._problem)

    @property
    def is_empty(self) -> bool:
        """Whether there are required fields, all of them empty."""
        fields = self._model_class.model_fields
        required = [editor for name, editor in self.editors.items() if fields[name].is_required()]
        return bool(required) and all(editor.value() in (None, "") for editor in required)

    def values(self) -> dict[str, Any]:
        """Return the values as in a TOML file, without unset fields."""
        values = {name: editor.value() for name, editor in self.editors.items()}
        return self._fixed | {name: value for name, value in values.items() if value is not None}

    def set_values(self, values: Mapping[str, Any]) -> None:
        """Show values; missing fields get their defaults."""
        with QSignalBlocker(self):
            for name, editor in self.editors.items():
                field = self._model_class.model_fields[name]
                has_default = not (self.leaves_empty or field.is_required())
                default = field.get_default() if has_default else None
                value = values.get(name, default)
                if value is None and default is not None:
                    continue
                try:
                    editor.set_value(value)
                except (TypeError, ValueError, OverflowError):
                    # A saved entry may be text that is no number.
                    editor.set_value(default)
        self._on_change()

    # State that is saved between sessions
    state, restore = values, set_values

    def model(self) -> BaseModel:
        """Return the validated model, or raise an `InputError`."""
        name = getattr(self._model_class, "title", "options")
        return validate(self._model_class, self.values(), name, labels_of(self._model_class))

    def _on_change(self) -> None:
        self._keep_one_alternative()
        problem = ""
        try:
            self.model()
        except InputError as error:
            # A form without any entries is not an error yet.
            problem = "" if self.is_empty else str(error)
        self._problem.show_text(problem)
        self.changed.emit()

    def _keep_one_alternative(self) -> None:
        editors = [self.editors[name] for name in _ALTERNATIVES if name in self.editors]
        checked = [editor for editor in editors if editor.checked]
        if len(checked) == 2:
            unchecked = checked[0] if self.sender() is checked[1] else checked[1]
            with QSignalBlocker(unchecked):
                unchecked.set_value(None)


def kinds_of(models: Mapping[str, Any]) -> Kinds:
    """Return the kinds of a `ModelPicker` from model classes with titles."""
    return {name: (model.title, model) for name, model in models.items()}


class ModelPicker(QtWidgets.QWidget):
    """A choice between kinds, each with its form or widget below, or with none."""

    changed = Signal()

    def __init__(self, label: str, kinds: Kinds, tip: str = "") -> None:
        super().__init__()
        self._kinds = dict(kinds)
        self._rows = {kind: row for kind, (_, row) in kinds.items() if isinstance(row, QWidget)}
        self._forms: dict[str, ModelForm] = {}
        self.choice = SteadyComboBox({key: title for key, (title, _) in kinds.items()}, tip)
        qt.column(self, labelled(label, self.choice), *self._rows.values())
        self.choice.currentIndexChanged.connect(self._on_choice)
        self._on_choice()

    @property
    def kind(self) -> str:
        return str(self.choice.currentData())

    def set_kind(self, kind: str) -> None:
        """Select a kind; ignore an unknown one."""
        index = self.choice.findData(kind)
        if index >= 0:
            self.choice.setCurrentIndex(index)

    @property
    def form(self) -> ModelForm | None:
        return self._forms.get(self.kind)

    def model(self) -> BaseModel | None:
        """Return the validated model of the selected kind; None without a form."""
        return None if self.form is None else self.form.model()

    def state(self) -> dict[str, Any]:
        values = {kind: form.values() for kind, form in self._forms.items()}
        return {"kind": self.kind, "values": values}

    def restore(self, state: Mapping[str, Any]) -> None:
        for kind, values in state.get("values", {}).items():
            form = self._form_of(kind) if kind in self._kinds else None
            if form is not None:
                form.set_values(values)
        self.set_kind(str(state.get("kind", self.kind)))

    def _on_choice(self) -> None:
        self._form_of(self.kind)
        for kind, widget in (*self._rows.items(), *self._forms.items()):
            widget.setVisible(kind == self.kind)
        self.changed.emit()

    def _form_of(self, kind: str) -> ModelForm | None:
        _, model_class = self._kinds[kind]
        if isinstance(model_class, type) and kind not in self._forms:
            form = ModelForm(model_class)
            form.layout().setContentsMargins(INDENT, 0, 0, 0)
            form.setVisible(False)
            form.changed.connect(self.changed)
            self._forms[kind] = form
            self.layout().addWidget(form)
        return self._forms.get(kind)


def save_text(text: str, name: str | Path, suffix: str) -> Path:
    """Write a file; a name without a suffix gets one, and then replaces no file."""
    entered = Path(name)
    path = entered if entered.suffix else entered.with_suffix(suffix)
    with replacing(path, overwrite=path == entered) as unfinished:
        unfinished.write_text(text, encoding="utf-8")
    return path


class TomlButtons(QtWidgets.QWidget):
    """Buttons for TOML files; `load` gets entries and path, `values` returns entries to save."""

    def __init__(
        self,
        subject: str,
        values: Callable[[], dict[str, object]],
        load: Callable[[dict[str, object], str], None],
    ) -> None:
        super().__init__()
        self._subject, self._values, self._load_values = subject, values, load
        tip = f"Write {subject} to a TOML file, for use here or on the command line."
        self.load_button = qt.push_button(
            f"Load {subject}…", f"Read {subject} from a TOML file.", self._load
        )
        self.save_button = qt.push_button("Save…", tip, self._save)
        qt.side_by_side((self.load_button, 0), (self.save_button, 0), (QWidget(), 1), holder=self)

    @qt.notify_errors
    def _load(self) -> None:
        path, _ = QtWidgets.QFileDialog.getOpenFileName(self, f"Load {self._subject}", "", TOML)
        if path:
            self._load_values(read_toml(path), path)

    @qt.notify_errors
    def _save(self) -> None:
        values = self._values()
        if not values:
            raise InputError(f"there is no {self._subject} to save: select one first")
        path, _ = QtWidgets.QFileDialog.getSaveFileName(
            self, f"Save {self._subject}", f"{self._subject}.toml", TOML
        )
        if path:
            save_text(tomli_w.dumps(values), path, ".toml")


class StepForm(QWidget):
    """A step: a line with its name, which folds its form, and buttons to move or remove it."""

    changed = Signal()

    def __init__(self, kind: type[Step], move: Callable[..., None]) -> None:
        super().__init__()
        self.kind = kind
        self.form = ModelForm(kind)
        self.form.layout().setContentsMargins(INDENT, 0, 0, 0)
        self.title = qt.small_button(
            "", "Show or hide the parameters.", lambda: self.fold(not self.form.isHidden())
        )
        self.title.setToolButtonStyle(Qt.ToolButtonStyle.ToolButtonTextBesideIcon)
        self.title.setSizePolicy(QSizePolicy.Policy.Ignored, QSizePolicy.Policy.Fixed)
        self.up = qt.small_button("↑", "Move this step up.", lambda: move(self, -1))
        self.down = qt.small_button("↓", "Move this step down.", lambda: move(self, 1))
        self.remove = qt.small_button("✕", "Remove this step.", lambda: move(self, None))
        for button in (self.title, self.up, self.down, self.remove):
            button.setAutoRaise(True)
        line = qt.side_by_side((self.title, 1), (self.up, 0), (self.down, 0), (self.remove, 0))
        line.layout().setSpacing(0)
        qt.column(self, line, self.form)
        self.form.changed.connect(self._show_title)
        self.form.changed.connect(self.changed)
        self.fold(False)

    def fold(self, folded: bool = True) -> None:
        self.form.setVisible(not folded)
        self.title.setArrowType(Qt.ArrowType.RightArrow if folded else Qt.ArrowType.DownArrow)
        self._show_title()

    def _show_title(self) -> None:
        """Show the step's name; with a folded form also its parameters."""
        title = self.kind.title
        if self.form.isHidden():
            try:
                title = self.form.model().summary  # type: ignore[attr-defined]
            except InputError:
                self.form.setVisible(True)  # it shows the problem
        self.title.setText(title)


class StepsSection(QWidget):
    """A folded list of steps under a title with their names."""

    changed = Signal()

    def __init__(self, kinds: Mapping[str, type[Step]] = STEPS) -> None:
        super().__init__()
        self._kinds = kinds
        self.forms: list[StepForm] = []
        self.choice = SteadyComboBox(
            {None: "add a step…", **{name: kind.title for name, kind in kinds.items()}},
            "Processing of image, source and masks before the inversion or fit.",
        )
        self._list = QWidget()
        qt.column(self._list)
        self.folded = titled_section(self._list, labelled("", self.choice))
        self._earlier = WrappingLabel(style=PROBLEM_STYLE)
        qt.column(self, self.folded, self._earlier)
        self.choice.activated.connect(self._on_choice)
        self._on_change()

    def steps(self) -> tuple[Step, ...]:
        """Return the validated steps, or raise an `InputError`."""
        return tuple(form.form.model() for form in self.forms)  # type: ignore[misc]

    def add(self, name: str, values: Mapping[str, Any] | None = None) -> StepForm:
        """Append a step by name, with its defaults or other values."""
        step_form = StepForm(STEPS[name], self._move)
        if values is not None:
            step_form.form.set_values(values)
        step_form.changed.connect(self._on_change)
        self.forms.append(step_form)
        self._list.layout().addWidget(step_form)
        self._on_change()
        return step_form

    def show_steps(self, steps: Sequence[Step]) -> None:
        """Replace the steps by others, folded."""
        self._show([step.model_dump() for step in steps])

    def state(self) -> list[dict[str, Any]]:
        return [form.form.values() for form in self.forms]

    def restore(self, state: Any) -> None:
        """Show the steps of a saved state, and say that they are of an earlier image."""
        self._show(state)
        names = ", ".join(form.kind.title for form in self.forms)
        text = f"Kept from an earlier image: {names}. Remove what does not suit this one."
        self._earlier.show_text(text if names else "")

    def _show(self, state: Any) -> None:
        """Show steps from their values; ignore unknown steps."""
        with QSignalBlocker(self):
            for form in list(self.forms):
                self._move(form, None)
            for values in state:
                if isinstance(values, Mapping) and values.get("step") in self._kinds:
                    self.add(str(values["step"]), values).fold()
        self._on_change()

    def _on_choice(self, index: int) -> None:
        if index > 0:
            self.add(str(self.choice.itemData(index)))
        self.choice.setCurrentIndex(0)

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
        self._earlier.show_text("")
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
