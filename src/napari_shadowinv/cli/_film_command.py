"""`shadowinv film`: doses and fluences from the scans of a film pack."""

from __future__ import annotations

import json
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from napari_shadowinv.cautions import Caution
from napari_shadowinv.cli import _flags, _outputs
from napari_shadowinv.cli._summary import Rows, two_columns
from napari_shadowinv.cli._terminal import is_interrupted, notify_errors, progress_bars, say
from napari_shadowinv.errors import InputError

if TYPE_CHECKING:
    import xarray
    from rich.table import Table

    from napari_shadowinv.film import Pack

LayersFormat = Literal["tiff", "pradformat"]
# Help of options, where it is longer than a line.
HELP = {
    "pack": "TOML file with the layers of the pack and their scans.",
    "layers": "Folder for the fluence images of the layers, with a table of them for fit and "
    "batch.",
    "corners": "Table (.csv) for the detected corners of the films, to correct and name in the "
    "pack file.",
    "new": "Folder of scans: only write a pack.toml for them, to be completed.",
    "out": "Result file. Default: the pack's name with .shadowinv, in the current folder.",
}
EPILOG = r"""
[bold]Examples[/bold]
shadowinv film --new scans
shadowinv film scans/pack.toml --layers layers
shadowinv fit layers/layers.csv --brightness free --source unknown

[bold]pack.toml[/bold] (paths are relative to this file)
seen_from = "source"                          # or detector: sets the sign of B
scan = "scan.tif"                             # all films on one scan; or a file for each layer
\[setup]                                       # distances, if known
source_object_distance = 0.01
object_image_distance = 0.1
\[films.HDV2]
calibration = "HDV2.csv"
unexposed = "unexposed.tif"
\[\[layers]]
film = "HDV2"
filters = \["13 um Al", "25 um Fe"]
file = "film_01.tif"
Known films: EBT3, HDV2, MDV3; materials: Al, Au, Cu, Fe, Kapton, Mylar, Ta, Ti and others.

[bold]Exit codes[/bold]
0 written; 2 invalid input, nothing written; 130 cancelled.
"""


@notify_errors
def film(
    pack: Annotated[Path | None, typer.Argument(help=HELP["pack"], show_default=False)] = None,
    layers: Annotated[Path | None, typer.Option(help=HELP["layers"])] = None,
    layers_format: Annotated[
        LayersFormat,
        typer.Option(metavar="tiff|pradformat", help="Format of the layers' images."),
    ] = "tiff",
    corners: Annotated[Path | None, typer.Option("--save-corners", help=HELP["corners"])] = None,
    out: Annotated[Path | None, typer.Option(help=HELP["out"])] = None,
    figure: _flags.Figure = None,
    new: Annotated[Path | None, typer.Option("--new", help=HELP["new"])] = None,
    overwrite: _flags.Overwrite = False,
    quiet: _flags.Quiet = False,
) -> None:
    """Convert the scans of a film pack to doses and fluences, layer by layer.

    Finds and straightens the films, masks handwriting and damage, aligns the layers, and
    unfolds the proton spectrum in every pixel.
    """
    from napari_shadowinv.film import write_corners
    from napari_shadowinv.io import replacing
    from napari_shadowinv.io.formats import FIGURE_SUFFIXES, PACK_WRITERS, SITES
    from napari_shadowinv.pipeline import read_pack, write_layers
    from napari_shadowinv.pipeline.film_files import LAYERS_TABLE

    if new is not None:
        _write_new(new, pack, overwrite)
        return
    if pack is None:
        raise InputError(
            "received no pack file: name one, or write one for a folder of scans with --new"
        )
    result, figure = _outputs.result_and_figure(pack, out, figure)
    outputs: dict[Path, tuple[str, ...]] = {
        result: tuple(PACK_WRITERS),
        figure: FIGURE_SUFFIXES,
    }
    if corners is not None:
        outputs[corners] = SITES.suffixes
    if layers is not None and (table := layers / LAYERS_TABLE).exists():
        outputs[table] = SITES.suffixes
    _outputs.check_outputs(outputs, overwrite)
    content = read_pack(pack)
    _outputs.protect(list(outputs), [pack, *content.files])
    dataset = _run_pack(content, quiet)
    written = [result, figure]
    write_pack(dataset, pack.name, result, figure, overwrite)
    if layers is not None:
        written.append(write_layers(dataset, layers, form=layers_format, overwrite=overwrite)[-1])
    if corners is not None:
        points = dataset["corners"].dropna("layer")
        corners_by_film = {str(int(film["layer"])): film.values for film in points}
        with replacing(corners, overwrite) as temporary:
            write_corners(temporary, corners_by_film)
        written.append(corners)
    if not quiet:
        say(layer_table(dataset))
        rows = [*pack_rows(dataset), ("written", ", ".join(map(str, written)))]
        say(two_columns("Film pack", rows))


