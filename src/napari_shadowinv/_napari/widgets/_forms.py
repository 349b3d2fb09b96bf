"""A form made from a pydantic model: there is no second list of fields and defaults.

- edit a model: `ModelForm`
- edit one of several kinds of models: `ModelPicker`
- choose one of several kinds of things, with other controls: `RowPicker`
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Literal, get_args, get_origin

from pydantic import BaseModel
from qtpy.QtCore import QSignalBlocker, Qt, Signal
from qtpy.QtWidgets import QFormLayout, QHBoxLayout, QLabel, QSizePolicy, QVBoxLayout, QWidget

from napari_shadowinv._napari.widgets._fields import Editor, SteadyComboBox, editor_for
from napari_shadowinv._napari.widgets._quantities import unit_of_title
from napari_shadowinv._system.validation import validated
from napari_shadowinv.errors import InputError

__all__ = [
    "Kinds",
    "ModelForm",
    "ModelPicker",
    "RowPicker",
    "kinds_of",
    "labelled",
    "wrapping_label",
]

Kinds = dict[str, tuple[str, Callable[[], type[BaseModel]] | None]]

PROBLEM_STYLE = "color: #d9822b;"
_LABEL_WIDTH = 54
_INDENT = 12
# Of these optional fields only one may be given: checking one unchecks the other.
_ALTERNATIVES = ("pixel_size", "detector_pixel_size")


def labelled(text: str, widget: QWidget) -> QWidget:
    """A widget with a label before it; all of them line up."""
    holder = QWidget()
    row = QHBoxLayout(holder)
    row.setContentsMargins(0, 0, 0, 0)
    label = QLabel(text)
    label.setMinimumWidth(_LABEL_WIDTH)
    row.addWidget(label)
    row.addWidget(widget, 1)
    return holder


def wrapping_label(text: str = "", style: str = "") -> QLabel:
    """Text that wraps at the width there is, instead of asking for more."""
    label = QLabel(text)
    label.setWordWrap(True)
    label.setMinimumWidth(0)
    label.setSizePolicy(QSizePolicy.Policy.Ignored, QSizePolicy.Policy.Minimum)
    label.setTextInteractionFlags(Qt.TextInteractionFlag.TextSelectableByMouse)
    label.setStyleSheet(style)
    label.setVisible(bool(text))
    return label


class ModelForm(QWidget):
    """Editors for all fields of a model, with titles, units and descriptions from it.

    Parameters
    ----------
    model_class : type of pydantic.BaseModel
        Fields that leave no choice (a Literal of one value) are not shown.
    first : mapping of str to object, optional
        Values that optional fields start with when they are first checked.

    Signals
    -------
    changed
        A value changed.
    """

    changed = Signal()

    def __init__(
        self, model_class: type[BaseModel], first: Mapping[str, Any] | None = None
    ) -> None:
        super().__init__()
        self._model_class = model_class
        self._fixed: dict[str, Any] = {}
        self.editors: dict[str, Editor] = {}
        column = QVBoxLayout(self)
        column.setContentsMargins(0, 0, 0, 0)
        layout = QFormLayout()
        layout.setContentsMargins(0, 0, 0, 0)
        layout.setFieldGrowthPolicy(QFormLayout.FieldGrowthPolicy.AllNonFixedFieldsGrow)
        layout.setLabelAlignment(Qt.AlignmentFlag.AlignLeft | Qt.AlignmentFlag.AlignVCenter)
        column.addLayout(layout)
        for name, field in model_class.model_fields.items():
            if get_origin(field.annotation) is Literal and len(get_args(field.annotation)) == 1:
                self._fixed[name] = get_args(field.annotation)[0]
                continue
            editor = editor_for(field, (first or {}).get(name))
            title = field.title or name
            label = QLabel(unit_of_title(title)[0] if editor.shows_unit else title)
            for widget in (label, editor):
                widget.setToolTip(_tooltip(field.description))
            layout.addRow(label, editor)
            editor.changed.connect(self._on_change)
            self.editors[name] = editor
        self._problem = wrapping_label(style=PROBLEM_STYLE)
        column.addWidget(self._problem)

    @property
    def is_empty(self) -> bool:
        """Whether nothing is filled in of what has no default."""
        fields = self._model_class.model_fields
        needed = [name for name in self.editors if fields[name].is_required()]
        return all(self.editors[name].value() in (None, "") for name in needed)

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
                if value is not None or default is None:
                    _set_or_default(editor, value, default)
        self._on_change()

    def state(self) -> dict[str, Any]:
        """What is kept."""
        return self.values()

    def restore(self, state: Mapping[str, Any]) -> None:
        """Show what `state` has returned."""
        self.set_values(state)

    def model(self) -> BaseModel:
        """The validated model.

        Raises
        ------
        InputError
            If a value is missing or cannot be used.
        """
        return validated(self._model_class, self.values(), self._where())

    def _where(self) -> str:
        return self._model_class.__name__.removesuffix("Options").removesuffix("Setup").lower()

    def _on_change(self) -> None:
        self._keep_one_alternative()
        try:
            self.model()
        except InputError as error:
            self._problem.setText(str(error))
            # An empty form is no mistake yet.
            self._problem.setVisible(bool(self.values().keys() - self._fixed.keys()))
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

    def returning(model: type[BaseModel]) -> Callable[[], type[BaseModel]]:
        return lambda: model

    return {name: (f"{prefix}{model.title}", returning(model)) for name, model in models.items()}


def _set_or_default(editor: Editor, value: Any, default: Any) -> None:
    """What an older version has kept may be of another kind by now."""
    try:
        editor.set_value(value)
    except (TypeError, ValueError, OverflowError):
        editor.set_value(default)


def _tooltip(description: str | None) -> str:
    # As rich text, so that Qt breaks it into lines.
    return f"<qt>{description}</qt>" if description else ""


class ModelPicker(QWidget):
    """A choice between kinds of things, each with a form of its own or with none.

    Parameters
    ----------
    label : str
        What is chosen; shown before the choice.
    kinds : dict of str to (str, callable or None)
        For each key the title to show, and what returns the model's class: called only when
        the kind is chosen, because some classes take a second to import.

    Signals
    -------
    changed
        The kind or a value changed.
    """

    changed = Signal()

    def __init__(
        self,
        label: str,
        kinds: Kinds,
    ) -> None:
        super().__init__()
        self._kinds = dict(kinds)
        self._forms: dict[str, ModelForm] = {}
        self.choice = SteadyComboBox()
        for key, (title, _) in self._kinds.items():
            self.choice.addItem(title, key)
        column = QVBoxLayout(self)
        column.setContentsMargins(0, 0, 0, 0)
        column.addWidget(labelled(label, self.choice))
        self.choice.currentIndexChanged.connect(self._on_choice)
        self._on_choice()

    @property
    def kind(self) -> str:
        """The key of the chosen kind."""
        return str(self.choice.currentData())

    def set_kind(self, kind: str) -> None:
        """Choose a kind; an unknown one changes nothing."""
        index = self.choice.findData(kind)
        if index >= 0:
            self.choice.setCurrentIndex(index)

    @property
    def form(self) -> ModelForm | None:
        """The form of the chosen kind, if it has one."""
        return self._forms.get(self.kind)

    def model(self) -> BaseModel | None:
        """The validated model of the chosen kind, None if it has none.

        Raises
        ------
        InputError
            If a value is missing or cannot be used.
        """
        return None if self.form is None else self.form.model()

    def state(self) -> dict[str, Any]:
        """The choice and what all forms hold, to be kept."""
        values = {kind: form.values() for kind, form in self._forms.items()}
        return {"kind": self.kind, "values": values}

    def restore(self, state: Mapping[str, Any]) -> None:
        """Show what `state` has returned."""
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
            form = ModelForm(model_class())
            form.layout().setContentsMargins(_INDENT, 0, 0, 0)
            form.setVisible(False)
            form.changed.connect(self.changed)
            self._forms[kind] = form
            self.layout().addWidget(form)
        return self._forms.get(kind)


class RowPicker(QWidget):
    """A choice between kinds of things, some with a control of their own in a row below.

    Parameters
    ----------
    label, kinds
        See `ModelPicker`.
    tip : str
        Tooltip of the choice.
    rows : mapping of str to QWidget
        For some kinds, what is shown below while they are chosen.

    Signals
    -------
    changed
        The kind or a value changed; for the rows, their owner connects it.
    """

    changed = Signal()

    def __init__(self, label: str, kinds: Kinds, tip: str, rows: Mapping[str, QWidget]) -> None:
        super().__init__()
        self.picker = ModelPicker(label, kinds)
        self.picker.choice.setToolTip(f"<qt>{tip}</qt>")
        self._rows = dict(rows)
        column = QVBoxLayout(self)
        column.setContentsMargins(0, 0, 0, 0)
        for widget in (self.picker, *self._rows.values()):
            column.addWidget(widget)
        self.picker.changed.connect(self._on_kind)
        self._on_kind()

    def _on_kind(self) -> None:
        for kind, row in self._rows.items():
            row.setVisible(kind == self.picker.kind)
        self.changed.emit()
