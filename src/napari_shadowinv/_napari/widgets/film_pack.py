"""The widget that converts the scans of a film pack to fluences: `FilmPack`."""

from __future__ import annotations

from contextlib import ExitStack
from functools import partial
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Any

from napari.utils.notifications import show_info
from qtpy import QtWidgets
from qtpy.QtCore import Qt

from napari_shadowinv._napari import packs
from napari_shadowinv._napari.frame import frame_of
from napari_shadowinv._napari.layer_metadata import (
    Result,
    may_be_mask,
    metadata_of,
    result_of,
    role_of,
)
from napari_shadowinv._napari.layer_state import dataset_of_layers
from napari_shadowinv._napari.viewer_sync import plane_in_view
from napari_shadowinv._napari.widgets import _qt as qt
from napari_shadowinv._napari.widgets._corners import CornerEditor
from napari_shadowinv._napari.widgets._forms import PathEdit, labelled, with_button
from napari_shadowinv._napari.widgets._layers import LayerPicker, LayerWatch, mask_of, new_shapes
from napari_shadowinv._napari.widgets._new_pack import NewPackDialog
from napari_shadowinv._napari.widgets._pack_work import FinishedPack, PackJob, copy_edits
from napari_shadowinv._napari.widgets._panels import ReportTable, RunPanel, ToolPanel
from napari_shadowinv._napari.widgets._plots import COLOURS, Plot
from napari_shadowinv._napari.widgets._results import LastResults, ResultLayers
from napari_shadowinv._system.hidden_files import temporary_folder
from napari_shadowinv.errors import InputError
from napari_shadowinv.io import write
from napari_shadowinv.io.formats import RESULT
from napari_shadowinv.pipeline import read_pack, write_layers

if TYPE_CHECKING:
    import xarray

    import napari

_REDRAW_MS = 60  # while a region is drawn
_PLOT_HEIGHT_PX = 260
_BRUSH_PX = 10


class SpectrumPlot(Plot):
    """Mean fluence against energy."""

    def __init__(self) -> None:
        super().__init__(_PLOT_HEIGHT_PX)
        self.setFixedHeight(_PLOT_HEIGHT_PX)
        policy = QtWidgets.QSizePolicy.Policy
        self.setSizePolicy(policy.Expanding, policy.Fixed)
        self.shown: packs.Spectrum | None = None

    def show_spectrum(self, spectrum: packs.Spectrum | None, where: str = "") -> None:
        """Draw a spectrum; None empties the plot."""
        self.shown = spectrum
        self.setVisible(spectrum is not None)
        if spectrum is None:
            return
        (axis,) = self.fresh_axes()
        axis.errorbar(
            spectrum.energies,
            spectrum.fluence,
            spectrum.error,
            fmt="o-",
            color=COLOURS[0],
            markersize=4,
            capsize=2,
        )
        layers = zip(spectrum.bands, spectrum.energies, spectrum.is_measured, strict=True)
        for band, energy, is_measured in layers:
            if not is_measured:
                # The last film also contains protons from beyond its band.
                low, high = min(*band, energy), max(*band, energy)
                axis.axvspan(low, high, facecolor="none", edgecolor=self.ink, hatch="////", lw=0)
        axis.set_yscale("log", nonpositive="clip")
        positive = spectrum.fluence[spectrum.fluence > 0]
        if positive.size:
            axis.set_ylim(positive.min() / 3, 3 * positive.max())
        axis.set_xlabel(f"energy (MeV), mean {where}", color=self.ink, fontsize=8)
        axis.set_ylabel(f"fluence ({packs.PER_AREA})", color=self.ink, fontsize=8)
        self.draw()


