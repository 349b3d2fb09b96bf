"""The films of a pack as they were scanned, with all that is known of each: `read_films`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeVar

import numpy as np
from pydantic import ConfigDict

from napari_shadowinv._system.machine import available_threads
from napari_shadowinv._system.progress import Reporter
from napari_shadowinv._system.validation import CheckedModel
from napari_shadowinv._typing import BoolArray, FloatArray
from napari_shadowinv.errors import InputError
from napari_shadowinv.film import (
    Calibration,
    Pack,
    find_films,
    read_corners,
    unexposed_pixel,
)
from napari_shadowinv.film.scans import upright
from napari_shadowinv.io import read_radiograph
from napari_shadowinv.io.scans import Scan, read_scan
from napari_shadowinv.pipeline.shot_table import rows_of

__all__ = ["Film", "as_it_lay", "in_parallel", "read_films"]

_SAME_SCANNER = (0.98, 1.2)  # unexposed film over the lightest film of the table
# Films are cut at right angles, but by hand: by share of the diagonal, and in metres.
_MAX_ASKEW_SHARE, _MAX_ASKEW_M = 0.015, 2e-3

Item = TypeVar("Item")
Made = TypeVar("Made")


@dataclass(frozen=True, eq=False)
class Film:
    """The film of layer `number`: its scan as it should lie, its corners there, its calibration."""

    number: int
    scan: Scan
    corners: FloatArray
    calibration: Calibration
    background: FloatArray
    mask: BoolArray | None
    fiducials: dict[str, FloatArray]

    @property
    def name(self) -> str:
        return f"film {self.number}"


class _Fiducial(CheckedModel):
    """A mark through the pack, in px of a film's scan."""

    model_config = ConfigDict(frozen=True, extra="forbid")
    film: int
    name: str
    y: float
    x: float


def in_parallel(work: Callable[[Item], Made], items: Sequence[Item]) -> list[Made]:
    with ThreadPoolExecutor(available_threads(None)) as pool:
        return list(pool.map(work, items))


def read_films(pack: Pack, report: Reporter) -> list[Film]:
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
    fiducials = _fiducials(pack)
    calibrations = {layer.film: _calibration(pack, layer.film) for layer in pack.layers}

    def film(number: int) -> Film:
        layer = pack.layers[number - 1]
        report("read", number - 1, len(pack.layers), str(layer.file or pack.scan))
        if layer.file is None:
            scan, corners = shared[number]
        else:
            scan = read_scan(layer.file)
            given = known.get(str(number))
            corners = _only_film(layer.file, scan) if given is None else given
        if str(number) in known:
            _check_rectangle(number, corners, scan.pixel_size)
        calibration, background, bits = calibrations[layer.film]
        _check_bits(layer.file or pack.scan, scan, bits)
        mask = None if layer.mask is None else read_radiograph(layer.mask).image > 0
        _check_on_scan(fiducials.get(number, []), scan, pack.fiducials)
        is_mirrored = pack.is_mirrored(layer)
        lay = scan, layer.turned, is_mirrored
        marks = {
            one.name: _where_it_lay(np.array([one.y, one.x]), *lay)
            for one in fiducials.get(number, [])
        }
        scan, corners = as_it_lay(scan, corners, layer.turned, is_mirrored)
        return Film(number, scan, corners, calibration, background, mask, marks)

    films = in_parallel(film, used)
    _check_different(pack, films)
    return films


def _check_rectangle(number: int, corners: FloatArray, pixel_size: float | None) -> None:
    """Reject corners that somebody gave and that are far from those of a rectangle."""
    axes, middle, size = upright(corners)
    signs = np.array([(-1, -1), (-1, 1), (1, 1), (1, -1)])
    away = np.hypot(*(corners - middle - signs * size / 2 @ axes).T).max()
    limit = _MAX_ASKEW_SHARE * np.hypot(*size)
    if pixel_size is not None:
        limit = min(limit, _MAX_ASKEW_M / pixel_size)
    if away > limit:
        raise InputError(
            f"the corners of film {number} are up to {away:.0f} px from those of a rectangle: "
            "expected the four corners of the film itself; correct the one that lies inside or "
            "beside the film"
        )


def _fiducials(pack: Pack) -> dict[int, list[_Fiducial]]:
    """Marks through the pack, by the number of the film."""
    found: dict[int, list[_Fiducial]] = {}
    for row in [] if pack.fiducials is None else rows_of(pack.fiducials, _Fiducial):
        if not 1 <= row.film <= len(pack.layers):
            raise InputError(
                f"{pack.fiducials} has a mark on film {row.film}: expected numbers of layers, from "
                f"1 to {len(pack.layers)}"
            )
        if any(row.name == other.name for other in found.get(row.film, [])):
            raise InputError(
                f"{pack.fiducials} has the mark '{row.name}' twice on film {row.film}: expected "
                "another name for each"
            )
        found.setdefault(row.film, []).append(row)
    return found


def _check_on_scan(marks: Sequence[_Fiducial], scan: Scan, table: Path | None) -> None:
    """Reject a mark that lies outside of its film's scan."""
    height, width = scan.pixels.shape[:2]
    for mark in marks:
        if not (-0.5 <= mark.y <= height - 0.5 and -0.5 <= mark.x <= width - 0.5):
            raise InputError(
                f"{table} has the mark '{mark.name}' of film {mark.film} at y = {mark.y:g}, "
                f"x = {mark.x:g}, outside of its scan of {height} × {width} px: correct it"
            )


def _check_different(pack: Pack, films: list[Film]) -> None:
    """Reject a scan of one film that is given for two layers."""
    seen: dict[str, Film] = {}
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


def as_it_lay(
    scan: Scan, corners: FloatArray, turned: int, mirrored: bool
) -> tuple[Scan, FloatArray]:
    """Scan and corners of a film that was laid on the scanner another way round."""
    pixels, corners = scan.pixels, _where_it_lay(corners, scan, turned, mirrored)
    if mirrored:
        pixels, corners = pixels[:, ::-1], corners[[1, 0, 3, 2]]
    if turned == 180:
        pixels, corners = pixels[::-1, ::-1], corners[[2, 3, 0, 1]]
    return scan._replace(pixels=pixels), corners


def _where_it_lay(places: FloatArray, scan: Scan, turned: int, mirrored: bool) -> FloatArray:
    """Places (y, x) on the scan of such a film."""
    last = np.array(scan.pixels.shape[:2]) - 1
    if mirrored:
        places = places * [1, -1] + [0, last[1]]
    return np.asarray(last - places if turned == 180 else places)
