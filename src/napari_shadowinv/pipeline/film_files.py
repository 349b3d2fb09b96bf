"""A film pack as a file, and its layers as files for other commands.

- read the description of a pack: `read_pack`
- write its layers as images with a table: `write_layers`
"""

from __future__ import annotations

import csv
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import numpy as np

from napari_shadowinv._system.validation import validated
from napari_shadowinv.errors import FileFormatError, InputError
from napari_shadowinv.film import Pack, PackLayer
from napari_shadowinv.film_doses import FilmDoses
from napari_shadowinv.io import read_toml, replacing, write
from napari_shadowinv.io.formats import PRADFORMAT, SITES, TIFF
from napari_shadowinv.io.pradformat import write_radiograph
from napari_shadowinv.pipeline.shot_table import rows_of

__all__ = ["LAYERS_TABLE", "read_pack", "write_layers"]

LAYERS_TABLE = f"layers{SITES.suffix}"
_COLUMNS = ("file", "mask", "setup", "energy", "strength", "exclude")


def read_pack(path: Path) -> Pack:
    """Read a pack; file names in it are relative to its folder.

    Parameters
    ----------
    path : Path
        TOML file. Its `layers` are tables, or the name of a table (.csv) with a row for each; its
        `setup` is a table, or the name of a TOML file.

    Raises
    ------
    FileFormatError
        If a file cannot be read.
    InputError
        If an entry is invalid; the message names it.
    """
    path = Path(path).absolute()
    entries = read_toml(path)
    if isinstance(entries.get("layers"), str):
        rows = rows_of(path.parent / entries["layers"], PackLayer)
        entries["layers"] = [row.model_dump() for row in rows]
    if isinstance(entries.get("setup"), str):
        entries["setup"] = read_toml(path.parent / entries["setup"])
    return _map_files(validated(Pack, entries, str(path)), path.parent.joinpath)


def write_layers(
    doses: FilmDoses,
    folder: Path,
    *,
    form: Literal["tiff", "pradformat"] = "tiff",
    overwrite: bool = False,
) -> list[Path]:
    """Write the fluence of each layer as an image, its mask, its setup, and a table of them.

    The table, ``layers.csv``, is for `shadowinv fit` and `shadowinv batch`. Without a setup it
    contains the energy of each layer and the displacement of its protons by a magnetic field,
    relative to the first.

    Parameters
    ----------
    doses : FilmDoses
        Result of `run_film`.
    folder : Path
        Created if it does not exist.
    form : {"tiff", "pradformat"}
        Format of the images. Files in pradformat contain their setups.

    Returns
    -------
    list of Path
        The files, the table last.

    Raises
    ------
    FileFormatError
        If a file exists, unless `overwrite`, or cannot be written.
    InputError
        If the doses have no setup, which pradformat needs.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise FileFormatError(
            f"{folder} cannot be created as a folder ({error.strerror}): choose another name"
        ) from None
    setups = doses.setups
    if form == "pradformat" and not setups:
        raise InputError("pradformat needs a setup: give the pack's distances, or write TIFF")
    written, rows = [], []
    for k, used in enumerate(doses.usable):
        name = f"layer_{k + 1:02d}"
        row = {"mask": f"{name}_mask{TIFF.suffix}"}
        fluence = np.where(used, doses.fluence[k], 0.0)
        written.append(write(folder / row["mask"], used.astype(np.float32), overwrite=overwrite))
        if form == "pradformat":
            row["file"] = f"{name}{PRADFORMAT.suffix}"
            description = f"Film {k + 1} of a pack, fluence in protons per m² and MeV"
            with replacing(folder / row["file"], overwrite) as temporary:
                write_radiograph(temporary, fluence, setups[k], description)
            written.append(folder / row["file"])
        else:
            row["file"] = f"{name}{TIFF.suffix}"
            written.append(write(folder / row["file"], fluence, overwrite=overwrite))
        if setups and form == "tiff":
            row["setup"] = f"{name}.toml"
            written.append(_write_setup(folder / row["setup"], setups[k].model_dump(), overwrite))
        elif not setups:
            row["energy"] = f"{doses.energies[k]:.6g}"
            row["strength"] = f"{doses.strengths[k]:.6g}"
        if not used.any():
            row["exclude"] = "yes"
        rows.append(row)
    table = folder / LAYERS_TABLE
    columns = [name for name in _COLUMNS if any(name in row for row in rows)]
    with replacing(table, overwrite) as temporary, Path(temporary).open("w", newline="") as text:
        lines = csv.DictWriter(text, columns, restval="")
        lines.writeheader()
        lines.writerows(rows)
    return [*written, table]


def _write_setup(path: Path, content: dict[str, Any], overwrite: bool) -> Path:
    import tomli_w

    with replacing(path, overwrite) as temporary:
        Path(temporary).write_text(tomli_w.dumps(content), encoding="utf-8")
    return path


def _map_files(pack: Pack, move: Callable[[Path], Path]) -> Pack:
    def with_moved(model: Any, *names: str) -> Any:
        files = {name: getattr(model, name) for name in names}
        return model.model_copy(
            update={name: move(file) for name, file in files.items() if file is not None}
        )

    changes = {
        "films": {
            name: with_moved(film, "calibration", "unexposed") for name, film in pack.films.items()
        },
        "materials": {
            name: with_moved(material, "table") for name, material in pack.materials.items()
        },
        "layers": tuple(with_moved(layer, "file", "mask") for layer in pack.layers),
    }
    return Pack.model_validate(
        {**dict(with_moved(pack, "scan", "corners", "fiducials")), **changes}
    )
