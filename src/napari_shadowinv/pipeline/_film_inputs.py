"""The films of a pack as scanned, with corners, calibration and marks: `read_films`."""

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
from napari_shadowinv.io.images import Scan, read_scan
from napari_shadowinv.pipeline.shot_table import rows_of

__all__ = ["Film", "in_parallel", "read_films", "to_scan_frame"]

_UNEXPOSED_RANGE = (0.98, 1.2)  # unexposed film over the lightest film of the table
# Films are cut at right angles, but by hand: by share of the diagonal, and in metres.
_MAX_ASKEW_SHARE, _MAX_ASKEW_M = 0.015, 2e-3

Item = TypeVar("Item")
Result = TypeVar("Result")


@dataclass(frozen=True, eq=False)
class Film:
    """The film of layer `number`: its scan the right way round, corners and calibration."""

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


def in_parallel(work: Callable[[Item], Result], items: Sequence[Item]) -> list[Result]:
    with ThreadPoolExecutor(available_threads(None)) as pool:
        return list(pool.map(work, items))


def read_films(pack: Pack, report: Reporter) -> list[Film]:
    """Read the films of all layers that are not excluded."""
    measured = {} if pack.corners is None else read_corners(pack.corners)
    strange = set(measured) - {str(number) for number in range(1, len(pack.layers) + 1)}
    if strange:
        raise InputError(
            f"{pack.corners} has corners of a film '{min(strange)}': expected numbers of layers, "
            f"from 1 to {len(pack.layers)}"
        )
    used = [number for number, layer in enumerate(pack.layers, 1) if not layer.exclude]
    if not used:
        raise InputError("all layers of the pack are excluded: expected at least one film")
    shared = _find_on_shared_scan(
        pack, [k for k in used if pack.layers[k - 1].file is None], measured
    )
    fiducials = _read_marks(pack)
    calibrations = {layer.film: _calibration(pack, layer.film) for layer in pack.layers}

    def film(number: int) -> Film:
        layer = pack.layers[number - 1]
        report("read", number - 1, len(pack.layers), str(layer.file or pack.scan))
        if layer.file is None:
            scan, corners = shared[number]
        else:
            scan = read_scan(layer.file)
            by_hand = measured.get(str(number))
            corners = _find_single_film(layer.file, scan) if by_hand is None else by_hand
        if str(number) in measured:
            _check_rectangle(number, corners, scan.pixel_size)
        calibration, background, bits = calibrations[layer.film]
        _check_bits(layer.file or pack.scan, scan, bits)
        mask = None if layer.mask is None else read_radiograph(layer.mask).image > 0
        _check_on_scan(fiducials.get(number, []), scan, pack.fiducials)
        is_mirrored = pack.is_mirrored(layer)
        lay = scan, layer.turned, is_mirrored
        marks = {
            mark.name: _turned_places(np.array([mark.y, mark.x]), *lay)
            for mark in fiducials.get(number, [])
        }
        scan, corners = to_scan_frame(scan, corners, layer.turned, is_mirrored)
        return Film(number, scan, corners, calibration, background, mask, marks)

    films = in_parallel(film, used)
    _check_distinct(pack, films)
    return films


def _check_rectangle(number: int, corners: FloatArray, pixel_size: float | None) -> None:
    """Raise an `InputError` if measured corners are far from a rectangle."""
    axes, middle, size = upright(corners)
    signs = np.array([(-1, -1), (-1, 1), (1, 1), (1, -1)])
    away = np.hypot(*(corners - middle - signs * size / 2 @ axes).T).max()
    limit = _MAX_ASKEW_SHARE * np.hypot(*size)
    if pixel_size is not None:
        limit = min(limit, _MAX_ASKEW_M / pixel_size)
    if away > limit:
        raise InputError(
            f"the corners of film {number} are up to {away:.0f} px from those of a rectangle: "
            "expected the four corners of the film itself; correct the one inside or outside the "
            "film"
        )


