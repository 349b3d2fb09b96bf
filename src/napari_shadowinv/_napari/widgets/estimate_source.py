"""The widget that guesses the undisturbed beam: `EstimateSource`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from qtpy.QtCore import QTimer
from qtpy.QtWidgets import QCheckBox

from napari_shadowinv._napari.frame import frame_of
from napari_shadowinv._napari.marks import mark, setup_of
from napari_shadowinv._napari.widgets._base import ToolPanel, with_button
from napari_shadowinv._napari.widgets._drawing import new_mask
from napari_shadowinv._napari.widgets._forms import ModelPicker, kinds_of, labelled
from napari_shadowinv._napari.widgets._jobs import SourceJob
from napari_shadowinv._napari.widgets._messages import MISTAKES, reporting
from napari_shadowinv._napari.widgets._panels import RunPanel
from napari_shadowinv._napari.widgets._picking import LayerPicker, LayerWatch
from napari_shadowinv._napari.widgets._reading import image_of, mask_of
from napari_shadowinv._napari.widgets._recipes import ESTIMATES
from napari_shadowinv._napari.widgets._results import ResultLayers
from napari_shadowinv._napari.widgets._runner import Outcome

if TYPE_CHECKING:
    import napari

__all__ = ["EstimateSource"]

_SETTLE = 20  # ms


@dataclass(frozen=True, eq=False)
class _Request:
    job: SourceJob
    image: Any
    preview: bool


class EstimateSource(ToolPanel):
    """Choose a shot and a method; the estimate becomes an image layer.

    Parameters
    ----------
    viewer : napari.viewer.Viewer
        The viewer to work in.
    """

    def __init__(self, viewer: napari.viewer.Viewer) -> None:
        super().__init__(viewer, "estimate-source")
        self._previewed = ResultLayers(viewer)
        self._running_preview = False
        self.image = LayerPicker(viewer, ("image",))
        self.image.setToolTip("The shot: a grey image layer.")
        self.masks = LayerPicker(viewer, ("labels", "shapes"), none="none")
        self.masks.setToolTip("<qt>Labels or shapes that mark what the estimate must not see.</qt>")
        self.painted_is_unusable = QCheckBox("painted = unusable")
        self.painted_is_unusable.setChecked(True)
        self.method = ModelPicker("Method", kinds_of(ESTIMATES))
        self.live = QCheckBox("Live preview")
        self.live.setToolTip("The estimate follows every change.")
        self.panel = RunPanel(
            "Estimate source", "Estimate", "Make an image layer of the undisturbed beam."
        )
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
        self._settle = QTimer(self)
        self._settle.setSingleShot(True)
        self._settle.setInterval(_SETTLE)
        self._settle.timeout.connect(self._preview)
        self._edits = LayerWatch((self.image, self.masks))
        self._edits.setParent(self)
        self.panel.button.clicked.connect(lambda: self._run_or_cancel())
        self.panel.runner.ended.connect(self._on_end)
        for signal in (
            self.image.picked,
            self.masks.picked,
            self.method.changed,
            self.painted_is_unusable.toggled,
            self._edits.edited,
            self.live.toggled,
        ):
            signal.connect(self._on_change)

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
        """What the controls ask for.

        Raises
        ------
        InputError
            If there is no image, or anything else that cannot be used.
        """
        layer = self.image.layer
        image = image_of(layer)
        mask = mask_of(self.masks.layer, layer, self.painted_is_unusable.isChecked())
        estimate: Any = self.method.model()
        return _Request(SourceJob(image, estimate, mask, quick=preview), layer, preview)

    @reporting
    def _run_or_cancel(self) -> None:
        if self.panel.runner.running and not self._running_preview:
            self.panel.cancel()
            return
        request = self.request()
        self._running_preview = False
        self.panel.run(request.job.run, request)

    def _on_change(self) -> None:
        self.keep()
        if self._ready and self.live.isChecked():
            self._settle.start()

    def _preview(self) -> None:
        if self.panel.runner.running and not self._running_preview:
            return
        try:
            request = self.request(preview=True)
        except MISTAKES as error:
            self.panel.say(str(error), problem=True)
            return
        self._running_preview = True
        self.panel.run(request.job.run, request, quiet=True)

    def _on_end(self, outcome: Outcome) -> None:
        self._running_preview = self._running_preview and outcome.tag.preview
        if outcome.value is None:
            return
        layer, preview = outcome.tag.image, outcome.tag.preview
        described = (
            outcome.value,
            {
                "name": f"{layer.name} source{' preview' if preview else ''}",
                "metadata": mark("source", "", setup_of(layer)),
                "colormap": layer.colormap.name,
                "contrast_limits": tuple(layer.contrast_limits),
                **frame_of(layer).keywords(),
            },
            "image",
        )
        shown = self._previewed if preview else ResultLayers(self.viewer)
        if not preview:
            self._previewed.hide()
        shown.show([described])

    @reporting
    def _paint_mask(self) -> None:
        self.masks.layer = new_mask(self.viewer, self.image.layer)
