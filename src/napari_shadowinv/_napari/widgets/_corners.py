"""Correction of the corners of a pack's films on their scans: `CornerEditor`."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from qtpy.QtCore import QObject

from napari_shadowinv._napari.frame import frame_of
from napari_shadowinv._napari.layer_metadata import metadata_for
from napari_shadowinv._napari.packs import film_labels
from napari_shadowinv._napari.viewer_sync import plane_in_view
from napari_shadowinv._napari.widgets._qt import notify_errors, timer, while_alive
from napari_shadowinv._typing import AnyArray, FloatArray
from napari_shadowinv.errors import InputError
from napari_shadowinv.film.scans import checked_corners
from napari_shadowinv.io.images import Scan, read_scan

if TYPE_CHECKING:
    from pathlib import Path

    import xarray

    from napari_shadowinv.film import Pack

_COLOUR = "#00c8ff"
_SETTLE_MS = 60
_MIN_MOVE_PX = 0.01  # napari rounds coordinates


class CornerEditor(QObject):
    """Layers with the scan of the displayed film and a polygon of its corners."""

    def __init__(self, viewer: Any, parent: QObject) -> None:
        super().__init__(parent)
        self._viewer = viewer
        self._films: Any = None  # the fluence layer
        self._dataset: Any = None
        self._pack: Any = None
        self._plane = 0
        self._moved: dict[int, FloatArray] = {}  # by plane
        self._read: tuple[Path | None, Scan | None] = None, None
        self.scan: Any = None
        self.polygon: Any = None
        self._settle_timer = timer(self, _SETTLE_MS, self._follow, once=True)
        while_alive(self, viewer.dims.events.current_step, self._on_step)

    @property
    def shown(self) -> bool:
        return self.polygon is not None and self.polygon in self._viewer.layers

    def show(self, films: Any, dataset: xarray.Dataset, pack: Pack) -> None:
        """Show the displayed film of a pack's layer; changes to another pack are discarded."""
        if dataset is not self._dataset:
            self.close()
        self._films, self._dataset, self._pack = films, dataset, pack
        self._show(plane_in_view(self._viewer, films))

    def close(self) -> None:
        """Remove the layers and discard the changes."""
        for layer in (self.polygon, self.scan):
            if layer is not None and layer in self._viewer.layers:
                self._viewer.layers.remove(layer)
        self.scan = self.polygon = self._dataset = None
        self._moved = {}

    def corners(self, dataset: xarray.Dataset) -> dict[str, FloatArray] | None:
        """Return the corners of all films by number; None if the user moved none."""
        if dataset is not self._dataset:
            return None
        self._store_changes()
        if not self._moved:
            return None
        numbers = dataset["layer"].values
        corners = {
            k: film for k, film in enumerate(dataset["corners"].values) if np.isfinite(film).all()
        }
        try:
            return {
                str(numbers[k]): checked_corners(film)
                for k, film in (corners | self._moved).items()
            }
        except InputError as error:
            raise InputError(f"{error}; press Show corners to reset them") from None

    def _store_changes(self) -> None:
        """Store the polygon of the shown film if the user moved it."""
        if not self.shown:
            return
        shapes = [np.asarray(vertices, np.float64)[:, -2:] for vertices in self.polygon.data]
        if len(shapes) != 1 or len(shapes[0]) != 4:
            raise InputError(
                f"'{self.polygon.name}' has {len(shapes)} shapes with "
                f"{', '.join(str(len(vertices)) for vertices in shapes)} corners: expected one "
                "polygon with the four corners of the film"
            )
        old_corners = self._moved.get(self._plane, self._dataset["corners"].values[self._plane])
        if np.abs(shapes[0] - old_corners).max() > _MIN_MOVE_PX:
            self._moved[self._plane] = shapes[0]

    def _show(self, plane: int) -> None:
        corners = self._moved.get(plane, self._dataset["corners"].values[plane])
        text = film_labels(self._dataset)[plane]
        if not np.isfinite(corners).all():
            raise InputError(
                f"{text}: the layer is excluded and shows no film; choose another film"
            )
        pixels = self._scan_of(plane)
        self._plane = plane
        title = text.partition(":")[0]
        # The scan has the pixel size of the films, and its film lies over them.
        frame = frame_of(self._films)
        size = np.array(self._films.data.shape[-2:])
        centre = np.asarray(frame.translate) + (size - 1) / 2 * frame.scale
        placement = frame.keywords()
        placement["translate"] = tuple(centre - corners.mean(axis=0) * frame.scale)
        if self.shown and self.scan in self._viewer.layers:
            self.scan.data, self.scan.name = pixels, f"scan of {title}"
            self.polygon.data, self.polygon.name = [corners], f"corners of {title}"
            for layer in (self.scan, self.polygon):
                layer.translate = placement["translate"]
            self.polygon.mode = "direct"
            return
        from napari.layers import Image, Shapes

        self.scan = Image(pixels, rgb=True, name=f"scan of {title}", **placement)
        self.polygon = Shapes(
            [corners],
            shape_type="polygon",
            name=f"corners of {title}",
            face_color="transparent",
            edge_color=_COLOUR,
            edge_width=max(1.0, max(size) / 200),
            **placement,
        )
        for layer, role in ((self.scan, "scan"), (self.polygon, "corners")):
            layer.metadata = metadata_for(role, "")
            self._viewer.layers.append(layer)
        self._viewer.layers.selection.active = self.polygon
        self.polygon.mode = "direct"
        self._viewer.reset_view()

    def _scan_of(self, plane: int) -> AnyArray:
        """Return the pixels of a film's scan with eight bits."""
        path = self._pack.layers[plane].file or self._pack.scan
        if path != self._read[0] or self._read[1] is None:
            self._read = path, read_scan(path)
        scan = self._read[1]
        assert scan is not None
        pixels = scan.pixels
        return pixels if pixels.dtype == np.uint8 else (pixels >> 8).astype(np.uint8)

    def _on_step(self, _: Any = None) -> None:
        if self.shown and self._films in self._viewer.layers:
            self._settle_timer.start()

    @notify_errors
    def _follow(self) -> None:
        if not self.shown or self._films not in self._viewer.layers:
            return
        plane = plane_in_view(self._viewer, self._films)
        if plane != self._plane:
            self._store_changes()
            self._show(plane)
