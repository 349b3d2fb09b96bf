"""The window that simulates an object before its shot: `Simulate`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from pydantic import Field, create_model
from qtpy.QtWidgets import QWidget

from napari_shadowinv._napari import form as forms
from napari_shadowinv._napari import layer_metadata as about
from napari_shadowinv._napari.jobs import Finished
from napari_shadowinv._napari.placement import source_on
from napari_shadowinv._napari.run import Run
from napari_shadowinv._napari.simulations import (
    ForwardJob,
    GridFile,
    InputField,
    PlanJob,
    SimulatedObject,
    input_field,
    is_field,
    may_be_field,
)
from napari_shadowinv._napari.viewer_sync import error_text
from napari_shadowinv._napari.widgets import _panels as panels
from napari_shadowinv._napari.widgets._files import IMAGE_FORMATS, Savable, SaveButton
from napari_shadowinv._napari.widgets._inputs import InstrumentForm, SetupPicker
from napari_shadowinv._napari.widgets._layers import LayerPicker, image_of
from napari_shadowinv._napari.widgets._qt import Plot, column, notify_errors
from napari_shadowinv._system.validation import CheckedModel, validate
from napari_shadowinv.errors import InputError
from napari_shadowinv.options import Instrument
from napari_shadowinv.physics.beam import numbers_in_unit
from napari_shadowinv.physics.phantom_models import PHANTOMS
from napari_shadowinv.physics.setup import Setup, deflector_titles
from napari_shadowinv.pipeline.experiment import SWEPT
from napari_shadowinv.pipeline.experiment_object import setups_of_text, shape_of_text
from napari_shadowinv.pipeline.experiment_options import ExperimentOptions
from napari_shadowinv.plotting import draw_errors

_IMAGE, _PLAN = "image", "plan"  # tasks
_GRID, _LAYER = "grid", "layer"  # objects that are no phantoms
_NOTHING = ""  # of the quantities
_SIZE = " x ".join(map(str, ForwardJob.shape))
_PLOT_HEIGHT_PX = 260


class Simulate(panels.ToolPanel):
    """Choose an object; predict its image, or plan an experiment with it."""

    def __init__(self, napari_viewer: Any) -> None:
        tip = "Trace the beam through the object, or invert shots with random imperfections."
        super().__init__(napari_viewer, "simulate", Run("Simulate", "Run", tip))
        self._predicted: Any = None  # layers of the last image; plans have others
        self._build_object()
        self._build_task()
        self.warning = forms.WrappingLabel(style=forms.PROBLEM_STYLE)
        self.verdict, self.report = panels.VerdictLine(), panels.ReportView()
        self.plot = Plot(_PLOT_HEIGHT_PX, fixed=True)
        self.save_result = SaveButton(
            self,
            self._image_to_save,
            "Save the predicted image with its pixel size (.tif, .npy or .png).",
        )
        self.add(self.object, self._size_row, self.setup, self.task, self.keep_earlier)
        self.add(self.panel, self.warning, self.verdict, self.save_result, self.plot, self.report)
        self._connect()
        self.restore_last()
        self._ready = True
        self._on_change()

    def _build_object(self) -> None:
        self.potential = LayerPicker(
            self.viewer,
            "<qt>The field or potential of a result, or a potential in px² from a file; for a "
            "stack, the shot in view.</qt>",
            suits=may_be_field,
        )
        self.interpretation = forms.WrappingLabel()
        layer = QWidget()
        column(layer, forms.labelled("Layer", self.potential), self.interpretation)
        self.object = forms.ModelPicker(
            "Object",
            {
                **forms.kinds_of(PHANTOMS),
                _GRID: ("a 3-D field from a file", GridFile),
                _LAYER: ("a result or potential", layer),
            },
            "Object that deflects the beam.",
        )
        tip = "Height and width of an image in px, such as 200 x 200."
        self.side = forms.SavedLine(_SIZE, tip)
        self._size_row = forms.labelled("Size (px)", self.side)
        self.setup = SetupPicker()

    def _build_task(self) -> None:
        tip = "Image layer of the undisturbed beam."
        self.source = LayerPicker(self.viewer, tip, "uniform", about.may_be_source)
        self.deflector = forms.SteadyComboBox(
            {None: "default for the beam", **{name: name for name in deflector_titles().values()}},
            "Field that deflects the beam. Used only to predict the object's image in another "
            "experiment, when the setup differs from the result's setup.",
        )
        self._deflector_row = forms.labelled("Deflected by", self.deflector)
        image, plan = QWidget(), QWidget()
        column(image, forms.labelled("Source", self.source), self._deflector_row)
        self.energies = forms.SavedLine(
            "14.7, 30",
            "Energies of several images of a shot in MeV (of light: wavelengths in m), separated "
            "by commas. Empty: one image with the setup's.",
        )
        self.instrument, self.options = InstrumentForm(), forms.ModelForm(ExperimentOptions)
        self.quantity = forms.ModelPicker(
            "Vary",
            {_NOTHING: ("nothing", None), **{key: _values_of(key) for key in SWEPT}},
            "Quantity of the experiment that is varied.",
        )
        column(
            plan,
            forms.labelled("Energies", self.energies),
            forms.section("Instrument", self.instrument),
            forms.section("Simulated shots", self.options),
            self.quantity,
        )
        self.task = forms.ModelPicker(
            "Simulate",
            {_IMAGE: ("the image", image), _PLAN: ("shots, to plan an experiment", plan)},
            "The image that the object casts, or shots with random imperfections, whose fields are "
            "compared with the object.",
        )

    def _connect(self) -> None:
        self.object.choice.currentIndexChanged.connect(lambda _: self._on_object())
        self.potential.picked.connect(self._follow_layer)
        parts = (self.object, self.task, self.setup, self.instrument, self.options, self.quantity)
        for part in parts:
            part.changed.connect(self._on_change)
        for line in (self.side, self.energies):
            line.textChanged.connect(lambda _: self.keep())

    @notify_errors
    def start_from(self, layer: Any) -> None:
        """Select a field or potential, whose image is to be predicted."""
        if layer is None or not any(layer is offered for offered in self.potential.offered):
            name = "no layer" if layer is None else f"layer '{layer.name}'"
            raise InputError(
                f"{name} is selected: select the field or the potential of a result, or an image "
                "of a potential"
            )
        self.task.set_kind(_IMAGE)
        self.object.set_kind(_LAYER)
        self.potential.layer = layer

    def parts(self) -> dict[str, Any]:
        return {
            "task": self.task,
            "setup": self.setup,
            "object": self.object,
            "size": self.side,
            "energies": self.energies,
            "instrument": self.instrument,
            "options": self.options,
            "quantity": self.quantity,
        }

    def state(self) -> dict[str, Any]:
        return {**super().state(), "setup": {**self.setup.state(), "kind": self.setup.picker.kind}}

    def restore(self, state: Mapping[str, Any]) -> None:
        super().restore(state)
        if self.object.kind != _LAYER:
            self.setup.choose_kind(str(state.get("setup", {}).get("kind", "proton")))

    def request(self) -> ForwardJob | PlanJob:
        setup = self.setup.setup()
        target = self._object(setup)
        size = self.side.text().strip()
        shape = shape_of_text(size, "the size") if size else None
        if self.task.kind == _IMAGE:
            return self._image_job(target, setup, shape or ForwardJob.shape)
        key, sweep = self.quantity.kind, self.quantity.model()
        values: list[float] = []
        if sweep is not None:
            text = sweep.values  # type: ignore[attr-defined]
            values = numbers_in_unit(text, SWEPT[key].unit, "Values")
        instrument = validate(Instrument, self.instrument.state(), "instrument")
        options: Any = self.options.model()
        return PlanJob(
            object=target,
            setups=tuple(setups_of_text(setup, self.energies.text(), "the energies") or ()),
            shape=shape,
            instrument=instrument,
            options=options,
            quantity=key,
            values=tuple(values),
        )

    def _object(self, setup: Setup | None) -> SimulatedObject:
        """Return the phantom, the file or the layer's field, or raise an `InputError`."""
        if self.object.kind == _LAYER:
            return input_field(self.potential.layer, self.viewer.dims.point, setup)
        chosen: Any = self.object.model()
        return chosen

    def _image_job(
        self, target: SimulatedObject, setup: Setup | None, shape: tuple[int, int]
    ) -> ForwardJob:
        beam: Any = self.source.layer
        source = None if beam is None else image_of(beam)
        layer: Any = None
        if isinstance(target, InputField):
            layer, setup = self.potential.layer, setup or target.setup
            shape = layer.data.shape[-2:]
            source = None if source is None else source_on(beam, source, layer)
        elif source is not None:
            shape = source.shape
        # In another experiment the object may have other pixels.
        is_moved = layer is None or getattr(target, "setup", None) not in (None, setup)
        return ForwardJob(
            target,
            shape=shape,
            setup=setup,
            deflector=self.deflector.currentData(),
            source=source,
            name=f"{target.title} image",
            frame=about.frame_for(shape, setup) if is_moved else about.frame_of(layer),
            unit=about.unit_of(beam or {}),
            setup_origin=self.setup.origin,
            subject=target.title if layer is None else layer,
        )

    def _image_to_save(self) -> Savable:
        if self._predicted is None or not self._predicted.layers:
            raise InputError("there is no predicted image yet: press Run first")
        (layer,) = self._predicted.layers
        return Savable(layer.name, np.asarray(layer.data), IMAGE_FORMATS, about.setup_of(layer))

    def forget(self) -> None:
        self.warning.setVisible(False)
        self.verdict.show_text("")
        self.report.empty()
        self.plot.setVisible(False)

    def show_result(self, finished: Finished, job: ForwardJob | PlanJob) -> None:
        content = finished.content
        subject = job.subject if isinstance(job, ForwardJob) else job.quantity or _PLAN
        self.results = self._last.layers_for_next(subject)
        self.results.show(finished.layer_data)
        if isinstance(job, ForwardJob):
            self._predicted = self.results
            self.viewer.reset_view()
            self.warning.show_text(content.warning)
            return
        self.verdict.show_headline(content.headline)
        self.plot.show_drawing(lambda axes: draw_errors(axes[0], content, self.plot.ink))
        rows, details = (panels.fact_rows(content.facts, details=flag) for flag in (False, True))
        self.report.show_rows(rows, details)
        self.reveal(self.report)

    def _on_object(self) -> None:
        """Select the setup that the object requires, keeping its entries."""
        layer = self.potential.layer
        if self.object.kind == _LAYER and self._ready and (layer is None or not is_field(layer)):
            # Layers labelled as a field are preferred to unlabelled images.
            fields = list(filter(is_field, self.viewer.layers))
            if fields:
                self.potential.layer = fields[-1]
        self._follow_layer()
        phantom = PHANTOMS.get(self.object.kind)
        probe = "" if phantom is None else phantom.probe
        if self.object.kind == _GRID:
            probe = "proton"
        if self._ready and probe:
            self.setup.choose_kind(probe)

    def _follow_layer(self) -> None:
        """Show the setup of a layer's result, or the user's setup for an object."""
        is_layer = self.object.kind == _LAYER
        self.setup.follow(self.potential.layer if is_layer else None, store=False)
        if self._ready:
            self._on_change()

    def _on_change(self) -> None:
        kind, is_plan = self.object.kind, self.task.kind == _PLAN
        self.save_result.setVisible(not is_plan)
        self._size_row.setVisible(is_plan or kind != _LAYER)
        self._deflector_row.setVisible(kind == _LAYER)
        has_size = is_plan and kind not in PHANTOMS
        self.side.setPlaceholderText("that of the field" if has_size else _SIZE)
        if kind == _LAYER:
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


def _values_of(key: str) -> tuple[str, type[CheckedModel]]:
    """Return title and entries of a quantity that can be varied."""
    swept = SWEPT[key]
    unit = f", in {swept.unit} or with a unit" if swept.unit else ""
    tip = f"Values of the quantity, separated by commas{unit}."
    field: Any = Field(title="Values", description=tip)
    return swept.title, create_model(key, __base__=CheckedModel, values=(str, field))
