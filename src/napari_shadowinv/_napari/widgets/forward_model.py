"""The widget that predicts the image of an object: `ForwardModel`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, get_args

import numpy as np
from numpy.typing import ArrayLike
from qtpy.QtWidgets import QLabel, QSpinBox

from napari_shadowinv._napari import layer_metadata as about
from napari_shadowinv._napari.frame import Frame, frame_for, frame_of
from napari_shadowinv._napari.widgets import _forms as forms
from napari_shadowinv._napari.widgets._editors import SteadyComboBox, parse_number
from napari_shadowinv._napari.widgets._inputs import SetupPicker
from napari_shadowinv._napari.widgets._layers import LayerPicker, image_of, shown_plane
from napari_shadowinv._napari.widgets._panels import RunPanel, ToolPanel
from napari_shadowinv._napari.widgets._phantoms import PHANTOMS, ForwardJob, Prediction
from napari_shadowinv._napari.widgets._qt import error_text, side_by_side
from napari_shadowinv._napari.widgets._results import LastResults, ResultLayers
from napari_shadowinv._napari.widgets._saving import IMAGE_FORMATS, Savable, SaveButton
from napari_shadowinv._system.progress import OnProgress, ShouldStop
from napari_shadowinv.errors import InputError
from napari_shadowinv.physics.setup import SETUPS, Deflector
from napari_shadowinv.physics.units import intensity_limits

if TYPE_CHECKING:
    import napari
    from napari_shadowinv.physics.setup import Setup


_FIELDS = ("field", "field y", "field x")
_LAYER = "layer"
_MAX_SIDE_PX = 20_000


@dataclass(frozen=True, eq=False)
class InputField:
    """A potential or displacement whose image can be predicted."""

    values: ArrayLike  # (H, W), or (2, H, W) in px
    to_px2: float  # conversion factor of the potential to px²
    field_setup: Setup | None  # of its measurement, if the layer has it
    text: str  # the interpretation, in a sentence


def is_field(layer: Any) -> bool:
    """Whether a layer is labelled as a potential, or as the field of one result."""
    if about.role_of(layer) == "potential":
        return True
    return about.role_of(layer) in _FIELDS and about.result_of(layer) is not None


def may_be_field(layer: Any) -> bool:
    """Whether a layer is a field, or an image without a label."""
    is_unlabelled = about.may_be_shot(layer) and about.result_of(layer) is None
    return is_field(layer) or (is_unlabelled and not getattr(layer, "rgb", False))


def input_field(layer: Any | None, point: Any, setup: Any) -> InputField:
    """Return the field of a layer, or of its shot in view.

    `setup` converts a potential in m whose layer has no setup.
    """
    if layer is None:
        raise InputError(
            "there is no potential or result to start from: invert a shot (Plugins → Invert "
            "shot), open a .shadowinv file or an image of a potential in px² (File → Open), or "
            "select a simulated object"
        )
    result = about.result_of(layer)
    is_masked = about.role_of(layer) == "potential" and bool(np.isnan(layer.data).any())
    if result is not None and (about.role_of(layer) in _FIELDS or is_masked):
        displacement = np.asarray(about.displacement_of(layer))
        return InputField(displacement, 1.0, result.setup, "The displacement of this result.")
    potential = shown_plane(layer, point) if layer.ndim == 3 else image_of(layer, "potential")
    unit, layer_setup = about.unit_of(layer), about.setup_of(layer)
    if about.role_of(layer) != "potential":
        text = (
            "This image is not labelled as a potential. Its values are treated as a potential in "
            "px² of the object plane."
        )
        return InputField(potential, 1.0, layer_setup, text)
    if unit in ("", "px²"):
        return InputField(potential, 1.0, layer_setup, "A potential in px².")
    field_setup = layer_setup or setup
    if field_setup is None:
        raise InputError(
            f"'{layer.name}' is in {unit}: select the setup of its experiment, which is needed "
            "to convert it to pixels"
        )
    to_px2 = float(field_setup.normalized_potential(parse_number(f"1 {unit}", "m")))
    return InputField(potential, to_px2, field_setup, f"A potential in {unit}.")


@dataclass(frozen=True, eq=False)
class _Request:
    job: ForwardJob
    name: str
    frame: Frame
    setup_origin: str
    subject: Any  # a layer, or the name of an object

    def run(self, on_progress: OnProgress, should_stop: ShouldStop) -> Prediction:
        return self.job.run(on_progress, should_stop)


class ForwardModel(ToolPanel):
    """Choose an object or a potential, and predict its image."""

    def __init__(self, viewer: napari.viewer.Viewer) -> None:
        panel = RunPanel(
            "Forward model", "Simulate", "Trace the beam through the object and show the image."
        )
        super().__init__(viewer, "forward-model", panel)
        self.object = forms.ModelPicker(
            "Object", {**forms.kinds_of(PHANTOMS), _LAYER: ("a result or potential", None)}
        )
        self.object.choice.setToolTip("Object that deflects the beam.")
        self.potential = LayerPicker(
            viewer,
            ("image",),
            "<qt>The field or potential of a result, or a potential in px² from a file; for a "
            "stack, the shot in view.</qt>",
            suits=may_be_field,
        )
        self.interpretation = forms.wrapping_label()
        self.deflector = SteadyComboBox()
        self.deflector.addItem("default for the beam", None)
        for name in get_args(Deflector):
            self.deflector.addItem(name, name)
        self.deflector.setToolTip(
            "<qt>Field that deflects the beam. Used only to predict the object's image in another "
            "experiment, when the setup differs from the result's setup.</qt>"
        )
        self.height_px, self.width_px = _side("Height"), _side("Width")
        self.setup = SetupPicker()
        tip = "Image layer of the undisturbed beam."
        self.source = LayerPicker(viewer, ("image",), tip, "uniform", about.may_be_source)
        self.warning = forms.wrapping_label(style=forms.PROBLEM_STYLE)
        self.save_result = SaveButton(
            self,
            self._image_to_save,
            "Save the predicted image with its pixel size (.tif, .npy or .png).",
        )
        self.results: ResultLayers | None = None
        self._potential_rows = (
            forms.labelled("Layer", self.potential),
            self.interpretation,
            forms.labelled("Deflected by", self.deflector),
        )
        self._last = LastResults(viewer, self)
        size = side_by_side((self.width_px, 1), (QLabel("×"), 0), (self.height_px, 1))
        self._size_row = forms.labelled("Size", size)
        self.add(self.object, *self._potential_rows, self._size_row, self.setup)
        self.add(forms.labelled("Source", self.source), self._last.keep_earlier)
        self.add(self.panel, self.warning, self.save_result)
        self.object.choice.currentIndexChanged.connect(lambda _: self._on_object())
        self.object.changed.connect(self._on_change)
        self.potential.picked.connect(self._follow_potential)
        self.setup.changed.connect(self._on_change)
        for side in (self.height_px, self.width_px):
            side.valueChanged.connect(lambda _: self.keep())
        self.restore_last()
        self._ready = True
        self._on_change()

    def state(self) -> dict[str, Any]:
        return {
            "object": self.object.state(),
            "setup": {**self.setup.state(), "kind": self.setup.picker.kind},
            "size": [self.height_px.value(), self.width_px.value()],
        }

    def restore(self, state: Any) -> None:
        self.setup.restore(state.get("setup", {}))
        self.object.restore(state.get("object", {}))
        if self.object.kind != _LAYER:
            self._choose_setup(str(state.get("setup", {}).get("kind", "proton")))
        size = state.get("size", [200, 200])
        self.height_px.setValue(int(size[0]))
        self.width_px.setValue(int(size[1]))

    def request(self) -> _Request:
        setup = self.setup.setup()
        source = None if self.source.layer is None else image_of(self.source.layer)
        if self.object.kind == _LAYER:
            layer: Any = self.potential.layer
            field = input_field(layer, self.viewer.dims.point, setup)
            job = ForwardJob(
                field.values,
                to_px2=field.to_px2,
                setup=setup or field.field_setup,
                field_setup=field.field_setup,
                deflector=self.deflector.currentData(),
                source=source,
            )
            name = str(about.metadata_of(layer).get("name") or layer.name)
            return _Request(job, f"{name} image", frame_of(layer), self.setup.origin, layer)
        recipe: Any = self.object.model()
        shape = (self.height_px.value(), self.width_px.value())
        if source is not None:
            shape = source.shape
        job = ForwardJob(recipe, shape=shape, setup=setup, source=source)
        name = type(recipe).title
        frame = frame_for(shape, setup)
        return _Request(job, f"{name} image", frame, self.setup.origin, name)

    def _image_to_save(self) -> Savable:
        layers = [] if self.results is None else self.results.layers
        if not layers:
            raise InputError("there is no predicted image yet: press Simulate first")
        (layer,) = layers
        return Savable(layer.name, np.asarray(layer.data), IMAGE_FORMATS, about.setup_of(layer))

    def forget(self) -> None:
        self.warning.setVisible(False)

    def _on_object(self) -> None:
        """Select the kind of setup that an object requires, keeping its entries."""
        if self.object.kind == _LAYER and self._ready:
            self._select_field()
        self._follow_potential()
        recipe = PHANTOMS.get(self.object.kind)
        if recipe is None or not recipe.probe or not self._ready:
            return
        self._choose_setup(recipe.probe)

    def _choose_setup(self, kind: str) -> None:
        """Show the user's setup of a kind, or else the paper's."""
        self.setup.picker.set_kind(kind)
        form = self.setup.picker.form
        if form is not None and form.is_empty:
            example = SETUPS[kind].example()
            self.setup.suggest(example, "example from the paper")

    def _follow_potential(self) -> None:
        """Show the setup of a potential's result, or the user's setup for an object."""
        layer = self.potential.layer if self.object.kind == _LAYER else None
        self.setup.follow(layer, store=False)
        if self._ready:
            self._on_change()

    def _select_field(self) -> None:
        """Prefer layers labelled as a field to unlabelled images."""
        layer = self.potential.layer
        if layer is None or not is_field(layer):
            fields = list(filter(is_field, self.viewer.layers))
            if fields:
                self.potential.layer = fields[-1]

    def _on_change(self) -> None:
        is_layer = self.object.kind == _LAYER
        for row in self._potential_rows:
            row.setVisible(is_layer)
        self._size_row.setVisible(not is_layer)
        if is_layer:
            self._show_interpretation()
        self.keep()

    def _show_interpretation(self) -> None:
        layer = self.potential.layer
        try:
            field = input_field(layer, self.viewer.dims.point, self.setup.setup())
        except InputError as error:
            self.interpretation.setText(error_text(error))
            # Nothing to choose from yet is no mistake.
            self.interpretation.setStyleSheet("" if layer is None else forms.PROBLEM_STYLE)
            return
        self.interpretation.setText(field.text)
        is_unlabelled = not is_field(layer)
        self.interpretation.setStyleSheet(forms.PROBLEM_STYLE if is_unlabelled else "")

    def show_result(self, value: Prediction, request: _Request) -> None:
        unit = "" if request.job.source is None else about.unit_of(self.source.layer or {})
        # An inversion of the image uses this source.
        inputs: dict[str, Any] = {} if value.source is None else {"source": value.source}
        # In another experiment the object may have other pixels.
        frame, field_setup = request.frame, request.job.field_setup
        if field_setup is not None and field_setup != request.job.setup:
            frame = frame_for(value.image.shape, request.job.setup)
        if request.setup_origin:
            inputs["setup_origin"] = f"{about.CAME_WITH} the forward model, {request.setup_origin}"
        keywords = {
            "name": request.name,
            "metadata": about.metadata_for(about.SHOT, unit, request.job.setup, **inputs),
            "contrast_limits": intensity_limits(value.image),
            **frame.keywords(),
        }
        self.results = self._last.layers_for_next(request.subject)
        self.results.show([(value.image, keywords, "image")])
        self.viewer.reset_view()
        self.warning.setText(value.warning)
        self.warning.setVisible(bool(value.warning))


def _side(name: str) -> QSpinBox:
    side = QSpinBox()
    side.setRange(4, _MAX_SIDE_PX)
    side.setSuffix(" px")
    side.setToolTip(f"{name} of the image in px.")
    return side
