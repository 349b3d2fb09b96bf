"""From the scans of a film pack to doses and fluences on common pixels: `run_film`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from napari_shadowinv._system.progress import OnProgress, Reporter, ShouldStop
from napari_shadowinv._typing import BoolArray, FloatArray
from napari_shadowinv.cautions import Caution
from napari_shadowinv.errors import InputError
from napari_shadowinv.film import (
    Pack,
    Poses,
    Response,
    burnt_edges,
    check_orientation,
    combined_dose,
    moved_corners,
    poses_by_fiducials,
    register,
    straightened,
    unfold,
    usable_pixels,
)
from napari_shadowinv.film.registration import EDGES
from napari_shadowinv.film.scans import common_shape, upright
from napari_shadowinv.film_doses import FilmDoses
from napari_shadowinv.fitting.measurements import estimated_noise
from napari_shadowinv.io.files import text_of
from napari_shadowinv.io.images import Scan
from napari_shadowinv.pipeline._film_inputs import Film, in_parallel, read_films, to_scan_frame
from napari_shadowinv.provenance import ImageOrigin, Provenance

__all__ = ["run_film"]

_MAX_SIZE_DEVIATION = 0.1  # from the median size
_MAX_PIXEL_DEVIATION = 0.01
_MAX_DARK_SHARE = 0.01  # of a film's pixels
_CUT_APART_PX = 3.0  # films whose sides differ by more were not cut together


@dataclass(frozen=True, eq=False)
class _Doses:
    """Dose of one film, upright, in Gy, its relative standard deviation, and the usable pixels."""

    dose: FloatArray
    error: FloatArray
    usable: BoolArray
    too_dark: float  # share of the film


def run_film(
    pack: Pack, *, on_progress: OnProgress | None = None, should_stop: ShouldStop | None = None
) -> FilmDoses:
    """Convert the scans of a pack to doses, and these to fluences at each film's energy.

    Films are located on their scans, straightened and aligned, and their marks are masked.
    Doses are computed by `combined_dose`, spectra by `unfold`.

    Parameters
    ----------
    pack : Pack
        With the files of all layers that are not excluded, and a calibration for their types.
    on_progress, should_stop : callable, optional
        Receives a `Progress` now and then; ends the work when it returns true.

    Returns
    -------
    FilmDoses
        With the pack, by which it can be repeated. Films are shown as seen from the source, which
        decides the sign of a magnetic field.

    Raises
    ------
    FileFormatError
        If a file cannot be read.
    InputError
        If films and pack do not fit together.
    InversionCancelled
        If `should_stop` returned true.
    """
    report = Reporter(on_progress, should_stop)
    response = Response.of(pack)
    peaks = np.array([band.peak for band in response.bands])
    films = read_films(pack, report)
    pixel = _pixel_size(pack, [film.scan for film in films])
    geometry = pack.setups(peaks, pixel)
    magnifications = np.array([setup.magnification for setup in geometry] or np.ones(len(peaks)))
    scales = magnifications / magnifications[0]
    shape = _common_shape(films, scales)

    def doses_of(film: Film) -> _Doses:
        report("dose", film.number - 1, len(pack.layers), film.name)
        return _film_doses(film, shape, scales[film.number - 1], pack.rim)

    cut = {film.number: film.corners for film in films}
    # Marks through the pack lie behind each other, the image content lies on rays.
    marked = any(film.fiducials for film in films)
    if not marked:
        films = _scale_about_axis(films, pack, scales)
    edges = in_parallel(doses_of, films)
    poses = _align_films(films, edges, pack, scales, report)
    aligned = [
        replace(film, corners=moved_corners(film.corners, shift, turn, scales[film.number - 1]))
        for film, shift, turn in zip(films, poses.shifts, poses.turns, strict=True)
    ]
    if marked:
        aligned = _scale_about_axis(aligned, pack, scales)
    pairs = zip(films, aligned, strict=True)
    moved = any((film.corners != shifted.corners).any() for film, shifted in pairs)
    doses = in_parallel(doses_of, aligned) if moved else edges
    planes = _stack_planes(len(pack.layers), shape, aligned, doses)
    # Per area of the first film: behind it the same protons cover more.
    planes["dose"] *= scales[:, None, None] ** 2
    spectra = unfold(
        planes["dose"],
        np.where(planes["usable"], planes["dose_error"], np.inf),
        response,
        on_progress=on_progress,
        should_stop=should_stop,
    )
    planes["dose_error"] *= planes["dose"]
    planes |= {"fluence": spectra.fluence, "fluence_error": spectra.error}
    stored = {name: plane.astype(np.float32) for name, plane in planes.items() if name != "usable"}
    return FilmDoses(
        **stored,
        usable=planes["usable"],
        **_film_values(pack, films, cut, poses),
        energies=spectra.energies,
        bands=np.array([(band.peak, band.low, band.high) for band in response.bands]),
        provenance=Provenance(kind="film pack", pack=pack, images=_scans(pack, films)),
        cautions=tuple(_warnings(aligned, doses, poses, pack)),
        pixel_size=pixel,
        setups=pack.setups(spectra.energies, pixel),
    )


def _scans(pack: Pack, films: list[Film]) -> tuple[ImageOrigin, ...]:
    """Return the origin of each film's scan."""
    origins = []
    for film in films:
        file = pack.layers[film.number - 1].file or pack.scan
        name = "" if file is None else text_of(file.name)
        origins.append(ImageOrigin(file=name, sha256=film.scan.checksum))
    return tuple(origins)


