"""The window that inverts a shot, a stack, files or a watched folder: `Invert`."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from qtpy.QtWidgets import QCheckBox, QWidget

from napari_shadowinv._napari import form as forms
from napari_shadowinv._napari import jobs
from napari_shadowinv._napari import layer_metadata as about
from napari_shadowinv._napari.layer_metadata import main_layers
from napari_shadowinv._napari.run import Outcome, Run
from napari_shadowinv._napari.viewer_sync import USER_ERRORS
from napari_shadowinv._napari.widgets import _layers as layers
from napari_shadowinv._napari.widgets import _qt as qt
from napari_shadowinv._napari.widgets._files import field_of
from napari_shadowinv._napari.widgets._inputs import (
    SHOT_SOURCES,
    ImagePanel,
    SetupPicker,
)
from napari_shadowinv._napari.widgets._panels import (
    ResultLayers,
    ResultView,
    place_inputs,
    result_frame,
)
from napari_shadowinv._napari.widgets._stacks import (
    ShotPicker,
    StackJob,
    StackView,
    StoreSection,
    placement_on,
)
from napari_shadowinv._system.progress import Progress
from napari_shadowinv.errors import InputError
from napari_shadowinv.fitting import Fit
from napari_shadowinv.inversion import Inversion
from napari_shadowinv.options import FitChoices, InversionOptions
from napari_shadowinv.pipeline import Cache
from napari_shadowinv.pipeline.costs import inversion_cost
from napari_shadowinv.pipeline.inversion_run import PREVIEW_SITES
from napari_shadowinv.preprocessing import Crop, Estimate, Recipe, Step
from napari_shadowinv.shot import Shot

_REFINE_TIP = (
    "Fit the forward model to the image, starting from its last inversion. The fit includes blur, "
    "gives error bars, and works beyond the first caustic. The verdict says whether the image "
    "determines the field."
)
_SAVE_TIP = (
    "Save the selected or last result, of a stack the shot in view: complete with its layers "
    "(.shadowinv), or for other programs (.h5)."
)
_PREVIEW_DELAY_MS = 10  # merges simultaneous changes


class Invert(ImagePanel):
    """Choose an image or many shots, then press Run; everything else has a default."""

    command = "invert"

    def __init__(self, napari_viewer: Any) -> None:
        tip = "Invert the image, or all shots that are not in the store yet."
        super().__init__(napari_viewer, Run("Run", tip))
        self._cache = Cache()
        self.previewed = ResultLayers(self.viewer, self)
        self._preview_timer = qt.timer(self, _PREVIEW_DELAY_MS, self._preview, once=True)
        self._build()
        self._connect()
        self._on_shots()
        self.view.follow()
        self._ready = True

    def _build(self) -> None:
        self.image = ShotPicker(self.viewer)
        self.make_inputs(
            SHOT_SOURCES,
            "The beam without the object: ideally a measured reference image, otherwise uniform "
            "or estimated from the shot.",
            InversionOptions,
            SetupPicker("invert", waits=True),
        )
        self.source_masks = layers.MaskPicker(
            self.viewer,
            self.chosen_image,
            "Labels or shapes that exclude the object from the source estimate only; the "
            "inversion still uses these pixels.",
            "Source mask",
        )
        self.mask_pickers["source_mask"] = self.source_masks
        tip = "Shapes layer with a rectangle; only the image inside is inverted."
        kinds: Any = ("shapes",)
        self.crop = layers.LayerPicker(self.viewer, tip, "none", kinds=kinds, label="Crop")
        self.crop.add_button("✎", "Draw a rectangle.", self._draw_crop)
        tip = f"<qt>Update the field after each change, with at most {PREVIEW_SITES:,} sites.</qt>"
        self.live = QCheckBox("Live preview", toolTip=tip)
        self.store = StoreSection()
        self.cost, self.refine_form = forms.WrappingLabel(), forms.ModelForm(FitChoices, ["psf"])
        self.refine_button = qt.push_button("Refine", _REFINE_TIP, self.refine)
        refine = self.refine_form, self.refine_button
        self.refine_section = forms.section("Refine the result", *refine)
        self._refined = ResultLayers(self.viewer, self)
        self.view = ResultView(self, (Inversion, Fit), _SAVE_TIP)
        self.verdict, self.report = self.view.verdict, self.view.report
        self.stack_view = StackView(self.viewer, self.report)
        self.show_source = qt.push_button(
            "Show source", "Add the estimated beam as an image layer.", self._show_source
        )
        self._source_row = forms.labelled("", self.show_source)
        self.add(self.image, self.source, self._source_row, self.source_masks, self.setup)
        self.add(self.store, self.cost, self.panel, self.view, self.stack_view)
        self.add(self.refine_section)
        self.add(forms.section("Mask and crop", self.masks, self.crop), *self.settings)
        last_row = qt.side_by_side((self.live, 0), (QWidget(), 1), (self.recipes, 0))
        self.add(self.keep_earlier, last_row)

    def _connect(self) -> None:
        self.image.changed.connect(self._on_shots)
        self.image.edited.connect(self._forget_report)
        self.panel.progressed.connect(self._on_progress)
        changes = [control.changed for control in self.parts()]
        picked = self.image, self.masks, self.source_masks, self.crop, self.source
        edits = [picker.edited for picker in picked]
        for signal in (*changes, self.live.toggled, self.crop.picked, *edits):
            signal.connect(self.on_change)

    def parts(self) -> tuple[Any, ...]:
        return *super().parts(), self.source_masks

    def chosen_image(self) -> Any | None:
        """Return the layer of the shot or of the stack; None for files."""
        return self.image.layer

    def all_steps(self) -> tuple[Step, ...]:
        """Return the preprocessing steps, the crop first, or raise an `InputError`."""
        has_crop = not self.image.is_stack
        crop = layers.crop_of(self.crop.layer, self.chosen_image()) if has_crop else None
        steps = self.steps.steps()
        return steps if crop is None else (crop, *steps)

    def show_recipe(self, recipe: Recipe, path: Path) -> None:
        """Show a recipe but for its masks; change nothing unless all of it is usable."""
        image: Any = self.chosen_image()
        crop, steps = None, recipe.steps
        can_crop = image is not None and not self.image.is_stack
        if can_crop and steps and isinstance(steps[0], Crop):
            height, width = image.data.shape[-2:]
            crop, steps = steps[0].slices((height, width)), steps[1:]
        source = self.source.usable(recipe.source, image, path)
        self.steps.show_steps(steps)
        self.instrument.restore(recipe.instrument.stated)
        if recipe.setup is not None:
            self.setup.load(recipe.setup.model_dump(exclude_none=True), str(path))
        self.source.show(source)
        self.options.restore(recipe.options.model_dump())
        self.crop.layer = None if crop is None else layers.new_crop(self.viewer, image, crop)

    def _hidden_from_source(self, image: Any) -> Any:
        """Return the source mask, False on the object; None without one or an estimate."""
        return self.source_masks.usable(image) if self.source.is_estimated else None

    def recipe(self) -> Recipe:
        """Return the recipe of the controls, without masks and layers; or raise an `InputError`."""
        return self.input_recipe(steps=self.all_steps(), options=self.options.model())

    def request(self, preview: bool = False) -> jobs.InversionJob | StackJob:
        layer: Any = self.image.layer
        if not self.image.is_stack:
            layers.image_of(layer)
        if not preview:
            self.setup.keep()
        recipe = self.recipe()
        shot = replace(self._shot(layer), source_mask=self._hidden_from_source(layer))
        self.source.check(shot.mask)
        chosen = (self.masks.layer, self.source_masks.layer, self.crop.layer)
        source_mask = self.source_masks.summary(layer) if self.source.is_estimated else ""
        described = self.describe(
            layer, recipe, chosen, name=self.image.name, source_mask=source_mask
        )
        if self.image.is_stack:
            return StackJob(
                shots=shot,
                out=self.store.path,
                placement={} if layer is None else placement_on(layer, recipe),
                options=self.store.options(self.image.kind),
                **described,
            )
        estimated = [f"{self.source.kind} source"] if self.source.is_made else []
        return jobs.InversionJob(
            name=", ".join([jobs.name_of_result(layer), *estimated]),
            frame=result_frame(layer, recipe),
            shot=shot,
            cache=self._cache,
            preview=preview,
            **described,
        )

    def _shot(self, layer: Any) -> Shot:
        """Return the shot or the shots, with their source and mask."""
        if not self.image.is_stack:
            return replace(self.shot_of(layer), cautions=layers.cautions_of(layer))
        beam = self.source.measured(layer)
        source = None if beam is None else beam.image
        return Shot(self.image.shots(), source=source, mask=self.masks.usable(layer))

    @qt.notify_errors
    def refine(self) -> None:
        """Refine the image's last inversion, or that of the selected layer."""
        if self.is_busy:
            raise InputError(
                "Invert is running: wait until it finishes, or press Cancel, then refine"
            )
        last = self._last.get(self.image.layer)
        fields = [] if last is None else field_of(last.layers)
        chosen = next(iter(fields), self.viewer.layers.selection.active)
        if chosen is None or about.result_of(chosen) is None:
            raise InputError(
                "there is no inversion of this image to refine: press Run first, then Refine"
            )
        shots = [shot for shot, last in self._last.items() if chosen in last.layers]
        image = next((shot for shot in shots if shot in self.viewer.layers), chosen)
        name = jobs.name_of_result(image)
        choices: Any = self.refine_form.model()
        job = jobs.refinement(chosen, image, name, choices.psf or 0.0)
        self.start(job, self._show_refinement)

    @qt.notify_errors
    def _show_source(self) -> None:
        """Estimate the beam of the image, which the steps have not changed."""
        if self.is_busy:
            return
        layer: Any = self.image.layer
        image, source = layers.image_of(layer), self.source.recipe_source()
        assert isinstance(source, Estimate)  # without one the button is hidden
        estimate = source.adapt_to(self.setup.setup(), image.shape)
        hidden = self._hidden_from_source(layer)
        made_from = {"image": layer.name, "estimate": estimate.summary}
        if hidden is not None:
            made_from["source_mask"] = self.source_masks.summary(layer)
        shot = Shot(image, source_mask=hidden)
        job = jobs.source_job(estimate, shot, layer, made_from)
        self.start(job, self._show_estimate)

    def _on_progress(self, progress: Progress) -> None:
        job = self.panel.tag
        has_shots = progress.stage == "shots" or (progress.stage == "wait" and progress.step)
        if isinstance(job, StackJob) and has_shots:
            self._show_run(job)

    def _show_run(self, job: StackJob) -> None:
        self.store.begin()
        self.stack_view.show_run(job)
        self.results = self.stack_view.results

    @qt.notify_errors
    def _on_end(self, outcome: Outcome) -> None:
        job = outcome.tag
        if not isinstance(job, StackJob):
            super()._on_end(outcome)
        elif text := self.stack_view.end(outcome):
            self.results = self.stack_view.results
            self.panel.say(text)

    def forget(self) -> None:
        self.stack_view.empty()

    def show_result(self, finished: jobs.Finished, job: jobs.InversionJob) -> None:
        inversion = finished.content
        moved = place_inputs(self.viewer, job, quiet=job.preview)
        if job.preview:
            self.view.show_preview(finished.result)
            residual = next(f for f in inversion.facts if f.key == "image_residual")
            self.panel.say(f"{residual.title} {residual.text}")
            self.previewed.show(finished.layer_data, select=False, fit=moved)
            return
        self.view.show_report(finished.result, job)
        self._show_cost()
        # They refine an earlier result and would cover the new one.
        self._refined.hide()
        self.previewed.hide()
        self.results = self.results_for(job.image)
        layer_data = main_layers(finished.layer_data, also=self.results.layer_keys)
        self.results.show(layer_data, fit=moved)

    def _show_refinement(self, finished: jobs.Finished, job: jobs.FitJob) -> None:
        self.previewed.hide()
        self.results = self._refined = self.view.show_fit(job, finished)

    def _show_estimate(self, finished: jobs.Finished, job: jobs.Job) -> None:
        self.results_for(job.subject).show(finished.layer_data)

    def on_change(self) -> None:
        """Update the preview, the estimated cost, and what is said of the result."""
        self.compare()
        self._start_preview()
        self.source_masks.setVisible(self.source.is_estimated)
        self._source_row.setVisible(self.source.is_made and not self.image.is_stack)
        self._show_cost()

    def showEvent(self, event: Any) -> None:
        super().showEvent(event)
        self._start_preview()

    def _start_preview(self) -> None:
        if self._ready and self.live.isChecked() and not self.image.is_stack:
            self._preview_timer.start()

    def _preview(self) -> None:
        """Show a preview; the button's run has priority."""
        if self.is_busy or not self.isVisible():
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
            options: Any = self.options.model()
            cost = inversion_cost(shape, options)
            self.cost.show_text(cost.text, forms.PROBLEM_STYLE if cost.exceeds_memory else "")
        except InputError:
            self.cost.setVisible(False)  # Run reports the problem

    def _on_shots(self) -> None:
        """Show the source, setup and choices of another image or of other files."""
        layer, is_stack = self.image.layer, self.image.is_stack
        self.store.follow(self.image)
        for row in (self.store, self.stack_view):
            row.setVisible(is_stack)
        for row in (self.crop, self.live, self.keep_earlier, self.refine_section):
            row.setVisible(not is_stack)
        self.source.follow(layer)
        self.setup.follow(layer, self.image.name if layer is None else "")
        if layer is not None:
            self.masks.follow(layer)
        self._forget_report()
        self.on_change()

    def _forget_report(self) -> None:
        """Clear the report, which does not apply to another image."""
        self.view.empty()
        if not self.panel.running:
            self.forget()
            self.panel.say("")

    @qt.notify_errors
    def _draw_crop(self) -> None:
        layers.image_of(self.image.layer)
        self.crop.layer = layers.new_shapes(self.viewer, self.image.layer, "crop", "add_rectangle")
