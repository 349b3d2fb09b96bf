"""From the scans of a film pack to doses and fluences on common pixels: `run_film`."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

import numpy as np

from napari_shadowinv import __version__
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
from napari_shadowinv.film.response import relative_strengths
from napari_shadowinv.film.scans import common_shape, upright
from napari_shadowinv.fitting.measurements import estimated_noise
from napari_shadowinv.inversion.labels import PACK_FORMAT, PIXEL, place_coordinates
from napari_shadowinv.io.scans import Scan
from napari_shadowinv.pipeline._film_inputs import Film, as_it_lay, in_parallel, read_films

if TYPE_CHECKING:
    import xarray


__all__ = ["run_film"]

_ODD_SIZE = 0.1  # of the usual one
_ODD_PIXEL = 0.01
_DARK = 0.01  # of a film's pixels
_CUT_APART_PX = 3.0  # films whose sides differ by more were not cut together
_PER_AREA = "1/(m² MeV)"
_UNITS = {"dose": "Gy", "dose_error": "Gy", "fluence": _PER_AREA, "fluence_error": _PER_AREA}
_UNITS |= {"usable": "1", "by_images": "1", "sha256": "1", "turn": "rad"}

_SEEN_FROM = {
    None: "the source (assumed)",
    "source": "the source",
    "detector": "the source (scans from the detector, mirrored)",
}

ByLayer = dict[str, tuple[tuple[str, ...], Any]]


@dataclass(frozen=True, eq=False)
class _Doses:
    """What one film tells, upright: Gy, standard deviation as a share, where it is usable."""

    dose: FloatArray
    error: FloatArray
    usable: BoolArray
    too_dark: float  # share of the film


def run_film(
    pack: Pack, *, on_progress: OnProgress | None = None, should_stop: ShouldStop | None = None
) -> xarray.Dataset:
    """Turn the scans of a pack into doses, and these into fluences at each film's energy.

    Films are found on their scans, straightened, laid on each other, and their marks left out.
    Doses are those by `combined_dose`, spectra those by `unfold`.

    Parameters
    ----------
    pack : Pack
        With the files of all layers that are not excluded, and a calibration for their types.
    on_progress, should_stop : callable, optional
        Receives a `Progress` now and then; ends the work when it returns true.

    Returns
    -------
    xarray.Dataset
        By layer, y and x: ``dose`` in Gy and ``fluence`` in protons per m² and MeV, both as on the
        first film, each with its standard deviation, and ``usable``. By layer: ``energy`` of the
        protons that its fluence shows, that of the Bragg ``peak`` in its film and the band around
        it (MeV); ``strength``, by which a magnetic field displaces these protons relative to
        the first layer's; with a setup ``time_of_flight`` (s); the ``corners`` of the film on its
        scan (px), and ``shift`` and ``shift_error`` (px) and ``turn`` (rad) by which the film was
        moved from there, and whether ``by_images``.
        Attribute ``warnings``: what one should know before trusting it. Films are seen from the
        source, on which the sign of a magnetic field depends; attribute ``seen_from`` says how the
        pack describes its scans.

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
    magnifications = np.array([one.magnification for one in geometry] or np.ones(len(peaks)))
    scales = magnifications / magnifications[0]
    shape = _common_shape(films, scales)

    def doses_of(film: Film) -> _Doses:
        report("dose", film.number - 1, len(pack.layers), film.name)
        return _doses(film, shape, scales[film.number - 1], pack.rim)

    cut = {film.number: film.corners for film in films}
    # Marks through the pack lie behind each other, what the films show lies on rays.
    marked = any(film.fiducials for film in films)
    if not marked:
        films = _about_axis(films, pack, scales)
    edges = in_parallel(doses_of, films)
    poses = _poses(films, edges, pack, scales, report)
    laid = [
        replace(film, corners=moved_corners(film.corners, shift, turn, scales[film.number - 1]))
        for film, shift, turn in zip(films, poses.shifts, poses.turns, strict=True)
    ]
    if marked:
        laid = _about_axis(laid, pack, scales)
    moved = any((film.corners != one.corners).any() for film, one in zip(films, laid, strict=True))
    doses = in_parallel(doses_of, laid) if moved else edges
    planes = _planes(len(pack.layers), shape, laid, doses)
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
    by_film = _by_film(pack, films, cut, poses)
    warnings = _warnings(laid, doses, poses, pack)
    setups = pack.setups(spectra.energies, pixel)
    return _dataset(pack, response, spectra.energies, setups, pixel, planes, by_film, warnings)


