"""The widget that guesses the undisturbed beam: `EstimateSource`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from qtpy.QtWidgets import QCheckBox

from napari_shadowinv._napari.frame import frame_of
from napari_shadowinv._napari.marks import mark, setup_of
from napari_shadowinv._napari.widgets._base import with_button
from napari_shadowinv._napari.widgets._drawing import new_mask
from napari_shadowinv._napari.widgets._forms import ModelPicker, kinds_of, labelled
from napari_shadowinv._napari.widgets._jobs import SourceJob
from napari_shadowinv._napari.widgets._live import LivePanel
from napari_shadowinv._napari.widgets._messages import reporting
from napari_shadowinv._napari.widgets._panels import RunPanel
from napari_shadowinv._napari.widgets._picking import LayerPicker, LayerWatch
from napari_shadowinv._napari.widgets._reading import image_of, mask_of
from napari_shadowinv._napari.widgets._recipes import ESTIMATES
from napari_shadowinv._napari.widgets._results import ResultLayers
from napari_shadowinv.progress import OnProgress, ShouldStop

if TYPE_CHECKING:
    import napari

__all__ = ["EstimateSource"]


@dataclass(frozen=True, eq=False)
class _Request:
    job: SourceJob
    image: Any
    preview: bool

    def run(self, on_progress: OnProgress, should_stop: ShouldStop) -> Any:
        return self.job.run(on_progress, should_stop)


class EstimateSource(LivePanel):
    """Choose a shot and a method; the estimate becomes an image layer.

    Parameters
    ----------
    viewer : napari.viewer.Viewer
        The viewer to work in.
    """

    def __init__(self, viewer: napari.viewer.Viewer) -> None:
        super().__init__(
            viewer,
            "estimate-source",
            RunPanel("Estimate source", "Estimate", "Make an image layer of the beam."),
        )
        self.previewed = ResultLayers(viewer, self)
        self.image = LayerPicker(viewer, ("image",))
        self.image.setToolTip("The shot: a grey image layer.")
        self.masks = LayerPicker(viewer, ("labels", "shapes"), none="none")
        self.masks.setToolTip("<qt>Labels or shapes that mark what the estimate must not see.</qt>")
        self.painted_is_unusable = QCheckBox("painted = unusable")
        self.painted_is_unusable.setChecked(True)
        self.method = ModelPicker("Method", kinds_of(ESTIMATES))
        self.live.setToolTip("The estimate follows every change.")
        for row in (
            labelled("Image", self.image),
            labelled("Mask", with_button(self.masks, "✎", "Paint a mask.", self._paint_mask)),
            labelled("", self.painted_is_unusable),
            self.method,
            self.live,
            self.panel,
        ):
            self.column.addWidget(row)
        self._connect()
        self.restore(self._keeper.load())
        self._ready = True

    def _connect(self) -> None:
        self._edits = LayerWatch((self.image, self.masks))
        self._edits.setParent(self)
        for signal in (
            self.image.picked,
            self.masks.picked,
            self.method.changed,
            self.painted_is_unusable.toggled,
            self._edits.edited,
        ):
            signal.connect(self.on_change)

    def state(self) -> dict[str, Any]:
        return {
            "method": self.method.state(),
            "painted_is_unusable": self.painted_is_unusable.isChecked(),
        }

    def restore(self, kept: Any) -> None:
        """Show what `state` has returned."""
        self.method.restore(kept.get("method", {"kind": "total_variation"}))
        self.painted_is_unusable.setChecked(bool(kept.get("painted_is_unusable", True)))

    def request(self, preview: bool = False) -> _Request:
        layer = self.image.layer
        image = image_of(layer)
        mask = mask_of(self.masks.layer, layer, self.painted_is_unusable.isChecked())
        estimate: Any = self.method.model()
        return _Request(SourceJob(image, estimate, mask, quick=preview), layer, preview)

    def show_result(self, value: Any, request: _Request) -> None:
        layer, preview = request.image, request.preview
        described = (
            value,
            {
                "name": f"{layer.name} source{' preview' if preview else ''}",
                "metadata": mark("source", "", setup_of(layer)),
                "colormap": layer.colormap.name,
                "contrast_limits": tuple(layer.contrast_limits),
                **frame_of(layer).keywords(),
            },
            "image",
        )
        shown = self.previewed if preview else ResultLayers(self.viewer, self)
        if not preview:
            self.previewed.hide()
        shown.show([described], select=not preview)

    @reporting
    def _paint_mask(self) -> None:
        self.masks.layer = new_mask(self.viewer, self.image.layer)
