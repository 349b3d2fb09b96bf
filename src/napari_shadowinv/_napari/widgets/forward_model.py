"""The widget that plans a shot: `ForwardModel`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, get_args

import numpy as np
from numpy.typing import ArrayLike
from qtpy.QtWidgets import QLabel, QSpinBox

from napari_shadowinv._napari import layer_metadata as about
from napari_shadowinv._napari.frame import Frame, frame_for, frame_of
from napari_shadowinv._napari.widgets import _forms as forms
from napari_shadowinv._napari.widgets._fields import SteadyComboBox, parsed
from napari_shadowinv._napari.widgets._forecast import PHANTOMS, Forecast, ForwardJob
from napari_shadowinv._napari.widgets._inputs import SetupPicker
from napari_shadowinv._napari.widgets._layers import LayerPicker, image_of, shown_plane
from napari_shadowinv._napari.widgets._panels import RunPanel, ToolPanel
from napari_shadowinv._napari.widgets._qt import beside, error_text
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
_LARGEST_SIDE = 20_000


@dataclass(frozen=True, eq=False)
class KnownField:
    """A potential or a displacement that an image can be predicted from."""

    values: ArrayLike  # (H, W), or (2, H, W) in px
    to_px2: float  # brings the potential to px²
    made_with: Setup | None  # its experiment, where the layer knows it
    text: str  # what it is taken for, in a sentence


def is_surely_a_field(layer: Any) -> bool:
    """Whether a layer is marked as a potential, or as the field of one result."""
    if about.role_of(layer) == "potential":
        return True
    return about.role_of(layer) in _FIELDS and about.result_of(layer) is not None


def may_be_a_field(layer: Any) -> bool:
    """Whether a layer is a field, or an image that does not tell what it is."""
    unknown = about.may_be_shot(layer) and about.result_of(layer) is None
    return is_surely_a_field(layer) or (unknown and not getattr(layer, "rgb", False))


def known_field(layer: Any | None, point: Any, setup: Any) -> KnownField:
    """What a layer, or its shot in view, holds; `setup` is for a potential in m without one."""
    if layer is None:
        raise InputError(
            "there is no potential or result to start from: invert a shot (Plugins → Invert "
            "shot), open a .shadowinv file or an image of a potential in px² (File → Open), or "
            "choose one of the simulated objects"
        )
    result = about.result_of(layer)
    is_masked = about.role_of(layer) == "potential" and bool(np.isnan(layer.data).any())
    if result is not None and (about.role_of(layer) in _FIELDS or is_masked):
        displacement = np.asarray(about.displacement_of(layer))
        return KnownField(displacement, 1.0, result.setup, "The displacement of this result.")
    potential = shown_plane(layer, point) if layer.ndim == 3 else image_of(layer, "potential")
    unit, own = about.unit_of(layer), about.setup_of(layer)
    if about.role_of(layer) != "potential":
        text = (
            "This image is not labelled as a potential: its values are treated as a potential "
            "in px² of the object plane."
        )
        return KnownField(potential, 1.0, own, text)
    if unit in ("", "px²"):
        return KnownField(potential, 1.0, own, "A potential in px².")
    made_with = own or setup
    if made_with is None:
        raise InputError(
            f"'{layer.name}' is in {unit}: choose the setup of its experiment, which is needed "
            "to convert it to pixels"
        )
    to_px2 = float(made_with.normalized_potential(parsed(f"1 {unit}", "m")))
    return KnownField(potential, to_px2, made_with, f"A potential in {unit}.")


@dataclass(frozen=True, eq=False)
class _Request:
    job: ForwardJob
    name: str
    frame: Frame
    setup_origin: str
    of: Any

    def run(self, on_progress: OnProgress, should_stop: ShouldStop) -> Forecast:
        return self.job.run(on_progress, should_stop)


class ForwardModel(ToolPanel):
    """Choose an object or a potential; see the image that it would make."""

    def __init__(self, viewer: napari.viewer.Viewer) -> None:
        panel = RunPanel("Forward model", "Simulate", "Trace the beam through the object.")
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
            suits=may_be_a_field,
        )
        self.expected = forms.wrapping_label()
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
        tip = "Image layer of the undisturbed beam."
        self.source = LayerPicker(viewer, ("image",), tip, "uniform", about.may_be_source)
        self.warning = forms.wrapping_label(style=forms.PROBLEM_STYLE)
        self.save_result = SaveButton(
            self,
            self._image_to_save,
            "Write the predicted image, with the size of its pixels (.tif, .npy or .png).",
        )
        self.results: ResultLayers | None = None
        self._potential_rows = (
            forms.labelled("Layer", self.potential),
            self.expected,
            forms.labelled("Bent by", self.deflector),
        )
        self._last = LastResults(viewer, self)
        size = beside((self.width_px, 1), (QLabel("×"), 0), (self.height_px, 1))
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

    def restore(self, kept: Any) -> None:
        self.setup.restore(kept.get("setup", {}))
        self.object.restore(kept.get("object", {}))
        if self.object.kind != _LAYER:
            self._choose_setup(str(kept.get("setup", {}).get("kind", "proton")))
        size = kept.get("size", [200, 200])
        self.height_px.setValue(int(size[0]))
        self.width_px.setValue(int(size[1]))

    def request(self) -> _Request:
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
            name = str(about.mark_of(layer).get("name") or layer.name)
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
            usual = SETUPS[kind].example()
            self.setup.suggest(usual, "the paper's beam")

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
            self.expected.setStyleSheet(forms.PROBLEM_STYLE)
            return
        self.expected.setText(known.text)
        unsure = not is_surely_a_field(layer)
        self.expected.setStyleSheet(forms.PROBLEM_STYLE if unsure else "")

    def show_result(self, value: Forecast, request: _Request) -> None:
        unit = "" if request.job.source is None else about.unit_of(self.source.layer or {})
        # So that an inversion of the image finds its source.
        came_with: dict[str, Any] = {} if value.source is None else {"source": value.source}
        # In another experiment the same object may be seen with other pixels.
        frame, made_with = request.frame, request.job.made_with
        if made_with is not None and made_with != request.job.setup:
            frame = frame_for(value.image.shape, request.job.setup)
        if request.setup_origin:
            came_with["setup_origin"] = (
                f"{about.CAME_WITH} the forward model, {request.setup_origin}"
            )
        keywords = {
            "name": request.name,
            "metadata": about.mark(about.SHOT, unit, request.job.setup, **came_with),
            "contrast_limits": intensity_limits(value.image),
            **frame.keywords(),
        }
        self.results = self._last.next_of(request.of)
        self.results.show([(value.image, keywords, "image")])
        self.viewer.reset_view()
        self.warning.setText(value.warning)
        self.warning.setVisible(bool(value.warning))


def _side(what: str) -> QSpinBox:
    side = QSpinBox()
    side.setRange(4, _LARGEST_SIDE)
    side.setSuffix(" px")
    side.setToolTip(f"{what} of the image in px.")
    return side
