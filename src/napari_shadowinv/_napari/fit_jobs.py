"""Fits of layers.

- a fit to run: `FitJob`; its result with layers: `FinishedFit`
- the job that refines an inversion: `refinement`
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

from napari_shadowinv._napari.fit_layers import fit_layers, setup_of_fit
from napari_shadowinv._napari.fit_progress import PACE, FitProgress, TimeEstimate, estimate_fit_time
from napari_shadowinv._napari.frame import Frame, frame_of
from napari_shadowinv._napari.layer_metadata import Result, metadata_of, result_of
from napari_shadowinv._napari.shots import load_radiograph
from napari_shadowinv._system.progress import OnProgress, Progress, ShouldStop
from napari_shadowinv.errors import InputError
from napari_shadowinv.fitting import Fit
from napari_shadowinv.inversion import Inversion
from napari_shadowinv.options import FitChoices
from napari_shadowinv.pipeline import FitShot, run_fit, run_refinement
from napari_shadowinv.pipeline.refinement import refinement_choices
from napari_shadowinv.preprocessing import Radiograph, Recipe

if TYPE_CHECKING:
    from napari_shadowinv._napari.layers import FullLayerData
    from napari_shadowinv.physics.setup import Setup


@dataclass(frozen=True, eq=False)
class FinishedFit:
    result: Result
    layer_data: list[FullLayerData]

    @property
    def fit(self) -> Fit:
        content = self.result.content
        assert isinstance(content, Fit)
        return content


@dataclass(frozen=True, eq=False)
class FitJob:
    """A fit to run, and the frame of its layers; images and sources may be lazy."""

    recipe: Recipe  # with the fit's choices, and the setup of the first image
    shots: tuple[FitShot, ...]
    names: tuple[str, ...]  # of the images
    name: str
    frame: Frame
    inputs: Sequence[tuple[str, str]]  # rows of the report
    attributes: Mapping[str, str]
    layer: Any = None  # of the first image
    companions: tuple[Any, ...] = ()

    @property
    def choices(self) -> FitChoices:
        assert self.recipe.fit is not None
        return self.recipe.fit

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of the images after the steps."""
        image: Any = self.shots[0].image
        return self.recipe.shape_after(image.image.shape)

    @cached_property
    def progress(self) -> FitProgress:
        """Progress of the fit, and its objectives so far."""
        return FitProgress(self.time_estimate)

    @property
    def time_estimate(self) -> TimeEstimate:
        """Estimate of the fit's time."""
        choices = self.choices
        source = choices.beam if choices.beam == "unknown" else None
        fields = len(choices.fields or ("B",))
        return estimate_fit_time(self.shape, len(self.names), fields, source, choices.options)

    def run(self, on_progress: OnProgress, should_stop: ShouldStop) -> FinishedFit:
        """Fit the images and describe the layers."""

        def update(progress: Progress) -> None:
            on_progress(self.progress.update(progress))

        fit = self.compute(update, should_stop)
        PACE.learn(self.time_estimate, sum(fit.report.seconds.values()))
        result = Result(fit, setup_of_fit(fit), dict(self.attributes))
        return FinishedFit(result, fit_layers(result, self.frame, self.name))

    def compute(
        self, on_progress: OnProgress | None = None, should_stop: ShouldStop | None = None
    ) -> Fit:
        """Load the images, apply the recipe's steps, and fit."""
        names = [f"'{name}'" for name in self.names]
        shots = [_load(shot, name) for shot, name in zip(self.shots, names, strict=True)]
        return run_fit(
            self.recipe, shots, names=names, on_progress=on_progress, should_stop=should_stop
        )


def _load(shot: FitShot, name: str) -> FitShot:
    image, source = shot.image, shot.source
    if isinstance(image, Radiograph):
        image = load_radiograph(image, name)
    if isinstance(source, Radiograph):
        source = load_radiograph(source, f"the source of {name}")
    return replace(shot, image=image, source=source)


@dataclass(frozen=True, eq=False)
class Refinement(FitJob):
    """A fit to the image of an inversion, starting from the inversion."""

    inversion: Inversion | None = None
    setup: Setup | None = None

    @property
    def shape(self) -> tuple[int, ...]:
        assert self.inversion is not None
        return self.inversion.image.shape

    def compute(
        self, on_progress: OnProgress | None = None, should_stop: ShouldStop | None = None
    ) -> Fit:
        """Fit, starting from the inversion."""
        assert self.inversion is not None
        return run_refinement(
            self.inversion,
            self.setup,
            self.choices,
            on_progress=on_progress,
            should_stop=should_stop,
        )


def refinement(layer: Any, image: Any, name: str, psf: float) -> Refinement:
    """Return the job that fits an inversion's image with its source, mask and setup.

    `layer` belongs to the inversion, `image` is the layer of its shot, or `layer` again.
    """
    result = result_of(layer)
    if result is None or not isinstance(result.content, Inversion):
        kind = "a fit" if result is not None and isinstance(result.content, Fit) else "no inversion"
        raise InputError(
            f"layer '{layer.name}' shows {kind}: select a layer of an inversion's result, such as "
            "the field"
        )
    inversion, setup = result.content, result.setup
    choices = refinement_choices(inversion, setup, psf)
    inputs = [
        ("Start", f"the inversion of '{name}'"),
        ("Point spread", f"σ {psf:g} px" if psf else "none"),
    ]
    attributes = {"start_origin": f"the inversion of '{name}'"}
    return Refinement(
        recipe=Recipe(fit=choices),
        shots=(),
        names=(name,),
        name=f"{name} refined",
        frame=frame_of(layer),
        inputs=inputs,
        attributes=attributes,
        layer=image,
        inversion=inversion,
        setup=setup,
    )


def name_of_result(layer: Any) -> str:
    """Return the name of the result that a layer belongs to, or else the layer's name."""
    return str(metadata_of(layer).get("name") or layer.name)
