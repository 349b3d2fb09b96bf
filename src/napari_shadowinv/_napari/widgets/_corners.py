"""The corners of a pack's films, shown on their scans and dragged: `CornerEditor`."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from qtpy.QtCore import QObject

from napari_shadowinv._napari.frame import frame_of
from napari_shadowinv._napari.layer_metadata import mark
from napari_shadowinv._napari.packs import film_texts
from napari_shadowinv._napari.viewer_sync import plane_in_view
from napari_shadowinv._napari.widgets._qt import notify_errors, timer, while_alive
from napari_shadowinv._typing import AnyArray, FloatArray
from napari_shadowinv.errors import InputError
from napari_shadowinv.film.scans import checked_corners
from napari_shadowinv.io.scans import Scan, read_scan

if TYPE_CHECKING:
    from pathlib import Path

    import xarray

    from napari_shadowinv.film import Pack

_COLOUR = "#00c8ff"
_SETTLE = 60  # ms
_LEAST = 0.01  # px


class CornerEditor(QObject):
    """Two layers with the scan of the film in view, and a polygon of its corners."""

    def __init__(self, viewer: Any, parent: QObject) -> None:
        super().__init__(parent)
        self._viewer = viewer
        self._films: Any = None  # the layer of fluences
        self._dataset: Any = None
        self._pack: Any = None
        self._plane = 0
        self._moved: dict[int, FloatArray] = {}  # by plane
        self._read: tuple[Path | None, Scan | None] = None, None
        self.scan: Any = None
        self.polygon: Any = None
        self._soon = timer(self, _SETTLE, self._follow, once=True)
        while_alive(self, viewer.dims.events.current_step, self._on_step)

    @property
    def shown(self) -> bool:
        return self.polygon is not None and self.polygon in self._viewer.layers

    def show(self, films: Any, dataset: xarray.Dataset, pack: Pack) -> None:
        """Show the film that is in view in a layer of a pack; corners of another pack are lost."""
        if dataset is not self._dataset:
            self.close()
        self._films, self._dataset, self._pack = films, dataset, pack
        self._show(plane_in_view(self._viewer, films))

    def close(self) -> None:
        """Take the layers away, and forget what was moved."""
        for layer in (self.polygon, self.scan):
            if layer is not None and layer in self._viewer.layers:
                self._viewer.layers.remove(layer)
        self.scan = self.polygon = self._dataset = None
        self._moved = {}

    def corners(self, dataset: xarray.Dataset) -> dict[str, FloatArray] | None:
        """Return the corners of all films by number, None if none of this pack was moved."""
        if dataset is not self._dataset:
            return None
        self._keep()
        if not self._moved:
            return None
        known = dataset["corners"].values
        numbers = dataset["layer"].values
        found = {int(k): known[k] for k in range(len(known)) if np.isfinite(known[k]).all()}
        try:
            return {
                str(numbers[k]): checked_corners(one) for k, one in (found | self._moved).items()
            }
        except InputError as error:
            raise InputError(f"{error}; show the corners again to start anew") from None

    def _keep(self) -> None:
        """Remember the polygon of the film that is shown, if somebody moved it."""
        if not self.shown:
            return
        found = [np.asarray(one, np.float64)[:, -2:] for one in self.polygon.data]
        if len(found) != 1 or len(found[0]) != 4:
            raise InputError(
                f"'{self.polygon.name}' has {len(found)} shapes with "
                f"{', '.join(str(len(one)) for one in found)} corners: expected one polygon with "
                "the four corners of the film"
            )
        known = self._moved.get(self._plane, self._dataset["corners"].values[self._plane])
        if np.abs(found[0] - known).max() > _LEAST:  # napari rounds
            self._moved[self._plane] = found[0]

    def _show(self, plane: int) -> None:
        known = self._moved.get(plane, self._dataset["corners"].values[plane])
        text = film_texts(self._dataset)[plane]
        if not np.isfinite(known).all():
            raise InputError(f"{text}: the layer is excluded and shows no film; choose another one")
        pixels = self._scan_of(plane)
        self._plane = plane
        title = text.partition(":")[0]
        # One pixel of the scan is as large as one of the film, and the film lies on the others.
        frame = frame_of(self._films)
        size = np.array(self._films.data.shape[-2:])
        middle = np.asarray(frame.translate) + (size - 1) / 2 * frame.scale
        place = frame.keywords()
        place["translate"] = tuple(middle - known.mean(axis=0) * frame.scale)
        if self.shown and self.scan in self._viewer.layers:
            self.scan.data, self.scan.name = pixels, f"scan of {title}"
            self.polygon.data, self.polygon.name = [known], f"corners of {title}"
            for layer in (self.scan, self.polygon):
                layer.translate = place["translate"]
            self.polygon.mode = "direct"
            return
        from napari.layers import Image, Shapes

        self.scan = Image(pixels, rgb=True, name=f"scan of {title}", **place)
        self.polygon = Shapes(
            [known],
            shape_type="polygon",
            name=f"corners of {title}",
            face_color="transparent",
            edge_color=_COLOUR,
            edge_width=max(1.0, max(size) / 200),
            **place,
        )
        for layer, role in ((self.scan, "scan"), (self.polygon, "corners")):
            layer.metadata = mark(role, "")
            self._viewer.layers.append(layer)
        self._viewer.layers.selection.active = self.polygon
        self.polygon.mode = "direct"
        self._viewer.reset_view()

    def _scan_of(self, plane: int) -> AnyArray:
        """Its pixels in eight bits."""
        path = self._pack.layers[plane].file or self._pack.scan
        if path != self._read[0] or self._read[1] is None:
            self._read = path, read_scan(path)
        scan = self._read[1]
        assert scan is not None
        pixels = scan.pixels
        return pixels if pixels.dtype == np.uint8 else (pixels >> 8).astype(np.uint8)

    def _on_step(self, _: Any = None) -> None:
        if self.shown and self._films in self._viewer.layers:
            self._soon.start()

    @notify_errors
    def _follow(self) -> None:
        if not self.shown or self._films not in self._viewer.layers:
            return
        plane = plane_in_view(self._viewer, self._films)
        if plane != self._plane:
            self._keep()
            self._show(plane)
