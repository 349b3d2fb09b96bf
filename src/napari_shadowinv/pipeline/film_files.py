"""A film pack as a file, and its layers as files for other commands.

- read the description of a pack: `read_pack`
- write its layers as images with a table: `write_layers`
- a pack with corners and masks by hand: `corrected_pack`; their files: `copy_corrections`
"""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from napari_shadowinv._system.tables import read_rows, write_cells
from napari_shadowinv._system.validation import map_paths, validate
from napari_shadowinv._typing import BoolArray, FloatArray
from napari_shadowinv.film import Pack, PackLayer, read_corners, write_corners
from napari_shadowinv.film.scans import common_shape, upright
from napari_shadowinv.film_doses import FilmDoses
from napari_shadowinv.io import read_shot, read_toml, replacing, write
from napari_shadowinv.io.files import make_folder, write_toml
from napari_shadowinv.io.formats import TABLE, TIFF

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
