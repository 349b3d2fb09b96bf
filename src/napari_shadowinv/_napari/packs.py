"""A film pack as layers.

- the doses of `run_film` as stacks with a plane for each film: `pack_layers`
- each film as an image to invert or fit: `film_layers`
- the mean spectrum in a region: `spectrum_in`
- pixels painted by hand: `painted_by_hand`
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from napari_shadowinv._napari import layer_metadata as about
from napari_shadowinv._napari.jobs import Job
from napari_shadowinv._napari.layer_metadata import Frame, Kind, Result, frame_for
from napari_shadowinv._napari.layers import LayerData, Limits, label_colours
from napari_shadowinv._napari.preferences import colour_map
from napari_shadowinv._napari.shots import shot_layer
from napari_shadowinv._system.progress import OnProgress, ShouldStop
from napari_shadowinv._typing import AnyArray, BoolArray, FloatArray
from napari_shadowinv.film import Pack, read_corners, write_corners
from napari_shadowinv.film.scans import common_shape, upright
from napari_shadowinv.film_doses import FilmDoses
from napari_shadowinv.io import read_shot, replacing, write
from napari_shadowinv.io.formats import TIFF
from napari_shadowinv.pipeline import run_film

FLUENCE, DOSE, UNUSABLE = "fluence", "dose", "unusable"
PER_AREA = "1/(m² MeV)"

KINDS = (
    Kind(DOSE, "dose", "dose (Gy)", "Gy", "uncertainty"),
    Kind(FLUENCE, "fluence", f"fluence ({PER_AREA})", PER_AREA, "field", visible=True),
    Kind(UNUSABLE, "usable", "unusable", type="labels"),
)

EXCLUDED, BY_HAND = 1, 2
"""Labels of unusable pixels: excluded by `run_film`, and painted by the user."""

_MIN_SIGNIFICANCE = 2.0  # fluence over its error, dose over that of a flat background
_MAX_BACKGROUND_SHARE = 0.05  # of the largest dose; above, the last film sees the beam
_LIMITS_PERCENTILES = (0.1, 99.7)
_MAX_DARK_FRACTION = 0.3  # of the upper limit, for limits that start at zero


class Spectrum(NamedTuple):
    """Mean over the usable pixels of a region, by film; NaN for films without usable pixels."""

    energies: FloatArray  # MeV
    fluence: FloatArray  # protons per m² and MeV
    error: FloatArray  # median standard deviation of a pixel; mostly common to all pixels
    bands: FloatArray  # shape (n, 2), MeV
    is_measured: BoolArray
    """False for layers without usable pixels or with a fluence below twice its error, and for the
    last layer, whose fluence depends on the assumed spectrum beyond it. Also for a faint layer
    whose dose exceeds the dose of the last film, which electrons or X-rays may leave in all films,
    by less than twice that dose."""


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
    times = doses.times_of_flight
    films = {
        "films": [doses.film_label(k) for k in range(len(doses.energies))],
        "energies": doses.energies.tolist(),
        "times_of_flight": None if times is None else times.tolist(),
    }
    layers = []
    for kind in KINDS:
        more: dict[str, Any] = {**films, **facts, "name": name, "result": result, "main": True}
        if kind.type == "labels":
            data: AnyArray = np.where(doses.usable, 0, EXCLUDED).astype(np.uint8)
            if by_hand is not None:
                data[by_hand] = BY_HAND
            look: dict[str, Any] = {"colormap": label_colours("#5dff5d", "#00c8ff"), "opacity": 0.5}
        else:
            data = getattr(doses, kind.variable)
            limits = [_limits(film, used) for film, used in zip(data, doses.usable, strict=True)]
            more["limits"] = limits
            look = {"colormap": colour_map(kind.colormap), "contrast_limits": limits[plane]}
        more["stack_axis"] = "layer"
        layers.append(kind.layer(data, name, frame, result.setup, look, **more))
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


def spectrum_in(doses: FilmDoses, region: BoolArray | None = None) -> Spectrum:
    """Return the mean fluence of each film over the usable pixels of a region; None is all."""
    inside = doses.usable if region is None else doses.usable & region

    def reduce(planes: FloatArray, statistic: Callable[[AnyArray], Any]) -> FloatArray:
        films = zip(planes, inside, strict=True)
        values = [statistic(plane[used]) if used.any() else np.nan for plane, used in films]
        return np.array(values, float)

    fluence = reduce(doses.fluence, partial(np.mean, dtype=np.float64))
    error = reduce(doses.fluence_error, np.median)
    is_measured = fluence > _MIN_SIGNIFICANCE * error  # False for NaN
    is_measured[-1] = False
    dose = reduce(doses.dose, partial(np.mean, dtype=np.float64))
    background = dose[-1]
    is_faint = dose < _MAX_BACKGROUND_SHARE * np.nanmax(dose, initial=0.0)
    is_measured &= ~(is_faint & (dose - background < _MIN_SIGNIFICANCE * background))
    return Spectrum(doses.energies, fluence, error, doses.bands[:, 1:], is_measured)


def painted_by_hand(labels: AnyArray, doses: FilmDoses) -> BoolArray:
    """Return the pixels of a pack's labels that the user painted."""
    return np.asarray((labels == BY_HAND) | (doses.usable & (labels > 0)))


