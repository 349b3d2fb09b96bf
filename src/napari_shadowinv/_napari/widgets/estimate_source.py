"""The widget that estimates the undisturbed beam: `EstimateSource`."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

from napari_shadowinv._napari import layer_metadata as about
from napari_shadowinv._napari.frame import frame_of
from napari_shadowinv._napari.jobs import Finished, Job
from napari_shadowinv._napari.layers import FullLayerData
from napari_shadowinv._napari.shots import load_radiograph
from napari_shadowinv._napari.widgets._forms import ModelPicker, kinds_of, labelled
from napari_shadowinv._napari.widgets._layers import LayerWatch, MaskPicker, ShotPicker, image_of
from napari_shadowinv._napari.widgets._panels import LivePanel, RunPanel
from napari_shadowinv._system.progress import OnProgress, Reporter, ShouldStop
from napari_shadowinv._typing import FloatArray
from napari_shadowinv.pipeline import Cache
from napari_shadowinv.pipeline.inversion_run import PREVIEW_PIXELS
from napari_shadowinv.preprocessing import ESTIMATES, Estimate, Radiograph, estimate_source

if TYPE_CHECKING:
    import napari


@dataclass(frozen=True, eq=False)
class SourceJob(Job):
    estimate: Estimate
    shot: Radiograph  # its image may be lazy
    image: Any
    made_from: dict[str, str]
    preview: bool

    def run(self, on_progress: OnProgress, should_stop: ShouldStop) -> FloatArray:
        report = Reporter(on_progress, should_stop)
        report("source", 0, None, self.estimate.title)
        shot = load_radiograph(self.shot, "the image")
        max_pixels = PREVIEW_PIXELS if self.preview else None
        by = partial(Cache().source, self.estimate, most_pixels=max_pixels)
        source = estimate_source(self.estimate, shot, should_stop, by=by)
        report("source", 1, 1)
        return source

    def layers(self, content: FloatArray) -> list[FullLayerData]:
        """Describe the source as a layer over its image."""
        layer: Any = self.image
        layer_data = (
            content,
            {
                "name": f"{layer.name} source{' preview' if self.preview else ''}",
                "metadata": about.metadata_for(
                    about.SOURCE,
                    "",
                    about.setup_of(layer),
                    setup_origin=about.setup_origin_of(layer),
                    made_from=self.made_from,
                    source_mask=self.shot.source_mask,
                ),
                "colormap": layer.colormap.name,
                "contrast_limits": tuple(layer.contrast_limits),
                **frame_of(layer).keywords(),
            },
            "image",
        )
        return [layer_data]


class EstimateSource(LivePanel):
    """Choose a shot and a method, and add the estimated source as an image layer."""

    def __init__(self, viewer: napari.viewer.Viewer) -> None:
        tip = "Estimate the beam and add it as an image layer."
        super().__init__(viewer, "estimate-source", RunPanel("Estimate source", "Estimate", tip))
        self.image = ShotPicker(viewer)
        tip = "Labels or shapes on pixels that the estimate ignores."
        self.masks = MaskPicker(viewer, lambda: self.image.layer, ("labels", "shapes"), tip)
        self.method = ModelPicker("Method", kinds_of(ESTIMATES))
        self.method.set_kind("total-variation")
        self.live.setToolTip("Update the estimate after each change.")
        self.add(labelled("Image", self.image), self.masks, self.method)
        self.add(self.live, self.keep_earlier, self.panel)
        edits = LayerWatch(self, (self.image, self.masks))
        for signal in (self.image.picked, self.masks.changed, self.method.changed, edits.edited):
            signal.connect(self.on_change)
        self.restore_last()
        self._ready = True

    def parts(self) -> dict[str, Any]:
        return {"method": self.method, "painted_is_unusable": self.masks}

    def request(self, preview: bool = False) -> SourceJob:
        layer: Any = self.image.layer
        image = image_of(layer)
        mask = self.masks.usable(layer)
        model: Any = self.method.model()
        estimate = model.adapt_to(about.setup_of(layer), image.shape)
        made_from = {"image": layer.name, "estimate": estimate.summary}
        if mask is not None:
            made_from["source_mask"] = self.masks.summary(layer)
        return SourceJob(estimate, Radiograph(image, source_mask=mask), layer, made_from, preview)

    def show_result(self, finished: Finished, job: SourceJob) -> None:
        self.show_layers(job.image, finished.layer_data, job.preview)
