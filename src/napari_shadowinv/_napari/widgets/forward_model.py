"""The widget that plans a shot: `ForwardModel`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from qtpy.QtWidgets import QHBoxLayout, QLabel, QSpinBox, QWidget

from napari_shadowinv._napari.frame import Frame, frame_for, frame_of
from napari_shadowinv._napari.marks import mark, unit_of
from napari_shadowinv._napari.widgets._base import ToolPanel
from napari_shadowinv._napari.widgets._forecast import ForwardJob
from napari_shadowinv._napari.widgets._forms import (
    PROBLEM_STYLE,
    ModelPicker,
    kinds_of,
    labelled,
    wrapping_label,
)
from napari_shadowinv._napari.widgets._messages import reporting
from napari_shadowinv._napari.widgets._panels import RunPanel
from napari_shadowinv._napari.widgets._phantoms import PHANTOMS
from napari_shadowinv._napari.widgets._picking import LayerPicker
from napari_shadowinv._napari.widgets._quantities import parsed
from napari_shadowinv._napari.widgets._reading import image_of
from napari_shadowinv._napari.widgets._results import ResultLayers
from napari_shadowinv._napari.widgets._runner import Outcome
from napari_shadowinv._napari.widgets._setups import SetupPicker
from napari_shadowinv.errors import InputError

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
            "Object", {**kinds_of(PHANTOMS), _LAYER: ("a potential layer", None)}
        )
        self.object.choice.setToolTip("What deflects the beam.")
        self.potential = LayerPicker(viewer, ("image",))
        self.potential.setToolTip(
            "<qt>A potential in px² or, with a setup, in m, such as an inversion makes.</qt>"
        )
        self.height_px, self.width_px = _side("Height"), _side("Width")
        self.setup = SetupPicker()
        self.source = LayerPicker(viewer, ("image",), none="uniform")
        self.source.setToolTip("Image layer of the undisturbed beam.")
        self.panel = RunPanel(
            "Forward model", "Make the image", "Trace the beam through the object."
        )
        self.warning = wrapping_label(style=PROBLEM_STYLE)
        self._potential_row = labelled("Layer", self.potential)
        self._size_row = labelled("Size", _size(self.width_px, self.height_px))
        for row in (
            self.object,
            self._potential_row,
            self._size_row,
            self.setup,
            labelled("Source", self.source),
            self.panel,
            self.warning,
        ):
            self.column.addWidget(row)
        self.object.choice.currentIndexChanged.connect(lambda _: self._on_object())
        self.object.changed.connect(self._on_change)
        self.setup.changed.connect(self.keep)
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
            "setup": self.setup.picker.state(),
            "size": [self.height_px.value(), self.width_px.value()],
        }

    def restore(self, kept: Any) -> None:
        """Show what `state` has returned."""
        if "setup" in kept:
            self.setup.picker.restore(kept["setup"])
        else:
            self.setup.show_setup(_usual_setup("proton").model_dump())
        self.object.restore(kept.get("object", {}))
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
            potential = image_of(layer, "potential")
            job = ForwardJob(potential, to_px2=_to_px2(layer, setup), setup=setup, source=source)
            return _Request(job, f"{layer.name} image", frame_of(layer))
        recipe: Any = self.object.model()
        shape = (self.height_px.value(), self.width_px.value())
        if source is not None:
            shape = source.shape
        job = ForwardJob(recipe, shape=shape, setup=setup, source=source)
        return _Request(job, f"{type(recipe).title} image", frame_for(shape, setup))

    @reporting
    def _run_or_cancel(self) -> None:
        if self.panel.runner.running:
            self.panel.cancel()
            return
        request = self.request()
        self.warning.setVisible(False)
        self.panel.run(request.job.run, request)

    def _on_object(self) -> None:
        """Choose the beam that an object needs; one that is filled in already stays."""
        recipe = PHANTOMS.get(self.object.kind)
        if recipe is None or not recipe.probe or not self._ready:
            return
        self.setup.picker.set_kind(recipe.probe)
        form = self.setup.picker.form
        if form is not None and form.is_empty:
            self.setup.show_setup(_usual_setup(recipe.probe).model_dump())

    def _on_change(self) -> None:
        a_layer = self.object.kind == _LAYER
        self._potential_row.setVisible(a_layer)
        self._size_row.setVisible(not a_layer)
        self.keep()

    def _on_end(self, outcome: Outcome) -> None:
        if outcome.value is None:
            return
        forecast, request = outcome.value, outcome.tag
        unit = "" if request.job.source is None else unit_of(self.source.layer or {})
        # Whoever inverts the image finds its source.
        came_with = {} if forecast.source is None else {"source": forecast.source}
        keywords = {
            "name": request.name,
            "metadata": mark("image", unit, request.job.setup, **came_with),
            **request.frame.keywords(),
        }
        ResultLayers(self.viewer, self).show([(forecast.image, keywords, "image")])
        self.viewer.reset_view()
        self.warning.setText(forecast.warning)
        self.warning.setVisible(bool(forecast.warning))


def _usual_setup(kind: str) -> Any:
    """The paper's beam of protons or of light."""
    from napari_shadowinv.physics.phantoms import paper_setup, wakefield_setup

    return paper_setup() if kind == "proton" else wakefield_setup()


def _to_px2(layer: Any, setup: Any) -> float:
    """Factor that brings a layer's potential to px²."""
    unit = unit_of(layer)
    if unit in ("", "px²"):
        return 1.0
    metres = parsed(f"1 {unit}", "m")
    if setup is None:
        raise InputError(
            f"'{layer.name}' is in {unit}: choose the setup of its experiment, which brings it to "
            "pixels"
        )
    return float(setup.normalized_potential(metres))


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
