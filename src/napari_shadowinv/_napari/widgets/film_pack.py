"""The widget that converts the scans of a film pack to fluences: `FilmPack`."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from tempfile import TemporaryDirectory, mkdtemp
from typing import Any

import numpy as np
from napari.utils.notifications import show_info
from pydantic import Field
from qtpy import QtWidgets
from qtpy.QtCore import QObject, Qt

from napari_shadowinv._napari import form as forms
from napari_shadowinv._napari import layer_metadata as about
from napari_shadowinv._napari import packs
from napari_shadowinv._napari.jobs import Finished, name_of_result
from napari_shadowinv._napari.layers import add_layers
from napari_shadowinv._napari.packs import PackJob
from napari_shadowinv._napari.result_files import dataset_of_layers
from napari_shadowinv._napari.run import Run
from napari_shadowinv._napari.viewer_sync import plane_in_view
from napari_shadowinv._napari.widgets import _panels as panels
from napari_shadowinv._napari.widgets import _qt as qt
from napari_shadowinv._napari.widgets._layers import LayerPicker, mask_of, new_shapes
from napari_shadowinv._napari.widgets._results import ResultLayers
from napari_shadowinv._system.validation import CheckedModel
from napari_shadowinv._typing import AnyArray, FloatArray
from napari_shadowinv.errors import InputError
from napari_shadowinv.film.scans import checked_corners
from napari_shadowinv.film_doses import FilmDoses, Spectrum
from napari_shadowinv.io import write
from napari_shadowinv.io.images import read_scan
from napari_shadowinv.pipeline import read_pack, write_layers
from napari_shadowinv.pipeline.film_files import copy_corrections

_SETTLE_MS = 60
_MIN_MOVE_PX = 0.01  # napari rounds coordinates


class CornerEditor(QObject):
    """Layers with the scan of the displayed film and a polygon of its corners."""

    def __init__(self, viewer: Any, parent: QObject) -> None:
        super().__init__(parent)
        self._viewer = viewer
        self._films: Any = None  # the fluence layer
        self._doses: Any = None
        self._plane = 0
        self._moved: dict[int, FloatArray] = {}  # by plane
        self._read_scan = lru_cache(maxsize=1)(read_scan)
        self.scan: Any = None
        self.polygon: Any = None
        self._settle_timer = qt.timer(self, _SETTLE_MS, self._follow, once=True)
        qt.while_alive(self, viewer.dims, "current_step", self._on_step)

    @property
    def shown(self) -> bool:
        return all(layer in self._viewer.layers for layer in (self.scan, self.polygon))

    def show(self, films: Any, doses: FilmDoses) -> None:
        """Show the displayed film of a pack's layer; changes to another pack are discarded."""
        if doses is not self._doses:
            self.close()
        self._films, self._doses = films, doses
        self.set_visible(True)  # first, as it ends the mode in which corners are dragged
        self._show(plane_in_view(self._viewer, films))

    def close(self) -> None:
        """Remove the layers and discard the changes."""
        for layer in (self.polygon, self.scan):
            if layer is not None and layer in self._viewer.layers:
                self._viewer.layers.remove(layer)
        self.scan = self.polygon = self._doses = None
        self._moved = {}

    def corners(self, doses: FilmDoses) -> dict[str, FloatArray] | None:
        """Return the corners of all films by number; None if the user moved none."""
        if doses is not self._doses:
            return None
        self._store_changes()
        if not self._moved:
            return None
        corners = {k: film for k, film in enumerate(doses.corners) if np.isfinite(film).all()}
        try:
            return {
                str(k + 1): checked_corners(film) for k, film in (corners | self._moved).items()
            }
        except InputError as error:
            raise InputError(f"{error}; press Show corners to reset them") from None

    def _store_changes(self) -> None:
        """Store the polygon of the shown film if the user moved it."""
        if not self.shown:
            return
        shapes = [np.asarray(vertices, np.float64)[:, -2:] for vertices in self.polygon.data]
        if len(shapes) != 1 or len(shapes[0]) != 4:
            counts = ", ".join(str(len(vertices)) for vertices in shapes)
            corners = f" with {counts} corners" if shapes else ""
            raise InputError(
                f"'{self.polygon.name}' has {len(shapes)} shapes{corners}: expected one polygon "
                "with the four corners of the film; press Show corners to reset it"
            )
        old_corners = self._moved.get(self._plane, self._doses.corners[self._plane])
        if np.abs(shapes[0] - old_corners).max() > _MIN_MOVE_PX:
            self._moved[self._plane] = shapes[0]

    def _show(self, plane: int) -> None:
        corners = self._moved.get(plane, self._doses.corners[plane])
        if not np.isfinite(corners).all():
            raise InputError(
                f"{self._doses.film_label(plane)}: the layer is excluded and shows no film; choose "
                "another film"
            )
        pixels = self._scan_of(plane)
        self._plane = plane
        name = f"scan of film {plane + 1}"
        # The scan has the pixel size of the films, and its film lies over them.
        frame = about.frame_of(self._films)
        size = np.array(self._films.data.shape[-2:])
        centre = np.asarray(frame.translate) + (size - 1) / 2 * frame.scale
        is_new = not self.shown
        if is_new:
            metadata = about.metadata_for("scan", "")
            look = {"rgb": True, "name": name, "metadata": metadata, **frame.keywords()}
            (self.scan,) = add_layers(self._viewer, [(pixels, look, "image")])
            self.polygon = new_shapes(self._viewer, self.scan, "corners", "direct")
            self.polygon.metadata = about.metadata_for("corners", "")
        self.scan.data, self.scan.name = pixels, name
        self.polygon.name = about.layer_name("corners", name)
        self.polygon.data = []
        self.polygon.add_polygons([corners])
        for layer in (self.scan, self.polygon):
            layer.translate = centre - corners.mean(axis=0) * frame.scale
        self.polygon.mode = "direct"
        if is_new:
            self._viewer.reset_view()

    def set_visible(self, visible: bool) -> None:
        """Show or hide the layers, if they are there."""
        if self.shown:
            self.scan.visible = self.polygon.visible = visible

    def _scan_of(self, plane: int) -> AnyArray:
        """Return the pixels of a film's scan with eight bits."""
        path = self._doses.pack.layers[plane].file or self._doses.pack.scan
        pixels = self._read_scan(path).pixels
        return pixels if pixels.dtype == np.uint8 else (pixels >> 8).astype(np.uint8)

    def _on_step(self, _: Any = None) -> None:
        if self.shown and self._films in self._viewer.layers:
            self._settle_timer.start()

    @qt.notify_errors
    def _follow(self) -> None:
        if not self.shown or self._films not in self._viewer.layers:
            return
        plane = plane_in_view(self._viewer, self._films)
        if plane != self._plane:
            self._store_changes()
            self._show(plane)


