"""The widget that fits fields to several images of one object: `FitImages`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from napari_shadowinv._napari import form as forms
from napari_shadowinv._napari import layer_metadata as about
from napari_shadowinv._napari.jobs import Finished, FitJob, name_of_result
from napari_shadowinv._napari.layers import add_layers
from napari_shadowinv._napari.run import Run
from napari_shadowinv._napari.shots import layers_of_shot
from napari_shadowinv._napari.widgets import _inputs as inputs
from napari_shadowinv._napari.widgets import _layers as layers
from napari_shadowinv._napari.widgets._image_table import (
    ImageTable,
    beam_column,
    entries_of,
    store_entries,
)
from napari_shadowinv._napari.widgets._panels import ResultView, result_frame
from napari_shadowinv._napari.widgets._qt import side_by_side
from napari_shadowinv._system.validation import labels_of, validate
from napari_shadowinv.errors import InputError
from napari_shadowinv.fitting import Fit
from napari_shadowinv.io import read_shot
from napari_shadowinv.options import FitChoices, FitOptions
from napari_shadowinv.physics.setup import SETUPS, Setup
from napari_shadowinv.pipeline.costs import fit_cost
from napari_shadowinv.pipeline.fit_run import check_fit
from napari_shadowinv.preprocessing import FIT_STEPS, MeasuredSource, Recipe, UniformEstimate
from napari_shadowinv.shot import Shot

# Choices of a fit that other controls of the window make.
_ELSEWHERE = {"fields", "beam", "psf", "source_size", "resolution", "options"}


def _cautions_of(images: Sequence[Any]) -> dict[str, str]:
    """Return the warnings of the images' readers as a row of the report."""
    texts = [
        f"'{image.name}': {caution.text}"
        for image in images
        for caution in layers.cautions_of(image)
    ]
    return {"Warning": "; ".join(texts)} if texts else {}


def _has_recorded_beam(image: Any | None) -> bool:
    """Whether an image belongs to a result with its beam, which no fit of several has found."""
    result = None if image is None else about.result_of(image)
    if result is None or about.source_of(image) is not None:
        return result is not None
    provenance = result.content.provenance
    origins = () if provenance is None else provenance.images
    return bool(origins) and all(origin.source is not None for origin in origins)