def _read_marks(pack: Pack) -> dict[int, list[_Fiducial]]:
    """Read the marks through the pack, by the number of the film."""
    marks: dict[int, list[_Fiducial]] = {}
    for row in [] if pack.fiducials is None else rows_of(pack.fiducials, _Fiducial):
        if not 1 <= row.film <= len(pack.layers):
            raise InputError(
                f"{pack.fiducials} has a mark on film {row.film}: expected numbers of layers, from "
                f"1 to {len(pack.layers)}"
            )
        if any(row.name == mark.name for mark in marks.get(row.film, [])):
            raise InputError(
                f"{pack.fiducials} has the mark '{row.name}' twice on film {row.film}: expected "
                "another name for each"
            )
        marks.setdefault(row.film, []).append(row)
    return marks


def _check_on_scan(marks: Sequence[_Fiducial], scan: Scan, table: Path | None) -> None:
    """Raise an `InputError` if a mark lies outside its film's scan."""
    height, width = scan.pixels.shape[:2]
    for mark in marks:
        if not (-0.5 <= mark.y <= height - 0.5 and -0.5 <= mark.x <= width - 0.5):
            raise InputError(
                f"{table} has the mark '{mark.name}' of film {mark.film} at y = {mark.y:g}, "
                f"x = {mark.x:g}, outside of its scan of {height} × {width} px: correct it"
            )


def _check_distinct(pack: Pack, films: list[Film]) -> None:
    """Raise an `InputError` if two layers have the same scan of a single film."""
    by_checksum: dict[str, Film] = {}
    for film in films:
        file = pack.layers[film.number - 1].file
        first = by_checksum.setdefault(film.scan.checksum, film) if file is not None else film
        if first is not film:
            raise InputError(
                f"{file} of {film.name} has the same content as the scan of {first.name}: expected "
                "a scan of each film; exclude = true stands for a lost one"
            )


def _find_on_shared_scan(
    pack: Pack, numbers: list[int], measured: dict[str, FloatArray]
) -> dict[int, tuple[Scan, FloatArray]]:
    """Locate the films of some layers on the scan that they share."""
    if not numbers:
        return {}
    if pack.scan is None:
        raise InputError(
            f"layer {numbers[0]} has no file: give it, or a 'scan' of all films, or exclude = true "
            "if the film is lost"
        )
    scan = read_scan(pack.scan)
    if all(str(number) in measured for number in numbers):
        return {number: (scan, measured[str(number)]) for number in numbers}
    all_corners = find_films(scan.pixels)
    if len(all_corners) != len(numbers):
        raise InputError(
            f"{pack.scan} shows {len(all_corners)} films, the pack has {len(numbers)} layers "
            "without a file of their own: expected one film for each, row by row; mark layers of "
            "lost films with exclude = true, or give corners"
        )
    return {number: (scan, corners) for number, corners in zip(numbers, all_corners, strict=True)}


def _find_single_film(file: Path, scan: Scan) -> FloatArray:
    all_corners = find_films(scan.pixels)
    if len(all_corners) > 1:
        raise InputError(
            f"{file} shows {len(all_corners)} films, expected one: give its corners, or name the "
            "file as the pack's 'scan' if it shows all films"
        )
    return all_corners[0]


def _calibration(pack: Pack, kind: str) -> tuple[Calibration, FloatArray, int | None]:
    """Return the calibration of a type of film, its unexposed pixel, and the bits of its scan."""
    film = pack.film_types[kind]
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
    if (lighter > _UNEXPOSED_RANGE[0]).all() and (lighter < _UNEXPOSED_RANGE[1]).all():
        # Then zero dose is the same in both; the lightest film of the table has some dose.
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


def to_scan_frame(
    scan: Scan, corners: FloatArray, turned: int, mirrored: bool
) -> tuple[Scan, FloatArray]:
    """Turn and mirror scan and corners of a film to the right way round, or back."""
    pixels, corners = scan.pixels, _turned_places(corners, scan, turned, mirrored)
    if mirrored:
        pixels, corners = pixels[:, ::-1], corners[[1, 0, 3, 2]]
    if turned == 180:
        pixels, corners = pixels[::-1, ::-1], corners[[2, 3, 0, 1]]
    return scan._replace(pixels=pixels), corners


def _turned_places(places: FloatArray, scan: Scan, turned: int, mirrored: bool) -> FloatArray:
    """Turn and mirror places (y, x) on a scan."""
    last = np.array(scan.pixels.shape[:2]) - 1
    if mirrored:
        places = places * [1, -1] + [0, last[1]]
    return np.asarray(last - places if turned == 180 else places)
