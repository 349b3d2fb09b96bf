"""Work on layers in a thread.

- something to compute, and the layers that come of it: `Job`, `Finished`; on an image: `ImageJob`
- an inversion: `InversionJob`; its estimated source: `source_job`
- a fit: `FitJob`; the fit that refines an inversion: `refinement`
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

from napari_shadowinv._napari import layer_metadata as about
from napari_shadowinv._napari.layer_metadata import KEY, Frame, Result, frame_of, result_of, role_of
from napari_shadowinv._napari.layers import LayerData, fit_layers, result_layers
from napari_shadowinv._napari.shots import shot_in_memory, shot_layer
from napari_shadowinv._system.progress import OnProgress, Reporter, ShouldStop
from napari_shadowinv._typing import FloatArray
from napari_shadowinv.errors import InputError
from napari_shadowinv.fitting import Fit
from napari_shadowinv.inversion import Inversion
from napari_shadowinv.pipeline.fit_run import refinement_choices, run_fit, run_refinement
from napari_shadowinv.pipeline.inversion_run import Cache, run
from napari_shadowinv.preprocessing import Estimate, Recipe, estimate_source
from napari_shadowinv.shot import Shot

_PREVIEW_ROLES = ("field", "caustic")


@dataclass(frozen=True, eq=False)
class Finished:
    """The result of a job, and the layers that show it."""

    content: Any
    layer_data: LayerData

    @property
    def result(self) -> Result[Any]:
        result = result_of(self.layer_data[0][1])
        assert result is not None
        return result


class Job:
    """Something to compute in a thread, and a description of the layers that come of it.

    The result of the next job on the same `subject`, an image layer or a name, takes the place of
    this one's. Cancelled work that does not stop is left alone after `patience` (s).
    """

    patience: ClassVar[float] = 0.5
    show: Callable[[Any, Any], Any] | None = None  # its result, unless its window does

    def __init__(
        self, compute: Callable[..., Any], describe: Callable[[Any], LayerData], subject: Any = None
    ) -> None:
        self._compute, self._describe, self.subject = compute, describe, subject

    def run(self, on_progress: OnProgress, should_stop: ShouldStop) -> Any:
        return self._compute(on_progress=on_progress, should_stop=should_stop)

    def layers(self, content: Any) -> LayerData:
        """Describe the layers of the result, the lowest first."""
        return self._describe(content)

    def work(self, on_progress: OnProgress, should_stop: ShouldStop) -> Finished:
        """Compute the result and describe its layers, both in the thread."""
        content = self.run(on_progress, should_stop)
        return Finished(content, self.layers(content))


@dataclass(eq=False, kw_only=True)
class ImageJob(Job):
    """A job on the image or the stack of a layer."""

    task: ClassVar[str]

    recipe: Recipe
    name: str = ""  # of the result
    frame: Frame = field(default_factory=Frame)
    origins: Mapping[str, str] = field(default_factory=dict)  # of its inputs, saved and reported
    image: Any = None  # the layer
    companions: tuple[Any, ...] = ()  # layers that lie on the image

    @property
    def image_name(self) -> str:
        return str(self.image.name)


@dataclass(eq=False, kw_only=True)
class InversionJob(ImageJob):
    """An inversion of a shot with its masks; image and source may be lazy."""

    task: ClassVar[str] = "inversion"

    shot: Shot
    cache: Cache | None = None
    preview: bool = False

    def run(self, on_progress: OnProgress, should_stop: ShouldStop) -> Inversion:
        return run(
            self.recipe,
            shot_in_memory(self.shot, "the image", "the source"),
            on_progress=on_progress,
            should_stop=should_stop,
            cache=self.cache,
            preview=self.preview,
        )

    def layers(self, content: Inversion) -> LayerData:
        """Describe the layers of the inversion; of a preview only the field and its caustics."""
        name = f"{self.name} preview" if self.preview else self.name
        result = Result(content, self.origins)
        layer_data = result_layers(result, self.frame, name)
        mask = self.shot.source_mask
        for _, keywords, _ in layer_data:
            if role_of(keywords) == about.SOURCE and mask is not None:
                masked = Shot(mask.astype(float), source_mask=mask)
                keywords["metadata"][KEY]["source_mask"] = self.recipe.move(masked).source_mask
        if self.preview:
            layer_data = [layer for layer in layer_data if role_of(layer[1]) in _PREVIEW_ROLES]
        return layer_data


def source_job(estimate: Estimate, shot: Shot, image: Any, made_from: dict[str, str]) -> Job:
    """Return the job that estimates the source of a shot, whose image may be lazy."""

    def compute(on_progress: OnProgress, should_stop: ShouldStop) -> FloatArray:
        Reporter(on_progress, should_stop)("source", 0, None, estimate.title)
        return estimate_source(estimate, shot_in_memory(shot, "the image"), should_stop)

    def describe(content: FloatArray) -> LayerData:
        layer = shot_layer(
            content,
            f"{image.name} source: {estimate.title}",
            about.setup_of(image),
            tuple(image.contrast_limits),
            about.SOURCE,
            frame=frame_of(image),
            unit="",
            setup_origin=about.setup_origin_of(image),
            made_from=made_from,
            source_mask=shot.source_mask,
        )
        return [layer]

    return Job(compute, describe, subject=(image, about.SOURCE))


@dataclass(eq=False, kw_only=True)
class FitJob(ImageJob):
    """A fit to several images; images and sources may be lazy.

    The recipe holds the choices of the fit and the setup of the first image. A `start` is the
    inversion that the fit refines.
    """

    task: ClassVar[str] = "fit"

    shots: tuple[Shot, ...]  # with the names of their images
    start: Inversion | None = None

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(str(shot.name) for shot in self.shots)

    def run(self, on_progress: OnProgress, should_stop: ShouldStop) -> Fit:
        """Load the images, apply the recipe's steps, and fit; or refine the inversion."""
        callbacks: Any = {"on_progress": on_progress, "should_stop": should_stop}
        if self.start is not None:
            assert self.recipe.fit is not None
            return run_refinement(self.start, self.start.setup, self.recipe.fit, **callbacks)
        names = [f"'{name}'" for name in self.names]
        shots = [
            replace(shot_in_memory(shot, name, f"the source of {name}"), name=name)
            for shot, name in zip(self.shots, names, strict=True)
        ]
        return run_fit(self.recipe, shots, **callbacks)

    def layers(self, content: Fit) -> LayerData:
        return fit_layers(Result(content, self.origins), self.frame, self.name)


def refinement(layer: Any, image: Any, name: str, psf: float) -> FitJob:
    """Return the job that fits an inversion's image with its source, mask and setup.

    `layer` belongs to the inversion, `image` is the layer of its shot, or `layer` again.
    """
    result = result_of(layer)
    if result is None or not isinstance(result.content, Inversion):
        kind = "no result" if result is None else f"a {result.content.kind.noun}"
        raise InputError(
            f"layer '{layer.name}' shows {kind}: select a layer of an inversion's result, such as "
            "the field"
        )
    inversion = result.content
    start = f"the inversion of '{name}'"
    return FitJob(
        recipe=Recipe(fit=refinement_choices(inversion, inversion.setup, psf)),
        shots=(Shot(inversion.image, name=name),),
        name=f"{name} refined",
        frame=frame_of(layer),
        origins={"Start": start, "Point spread": f"σ {psf:g} px" if psf else "none"},
        image=image,
        start=inversion,
    )


def name_of_result(layer: Any) -> str:
    """Return the name of the result that a layer belongs to, or else the layer's name."""
    return str(about.metadata_of(layer).get("name") or layer.name)
