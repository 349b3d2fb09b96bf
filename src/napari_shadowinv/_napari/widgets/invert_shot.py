"""The widget that turns a shot into a field: `InvertShot`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from napari_shadowinv._napari.frame import Frame
from napari_shadowinv._napari.marks import Result, role_of
from napari_shadowinv._napari.widgets._base import Part, with_button
from napari_shadowinv._napari.widgets._cleaning import CleaningSection
from napari_shadowinv._napari.widgets._drawing import new_shapes
from napari_shadowinv._napari.widgets._estimating import SourceCache
from napari_shadowinv._napari.widgets._forms import labelled
from napari_shadowinv._napari.widgets._jobs import PREVIEW_SITES, PlanCache, ShotJob
from napari_shadowinv._napari.widgets._live import LivePanel
from napari_shadowinv._napari.widgets._masks import MaskPicker
from napari_shadowinv._napari.widgets._messages import reporting, tell_warning
from napari_shadowinv._napari.widgets._options import OptionsForm
from napari_shadowinv._napari.widgets._panels import ReportTable, RunPanel, report_rows, section
from napari_shadowinv._napari.widgets._picking import LayerPicker, LayerWatch
from napari_shadowinv._napari.widgets._reading import crop_of, image_of
from napari_shadowinv._napari.widgets._results import ResultLayers, place_together, result_frame
from napari_shadowinv._napari.widgets._setups import SetupPicker
from napari_shadowinv._napari.widgets._sources import SourcePicker
from napari_shadowinv.io.files import text_of
from napari_shadowinv.progress import OnProgress, ShouldStop

if TYPE_CHECKING:
    import napari
    from napari_shadowinv._napari.layers import FullLayerData
    from napari_shadowinv.inversion import Inversion

__all__ = ["InvertShot"]

_PREVIEW_ROLES = ("potential", "field", "caustic")


@dataclass(frozen=True, eq=False)
class _Answer:
    inversion: Inversion
    described: list[FullLayerData]


@dataclass(frozen=True, eq=False)
class _Request:
    """A run, and all that it takes to show its result."""

    job: ShotJob
    image: Any
    companions: tuple[Any, ...]
    setup: Any
    frame: Frame
    preview: bool

    def run(self, on_progress: OnProgress, should_stop: ShouldStop) -> _Answer:
        """Invert the shot and describe its layers, all of it beside the window."""
        inversion = self.job.run(on_progress, should_stop)
        from napari_shadowinv._napari.layers import result_layers

        name = f"{self.image.name} preview" if self.preview else self.image.name
        file = self.image.source.path
        told = {} if file is None else {"input_file": text_of(Path(file).name)}
        result = Result(inversion, self.setup, {**told, **self.job.attributes()})
        described = result_layers(result, self.frame, name)
        if self.preview:
            described = [layer for layer in described if role_of(layer[1]) in _PREVIEW_ROLES]
        return _Answer(inversion, described)


class InvertShot(LivePanel):
    """Choose an image, press Run; all else has a default.

    Parameters
    ----------
    viewer : napari.viewer.Viewer
        The viewer to work in.
    """

    def __init__(self, viewer: napari.viewer.Viewer) -> None:
        super().__init__(
            viewer,
            "invert-shot",
            RunPanel("Invert shot", "Run", "Invert the image; the result comes as layers."),
        )
        self._cache, self._estimates = PlanCache(), SourceCache()
        self.previewed = ResultLayers(viewer, self)
        self._build()
        self._connect()
        self.restore_last()
        self._on_image()
        self._ready = True

    def _build(self) -> None:
        viewer = self.viewer
        self.image = LayerPicker(viewer, ("image",))
        self.image.setToolTip("The shot: a grey image layer.")
        self.source = SourcePicker(viewer)
        self.masks = MaskPicker(
            viewer,
            lambda: self.image.layer,
            ("labels", "shapes"),
            "Labels or shapes that mark pixels of the detector.",
        )
        self.crop = LayerPicker(viewer, ("shapes",), none="none")
        self.crop.setToolTip("<qt>A rectangle in a shapes layer: only that part is inverted.</qt>")
        self.setup = SetupPicker()
        self.cleaning = CleaningSection()
        self.options = OptionsForm()
        self.live.setToolTip(
            f"<qt>The field follows every change, with at most {PREVIEW_SITES:,} sites.</qt>"
        )
        self.report = ReportTable()

        for row in (
            labelled("Image", self.image),
            self.source,
            self.masks,
            labelled("Crop", with_button(self.crop, "✎", "Draw a rectangle.", self._draw_crop)),
            self.setup,
            self.cleaning,
        ):
            self.column.addWidget(row)
        self.column.addWidget(section("Options", self.options))
        for widget in (self.live, self.panel, self.report):
            self.column.addWidget(widget)

    def _connect(self) -> None:
        self.image.picked.connect(self._on_image)
        self._edits = LayerWatch((self.image, self.masks, self.crop, self.source.layers))
        self._edits.setParent(self)
        for signal in (
            self.source.changed,
            self.masks.changed,
            self.crop.picked,
            self._edits.edited,
            self.setup.changed,
            self.cleaning.changed,
            self.options.changed,
        ):
            signal.connect(self.on_change)

    # What is kept, and what is asked for

    def parts(self) -> dict[str, Part]:
        return {
            "source": self.source,
            "setup": self.setup,
            "cleaning": self.cleaning,
            "options": self.options,
            "painted_is_unusable": self.masks,
        }

    def request(self, preview: bool = False) -> _Request:
        layer = self.image.layer
        image = image_of(layer)
        job = ShotJob(
            image=image,
            source=self.source.source(layer),
            mask=self.masks.usable(layer),
            crop=crop_of(self.crop.layer, layer),
            cleaning=self.cleaning.model(),
            options=self.options.model(),  # type: ignore[arg-type]
            cache=self._cache,
            estimates=self._estimates,
        )
        setup = self.setup.setup()
        companions = (self.masks.layer, self.crop.layer, self.source.layers.layer)
        return _Request(
            job.for_preview() if preview else job,
            layer,
            tuple(one for one in companions if one is not None and one is not layer),
            setup,
            result_frame(layer, setup, job.crop),
            preview,
        )

    def show_result(self, value: _Answer, request: _Request) -> None:
        image = request.image
        if image not in self.viewer.layers and not request.preview:
            tell_warning(
                f"'{image.name}' was deleted while it was inverted; its result is shown all the "
                "same"
            )
        if request.setup is not None:
            place_together(self.viewer, image, request.setup, request.companions)
        if request.preview:
            self.previewed.show(value.described, select=False)
            if not value.inversion.report.converged:
                self.panel.say(f"Preview {value.inversion.report.warnings[0]}", problem=True)
            return
        self.report.show_rows(report_rows(value.inversion))
        self.previewed.hide()
        self.results = ResultLayers(self.viewer, self)
        self.results.show(value.described)

    # Layers

    def _on_image(self) -> None:
        layer = self.image.layer
        if layer is not None:
            self.source.follow(layer)
            self.setup.follow(layer)
        self.on_change()

    @reporting
    def _draw_crop(self) -> None:
        image_of(self.image.layer)
        self.crop.layer = new_shapes(self.viewer, self.image.layer, "crop", "add_rectangle")
