"""Shots of a store as files (`shadowinv export`) and as a movie (`shadowinv movie`)."""

from __future__ import annotations

import csv
import importlib.util
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from napari_shadowinv.cli._inputs import protect_store
from napari_shadowinv.cli._terminal import escape_invisible
from napari_shadowinv.errors import FileFormatError, InputError
from napari_shadowinv.inversion.variables import setup_from_dataset
from napari_shadowinv.io import check_output, replacing, write
from napari_shadowinv.io.files import make_folder
from napari_shadowinv.io.formats import PRADFORMAT, TIFF
from napari_shadowinv.io.openpmd import check_openpmd_setup, write_openpmd
from napari_shadowinv.io.pradformat import check_pradformat_setup
from napari_shadowinv.io.store import STATUS_NAMES, StackStore, read_stack
from napari_shadowinv.io.store_shots import open_shots, parse_shots
from napari_shadowinv.physics.units import display_unit
from napari_shadowinv.pipeline.rerun import provenance_of

if TYPE_CHECKING:
    import xarray

_FORMULA_SIGNS = ("=", "+", "-", "@")
FORMATS = ("tiff", "pradformat", "openpmd", "csv")


def export_shots(
    store: Path, out: Path, form: str, shots: str | None, variables: list[str], overwrite: bool
) -> list[Path]:
    """Write shots of a store in another format; return the files."""
    if form not in FORMATS:
        raise InputError(f"format is {form!r}: expected one of {', '.join(FORMATS)}")
    protect_store(store, out)
    if form == "csv":
        return [_write_table(store, out, shots, overwrite)]
    field = StackStore(store).field
    if form == "pradformat" and field is not None:
        raise InputError(
            f"{store} holds fits, expected inversions for pradformat: use --format tiff or csv"
        )
    dataset = open_shots(store, shots)
    if form == "openpmd":
        return _write_openpmd(dataset, out, overwrite)
    jobs = list(_tiff_jobs(dataset, variables) if form == "tiff" else _pradformat_jobs(dataset))
    make_folder(out)
    for name, *_ in jobs:
        check_output(out / name, overwrite)
    return [
        write(out / name, load(), setup=setup, overwrite=overwrite) for name, load, setup in jobs
    ]


def _stem(shot: xarray.Dataset) -> str:
    name = Path(str(shot["name"].values)).name
    stem = name if "[" in name or name.isdecimal() else Path(name).stem
    safe = "".join(c if c.isalnum() or c in "-_." else "_" for c in stem)
    return f"{int(shot['index']):04d}_{safe}"


# Name of a file, reader of its content, and setup, which gives the pixel size.
_Job = tuple[str, Callable[[], Any], Any]


def _check_images(dataset: xarray.Dataset, variables: list[str]) -> None:
    for variable in variables:
        dims = dataset[variable].dims if variable in dataset else ()
        if dims[:1] != ("shot",) or dims[-2:] != ("y", "x"):
            images = [name for name in dataset.data_vars if dataset[name].dims[-2:] == ("y", "x")]
            raise InputError(
                f"the store has no images {variable!r}: expected one or more of "
                f"{', '.join(map(str, images))}"
            )


def _write_openpmd(dataset: xarray.Dataset, out: Path, overwrite: bool) -> list[Path]:
    """Write the fields of each shot as a file of a series."""
    check_openpmd_setup(setup_from_dataset(dataset))
    make_folder(out)
    series = f"{out.name}_%06T{PRADFORMAT.suffix}"
    files = [
        out / f"{out.name}_{index:06d}{PRADFORMAT.suffix}" for index in dataset["index"].values
    ]
    for file in files:
        check_output(file, overwrite)
    for file, position in zip(files, range(dataset.sizes["shot"]), strict=True):
        shot = dataset.isel(shot=position)
        setup = check_openpmd_setup(setup_from_dataset(shot))
        with replacing(file, overwrite) as temporary:
            write_openpmd(temporary, shot, setup, series, int(shot["index"]))
    return files


