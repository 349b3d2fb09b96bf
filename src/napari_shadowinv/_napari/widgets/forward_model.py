"""The widget that predicts the image of an object: `ForwardModel`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from qtpy.QtWidgets import QLabel, QSpinBox

from napari_shadowinv._napari import form as forms
from napari_shadowinv._napari import layer_metadata as about
from napari_shadowinv._napari.jobs import Finished, Job
from napari_shadowinv._napari.layers import LayerData
from napari_shadowinv._napari.placement import source_on
from napari_shadowinv._napari.run import Run
from napari_shadowinv._napari.shots import shot_layer
from napari_shadowinv._napari.viewer_sync import error_text
from napari_shadowinv._napari.widgets._files import IMAGE_FORMATS, Savable, SaveButton
from napari_shadowinv._napari.widgets._layers import LayerPicker, image_of, shown_plane
from napari_shadowinv._napari.widgets._objects import GRID, LAYER, GridFile, ObjectPanel
from napari_shadowinv._napari.widgets._qt import notify_errors, side_by_side
from napari_shadowinv._system.progress import OnProgress, Reporter, ShouldStop
from napari_shadowinv._typing import BoolArray, FloatArray
from napari_shadowinv.errors import InputError
from napari_shadowinv.facts import Level, percent
from napari_shadowinv.options import InversionOptions
from napari_shadowinv.physics.beam import displacement_from_potential, number_in_unit
from napari_shadowinv.physics.forward import jacobian_determinant, synthetic_image
from napari_shadowinv.physics.phantom_models import PhantomRecipe
from napari_shadowinv.physics.projection import default_deflector, transferred_displacement
from napari_shadowinv.physics.setup import Setup, deflector_titles
from napari_shadowinv.physics.trace_options import SizedView
from napari_shadowinv.physics.units import intensity_limits
from napari_shadowinv.pipeline.inversion_run import plane_of
from napari_shadowinv.pipeline.traced_file import trace_file


@dataclass(frozen=True, eq=False)
class Prediction:
    """The image that an object casts, with its displacement and source."""

    image: FloatArray  # in the unit of the source
    displacement: FloatArray  # px
    source: FloatArray | None  # the beam past opaque parts of the object; None if uniform
    caustic_share: float  # of the pixels: rays cross or nearly cross there
    flux_inside: float  # share of the flux that lands inside the image
    assumption: str = ""  # about the deflecting field, for another setup than the field's

    @property
    def warning(self) -> str:
        """Warnings about caustics, lost flux and assumptions; empty without any."""
        texts = [self.assumption] if self.assumption else []
        if self.caustic_share > 0:
            texts.append(
                f"Caustics: rays cross or nearly cross in {percent(self.caustic_share)} of the "
                "pixels. Once rays cross, one image no longer determines the whole field."
            )
        if self.flux_inside < 0.99:
            texts.append(f"Only {percent(self.flux_inside)} of the flux lands inside the image.")
        return " ".join(texts)


@dataclass(frozen=True, eq=False)
class ForwardJob(Job):
    """A prediction of the image of a potential, a displacement in px, or a simulated object."""

    field: ArrayLike | PhantomRecipe | GridFile
    shape: tuple[int, int] = (200, 200)  # of a simulated object's image
    to_px2: float = 1.0  # conversion factor of the potential to px²
    setup: Setup | None = None
    field_setup: Setup | None = None  # of the field's measurement
    deflector: str | None = None
    source: ArrayLike | None = None  # None for a uniform beam
    name: str = ""  # of the image
    frame: about.Frame = about.Frame()  # noqa: RUF009
    unit: str = ""  # of the source
    setup_origin: str = ""
    subject: Any = None  # the layer of the field, or the name of an object

    def run(self, on_progress: OnProgress, should_stop: ShouldStop) -> Prediction:
        Reporter(on_progress, should_stop)("field", 0, None)
        keywords: dict[str, Any] = {"on_progress": on_progress, "should_stop": should_stop}
        if isinstance(self.field, GridFile):
            source, shadow = self._source(self.shape)
            height, width = self.shape
            view = SizedView(**dict(self.field.view), height=height, width=width)
            keywords |= {"view": view, "source": source}
            traced = trace_file(Path(self.field.path), self.setup, **keywords)
            image, displacement = traced.image, np.nan_to_num(traced.displacement)
            flux = traced.source.sum()
            doubts = [fact.text for fact in traced.facts if fact.level is not Level.SOUND]
            assumption = " ".join(f"{text[0].upper()}{text[1:]}." for text in doubts)
        else:
            displacement, assumption = self._transfer(self._displacement())
            source, shadow = self._source(displacement.shape[1:])
            image = synthetic_image(displacement, source, **keywords)
            flux = image.size if source is None else source.sum()
        caustic = jacobian_determinant(displacement) < InversionOptions().caustic_jacobian
        if shadow is not None:
            caustic &= ~shadow
        flux_inside = float(image.sum() / flux) if flux else 1.0
        share = float(caustic.mean())
        return Prediction(image, displacement, source, share, flux_inside, assumption)

    def layers(self, content: Prediction) -> LayerData:
        origin = f"{about.CAME_WITH} the forward model, {self.setup_origin}"
        # In another experiment the object may have other pixels.
        frame = self.frame
        if self.field_setup is not None and self.field_setup != self.setup:
            frame = about.frame_for(content.image.shape, self.setup)
        layer = shot_layer(
            content.image,
            self.name,
            self.setup,
            intensity_limits(content.image),
            frame=frame,
            unit=self.unit,
            source=content.source,  # for an inversion of the image
            setup_origin=origin if self.setup_origin else None,
        )
        return [layer]

    def _source(self, shape: tuple[int, ...]) -> tuple[FloatArray | None, BoolArray | None]:
        """Return the beam that passes the object, and where the object stops it."""
        source = None if self.source is None else plane_of(self.source, "the source")
        if not isinstance(self.field, PhantomRecipe):
            return source, None
        shadow = self.field.shadow(self.shape, self.setup)
        if shadow is None:
            return source, None
        return np.where(shadow, 0.0, np.ones(shape) if source is None else source), shadow

    def _transfer(self, displacement: FloatArray) -> tuple[FloatArray, str]:
        """Return the displacement in the chosen setup, and the assumption behind it."""
        field_setup, setup = self.field_setup, self.setup
        if field_setup is None or setup is None or field_setup == setup:
            return displacement, ""
        deflector = self.deflector or default_deflector(field_setup, setup)
        shape: Any = None if self.source is None else np.shape(self.source)
        moved = transferred_displacement(
            displacement, field_setup, setup, deflector=deflector, shape=shape
        )
        text = f"Converted to another setup, assuming that only a {deflector} deflects the beam."
        return moved, text

    def _displacement(self) -> FloatArray:
        if isinstance(self.field, PhantomRecipe):
            return self.field.phantom(self.shape, self.setup).displacement
        values: Any = self.field
        if np.ndim(values) == 3:
            return np.asarray(values, dtype=np.float64)
        return displacement_from_potential(self.to_px2 * plane_of(values, "the potential"))


_FIELDS = ("field", "field y", "field x")
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
            "there is no potential or result to start from: invert a shot (Plugins → Shadowinv → "
            "Invert shot), open a .shadowinv file or an image of a potential in px² (File → Open), "
            "or select a simulated object"
        )
    result = about.result_of(layer)
    is_masked = about.role_of(layer) == "potential" and bool(np.isnan(layer.data).any())
    if result is not None and (about.role_of(layer) in _FIELDS or is_masked):
        displacement = np.asarray(about.displacement_of(layer))
        return InputField(displacement, 1.0, result.setup, "The displacement of this result.")
    potential = shown_plane(layer, point) if layer.ndim == 3 else image_of(layer, "potential")
    unit, layer_setup = about.unit_of(layer), about.setup_of(layer)
    if about.role_of(layer) != "potential":
        _refuse_counts(potential, layer.name)
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
    to_px2 = float(field_setup.normalized_potential(number_in_unit(f"1 {unit}", "m")))
    return InputField(potential, to_px2, field_setup, f"A potential in {unit}.")


def _refuse_counts(potential: ArrayLike, name: str) -> None:
    """Refuse whole numbers from zero on, which a detector counts and no potential has."""
    values = np.asarray(potential)
    if values.any() and values.min() >= 0 and np.array_equal(values, np.round(values)):
        raise InputError(
            f"'{name}' has whole numbers from {values.min():g} to {values.max():g}, as a detector "
            "counts, expected a potential in px²: invert the image first (Plugins → Shadowinv → "
            "Invert shot), or choose a layer of a result"
        )


class ForwardModel(ObjectPanel):
    """Choose an object or a potential, and predict its image."""

    def __init__(self, napari_viewer: Any) -> None:
        panel = Run(
            "Forward model", "Simulate", "Trace the beam through the object and show the image."
        )
        super().__init__(napari_viewer, "forward-model", panel, "a result or potential")
        self.potential = LayerPicker(
            self.viewer,
            "<qt>The field or potential of a result, or a potential in px² from a file; for a "
            "stack, the shot in view.</qt>",
            suits=may_be_field,
        )
        self.interpretation = forms.WrappingLabel()
        self.deflector = forms.SteadyComboBox(
            {None: "default for the beam", **{name: name for name in deflector_titles().values()}},
            "Field that deflects the beam. Used only to predict the object's image in another "
            "experiment, when the setup differs from the result's setup.",
        )
        self.height_px, self.width_px = (
            QSpinBox(minimum=4, maximum=_MAX_SIDE_PX, toolTip=f"{side} of the image in px.")
            for side in ("Height", "Width")
        )
        tip = "Image layer of the undisturbed beam."
        self.source = LayerPicker(self.viewer, tip, "uniform", about.may_be_source)
        self.warning = forms.WrappingLabel(style=forms.PROBLEM_STYLE)
        self.save_result = SaveButton(
            self,
            self._image_to_save,
            "Save the predicted image with its pixel size (.tif, .npy or .png).",
        )
        self._potential_rows = (
            forms.labelled("Layer", self.potential),
            self.interpretation,
            forms.labelled("Deflected by", self.deflector),
        )
        size = side_by_side((self.width_px, 1), (QLabel("×"), 0), (self.height_px, 1))
        self._size_row = forms.labelled("Size (px)", size)
        self.add(self.object, self.file_row, *self._potential_rows, self._size_row, self.setup)
        self.add(forms.labelled("Source", self.source), self.keep_earlier)
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

    @notify_errors
    def start_from(self, layer: Any) -> None:
        """Select a field or potential, whose image is to be predicted."""
        if layer is None or not any(layer is offered for offered in self.potential.offered):
            name = "no layer" if layer is None else f"layer '{layer.name}'"
            raise InputError(
                f"{name} is selected: select the field or the potential of a result, or an image "
                "of a potential"
            )
        self.object.set_kind(LAYER)
        self.potential.layer = layer

    def state(self) -> dict[str, Any]:
        return {**super().state(), "size": [self.height_px.value(), self.width_px.value()]}

    def restore(self, state: Any) -> None:
        super().restore(state)
        if self.object.kind != LAYER:
            self.setup.choose_kind(str(state.get("setup", {}).get("kind", "proton")))
        size = state.get("size", [200, 200])
        self.height_px.setValue(int(size[0]))
        self.width_px.setValue(int(size[1]))

    def request(self) -> ForwardJob:
        setup = self.setup.setup()
        source = None if self.source.layer is None else image_of(self.source.layer)
        unit = about.unit_of(self.source.layer or {})
        common: dict[str, Any] = {"source": source, "unit": unit, "setup_origin": self.setup.origin}
        if self.object.kind == LAYER:
            layer: Any = self.potential.layer
            field = input_field(layer, self.viewer.dims.point, setup)
            if source is not None:
                common["source"] = source_on(self.source.layer, source, layer)
            return ForwardJob(
                field.values,
                to_px2=field.to_px2,
                setup=setup or field.field_setup,
                field_setup=field.field_setup,
                deflector=self.deflector.currentData(),
                name=f"{about.metadata_of(layer).get('name') or layer.name} image",
                frame=about.frame_of(layer),
                subject=layer,
                **common,
            )
        simulated = self.simulated_object()
        shape = (self.height_px.value(), self.width_px.value())
        if source is not None:
            shape = source.shape
        return ForwardJob(
            simulated,
            shape=shape,
            setup=setup,
            name=f"{simulated.title} image",
            frame=about.frame_for(shape, setup),
            subject=simulated.title,
            **common,
        )

    def _image_to_save(self) -> Savable:
        if not self.results.layers:
            raise InputError("there is no predicted image yet: press Simulate first")
        (layer,) = self.results.layers
        return Savable(layer.name, np.asarray(layer.data), IMAGE_FORMATS, about.setup_of(layer))

    def forget(self) -> None:
        self.warning.setVisible(False)

    def _on_object(self) -> None:
        layer = self.potential.layer
        if self.object.kind == LAYER and self._ready and (layer is None or not is_field(layer)):
            # Layers labelled as a field are preferred to unlabelled images.
            fields = list(filter(is_field, self.viewer.layers))
            if fields:
                self.potential.layer = fields[-1]
        self._follow_potential()
        self.choose_setup()

    def _follow_potential(self) -> None:
        """Show the setup of a potential's result, or the user's setup for an object."""
        is_layer = self.object.kind == LAYER
        self.setup.follow(self.potential.layer if is_layer else None, store=False)
        if self._ready:
            self._on_change()

    def _on_change(self) -> None:
        is_layer = self.object.kind == LAYER
        for row in self._potential_rows:
            row.setVisible(is_layer)
        self._size_row.setVisible(not is_layer)
        self.file_row.setVisible(self.object.kind == GRID)
        if is_layer:
            self._show_interpretation()
        self.keep()

    def _show_interpretation(self) -> None:
        layer = self.potential.layer
        try:
            field = input_field(layer, self.viewer.dims.point, self.setup.setup())
        except InputError as error:
            # Nothing to choose from yet is no mistake.
            style = "" if layer is None else forms.PROBLEM_STYLE
            self.interpretation.show_text(error_text(error), style)
            return
        self.interpretation.show_text(field.text, "" if is_field(layer) else forms.PROBLEM_STYLE)

    def show_result(self, finished: Finished, job: ForwardJob) -> None:
        self.results = self._last.layers_for_next(job.subject)
        self.results.show(finished.layer_data)
        self.viewer.reset_view()
        self.warning.show_text(finished.content.warning)
