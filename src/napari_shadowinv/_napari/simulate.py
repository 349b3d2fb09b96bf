"""The window that simulates an object before its shot: `Simulate`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

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
from napari_shadowinv._napari.widgets._inputs import ChoiceBox, InstrumentForm, SetupPicker
from napari_shadowinv._napari.widgets._layers import LayerPicker, image_of
from napari_shadowinv._napari.widgets._qt import COLOURS, Plot, notify_errors
from napari_shadowinv._system.validation import validate
from napari_shadowinv.errors import InputError
from napari_shadowinv.options import Instrument
from napari_shadowinv.physics.beam import number_in_unit
from napari_shadowinv.physics.phantom_models import PHANTOMS
from napari_shadowinv.physics.setup import Setup, deflector_titles
from napari_shadowinv.physics.trace_options import GridView
from napari_shadowinv.pipeline.experiment import SWEPT
from napari_shadowinv.pipeline.experiment_object import shape_of_text
from napari_shadowinv.pipeline.experiment_options import ExperimentOptions
from napari_shadowinv.pipeline.experiment_result import ExperimentPlan, ExperimentSweep

_IMAGE, _PLAN = "image", "plan"  # tasks
_GRID, _LAYER = "grid", "layer"  # objects that are no phantoms
_SHAPE = (200, 200)
_PLOT_HEIGHT_PX = 260
_LOG_RANGE = 8.0


class PlanPlot(Plot):
    """Errors of the draws of a plan, or the error over the quantity of a sweep."""

    def __init__(self) -> None:
        super().__init__(_PLOT_HEIGHT_PX)
        self.setFixedHeight(_PLOT_HEIGHT_PX)
        self.setVisible(False)

    def show_errors(self, content: ExperimentPlan | ExperimentSweep) -> None:
        """Draw the errors made and reported."""
        self.setVisible(True)
        (axis,) = self.fresh_axes()
        if isinstance(content, ExperimentSweep):
            name = self._draw_sweep(axis, content)
        else:
            name = self._draw_plan(axis, content)
        axis.set_ylim(bottom=0)
        axis.set_xlabel(name, color=self.ink, fontsize=8)
        axis.set_ylabel("error of the field (%)", color=self.ink, fontsize=8)
        self.add_legend(axis)
        self.draw()

    def _draw_plan(self, axis: Any, plan: ExperimentPlan) -> str:
        """Draw the errors of each draw; return the label of the axis."""
        numbers = [shot.number for shot in plan.shots]
        axis.bar(numbers, [100 * shot.error for shot in plan.shots], color=COLOURS[0], label="made")
        totals = [100 * shot.total for shot in plan.shots]
        axis.plot(numbers, totals, "_", color=self.ink, markersize=8, label="reported")
        return "draw"

    def _draw_sweep(self, axis: Any, sweep: ExperimentSweep) -> str:
        """Draw the median errors, with the band of 68 % of the draws."""
        order = np.argsort(sweep.values)
        values = np.array(sweep.values)[order]
        chosen = [sweep.plans[k] for k in order]
        spreads = [plan.error for plan in chosen]
        low, high = ([100 * getattr(each, end) for each in spreads] for end in ("low", "high"))
        axis.fill_between(values, low, high, color=COLOURS[0], alpha=0.25)
        medians = [100 * each.median for each in spreads]
        axis.plot(values, medians, "o-", color=COLOURS[0], label="made")
        totals = [100 * plan.total.median for plan in chosen]
        axis.plot(values, totals, "--", color=self.ink, label="reported")
        if values[0] > 0 and values[-1] / values[0] > _LOG_RANGE:
            axis.set_xscale("log")
        return f"{sweep.title} ({sweep.unit})" if sweep.unit else sweep.title


class Simulate(panels.ToolPanel):
    """Choose an object; predict its image, or plan an experiment with it."""

    def __init__(self, napari_viewer: Any) -> None:
        tip = "Trace the beam through the object, or invert shots with random imperfections."
        super().__init__(napari_viewer, "simulate", Run("Simulate", "Run", tip))
        self._predicted: Any = None  # layers of the last image; plans have others
        self._build_object()
        self._build_plan()
        self.warning = forms.WrappingLabel(style=forms.PROBLEM_STYLE)
        self.verdict, self.report, self.plot = panels.VerdictLine(), panels.ReportView(), PlanPlot()
        self.save_result = SaveButton(
            self,
            self._image_to_save,
            "Save the predicted image with its pixel size (.tif, .npy or .png).",
        )
        self.add(forms.labelled("Simulate", self.task), self.object, self._file_row)
        self.add(*self._layer_rows, self._size_row, self.setup, self._source_row)
        self.add(*self._plan_rows, self._values_row, self.keep_earlier, self.panel)
        self.add(self.warning, self.verdict, self.save_result, self.plot, self.report)
        self._connect()
        self.restore_last()
        self._ready = True
        self._on_change()

    def _build_object(self) -> None:
        self.task = ChoiceBox(
            {_IMAGE: "the image", _PLAN: "shots, to plan an experiment"},
            "The image that the object casts, or shots with random imperfections, whose fields are "
            "compared with the object.",
        )
        kinds: forms.Kinds = {
            **forms.kinds_of(PHANTOMS),
            _GRID: ("a 3-D field from a file", GridView),
            _LAYER: ("a result or potential", None),
        }
        self.object = forms.ModelPicker("Object", kinds, "Object that deflects the beam.")
        self.file = forms.PathEdit(
            "Choose a 3-D field",
            "openPMD or NetCDF file",
            "openPMD file (HDF5), or NetCDF 4 file with Bx, By, Bz or Ex, Ey, Ez; particles are "
            "traced through it.",
            "3-D fields (*.h5 *.hdf5 *.nc)",
        )
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
        tip = "Height and width of an image in px, such as 200 x 200."
        self.side = forms.SavedLine("200 x 200", tip)
        self.setup = SetupPicker()
        tip = "Image layer of the undisturbed beam."
        self.source = LayerPicker(self.viewer, tip, "uniform", about.may_be_source)
        self._file_row = forms.labelled("File", self.file)
        self._deflector_row = forms.labelled("Deflected by", self.deflector)
        layer = forms.labelled("Layer", self.potential)
        self._layer_rows = (layer, self.interpretation, self._deflector_row)
        self._size_row = forms.labelled("Size (px)", self.side)
        self._source_row = forms.labelled("Source", self.source)

    def _build_plan(self) -> None:
        self.energies = forms.SavedLine(
            "14.7, 30",
            "Energies of several images of a shot in MeV (of light: wavelengths in m), separated "
            "by commas. Empty: one image with the setup's.",
        )
        self.instrument, self.options = InstrumentForm(), forms.ModelForm(ExperimentOptions)
        self.quantity = ChoiceBox(
            {"": "nothing", **{key: swept.title for key, swept in SWEPT.items()}},
            "Quantity of the experiment that is varied.",
        )
        self.values = forms.SavedLine(
            "100, 300, 1000", "Values of the quantity, separated by commas, in its unit."
        )
        self._values_row = forms.labelled("Values", self.values)
        self._plan_rows = (
            forms.labelled("Energies", self.energies),
            forms.section("Instrument", self.instrument),
            forms.section("Simulated shots", self.options),
            forms.labelled("Vary", self.quantity),
        )

    def _connect(self) -> None:
        self.object.choice.currentIndexChanged.connect(lambda _: self._on_object())
        self.potential.picked.connect(self._follow_layer)
        for choice in (self.task, self.quantity):
            choice.currentIndexChanged.connect(lambda _: self._on_change())
        for part in (self.object, self.file, self.setup, self.instrument, self.options):
            part.changed.connect(self._on_change)
        for line in (self.side, self.energies, self.values):
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
        self.task.setCurrentIndex(self.task.findData(_IMAGE))
        self.object.set_kind(_LAYER)
        self.potential.layer = layer

    def parts(self) -> dict[str, Any]:
        return {
            "task": self.task,
            "setup": self.setup,
            "object": self.object,
            "file": self.file,
            "size": self.side,
            "energies": self.energies,
            "instrument": self.instrument,
            "options": self.options,
            "quantity": self.quantity,
            "values": self.values,
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
        if self.task.state() == _PLAN:
            quantity, options = self.quantity.state(), self.options.model()
            return PlanJob(
                object=target,
                setups=self._setups(setup),
                shape=shape,
                instrument=validate(Instrument, self.instrument.state(), "instrument"),
                options=options,  # type: ignore[arg-type]
                quantity=quantity,
                values=tuple(_numbers("the values", self.values.text())) if quantity else (),
            )
        return self._image_job(target, setup, shape or _SHAPE)

    def _object(self, setup: Setup | None) -> SimulatedObject:
        """Return the phantom, the file or the layer's field, or raise an `InputError`."""
        recipe: Any = self.object.model()
        if self.object.kind == _LAYER:
            return input_field(self.potential.layer, self.viewer.dims.point, setup)
        if self.object.kind != _GRID:
            return recipe
        if not self.file.path:
            raise InputError("there is no file with a 3-D field: choose one")
        return GridFile(self.file.path, recipe)

    def _image_job(
        self, target: SimulatedObject, setup: Setup | None, shape: tuple[int, int]
    ) -> ForwardJob:
        beam: Any = self.source.layer
        source = None if beam is None else image_of(beam)
        common: dict[str, Any] = {
            "unit": about.unit_of(beam or {}),
            "setup_origin": self.setup.origin,
        }
        if isinstance(target, InputField):
            layer: Any = self.potential.layer
            return ForwardJob(
                target,
                setup=setup or target.setup,
                deflector=self.deflector.currentData(),
                source=None if source is None else source_on(beam, source, layer),
                name=f"{about.metadata_of(layer).get('name') or layer.name} image",
                frame=about.frame_of(layer),
                subject=layer,
                **common,
            )
        shape = shape if source is None else source.shape
        return ForwardJob(
            target,
            shape=shape,
            setup=setup,
            source=source,
            name=f"{target.title} image",
            frame=about.frame_for(shape, setup),
            subject=target.title,
            **common,
        )

    def _setups(self, setup: Setup | None) -> tuple[Setup, ...]:
        text = self.energies.text().strip()
        if not text:
            return () if setup is None else (setup,)
        if setup is None:
            raise InputError("received energies without a setup: choose the setup of all images")
        quantity = setup.beam_quantity()
        return tuple(
            validate(type(setup), {**setup.model_dump(), quantity.name: value}, quantity.plural)
            for value in _numbers(quantity.plural, text, quantity.unit)
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
        self.plot.show_errors(content)
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
        kind, is_plan = self.object.kind, self.task.state() == _PLAN
        for row in self._layer_rows:
            row.setVisible(kind == _LAYER)
        for row in self._plan_rows:
            row.setVisible(is_plan)
        self._values_row.setVisible(is_plan and bool(self.quantity.state()))
        self._file_row.setVisible(kind == _GRID)
        self._source_row.setVisible(not is_plan)
        self.save_result.setVisible(not is_plan)
        self._size_row.setVisible(is_plan or kind != _LAYER)
        has_size = is_plan and kind not in PHANTOMS
        self.side.setPlaceholderText("that of the field" if has_size else "200 x 200")
        if kind == _LAYER:
            self._deflector_row.setVisible(not is_plan)
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


def _numbers(name: str, text: str, unit: str = "") -> Sequence[float]:
    parts = [part for part in text.split(",") if part.strip()]
    try:
        return [number_in_unit(part, unit) for part in parts]
    except ValueError:
        raise InputError(
            f"{name}: received '{text}', expected numbers separated by commas"
        ) from None