class FitImages(inputs.ImagePanel):
    """Choose images of one object at several energies, then press Run."""

    command = "fit"

    def __init__(self, napari_viewer: Any) -> None:
        tip = "Fit the fields, and an unknown beam, to all images together."
        panel = Run("Run", tip)
        super().__init__(napari_viewer, panel)
        self._build()
        self._connect()
        self._on_reference()
        self.view.follow()
        self._ready = True

    def _build(self) -> None:
        self.make_inputs(
            inputs.FIT_SOURCES,
            "The beam without the object. An unknown beam is fitted as a smooth beam, the same in "
            "all images except for its brightness.",
            FitOptions,
            inputs.SetupPicker("fit-images"),
            FIT_STEPS,
        )
        self.images = ImageTable(
            self.viewer, lambda layer: about.may_be_shot(layer) and layer is not self.source.layer
        )
        self.fields = forms.ModelPicker(
            "Fields", {}, "Field that deflects the beam. Two fields require images at two energies."
        )
        fields = FitChoices.model_fields.keys() - _ELSEWHERE
        self.choices = forms.ModelForm(FitChoices, sorted(fields))
        self.setup_section = forms.titled_section(self.setup)
        self.cost = forms.WrappingLabel()
        tip = (
            "Save the selected or last fit: complete with its layers (.shadowinv), or its field "
            "for other programs (.h5)."
        )
        self.view = ResultView(self, self._last, Fit, tip)
        self.add(self.images, self.fields, self.source, self.masks, self.choices)
        self.add(self.setup_section, *self.settings)
        self.add(side_by_side((self.keep_earlier, 1), (self.recipes, 0)), self.cost, self.panel)
        self.add(self.view)

    def _connect(self) -> None:
        self.images.reference_changed.connect(self._on_reference)
        self.images.changed.connect(self._show_beams)
        self.source.changed.connect(self.images.fill)
        self.setup.changed.connect(self._on_setup)
        self.choices.changed.connect(self._show_beams)
        for part in self.parts():
            part.changed.connect(lambda *_: self.compare())
            part.changed.connect(lambda *_: self._show_cost())
        for signal in (self.images.changed, self.images.reference_changed):
            signal.connect(self._show_cost)

    def parts(self) -> tuple[Any, ...]:
        return *super().parts(), self.fields, self.choices

    def recipe(self) -> Recipe:
        """Return the recipe of the controls, without table and layers; or raise an `InputError`."""
        choices = self.choices.model().model_copy(
            update={
                "fields": tuple(self.fields.kind.split(inputs.BOTH)),
                "beam": "unknown" if self.source.kind == inputs.UNKNOWN else "known",
                "options": self.options.model(),
            }
        )
        return self.input_recipe(steps=self.steps.steps(), fit=choices)

    def _instrument(self) -> Any:
        return self.instrument.model()  # each shot says whether its beam was measured

    def recipe_to_save(self) -> Recipe:
        recipe = self.recipe()
        assert recipe.fit is not None
        choices = recipe.fit.model_copy(update={"psf": self.common_psf()})
        return recipe.model_copy(update={"fit": choices})

    def show_recipe(self, recipe: Recipe, path: Path) -> None:
        check_fit(recipe)
        choices = recipe.fit or FitChoices()
        if recipe.estimate is not None and not isinstance(recipe.estimate, UniformEstimate):
            raise InputError(
                f"{path} estimates the source ({recipe.estimate.summary}), which a fit here does "
                "not do: add it as a layer with 'Show source' in Invert, select it, and remove the "
                "estimate from the recipe"
            )
        self.check_choices(choices, recipe.setup, path)
        beam = None
        if isinstance(recipe.source, MeasuredSource) and recipe.source.file is not None:
            beam = read_shot(recipe.source.file, variable=recipe.source.variable)
        self.show_inputs(recipe, path)
        self.show_choices(choices)
        if beam is not None:
            (self.source.layer,) = add_layers(self.viewer, layers_of_shot(beam)[-1:])
        self.source.show(recipe.source, choices.beam)

    def chosen_image(self) -> Any | None:
        """Return the layer of the reference, to which masks and source of a recipe belong."""
        return self.images.reference

    def common_psf(self) -> float | None:
        """Return the common point spread of all images; None if they differ."""
        widths = {self.images.values(image)["psf"] for image in self.images.used}
        return widths.pop() if len(widths) == 1 else None

    def check_choices(self, choices: FitChoices, setup: Setup | None, path: Path) -> None:
        """Refuse choices that do not match a setup, or else the shown setup."""
        fields = choices.fields
        available = inputs.fields_of(self.setup.kind if setup is None else setup.kind)
        if choices.source_size is not None or choices.resolution is not None:
            raise InputError(
                f"{path} gives source size or resolution in m: give psf instead, the point spread "
                "in px"
            )
        if fields is not None and inputs.field_key(fields) not in available:
            raise InputError(
                f"{path} fits the fields {', '.join(fields)}: with this setup expected one of "
                f"{', '.join(available)}; select another kind of setup first"
            )

    def show_choices(self, choices: FitChoices) -> None:
        """Show the choices of a recipe."""
        if choices.fields is not None:
            self.fields.set_kind(inputs.field_key(choices.fields))
        self.choices.restore(choices.model_dump(exclude=_ELSEWHERE))
        self.options.restore(choices.options.model_dump())
        if choices.psf is not None:
            for image in self.images.used:
                store_entries(image, psf=choices.psf)
        self._show_beams()

    def request(self) -> FitJob:
        images = self._images()
        first = images[0]
        recipe = self.recipe()
        if recipe.setup is None:
            raise InputError(
                "there is no setup: select the kind of beam, and enter the lengths; a fit without "
                "lengths, by displacements relative to the first image, is for Python and the "
                "command, as 'strength'"
            )
        shots = self._shots(images, recipe.setup)
        steps = "; ".join(step.summary for step in recipe.steps)
        described = self.describe(first, recipe, (*images, self.masks.layer), steps=steps)
        described["origins"] |= _cautions_of(images)
        name = f"{name_of_result(first).removesuffix(' fit')} fit"
        return FitJob(shots=shots, name=name, frame=result_frame(first, recipe), **described)

    def _shots(self, images: Sequence[Any], setup: Setup) -> tuple[Shot, ...]:
        """Return the images, lazy if their layers are, with all their settings."""
        rows = [self.images.values(image) for image in images]
        # One that is 1 for all need not be said.
        is_known = self._is_brightness_known and any(row["brightness"] != 1 for row in rows)
        return tuple(
            replace(
                self.shot_of(image),
                name=image.name,
                setup=self._setup_of(image, setup),
                brightness=row["brightness"] if is_known else None,
                psf=row["psf"],
                measured=self.source.layer is None or not about.is_estimate(self.source.layer),
            )
            for image, row in zip(images, rows, strict=True)
        )

    def show_result(self, finished: Finished, job: FitJob) -> None:
        self.results = self.view.show_fit(job, finished)
        self._show_cost()

    def _show_cost(self) -> None:
        try:
            images, recipe = self._images(), self.recipe()
            shape = recipe.shape_after(images[0].data.shape)
            assert recipe.fit is not None
            cost = fit_cost(shape, len(images), recipe.fit, recipe.instrument)
        except InputError:
            self.cost.setVisible(False)  # Run reports the problem
            return
        self.cost.show_text(cost.text)

    def _images(self) -> list[Any]:
        images = self.images.used
        if len(images) < 2:
            raise InputError(
                f"{len(images) or 'no'} image{'s are' if not images else ' is'} checked, expected "
                "two or more of one object: open them, split a stack (right click on the layer → "
                "Split Stack), or use 'Refine' in Invert for one image"
            )
        shape = tuple(images[0].data.shape)
        for image in images[1:]:
            if tuple(image.data.shape) != shape:
                raise InputError(
                    f"'{image.name}' has shape {tuple(image.data.shape)}, '{images[0].name}' "
                    f"{shape}: all images must have the same shape; crop or uncheck the image that "
                    "differs"
                )
        return images

    def _setup_of(self, image: Any, setup: Setup) -> Setup:
        """Return the setup of an image, its own or the reference's, with the beam of its row."""
        beam, base = self.images.beam, self._base_setup(image, setup)
        values = {**base.model_dump(), beam.name: self.images.beam_value(image)}
        model_class = SETUPS[setup.kind]
        names = labels_of(model_class) | {beam.name: f"'{beam.title}'"}
        return validate(model_class, values, f"the setup of '{image.name}'", names)

    def _base_setup(self, image: Any, setup: Setup) -> Setup:
        own = about.setup_of(image)
        is_of_kind = own is not None and own.kind == setup.kind
        return own if own and is_of_kind and image is not self.images.reference else setup

    def showEvent(self, event: Any) -> None:
        super().showEvent(event)
        # Another widget may have changed the setup of the reference.
        setup = self._setup_of_reference()
        if self._ready and setup not in (None, self.setup.complete_setup()):
            self.setup.suggest(setup, about.setup_origin_of(self.images.reference))

    def _setup_of_reference(self) -> Any:
        image = self.images.reference
        return None if image is None else about.setup_of(image)

    def _on_reference(self) -> None:
        """Show the setup of a new reference; without a setup it gets the last one."""
        image, old_setup = self.images.reference, self.setup.complete_setup()
        # Other images show the same object: none of them is the beam of another.
        self.source.follow(image if _has_recorded_beam(image) else None)
        self.setup.follow(image)
        if image is not None:
            self.masks.follow(image)
            own = self._setup_of_reference()
            if (base := own or old_setup) is not None:
                values, beam = base.model_dump(), beam_column(base.kind).name
                entry = entries_of(image).get(beam)
                if isinstance(entry, float) and own is None:
                    values[beam] = entry
                setup = self.setup.complete_setup()
                if setup is None or values != setup.model_dump():
                    self.setup.show_setup(values)
        self.view.empty()
        self._on_setup()
        # A complete setup is folded to show the controls below.
        if self.setup.complete_setup() is None:
            self.setup_section.expand(animate=False)
        else:
            self.setup_section.collapse(animate=False)

    def _on_setup(self) -> None:
        self.fields.offer(inputs.fields_of(self.setup.kind))
        setup = self.setup.complete_setup()
        summary = "none" if setup is None else f"{setup.probe}, {self.setup.origin}"
        self.setup_section.setText(f"Setup: {summary}")
        self.setup_section.setToolTip(f"Setup: {summary}")
        self._show_beams()

    def _show_beams(self) -> None:
        form = self.setup.form
        beam = None if form is None else form.state().get(self.images.beam.name)
        self.images.show_beams(self.setup.kind, beam, self._is_brightness_known)

    @property
    def _is_brightness_known(self) -> bool:
        return self.choices.state().get("brightness") != "free"