def _about_axis(films: list[Film], pack: Pack, scales: FloatArray) -> list[Film]:
    """Films whose corners are moved so that their scales are about the axis."""
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
    told = [scan.pixel_size for scan in scans if scan.pixel_size is not None]
    if len(told) < len(scans):
        if pack.setup is not None:
            raise InputError(
                "the scans do not tell the size of their pixels: give pixel_size, in m (25.4 mm "
                "over the dots per inch)"
            )
        return None
    if max(told) > (1 + _ODD_PIXEL) * min(told):
        raise InputError(
            f"the scans' pixels are {1e6 * min(told):.4g} to {1e6 * max(told):.4g} µm wide: "
            "expected all films scanned with the same resolution; scan them again"
        )
    return told[0]


def _common_shape(films: list[Film], scales: FloatArray) -> tuple[int, int]:
    sizes = np.array([upright(film.corners)[2] / scales[film.number - 1] for film in films])
    usual = np.median(sizes, axis=0)
    for film, size in zip(films, sizes, strict=True):
        if (np.abs(size / usual - 1) > _ODD_SIZE).any():
            raise InputError(
                f"{film.name} is {size[0]:.0f} × {size[1]:.0f} px, the others "
                f"{usual[0]:.0f} × {usual[1]:.0f}: expected films of one size; correct its corners"
            )
    return common_shape(sizes)


def _doses(film: Film, shape: tuple[int, int], scale: float, rim: int) -> _Doses:
    values = straightened(film.scan.pixels, film.corners, shape=shape, scale=scale)
    found = combined_dose(values, film.calibration, background=film.background)
    usable = usable_pixels(values, film.calibration, background=film.background, rim=rim)
    usable &= ~burnt_edges(found.dose)
    if film.mask is not None:
        if film.mask.shape != shape:
            raise InputError(
                f"the mask of {film.name} has shape {film.mask.shape}: expected {shape}, that of "
                "the upright films"
            )
        usable &= film.mask
    dark = found.outside & usable & (found.dose > 0.999 * film.calibration.doses.max())
    usable &= ~found.outside
    error = found.error
    if usable.any():
        # Grain is the same in all channels, which the calibration's films do not tell.
        noise = estimated_noise(np.log(found.dose), usable)
        error = error * max(1.0, noise / float(np.median(error[usable])))
    return _Doses(found.dose, error, usable, float(dark.mean()))


def _cuts(films: list[Film], kinds: Sequence[str]) -> list[tuple[object, ...]]:
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


def _poses(
    films: list[Film],
    doses: list[_Doses],
    pack: Pack,
    scales: FloatArray,
    report: Reporter,
) -> Poses:
    usable = np.array([one.usable for one in doses])
    logarithms = np.log(np.array([one.dose for one in doses]))
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
        return register(logarithms, usable, kinds=_cuts(films, kinds), report=report)
    return Poses.by_edges(len(films))


def _planes(
    count: int, shape: tuple[int, int], films: list[Film], doses: list[_Doses]
) -> dict[str, Any]:
    """What the films tell, by layer; nothing where a layer is excluded."""
    planes: dict[str, Any] = {
        name: np.full((count, *shape), np.nan) for name in ("dose", "dose_error")
    }
    planes["usable"] = np.zeros((count, *shape), dtype=bool)
    for film, one in zip(films, doses, strict=True):
        planes["dose"][film.number - 1] = one.dose
        planes["dose_error"][film.number - 1] = one.error
        planes["usable"][film.number - 1] = one.usable
    return planes


def _by_film(
    pack: Pack, films: list[Film], corners: Mapping[int, FloatArray], poses: Poses
) -> ByLayer:
    count = len(pack.layers)
    values: ByLayer = {
        "shift": (("layer", "component"), np.full((count, 2), np.nan)),
        "turn": (("layer",), np.full(count, np.nan)),
        "shift_error": (("layer",), np.full(count, np.nan)),
        "by_images": (("layer",), np.zeros(count, dtype=bool)),
        "corners": (("layer", "corner", "component"), np.full((count, 4, 2), np.nan)),
        "sha256": (("layer",), np.full(count, "", dtype="U64")),
    }
    for k, film in enumerate(films):
        at = film.number - 1
        values["shift"][1][at] = poses.shifts[k]
        values["turn"][1][at] = poses.turns[k]
        values["shift_error"][1][at] = poses.errors[k]
        values["by_images"][1][at] = poses.by_images[k]
        values["sha256"][1][at] = film.scan.checksum
        layer = pack.layers[at]
        _, on_scan = as_it_lay(
            film.scan, corners[film.number], layer.turned, pack.is_mirrored(layer)
        )
        values["corners"][1][at] = on_scan
    return values


