"""Forms made from pydantic models: there is no second list of fields and defaults."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Literal, get_args, get_origin

from pydantic import BaseModel
from qtpy import QtWidgets
from qtpy.QtCore import QSignalBlocker, Qt, Signal
from superqt import QCollapsible

from napari_shadowinv._napari.widgets._fields import (
    Editor,
    SteadyComboBox,
    editor_for,
    unit_of_title,
)
from napari_shadowinv._napari.widgets._qt import beside, column, notify_errors
from napari_shadowinv._system.validation import validated
from napari_shadowinv.errors import InputError

# For each key the title to show, and the model's class, if there is one.
Kinds = dict[str, tuple[str, type[BaseModel] | None]]

PROBLEM_STYLE = "color: #d9822b;"
_LABEL_WIDTH = 54
INDENT = 12
TOML = "TOML (*.toml)"
# Of these optional fields only one may be given: checking one unchecks the other.
_ALTERNATIVES = ("pixel_size", "detector_pixel_size")


def labelled(text: str, widget: QtWidgets.QWidget) -> QtWidgets.QWidget:
    """A widget with a label before it; all of them line up."""
    label = QtWidgets.QLabel(text)
    label.setMinimumWidth(_LABEL_WIDTH)
    return beside((label, 0), (widget, 1))


def with_button(
    widget: QtWidgets.QWidget, text: str, tip: str, action: Callable[[], Any]
) -> QtWidgets.QWidget:
    """A widget with a small button on its right."""
    return beside((widget, 1), (small_button(text, tip, action), 0))


def small_button(text: str, tip: str, action: Callable[[], Any]) -> QtWidgets.QToolButton:
    button = QtWidgets.QToolButton()
    button.setText(text)
    button.setToolTip(tip)
    button.clicked.connect(lambda: action())
    return button


def section(title: str, *widgets: QtWidgets.QWidget) -> QCollapsible:
    """Widgets under a title that folds them away; folded to begin with."""
    folded = QCollapsible(title, expandedIcon="▾", collapsedIcon="▸")
    folded.setDuration(0)
    folded.layout().setContentsMargins(0, 0, 0, 0)
    folded.layout().setSpacing(2)
    folded.content().layout().setContentsMargins(6, 2, 0, 4)
    for widget in widgets:
        folded.addWidget(widget)
    return folded


def titled_section(*widgets: QtWidgets.QWidget) -> QCollapsible:
    """A section whose title tells what is in it; a long one does not widen the window."""
    folded = section("", *widgets)
    policy = QtWidgets.QSizePolicy.Policy
    folded.toggleButton().setSizePolicy(policy.Ignored, policy.Fixed)
    return folded


def wrapping_label(text: str = "", style: str = "") -> QtWidgets.QLabel:
    """Text that wraps at the width there is, instead of asking for more."""
    label = QtWidgets.QLabel(text)
    label.setWordWrap(True)
    label.setMinimumWidth(0)
    label.setSizePolicy(QtWidgets.QSizePolicy.Policy.Ignored, QtWidgets.QSizePolicy.Policy.Minimum)
    label.setTextInteractionFlags(Qt.TextInteractionFlag.TextSelectableByMouse)
    label.setStyleSheet(style)
    label.setVisible(bool(text))
    return label


class PathEdit(QtWidgets.QWidget):
    changed = Signal()

    def __init__(self, title: str, example: str = "path of a file") -> None:
        super().__init__()
        self._title = title
        self.edit = QtWidgets.QLineEdit()
        self.edit.setPlaceholderText(example)
        self.edit.setMinimumWidth(60)
        beside((with_button(self.edit, "…", title, self._choose), 0), holder=self)
        self.edit.editingFinished.connect(self.changed)

    @property
    def path(self) -> str:
        return str(self.edit.text()).strip()

    def ask(self) -> str:
        """Let the user choose in a dialog; empty if he does not."""
        path, _ = QtWidgets.QFileDialog.getOpenFileName(self, self._title)
        return str(path)

    def _choose(self) -> None:
        path = self.ask()
        if path:
            self.edit.setText(path)
            self.changed.emit()


class ModelForm(QtWidgets.QWidget):
    """Editors for a model's fields; optional ones start with what `first` holds."""

    changed = Signal()

    def __init__(
        self, model_class: type[BaseModel], first: Mapping[str, Any] | None = None
    ) -> None:
        super().__init__()
        self._model_class = model_class
        self._fixed: dict[str, Any] = {}
        self.editors: dict[str, Editor] = {}
        rows = QtWidgets.QFormLayout()
        rows.setContentsMargins(0, 0, 0, 0)
        rows.setRowWrapPolicy(QtWidgets.QFormLayout.RowWrapPolicy.WrapLongRows)
        rows.setFieldGrowthPolicy(QtWidgets.QFormLayout.FieldGrowthPolicy.AllNonFixedFieldsGrow)
        rows.setLabelAlignment(Qt.AlignmentFlag.AlignLeft | Qt.AlignmentFlag.AlignVCenter)
        whole = column(self)
        whole.addLayout(rows)
        for name, field in model_class.model_fields.items():
            if get_origin(field.annotation) is Literal and len(get_args(field.annotation)) == 1:
                self._fixed[name] = get_args(field.annotation)[0]
                continue
            editor = editor_for(field, (first or {}).get(name))
            title = field.title or name
            label = QtWidgets.QLabel(unit_of_title(title)[0] if editor.shows_unit else title)
            for widget in (label, editor):
                # As rich text, so that Qt breaks it into lines.
                widget.setToolTip(f"<qt>{field.description}</qt>" if field.description else "")
            rows.addRow(label, editor)
            editor.changed.connect(self._on_change)
            self.editors[name] = editor
        self._problem = wrapping_label(style=PROBLEM_STYLE)
        whole.addWidget(self._problem)

    @property
    def is_empty(self) -> bool:
        """Whether nothing is filled in of what has no default."""
        fields = self._model_class.model_fields
        needed = [name for name in self.editors if fields[name].is_required()]
        return all(self.editors[name].value() in (None, "") for name in needed)

    @property
    def _is_blank(self) -> bool:
        fields = self._model_class.model_fields
        has_required = any(fields[name].is_required() for name in self.editors)
        return has_required and self.is_empty

    def values(self) -> dict[str, Any]:
        """What the form holds, as a TOML file does: what is not given is left out."""
        edited = {name: editor.value() for name, editor in self.editors.items()}
        return self._fixed | {name: value for name, value in edited.items() if value is not None}

    def set_values(self, values: Mapping[str, Any]) -> None:
        """Show other values; fields that are not among them go back to their defaults."""
        with QSignalBlocker(self):
            for name, editor in self.editors.items():
                field = self._model_class.model_fields[name]
                default = None if field.is_required() else field.get_default()
                value = values.get(name, default)
                if value is None and default is not None:
                    continue
                try:
                    editor.set_value(value)
                except (TypeError, ValueError, OverflowError):
                    # What an older version has kept may be of another kind by now.
                    editor.set_value(default)
        self._on_change()

    # What is kept between sessions
    state, restore = values, set_values

    def model(self) -> BaseModel:
        """The validated model, or an `InputError`."""
        name = self._model_class.__name__.removesuffix("Options").removesuffix("Setup").lower()
        return validated(self._model_class, self.values(), name)

    def _on_change(self) -> None:
        self._keep_one_alternative()
        try:
            self.model()
        except InputError as error:
            self._problem.setText(str(error))
            # A form in which nothing has been typed is no mistake yet, whatever its defaults.
            self._problem.setVisible(not self._is_blank)
        else:
            self._problem.setVisible(False)
        self.changed.emit()

    def _keep_one_alternative(self) -> None:
        editors = [self.editors[name] for name in _ALTERNATIVES if name in self.editors]
        given = [editor for editor in editors if editor.checked]
        if len(given) == 2:
            other = given[0] if self.sender() is given[1] else given[1]
            with QSignalBlocker(other):
                other.set_value(None)


