"""The widget that converts the scans of a film pack to fluences: `FilmPack`."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory, mkdtemp
from typing import Any

import numpy as np
from napari.utils.notifications import show_info
from pydantic import Field
from qtpy import QtWidgets
from qtpy.QtCore import Qt

from napari_shadowinv._napari import form as forms
from napari_shadowinv._napari import layer_metadata as about
from napari_shadowinv._napari.jobs import Finished, Job, name_of_result
from napari_shadowinv._napari.layers import (
    BY_HAND,
    FLUENCE,
    PACK_KINDS,
    PER_AREA,
    UNUSABLE,
    LayerData,
    add_layers,
    film_limits,
    pack_layers,
)
from napari_shadowinv._napari.result_files import dataset_to_save
from napari_shadowinv._napari.run import Run
from napari_shadowinv._napari.shots import shot_layer
from napari_shadowinv._napari.viewer_sync import plane_in_view
from napari_shadowinv._napari.widgets import _panels as panels
from napari_shadowinv._napari.widgets import _qt as qt
from napari_shadowinv._napari.widgets._layers import LayerPicker, new_shapes, painted_on
from napari_shadowinv._napari.widgets._panels import ResultLayers
from napari_shadowinv._system.validation import CheckedModel
from napari_shadowinv._typing import AnyArray, BoolArray, FloatArray
from napari_shadowinv.errors import InputError
from napari_shadowinv.film.scans import checked_corners
from napari_shadowinv.film_doses import FilmDoses, Spectrum
from napari_shadowinv.io import write
from napari_shadowinv.io.images import read_scan
from napari_shadowinv.pipeline import read_pack, run_film
from napari_shadowinv.pipeline.film_files import copy_corrections, corrected_pack

_MIN_MOVE_PX = 0.01  # napari rounds coordinates


def corner_layers(viewer: Any, doses: FilmDoses | None = None) -> list[Any]:
    """Return the scans of films with the polygons of their corners, of one result or of all."""
    layers = [layer for layer in viewer.layers if about.role_of(layer) in ("scan", "corners")]
    return [each for each in layers if doses in (None, about.metadata_of(each)["doses"])]


def show_corners(viewer: Any, films: Any, doses: FilmDoses) -> None:
    """Show the scan of the film in view, with a polygon of its corners; hide those of others."""
    plane, shown = plane_in_view(viewer, films), []
    for layer in corner_layers(viewer):
        layer.visible = about.metadata_of(layer)["plane"] == plane
        shown += [layer] if layer.visible else []
    if len(shown) != 2:
        for layer in shown:
            viewer.layers.remove(layer)
        shown = _add_corners(viewer, films, doses, plane)
    viewer.layers.selection.active = shown[-1]
    shown[-1].mode = "direct"


def _add_corners(viewer: Any, films: Any, doses: FilmDoses, plane: int) -> list[Any]:
    corners = doses.corners[plane]
    if not np.isfinite(corners).all():
        raise InputError(
            f"{doses.film_label(plane)}: the layer is excluded and shows no film; choose another "
            "film"
        )
    path: Any = doses.pack.layers[plane].file or doses.pack.scan
    pixels = read_scan(path).pixels
    pixels = pixels if pixels.dtype == np.uint8 else (pixels >> 8).astype(np.uint8)
    # The scan has the pixel size of the films, and its film lies over them.
    frame = about.frame_of(films)
    centre = np.asarray(frame.translate) + (np.array(films.data.shape[-2:]) - 1) / 2 * frame.scale
    y, x = centre - corners.mean(axis=0) * frame.scale
    metadata = about.metadata_for("scan", "", doses=doses, plane=plane)
    look = {"rgb": True, "name": f"scan of film {plane + 1}", "metadata": metadata}
    place = replace(frame, translate=(y, x)).keywords()
    (scan,) = add_layers(viewer, [(pixels, look | place, "image")])
    polygon = new_shapes(viewer, scan, "corners", "direct")
    polygon.metadata = about.metadata_for("corners", "", doses=doses, plane=plane)
    polygon.add_polygons([corners])
    viewer.reset_view()
    return [scan, polygon]


def dragged_corners(viewer: Any, doses: FilmDoses) -> dict[str, FloatArray] | None:
    """Return the corners of all films by number; None if the user moved none."""
    corners = {k: film for k, film in enumerate(doses.corners) if np.isfinite(film).all()}
    is_moved = False
    for polygon in corner_layers(viewer, doses):
        if about.role_of(polygon) == "corners":
            plane = about.metadata_of(polygon)["plane"]
            film = _film_in(polygon)
            if np.abs(film - corners[plane]).max() > _MIN_MOVE_PX:
                corners[plane], is_moved = checked_corners(film), True
    return {str(k + 1): film for k, film in corners.items()} if is_moved else None


def _film_in(polygon: Any) -> FloatArray:
    """Return the only four corners in a layer of shapes, or raise an `InputError`."""
    shapes = [np.asarray(vertices, np.float64)[:, -2:] for vertices in polygon.data]
    if len(shapes) != 1 or len(shapes[0]) != 4:
        counts = ", ".join(str(len(vertices)) for vertices in shapes)
        corners = f" with {counts} corners" if shapes else ""
        raise InputError(
            f"'{polygon.name}' has {len(shapes)} shapes{corners}: expected one polygon with the "
            "four corners of the film; delete the layer, and press Show corners"
        )
    return shapes[0]


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
    axes.set_ylabel(f"fluence ({PER_AREA})")


class _PackFile(CheckedModel):
    file: Path | None = Field(
        default=None,
        title="Pack",
        description="TOML file with films, filters, scans and calibrations, as for the command "
        "<code>shadowinv film</code>.",
        examples=["pack.toml"],
    )


def film_layers(doses: FilmDoses, frame: about.Frame, name: str) -> LayerData:
    """Describe an image of each film's fluence, with the metadata that an inversion needs.

    Films without usable pixels are omitted; in others, unusable pixels are zero. Only the first
    image is visible.
    """
    layers: LayerData = []
    for k, used in enumerate(doses.usable):
        if not used.any():
            continue
        image = np.where(used, doses.fluence[k], 0.0)
        layer = shot_layer(
            image,
            f"film {k + 1}, {doses.energies[k]:.3g} MeV",
            doses.setups[k] if doses.setups else None,
            film_limits(image, used),
            frame=frame,
            setup_origin=f"{about.CAME_WITH} {name}" if doses.setups else None,
            usable=used,
            part=str(k + 1),
            fit=None if doses.setups else {"energy": float(doses.energies[k])},
        )
        layer[1]["visible"] = not layers
        layers.append(layer)
    return layers


def painted_by_hand(labels: AnyArray, doses: FilmDoses) -> BoolArray:
    """Return the pixels of a pack's labels that the user painted."""
    return np.asarray((labels == BY_HAND) | (doses.usable & (labels > 0)))


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
            suits=lambda layer: about.role_of(layer) == FLUENCE,
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
        self.save = qt.push_button("Save…", "Save the result as a .shadowinv file.", self._save)
        self.actions = QtWidgets.QWidget()
        column = qt.column(
            self.actions,
            self.packs,
            self.report,
            self.regions,
            self.plot,
            qt.side_by_side((self.show_corners, 1), (self.paint, 1)),
            qt.side_by_side((self.to_fit, 1), (self.save, 1)),
        )
        column.setAlignment(Qt.AlignmentFlag.AlignTop)
        self.add(self.file, self.keep_earlier, self.panel, self.actions)

    def request(self) -> Job:
        """Return the pack of the file, or else of the result, with its corners and painted pixels.

        Another file than the result's has none of them.
        """
        stated = self.file.state().get("file", "").strip()
        file = str(Path(stated).expanduser().absolute()) if stated else ""
        layer = self.packs.layer
        corrections: tuple[Any, ...] = (None, None, None)
        plane = 0  # the film in view
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
                plane = plane_in_view(self.viewer, layer)
        folder = Path(mkdtemp(dir=self._scratch))
        path_of_pack = file or metadata.get("path", "")
        facts: Any = {"path": path_of_pack, "pack": pack, "corners": corrections[0]}

        def compute(**callbacks: Any) -> tuple[FilmDoses, BoolArray | None]:
            corrected, painted = corrected_pack(pack, folder, *corrections)
            return run_film(corrected, **callbacks), painted

        def describe(content: tuple[FilmDoses, BoolArray | None]) -> LayerData:
            doses, painted = content
            frame = about.frame_for(doses.dose.shape, doses.setup, pixel_size=doses.pixel_size)
            return pack_layers(
                about.Result(doses), frame, name, by_hand=painted, plane=plane, **facts
            )

        return Job(compute, describe, path_of_pack or name)

    def _corrections(self, layer: Any, doses: FilmDoses) -> tuple[Any, ...]:
        """Return the corners of all films by number, painted pixels, and the films' scales."""
        labels = self._partner(layer, UNUSABLE)
        by_hand = None if labels is None else painted_by_hand(labels.data, doses)
        corners = dragged_corners(self.viewer, doses) or about.metadata_of(layer).get("corners")
        return corners, by_hand, doses.scales

    def forget(self) -> None:
        self.panel.say("")

    def show_result(self, finished: Finished, job: Job) -> None:
        for layer in corner_layers(self.viewer):
            self.viewer.layers.remove(layer)
        self.results = self.results_for(job.subject)
        self.results.complete.connect(self._follow_result)
        self.results.show(finished.layer_data, fit=not self.viewer.layers)

    def _follow_result(self) -> None:
        for layer in self.results.layers:
            if about.role_of(layer) == FLUENCE:
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
            region = painted_on(self.regions.layer, layer)
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
        show_corners(self.viewer, layer, doses)
        self.panel.say("Drag the corners, also those of other films. Then press Run.")

    @qt.notify_errors
    def _paint(self) -> None:
        layer, _ = self._selected()
        labels = self._partner(layer, UNUSABLE)
        if labels is None:
            raise InputError(
                f"the unusable pixels of '{layer.name}' were deleted: press Run, or open the file "
                "again"
            )
        for each in corner_layers(self.viewer):
            each.visible = False  # the scan would cover the labels
        labels.visible = True
        labels.selected_label = BY_HAND
        labels.brush_size = _BRUSH_PX
        self.viewer.layers.selection.active = labels
        labels.mode = "paint"
        self.panel.say("Paint the pixels to exclude. Then press Run.")

    @qt.notify_errors
    def _add_fit_images(self) -> None:
        layer, doses = self._selected()
        for kind in PACK_KINDS:
            partner = self._partner(layer, kind.role)
            if partner is not None:
                partner.visible = False
        layer_data = film_layers(doses, about.frame_of(layer), layer.name)
        self.fit_images = ResultLayers(self.viewer, self)
        self.fit_images.show(layer_data, select=False)

    @qt.notify_errors
    def _save(self) -> None:
        layer, doses = self._selected()
        if path := qt.ask_file(self, "Save the result", "pack", qt.RESULT_FILES):
            result: Any = about.result_of(layer)
            doses = copy_corrections(doses, self._scratch, path)
            saved = about.Result(doses, result.origins)
            written = write(path, dataset_to_save(saved, layer), overwrite=True)
            show_info(f"Wrote {written}")
