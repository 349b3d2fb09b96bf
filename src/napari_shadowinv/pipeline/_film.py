"""From the scans of a film pack to doses and fluences on common pixels.

- the films as scanned, with corners, calibration and marks: `read_films`
- their doses and fluences: `run_film`
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from napari_shadowinv._system.machine import available_threads, results_of
from napari_shadowinv._system.progress import OnProgress, Reporter, ShouldStop
from napari_shadowinv._system.tables import read_rows
from napari_shadowinv._system.validation import CheckedModel
from napari_shadowinv._typing import AnyArray, BoolArray, FloatArray
from napari_shadowinv.cautions import Caution
from napari_shadowinv.errors import InputError
from napari_shadowinv.facts import percent
from napari_shadowinv.film import Calibration, Pack, PackLayer, combined_dose, read_corners
from napari_shadowinv.film.calibration import unexposed_pixel
from napari_shadowinv.film.registration import (
    EDGE_ERROR_PX,
    Poses,
    check_orientation,
    move_corners,
    poses_by_fiducials,
    register,
)
from napari_shadowinv.film.scans import (
    burnt_edges,
    common_shape,
    find_films,
    straighten_film,
    upright,
    usable_pixels,
)
from napari_shadowinv.film.unfolding import ResponseMatrix, unfold
from napari_shadowinv.film_doses import FilmDoses
from napari_shadowinv.io.files import text_of
from napari_shadowinv.io.images import INCH_M, Scan, read_scan
from napari_shadowinv.pipeline.inversion_run import picture_mask
from napari_shadowinv.preprocessing.noise import estimated_noise
from napari_shadowinv.provenance import ImageOrigin, Provenance

_UNEXPOSED_RANGE = (0.98, 1.2)  # unexposed film over the lightest film of the table
# Films are cut at right angles, but by hand: by share of the diagonal, and in metres.
_MAX_ASKEW_SHARE, _MAX_ASKEW_M = 0.015, 2e-3


@dataclass(frozen=True, eq=False)
class Film:
    """The film of layer `number`: its scan the right way round, corners and calibration.

    Its image is larger by `scale` than the first film's.
    """

    number: int
    layer: PackLayer
    scan: Scan
    corners: FloatArray
    calibration: Calibration
    background: FloatArray
    mask: BoolArray | None
    fiducials: dict[str, FloatArray]
    turn: tuple[int, bool]  # by which the scan was turned and mirrored, see `to_scan_frame`
    scale: float = 1.0

    @property
    def name(self) -> str:
        return f"film {self.number}"


class _FilmFiducial(CheckedModel):
    """A mark through the pack, in px of a film's scan."""

    film: int
    name: str
    y: float
    x: float


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
    fiducials = {} if pack.fiducials is None else read_fiducials(pack.fiducials, len(pack.layers))
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
        mask = None if layer.mask is None else picture_mask(layer.mask)
        _check_on_scan(fiducials.get(number, []), scan, pack.fiducials)
        turn = layer.turned, pack.is_mirrored(layer)
        marks = {
            mark.name: _turn_places(np.array([mark.y, mark.x]), scan, *turn)
            for mark in fiducials.get(number, [])
        }
        scan, corners = to_scan_frame(scan, corners, *turn)
        return Film(number, layer, scan, corners, calibration, background, mask, marks, turn)

    films = results_of([partial(film, number) for number in used], available_threads(None))
    _check_distinct(films)
    return films


def _check_rectangle(number: int, corners: FloatArray, pixel_size: float | None) -> None:
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


def read_fiducials(table: Path, n_layers: int) -> dict[int, list[_FilmFiducial]]:
    """Read the marks through a pack, by the number of the film."""
    marks: dict[int, list[_FilmFiducial]] = {}
    for line, row in read_rows(table, _FilmFiducial).items():
        if not 1 <= row.film <= n_layers:
            raise InputError(
                f"{table}, line {line} has a mark on film {row.film}: expected numbers of layers, "
                f"from 1 to {n_layers}"
            )
        if any(row.name == mark.name for mark in marks.get(row.film, [])):
            raise InputError(
                f"{table}, line {line} has the mark '{row.name}' twice on film {row.film}: "
                "expected another name for each"
            )
        marks.setdefault(row.film, []).append(row)
    return marks


def _check_on_scan(marks: Sequence[_FilmFiducial], scan: Scan, table: Path | None) -> None:
    height, width = scan.pixels.shape[:2]
    for mark in marks:
        if not (-0.5 <= mark.y <= height - 0.5 and -0.5 <= mark.x <= width - 0.5):
            raise InputError(
                f"{table} has the mark '{mark.name}' of film {mark.film} at y = {mark.y:g}, "
                f"x = {mark.x:g}, outside of its scan of {height} × {width} px: correct it"
            )


