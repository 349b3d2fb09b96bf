"""The window for a single shot and its beam: `InvertShot`."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from qtpy.QtWidgets import QCheckBox

from napari_shadowinv._napari import form as forms
from napari_shadowinv._napari import jobs
from napari_shadowinv._napari import layer_metadata as about
from napari_shadowinv._napari.layer_metadata import main_layers
from napari_shadowinv._napari.layers import LayerData
from napari_shadowinv._napari.run import Run
from napari_shadowinv._napari.shots import shot_in_memory, shot_of_layer
from napari_shadowinv._napari.viewer_sync import USER_ERRORS, show_caution
from napari_shadowinv._napari.widgets import _layers as layers
from napari_shadowinv._napari.widgets import _panels as panels
from napari_shadowinv._napari.widgets import _qt as qt
from napari_shadowinv._napari.widgets._files import field_of, result_buttons
from napari_shadowinv._napari.widgets._fitting import FitView, RefineSection
from napari_shadowinv._napari.widgets._inputs import InversionInputs
from napari_shadowinv._napari.widgets._results import ResultLayers, place_inputs, result_frame
from napari_shadowinv._system.machine import physical_memory
from napari_shadowinv._system.progress import OnProgress, Reporter, ShouldStop
from napari_shadowinv._typing import FloatArray
from napari_shadowinv.errors import InputError
from napari_shadowinv.facts import percent
from napari_shadowinv.inversion import Inversion
from napari_shadowinv.options import MAX_DEFAULT_SITES, InversionOptions
from napari_shadowinv.physics.setup import Setup
from napari_shadowinv.pipeline import Cache
from napari_shadowinv.pipeline.inversion_run import PREVIEW_SITES
from napari_shadowinv.preprocessing import Estimate, Recipe, estimate_source
from napari_shadowinv.preprocessing.estimates import LowPassEstimate, TotalVariationEstimate
from napari_shadowinv.shot import Shot

# Measured on two cores with images of 0.25 to 4 Mpx and 5,000 to 1,000,000 sites, including the
# layers of the result.
_SECONDS_PER_PIXEL, _SECONDS_PER_SITE = 3e-6, 11e-6
_BYTES, _BYTES_PER_PIXEL, _BYTES_PER_SITE = 200e6, 280.0, 1700.0
_MIN_PIXELS_FOR_ESTIMATE = 1_000_000
_NOTABLE_PATTERN = 0.25
_PREVIEW_DELAY_MS = 10  # merges simultaneous changes


@dataclass(frozen=True)
class CostEstimate:
    """Estimated time (s) and peak memory (bytes) of an inversion."""

    pixels: int
    sites: int
    seconds: float
    memory: float

    @property
    def exceeds_memory(self) -> bool:
        available = physical_memory()
        return available is not None and self.memory > available

    @property
    def text(self) -> str:
        """The estimate as a sentence; empty for small images."""
        if self.pixels < _MIN_PIXELS_FOR_ESTIMATE and not self.exceeds_memory:
            return ""
        text = (
            f"{self.pixels / 1e6:.3g} Mpx with {self.sites:,} sites: about "
            f"{jobs.duration_in_words(self.seconds)} and up to {self.memory / 1e9:.1f} GB"
        )
        if not self.exceeds_memory:
            return f"{text}."
        return (
            f"{text}, more than this machine's {(physical_memory() or 0) / 1e9:.1f} GB: crop or "
            "bin the image, or choose fewer sites."
        )


def estimate_cost(
    shape: tuple[int, ...], options: InversionOptions, pace: float = 1.0
) -> CostEstimate:
    """Estimate an inversion that takes `pace` times the reference time on this machine."""
    pixels = shape[0] * shape[1]
    sites = options.n_sites or min(pixels, MAX_DEFAULT_SITES)
    seconds = pace * (_SECONDS_PER_PIXEL * pixels + _SECONDS_PER_SITE * sites)
    memory = _BYTES + _BYTES_PER_PIXEL * pixels + _BYTES_PER_SITE * sites
    return CostEstimate(pixels, sites, seconds, memory)


class InvertShot(InversionInputs, panels.ToolPanel):
    """Choose an image, then press Run; everything else has a default."""

    def __init__(self, napari_viewer: Any) -> None:
        tip = "Invert the image and show the result as layers."
        super().__init__(napari_viewer, "invert-shot", Run("Invert shot", "Run", tip))
        self._cache = Cache()
        self.previewed = ResultLayers(self.viewer, self)
        self._preview_timer = qt.timer(self, _PREVIEW_DELAY_MS, self._preview, once=True)
        self._build()
        self._connect()
        self.restore_last()
        self._on_image()
        self._follow_result()
        self._ready = True

    def _build(self) -> None:
        self.image = layers.ShotPicker(self.viewer)
        self.make_inputs(
            lambda: self.image.layer,
            ("labels", "shapes"),
            "Labels or shapes on bad detector pixels. The inversion ignores masked pixels, so do "
            "not mask the object.",
            "Labels or shapes that exclude the object from the source estimate only; the "
            "inversion still uses these pixels.",
        )
        tip = "<qt>Shapes layer with a rectangle; only the image inside is inverted.</qt>"
        self.crop = layers.LayerPicker(self.viewer, tip, "none", kinds=("shapes",))
        tip = f"<qt>Update the field after each change, with at most {PREVIEW_SITES:,} sites.</qt>"
        self.live = QCheckBox("Live preview", toolTip=tip)
        self.cost, self._pace = forms.WrappingLabel(), 1.0
        self.refine_section = RefineSection(self.refine)
        self.fit_view = FitView(self.viewer, self.panel)
        self.verdict, self.report = panels.VerdictLine(), panels.ReportView()
        self._reported: about.Result[Any] | None = None
        self.save_result, self.more_layers = result_buttons(
            self,
            lambda: self.fit_view.results if self.fit_view.results.layers else self.results,
            "Save the selected or last result: complete with its layers (.shadowinv), for other "
            "programs (.h5), or its sites (.csv).",
        )
        self.show_source = qt.push_button(
            "Show source", "Add the estimated beam as an image layer.", self._show_source
        )
        crop = qt.with_button(self.crop, "✎", "Draw a rectangle.", self._draw_crop)
        source, *masks = self.beam
        self.add(forms.labelled("Image", self.image), source, forms.labelled("", self.show_source))
        self.add(*masks, forms.labelled("Crop", crop))
        self.add(*self.settings, self.live, self.keep_earlier, self.cost, self.panel)
        self.add(self.verdict, qt.side_by_side((self.save_result, 1), (self.more_layers, 1)))
        self.add(self.report, self.refine_section, self.fit_view)

    def _connect(self) -> None:
        self.image.picked.connect(self._on_image)
        self.image.edited.connect(self._forget_report)
        # Also for runs that are cancelled, or refused before they start.
        self.panel.button.clicked.connect(self._empty_report)
        self.panel.started.connect(self._on_start)
        qt.while_alive(self, self.viewer.layers.selection, "active", self._follow_result)
        changes = [control.changed for control in self.parts().values()]
        masks = self.masks.layers, self.source_masks.layers
        edits = [each.edited for each in (self.image, *masks, self.crop, self.source.layers)]
        for signal in (*changes, self.live.toggled, self.crop.picked, *edits):
            signal.connect(self.on_change)

    def request(self, preview: bool = False) -> jobs.InversionJob:
        layer: Any = self.image.layer
        image = layers.image_of(layer)
        if not preview:
            self.setup.keep()
        recipe = self.recipe()
        mask = self.masks.usable(layer)
        self.source.check(mask)
        warnings, hidden = layers.warnings_of(layer), self.hidden_from_source(layer)
        shot = replace(
            shot_of_layer(layer, image),
            warnings=warnings,
            mask=mask,
            source_mask=hidden,
            source=self.source.measured(layer),
        )
        return jobs.InversionJob(
            name=", ".join(filter(None, (jobs.name_of_result(layer), self.source.short_name))),
            frame=result_frame(layer, recipe),
            shot=shot,
            cache=self._cache,
            preview=preview,
            **self.job_inputs(layer, layer.name, recipe, self.crop.layer),
        )

    @qt.notify_errors
    def refine(self, psf: float) -> None:
        """Refine the last inversion of the image, or else that of the selected layer."""
        if self.panel.running and not self._running_preview:
            return
        image: Any = self.image.layer
        fields = field_of(self._last.layers_of(image))
        chosen = self.viewer.layers.selection.active
        if not fields and chosen is not None and about.result_of(chosen) is not None:
            self.refine_layer(chosen)
            return
        if not fields:
            raise InputError(
                "there is no inversion of this image to refine: press Run first, then Refine"
            )
        self.start(jobs.refinement(fields[0], image, str(image.name), psf))

    @qt.notify_errors
    def refine_layer(self, layer: Any) -> None:
        """Refine the inversion that a layer belongs to, such as a result from a file."""
        self.refine_section.folded.expand()
        image = self._last.shot_of(layer)
        name = jobs.name_of_result(layer) if image is None else str(image.name)
        psf = self.refine_section.psf.value()
        job = jobs.refinement(layer, layer if image is None else image, name, psf)
        if self.panel.running and not self._running_preview:
            raise InputError(
                "Invert shot is running: wait until it finishes, or press Cancel, then refine"
            )
        self.start(job)

    @qt.notify_errors
    def _show_source(self) -> None:
        """Estimate the beam of the image, which the steps have not changed."""
        if self.panel.running and not self._running_preview:
            return
        layer: Any = self.image.layer
        image, source = layers.image_of(layer), self.source.chosen()
        assert isinstance(source, Estimate)  # without one the button is hidden
        estimate = source.adapt_to(self.setup.setup(), image.shape)
        hidden = self.hidden_from_source(layer)
        made_from = {"image": layer.name, "estimate": estimate.summary}
        if hidden is not None:
            made_from["source_mask"] = self.source_masks.summary(layer)
        self.start(SourceJob(estimate, Shot(image, source_mask=hidden), layer, made_from))

    def show_result(
        self, finished: jobs.Finished, job: jobs.InversionJob | jobs.FitJob | SourceJob
    ) -> None:
        if isinstance(job, jobs.InversionJob):
            self._show_inversion(finished, job)
            return
        if isinstance(job, SourceJob):
            self._show_estimate(finished, job)
            return
        self.previewed.hide()
        self.fit_view.show_result(job, finished, self._last)
        self.reveal(self.fit_view.verdict)

    def _on_start(self) -> None:
        # The verdict of a preview stays until the next preview.
        if not self._running_preview:
            self._empty_report()

    def _empty_report(self) -> None:
        self._reported = None
        self.verdict.show_text("")
        self.report.empty()

    def _follow_result(self, _: Any = None) -> None:
        """Show the report of the result whose layer is selected, such as a layer from a file."""
        if self.fit_view.follow():
            self._empty_report()
            return
        layer = self.viewer.layers.selection.active
        result = None if layer is None else about.result_of(layer)
        if result is None or result is self._reported or self.panel.running:
            return
        if isinstance(result.content, Inversion):
            self.fit_view.empty()
            self._report(result.content, result.setup, [])
            self._reported = result
            self.reveal(self.verdict)

    def _report(self, inversion: Inversion, setup: Setup | None, input_rows: panels.Rows) -> None:
        inversion = inversion.in_units(setup)
        self.verdict.show_headline(inversion.headline)
        facts = inversion.facts
        said = self.setup.warning_label.text()  # in the form, above
        warnings = [row for row in panels.warning_rows(facts) if row[1] not in said]
        rows = [*warnings, *input_rows, *panels.fact_rows(facts)]
        self.report.show_rows(rows, panels.fact_rows(facts, details=True))

    def _show_inversion(self, finished: jobs.Finished, job: jobs.InversionJob) -> None:
        inversion = finished.content
        headline = inversion.headline
        moved = place_inputs(self.viewer, job, quiet=job.preview)
        self._reported = finished.result
        if job.preview:
            self.verdict.show_headline(headline, "Preview: ")
            residual = next(f for f in inversion.facts if f.key == "image_residual")
            self.panel.say(f"{residual.title} {residual.text}")
        else:
            self._report(inversion, inversion.setup, job.inputs)
            if not headline.level.is_success:
                show_caution(str(headline))
            self.reveal(self.verdict)
            self._learn_pace(inversion)
            # They refine an earlier result and would cover the new one.
            self.fit_view.results.hide()
        if job.preview:
            self.previewed.show(finished.layer_data, select=False, fit=moved)
            return
        self.previewed.hide()
        self.results = self._last.layers_for_next(job.image)
        layer_data = main_layers(finished.layer_data, also=self.results.layer_keys)
        self.results.show(layer_data, fit=moved)

    def _show_estimate(self, finished: jobs.Finished, job: SourceJob) -> None:
        self._last.layers_for_next((job.image, about.SOURCE)).show(finished.layer_data)
        share = _pattern_share(finished.content, job)
        if share >= _NOTABLE_PATTERN:
            self.panel.say(
                f"The estimate contains {percent(share)} of the pattern in the image: what of it "
                "is the object's is missing in the field. Choose a smoother estimate, or mask "
                "the object.",
                problem=True,
            )

    def on_change(self) -> None:
        """Save the state, update the preview and the estimated cost."""
        self.keep()
        if self._ready and self.live.isChecked():
            self._preview_timer.start()
        self.show_source.parentWidget().setVisible(self.source.is_made)
        self._show_cost()

    def showEvent(self, event: Any) -> None:
        super().showEvent(event)
        if self._ready and self.live.isChecked():
            self._preview_timer.start()

    def _preview(self) -> None:
        """Show a preview; the button's run has priority."""
        is_busy = self.panel.running and not self._running_preview
        if is_busy or not self.isVisible():
            return
        try:
            job = self.request(preview=True)
        except USER_ERRORS as error:
            # An unfinished rectangle or number is no reason for a notification.
            self.panel.say(str(error), problem=True)
            return
        self.start(job, preview=True)

    def _show_cost(self) -> None:
        """Show the estimated time and memory for large images."""
        try:
            recipe = Recipe(steps=self.all_steps())
            shape = recipe.shape_after(layers.image_of(self.image.layer).shape)
            cost = estimate_cost(shape, self.options.model(), self._pace)  # type: ignore[arg-type]
        except InputError:
            self.cost.setVisible(False)  # Run reports the problem
            return
        self.cost.show_text(cost.text, forms.PROBLEM_STYLE if cost.exceeds_memory else "")

    def _learn_pace(self, inversion: Inversion) -> None:
        seconds = inversion.report.seconds
        estimated_s = estimate_cost(inversion.potential.shape, inversion.options).seconds
        # Cached sites and small images would give a wrong pace.
        if estimated_s > 1 and seconds.get("sites", 0) > 0.1:
            self._pace = sum(seconds.values()) / estimated_s
            self._show_cost()

    def _on_image(self) -> None:
        layer = self.image.layer
        self.source.follow(layer)
        self.setup.follow(layer)
        if layer is not None:
            self.masks.follow(layer)
        self._forget_report()
        self.on_change()

    def _forget_report(self) -> None:
        """Clear the report, which does not apply to another image."""
        self._empty_report()
        self.fit_view.empty()
        if not self.panel.running:
            self.panel.say("")

    @qt.notify_errors
    def _draw_crop(self) -> None:
        layers.image_of(self.image.layer)
        self.crop.layer = layers.new_shapes(self.viewer, self.image.layer, "crop", "add_rectangle")