_REDRAW_MS = 60  # while a region is drawn
_PLOT_HEIGHT_PX = 260
_BRUSH_PX = 10


def draw_spectrum(axes: Any, spectrum: Spectrum, where: str, ink: str) -> None:
    """Draw the mean fluence against energy."""
    style = {"fmt": "o-", "color": qt.COLOURS[0], "markersize": 4, "capsize": 2}
    axes.errorbar(spectrum.energies, spectrum.fluence, spectrum.error, **style)
    layers = zip(spectrum.bands, spectrum.energies, spectrum.is_measured, strict=True)
    for band, energy, is_measured in layers:
        if not is_measured:
            # The last film also contains protons from beyond its band.
            low, high = min(*band, energy), max(*band, energy)
            axes.axvspan(low, high, facecolor="none", edgecolor=ink, hatch="////", lw=0)
    axes.set_yscale("log", nonpositive="clip")
    positive = spectrum.fluence[spectrum.fluence > 0]
    if positive.size:
        axes.set_ylim(positive.min() / 3, 3 * positive.max())
    axes.set_xlabel(f"energy (MeV), mean {where}")
    axes.set_ylabel(f"fluence ({packs.PER_AREA})")


class _PackFile(CheckedModel):
    file: Path | None = Field(
        default=None,
        title="Pack",
        description="TOML file with films, filters, scans and calibrations, as for the command "
        "<code>shadowinv film</code>.",
        examples=["pack.toml"],
    )


