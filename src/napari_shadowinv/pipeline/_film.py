"""From the scans of a film pack to doses and fluences on common pixels: `run_film`."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from napari_shadowinv import __version__
from napari_shadowinv._system.machine import available_threads
from napari_shadowinv._system.progress import OnProgress, Reporter, ShouldStop
from napari_shadowinv._typing import BoolArray, FloatArray
from napari_shadowinv.errors import InputError
from napari_shadowinv.film import (
    Calibration,
    Pack,
    Poses,
    Response,
    check_orientation,
    combined_dose,
    find_films,
    moved_corners,
    read_corners,
    register,
    straightened,
    unexposed_pixel,
    unfold,
    usable_pixels,
)
from napari_shadowinv.film.registration import EDGES
from napari_shadowinv.film.response import relative_strengths
from napari_shadowinv.film.scans import common_shape, upright
from napari_shadowinv.fitting.measurements import estimated_noise
from napari_shadowinv.inversion.labels import PACK_FORMAT
from napari_shadowinv.io import read_radiograph
from napari_shadowinv.io.scans import Scan, read_scan

if TYPE_CHECKING:
    import xarray


__all__ = ["run_film"]

_ODD_SIZE = 0.1  # of the usual one
_ODD_PIXEL = 0.01
_DARK = 0.01  # of a film's pixels
_SAME_SCANNER = (0.98, 1.2)  # unexposed film over the lightest film of the table
_PER_AREA = "1/(m² MeV)"
_UNITS = {"dose": "Gy", "dose_error": "Gy", "fluence": _PER_AREA, "fluence_error": _PER_AREA}
_UNITS |= {"usable": "1", "by_images": "1", "sha256": "1", "turn": "rad"}

ByLayer = dict[str, tuple[tuple[str, ...], Any]]
Item = TypeVar("Item")
Made = TypeVar("Made")


@dataclass(frozen=True, eq=False)
class _Film:
    """The film of layer `number`: its scan as it should lie, its corners there, its calibration."""

    number: int
    scan: Scan
    corners: FloatArray
    calibration: Calibration
    background: FloatArray
    mask: BoolArray | None

    @property
    def name(self) -> str:
        return f"film {self.number}"


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
        the first layer's; with a setup ``time_of_flight`` (s); ``shift`` and ``shift_error`` (px)
        and ``turn`` (rad) against the film's edges, whether ``by_images``, and the ``corners``.
        Attribute ``warnings``: what one should know before trusting it.

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
    films = _films(pack, report)
    pixel = _pixel_size(pack, [film.scan for film in films])
    geometry = pack.setups(peaks, pixel)
    magnifications = np.array([one.magnification for one in geometry] or np.ones(len(peaks)))
    scales = magnifications / magnifications[0]
    shape = _common_shape(films, scales)

    def doses_of(film: _Film) -> _Doses:
        report("dose", film.number - 1, len(pack.layers), film.name)
        return _doses(film, shape, scales[film.number - 1], pack.rim)

    edges = _each(doses_of, films)
    poses = _poses(films, edges, pack.align, report)
    laid = [
        replace(film, corners=moved_corners(film.corners, shift, turn, scales[film.number - 1]))
        for film, shift, turn in zip(films, poses.shifts, poses.turns, strict=True)
    ]
    doses = edges if pack.align == "edges" else _each(doses_of, laid)
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
    by_film = _by_film(pack, laid, poses)
    warnings = _warnings(laid, doses, poses)
    setups = pack.setups(spectra.energies, pixel)
    return _dataset(pack, response, spectra.energies, setups, pixel, planes, by_film, warnings)


def _each(work: Callable[[Item], Made], items: Sequence[Item]) -> list[Made]:
    with ThreadPoolExecutor(available_threads(None)) as pool:
        return list(pool.map(work, items))


def _films(pack: Pack, report: Reporter) -> list[_Film]:
    """The films of all layers that are not excluded."""
    known = {} if pack.corners is None else read_corners(pack.corners)
    strange = set(known) - {str(number) for number in range(1, len(pack.layers) + 1)}
    if strange:
        raise InputError(
            f"{pack.corners} has corners of a film '{min(strange)}': expected numbers of layers, "
            f"from 1 to {len(pack.layers)}"
        )
    used = [number for number, layer in enumerate(pack.layers, 1) if not layer.exclude]
    if not used:
        raise InputError("all layers of the pack are excluded: expected at least one film")
    shared = _on_one_scan(pack, [k for k in used if pack.layers[k - 1].file is None], known)
    calibrations = {layer.film: _calibration(pack, layer.film) for layer in pack.layers}

    def film(number: int) -> _Film:
        layer = pack.layers[number - 1]
        report("read", number - 1, len(pack.layers), str(layer.file or pack.scan))
        if layer.file is None:
            scan, corners = shared[number]
        else:
            scan = read_scan(layer.file)
            given = known.get(str(number))
            corners = _only_film(layer.file, scan) if given is None else given
        calibration, background, bits = calibrations[layer.film]
        _check_bits(layer.file or pack.scan, scan, bits)
        mask = None if layer.mask is None else read_radiograph(layer.mask).image > 0
        scan, corners = _as_it_lay(scan, corners, layer.turned, layer.mirrored)
        return _Film(number, scan, corners, calibration, background, mask)

    films = _each(film, used)
    _check_different(pack, films)
    return films


def _check_different(pack: Pack, films: list[_Film]) -> None:
    """Reject a scan of one film that is given for two layers."""
    seen: dict[str, _Film] = {}
    for film in films:
        file = pack.layers[film.number - 1].file
        other = seen.setdefault(film.scan.checksum, film) if file is not None else film
        if other is not film:
            raise InputError(
                f"{file} of {film.name} has the same content as the scan of {other.name}: expected "
                "a scan of each film; exclude = true stands for a lost one"
            )


def _on_one_scan(
    pack: Pack, numbers: list[int], known: dict[str, FloatArray]
) -> dict[int, tuple[Scan, FloatArray]]:
    """The films of some layers on the scan that shows all of them."""
    if not numbers:
        return {}
    if pack.scan is None:
        raise InputError(
            f"layer {numbers[0]} has no file: give it, or a 'scan' of all films, or exclude = true "
            "if the film is lost"
        )
    scan = read_scan(pack.scan)
    if all(str(number) in known for number in numbers):
        return {number: (scan, known[str(number)]) for number in numbers}
    found = find_films(scan.pixels)
    if len(found) != len(numbers):
        raise InputError(
            f"{pack.scan} shows {len(found)} films, the pack has {len(numbers)} layers without a "
            "file of their own: expected one film for each, row by row; mark layers of lost films "
            "with exclude = true, or give corners"
        )
    return {number: (scan, one) for number, one in zip(numbers, found, strict=True)}


def _only_film(file: Path, scan: Scan) -> FloatArray:
    found = find_films(scan.pixels)
    if len(found) > 1:
        raise InputError(
            f"{file} shows {len(found)} films, expected one: give its corners, or name the file "
            "as the pack's 'scan' if it shows all films"
        )
    return found[0]


def _calibration(pack: Pack, kind: str) -> tuple[Calibration, FloatArray, int | None]:
    """How a type of film darkens, its unexposed pixel, and the bits of the scan of that."""
    film = pack.kinds[kind]
    if film.calibration is None:
        raise InputError(
            f"films of type '{kind}' have no calibration: give [films.{kind}] with calibration = "
            "a table of doses and pixels"
        )
    calibration = Calibration.from_csv(film.calibration, dose_range=film.dose_range)
    if film.unexposed is None:
        return calibration, calibration.background, None
    scan = read_scan(film.unexposed)
    background = unexposed_pixel(scan.pixels)
    lighter = background / calibration.background
    if (lighter > _SAME_SCANNER[0]).all() and (lighter < _SAME_SCANNER[1]).all():
        # Then no dose is no dose in both; the table's lightest film saw some.
        calibration = replace(calibration, background=background)
    return calibration, background, scan.pixels.dtype.itemsize * 8


def _check_bits(file: Path | None, scan: Scan, of_unexposed: int | None) -> None:
    bits = scan.pixels.dtype.itemsize * 8
    if bits != (of_unexposed or 16):
        as_what = "calibrations" if of_unexposed is None else "its unexposed film"
        raise InputError(
            f"{file} has {bits} bits per channel, {as_what} {of_unexposed or 16}: scan it again "
            f"with {3 * (of_unexposed or 16)}-bit colour"
        )


def _as_it_lay(
    scan: Scan, corners: FloatArray, turned: int, mirrored: bool
) -> tuple[Scan, FloatArray]:
    """Scan and corners of a film that was laid on the scanner another way round."""
    height, width = scan.pixels.shape[:2]
    pixels = scan.pixels
    if mirrored:
        pixels, corners = pixels[:, ::-1], corners[[1, 0, 3, 2]] * [1, -1] + [0, width - 1]
    if turned == 180:
        pixels = pixels[::-1, ::-1]
        corners = np.array([height - 1, width - 1]) - corners[[2, 3, 0, 1]]
    return scan._replace(pixels=pixels), corners


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


def _common_shape(films: list[_Film], scales: FloatArray) -> tuple[int, int]:
    sizes = np.array([upright(film.corners)[2] / scales[film.number - 1] for film in films])
    usual = np.median(sizes, axis=0)
    for film, size in zip(films, sizes, strict=True):
        if (np.abs(size / usual - 1) > _ODD_SIZE).any():
            raise InputError(
                f"{film.name} is {size[0]:.0f} × {size[1]:.0f} px, the others "
                f"{usual[0]:.0f} × {usual[1]:.0f}: expected films of one size; correct its corners"
            )
    return common_shape(sizes)


def _doses(film: _Film, shape: tuple[int, int], scale: float, rim: int) -> _Doses:
    values = straightened(film.scan.pixels, film.corners, shape=shape, scale=scale)
    found = combined_dose(values, film.calibration, background=film.background)
    usable = usable_pixels(values, film.calibration, background=film.background, rim=rim)
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


def _poses(films: list[_Film], doses: list[_Doses], align: str, report: Reporter) -> Poses:
    usable = np.array([one.usable for one in doses])
    logarithms = np.log(np.array([one.dose for one in doses]))
    check_orientation(logarithms, usable, [film.name for film in films])
    if align == "images":
        return register(logarithms, usable, report=report)
    return Poses.by_edges(len(films))


def _planes(
    count: int, shape: tuple[int, int], films: list[_Film], doses: list[_Doses]
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


def _by_film(pack: Pack, films: list[_Film], poses: Poses) -> ByLayer:
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
        _, corners = _as_it_lay(film.scan, film.corners, layer.turned, layer.mirrored)
        values["corners"][1][at] = corners
    return values


def _warnings(films: list[_Film], doses: list[_Doses], poses: Poses) -> list[str]:
    found = [
        f"{film.name} is darker than its calibration reaches over {one.too_dark:.0%} of it: left "
        "out"
        for film, one in zip(films, doses, strict=True)
        if one.too_dark > _DARK
    ]
    loose = [film.number for film, seen in zip(films, poses.by_images, strict=True) if not seen]
    if loose and len(films) > 1:
        found.append(
            f"films {', '.join(map(str, loose))} show too little in common with those beside them: "
            f"laid by their edges, to some {EDGES:.0f} px"
        )
    furthest = float(np.abs(poses.shifts).max())
    if furthest > 0:
        found.append(
            f"films were moved by up to {furthest:.1f} px by what they show, which fields "
            "displace, too: a fit of E beside B by these layers can be wrong without a sign of it"
        )
    return found


def _dataset(
    pack: Pack,
    response: Response,
    energies: FloatArray,
    setups: Sequence[Any],
    pixel: float | None,
    planes: dict[str, Any],
    by_film: ByLayer,
    warnings: list[str],
) -> xarray.Dataset:
    import xarray as xr

    bands = response.bands
    variables: dict[str, Any] = {}
    for name, values in planes.items():
        kept = values if name == "usable" else values.astype(np.float32)
        variables[name] = (("layer", "y", "x"), kept, {"units": _UNITS[name]})
    for name, (dims, values) in by_film.items():
        variables[name] = (dims, values, {"units": _UNITS.get(name, "px")})
    coordinates: dict[str, Any] = {
        "layer": np.arange(1, len(bands) + 1),
        "film": ("layer", [layer.film for layer in pack.layers]),
        "energy": ("layer", energies, {"units": "MeV"}),
        "peak": ("layer", [band.peak for band in bands], {"units": "MeV"}),
        "energy_low": ("layer", [band.low for band in bands], {"units": "MeV"}),
        "energy_high": ("layer", [band.high for band in bands], {"units": "MeV"}),
        "strength": ("layer", relative_strengths(energies), {"units": "1"}),
    }
    attributes: dict[str, Any] = {
        "format": PACK_FORMAT,
        "package_version": __version__,
        "created": datetime.now(UTC).isoformat(timespec="seconds"),
        "pack": pack.model_dump_json(exclude_defaults=True),
        "warnings": json.dumps(warnings),
    }
    if pixel is not None:
        attributes["scan_pixel_size"] = pixel
    if setups:
        flight = [one.time_of_flight for one in setups]
        coordinates["time_of_flight"] = ("layer", flight, {"units": "s"})
        attributes["setups"] = json.dumps([one.model_dump(mode="json") for one in setups])
    return xr.Dataset(variables, coordinates, attributes)