def _warnings(films: list[Film], doses: list[_Doses], poses: Poses, pack: Pack) -> list[Caution]:
    found = [
        Caution(
            "film-range",
            f"{film.name} is darker than its calibration reaches over {one.too_dark:.0%} of it: "
            "left out",
        )
        for film, one in zip(films, doses, strict=True)
        if one.too_dark > _DARK
    ]
    at_edges = poses.errors >= EDGES
    if at_edges.any() and len(films) > 1:
        loose = [film.number for film, one in zip(films, at_edges, strict=True) if one]
        why = "show too little in common with those beside them"
        if any(film.fiducials for film in films):
            why = "have no fiducials"
        elif pack.align == "edges":
            why = "are not compared with each other"
        text = (
            f"films {', '.join(map(str, loose))} {why}: laid by their edges, to some "
            f"{poses.errors[at_edges].max():.0f} px"
        )
        found.append(Caution("film-alignment", text))
    if any(film.fiducials for film in films) and not np.isfinite(poses.closure):
        text = (
            "each film has one fiducial, so that nothing tells a mark that was read wrongly: give "
            "two or more that go through all films"
        )
        found.append(Caution("film-alignment", text))
    furthest = float(np.abs(poses.shifts).max())
    if furthest > 0 and poses.by_images.any():
        text = (
            f"films were moved by up to {furthest:.1f} px by what they show, which fields "
            "displace, too: a fit of E beside B by these layers can be wrong without a sign of it"
        )
        found.append(Caution("film-alignment", text))
    if pack.setup is not None and pack.seen_from is None:
        text = (
            "the pack does not say from which side its films are seen, and the source was assumed: "
            "if they are seen from the detector, B has the wrong sign; give seen_from"
        )
        found.append(Caution("film-side", text))
    return found


def _dataset(
    pack: Pack,
    response: Response,
    energies: FloatArray,
    setups: Sequence[Any],
    pixel: float | None,
    planes: dict[str, Any],
    by_film: ByLayer,
    warnings: list[Caution],
) -> xarray.Dataset:
    import xarray as xr

    bands = response.bands
    variables: dict[str, Any] = {}
    for name, values in planes.items():
        kept = values if name == "usable" else values.astype(np.float32)
        variables[name] = (("layer", "y", "x"), kept, {"units": _UNITS[name]})
    for name, (dims, values) in by_film.items():
        variables[name] = (dims, values, {"units": _UNITS.get(name, PIXEL)})
    coordinates: dict[str, Any] = {
        "layer": np.arange(1, len(bands) + 1),
        "film": ("layer", [layer.film for layer in pack.layers]),
        "energy": ("layer", energies, {"units": "MeV"}),
        "peak": ("layer", [band.peak for band in bands], {"units": "MeV"}),
        "energy_low": ("layer", [band.low for band in bands], {"units": "MeV"}),
        "energy_high": ("layer", [band.high for band in bands], {"units": "MeV"}),
        "strength": ("layer", relative_strengths(energies), {"units": "1"}),
        **place_coordinates(planes["dose"].shape[1:], pixel, "film's plane"),
    }
    attributes: dict[str, Any] = {
        "format": PACK_FORMAT,
        "package_version": __version__,
        "created": datetime.now(UTC).isoformat(timespec="seconds"),
        "pack": pack.model_dump_json(exclude_defaults=True),
        "warnings": json.dumps([asdict(caution) for caution in warnings]),
        "seen_from": _SEEN_FROM[pack.seen_from],
    }
    if pixel is not None:
        attributes["scan_pixel_size"] = pixel
    if setups:
        flight = [one.time_of_flight for one in setups]
        coordinates["time_of_flight"] = ("layer", flight, {"units": "s"})
        attributes["setups"] = json.dumps([one.model_dump(mode="json") for one in setups])
    return xr.Dataset(variables, coordinates, attributes)