class FilmPack(panels.ToolPanel):
    """Choose a pack file, then press Run; correct corners and masks, and press it again."""

    def __init__(self, napari_viewer: Any) -> None:
        tip = "Compute dose and fluence of each film of the pack."
        super().__init__(napari_viewer, Run("Run", tip))
        scratch = TemporaryDirectory(prefix="film-pack-")
        qt.when_destroyed(self, scratch.cleanup)
        self._scratch = Path(scratch.name)
        self.fit_images = ResultLayers(self.viewer, self)
        self._build()
        self._timer = qt.timer(self, _REDRAW_MS, self.update_plot, once=True)
        for signal in (self.regions.picked, self.regions.edited):
            signal.connect(self._schedule_plot)
        self.packs.picked.connect(self._on_pack)
        self._on_pack()
        self._ready = True

    def _build(self) -> None:
        self.file = forms.ModelForm(_PackFile)
        self.report = panels.ReportView()
        self.packs = LayerPicker(
            self.viewer,
            "Fluence of a pack, from a run or from a .shadowinv file.",
            suits=lambda layer: about.role_of(layer) == packs.FLUENCE,
            label="Result",
        )
        self.regions = LayerPicker(
            self.viewer,
            "Shapes or labels. The spectrum is the mean over the usable pixels inside.",
            "whole film",
            about.may_be_mask,
            kinds=("shapes", "labels"),
            label="Region",
        )
        self.regions.add_button("✎", "Draw a region.", self._draw_region)
        self.spectrum: Spectrum | None = None  # shown
        self.plot = qt.Plot(_PLOT_HEIGHT_PX, fixed=True)
        self.plot.setToolTip(
            "<qt>Mean fluence of each film. Error bars are the median standard deviation of a "
            "pixel, because calibration errors are common to all pixels and do not average out. "
            "Hatched layers are not a measurement: they have no usable pixels or a fluence below "
            "twice its error, or are the last layer, which also records all protons beyond it.</qt>"
        )
        self.show_corners = qt.push_button(
            "Show corners",
            "Show the scan of the displayed film, with corners to drag.",
            self._show_corners,
        )
        self.paint = qt.push_button(
            "Paint mask", "Paint pixels of the displayed film to exclude them.", self._paint
        )
        self.to_fit = qt.push_button(
            "Layers for a fit",
            "Add each film as an image with energy, setup and mask, for Invert and Fit "
            "several images.",
            self._add_fit_images,
        )
        self.write = qt.push_button(
            "Write layers…",
            "Save each film as an image, with a table of all films.",
            self._write_layers,
        )
        self.save = qt.push_button("Save…", "Save the result as a .shadowinv file.", self._save)
        self.actions = QtWidgets.QWidget()
        column = qt.column(
            self.actions,
            self.packs,
            self.report,
            self.regions,
            self.plot,
            qt.side_by_side((self.show_corners, 1), (self.paint, 1)),
            qt.side_by_side((self.to_fit, 1), (self.write, 1), (self.save, 1)),
        )
        column.setAlignment(Qt.AlignmentFlag.AlignTop)
        self.add(self.file, self.keep_earlier, self.panel, self.actions)
        self.corners = CornerEditor(self.viewer, self)

    def request(self) -> PackJob:
        """Return the pack of the file, or else of the result, with its corners and painted pixels.

        Another file than the result's has none of them.
        """
        stated = self.file.state().get("file", "").strip()
        file = str(Path(stated).expanduser().absolute()) if stated else ""
        layer = self.packs.layer
        corrections: tuple[Any, ...] = ()
        metadata = {} if layer is None else about.metadata_of(layer)
        if layer is None or file not in ("", metadata.get("path")):
            if not file:
                raise InputError("no pack is selected: choose a pack file, such as pack.toml")
            path = Path(file)
            pack, name = read_pack(path), path.stem if path.stem != "pack" else path.parent.name
        else:
            doses, name = self._selected()[1], name_of_result(layer)
            pack = read_pack(Path(file)) if file else metadata.get("pack") or doses.pack
            if len(pack.layers) == len(doses.usable):
                corrections = self._corrections(layer, doses)
        folder = Path(mkdtemp(dir=self._scratch))
        return PackJob(pack, file or metadata.get("path", ""), name, folder, *corrections)

    def _corrections(self, layer: Any, doses: FilmDoses) -> tuple[Any, ...]:
        """Return the last arguments of a job: corners, painted pixels, and the film in view."""
        labels = self._partner(layer, packs.UNUSABLE)
        by_hand = None if labels is None else packs.painted_by_hand(labels.data, doses)
        corners = self.corners.corners(doses) or about.metadata_of(layer).get("corners")
        return corners, by_hand, doses.scales, plane_in_view(self.viewer, layer)

    def forget(self) -> None:
        self.panel.say("")

    def show_result(self, finished: Finished, job: PackJob) -> None:
        self.corners.close()
        self.results = self._last.layers_for_next(job.path or job.name)
        if not (self.results.layers or self.keep_earlier.isChecked()):
            self.results.adopt(self._opened(job.name))
        self.results.complete.connect(self._follow_result)
        self.results.show(finished.layer_data, fit=not self.viewer.layers)

    def _opened(self, name: str) -> list[Any]:
        """Return the layers of a pack's result that was opened from a file."""
        roles = {kind.role for kind in packs.KINDS}
        of_packs = [layer for layer in self.viewer.layers if about.role_of(layer) in roles]
        return [layer for layer in of_packs if name_of_result(layer) == name]

    def _follow_result(self) -> None:
        for layer in self.results.layers:
            if about.role_of(layer) == packs.FLUENCE:
                self.packs.layer = layer
        self._on_pack()

    def _selected(self) -> tuple[Any, FilmDoses]:
        layer = self.packs.layer
        result = None if layer is None else about.result_of(layer)
        if result is None:
            raise InputError(
                "there is no result of a film pack: press Run first, or open a .shadowinv file"
            )
        doses: Any = result.content
        return layer, doses

    def _partner(self, layer: Any, role: str) -> Any | None:
        """Return the layer of the same result with a role, or None."""
        partners = about.layers_of(self.viewer, layer)
        return next((partner for partner in partners if about.role_of(partner) == role), None)

    def _on_pack(self) -> None:
        has_result = self.packs.layer is not None
        self.actions.setVisible(has_result)
        if has_result:
            # The file of an opened result is unknown: Run then uses the pack in the result.
            self.file.restore({"file": about.metadata_of(self.packs.layer).get("path") or None})
            facts = self._selected()[1].facts
            self.report.show_rows([*panels.fact_rows(facts), *panels.warning_rows(facts)])
        self.update_plot()

    def _schedule_plot(self) -> None:
        if not self._timer.isActive():
            self._timer.start()

    def update_plot(self) -> None:
        """Draw the spectrum of the current region."""
        layer = self.packs.layer
        if layer is None:
            return
        _, doses = self._selected()
        try:
            region = mask_of(self.regions.layer, layer, painted_is_unusable=False)
        except InputError as error:
            self.show_problem(str(error))
            return
        where = "of the whole film" if region is None else "in the region"
        spectrum = self.spectrum = doses.spectrum(region)
        self.plot.show_drawing(lambda axes: draw_spectrum(axes[0], spectrum, where, self.plot.ink))

    @qt.notify_errors
    def _draw_region(self) -> None:
        layer, _ = self._selected()
        self.regions.layer = new_shapes(self.viewer, layer, "region", "add_rectangle")

    @qt.notify_errors
    def _show_corners(self) -> None:
        layer, doses = self._selected()
        self.corners.show(layer, doses)
        self.panel.say("Drag the corners. Move the slider to show other films. Then press Run.")

    @qt.notify_errors
    def _paint(self) -> None:
        layer, _ = self._selected()
        labels = self._partner(layer, packs.UNUSABLE)
        if labels is None:
            raise InputError(
                f"the unusable pixels of '{layer.name}' were deleted: press Run, or open the file "
                "again"
            )
        self.corners.set_visible(False)  # the scan would cover the labels
        labels.visible = True
        labels.selected_label = packs.BY_HAND
        labels.brush_size = _BRUSH_PX
        self.viewer.layers.selection.active = labels
        labels.mode = "paint"
        self.panel.say("Paint the pixels to exclude. Then press Run.")

    @qt.notify_errors
    def _add_fit_images(self) -> None:
        layer, doses = self._selected()
        for kind in packs.KINDS:
            partner = self._partner(layer, kind.role)
            if partner is not None:
                partner.visible = False
        layer_data = packs.film_layers(doses, about.frame_of(layer), layer.name)
        self.fit_images = ResultLayers(self.viewer, self)
        self.fit_images.show(layer_data, select=False)

    @qt.notify_errors
    def _write_layers(self) -> None:
        _, doses = self._selected()
        folder = QtWidgets.QFileDialog.getExistingDirectory(
            self, "Folder for the images of the films"
        )
        if folder:
            show_info(f"Wrote {write_layers(doses, Path(folder))[-1]}")

    @qt.notify_errors
    def _save(self) -> None:
        layer, doses = self._selected()
        if path := qt.ask_file(self, "Save the result", "pack", qt.RESULT_FILES):
            result: Any = about.result_of(layer)
            doses = copy_corrections(doses, self._scratch, path)
            saved = about.Result(doses, result.origins)
            layers = about.layers_of(self.viewer, layer)
            dataset = dataset_of_layers([each.as_layer_data_tuple() for each in layers], saved)
            show_info(f"Wrote {write(path, dataset, overwrite=True)}")
