"""The widget that plans a shot: `ForwardModel`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, get_args

from qtpy.QtWidgets import QHBoxLayout, QLabel, QSpinBox, QWidget

from napari_shadowinv._napari.frame import Frame, frame_for, frame_of
from napari_shadowinv._napari.layer_metadata import CAME_WITH, SHOT, mark, may_be_source, unit_of
from napari_shadowinv._napari.layers import intensity_limits
from napari_shadowinv._napari.widgets._base import ToolPanel
from napari_shadowinv._napari.widgets._fields import SteadyComboBox
from napari_shadowinv._napari.widgets._forecast import ForwardJob
from napari_shadowinv._napari.widgets._forms import (
    PROBLEM_STYLE,
    ModelPicker,
    kinds_of,
    labelled,
    wrapping_label,
)
from napari_shadowinv._napari.widgets._known_fields import (
    is_surely_a_field,
    known_field,
    may_be_a_field,
)
from napari_shadowinv._napari.widgets._notifications import MISTAKES, error_text
from napari_shadowinv._napari.widgets._panels import RunPanel
from napari_shadowinv._napari.widgets._phantoms import PHANTOMS
from napari_shadowinv._napari.widgets._picking import LayerPicker
from napari_shadowinv._napari.widgets._reading import image_of
from napari_shadowinv._napari.widgets._results import LastResults, keep_earlier_box
from napari_shadowinv._napari.widgets._runner import Outcome
from napari_shadowinv._napari.widgets._setups import SetupPicker
from napari_shadowinv.errors import InputError
from napari_shadowinv.physics.setup import SETUPS, Deflector

if TYPE_CHECKING:
    import napari

__all__ = ["ForwardModel"]


_LAYER = "layer"
_LARGEST_SIDE = 20_000


@dataclass(frozen=True, eq=False)
class _Request:
    job: ForwardJob
    name: str
    frame: Frame
    setup_origin: str
    of: Any


class ForwardModel(ToolPanel):
    """Choose an object or a potential; see the image that it would make.

    Parameters
    ----------
    viewer : napari.viewer.Viewer
        The viewer to work in.
    """

    def __init__(self, viewer: napari.viewer.Viewer) -> None:
        super().__init__(viewer, "forward-model")
        self.object = ModelPicker(
            "Object", {**kinds_of(PHANTOMS), _LAYER: ("a result or potential", None)}
        )
        self.object.choice.setToolTip("Object that deflects the beam.")
        self.potential = LayerPicker(viewer, ("image",), suits=may_be_a_field)
        self.potential.setToolTip(
            "<qt>The field or potential of a result, or a potential in px² from a file; for a "
            "stack, the shot in view.</qt>"
        )
        self.expected = wrapping_label()
        self.deflector = SteadyComboBox()
        self.deflector.addItem("default for the beam", None)
        for name in get_args(Deflector):
            self.deflector.addItem(name, name)
        self.deflector.setToolTip(
            "<qt>What deflects the beam. This matters only if the setup differs from that of "
            "the result, to predict the same object's image in another experiment.</qt>"
        )
        self.height_px, self.width_px = _side("Height"), _side("Width")
        self.setup = SetupPicker()
        self.source = LayerPicker(viewer, ("image",), none="uniform", suits=may_be_source)
        self.source.setToolTip("Image layer of the undisturbed beam.")
        self.panel = RunPanel("Forward model", "Simulate", "Trace the beam through the object.")
        self.warning = wrapping_label(style=PROBLEM_STYLE)
        self._potential_rows = (
            labelled("Layer", self.potential),
            self.expected,
            labelled("Bent by", self.deflector),
        )
        self.keep_earlier = keep_earlier_box()
        self._last = LastResults(viewer, self)
        self._size_row = labelled("Size", _size(self.width_px, self.height_px))
        for row in (
            self.object,
            *self._potential_rows,
            self._size_row,
            self.setup,
            labelled("Source", self.source),
            self.keep_earlier,
            self.panel,
            self.warning,
        ):
            self.column.addWidget(row)
        self.object.choice.currentIndexChanged.connect(lambda _: self._on_object())
        self.object.changed.connect(self._on_change)
        self.potential.picked.connect(self._follow_potential)
        self.setup.changed.connect(self._on_change)
        for side in (self.height_px, self.width_px):
            side.valueChanged.connect(lambda _: self.keep())
        self.panel.button.clicked.connect(lambda: self._run_or_cancel())
        self.panel.runner.ended.connect(self._on_end)
        self.restore(self._keeper.load())
        self._ready = True
        self._on_change()

    def state(self) -> dict[str, Any]:
        return {
            "object": self.object.state(),
            "setup": {**self.setup.state(), "kind": self.setup.picker.kind},
            "size": [self.height_px.value(), self.width_px.value()],
        }

    def restore(self, kept: Any) -> None:
        """Show what `state` has returned."""
        self.setup.restore(kept.get("setup", {}))
        self.object.restore(kept.get("object", {}))
        if self.object.kind != _LAYER:
            self._choose_setup(str(kept.get("setup", {}).get("kind", "proton")))
        size = kept.get("size", [200, 200])
        self.height_px.setValue(int(size[0]))
        self.width_px.setValue(int(size[1]))

    def request(self) -> _Request:
        """What the controls ask for.

        Raises
        ------
        InputError
            If there is no potential, or anything else that cannot be used.
        """
        setup = self.setup.setup()
        source = None if self.source.layer is None else image_of(self.source.layer)
        if self.object.kind == _LAYER:
            layer: Any = self.potential.layer
            known = known_field(layer, self.viewer.dims.point, setup)
            job = ForwardJob(
                known.values,
                to_px2=known.to_px2,
                setup=setup or known.made_with,
                made_with=known.made_with,
                deflector=self.deflector.currentData(),
                source=source,
            )
            # The unit in the name of a field is not that of the image.
            name = layer.name.removesuffix(f" ({unit_of(layer)})")
            return _Request(job, f"{name} image", frame_of(layer), self.setup.origin, layer)
        recipe: Any = self.object.model()
        shape = (self.height_px.value(), self.width_px.value())
        if source is not None:
            shape = source.shape
        job = ForwardJob(recipe, shape=shape, setup=setup, source=source)
        name = type(recipe).title
        frame = frame_for(shape, setup)
        return _Request(job, f"{name} image", frame, self.setup.origin, name)

    def _run_or_cancel(self) -> None:
        if self.panel.runner.running:
            self.panel.cancel()
            return
        self.warning.setVisible(False)
        try:
            request = self.request()
        except MISTAKES as error:
            self.panel.refuse(error)
            return
        self.panel.run(request.job.run, request)

    def _on_object(self) -> None:
        """Choose the beam that an object needs; one that is filled in already stays."""
        if self.object.kind == _LAYER and self._ready:
            self._prefer_a_field()
        self._follow_potential()
        recipe = PHANTOMS.get(self.object.kind)
        if recipe is None or not recipe.probe or not self._ready:
            return
        self._choose_setup(recipe.probe)

    def _choose_setup(self, kind: str) -> None:
        """Show the user's own setup of a kind, or else the paper's."""
        self.setup.picker.set_kind(kind)
        form = self.setup.picker.form
        if form is not None and form.is_empty:
            self.setup.suggest(SETUPS[kind].example(), "the paper's beam")

    def _follow_potential(self) -> None:
        """A potential has the setup of its result; a phantom that of the user."""
        layer = self.potential.layer if self.object.kind == _LAYER else None
        self.setup.follow(layer, keep=False)
        if self._ready:
            self._on_change()

    def _prefer_a_field(self) -> None:
        """Choose what is known to be a field before what only may be one."""
        chosen = self.potential.layer
        if chosen is None or not is_surely_a_field(chosen):
            sure = [layer for layer in self.viewer.layers if is_surely_a_field(layer)]
            if sure:
                self.potential.layer = sure[-1]

    def _on_change(self) -> None:
        a_layer = self.object.kind == _LAYER
        for row in self._potential_rows:
            row.setVisible(a_layer)
        self._size_row.setVisible(not a_layer)
        if a_layer:
            self._tell_what_is_expected()
        self.keep()

    def _tell_what_is_expected(self) -> None:
        try:
            layer = self.potential.layer
            known = known_field(layer, self.viewer.dims.point, self.setup.setup())
        except InputError as error:
            self.expected.setText(error_text(error))
            self.expected.setStyleSheet(PROBLEM_STYLE)
            return
        self.expected.setText(known.text)
        unsure = not is_surely_a_field(layer)
        self.expected.setStyleSheet(PROBLEM_STYLE if unsure else "")

    def _on_end(self, outcome: Outcome) -> None:
        if outcome.value is None:
            return
        forecast, request = outcome.value, outcome.tag
        unit = "" if request.job.source is None else unit_of(self.source.layer or {})
        # Whoever inverts the image finds its source.
        came_with = {} if forecast.source is None else {"source": forecast.source}
        # In another experiment the same object may be seen with other pixels.
        frame, made_with = request.frame, request.job.made_with
        if made_with is not None and made_with != request.job.setup:
            frame = frame_for(forecast.image.shape, request.job.setup)
        if request.setup_origin:
            came_with["setup_origin"] = f"{CAME_WITH} the forward model, {request.setup_origin}"
        keywords = {
            "name": request.name,
            "metadata": mark(SHOT, unit, request.job.setup, **came_with),
            "contrast_limits": intensity_limits(forecast.image),
            **frame.keywords(),
        }
        shown = self._last.next_of(request.of, keep=self.keep_earlier.isChecked())
        shown.show([(forecast.image, keywords, "image")])
        self.viewer.reset_view()
        self.warning.setText(forecast.warning)
        self.warning.setVisible(bool(forecast.warning))


def _side(what: str) -> QSpinBox:
    side = QSpinBox()
    side.setRange(4, _LARGEST_SIDE)
    side.setSuffix(" px")
    side.setToolTip(f"{what} of the image in px.")
    return side


def _size(width: QSpinBox, height: QSpinBox) -> QWidget:
    holder = QWidget()
    row = QHBoxLayout(holder)
    row.setContentsMargins(0, 0, 0, 0)
    row.addWidget(width, 1)
    row.addWidget(QLabel("×"))
    row.addWidget(height, 1)
    return holder
