"""`shadowinv film`: doses and fluences from the scans of a film pack."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
from typer import Option

from napari_shadowinv.cli import _flags
from napari_shadowinv.cli._outputs import Outputs, result_and_figure
from napari_shadowinv.cli._summary import fact_rows
from napari_shadowinv.cli._terminal import notify_errors, say, work_callbacks
from napari_shadowinv.facts import ResultKind

if TYPE_CHECKING:
    from rich.table import Table

    from napari_shadowinv.film_doses import FilmDoses

# Help of options, where it is longer than a line.
HELP = {
    "pack": "TOML file with the layers of the pack and their scans.",
    "layers": "Folder for the fluence images of the layers, with a table of them for fit and "
    "batch.",
    "corners": "Table (.csv) for the detected corners of the films, to correct and name in the "
    "pack file.",
    "out": "Result file. Default: the pack's name with .shadowinv, in the current folder.",
}
EPILOG = """
shadowinv film scans/pack.toml --layers layers

Exit codes: 0 written; 2 invalid input, nothing written; 130 cancelled.
"""


@notify_errors
@_flags.takes_flags
def film(
    pack: Annotated[Path, _flags.argument(help=HELP["pack"])],
    outputs: Outputs,
    layers: Annotated[Path | None, Option(help=HELP["layers"])] = None,
    corners: Annotated[Path | None, Option("--save-corners", help=HELP["corners"])] = None,
    out: Annotated[Path | None, Option(help=HELP["out"])] = None,
    figure: _flags.Figure = None,
) -> None:
    """Convert the scans of a film pack to doses and fluences, layer by layer.

    Finds and straightens the films, masks handwriting and damage, aligns the layers, and
    unfolds the proton spectrum in every pixel.
    """
    from napari_shadowinv.film import write_corners
    from napari_shadowinv.io import replacing
    from napari_shadowinv.io.formats import TABLE
    from napari_shadowinv.pipeline import read_pack, run_film, write_layers
    from napari_shadowinv.pipeline.film_files import LAYERS_TABLE

    result, figure = result_and_figure(pack, out, figure)
    outputs.check_result(ResultKind.FILM_DOSES, result, figure)
    table = None if layers is None else layers / LAYERS_TABLE
    replaced = table if table is not None and table.exists() else None
    outputs.check([(corners, TABLE.suffixes), (replaced, TABLE.suffixes)], [])
    content = read_pack(pack)
    outputs.protect([pack, *content.files])
    with work_callbacks(outputs.quiet) as callbacks:
        doses = run_film(content, **callbacks)
    outputs.write_result(doses, [str(pack)], result, figure)
    if layers is not None:
        files = write_layers(doses, layers, overwrite=outputs.overwrite)
        outputs.files.append(files[-1])
    if corners is not None:
        corners_by_film = {
            str(number): places
            for number, places in enumerate(doses.corners, 1)
            if np.isfinite(places).all()
        }
        with replacing(corners, outputs.overwrite) as temporary:
            write_corners(temporary, corners_by_film)
    if not outputs.quiet:
        say(film_table(doses))
    outputs.show("Film pack", fact_rows(doses.facts))


def film_table(doses: FilmDoses) -> Table:
    """Build a table of the energy, dose and alignment of each film."""
    from rich import box
    from rich.table import Table

    rows = doses.film_texts()
    table = Table(box=box.SIMPLE)
    table.add_column("layer", justify="right")
    for name in rows[0]:
        table.add_column(name, justify="left" if name == "film" else "right")
    for number, cells in enumerate(rows, 1):
        table.add_row(str(number), *cells.values())
    return table