def _check_distinct(films: list[Film]) -> None:
    by_checksum: dict[str, Film] = {}
    for film in films:
        file = film.layer.file
        first = by_checksum.setdefault(film.scan.checksum, film) if file is not None else film
        if first is not film:
            raise InputError(
                f"{file} of {film.name} has the same content as the scan of {first.name}: expected "
                "a scan of each film; exclude = true stands for a lost one"
            )


def _find_on_shared_scan(
    pack: Pack, numbers: list[int], measured: dict[str, FloatArray]
) -> dict[int, tuple[Scan, FloatArray]]:
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
    pixels, corners = scan.pixels, _turn_places(corners, scan, turned, mirrored)
    if mirrored:
        pixels, corners = pixels[:, ::-1], corners[[1, 0, 3, 2]]
    if turned == 180:
        pixels, corners = pixels[::-1, ::-1], corners[[2, 3, 0, 1]]
    return scan._replace(pixels=pixels), corners


def _turn_places(places: FloatArray, scan: Scan, turned: int, mirrored: bool) -> FloatArray:
    last = np.array(scan.pixels.shape[:2]) - 1
    if mirrored:
        places = places * [1, -1] + [0, last[1]]
    return np.asarray(last - places if turned == 180 else places)


_MAX_SIZE_DEVIATION = 0.1  # from the median size
_MAX_PIXEL_DEVIATION = 0.01
# Scanners have round resolutions: 75, 300, 1200 dots per inch, or pixels of 25 or 50 µm.
_SCANNER_DPI, _SCANNER_DPI_STEP, _SCANNER_STEP_M, _MAX_STEP_DEVIATION = (74, 9700), 25, 5e-6, 0.001
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
    response = ResponseMatrix.of(pack)
    peaks = np.array([band.peak for band in response.bands])
    scanned = read_films(pack, report)
    pixel = _pixel_size(pack, [film.scan for film in scanned])
    geometry = pack.setups(peaks, pixel)
    magnifications = np.array([setup.magnification for setup in geometry] or np.ones(len(peaks)))
    scales = magnifications / magnifications[0]
    films = [replace(film, scale=scales[film.number - 1]) for film in scanned]
    shape = _common_shape(films)

    def doses_of(film: Film) -> _Doses:
        report("dose", film.number - 1, len(pack.layers), film.name)
        return _film_doses(film, shape, pack.rim)

    def by_layer(values: Sequence[AnyArray] | AnyArray, excluded: Any = np.nan) -> AnyArray:
        """Return values of the films by layer, with `excluded` for those without a film."""
        layers: AnyArray = np.full((len(pack.layers), *np.shape(values[0])), excluded)
        for film, value in zip(films, values, strict=True):
            layers[film.number - 1] = value
        return layers

    corners = by_layer([to_scan_frame(film.scan, film.corners, *film.turn)[1] for film in films])
    # Marks through the pack lie behind each other, the image content lies on rays.
    marked = any(film.fiducials for film in films)
    if not marked:
        films = _scale_about_axis(films, pack)
    threads = available_threads(None)
    edges = results_of([partial(doses_of, film) for film in films], threads)
    poses = _align_films(films, edges, pack, report)
    aligned = [
        replace(film, corners=move_corners(film.corners, shift, turn, film.scale))
        for film, shift, turn in zip(films, poses.shifts, poses.turns, strict=True)
    ]
    if marked:
        aligned = _scale_about_axis(aligned, pack)
    pairs = zip(films, aligned, strict=True)
    moved = any((film.corners != shifted.corners).any() for film, shifted in pairs)
    doses = edges
    if moved:
        doses = results_of([partial(doses_of, film) for film in aligned], threads)
    dose = by_layer([film_doses.dose for film_doses in doses])
    error = by_layer([film_doses.error for film_doses in doses])
    usable = by_layer([film_doses.usable for film_doses in doses], False)
    # Per area of the first film: behind it the same protons cover more.
    dose *= scales[:, None, None] ** 2
    origins = tuple(
        ImageOrigin(
            file=text_of(Path(film.layer.file or pack.scan or "").name), sha256=film.scan.checksum
        )
        for film in films
    )
    spectra = unfold(
        dose,
        np.where(usable, error, np.inf),
        response,
        on_progress=on_progress,
        should_stop=should_stop,
    )
    error *= dose
    return FilmDoses(
        dose=dose.astype(np.float32),
        dose_error=error.astype(np.float32),
        fluence=spectra.fluence.astype(np.float32),
        fluence_error=spectra.error.astype(np.float32),
        usable=usable,
        shifts=by_layer(poses.shifts),
        shift_errors=by_layer(poses.errors),
        turns=by_layer(poses.turns),
        by_images=by_layer(poses.by_images, False),
        corners=corners,
        energies=spectra.energies,
        bands=np.array([(band.peak, band.low, band.high) for band in response.bands]),
        provenance=Provenance(kind="film pack", pack=pack, images=origins),
        cautions=(*_cautions(aligned, doses, poses, pack), *_pixel_cautions(pack, pixel)),
        pixel_size=pixel,
        setups=pack.setups(spectra.energies, pixel),
    )


