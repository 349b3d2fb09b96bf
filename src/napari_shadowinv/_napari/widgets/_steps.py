"""The steps that are done to a shot first, in their order: `StepsSection`."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from qtpy.QtCore import QSignalBlocker, Qt, Signal
from qtpy.QtWidgets import QSizePolicy, QWidget

from napari_shadowinv._napari.widgets import _forms as forms
from napari_shadowinv._napari.widgets._fields import SteadyComboBox
from napari_shadowinv._napari.widgets._qt import beside, column
from napari_shadowinv.errors import InputError
from napari_shadowinv.preprocessing import STEPS, Step


class StepForm(QWidget):
    """One step: a line with its name, which folds its form, and buttons to move or remove it."""

    changed = Signal()

    def __init__(self, kind: type[Step], move: Callable[..., None]) -> None:
        super().__init__()
        self.kind = kind
        self.form = forms.ModelForm(kind)
        self.form.layout().setContentsMargins(forms.INDENT, 0, 0, 0)
        self.title = forms.small_button("", "Show or hide the parameters.", self._unfold_or_fold)
        self.title.setToolButtonStyle(Qt.ToolButtonStyle.ToolButtonTextBesideIcon)
        self.title.setSizePolicy(QSizePolicy.Policy.Ignored, QSizePolicy.Policy.Fixed)
        self.up = forms.small_button("↑", "Do this earlier.", lambda: move(self, -1))
        self.down = forms.small_button("↓", "Do this later.", lambda: move(self, 1))
        self.remove = forms.small_button("✕", "Leave this out.", lambda: move(self, None))
        for button in (self.title, self.up, self.down, self.remove):
            button.setAutoRaise(True)
        line = beside((self.title, 1), (self.up, 0), (self.down, 0), (self.remove, 0))
        line.layout().setSpacing(0)
        column(self, line, self.form)
        self.form.changed.connect(self._on_change)
        self.fold(False)

    def fold(self, away: bool = True) -> None:
        self.form.setVisible(not away)
        self.title.setArrowType(Qt.ArrowType.RightArrow if away else Qt.ArrowType.DownArrow)
        self._show_title()

    def _unfold_or_fold(self) -> None:
        self.fold(not self.form.isHidden())

    def _on_change(self) -> None:
        self._show_title()
        self.changed.emit()

    def _show_title(self) -> None:
        """Its name; without its form also its parameters."""
        title = self.kind.title
        if self.form.isHidden():
            try:
                title = self.form.model().described  # type: ignore[attr-defined]
            except InputError:
                self.form.setVisible(True)  # it tells what is wrong
        self.title.setText(title)


class StepsSection(QWidget):
    """A list of steps, folded away under a title that tells which."""

    changed = Signal()

    def __init__(self, kinds: Mapping[str, type[Step]] = STEPS) -> None:
        super().__init__()
        self._kinds = kinds
        self.forms: list[StepForm] = []
        self.choice = SteadyComboBox()
        self.choice.addItem("add a step…")
        for name, kind in kinds.items():
            self.choice.addItem(kind.title, name)
        self.choice.setToolTip("<qt>Done to image, source and masks before all else.</qt>")
        self._list = QWidget()
        column(self._list)
        self.folded = forms.titled_section(self._list, forms.labelled("", self.choice))
        column(self, self.folded)
        self.choice.activated.connect(self._on_choice)
        self._on_change()

    def steps(self) -> tuple[Step, ...]:
        """The validated steps, or an `InputError`."""
        return tuple(one.form.model() for one in self.forms)  # type: ignore[misc]

    def add(self, name: str, values: Mapping[str, Any] | None = None) -> StepForm:
        """Append a step of this name, with its defaults unless there are other values."""
        added = StepForm(STEPS[name], self._move)
        if values is not None:
            added.form.set_values(values)
        added.changed.connect(self._on_change)
        self.forms.append(added)
        self._list.layout().addWidget(added)
        self._on_change()
        return added

    def show_steps(self, steps: Sequence[Step]) -> None:
        """Show other steps instead, folded."""
        self.restore([step.model_dump() for step in steps])

    def state(self) -> list[dict[str, Any]]:
        return [one.form.values() for one in self.forms]

    def restore(self, state: Any) -> None:
        """Show the steps that `state` has returned; kinds that are not known any more are not."""
        with QSignalBlocker(self):
            for one in list(self.forms):
                self._move(one, None)
            for values in state if isinstance(state, list) else ():
                if isinstance(values, Mapping) and values.get("step") in self._kinds:
                    self.add(str(values["step"]), values).fold()
        self._on_change()

    def _on_choice(self, index: int) -> None:
        if index > 0:
            self.add(str(self.choice.itemData(index)))
        self.choice.setCurrentIndex(0)

    def _move(self, one: StepForm, by: int | None) -> None:
        """Do a step so many steps later; never, if None."""
        place = self.forms.index(one)
        self.forms.remove(one)
        self._list.layout().removeWidget(one)
        if by is None:
            one.setVisible(False)
            one.deleteLater()
            if not self.forms:
                self.folded.collapse(animate=False)
        else:
            self.forms.insert(place + by, one)
            self._list.layout().insertWidget(place + by, one)
        self._on_change()

    def _on_change(self) -> None:
        # A step must not work unseen in a folded section.
        names = ", ".join(one.kind.title for one in self.forms)
        title = f"Steps first: {names or 'nothing'}"
        if self.folded.text() != title:
            self.folded.setText(title)
            self.folded.setToolTip(title)
        for one in self.forms:
            one.up.setEnabled(one is not self.forms[0])
            one.down.setEnabled(one is not self.forms[-1])
        self.changed.emit()