def _tiff_jobs(dataset: xarray.Dataset, variables: list[str]) -> Iterator[_Job]:
    _check_images(dataset, variables)
    for index in range(dataset.sizes["shot"]):
        shot = dataset.isel(shot=index)
        setup = setup_from_dataset(shot)
        for variable in variables:
            planes = {variable: shot[variable]}
            if "component" in shot[variable].dims:
                planes = {
                    f"{variable}_{component}": shot[variable].sel(component=component)
                    for component in ("y", "x")
                }
            for name, plane in planes.items():
                load = partial(np.asarray, plane, dtype=float)
                yield f"{_stem(shot)}_{name}{TIFF.suffix}", load, setup


def _pradformat_jobs(dataset: xarray.Dataset) -> Iterator[_Job]:
    check_pradformat_setup(setup_from_dataset(dataset))
    for index in range(dataset.sizes["shot"]):
        shot = dataset.isel(shot=index)
        # A shot may have its own provenance.
        if (provenance := provenance_of(shot)) is not None:
            shot = shot.assign_attrs(provenance=provenance.to_json())
        yield f"{_stem(shot)}{PRADFORMAT.suffix}", shot.compute, setup_from_dataset(shot)


def _write_table(store: Path, out: Path, shots: str | None, overwrite: bool) -> Path:
    """Write one row per shot, done or not, with the peak magnitude of each field."""
    from napari_shadowinv.stack import stack_statistics

    content = StackStore(store)
    peaks = stack_statistics(read_stack(store))
    names = [str(name) for name in peaks.data_vars if str(name).endswith("_peak")]
    columns = {name: np.asarray(peaks[name].values) for name in names}
    headings = [f"{name} ({display_unit(peaks[name].attrs['units'])})" for name in names]
    count = len(content.names)
    indices = range(count) if shots is None else parse_shots(shots, count)
    statuses, reports = content.statuses(), content.reports()
    with (
        replacing(out, overwrite) as temporary,
        temporary.open("w", newline="", encoding="utf-8", errors="backslashreplace") as f,
    ):
        rows = csv.writer(f)
        listed = [column.heading for column in content.columns]
        rows.writerow(["shot", "name", "status", *listed, "reason", *headings])
        keys = [*(column.entry for column in content.columns), "reason"]
        for index in indices:
            report = (_escape_cell(reports[index].get(key, "")) for key in keys)
            peak = (f"{columns[name][index]:.9g}" for name in names)
            status = STATUS_NAMES[statuses[index]]
            rows.writerow([index, _escape_cell(content.names[index]), status, *report, *peak])
    return out


def _escape_cell(value: Any) -> Any:
    """Escape text that a terminal or a spreadsheet would interpret as a command."""
    if not isinstance(value, str):
        return value
    cell = escape_invisible(value)
    return f"'{cell}" if cell.startswith(_FORMULA_SIGNS) else cell


def write_movie(
    store: Path,
    out: Path,
    variable: str | None,
    shots: str | None,
    rate: float,
    limits: tuple[float, float] | None,
    overwrite: bool,
) -> int:
    """Write a movie of a store on one colour scale; return its number of frames."""
    from napari_shadowinv.plotting import stack_frames, write_film

    check_output(out, overwrite, suffixes=(".mp4", ".gif"))
    protect_store(store, out)
    if out.suffix.lower() == ".mp4" and importlib.util.find_spec("imageio_ffmpeg") is None:
        raise FileFormatError(
            f"{out} needs the package imageio-ffmpeg: install it with pip install "
            "'napari-shadowinv[movie]', or write a .gif"
        )
    if not 0 < rate <= 120:
        raise InputError(
            f"--rate is {rate:g}: expected more than 0 and at most 120 frames a second"
        )
    frames = stack_frames(open_shots(store, shots), variable, limits=limits)
    return write_film(out, frames, rate, overwrite=overwrite)