def _scale_about_axis(films: list[Film], pack: Pack) -> list[Film]:
    if pack.axis is None:
        return films
    away = np.array(pack.axis) - (upright(films[0].corners)[2] - 1) / 2
    moved = []
    for film in films:
        shift = (1 - film.scale) / film.scale * away
        moved.append(replace(film, corners=move_corners(film.corners, shift, 0.0, film.scale)))
    return moved


def _pixel_size(pack: Pack, scans: list[Scan]) -> float | None:
    if pack.pixel_size is not None:
        return pack.pixel_size
    sizes = [scan.pixel_size for scan in scans if scan.pixel_size is not None]
    if len(sizes) < len(scans):
        if pack.setup is not None:
            raise InputError(
                "the scans do not contain the size of their pixels: give the pack's pixel size, in "
                "m (25.4 mm over the dots per inch)"
            )
        return None
    if max(sizes) > (1 + _MAX_PIXEL_DEVIATION) * min(sizes):
        raise InputError(
            f"the scans' pixels are {1e6 * min(sizes):.4g} to {1e6 * max(sizes):.4g} µm wide: "
            "expected all films scanned with the same resolution; scan them again"
        )
    return sizes[0]


def _pixel_cautions(pack: Pack, pixel: float | None) -> tuple[Caution, ...]:
    if pixel is None or pack.pixel_size is not None:
        return ()
    per_inch = INCH_M / pixel
    by_inch, by_length = per_inch / _SCANNER_DPI_STEP, pixel / _SCANNER_STEP_M
    is_round = any(
        abs(n / round(n) - 1) < _MAX_STEP_DEVIATION for n in (by_inch, by_length) if n > 1
    )
    if is_round and _SCANNER_DPI[0] <= per_inch <= _SCANNER_DPI[1]:
        return ()
    text = (
        f"the scans give {per_inch:.4g} dots per inch (pixels of {1e6 * pixel:.4g} µm), unlike a "
        "scanner: picture programs write such a number when they save a scan again, and then all "
        "lengths are wrong; give the pack's pixel size (25.4 mm over the scanner's dots per inch)"
    )
    return (Caution("film-pixels", text),)


def _common_shape(films: list[Film]) -> tuple[int, int]:
    sizes = np.array([upright(film.corners)[2] / film.scale for film in films])
    usual = np.median(sizes, axis=0)
    for film, size in zip(films, sizes, strict=True):
        if (np.abs(size / usual - 1) > _MAX_SIZE_DEVIATION).any():
            raise InputError(
                f"{film.name} is {size[0]:.0f} × {size[1]:.0f} px, the others "
                f"{usual[0]:.0f} × {usual[1]:.0f}: expected films of one size; correct its corners"
            )
    return common_shape(sizes)


def _film_doses(film: Film, shape: tuple[int, int], rim: int) -> _Doses:
    values = straighten_film(film.scan.pixels, film.corners, shape=shape, scale=film.scale)
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
        of_kind = np.flatnonzero([name == kind for name in kinds])
        for axis in (0, 1):
            order = of_kind[np.argsort(sizes[of_kind, axis])]
            lengths = sizes[order, axis]
            groups[order, axis] = np.cumsum(np.diff(lengths, prepend=lengths[0]) > _CUT_APART_PX)
    return [(kind, *map(int, group)) for kind, group in zip(kinds, groups, strict=True)]


def _align_films(films: list[Film], doses: list[_Doses], pack: Pack, report: Reporter) -> Poses:
    usable = np.array([film_doses.usable for film_doses in doses])
    logarithms = np.log(np.array([film_doses.dose for film_doses in doses]))
    check_orientation(logarithms, usable, [film.name for film in films])
    if any(film.fiducials for film in films):
        return poses_by_fiducials(
            [film.fiducials for film in films],
            [film.corners for film in films],
            [film.scale for film in films],
            [film.name for film in films],
        )
    if pack.align == "images":
        kinds = [film.layer.film for film in films]
        return register(logarithms, usable, kinds=_cut_groups(films, kinds), report=report)
    return Poses.by_edges(len(films))


def _cautions(films: list[Film], doses: list[_Doses], poses: Poses, pack: Pack) -> list[Caution]:
    cautions = [
        Caution(
            "film-range",
            f"{film.name}: {percent(film_doses.too_dark)} of the pixels are darker than the "
            "calibration covers and were masked",
        )
        for film, film_doses in zip(films, doses, strict=True)
        if film_doses.too_dark > _MAX_DARK_SHARE
    ]
    at_edges = ~poses.by_images & (poses.errors >= EDGE_ERROR_PX)
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
            "if they are seen from the detector, B has the wrong sign; state the side in the pack"
        )
        cautions.append(Caution("film-side", text))
    return cautions
