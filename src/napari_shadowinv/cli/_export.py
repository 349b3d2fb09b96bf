"""`shadowinv export` and `shadowinv movie`: shots of a store to files and to a film."""

from __future__ import annotations

import csv
import importlib.util
import json
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from napari_shadowinv.cli._outputs import make_folder, protect_store
from napari_shadowinv.cli._terminal import visible
from napari_shadowinv.errors import FileFormatError, InputError
from napari_shadowinv.inversion.labels import display_unit, setup_from_dataset
from napari_shadowinv.io import check_output, replacing, write
from napari_shadowinv.io.formats import PRADFORMAT, TIFF
from napari_shadowinv.io.pradformat import check_pradformat_setup
from napari_shadowinv.io.store import DAMAGED, DONE, STATUS_NAMES, StackStore, read_stack
from napari_shadowinv.preprocessing import Provenance

if TYPE_CHECKING:
    import xarray

_FORMULA_SIGNS = ("=", "+", "-", "@")
FORMATS = ("tiff", "pradformat", "csv")
# Columns of the table: what a shot's report says, and how it says it.
_REPORTED = {
    "converged": "converged",
    "flux_residual": "residual",
    "image_residual": "image_residual",
    "noise_error (px)": "noise_error",
    "discretisation_error (px)": "discretisation_error",
    "iterations": "iterations",
    "reason": "reason",
}
_ROW_REPORTED = {"energy (MeV)": "energy", **_REPORTED}
_FIT_REPORTED = {
    name: name
    for name in ("verdict", "chi2", "folded", "uncertainty", "converged", "iterations", "reason")
}


def _opened(path: Path, shots: str | None) -> xarray.Dataset:
    """Open a store and choose shots from it; only those that are done."""
    dataset = read_stack(path)
    count = dataset.sizes["shot"]
    chosen = dataset.assign_coords(index=("shot", np.arange(count)))
    if shots is not None:
        chosen = chosen.isel(shot=_parsed_shots(shots, count))
    for index in np.flatnonzero(chosen["status"].values == DAMAGED)[:1]:
        number = int(chosen["index"].values[index])
        store = StackStore(path)
        raise FileFormatError(
            f"{path} is damaged: shot {number} ({store.names[number]}): "
            f"{store.report(number)['reason']}; "
            "repeat the run with --resume to invert it again, or choose other shots with --shots"
        )
    done = chosen.isel(shot=np.flatnonzero(chosen["status"].values == DONE))
    if not done.sizes["shot"]:
        raise InputError(f"{path} has no finished shots in this selection: see shadowinv status")
    return done


def _parsed_shots(text: str, count: int) -> list[int]:
    """Turn 3, 3:20, :10, ::5 or several of these with commas into numbers of shots."""
    chosen: list[int] = []
    for part in text.split(","):
        try:
            numbers = [int(piece) if piece.strip() else None for piece in part.split(":")]
            if len(numbers) == 1 and numbers[0] is not None:
                chosen.append(range(count)[numbers[0]])
            elif 2 <= len(numbers) <= 3:
                chosen.extend(range(count)[slice(*numbers)])
            else:
                raise ValueError(part)
        except (ValueError, IndexError):
            raise InputError(
                f"shots are {text!r}: expected numbers from 0 to {count - 1} such as 3, 3:20, or "
                "3,5,10:20"
            ) from None
    return chosen


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
    dataset = _opened(store, shots)
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


# The name of a file, what reads its content, and the setup, which gives the size of a pixel.
_Job = tuple[str, Callable[[], Any], Any]


def _tiff_jobs(dataset: xarray.Dataset, variables: list[str]) -> Iterator[_Job]:
    for variable in variables:
        dims = dataset[variable].dims if variable in dataset else ()
        if dims[:1] != ("shot",) or dims[-2:] != ("y", "x"):
            images = [name for name in dataset.data_vars if dataset[name].dims[-2:] == ("y", "x")]
            raise InputError(
                f"the store has no images {variable!r}: expected one or more of "
                f"{', '.join(map(str, images))}"
            )
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
        shot = _with_origin(dataset.isel(shot=index))
        yield f"{_stem(shot)}{PRADFORMAT.suffix}", shot.compute, setup_from_dataset(shot)


def _with_origin(shot: xarray.Dataset) -> xarray.Dataset:
    """A shot of a store with its own provenance, or the store's but for its own image."""
    report = json.loads(str(shot["report"].values))
    if "provenance" in report:
        return shot.assign_attrs(provenance=json.dumps(report["provenance"]))
    provenance = Provenance.of(shot.attrs)
    if provenance is None:
        return shot
    origin = {"file": str(shot["name"].values), "sha256": report.get("sha256", "")}
    image = provenance.image.model_copy(update=origin)
    own = provenance.model_copy(update={"image": image})
    return shot.assign_attrs(provenance=own.model_dump_json(exclude_none=True))


def _write_table(store: Path, out: Path, shots: str | None, overwrite: bool) -> Path:
    """One row for each shot, done or not, with the largest magnitude of each field."""
    from napari_shadowinv.stack import stack_statistics

    content = StackStore(store)
    peaks = stack_statistics(read_stack(store))
    names = [str(name) for name in peaks.data_vars if str(name).endswith("_peak")]
    columns = {name: np.asarray(peaks[name].values) for name in names}
    headings = [f"{name} ({display_unit(peaks[name].attrs['units'])})" for name in names]
    count = len(content.names)
    chosen = range(count) if shots is None else _parsed_shots(shots, count)
    statuses, reports = content.statuses(), content.reports()
    with (
        replacing(out, overwrite) as temporary,
        temporary.open("w", newline="", encoding="utf-8", errors="backslashreplace") as f,
    ):
        rows = csv.writer(f)
        own = _ROW_REPORTED if content.own_setups else _REPORTED
        reported = own if content.field is None else _FIT_REPORTED
        rows.writerow(["shot", "name", "status", *reported, *headings])
        for index in chosen:
            report = (reports[index].get(name, "") for name in reported.values())
            peak = (f"{columns[name][index]:.9g}" for name in names)
            status = STATUS_NAMES[statuses[index]]
            rows.writerow([index, _cell(content.names[index]), status, *report, *peak])
    return out


def _cell(text: str) -> str:
    """Text that neither a terminal nor a spreadsheet takes for a command."""
    cell = visible(text)
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
    """Write a film of a store, all shots on one colour scale; return its number of frames."""
    from napari_shadowinv.plotting import stack_frames, write_film

    check_output(out, overwrite, suffixes=(".mp4", ".gif"))
    protect_store(store, out)
    if out.suffix.lower() == ".mp4" and importlib.util.find_spec("imageio_ffmpeg") is None:
        raise FileFormatError(
            f"{out} needs the package imageio-ffmpeg: install it with pip install "
            "'napari-shadowinv[movie]', or write a .gif"
        )
    if not 0 < rate <= 120:
        raise InputError(f"rate is {rate:g}: expected more than 0 and at most 120 frames a second")
    frames = stack_frames(_opened(store, shots), variable, limits=limits)
    return write_film(out, frames, rate, overwrite=overwrite)
