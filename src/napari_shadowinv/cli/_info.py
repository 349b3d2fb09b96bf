"""The output of `shadowinv info` for a file: `file_table`."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from napari_shadowinv._system.safety import as_file_errors
from napari_shadowinv.cautions import Caution
from napari_shadowinv.cli import _summary
from napari_shadowinv.facts import ResultKind
from napari_shadowinv.physics.beam import setup_cautions
from napari_shadowinv.physics.setup import beam_quantities
from napari_shadowinv.provenance import Provenance
from napari_shadowinv.results import unpack_result
from napari_shadowinv.shot import Shot

if TYPE_CHECKING:
    import xarray
    from rich.table import Table

    from napari_shadowinv._typing import AnyArray
    from napari_shadowinv.io.formats import Format


@as_file_errors
def file_table(path: Path) -> Table:
    """Build a table of a file's kind and contents."""
    return _summary.two_columns(str(path), _rows(path))


def _rows(path: Path) -> _summary.Rows:
    from napari_shadowinv.io import read
    from napari_shadowinv.io.field_grids import is_field_grid
    from napari_shadowinv.io.formats import format_of
    from napari_shadowinv.io.frames import find_frames
    from napari_shadowinv.io.hdf5_arrays import list_sizes

    if is_field_grid(path):
        kind = "fields on a grid: trace particles with shadowinv forward"
        return [("kind", kind), *list_sizes(path)]
    frames = find_frames(path)
    if len(frames) > 1:
        return _frame_rows(read(path))
    path, variable = frames[0].path, frames[0].variable
    form = format_of(path)
    if form.is_scan or form.name in ("b16", "spe"):
        return _picture_rows(path, form)
    content = read(path, variable=variable)
    return _shot_rows(content) if isinstance(content, Shot) else _result_rows(content)


def _frame_rows(frames: Shot | xarray.Dataset) -> _summary.Rows:
    """Describe many images by their names and the first."""
    assert not isinstance(frames, Shot)
    names, images = frames["name"].values, frames["image"]
    return [
        ("kind", f"{len(names)} frames, {names[0]} to {names[-1]}"),
        ("shape", f"{images.shape}, [shot, y, x]"),
        *((f"first: {name}", text) for name, text in _array_rows(images[0].values)[2:]),
    ]


def _picture_rows(path: Path, form: Format) -> _summary.Rows:
    from napari_shadowinv.io.images import film_cautions

    array, metadata = form.read(path)
    cautions = film_cautions(array, None) if array.ndim == 2 else ()
    rows = [("kind", f"{form.name.upper()} picture, {metadata['bits']} bits per sample")]
    if array.ndim == 3:
        advice = "convert a film scan to dose, or choose one with --channel"
        rows.append(("channels", f"{array.shape[-1]}: {advice}"))
    return [*rows, *_array_rows(array), *_metadata_rows(metadata, cautions)]


def _shot_rows(shot: Shot) -> _summary.Rows:
    kind, cautions = f"{shot.metadata['kind']} image", shot.cautions
    if variable := shot.metadata.get("variable"):
        kind = f"{kind}, array {variable!r}"
    rows = [("kind", kind), *_array_rows(shot.image, shot.metadata["dtype"])]
    if shot.mask is not None:
        rows.append(("mask", f"in the same file, {(~shot.mask).sum()} pixels excluded"))
    if shot.setup is not None:
        cautions = (*cautions, *setup_cautions(shot.setup, shot.shape))
    rows.append(("setup", _summary.setup_text(shot.setup, shot, shot.shape)))
    return [*rows, *_metadata_rows(shot.metadata, cautions)]


def _metadata_rows(metadata: Mapping[str, Any], cautions: Iterable[Caution]) -> _summary.Rows:
    """Return the geometry in the metadata of an image, its notes, and the cautions."""
    quantities = beam_quantities()
    numbers = metadata.get("geometry", {}).items()
    return [
        *(
            (f"{name.replace('_', ' ')} ({unit})", f"{value:g}")
            for name, value in numbers
            if isinstance(value, int | float)
            for unit in [quantities[name].unit if name in quantities else "m"]
        ),
        *(("note", text) for text in metadata.get("notes", ())),
        *(
            ("warning", each.text)
            for each in dict.fromkeys((*cautions, *metadata.get("cautions", ())))
        ),
    ]


def _array_rows(array: AnyArray, dtype: str = "") -> _summary.Rows:
    import numpy as np

    values = array.astype(np.float64)
    finite = values[np.isfinite(values)]
    shape = f"{array.shape}, [y, x]" if array.ndim == 2 else str(array.shape)
    rows: _summary.Rows = [("shape", shape), ("dtype", dtype or str(array.dtype))]
    if finite.size:
        rows.append(("min, mean, max", f"{finite.min():g}, {finite.mean():g}, {finite.max():g}"))
    rows.append(("negative", f"{np.count_nonzero(finite < 0)} values"))
    rows.append(("NaN or infinite", f"{values.size - finite.size} values"))
    return rows


def _result_rows(dataset: xarray.Dataset) -> _summary.Rows:
    """Describe a result of any kind: its facts, its origin and its options."""
    from napari_shadowinv.analysis import products_in

    content = unpack_result(dataset)
    kind = f"{content.kind.noun} of shadowinv {dataset.attrs.get('package_version')}"
    if content.kind is ResultKind.FIELD and "options" not in dataset.attrs:
        kind = "field retrieved by another program"
    facts = list(content.facts)
    shape = (dataset.sizes["y"], dataset.sizes["x"])
    has_verdict = content.headline.verdict is not None
    rows: _summary.Rows = [
        *([_summary.headline_row(content.headline)] if has_verdict else []),
        ("kind", kind),
        *([("created", str(dataset.attrs["created"]))] if "created" in dataset.attrs else []),
        ("image", _summary.size_text(shape)),
        ("setup", _summary.setup_text(content.setup, shape=shape)),
        *_summary.fact_rows(facts, details=True),
        *_summary.provenance_rows(Provenance.of(dataset.attrs, dataset.variables)),
    ]
    if options := getattr(content, "options", None):
        rows.append(("options", _summary.options_text(options.model_dump())))
    return rows + [
        (each.name, f"{fact.title.lower()} {fact.text}")
        for each in products_in(dataset)
        for fact in each.facts
        if fact.key in each.variables
    ]
