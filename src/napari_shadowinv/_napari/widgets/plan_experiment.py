"""The widget that plans an experiment before its shot: `PlanExperiment`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from napari_shadowinv._napari import form as forms
from napari_shadowinv._napari import layer_metadata as about
from napari_shadowinv._napari.jobs import Finished, Job
from napari_shadowinv._napari.layers import LayerData
from napari_shadowinv._napari.run import Run
from napari_shadowinv._napari.shots import shot_layer
from napari_shadowinv._napari.widgets import _panels as panels
from napari_shadowinv._napari.widgets._inputs import ChoiceBox, InstrumentForm
from napari_shadowinv._napari.widgets._layers import LayerPicker
from napari_shadowinv._napari.widgets._objects import GRID, LAYER, GridFile, ObjectPanel
from napari_shadowinv._napari.widgets._qt import COLOURS, Plot
from napari_shadowinv._system.progress import OnProgress, Reporter, ShouldStop
from napari_shadowinv._system.validation import validate
from napari_shadowinv.errors import InputError
from napari_shadowinv.options import Instrument
from napari_shadowinv.physics.beam import number_in_unit
from napari_shadowinv.physics.phantom_models import PHANTOMS, PhantomRecipe
from napari_shadowinv.physics.setup import Setup
from napari_shadowinv.physics.units import intensity_limits
from napari_shadowinv.pipeline.experiment import SWEPT, plan_experiment, sweep_experiment
from napari_shadowinv.pipeline.experiment_object import (
    PlannedObject,
    object_of_displacement,
    shape_of_text,
)
from napari_shadowinv.pipeline.experiment_options import ExperimentOptions
from napari_shadowinv.pipeline.experiment_result import ExperimentPlan, ExperimentSweep
from napari_shadowinv.pipeline.traced_file import object_of_file

_NOTHING = ""
_PLOT_HEIGHT_PX = 260
_LOG_RANGE = 8.0


@dataclass(frozen=True, eq=False, kw_only=True)
class PlanJob(Job):
    """A plan of an experiment, or a sweep of one of its quantities."""

    object: PhantomRecipe | PlannedObject | GridFile
    setups: tuple[Setup, ...]
    shape: tuple[int, int] | None
    instrument: Instrument
    options: ExperimentOptions
    quantity: str = _NOTHING
    values: tuple[float, ...] = ()

    def run(
        self, on_progress: OnProgress, should_stop: ShouldStop
    ) -> ExperimentPlan | ExperimentSweep:
        choices = {"shape": self.shape, "instrument": self.instrument, "options": self.options}
        keywords: Any = {**choices, "on_progress": on_progress, "should_stop": should_stop}
        setups, target = self.setups or None, self.object
        if isinstance(target, GridFile):
            Reporter(on_progress, should_stop)("field", 0, None)
            target = object_of_file(Path(target.path), next(iter(self.setups), None), target.view)
        if self.quantity:
            keywords |= {"quantity": self.quantity, "values": self.values}
            return sweep_experiment(target, setups, **keywords)
        return plan_experiment(target, setups, **keywords)

    def layers(self, content: ExperimentPlan | ExperimentSweep) -> LayerData:
        """Describe the image of the first draw."""
        plan = content.plans[content.best] if isinstance(content, ExperimentSweep) else content
        setup = plan.setups[0] if plan.setups else None
        image, name = plan.images[0], f"{plan.title}, planned"
        return [shot_layer(image, name, setup, intensity_limits(image), unit="counts")]


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


class PlanExperiment(ObjectPanel):
    """Choose an object and an experiment, and see whether its field would be determined."""

    def __init__(self, napari_viewer: Any) -> None:
        panel = Run(
            "Plan an experiment",
            "Plan",
            "Simulate shots with random imperfections, retrieve their fields, and compare these "
            "with the object.",
        )
        super().__init__(napari_viewer, "plan-experiment", panel, "the field of a result")
        self.field = LayerPicker(
            self.viewer,
            "A layer of a result, whose field is the object.",
            suits=lambda layer: about.displacement_of(layer) is not None,
        )
        self._field_row = forms.labelled("Result", self.field)
        self.energies = forms.SavedLine(
            "14.7, 30",
            "Energies of several images of a shot in MeV (of light: wavelengths in m), separated "
            "by commas. Empty: one image with the setup's.",
        )
        self.side = forms.SavedLine(
            "200 x 200", "Height and width of an image in px, such as 200 x 200."
        )
        self.instrument = InstrumentForm()
        self.options = forms.ModelForm(ExperimentOptions)
        self.quantity = ChoiceBox(
            {_NOTHING: "nothing", **{key: swept.title for key, swept in SWEPT.items()}},
            "Quantity of the experiment that is varied.",
        )
        self.values = forms.SavedLine(
            "100, 300, 1000", "Values of the quantity, separated by commas, in its unit."
        )
        self._values_row = forms.labelled("Values", self.values)
        self.verdict, self.report = panels.VerdictLine(), panels.Report()
        self.plot = PlanPlot()
        instrument = forms.section("Instrument", self.instrument)
        options = forms.section("Simulated shots", self.options)
        self.add(self.object, self.file_row, self._field_row)
        self.add(forms.labelled("Size (px)", self.side), self.setup)
        self.add(forms.labelled("Energies", self.energies), instrument, options)
        self.add(forms.labelled("Vary", self.quantity), self._values_row, self.keep_earlier)
        self.add(self.panel, self.verdict, self.plot, self.report)
        self.object.choice.currentIndexChanged.connect(lambda _: self.choose_setup())
        self.quantity.currentIndexChanged.connect(lambda _: self._on_change())
        for part in (self.object, self.setup, self.instrument, self.options):
            part.changed.connect(self._on_change)
        for line in (self.energies, self.side, self.values):
            line.textChanged.connect(lambda _: self.keep())
        self.restore_last()
        self._ready = True
        self.choose_setup()
        self._on_change()

    def parts(self) -> dict[str, Any]:
        return {
            **super().parts(),
            "energies": self.energies,
            "size": self.side,
            "options": self.options,
            "quantity": self.quantity,
            "values": self.values,
        }

    def restore(self, state: Any) -> None:
        super().restore(state)
        if kind := state.get("setup", {}).get("kind"):
            self.setup.picker.set_kind(str(kind))

    def request(self) -> PlanJob:
        setup = self.setup.setup()
        quantity, size = self.quantity.state(), self.side.text().strip()
        options: Any = self.options.model()
        return PlanJob(
            object=self._object(),
            setups=self._setups(setup),
            shape=shape_of_text(size, "the size") if size else None,
            instrument=validate(Instrument, self.instrument.state(), "instrument"),
            options=options,
            quantity=quantity,
            values=tuple(_numbers("the values", self.values.text())) if quantity else (),
        )

    def forget(self) -> None:
        self.verdict.show_text("")
        self.report.empty()
        self.plot.setVisible(False)

    def show_result(self, finished: Finished, job: PlanJob) -> None:
        self.results = self._last.layers_for_next(job.quantity or "plan")
        self.results.show(finished.layer_data)
        content = finished.content
        self.verdict.show_headline(content.headline)
        self.plot.show_errors(content)
        rows, details = (panels.fact_rows(content.facts, details=flag) for flag in (False, True))
        self.report.show_rows(rows, details)
        self.reveal(self.report)

    def _object(self) -> PhantomRecipe | PlannedObject | GridFile:
        if self.object.kind != LAYER:
            return self.simulated_object()
        layer = self.field.layer
        if layer is None:
            raise InputError(
                "there is no result whose field could be the object: open one, or choose a phantom"
            )
        result = about.result_of(layer)
        setup = None if result is None else result.setup
        displacement = np.asarray(about.displacement_of(layer))
        return object_of_displacement(displacement, setup, title=layer.name)

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

    def _on_change(self) -> None:
        is_phantom = self.object.kind in PHANTOMS
        self.side.setPlaceholderText("200 x 200" if is_phantom else "that of the field")
        self.file_row.setVisible(self.object.kind == GRID)
        self._field_row.setVisible(self.object.kind == LAYER)
        self._values_row.setVisible(bool(self.quantity.state()))
        self.keep()


def _numbers(name: str, text: str, unit: str = "") -> Sequence[float]:
    parts = [part for part in text.split(",") if part.strip()]
    try:
        return [number_in_unit(part, unit) for part in parts]
    except ValueError:
        raise InputError(
            f"{name}: received '{text}', expected numbers separated by commas"
        ) from None
