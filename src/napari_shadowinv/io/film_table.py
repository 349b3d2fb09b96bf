"""Tables that tell which pixels a scanner gave for films of known dose: `read_film_table`."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from napari_shadowinv._system.safety import refusing_damage, small_text
from napari_shadowinv.errors import FileFormatError

__all__ = ["read_film_table"]


@refusing_damage
def read_film_table(path: Path) -> NDArray[np.float64]:
    """Read dose and pixels of every film.

    Parameters
    ----------
    path : str or Path
        Comma-separated values, a film in each row. The first line names the columns: one
        holds "dose" but not "log", others begin with "red", "green" and "blue"; the rest is
        ignored. A second line may tell units; doses are in Gy.

    Returns
    -------
    ndarray of float64, shape (n, 4)
        Dose, and red, green and blue pixel.

    Raises
    ------
    FileFormatError
        If the file is missing, has no such columns, or a row holds anything but numbers;
        the message tells the line.
    """
    text = small_text(path, "a calibration table, comma-separated values", "utf-8-sig")
    lines = list(csv.reader(text.splitlines()))
    columns = _columns(path, [name.strip().lower() for name in lines[0]] if lines else [])
    rows: list[list[float]] = []
    for number, cells in enumerate(lines[1:], start=2):
        picked = [cells[column] if column < len(cells) else "" for column in columns]
        try:
            rows.append([float(cell) for cell in picked])
        except ValueError:
            has_units = number == 2
            if any(cell.strip() for cell in cells) and not has_units:
                raise FileFormatError(
                    f"{path}, line {number} has {', '.join(map(repr, picked))[:80]}: expected a "
                    "dose and three pixels as numbers; correct it"
                ) from None
    return np.array(rows, dtype=np.float64).reshape(-1, 4)


def _columns(path: Path, names: list[str]) -> list[int]:
    found = [[at for at, name in enumerate(names) if "dose" in name and "log" not in name]]
    for colour in ("red", "green", "blue"):
        found.append([at for at, name in enumerate(names) if name.startswith(colour)])
    if not all(found):
        raise FileFormatError(
            f"{path} has the columns {', '.join(map(repr, names)) or 'none'}: expected one with "
            "'dose', and columns whose names begin with 'red', 'green' and 'blue'"
        )
    return [candidates[0] for candidates in found]
