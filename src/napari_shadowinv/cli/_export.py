"""Shots of a store as files, for `shadowinv export`."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from napari_shadowinv._system.safety import resolved_path
from napari_shadowinv._system.tables import write_cells
from napari_shadowinv._typing import FloatArray
from napari_shadowinv.cli._terminal import escape_invisible
from napari_shadowinv.errors import InputError
from napari_shadowinv.inversion.variables import setup_from_dataset
from napari_shadowinv.io import check_output, replacing, write
from napari_shadowinv.io.files import make_folder
from napari_shadowinv.io.formats import PRADFORMAT, TIFF
from napari_shadowinv.io.pradformat import check_pradformat_setup
from napari_shadowinv.io.store import STATUS_NAMES, StackStore, read_stack
from napari_shadowinv.io.store_shots import open_shots, parse_shots
from napari_shadowinv.physics.setup import SETUPS
from napari_shadowinv.physics.units import display_unit
from napari_shadowinv.pipeline.rerun import provenance_of

if TYPE_CHECKING:
    import xarray

_FORMULA_SIGNS = ("=", "+", "-", "@")
FORMATS = ("tiff", "pradformat", "csv")


def export_shots(
    store: Path, out: Path, form: str, shots: str | None, variables: list[str], overwrite: bool
) -> list[Path]:
    """Write shots of a store in another format; return the files."""
    if form not in FORMATS:
        raise InputError(f"format is {form!r}: expected one of {', '.join(FORMATS)}")
    protect_store(store, out)
    if form == "csv":
        return [_write_table(store, out, shots, overwrite)]
    dataset = open_shots(store, shots)
    if form == "tiff":
        _check_images(dataset, variables)
    contents: dict[Path, tuple[Any, Any]] = {}  # of the files, with their setups
    for position in range(dataset.sizes["shot"]):
        shot = dataset.isel(shot=position)
        setup = setup_from_dataset(shot)
        if form == "tiff":
            for name, plane in _planes(shot, variables):
                contents[out / f"{_stem(shot)}_{name}{TIFF.suffix}"] = plane.astype(float), setup
            continue
        check_pradformat_setup(setup)
        # A shot may have its own provenance.
        if (provenance := provenance_of(shot)) is not None:
            shot = shot.assign_attrs(provenance=provenance.to_json())
        contents[out / f"{_stem(shot)}{PRADFORMAT.suffix}"] = shot, setup
    make_folder(out)
    for path in contents:
        check_output(path, overwrite)
    for path, (content, setup) in contents.items():
        computed = content.compute()
        plain = computed.values if form == "tiff" else computed
        write(path, plain, setup=setup, overwrite=overwrite)
    return [*contents]


def _stem(shot: xarray.Dataset) -> str:
    name = Path(str(shot["name"].values)).name
    stem = name if "[" in name or name.isdecimal() else Path(name).stem
    safe = "".join(c if c.isalnum() or c in "-_." else "_" for c in stem)
    return f"{int(shot['index']):04d}_{safe}"


def _check_images(dataset: xarray.Dataset, variables: list[str]) -> None:
    for variable in variables:
        dims = dataset[variable].dims if variable in dataset else ()
        if dims[:1] != ("shot",) or dims[-2:] != ("y", "x"):
            images = [name for name in dataset.data_vars if dataset[name].dims[-2:] == ("y", "x")]
            raise InputError(
                f"the store has no images {variable!r}: expected one or more of "
                f"{', '.join(map(str, images))}"
            )


def _planes(shot: xarray.Dataset, variables: list[str]) -> Iterator[tuple[str, xarray.DataArray]]:
    """Yield the planes of variables, of each component, with their names."""
    for variable in variables:
        if "component" in shot[variable].dims:
            for component in ("y", "x"):
                yield f"{variable}_{component}", shot[variable].sel(component=component)
        else:
            yield variable, shot[variable]


def _write_table(store: Path, out: Path, shots: str | None, overwrite: bool) -> Path:
    """Write one row per shot, done or not, with the peak magnitude of each field."""
    content, dataset = StackStore(store), read_stack(store)
    in_si = [field.name for kind in SETUPS.values() for field in kind.si_fields]
    peaks = {
        f"{name}_peak ({display_unit(dataset[name].attrs['units'])})": _peaks(dataset, name)
        for name in dict.fromkeys(["potential", "displacement", *in_si])
        if name in dataset
    }
    headings = {column.key: column.heading for column in content.columns} | {"reason": "reason"}
    statuses, reports, count = content.statuses(), content.reports(), len(content.names)
    rows = [
        {"shot": index, "name": content.names[index], "status": STATUS_NAMES[statuses[index]]}
        | {heading: reports[index].get(key, "") for key, heading in headings.items()}
        | {heading: f"{values[index]:.9g}" for heading, values in peaks.items()}
        for index in (range(count) if shots is None else parse_shots(shots, count))
    ]
    cells = [{heading: _escape_cell(value) for heading, value in row.items()} for row in rows]
    with replacing(out, overwrite) as temporary:
        write_cells(temporary, ["shot", "name", "status", *headings.values(), *peaks], cells)
    return out


def _peaks(dataset: xarray.Dataset, name: str) -> FloatArray:
    """Return the largest magnitude of a field in each shot; NaN until a shot is done."""
    squared = dataset[name].astype(np.float64) ** 2
    if "component" in squared.dims:
        squared = squared.sum("component", skipna=False)
    if "mask" in dataset:
        squared = squared.where(dataset["mask"] | squared.isnull(), 0.0)
    return np.asarray(squared.max(("y", "x"), skipna=False) ** 0.5)


def protect_store(store: Path, output: Path) -> None:
    """Refuse to write into a store that is read."""
    if resolved_path(output).is_relative_to(resolved_path(store)):
        raise InputError(
            f"{output} is inside the store being read: choose another name for the output"
        )


def _escape_cell(value: Any) -> Any:
    """Escape text that a terminal or a spreadsheet would interpret as a command."""
    if not isinstance(value, str):
        return value
    cell = escape_invisible(value)
    return f"'{cell}" if cell.startswith(_FORMULA_SIGNS) else cell