def _write_new(folder: Path, pack: Path | None, overwrite: bool) -> None:
    """Write a pack file for a folder of scans, and list the entries to complete."""
    from napari_shadowinv.pipeline.new_pack import draft_pack, missing_entries, write_new_pack

    if pack is not None:
        raise InputError(
            f"received --new, which writes a pack file, and the pack file {pack}: use one of them"
        )
    entries = draft_pack(folder)
    rows = [("layers", str(len(entries["layers"])))]
    rows += [("to complete", text) for text in missing_entries(entries)]
    path = write_new_pack(folder, entries, overwrite=overwrite)
    say(two_columns("New pack", [*rows, ("written", str(path))]))


def _run_pack(pack: Pack, quiet: bool) -> xarray.Dataset:
    from napari_shadowinv.pipeline import run_film

    with nullcontext() if quiet else progress_bars() as show:
        return run_film(pack, on_progress=show, should_stop=is_interrupted)


def write_pack(
    dataset: xarray.Dataset, name: str, result: Path, figure: Path, overwrite: bool
) -> None:
    """Write a pack's dataset and its figure, both or none of them."""
    from napari_shadowinv.plotting import pack_figure

    figures = {figure: pack_figure(dataset, title=name)}
    _outputs.write_with_figures(dataset, figures, result, overwrite)


def layer_table(dataset: xarray.Dataset) -> Table:
    """Build a table of the energy, dose and alignment of each layer."""
    import numpy as np
    from rich import box
    from rich.table import Table

    table = Table(box=box.SIMPLE)
    names = ["layer", "film", "MeV"]
    if "time_of_flight" in dataset.coords:
        names.append("flight (ns)")
    for name in (*names, "median Gy", "usable", "shift y, x (px)", "±"):
        table.add_column(name, justify="left" if name == "film" else "right")
    for k in range(dataset.sizes["layer"]):
        layer = dataset.isel(layer=k)
        usable = layer["usable"].values
        is_usable = bool(usable.any())
        dose = f"{np.median(layer['dose'].values[usable]):.3g}" if is_usable else "left out"
        shift = ", ".join(f"{value:+.1f}" for value in layer["shift"].values)
        times = [float(layer["time_of_flight"])] if "time_of_flight" in layer.coords else []
        table.add_row(
            str(int(layer["layer"])),
            layer["film"].item(),
            f"{float(layer['energy']):.4g}",
            *(f"{1e9 * time:.4g}" for time in times),
            dose,
            f"{usable.mean():.0%}",
            shift if is_usable else "",
            f"{float(layer['shift_error']):.1f}" if is_usable else "",
        )
    return table


def pack_rows(dataset: xarray.Dataset) -> Rows:
    """Describe the layers of a pack's dataset."""
    sizes = dataset.sizes
    rows = [("images", f"{sizes['layer']} of {sizes['y']} × {sizes['x']} px, [y, x]")]
    if "scan_pixel_size" in dataset.attrs:
        rows.append(("pixel", f"{1e6 * dataset.attrs['scan_pixel_size']:.4g} µm on the film"))
    if "seen_from" in dataset.attrs:
        rows.append(("seen from", dataset.attrs["seen_from"]))
    cautions = map(Caution.from_json, json.loads(dataset.attrs["warnings"]))
    return rows + [("warning", caution.text) for caution in cautions]