def _scale_about_axis(films: list[Film], pack: Pack, scales: FloatArray) -> list[Film]:
    """Move the corners of the films so that they are scaled about the axis."""
    if pack.axis is None:
        return films
    away = np.array(pack.axis) - (upright(films[0].corners)[2] - 1) / 2
    moved = []
    for film in films:
        scale = scales[film.number - 1]
        shift = (1 - scale) / scale * away
        moved.append(replace(film, corners=moved_corners(film.corners, shift, 0.0, scale)))
    return moved


def _pixel_size(pack: Pack, scans: list[Scan]) -> float | None:
    if pack.pixel_size is not None:
        return pack.pixel_size
    sizes = [scan.pixel_size for scan in scans if scan.pixel_size is not None]
    if len(sizes) < len(scans):
        if pack.setup is not None:
            raise InputError(
                "the scans do not contain the size of their pixels: give pixel_size, in m (25.4 mm "
                "over the dots per inch)"
            )
        return None
    if max(sizes) > (1 + _MAX_PIXEL_DEVIATION) * min(sizes):
        raise InputError(
            f"the scans' pixels are {1e6 * min(sizes):.4g} to {1e6 * max(sizes):.4g} µm wide: "
            "expected all films scanned with the same resolution; scan them again"
        )
    return sizes[0]


def _common_shape(films: list[Film], scales: FloatArray) -> tuple[int, int]:
    sizes = np.array([upright(film.corners)[2] / scales[film.number - 1] for film in films])
    usual = np.median(sizes, axis=0)
    for film, size in zip(films, sizes, strict=True):
        if (np.abs(size / usual - 1) > _MAX_SIZE_DEVIATION).any():
            raise InputError(
                f"{film.name} is {size[0]:.0f} × {size[1]:.0f} px, the others "
                f"{usual[0]:.0f} × {usual[1]:.0f}: expected films of one size; correct its corners"
            )
    return common_shape(sizes)


def _film_doses(film: Film, shape: tuple[int, int], scale: float, rim: int) -> _Doses:
    values = straightened(film.scan.pixels, film.corners, shape=shape, scale=scale)
    combined = combined_dose(values, film.calibration, background=film.background)
    usable = usable_pixels(values, film.calibration, background=film.background, rim=rim)
    usable &= ~burnt_edges(combined.dose)
    if film.mask is not None:
        if film.mask.shape != shape:
            raise InputError(
                f"the mask of {film.name} has shape {film.mask.shape}: expected {shape}, as "
                "the upright films"
            )
        usable &= film.mask
    dark = combined.outside & usable & (combined.dose > 0.999 * film.calibration.doses.max())
    usable &= ~combined.outside
    error = combined.error
    if usable.any():
        # Grain is common to all channels, so the calibration does not include it.
        noise = estimated_noise(np.log(combined.dose), usable)
        error = error * max(1.0, noise / float(np.median(error[usable])))
    return _Doses(combined.dose, error, usable, float(dark.mean()))


def _cut_groups(films: list[Film], kinds: Sequence[str]) -> list[tuple[object, ...]]:
    """Kind of each film, and the group of its height and width among films of that kind."""
    sizes = np.array([upright(film.corners)[2] for film in films])
    groups = np.zeros(sizes.shape, dtype=int)
    for kind in set(kinds):
        of_kind = np.array([name == kind for name in kinds])
        for axis in (0, 1):
            lengths = sizes[of_kind, axis]
            order = np.argsort(lengths)
            is_wider = np.diff(lengths[order], prepend=lengths[order[0]]) > _CUT_APART_PX
            group = np.empty(len(lengths), dtype=int)
            group[order] = np.cumsum(is_wider)
            groups[of_kind, axis] = group
    return [(kind, *map(int, group)) for kind, group in zip(kinds, groups, strict=True)]