@dataclass(frozen=True, eq=False)
class SourceJob(jobs.Job):
    estimate: Estimate
    shot: Shot  # its image may be lazy
    image: Any
    made_from: dict[str, str]

    def run(self, on_progress: OnProgress, should_stop: ShouldStop) -> FloatArray:
        report = Reporter(on_progress, should_stop)
        report("source", 0, None, self.estimate.title)
        shot = shot_in_memory(self.shot, "the image")
        source = estimate_source(self.estimate, shot, should_stop)
        report("source", 1, 1)
        return source

    def layers(self, content: FloatArray) -> LayerData:
        layer: Any = self.image
        metadata = about.metadata_for(
            about.SOURCE,
            "",
            about.setup_of(layer),
            setup_origin=about.setup_origin_of(layer),
            made_from=self.made_from,
            source_mask=self.shot.source_mask,
        )
        keywords = {
            "name": f"{layer.name} source: {self.estimate.title}",
            "metadata": metadata,
            "colormap": layer.colormap.name,
            "contrast_limits": tuple(layer.contrast_limits),
            **about.frame_of(layer).keywords(),
        }
        return [(content, keywords, "image")]


def _pattern_share(source: FloatArray, job: SourceJob) -> float:
    """Return how much of an image's pattern an estimate keeps that smooths the whole image."""
    smooths = isinstance(job.estimate, LowPassEstimate | TotalVariationEstimate)
    if not smooths or job.shot.source_mask is not None:
        return 0.0
    kept, pattern = (layers.block_pattern(np.asarray(each)) for each in (source, job.shot.image))
    if kept is None or pattern is None or not pattern.any():
        return 0.0
    return float(np.vdot(kept, pattern) / np.vdot(pattern, pattern))
