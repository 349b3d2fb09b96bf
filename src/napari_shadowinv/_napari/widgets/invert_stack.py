"""The widget that turns a run of shots into a store of fields: `InvertStack`."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from numpy.typing import ArrayLike
from qtpy.QtCore import QTimer
from qtpy.QtWidgets import QCheckBox, QLabel

from napari_shadowinv._napari.layer_metadata import role_of
from napari_shadowinv._napari.stores import follow_shots
from napari_shadowinv._napari.widgets._base import Part, ToolPanel
from napari_shadowinv._napari.widgets._cleaning import CleaningSection
from napari_shadowinv._napari.widgets._forms import labelled
from napari_shadowinv._napari.widgets._masks import MaskPicker
from napari_shadowinv._napari.widgets._notifications import MISTAKES, notify_errors
from napari_shadowinv._napari.widgets._options import OptionsForm
from napari_shadowinv._napari.widgets._origins import Origins
from napari_shadowinv._napari.widgets._panels import ReportTable, RunPanel, section
from napari_shadowinv._napari.widgets._reading import stack_of
from napari_shadowinv._napari.widgets._results import ResultLayers, place_together
from napari_shadowinv._napari.widgets._runner import Outcome
from napari_shadowinv._napari.widgets._setups import SetupPicker
from napari_shadowinv._napari.widgets._sources import SourcePicker
from napari_shadowinv._napari.widgets._stack_inputs import EnginePicker, ShotsPicker, StoreEdit
from napari_shadowinv._napari.widgets._stack_results import FailureTable, StackRequest, place_on
from napari_shadowinv._napari.widgets._stacking import StackJob
from napari_shadowinv._system.progress import Progress

if TYPE_CHECKING:
    import napari

__all__ = ["InvertStack"]

_REFRESH_AFTER = 200  # ms; many small shots may end in a second


class InvertStack(ToolPanel):
    """Choose shots and a store, press Run; press it again to go on after an interruption.

    Parameters
    ----------
    viewer : napari.viewer.Viewer
        The viewer to work in.
    """

    def __init__(self, viewer: napari.viewer.Viewer) -> None:
        super().__init__(viewer, "invert-stack")
        self.panel = RunPanel(
            "Invert stack",
            "Run",
            "Invert all shots not yet in the store.",
            patience=math.inf,  # until it has left the store
        )
        self.results = ResultLayers(viewer, self)
        self._shown: StackRequest | None = None
        self._running: StackRequest | None = None
        self._heard = 0
        self._look_at = False
        self._arrows: Any = None
        self._read_arrows: Callable[[], None] | None = None
        self._soon = QTimer(self)
        self._soon.setSingleShot(True)
        self._soon.setInterval(_REFRESH_AFTER)
        self._soon.timeout.connect(self._refresh)
        self._build()
        self._connect()
        self.restore_last()
        self._on_layer()
        self._ready = True

    def _build(self) -> None:
        self.shots = ShotsPicker(self.viewer)
        self.source = SourcePicker(self.viewer)
        self.masks = MaskPicker(
            self.viewer,
            lambda: self.shots.layer,
            ("labels",),
            "Labels marking detector pixels in all shots. The inversion ignores masked pixels, "
            "so do not mask the object.",
        )
        self.source_masks = MaskPicker(
            self.viewer,
            lambda: self.shots.layer,
            ("labels",),
            "Labels that hide the object from the source estimates only; the inversion still "
            "uses it.",
            "Source mask",
        )
        self.setup = SetupPicker()
        self.cleaning = CleaningSection()
        self.options = OptionsForm()
        self.store = StoreEdit()
        self.overwrite = QCheckBox("overwrite the store")
        self.overwrite.setToolTip("<qt>Start from scratch. Otherwise the run is resumed.</qt>")
        self.redo_failed = QCheckBox("redo failed shots")
        self.redo_failed.setToolTip("<qt>Retry shots that failed in an earlier run.</qt>")
        self.engine = EnginePicker()
        self.report = ReportTable()
        self.failures_title = QLabel("Failed shots")
        self.failures_title.setVisible(False)
        self.failures = FailureTable()
        for row in (
            self.shots,
            self.source,
            self.source_masks,
            self.masks,
            self.setup,
            self.cleaning,
            section("Options", self.options),
            labelled("Store", self.store),
            labelled("", self.overwrite),
            labelled("", self.redo_failed),
            self.engine,
            self.panel,
            self.report,
            self.failures_title,
            self.failures,
        ):
            self.column.addWidget(row)

    def _connect(self) -> None:
        self.shots.changed.connect(self._on_layer)
        for signal in (
            self.source.changed,
            self.setup.changed,
            self.cleaning.changed,
            self.options.changed,
            self.engine.changed,
            self.masks.changed,
            self.source_masks.changed,
        ):
            signal.connect(self.keep)
        self.source.changed.connect(self._show_source_mask)
        self._show_source_mask()
        self.panel.button.clicked.connect(lambda: self._run_or_cancel())
        self.panel.runner.progressed.connect(self._on_progress)
        self.panel.runner.ended.connect(self._on_end)

    # What is kept, and what is asked for

    def parts(self) -> dict[str, Part]:
        return {
            "source": self.source,
            "setup": self.setup,
            "cleaning": self.cleaning,
            "options": self.options,
            "engine": self.engine,
            "painted_is_unusable": self.masks,
            "painted_is_object": self.source_masks,
        }

    def request(self) -> StackRequest:
        """What the controls ask for.

        Raises
        ------
        InputError
            If something is missing or cannot be used.
        """
        layer = self.shots.layer
        setup = self.setup.setup()
        scheduler, workers = self.engine.engine()
        mask = self.masks.usable(layer)
        self.source.check(mask)
        job = StackJob(
            shots=self.shots.shots(),
            out=self.store.store,
            source=self._source(layer),
            mask=mask,
            source_mask=self.source_masks.usable(layer) if self.source.is_guessed else None,
            cleaning=self.cleaning.model(),
            options=self.options.model(),  # type: ignore[arg-type]
            setup=setup,
            scheduler=scheduler,
            workers=workers,
            overwrite=self.overwrite.isChecked(),
            redo_failed=self.redo_failed.isChecked(),
        )
        companions = (self.masks.layer, self.source_masks.layer, self.source.layers.layer)
        return StackRequest(
            job,
            layer,
            tuple(one for one in companions if one is not None and one is not layer),
            {} if layer is None else place_on(layer, setup),
            Origins.of(self, layer, self.shots.name),
        )

    def _source(self, layer: Any) -> ArrayLike:
        # A run may have a source for each shot.
        chosen = self.source.layers.layer
        if self.source.picker.kind == "layer" and chosen is not None and chosen.ndim == 3:
            return stack_of(chosen)
        return self.source.source(layer)  # type: ignore[return-value]

    # A run

    def _run_or_cancel(self) -> None:
        if self.panel.runner.running:
            self.panel.cancel()
            return
        self._forget()
        try:
            self._running, self._heard = self.request(), 0
        except MISTAKES as error:
            self.panel.refuse(error)
            return
        self.panel.run(self._running.run, self._running)

    def _on_progress(self, news: Progress) -> None:
        if self._running is not None and news.stage == "shots":
            self._show(self._running)

    def _show(self, request: StackRequest) -> None:
        """Show what is new."""
        # Once it is done: to press Run again must not throw these shots away.
        self.overwrite.setChecked(False)
        self.redo_failed.setChecked(False)
        books = request.job.books
        if len(books.failures) != self.failures.count:
            self._show_failures(list(books.failures))
        if request.described and request is not self._shown:
            self._show_layers(request)
        elif books.ended > self._heard and not self._soon.isActive():
            self._soon.start()
        self._heard = books.ended

    def _show_layers(self, request: StackRequest) -> None:
        earlier, self._shown = self._shown, request
        again = earlier is not None and earlier.job.out == request.job.out
        if request.image is not None and request.job.setup is not None:
            place_together(self.viewer, request.image, request.job.setup, request.companions)
        if earlier is not None and again:
            request.go_on_from(earlier, self.results.layers)
        else:
            self.results = ResultLayers(self.viewer, self)
            self.results.complete.connect(self._on_layers)
        self._look_at = not again and request.image is None
        self.results.show(request.described, select=not again)

    def _on_layers(self) -> None:
        # Files lie where their setup puts them, which may be far from what is in view.
        if self._look_at:
            self._look_at = False
            self.viewer.reset_view()
        arrows = next((one for one in self.results.layers if role_of(one) == "arrows"), None)
        if arrows is not self._arrows:
            self._arrows = arrows
            self._read_arrows = None if arrows is None else follow_shots(self.viewer, arrows)
        self._soon.start()

    def _refresh(self) -> None:
        if self._shown is not None:
            self._shown.follow(self.results.layers)
        for layer in self.results.layers:
            layer.refresh()
        if self._read_arrows is not None:
            self._read_arrows()

    def _forget(self) -> None:
        """What was said of one run does not hold for another."""
        self.report.empty()
        self._show_failures([])
        self.panel.say("")

    def _show_failures(self, failures: list[tuple[str, str]]) -> None:
        self.failures.show_failures(failures)
        self.failures_title.setVisible(bool(failures))

    @notify_errors
    def _on_end(self, outcome: Outcome) -> None:
        request: StackRequest = outcome.tag
        books = request.job.books
        self._running = None
        if not books.total:
            return
        self._show(request)
        self.report.show_rows(request.origins.rows())
        if outcome.cancelled:
            self.panel.say(f"Cancelled: {books.text}; press Run to resume.")
        else:
            self.panel.say(f"{books.text}, in {request.job.out.name}")
        self.panel.status.setToolTip(str(request.job.out.absolute()))

    # Layers

    def _on_layer(self) -> None:
        layer = self.shots.layer
        self.source.follow(layer)
        self.setup.follow(layer, "" if layer is not None else self.shots.name)
        if not self.panel.runner.running:
            self._forget()
        self.keep()

    def _show_source_mask(self) -> None:
        self.source_masks.setVisible(self.source.is_guessed)
