"""A film pack as layers.

- the doses of `run_film` as stacks with a plane for each film: `pack_layers`
- each film as an image to invert or fit: `film_layers`
- pixels painted by hand: `painted_by_hand`
"""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from napari_shadowinv._napari import layer_metadata as about
from napari_shadowinv._napari.jobs import Job
from napari_shadowinv._napari.layer_metadata import Frame, Kind, Result, frame_for
from napari_shadowinv._napari.layers import LayerData, Limits, label_colours
from napari_shadowinv._napari.shots import shot_layer
from napari_shadowinv._system.progress import OnProgress, ShouldStop
from napari_shadowinv._typing import AnyArray, BoolArray, FloatArray
from napari_shadowinv.film import Pack
from napari_shadowinv.film_doses import FilmDoses
from napari_shadowinv.physics.units import intensity_limits
from napari_shadowinv.pipeline import run_film
from napari_shadowinv.pipeline.film_files import corrected_pack

FLUENCE, DOSE, UNUSABLE = "fluence", "dose", "unusable"
PER_AREA = "1/(m² MeV)"

KINDS = (
    Kind(DOSE, "dose", "dose (Gy)", "Gy", "uncertainty"),
    Kind(FLUENCE, "fluence", f"fluence ({PER_AREA})", PER_AREA, "field", visible=True),
    Kind(UNUSABLE, "usable", "unusable", type="labels"),
)

EXCLUDED, BY_HAND = 1, 2
"""Labels of unusable pixels: excluded by `run_film`, and painted by the user."""


def pack_layers(
    result: Result[FilmDoses],
    frame: Frame,
    name: str,
    *,
    by_hand: BoolArray | None = None,
    plane: int = 0,
    **facts: Any,
) -> LayerData:
    """Describe the layers of a pack, the lowest first; their names end with the pack's.

    Painted pixels, `by_hand`, shape (n, H, W), are not usable. The displayed film, `plane`, sets
    the contrast. `facts` are metadata of each layer.
    """
    doses = result.content
    layers = []
    for kind in KINDS:
        more: dict[str, Any] = {**facts, "name": name, "result": result, "main": True}
        if kind.type == "labels":
            data: AnyArray = np.where(doses.usable, 0, EXCLUDED).astype(np.uint8)
            if by_hand is not None:
                data[by_hand] = BY_HAND
            look: dict[str, Any] = {"colormap": label_colours("#5dff5d", "#00c8ff"), "opacity": 0.5}
        else:
            data = getattr(doses, kind.variable)
            limits = [_limits(film, used) for film, used in zip(data, doses.usable, strict=True)]
            more |= {"limits": limits, "plane": plane}
            look = {"contrast_limits": limits[plane]}
        layers.append(kind.layer(data, name, frame, doses.setup, look, stack_axis="layer", **more))
    return layers


def film_layers(doses: FilmDoses, frame: Frame, name: str) -> LayerData:
    """Describe an image of each film's fluence, with the metadata that an inversion needs.

    Films without usable pixels are omitted; in others, unusable pixels are zero. Without setups,
    the metadata contain the displacements in a magnetic field relative to each other. Only the
    first image is visible.
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
            _limits(image, used),
            frame=frame,
            setup_origin=f"{about.CAME_WITH} {name}" if doses.setups else None,
            usable=used,
            part=str(k + 1),
            energies=[float(doses.energies[k])],
            strength=None if doses.setups else float(doses.strengths[k]),
        )
        layer[1]["visible"] = not layers
        layers.append(layer)
    return layers


def painted_by_hand(labels: AnyArray, doses: FilmDoses) -> BoolArray:
    """Return the pixels of a pack's labels that the user painted."""
    return np.asarray((labels == BY_HAND) | (doses.usable & (labels > 0)))


def _limits(plane: AnyArray, used: BoolArray) -> Limits:
    """Return the contrast limits of a film from its usable pixels."""
    return intensity_limits(np.where(used, plane, np.nan), peak=np.inf)


@dataclass(frozen=True, eq=False)
class PackJob(Job):
    """Arguments of `run_film`; corrections are written to a folder, which a failed run removes."""

    pack: Pack  # before any correction
    path: str  # of the pack file
    name: str
    folder: Path  # to create
    corners: Mapping[str, FloatArray] | None = None  # of all films by number
    by_hand: BoolArray | None = None  # painted pixels, which are not used, (n, H, W)
    # Pixel side of the upright films in pixels of each film's scan, (n,); needed with corners.
    scales: FloatArray | None = None
    plane: int = 0  # the film in view

    def run(
        self, on_progress: OnProgress, should_stop: ShouldStop
    ) -> tuple[FilmDoses, BoolArray | None]:
        """Return the doses of the corrected pack, and the painted pixels on its grid."""
        try:
            pack, by_hand = corrected_pack(
                self.pack, self.folder, self.corners, self.by_hand, self.scales
            )
            return run_film(pack, on_progress=on_progress, should_stop=should_stop), by_hand
        except BaseException:
            shutil.rmtree(self.folder, ignore_errors=True)
            raise

    def layers(self, content: tuple[FilmDoses, BoolArray | None]) -> LayerData:
        doses, by_hand = content
        return pack_layers(
            Result(doses),
            frame_for(doses.dose.shape, doses.setup, pixel_size=doses.pixel_size),
            self.name,
            by_hand=by_hand,
            plane=self.plane,
            path=self.path,
            pack=self.pack,
            corners=self.corners,
        )
