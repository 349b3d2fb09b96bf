"""The widget that turns a shot into a field: `InvertShot`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from qtpy.QtCore import QTimer
from qtpy.QtWidgets import QCheckBox

from napari_shadowinv._napari.marks import role_of
from napari_shadowinv._napari.widgets._base import ToolPanel, with_button
from napari_shadowinv._napari.widgets._drawing import new_mask, new_shapes
from napari_shadowinv._napari.widgets._estimating import SourceCache
from napari_shadowinv._napari.widgets._forms import ModelForm, ModelPicker, kinds_of, labelled
from napari_shadowinv._napari.widgets._jobs import PREVIEW_SITES, PlanCache, ShotJob
from napari_shadowinv._napari.widgets._messages import MISTAKES, reporting, tell_warning
from napari_shadowinv._napari.widgets._panels import ReportTable, RunPanel, report_rows, section
from napari_shadowinv._napari.widgets._picking import LayerPicker, LayerWatch
from napari_shadowinv._napari.widgets._reading import crop_of, image_of, mask_of
from napari_shadowinv._napari.widgets._recipes import FILTERS
from napari_shadowinv._napari.widgets._results import ResultLayers, common_frame
from napari_shadowinv._napari.widgets._runner import Outcome
from napari_shadowinv._napari.widgets._setups import SetupPicker
from napari_shadowinv._napari.widgets._sources import SourcePicker
from napari_shadowinv._napari.widgets._toml import TomlButtons
from napari_shadowinv.options import InversionOptions
from napari_shadowinv.validation import validated

if TYPE_CHECKING:
    import napari

__all__ = ["InvertShot"]

_SETTLE = 20  # ms; a few changes at once are one
_PREVIEW_ROLES = ("potential", "field", "caustic")


@dataclass(frozen=True, eq=False)
class _Request:
    """A run, and all that it takes to show its result."""

    job: ShotJob
    image: Any
    companions: tuple[Any, ...]
    setup: Any
    preview: bool


class InvertShot(ToolPanel):
    """Choose an image, press Run; all else has a default.

    Parameters
    ----------
    viewer : napari.viewer.Viewer
        The viewer to work in.
    """

    def __init__(self, viewer: napari.viewer.Viewer) -> None:
        super().__init__(viewer, "invert-shot")
        self._cache, self._estimates = PlanCache(), SourceCache()
        self._previewed = ResultLayers(viewer)
        self._build()
        self._connect()
        self.restore(self._keeper.load())
        self._ready = True
        self._on_image()

    def _build(self) -> None:
        viewer = self.viewer
        self.image = LayerPicker(viewer, ("image",))
        self.image.setToolTip("The shot: a grey image layer.")
        self.source = SourcePicker(viewer)
        self.masks = LayerPicker(viewer, ("labels", "shapes"), none="none")
        self.masks.setToolTip("<qt>Labels or shapes that mark pixels of the detector.</qt>")
        self.painted_is_unusable = QCheckBox("painted = unusable")
        self.painted_is_unusable.setChecked(True)
        self.painted_is_unusable.setToolTip(
            "<qt>Checked: what is painted is left out (writing, dead pixels). Unchecked: only "
            "what is painted is used. What stands in the beam belongs into the source.</qt>"
        )
        self.crop = LayerPicker(viewer, ("shapes",), none="none")
        self.crop.setToolTip("<qt>A rectangle in a shapes layer: only that part is inverted.</qt>")
        self.setup = SetupPicker()
        self.cleaning = ModelPicker(
            "Filter",
            {"none": ("nothing", None), **kinds_of(FILTERS)},
        )
        self.options = ModelForm(InversionOptions, first={"n_sites": PREVIEW_SITES})
        self.option_files = TomlButtons("options", self._options_to_save, self._take_options)
        self.live = QCheckBox("Live preview")
        self.live.setToolTip(
            f"<qt>The field follows every change, with at most {PREVIEW_SITES:,} sites.</qt>"
        )
        self.panel = RunPanel("Invert shot", "Run", "Invert the image; the result comes as layers.")
        self.report = ReportTable()

        for row in (
            labelled("Image", self.image),
            self.source,
            labelled("Mask", with_button(self.masks, "✎", "Paint a mask.", self._paint_mask)),
            labelled("", self.painted_is_unusable),
            labelled("Crop", with_button(self.crop, "✎", "Draw a rectangle.", self._draw_crop)),
            self.setup,
        ):
            self.column.addWidget(row)
        self._cleaning_section = section("", self.cleaning)
        self.column.addWidget(self._cleaning_section)
        self.column.addWidget(section("Options", self.options, self.option_files))
        for widget in (self.live, self.panel, self.report):
            self.column.addWidget(widget)

    def _connect(self) -> None:
        self._settle = QTimer(self)
        self._settle.setSingleShot(True)
        self._settle.setInterval(_SETTLE)
        self._settle.timeout.connect(self._preview)
        self.panel.button.clicked.connect(lambda: self._run_or_cancel())
        self.panel.runner.ended.connect(self._on_end)
        self.image.picked.connect(self._on_image)
        self._edits = LayerWatch((self.image, self.masks, self.crop, self.source.layers))
        self._edits.setParent(self)
        for signal in (
            self.source.changed,
            self.masks.picked,
            self.crop.picked,
            self._edits.edited,
            self.setup.changed,
            self.cleaning.changed,
            self.options.changed,
            self.painted_is_unusable.toggled,
            self.live.toggled,
        ):
            signal.connect(self._on_change)

    # What is kept, and what is asked for

    def state(self) -> dict[str, Any]:
        return {
            "source": self.source.state(),
            "setup": self.setup.picker.state(),
            "cleaning": self.cleaning.state(),
            "options": self.options.values(),
            "painted_is_unusable": self.painted_is_unusable.isChecked(),
        }

    def restore(self, kept: Any) -> None:
        """Show what `state` has returned."""
        self.source.restore(kept.get("source", {}))
        self.setup.picker.restore(kept.get("setup", {}))
        self.cleaning.restore(kept.get("cleaning", {}))
        self.options.set_values(kept.get("options", {}))
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
        job = ShotJob(
            image=image,
            source=self.source.source(layer),
            mask=mask_of(self.masks.layer, layer, self.painted_is_unusable.isChecked()),
            crop=crop_of(self.crop.layer, layer),
            cleaning=self.cleaning.model(),  # type: ignore[arg-type]
            options=self.options.model(),  # type: ignore[arg-type]
            cache=self._cache,
            estimates=self._estimates,
        )
        companions = (self.masks.layer, self.crop.layer, self.source.layers.layer)
        return _Request(
            job.for_preview() if preview else job,
            layer,
            tuple(one for one in companions if one is not None and one is not layer),
            self.setup.setup(),
            preview,
        )

    # Running

    @reporting
    def _run_or_cancel(self) -> None:
        if self.panel.runner.running and not self._running_preview:
            self.panel.cancel()
            return
        request = self.request()
        self.report.setVisible(False)
        self._running_preview = False
        self.panel.run(request.job.run, request)

    _running_preview = False

    def _on_change(self) -> None:
        # A filter must not work unseen in a folded section.
        self._cleaning_section.setText(f"Filter first: {self.cleaning.choice.currentText()}")
        self.keep()
        if self._ready and self.live.isChecked():
            self._settle.start()

    def _preview(self) -> None:
        if self.panel.runner.running and not self._running_preview:
            return
        try:
            request = self.request(preview=True)
        except MISTAKES as error:
            # Half a rectangle, half a number: no reason for a notification.
            self.panel.say(str(error), problem=True)
            return
        self._running_preview = True
        self.panel.run(request.job.run, request, quiet=True)

    def _on_end(self, outcome: Outcome) -> None:
        self._running_preview = self._running_preview and outcome.tag.preview
        if outcome.value is None:
            return
        request = outcome.tag
        self._show(outcome.value, request)
        self.report.show_rows(report_rows(outcome.value))

    @reporting
    def _show(self, inversion: Any, request: _Request) -> None:
        from napari_shadowinv._napari.layers import add_layers, inversion_layers

        image = request.image
        if image not in self.viewer.layers and not request.preview:
            tell_warning(
                f"'{image.name}' was deleted while it was inverted; its result is shown all the "
                "same"
            )
        frame = common_frame(
            self.viewer, image, request.setup, request.companions, request.job.crop
        )
        described = inversion_layers(
            inversion,
            request.setup,
            name=f"{image.name} preview" if request.preview else image.name,
            scale=frame.scale,
            translate=frame.translate,
            units=frame.units,
        )
        if request.preview:
            self._previewed.show(
                [layer for layer in described if role_of(layer[1]) in _PREVIEW_ROLES]
            )
            return
        self._previewed.hide()
        added = add_layers(self.viewer, described)
        shown = [layer for layer in added if role_of(layer) == "field"]
        self.viewer.layers.selection = set(shown)

    # Layers

    def _on_image(self) -> None:
        layer = self.image.layer
        if layer is not None:
            self.source.follow(layer)
            self.setup.follow(layer)
        self._on_change()

    @reporting
    def _paint_mask(self) -> None:
        self.masks.layer = new_mask(self.viewer, self.image.layer)

    @reporting
    def _draw_crop(self) -> None:
        image_of(self.image.layer)
        self.crop.layer = new_shapes(self.viewer, self.image.layer, "crop", "add_rectangle")

    # Files

    def _options_to_save(self) -> dict[str, object]:
        self.options.model()
        return self.options.values()

    def _take_options(self, loaded: dict[str, object], path: str) -> None:
        validated(InversionOptions, loaded, path)
        self.options.set_values(loaded)