class FilmPack(ToolPanel):
    """Choose a pack file, then press Run; correct corners and masks, and run again."""

    def __init__(self, viewer: napari.viewer.Viewer) -> None:
        tip = "Compute dose and fluence of each film of the pack."
        super().__init__(viewer, "film-pack", RunPanel("Film pack", "Run", tip))
        resources = ExitStack()
        self._scratch = resources.enter_context(temporary_folder("film-pack"))
        qt.when_destroyed(self, resources.close)
        self._folders = count(1)
        self._last = LastResults(viewer, self)
        self.results = ResultLayers(viewer, self)
        self.fit_images = ResultLayers(viewer, self)
        self._build()
        self._connect()
        self._on_pack()
        self._ready = True

    def _build(self) -> None:
        self.path = PathEdit("Pack file", "pack.toml")
        self.path.edit.setToolTip(
            "<qt>TOML file with films, filters, scans and calibrations, as for the command "
            "<code>shadowinv film</code>.</qt>"
        )
        self.report = ReportTable()
        self.packs = LayerPicker(
            self.viewer,
            ("image",),
            "<qt>Fluence of a pack, from a run or from a .shadowinv file.</qt>",
            suits=lambda layer: role_of(layer) == packs.FLUENCE,
        )
        self.regions = LayerPicker(
            self.viewer,
            ("shapes", "labels"),
            "<qt>Shapes or labels. The spectrum is the mean over the usable pixels inside.</qt>",
            "whole film",
            may_be_mask,
        )
        self.plot = SpectrumPlot()
        self.plot.setToolTip(
            "<qt>Mean fluence of each film. Error bars are the median standard deviation of a "
            "pixel, because calibration errors are common to all pixels and do not average out. "
            "Hatched layers are not a measurement: they have no usable pixels or a fluence below "
            "twice its error, or are the last layer, which also records all protons beyond it.</qt>"
        )
        self.show_corners = _button(
            "Show corners", "Show the scan of the displayed film, with corners to drag."
        )
        self.paint = _button("Paint mask", "Paint pixels of the displayed film to exclude them.")
        self.run_again = _button(
            "Run again",
            "Evaluate the pack again with the dragged corners and without the painted pixels.",
        )
        self.to_fit = _button(
            "Layers for a fit",
            "Add each film as an image with energy, setup and mask, for Invert shot and Fit "
            "several images.",
        )
        self.write = _button(
            "Write layers…", "Save each film as an image, with a table of all films."
        )
        self.save = _button("Save…", "Save the result as a .shadowinv file.")
        self.actions = QtWidgets.QWidget()
        region = with_button(self.regions, "✎", "Draw a region.", self._draw_region)
        column = qt.column(
            self.actions,
            labelled("Result", self.packs),
            self.report,
            labelled("Region", region),
            self.plot,
            qt.side_by_side((self.show_corners, 1), (self.paint, 1), (self.run_again, 1)),
            qt.side_by_side((self.to_fit, 1), (self.write, 1), (self.save, 1)),
        )
        column.setAlignment(Qt.AlignmentFlag.AlignTop)
        self.new = _button("New pack…", "Create a pack file from a folder of scans.")
        pack_row = qt.side_by_side((self.path, 1), (self.new, 0))
        self.add(labelled("Pack", pack_row), self._last.keep_earlier, self.panel, self.actions)
        self.corners = CornerEditor(self.viewer, self)

    def _connect(self) -> None:
        self._timer = qt.timer(self, _REDRAW_MS, self.update_plot, once=True)
        edits = LayerWatch(self, (self.regions,))
        for signal in (self.regions.picked, edits.edited):
            signal.connect(self._schedule_plot)
        self.packs.picked.connect(self._on_pack)
        for button, action in (
            (self.new, self._new_pack),
            (self.show_corners, self._show_corners),
            (self.paint, self._paint),
            (self.run_again, self._run_again),
            (self.to_fit, self._add_fit_images),
            (self.write, self._write_layers),
            (self.save, self._save),
        ):
            button.clicked.connect(partial(_call, action))

    # A run

    def request(self) -> PackJob:
        path = self.path.path
        if not path:
            raise InputError("no pack is selected: choose a pack file, such as pack.toml")
        file = Path(path).expanduser().absolute()
        pack = read_pack(file)
        name = file.stem if file.stem != "pack" else file.parent.name
        return PackJob(pack, str(file), name, self._new_folder())

    @qt.notify_errors
    def _new_pack(self) -> None:
        folder = QtWidgets.QFileDialog.getExistingDirectory(self, "Folder with the scans of a pack")
        if not folder:
            return
        dialog = NewPackDialog(Path(folder), self)
        if dialog.exec() and dialog.written is not None:
            self.path.edit.setText(str(dialog.written))
            self.panel.say(f"Wrote {dialog.written}. {dialog.missing_text()}")

    def forget(self) -> None:
        self.panel.say("")

    def _corrected_job(self) -> PackJob:
        """Return the job for the selected pack with the user's corrections."""
        layer, dataset = self._selected()
        metadata = metadata_of(layer)
        labels = self._partner(layer, packs.UNUSABLE)
        by_hand = None if labels is None else packs.painted_by_hand(labels.data, dataset)
        return PackJob(
            metadata.get("pack") or packs.pack_of(dataset),
            metadata.get("path", ""),
            metadata.get("pack_name") or layer.name.removesuffix(_title(packs.FLUENCE)).strip(),
            self._new_folder(),
            self.corners.corners(dataset) or metadata.get("corners"),
            by_hand,
            packs.relative_scales(dataset),
            plane_in_view(self.viewer, layer),
        )

    @qt.notify_errors
    def _run_again(self) -> None:
        if self.panel.runner.running:
            return
        request = self._corrected_job()
        self.forget()
        self.panel.run(request.run, request)

    def show_result(self, value: FinishedPack, request: PackJob) -> None:
        dataset = value.dataset
        result = packs.pack_result(dataset)
        layer_data = packs.pack_layers(
            result,
            packs.pack_frame(dataset),
            request.name,
            by_hand=value.by_hand,
            plane=request.plane,
            path=request.path,
            pack=request.pack,
            pack_name=request.name,
            corners=request.corners,
        )
        self.corners.close()
        is_first = not self.viewer.layers
        self.results = self._last.layers_for_next(request.path or request.name)
        self.results.complete.connect(partial(self._on_layers, self.results, is_first))
        self.results.show(layer_data)

    def _on_layers(self, results: ResultLayers, is_first: bool) -> None:
        for layer in results.layers:
            if role_of(layer) == packs.FLUENCE:
                self.packs.layer = layer
        if is_first:
            self.viewer.reset_view()
        self._on_pack()

    # The chosen result

    def _selected(self) -> tuple[Any, xarray.Dataset]:
        layer = self.packs.layer
        result = None if layer is None else result_of(layer)
        if result is None:
            raise InputError(
                "there is no result of a film pack: press Run first, or open a .shadowinv file"
            )
        dataset: Any = result.content
        return layer, dataset

    def _partner(self, layer: Any, role: str) -> Any | None:
        """Return the layer of the same result with a role, or None."""
        result = result_of(layer)
        partners = (partner for partner in self.viewer.layers if result_of(partner) is result)
        return next((partner for partner in partners if role_of(partner) == role), None)

    def _on_pack(self) -> None:
        has_result = self.packs.layer is not None
        self.actions.setVisible(has_result)
        if has_result:
            _, dataset = self._selected()
            self.report.show_rows(_rows(dataset))
        self.update_plot()

    def _schedule_plot(self) -> None:
        if not self._timer.isActive():
            self._timer.start()

    def update_plot(self) -> None:
        """Draw the spectrum of the current region."""
        layer = self.packs.layer
        if layer is None:
            self.plot.show_spectrum(None)
            return
        _, dataset = self._selected()
        try:
            region = mask_of(self.regions.layer, layer, painted_is_unusable=False)
        except InputError as error:
            self.show_problem(str(error))
            return
        where = "of the whole film" if region is None else "in the region"
        self.plot.show_spectrum(packs.spectrum_in(dataset, region), where)

    @qt.notify_errors
    def _draw_region(self) -> None:
        layer, _ = self._selected()
        self.regions.layer = new_shapes(self.viewer, layer, "region", "add_rectangle")

    @qt.notify_errors
    def _show_corners(self) -> None:
        layer, dataset = self._selected()
        self.corners.show(layer, dataset, packs.pack_of(dataset))
        self.panel.say(
            "Drag the corners. Move the slider to show other films. Then press Run again."
        )

    @qt.notify_errors
    def _paint(self) -> None:
        layer, _ = self._selected()
        labels = self._partner(layer, packs.UNUSABLE)
        if labels is None:
            raise InputError(
                f"the layer '…{_title(packs.UNUSABLE)}' of '{layer.name}' was deleted: press Run, "
                "or open the file again"
            )
        labels.visible = True
        labels.selected_label = packs.BY_HAND
        labels.brush_size = _BRUSH_PX
        self.viewer.layers.selection.active = labels
        labels.mode = "paint"
        self.panel.say("Paint the pixels to exclude. Then press Run again.")

    @qt.notify_errors
    def _add_fit_images(self) -> None:
        layer, dataset = self._selected()
        for role in (packs.DOSE, packs.FLUENCE, packs.UNUSABLE):
            partner = self._partner(layer, role)
            if partner is not None:
                partner.visible = False
        layer_data = packs.film_layers(dataset, frame_of(layer), layer.name)
        self.fit_images = ResultLayers(self.viewer, self)
        self.fit_images.show(layer_data, select=False)

    @qt.notify_errors
    def _write_layers(self) -> None:
        _, dataset = self._selected()
        folder = QtWidgets.QFileDialog.getExistingDirectory(
            self, "Folder for the images of the films"
        )
        if folder:
            show_info(f"Wrote {write_layers(dataset, Path(folder))[-1]}")

    @qt.notify_errors
    def _save(self) -> None:
        layer, dataset = self._selected()
        name, _ = QtWidgets.QFileDialog.getSaveFileName(
            self, "Save the result", f"pack{RESULT.suffix}", f"results (*{RESULT.suffix})"
        )
        if not name:
            return
        has_suffix = name.lower().endswith(RESULT.suffix)
        path = Path(name if has_suffix else name + RESULT.suffix)
        scratch = self._scratch
        result = result_of(layer)
        assert result is not None
        saved = Result(
            copy_edits(dataset, packs.pack_of(dataset), scratch, path),
            result.setup,
            result.attributes,
        )
        layers = [each for each in self.viewer.layers if result_of(each) is result]
        layer_data = [each.as_layer_data_tuple() for each in layers]
        show_info(
            f"Wrote {write(path, dataset_of_layers(layer_data, saved), overwrite=has_suffix)}"
        )

    def _new_folder(self) -> Path:
        return self._scratch / str(next(self._folders))


def _rows(dataset: xarray.Dataset) -> list[tuple[str, str]]:
    """Return the report of a pack as rows; warnings come last."""
    energies, sizes = dataset["energy"].values, dataset.sizes
    empty = ~dataset["usable"].values.any(axis=(1, 2))
    rows = [
        ("Films", f"{len(energies)}, {energies[0]:.3g} to {energies[-1]:.3g} MeV"),
        ("Pixels", f"{sizes['y']} × {sizes['x']}, {dataset['usable'].values.mean():.0%} usable"),
    ]
    if "seen_from" in dataset.attrs:
        rows.append(("Seen from", dataset.attrs["seen_from"]))
    if empty.any():
        rows.append(("Excluded", "film " + ", ".join(map(str, dataset["layer"].values[empty]))))
    return rows + [("Warning", caution.text) for caution in packs.warnings_of_pack(dataset)]


def _title(role: str) -> str:
    return next(kind.title for kind in packs.KINDS if kind.role == role)


def _button(text: str, tip: str) -> QtWidgets.QPushButton:
    button = QtWidgets.QPushButton(text)
    button.setToolTip(f"<qt>{tip}</qt>")
    return button


def _call(action: Any, _: bool = False) -> None:
    action()
