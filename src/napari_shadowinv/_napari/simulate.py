"""The window that simulates an object before its shot: `Simulate`.

The object is a phantom, or the field of a layer.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
from qtpy.QtWidgets import QWidget

from napari_shadowinv._napari import form as forms
from napari_shadowinv._napari import layer_metadata as about
from napari_shadowinv._napari.jobs import Finished, Job, name_of_result
from napari_shadowinv._napari.layers import LayerData
from napari_shadowinv._napari.run import Run
from napari_shadowinv._napari.shots import shot_layer
from napari_shadowinv._napari.widgets import _panels as panels
from napari_shadowinv._napari.widgets._inputs import InstrumentForm, SetupPicker
from napari_shadowinv._napari.widgets._layers import LayerPicker
from napari_shadowinv._napari.widgets._qt import Plot, column
from napari_shadowinv._system.validation import validate
from napari_shadowinv.errors import InputError
from napari_shadowinv.options import Instrument
from napari_shadowinv.physics.phantom_models import PHANTOMS, PhantomRecipe
from napari_shadowinv.physics.setup import Setup
from napari_shadowinv.physics.units import intensity_limits
from napari_shadowinv.pipeline.experiment import plan_experiment
from napari_shadowinv.pipeline.experiment_object import (
    PlannedObject,
    object_of_displacement,
    setups_of_text,
    shape_of_text,
)
from napari_shadowinv.pipeline.experiment_options import ExperimentOptions
from napari_shadowinv.pipeline.experiment_result import ExperimentPlan
from napari_shadowinv.pipeline.prediction import Prediction, predict
from napari_shadowinv.plotting import draw_errors

_IMAGE, _PLAN = "image", "plan"  # tasks
_LAYER = "layer"  # an object that is no phantom
_SHAPE = 200, 200
_SIZE = " x ".join(map(str, _SHAPE))
_PLOT_HEIGHT_PX = 260
_FIELDS = ("field", "field y", "field x", "potential")  # roles


SimulatedObject = PhantomRecipe | PlannedObject


def is_field(layer: Any) -> bool:
    """Whether a layer shows the field or the potential of one result."""
    return about.role_of(layer) in _FIELDS and about.displacement_of(layer) is not None


def _planned_image(plan: ExperimentPlan, name: str) -> LayerData:
    """Describe the image of the first draw."""
    setup, image = plan.setups[0] if plan.setups else None, plan.images[0]
    return [shot_layer(image, name, setup, intensity_limits(image), unit="counts")]


class Simulate(panels.ToolPanel):
    """Choose an object; predict its image, or plan an experiment with it."""

    def __init__(self, napari_viewer: Any) -> None:
        tip = "Trace the beam through the object, or invert shots with random imperfections."
        super().__init__(napari_viewer, Run("Run", tip))
        self._build_object()
        self._build_task()
        self.warning = forms.WrappingLabel(style=forms.PROBLEM_STYLE)
        self.verdict, self.report = panels.VerdictLine(), panels.ReportView()
        self.plot = Plot(_PLOT_HEIGHT_PX, fixed=True)
        self.add(self.object, self._size_row, self.setup, self.task, self.keep_earlier)
        self.add(self.panel, self.warning, self.verdict, self.plot, self.report)
        self._connect()
        self.setup.choose_kind("proton")
        self._ready = True
        self._on_change()

    def _build_object(self) -> None:
        tip = "<qt>The field or the potential of a result, from a run or a .shadowinv file.</qt>"
        self.field = LayerPicker(self.viewer, tip, suits=is_field)
        self.object = forms.ModelPicker(
            "Object",
            {
                **forms.kinds_of(PHANTOMS),
                _LAYER: ("a result", forms.labelled("Layer", self.field)),
            },
            "Object that deflects the beam.",
        )
        tip = "Height and width of an image in px, such as 200 x 200."
        self.side = forms.text_line(_SIZE, tip)
        self._size_row = forms.labelled("Size (px)", self.side)
        self.setup = SetupPicker("simulate")

    def _build_task(self) -> None:
        self.energies = forms.text_line(
            "14.7, 30",
            "Energies of several images of a shot in MeV (of light: wavelengths in m), separated "
            "by commas. Empty: one image with the setup's.",
        )
        self.instrument, self.options = InstrumentForm(), forms.ModelForm(ExperimentOptions)
        plan = QWidget()
        column(
            plan,
            forms.labelled("Energies", self.energies),
            forms.section("Instrument", self.instrument),
            forms.section("Simulated shots", self.options),
        )
        self.task = forms.ModelPicker(
            "Simulate",
            {_IMAGE: ("the image", None), _PLAN: ("shots, to plan an experiment", plan)},
            "The image that the object casts, or shots with random imperfections, whose fields are "
            "compared with the object.",
        )

    def _connect(self) -> None:
        self.object.picked.connect(self._on_object)
        self.field.picked.connect(self._follow_layer)
        parts = (self.object, self.task, self.setup, self.instrument, self.options)
        for part in parts:
            part.changed.connect(self._on_change)
        for line in (self.side, self.energies):
            line.textChanged.connect(lambda _: self._on_change())

    def request(self) -> Job:
        setup = self.setup.setup()
        target = self._object()
        size = self.side.text().strip()
        shape = shape_of_text(size, "'Size (px)'") if size else None
        if self.task.kind == _IMAGE:
            return self._image_job(target, setup, shape or _SHAPE)
        choices: Any = {
            "setups": setups_of_text(setup, self.energies.text(), "'Energies'"),
            "shape": shape,
            "instrument": validate(Instrument, self.instrument.state(), "instrument"),
            "options": self.options.model(),
        }
        describe = partial(_planned_image, name=f"{target.title}, planned")
        return Job(partial(plan_experiment, target, **choices), describe, _PLAN)

    def _object(self) -> SimulatedObject:
        """Return the phantom or the layer's field, or raise an `InputError`."""
        if self.object.kind != _LAYER:
            chosen: Any = self.object.model()
            return chosen
        layer: Any = self.field.layer
        result = None if layer is None else about.result_of(layer)
        if result is None:
            raise InputError(
                "there is no result to start from: invert a shot (Plugins → Shadowinv → Invert), "
                "open a .shadowinv file (File → Open), or select a simulated object"
            )
        return object_of_displacement(
            np.asarray(about.displacement_of(layer), dtype=np.float64),
            result.content.setup,
            deflector=about.metadata_of(layer).get("cause"),  # of a field of a fit
            title=name_of_result(layer),
        )

    def _image_job(
        self, target: SimulatedObject, setup: Setup | None, shape: tuple[int, int]
    ) -> Job:
        layer: Any = None
        if isinstance(target, PlannedObject):
            layer, setup = self.field.layer, setup or target.setup
            shape = layer.data.shape[-2:]
        # In another experiment the object may have other pixels.
        is_moved = layer is None or getattr(target, "setup", None) not in (None, setup)
        origin = f"{about.CAME_WITH} the forward model, {self.setup.origin}"
        facts: Any = {
            "frame": about.frame_for(shape, setup) if is_moved else about.frame_of(layer),
            "unit": "",
            "setup_origin": origin if self.setup.origin else None,
        }

        def describe(content: Prediction) -> LayerData:
            image, name = content.image, f"{target.title} image"
            more = facts | {"source": content.source}  # for an inversion of the image
            return [shot_layer(image, name, setup, intensity_limits(image), **more)]

        compute = partial(predict, target, setup, shape)
        return Job(compute, describe, target.title if layer is None else layer)

    def forget(self) -> None:
        self.warning.setVisible(False)
        self.verdict.show_text("")
        self.report.empty()
        self.plot.setVisible(False)

    def show_result(self, finished: Finished, job: Job) -> None:
        content = finished.content
        self.results = self.results_for(job.subject)
        self.results.show(finished.layer_data)
        if isinstance(content, Prediction):
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
        self._follow_layer()
        phantom = PHANTOMS.get(self.object.kind)
        probe = "" if phantom is None else phantom.probe
        if self._ready and probe:
            self.setup.choose_kind(probe)

    def _follow_layer(self) -> None:
        """Show the setup of a layer's result, or the user's setup for an object."""
        is_layer = self.object.kind == _LAYER
        self.setup.follow(self.field.layer if is_layer else None, store=False)
        if self._ready:
            self._on_change()

    def _on_change(self) -> None:
        if not self.panel.running:
            self.panel.say("")  # an error of other choices
        kind, is_plan = self.object.kind, self.task.kind == _PLAN
        self._size_row.setVisible(is_plan or kind != _LAYER)
        has_size = is_plan and kind not in PHANTOMS
        self.side.setPlaceholderText("that of the field" if has_size else _SIZE)