def kinds_of(models: Mapping[str, Any], prefix: str = "") -> Kinds:
    """Kinds for a `ModelPicker`, from model classes that have a title."""
    return {name: (f"{prefix}{model.title}", model) for name, model in models.items()}


class ModelPicker(QtWidgets.QWidget):
    """A choice between kinds of things, each with a form of its own or with none."""

    changed = Signal()

    def __init__(self, label: str, kinds: Kinds) -> None:
        super().__init__()
        self._kinds = dict(kinds)
        self._forms: dict[str, ModelForm] = {}
        self.choice = SteadyComboBox()
        for key, (title, _) in self._kinds.items():
            self.choice.addItem(title, key)
        column(self, labelled(label, self.choice))
        self.choice.currentIndexChanged.connect(self._on_choice)
        self._on_choice()

    @property
    def kind(self) -> str:
        return str(self.choice.currentData())

    def set_kind(self, kind: str) -> None:
        """Choose a kind; an unknown one changes nothing."""
        index = self.choice.findData(kind)
        if index >= 0:
            self.choice.setCurrentIndex(index)

    @property
    def form(self) -> ModelForm | None:
        return self._forms.get(self.kind)

    def model(self) -> BaseModel | None:
        """The validated model of the chosen kind, None if it has none, or an `InputError`."""
        return None if self.form is None else self.form.model()

    def state(self) -> dict[str, Any]:
        values = {kind: form.values() for kind, form in self._forms.items()}
        return {"kind": self.kind, "values": values}

    def restore(self, state: Mapping[str, Any]) -> None:
        values = state.get("values", {})
        for kind, held in values.items() if isinstance(values, Mapping) else ():
            if kind in self._kinds and isinstance(held, Mapping):
                form = self._form_of(kind)
                if form is not None:
                    form.set_values(held)
        self.set_kind(str(state.get("kind", self.kind)))

    def _on_choice(self) -> None:
        chosen = self._form_of(self.kind)
        for form in self._forms.values():
            form.setVisible(form is chosen)
        self.changed.emit()

    def _form_of(self, kind: str) -> ModelForm | None:
        _, model_class = self._kinds[kind]
        if model_class is not None and kind not in self._forms:
            form = ModelForm(model_class)
            form.layout().setContentsMargins(INDENT, 0, 0, 0)
            form.setVisible(False)
            form.changed.connect(self.changed)
            self._forms[kind] = form
            self.layout().addWidget(form)
        return self._forms.get(kind)


