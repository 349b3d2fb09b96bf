"""A film pack as a file, and its layers as files for other commands.

- read the description of a pack: `read_pack`
- write its layers as images with a table: `write_layers`
- draft a description from a folder of scans, with the layers in the order of their names and the
  calibrations of the folder: `draft_pack`; as a file: `write_new_pack`
- list the entries still to be added: `missing_entries`
- a pack with corners and masks by hand: `corrected_pack`; their files: `copy_corrections`
"""

from __future__ import annotations

import re
import shutil
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from napari_shadowinv._system.tables import read_rows, write_cells
from napari_shadowinv._system.validation import map_paths, validate
from napari_shadowinv._typing import BoolArray, FloatArray
from napari_shadowinv.errors import FileFormatError, InputError
from napari_shadowinv.film import Calibration, Pack, PackLayer, read_corners, write_corners
from napari_shadowinv.film.pack import FILM_TYPES
from napari_shadowinv.film.scans import common_shape, upright
from napari_shadowinv.film_doses import FilmDoses
from napari_shadowinv.io import read_shot, read_toml, replacing, write
from napari_shadowinv.io.files import in_counting_order, make_folder, write_toml
from napari_shadowinv.io.formats import SCAN_SUFFIXES, TABLE, TIFF

LAYERS_TABLE = f"layers{TABLE.suffix}"
_COLUMNS = ("file", "mask", "setup", "energy", "strength", "exclude")


def read_pack(path: Path) -> Pack:
    """Read a pack from a TOML file; file names in it are relative to its folder.

    Its `layers` are tables, or the name of a table (.csv) with a row for each; its `setup` is a
    table, or the name of a TOML file. A `FileFormatError` if a file cannot be read; an `InputError`
    names an invalid entry.
    """
    path = Path(path).absolute()
    entries = read_toml(path)
    if isinstance(entries.get("layers"), str):
        rows = read_rows(path.parent / entries["layers"], PackLayer)
        entries["layers"] = [row.model_dump() for row in rows.values()]
    if isinstance(entries.get("setup"), str):
        entries["setup"] = read_toml(path.parent / entries["setup"])
    return map_paths(validate(Pack, entries, str(path)), path.parent.joinpath)


def write_layers(
    doses: FilmDoses,
    folder: Path,
    *,
    overwrite: bool = False,
) -> list[Path]:
    """Write the fluence of each layer as an image, its mask, its setup, and a table of them.

    Returns the files, the table last: ``layers.csv``, for `shadowinv fit` and `shadowinv batch`.
    Without a setup it contains the energy of each layer and the displacement of its protons by a
    magnetic field, relative to the first. The folder is made if it does not exist; a
    `FileFormatError` if a file exists, unless `overwrite`, or cannot be written.
    """
    make_folder(folder)
    setups, rows = doses.setups, []
    for k, used in enumerate(doses.usable):
        name = f"layer_{k + 1:02d}"
        row = {"mask": f"{name}_mask{TIFF.suffix}", "file": f"{name}{TIFF.suffix}"}
        fluence = np.where(used, doses.fluence[k], 0.0)
        write(folder / row["mask"], used.astype(np.float32), overwrite=overwrite)
        write(folder / row["file"], fluence, overwrite=overwrite)
        if setups:
            row["setup"] = f"{name}.toml"
            write_toml(folder / row["setup"], setups[k].model_dump(), overwrite)
        else:
            row["energy"] = f"{doses.energies[k]:.6g}"
            row["strength"] = f"{doses.strengths[k]:.6g}"
        if not used.any():
            row["exclude"] = "yes"
        rows.append(row)
    files = ("mask", "file", "setup")
    written = [folder / row[key] for row in rows for key in files if key in row]
    table = folder / LAYERS_TABLE
    columns = [name for name in _COLUMNS if any(name in row for row in rows)]
    with replacing(table, overwrite) as temporary:
        write_cells(temporary, columns, rows)
    return [*written, table]


PACK_FILE = "pack.toml"
_USUAL_FILM = "HDV2"
_UNEXPOSED_NAME = re.compile("unexposed|blank|background", re.IGNORECASE)


