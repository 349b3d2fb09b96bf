"""The preprocessing steps of a shot, in their order: `StepsSection`."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from qtpy.QtCore import QSignalBlocker, Qt, Signal
from qtpy.QtWidgets import QSizePolicy, QWidget

from napari_shadowinv._napari.widgets import _forms as forms
from napari_shadowinv._napari.widgets._editors import SteadyComboBox
from napari_shadowinv._napari.widgets._qt import column, side_by_side
from napari_shadowinv.errors import InputError
from napari_shadowinv.preprocessing import STEPS, Step


class StepForm(QWidget):
    """A step: a line with its name, which folds its form, and buttons to move or remove it."""

    changed = Signal()

    def __init__(self, kind: type[Step], move: Callable[..., None]) -> None:
        super().__init__()
        self.kind = kind
        self.form = forms.ModelForm(kind)
        self.form.layout().setContentsMargins(forms.INDENT, 0, 0, 0)
        self.title = forms.small_button("", "Show or hide the parameters.", self._unfold_or_fold)
        self.title.setToolButtonStyle(Qt.ToolButtonStyle.ToolButtonTextBesideIcon)
        self.title.setSizePolicy(QSizePolicy.Policy.Ignored, QSizePolicy.Policy.Fixed)
        self.up = forms.small_button("↑", "Move this step up.", lambda: move(self, -1))
        self.down = forms.small_button("↓", "Move this step down.", lambda: move(self, 1))
        self.remove = forms.small_button("✕", "Remove this step.", lambda: move(self, None))
        for button in (self.title, self.up, self.down, self.remove):
            button.setAutoRaise(True)
        line = side_by_side((self.title, 1), (self.up, 0), (self.down, 0), (self.remove, 0))
        line.layout().setSpacing(0)
        column(self, line, self.form)
        self.form.changed.connect(self._on_change)
        self.fold(False)

    def fold(self, folded: bool = True) -> None:
        self.form.setVisible(not folded)
        self.title.setArrowType(Qt.ArrowType.RightArrow if folded else Qt.ArrowType.DownArrow)
        self._show_title()

    def _unfold_or_fold(self) -> None:
        self.fold(not self.form.isHidden())

    def _on_change(self) -> None:
        self._show_title()
        self.changed.emit()

    def _show_title(self) -> None:
        """Show the step's name; with a folded form also its parameters."""
        title = self.kind.title
        if self.form.isHidden():
            try:
                title = self.form.model().described  # type: ignore[attr-defined]
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
        self.choice = SteadyComboBox()
        self.choice.addItem("add a step…")
        for name, kind in kinds.items():
            self.choice.addItem(kind.title, name)
        self.choice.setToolTip(
            "<qt>Processing of image, source and masks before the inversion or fit.</qt>"
        )
        self._list = QWidget()
        column(self._list)
        self.folded = forms.titled_section(self._list, forms.labelled("", self.choice))
        column(self, self.folded)
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
        self.restore([step.model_dump() for step in steps])

    def state(self) -> list[dict[str, Any]]:
        return [form.form.values() for form in self.forms]

    def restore(self, state: Any) -> None:
        """Show the steps of a saved state; ignore unknown steps."""
        with QSignalBlocker(self):
            for form in list(self.forms):
                self._move(form, None)
            for values in state if isinstance(state, list) else ():
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