class RowPicker(QtWidgets.QWidget):
    """A choice between kinds of things, some with a control of their own in a row below."""

    changed = Signal()

    def __init__(
        self, label: str, kinds: Kinds, tip: str, rows: Mapping[str, QtWidgets.QWidget]
    ) -> None:
        super().__init__()
        self.picker = ModelPicker(label, kinds)
        self.picker.choice.setToolTip(f"<qt>{tip}</qt>")
        self._rows = dict(rows)
        column(self, self.picker, *self._rows.values())
        self.picker.changed.connect(self._on_kind)
        self._on_kind()

    def _on_kind(self) -> None:
        for kind, row in self._rows.items():
            row.setVisible(kind == self.picker.kind)
        self.changed.emit()


def dump_toml(values: dict[str, object], path: str | Path) -> Path:
    import tomli_w

    return save_text(tomli_w.dumps(values), path, ".toml")


def save_text(text: str, name: str | Path, suffix: str) -> Path:
    """Write a file; a name without suffix gets one, which no dialog asked to replace."""
    from napari_shadowinv.io import replacing

    named = Path(name)
    path = named if named.suffix else named.with_suffix(suffix)
    with replacing(path, overwrite=path == named) as unfinished:
        unfinished.write_text(text, encoding="utf-8")
    return path


class TomlButtons(QtWidgets.QWidget):
    """Load and Save buttons; `take` gets the content of a file and its path, `values` gives it."""

    def __init__(
        self,
        what: str,
        values: Callable[[], dict[str, object]],
        take: Callable[[dict[str, object], str], None],
    ) -> None:
        super().__init__()
        self._what, self._values, self._take = what, values, take
        self.load_button = QtWidgets.QPushButton(f"Load {what}…")
        self.save_button = QtWidgets.QPushButton("Save…")
        self.load_button.setToolTip(f"Read {what} from a TOML file.")
        self.save_button.setToolTip(
            f"Write {what} to a TOML file, to reuse here or on the command line."
        )
        beside((self.load_button, 0), (self.save_button, 0), holder=self).layout().addStretch(1)
        self.load_button.clicked.connect(lambda: self._load())
        self.save_button.clicked.connect(lambda: self._save())

    @notify_errors
    def _load(self) -> None:
        from napari_shadowinv.io import read_toml

        path, _ = QtWidgets.QFileDialog.getOpenFileName(self, f"Load {self._what}", "", TOML)
        if path:
            self._take(read_toml(path), path)

    @notify_errors
    def _save(self) -> None:
        values = self._values()
        if not values:
            raise InputError(f"there is no {self._what} to save: choose one first")
        path, _ = QtWidgets.QFileDialog.getSaveFileName(
            self, f"Save {self._what}", f"{self._what}.toml", TOML
        )
        if path:
            dump_toml(values, path)