def draft_pack(folder: Path) -> dict[str, Any]:
    """Return the entries of a pack file for the scans of a folder.

    Each scan is a layer, in the order of the names (film_2 before film_10), without filters. A scan
    that is named after a film type, or with "unexposed" or "blank", shows unexposed film. A table
    (.csv) that can be read as a calibration belongs to the type in its name, or to all types. A
    `FileFormatError` if the folder cannot be read; an `InputError` if it has no scans.
    """
    folder = Path(folder)
    try:
        files = in_counting_order(path for path in folder.iterdir() if path.is_file())
    except OSError as error:
        raise FileFormatError(
            f"{folder} cannot be read as a folder ({error.strerror}): choose the folder of the "
            "scans"
        ) from None
    scans = [path for path in files if path.suffix.lower() in SCAN_SUFFIXES]
    unexposed = [p for p in scans if p.stem in FILM_TYPES or _UNEXPOSED_NAME.search(p.stem)]
    scans = [path for path in scans if path not in unexposed]
    if not scans:
        raise InputError(f"{folder} has no scans of films: expected images in colour, such as TIFF")
    tables = [path for path in files if path.suffix.lower() in TABLE.suffixes]
    calibrations = [path for path in tables if _is_calibration(path)]
    layers: list[dict[str, Any]] = [
        {"film": _film_type_of(path) or _USUAL_FILM, "filters": [], "file": path.name}
        for path in scans
    ]
    films: dict[str, dict[str, str]] = {}
    for kind in sorted({layer["film"] for layer in layers}):
        for part, candidates in (("calibration", calibrations), ("unexposed", unexposed)):
            by_type = {path: _film_type_of(path) for path in candidates}
            of_kind = [path for path, film_type in by_type.items() if film_type == kind]
            of_any = [path for path, film_type in by_type.items() if film_type is None]
            if matching := of_kind or of_any:
                films.setdefault(kind, {})[part] = matching[0].name
    return {"films": films, "layers": layers}


def missing_entries(entries: Mapping[str, Any]) -> list[str]:
    """Return the missing and recommended entries of a pack, one clause for each."""
    missing = []
    if not any(layer["filters"] for layer in entries["layers"]):
        missing.append("filters: those in front of each film, such as 13 um Al; 25 um Fe")
    for kind in sorted({layer["film"] for layer in entries["layers"]}):
        if "calibration" not in entries["films"].get(kind, {}):
            missing.append(f"calibration of {kind}: a table (.csv) of doses and pixels")
    if "seen_from" not in entries:
        missing.append("seen from: source or detector, which decides the sign of B")
    if "setup" not in entries:
        missing.append("setup: distances, without which results are in px")
    return missing


def write_new_pack(folder: Path, entries: Mapping[str, Any], *, overwrite: bool = False) -> Path:
    """Write the entries of a pack to ``pack.toml`` of a folder, and return its path.

    A `FileFormatError` if the file exists, unless `overwrite`, or cannot be written; an
    `InputError` with the reason if the entries do not describe a pack.
    """
    path = Path(folder) / PACK_FILE
    validate(Pack, dict(entries), str(path))
    write_toml(path, entries, overwrite)
    return path


def _film_type_of(path: Path) -> str | None:
    return next((kind for kind in FILM_TYPES if kind.lower() in path.stem.lower()), None)


def _is_calibration(path: Path) -> bool:
    try:
        Calibration.from_csv(path)
    except (FileFormatError, InputError):
        return False
    return True


def corrected_pack(
    pack: Pack,
    folder: Path,
    corners: Mapping[str, FloatArray] | None,
    excluded: BoolArray | None,
    scales: FloatArray | None,
) -> tuple[Pack, BoolArray | None]:
    """Write corrections by hand to a new folder; return the pack with them.

    `corners` are those of all films by number. Also returns the excluded pixels, (n, H, W), on the
    grid of the corners; `scales`, (n,), is the pixel side of the upright films in pixels of each
    film's scan, needed with corners.
    """
    changes: dict[str, Any] = {}
    if corners is not None:
        folder.mkdir(parents=True, exist_ok=True)
        changes["corners"] = folder / "corners.csv"
        write_corners(changes["corners"], dict(corners))
        if excluded is not None:
            assert scales is not None
            films = read_corners(changes["corners"])
            sides = [upright(films[n])[2] / scales[int(n) - 1] for n in films]
            excluded = _resize(excluded, common_shape(sides))
    if excluded is not None and excluded.any():
        layers = list(pack.layers)
        for k in np.flatnonzero(excluded.any(axis=(1, 2))):
            usable, mask_file = ~excluded[k], layers[k].mask
            if mask_file is not None:
                mask = read_shot(mask_file).image > 0
                if mask.shape != usable.shape:
                    continue  # `run_film` reports it
                usable &= mask
            folder.mkdir(parents=True, exist_ok=True)
            file = folder / f"mask_{k + 1:02d}{TIFF.suffix}"
            write(file, usable.astype(np.float32))
            layers[k] = layers[k].model_copy(update={"mask": file})
        changes["layers"] = tuple(layers)
    return pack.model_copy(update=changes), excluded


def _resize(planes: BoolArray, shape: tuple[int, int]) -> BoolArray:
    """Crop or pad planes around their centres."""
    sides = planes.shape[1:]
    y, x = (np.arange(new) + (old - new) // 2 for new, old in zip(shape, sides, strict=True))
    inside = ((y >= 0) & (y < sides[0]))[:, None] & (x >= 0) & (x < sides[1])
    rows, columns = (np.clip(index, 0, old - 1) for index, old in zip((y, x), sides, strict=True))
    return np.asarray(planes[:, rows[:, None], columns] & inside)


def copy_corrections(doses: FilmDoses, scratch: Path, path: Path) -> FilmDoses:
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