def _limits(plane: AnyArray, used: BoolArray) -> Limits:
    """Return the contrast limits of a film from its usable pixels."""
    if not used.any():
        return 0.0, 1.0
    dark, bright = (float(value) for value in np.percentile(plane[used], _LIMITS_PERCENTILES))
    low = 0.0 if 0 <= dark < _MAX_DARK_FRACTION * bright else dark
    return (low, bright) if bright > low else (low, low + 1.0)


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
            pack, by_hand = self._write_corrections()
            return run_film(pack, on_progress=on_progress, should_stop=should_stop), by_hand
        except BaseException:
            shutil.rmtree(self.folder, ignore_errors=True)
            raise

    def layers(self, content: tuple[FilmDoses, BoolArray | None]) -> LayerData:
        doses, by_hand = content
        return pack_layers(
            Result(doses, doses.setup),
            frame_for(doses.dose.shape, doses.setup, pixel_size=doses.pixel_size),
            self.name,
            by_hand=by_hand,
            plane=self.plane,
            path=self.path,
            pack=self.pack,
            corners=self.corners,
        )

    def _write_corrections(self) -> tuple[Pack, BoolArray | None]:
        changes: dict[str, Any] = {}
        by_hand = self.by_hand
        if self.corners is not None:
            changes["corners"] = self._file("corners.csv")
            write_corners(changes["corners"], dict(self.corners))
            if by_hand is not None:
                assert self.scales is not None
                films = read_corners(changes["corners"])
                sides = [upright(films[n])[2] / self.scales[int(n) - 1] for n in films]
                by_hand = _resize(by_hand, common_shape(sides))
        if by_hand is not None and by_hand.any():
            layers = list(self.pack.layers)
            for k in np.flatnonzero(by_hand.any(axis=(1, 2))):
                usable = ~by_hand[k]
                mask_file = layers[k].mask
                if mask_file is not None:
                    mask = read_shot(mask_file).image > 0
                    if mask.shape != usable.shape:
                        continue  # `run_film` reports it
                    usable &= mask
                file = self._file(f"mask_{k + 1:02d}{TIFF.suffix}")
                write(file, usable.astype(np.float32))
                layers[k] = layers[k].model_copy(update={"mask": file})
            changes["layers"] = tuple(layers)
        return self.pack.model_copy(update=changes), by_hand

    def _file(self, name: str) -> Path:
        self.folder.mkdir(parents=True, exist_ok=True)
        return self.folder / name


def _resize(planes: BoolArray, shape: tuple[int, int]) -> BoolArray:
    """Crop or pad planes around their centres."""
    sides = planes.shape[1:]
    y, x = (np.arange(new) + (old - new) // 2 for new, old in zip(shape, sides, strict=True))
    inside = ((y >= 0) & (y < sides[0]))[:, None] & (x >= 0) & (x < sides[1])
    rows, columns = (np.clip(index, 0, old - 1) for index, old in zip((y, x), sides, strict=True))
    return planes[:, rows[:, None], columns] & inside


def copy_edits(doses: FilmDoses, scratch: Path, path: Path) -> FilmDoses:
    """Copy corrections from the folder `scratch` next to the result's file at `path`.

    The pack of the returned doses names the copies, such as ``result_corners.csv``.
    """
    overwrite = path.exists()  # the dialog has asked

    def copy(file: Path | None) -> Path | None:
        if file is None or scratch not in file.parents:
            return file
        with replacing(path.with_name(f"{path.stem}_{file.name}"), overwrite) as temporary:
            shutil.copyfile(file, temporary)
        return path.with_name(f"{path.stem}_{file.name}")

    pack = doses.pack
    layers = tuple(layer.model_copy(update={"mask": copy(layer.mask)}) for layer in pack.layers)
    saved_pack = pack.model_copy(update={"corners": copy(pack.corners), "layers": layers})
    return replace(doses, provenance=doses.provenance.model_copy(update={"pack": saved_pack}))