def _align_films(
    films: list[Film],
    doses: list[_Doses],
    pack: Pack,
    scales: FloatArray,
    report: Reporter,
) -> Poses:
    usable = np.array([film_doses.usable for film_doses in doses])
    logarithms = np.log(np.array([film_doses.dose for film_doses in doses]))
    check_orientation(logarithms, usable, [film.name for film in films])
    if any(film.fiducials for film in films):
        return poses_by_fiducials(
            [film.fiducials for film in films],
            [film.corners for film in films],
            [scales[film.number - 1] for film in films],
            [film.name for film in films],
        )
    if pack.align == "images":
        kinds = [pack.layers[film.number - 1].film for film in films]
        return register(logarithms, usable, kinds=_cut_groups(films, kinds), report=report)
    return Poses.by_edges(len(films))


def _stack_planes(
    count: int, shape: tuple[int, int], films: list[Film], doses: list[_Doses]
) -> dict[str, Any]:
    """Stack doses and errors by layer, with NaN for excluded layers."""
    planes: dict[str, Any] = {
        name: np.full((count, *shape), np.nan) for name in ("dose", "dose_error")
    }
    planes["usable"] = np.zeros((count, *shape), dtype=bool)
    for film, film_doses in zip(films, doses, strict=True):
        planes["dose"][film.number - 1] = film_doses.dose
        planes["dose_error"][film.number - 1] = film_doses.error
        planes["usable"][film.number - 1] = film_doses.usable
    return planes


def _film_values(
    pack: Pack, films: list[Film], corners: Mapping[int, FloatArray], poses: Poses
) -> dict[str, Any]:
    """Collect alignment and corners of each layer, NaN for excluded ones."""
    count = len(pack.layers)
    shifts, on_scans = np.full((count, 2), np.nan), np.full((count, 4, 2), np.nan)
    turns, errors = np.full(count, np.nan), np.full(count, np.nan)
    by_images = np.zeros(count, dtype=bool)
    for k, film in enumerate(films):
        at = film.number - 1
        shifts[at], turns[at] = poses.shifts[k], poses.turns[k]
        errors[at], by_images[at] = poses.errors[k], poses.by_images[k]
        layer = pack.layers[at]
        _, on_scans[at] = to_scan_frame(
            film.scan, corners[film.number], layer.turned, pack.is_mirrored(layer)
        )
    return {
        "shifts": shifts,
        "shift_errors": errors,
        "turns": turns,
        "by_images": by_images,
        "corners": on_scans,
    }


def _warnings(films: list[Film], doses: list[_Doses], poses: Poses, pack: Pack) -> list[Caution]:
    cautions = [
        Caution(
            "film-range",
            f"{film.name}: {film_doses.too_dark:.0%} of the pixels are darker than the "
            "calibration covers and were masked",
        )
        for film, film_doses in zip(films, doses, strict=True)
        if film_doses.too_dark > _MAX_DARK_SHARE
    ]
    at_edges = poses.errors >= EDGES
    if at_edges.any() and len(films) > 1:
        loose = [film.number for film, by_edges in zip(films, at_edges, strict=True) if by_edges]
        why = "share too little structure with their neighbours"
        if any(film.fiducials for film in films):
            why = "have no fiducials"
        elif pack.align == "edges":
            why = "were not compared with each other"
        text = (
            f"films {', '.join(map(str, loose))} {why} and were aligned by their edges "
            f"(± {poses.errors[at_edges].max():.0f} px)"
        )
        cautions.append(Caution("film-alignment", text))
    if any(film.fiducials for film in films) and not np.isfinite(poses.closure):
        text = (
            "each film has one fiducial, so a misread mark cannot be detected: give two or more "
            "that go through all films"
        )
        cautions.append(Caution("film-alignment", text))
    furthest = float(np.abs(poses.shifts).max())
    if furthest > 0 and poses.by_images.any():
        text = (
            f"films were aligned on image content by up to {furthest:.1f} px; fields shift that "
            "content too, so a joint fit of E and B may be wrong without a warning"
        )
        cautions.append(Caution("film-alignment", text))
    if pack.setup is not None and pack.seen_from is None:
        text = (
            "the pack does not say from which side its films are seen, and the source was assumed: "
            "if they are seen from the detector, B has the wrong sign; give seen_from"
        )
        cautions.append(Caution("film-side", text))
    return cautions
