"""Shots of a store as files, for `shadowinv export`."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from napari_shadowinv._system.tables import write_cells
from napari_shadowinv.cli._terminal import escape_invisible
from napari_shadowinv.errors import InputError
from napari_shadowinv.inversion.variables import setup_from_dataset
from napari_shadowinv.io import check_output, replacing, write
from napari_shadowinv.io.files import make_folder
from napari_shadowinv.io.formats import PRADFORMAT, TIFF
from napari_shadowinv.io.pradformat import check_pradformat_setup
from napari_shadowinv.io.store import STATUS_NAMES, StackStore
from napari_shadowinv.io.store_shots import check_images, open_shots, parse_shots
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
    if form == "csv":
        return [_write_table(store, out, shots, overwrite)]
    dataset = open_shots(store, shots)
    if form == "tiff":
        check_images(dataset, variables)
    contents: dict[Path, tuple[Any, Any]] = {}  # of the files, with their setups
    for position in range(dataset.sizes["shot"]):
        shot = dataset.isel(shot=position)
        setup, stem = setup_from_dataset(shot), out / _stem(shot)
        if form == "tiff":
            for name, plane in _planes(shot, variables):
                contents[Path(f"{stem}_{name}{TIFF.suffix}")] = plane.astype(float), setup
            continue
        check_pradformat_setup(setup)
        provenance = provenance_of(shot)  # a shot may have its own
        attributes = {} if provenance is None else {"provenance": provenance.to_json()}
        contents[Path(f"{stem}{PRADFORMAT.suffix}")] = shot.assign_attrs(attributes), setup
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


def _planes(shot: xarray.Dataset, variables: list[str]) -> Iterator[tuple[str, xarray.DataArray]]:
    """Yield the planes of variables, of each component, with their names."""
    for variable in variables:
        if "component" in shot[variable].dims:
            for component in ("y", "x"):
                yield f"{variable}_{component}", shot[variable].sel(component=component)
        else:
            yield variable, shot[variable]


def _write_table(path: Path, out: Path, shots: str | None, overwrite: bool) -> Path:
    """Write one row per shot, done or not, with the peak of its main field."""
    store = StackStore(path)
    statuses, reports, count = store.statuses(), store.reports(), len(store.names)
    headings = {column.key: column.heading for column in store.columns} | {"reason": "reason"}
    rows = []
    for index in range(count) if shots is None else parse_shots(shots, count):
        report = reports[index]
        peak = report.get("peak", {})
        row = {"shot": index, "name": store.names[index], "status": STATUS_NAMES[statuses[index]]}
        row |= {"peak": peak.get("value", ""), "peak_unit": peak.get("unit", "")}
        row |= {heading: report.get(key, "") for key, heading in headings.items()}
        rows.append({heading: _escape_cell(value) for heading, value in row.items()})
    columns = ["shot", "name", "status", "peak", "peak_unit", *headings.values()]
    with replacing(out, overwrite) as temporary:
        write_cells(temporary, columns, rows)
    return out


def _escape_cell(value: Any) -> Any:
    """Escape text that a terminal or a spreadsheet would interpret as a command."""
    if not isinstance(value, str):
        return value
    cell = escape_invisible(value)
    return f"'{cell}" if cell.startswith(_FORMULA_SIGNS) else cell
