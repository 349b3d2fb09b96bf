"""Results of many shots in one Zarr store, written shot by shot.

- write one shot, or why it failed: `ShotWriter`
- read the results: `read_stack` (lazy, for everyone), `StackStore` (for a run)

Each variable has one chunk for each shot, each chunk is a file that appears whole or not at
all, and the last one of a shot is its `status`: a shot that is not marked there is pending and will
be written again. So workers can write at the same time, and any of them may die.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from napari_shadowinv._system.safety import as_file_errors, small_text
from napari_shadowinv._typing import AnyArray
from napari_shadowinv.errors import FileFormatError
from napari_shadowinv.inversion.variables import (
    fit_labels,
    setup_from_dataset,
    update_labels,
    variable_labels,
)
from napari_shadowinv.io.files import check_folder_of
from napari_shadowinv.io.formats import STORE
from napari_shadowinv.io.store_checksums import (
    FIXED,
    LABELS,
    SEAL,
    Damage,
    Layout,
    Status,
    check_seal,
    find_damage,
    note_shot,
    read_labels,
)
from napari_shadowinv.io.store_columns import FITS, INVERSIONS, ROWS, columns_of
from napari_shadowinv.io.store_setups import OWN_SETUPS, field_in_si, with_own_setups

if TYPE_CHECKING:
    import xarray

FORMAT = "shadowinv stack"
STORE_SUFFIX = STORE.suffix
PENDING, DONE, FAILED, DAMAGED = map(int, Status)
STATUS_NAMES = tuple(status.name.lower() for status in Status)


class StoreError(OSError):
    """A store that cannot be written: the run must end, no shot is to blame."""


def check_store_path(path: str | Path) -> Path:
    """Refuse a path that can be no store, before any work; return it absolute."""
    path = Path(path)
    if not path.name.endswith(STORE_SUFFIX) or path.name == STORE_SUFFIX:
        raise FileFormatError(
            f"{path} cannot be written: expected a name that ends with {STORE_SUFFIX}"
        )
    check_folder_of(path)
    if path.exists() and not is_stack(path):
        raise FileFormatError(
            f"{path} exists and is not a stack of shots: choose another name, or remove it"
        )
    return path.absolute()


def is_stack(path: str | Path) -> bool:
    """Return whether a folder is a store of many shots."""
    return _read_attributes(Path(path)).get("format") == FORMAT


def fitted_field(attributes: Mapping[Any, Any]) -> str | None:
    """Return the field that was fitted to each shot of a store; None if shots were inverted."""
    names = json.loads(attributes.get("fields", "[]"))
    return str(names[0]) if names else None


def kind_of_shots(attributes: Mapping[Any, Any]) -> str:
    """Return whether the shots of a store are inversions, rows of a table, or fits."""
    if fitted_field(attributes) is not None:
        return FITS
    return ROWS if OWN_SETUPS in attributes else INVERSIONS


def _read_document(path: Path) -> dict[str, Any]:
    """Return the description of a store, empty for a folder of another kind."""
    try:
        document = dict(json.loads(small_text(path / "zarr.json", "metadata of a store")))
        return document if isinstance(document["attributes"], dict) else {}
    except Exception:
        # The error on opening it says more about the damage.
        return {}


def _read_attributes(path: Path) -> dict[str, Any]:
    return dict(_read_document(path).get("attributes", {}))


def store_error(path: Path, error: OSError) -> StoreError:
    """Return the error of a store that cannot be written, with its reason and advice."""
    if not (path / "zarr.json").exists():
        return StoreError(
            f"{path} was removed or moved while it was being written: put it back and run again to "
            "resume, or start again with another name"
        )
    return StoreError(
        f"{path} cannot be written ({error.strerror or error}): free some disk space or check "
        "the folder's permissions, then run again to resume"
    )


@dataclass(frozen=True)
class ShotWriter:
    """Writer of shots into an existing store; it can be sent to a worker."""

    path: Path
    store_id: str  # another store may have taken its place
    shots: int  # it may have had fewer when this process opened it before

    def write(self, index: int, arrays: Mapping[str, Any], report: Mapping[str, Any]) -> None:
        """Write a shot and its report; it is done when this returns, pending if this fails."""
        self._commit(index, arrays, report, DONE)

    def fail(self, index: int, report: Mapping[str, Any]) -> None:
        """Write why a shot failed."""
        self._commit(index, {}, report, FAILED)

    def _commit(
        self, index: int, arrays: Mapping[str, Any], report: Mapping[str, Any], status: int
    ) -> None:
        attributes = _read_attributes(self.path)
        if attributes.get("store_id") != self.store_id:
            raise StoreError(
                f"{self.path} is missing or is not the store the run started with: all workers "
                "must share one file system, and the store must not be replaced during the run"
            )
        group = self.arrays()
        try:
            for name in fields_of(group):
                if name in arrays:
                    group[name][index : index + 1] = np.asarray(arrays[name])[np.newaxis]
                else:
                    erase(self.path, group[name], index)
            checksums = note_shot(self.path, group, index, self.labels(index, attributes))
            text = json.dumps({**report, **checksums})
            group["report"][index : index + 1] = np.array([text], dtype=object)
            group["status"][index : index + 1] = np.int8(status)
        except OSError as error:
            raise store_error(self.path, error) from error

    def reopen(self, index: int) -> None:
        """Mark a shot as pending that is to be done again, and forget its report and fields."""
        group = self.arrays()
        try:
            group["status"][index : index + 1] = np.int8(PENDING)
            for name in ("report", *fields_of(group)):
                erase(self.path, group[name], index)
        except OSError as error:
            raise store_error(self.path, error) from error

    def labels(self, index: int, attributes: Mapping[str, Any]) -> dict[str, Any]:
        """Return the name and other labels of a shot."""
        numbers = tuple(column.key for column in columns_of(kind_of_shots(attributes)))
        labels = _labels_of_all(self.path, self.store_id, self.shots, numbers)
        return labels[index] if labels else {}

    def arrays(self) -> dict[str, Any]:
        return _open_arrays(self.path, self.store_id, self.shots)


def fields_of(arrays: Mapping[str, Any]) -> tuple[str, ...]:
    """Return the names of the arrays that hold a chunk of values for each shot."""
    return tuple(
        name
        for name, array in arrays.items()
        if is_along_shots(array) and array.chunks[0] == 1 and name not in ("status", "report")
    )


def erase(path: Path, array: Any, index: int) -> None:
    """Remove the chunk of a shot, which is read as the fill value then."""
    key = array.metadata.encode_chunk_key((index, *[0] * (array.ndim - 1)))
    (path / array.basename / key).unlink(missing_ok=True)


def open_to_write(path: Path) -> dict[str, Any]:
    """Open the arrays of a store to write to them."""
    import zarr

    # Also chunks that are empty: one that is not there has been lost.
    return {
        name: array.with_config({"write_empty_chunks": True})
        for name, array in zarr.open_group(path, mode="r+").arrays()
    }


@lru_cache(maxsize=4)
def _labels_of_all(
    path: Path, store_id: str, shots: int, numbers: tuple[str, ...]
) -> list[dict[str, Any]]:
    return read_labels(_open_arrays(path, store_id, shots), numbers, slice(shots))


@lru_cache(maxsize=4)
def _open_arrays(path: Path, store_id: str, shots: int) -> dict[str, Any]:
    arrays = open_to_write(path)
    shot_count = arrays["status"].shape[0]
    if shot_count != shots:
        raise StoreError(
            f"{path} has {shot_count} shots here and {shots} where the run was started: wait until "
            "the file system is in sync on all machines, then run again to resume"
        )
    return arrays


class StackStore:
    """Store of a run: the status and the report of each shot, and damage to files.

    Parameters
    ----------
    path : Path
    every_byte : bool, optional
        Read all files to find damage. Otherwise damage within a field is noticed when the field is
        read.

    Attributes
    ----------
    field : str or None
        The fitted field; None where shots were inverted.
    columns : tuple of Column
        The quantities that it lists of each shot.
    """

    def __init__(self, path: Path, *, every_byte: bool = False) -> None:
        self.path = path
        self._every_byte = every_byte
        if not path.exists():
            raise FileFormatError(
                f"{path} does not exist: expected a stack of shots, name{STORE_SUFFIX}; check the "
                "path"
            )
        document = _read_document(path)
        check_seal(path / "zarr.json", document)
        self.attributes = document.get("attributes", {})
        if self.attributes.get("format") != FORMAT:
            raise FileFormatError(f"{path} is not a stack of shots: expected name{STORE_SUFFIX}")
        self.field = fitted_field(self.attributes)
        self.columns = columns_of(kind_of_shots(self.attributes))
        self._layout = Layout.of(path, document)
        self._arrays = _open_readable(path)
        self.names = tuple(map(str, self._values("name").tolist()))
        if self._layout is None:
            self.statuses()

    @property
    def writer(self) -> ShotWriter:
        return ShotWriter(self.path, self.attributes["store_id"], len(self.names))

    def statuses(self) -> AnyArray:
        """Return PENDING, DONE, FAILED or DAMAGED for each shot."""
        damaged = self.damage.shots
        if not damaged:
            return self._values("status")
        statuses = np.full(len(self.names), DAMAGED, np.int8)
        for index in set(range(len(statuses))) - damaged.keys():
            statuses[index] = self._values("status", index)
        return statuses

    def report(self, index: int) -> dict[str, Any]:
        """Return a shot's report; ``reason`` says why it failed, or how it is damaged."""
        if index in self.damage.shots:
            return {"reason": self.damage.shots[index]}
        return _parse_reports(self.path, [str(self._values("report", index))])[0]

    def reports(self) -> Sequence[dict[str, Any]]:
        """Return the report of each shot, as `report` does."""
        if self.damage.shots:
            return [self.report(index) for index in range(len(self.names))]
        return _parse_reports(self.path, self._values("report").tolist())

    @cached_property
    def damage(self) -> Damage:
        """Return the lost, exchanged or damaged files; none in a store without checksums."""
        if self._layout is None:
            return Damage()
        damage = find_damage(self._layout, every_byte=self._every_byte)
        return Damage(damage.shots, (*damage.files, *self._exchanged(damage)))

    @property
    def has_checksums(self) -> bool:
        """Whether the store has checksums, by which damage is noticed."""
        return self._layout is not None

    def _exchanged(self, damage: Damage) -> Iterator[str]:
        """Name files with values of many shots that disagree with the shots' reports."""
        assert self._layout is not None
        columns = {column.key: column for column in self.columns}
        for name in self._layout.of_many_shots:
            length = self._arrays[name].chunks[0]
            for first in range(0, len(self.names), length):
                index = self._first_ended(first, first + length, damage)
                if index is None or any(f"{name}/c/{first // length} " in f for f in damage.files):
                    continue
                report = _parse_reports(self.path, [str(self._values("report", index))])[0]
                value = self._values(name, index).item()
                expected: list[Any] = [report.get(LABELS, {}).get(name, value)]
                if column := columns.get(name):
                    expected = [column.kind(column.of(report)), column.kind(column.fill)]
                if json.dumps(value) not in map(json.dumps, expected):
                    yield (
                        f"{name}/c/{first // length} does not belong to shots {first} to "
                        f"{min(first + length, len(self.names)) - 1}"
                    )

    def _first_ended(self, first: int, end: int, damage: Damage) -> int | None:
        """Return the first shot of some whose report can be trusted, None without one."""
        for index in range(first, min(end, len(self.names))):
            if index not in damage.shots and self._values("status", index) != PENDING:
                return index
        return None

    def _values(self, name: str, which: Any = ...) -> AnyArray:
        return _values(self.path, self._arrays[name], which)

    def summarise(self) -> None:
        """Gather numbers of each shot from their reports, for those who open the store."""
        reports = self.reports()
        group = self.writer.arrays()
        try:
            for column in self.columns:
                if column.key not in group:  # a store of an older version
                    continue
                values = [column.of(report) for report in reports]
                group[column.key][...] = np.array(values, dtype=column.dtype)
        except OSError as error:
            raise store_error(self.path, error) from error


def check_files(store: StackStore) -> None:
    """Refuse a store with damage to files that belong to no single shot."""
    if store.damage.files:
        raise FileFormatError(
            f"{store.path} is damaged: {store.damage.files[0]}; repeat the run with --resume, or "
            "copy the store again"
        )


@as_file_errors
def _open_readable(path: Path) -> dict[str, Any]:
    import zarr

    from napari_shadowinv.io.store_files import CheckedStore

    arrays: dict[str, Any] = dict(zarr.open_group(CheckedStore(path), mode="r").arrays())
    names = arrays["name"]
    shots = names.shape[0]
    lengths = {array.shape[0] for array in arrays.values() if is_along_shots(array)}
    last = path / "name" / "c" / str((shots - 1) // names.chunks[0])
    if lengths != {shots} or (shots and not last.exists()):
        raise FileFormatError(
            f"{path} is damaged: it lists {max(lengths)} shots, but they are missing; copy it "
            "again, or repeat the run with overwriting"
        )
    return arrays


@as_file_errors
def _values(path: Path, array: Any, which: Any) -> AnyArray:
    return np.asarray(array[which])


@as_file_errors
def _parse_reports(path: Path, texts: Sequence[str]) -> list[dict[str, Any]]:
    return [dict(json.loads(text)) if text else {} for text in texts]


def is_along_shots(array: Any) -> bool:
    """Return whether an array of a store has a value for each shot."""
    return tuple(array.metadata.dimension_names or ())[:1] == ("shot",)


@as_file_errors
def read_stack(path: Path) -> xarray.Dataset:
    """Open a store of many shots, also while it is written; arrays are read when asked for.

    Parameters
    ----------
    path : str or Path
        ``name.shadowinv.zarr``.

    Returns
    -------
    xarray.Dataset
        Dimensions shot, y, x and component. ``status`` is 0 where a shot is pending, 1 done,
        2 failed, 3 damaged; the values of shots that are not done are NaN, and damaged shots
        cannot be read. Where shots have different setups, ``setup`` has one for each shot, empty
        until the shot is done.

    Raises
    ------
    FileFormatError
        If it is no store, or is damaged.
    """
    import xarray as xr

    from napari_shadowinv.io.store_files import CheckedStore

    store = StackStore(path)
    dataset: xr.Dataset = xr.open_zarr(
        CheckedStore(path), decode_times=False, mask_and_scale=False, chunks={}
    )
    dataset = update_labels(dataset)
    if dataset.sizes["shot"] > len(store.names):  # grown since
        dataset = dataset.isel(shot=slice(len(store.names)))
    check_files(store)
    # They hold for this folder, not for datasets derived from this one.
    dataset.attrs = {k: v for k, v in dataset.attrs.items() if k not in (SEAL, FIXED)}
    setup = setup_from_dataset(dataset)
    complete = _with_fields(with_own_setups(dataset), setup)
    # The folder's own order is arbitrary.
    columns = (column.key for column in store.columns)
    order = [*_labels(dataset, setup), "status", *columns, "setup", "report"]
    ordered = complete[[name for name in order if name in complete]]
    return ordered.assign(status=ordered["status"].copy(data=store.statuses()))


def _labels(dataset: xarray.Dataset, setup: Any) -> dict[str, Any]:
    """Return dimensions and labels of the variables that a store's dataset may have, by name."""
    field = fitted_field(dataset.attrs)
    return variable_labels(setup) if field is None else fit_labels(field, setup)


def _with_fields(dataset: xarray.Dataset, setup: Any) -> xarray.Dataset:
    """Add the fields in SI units, computed lazily from the stored ones."""
    if setup is None:
        return dataset
    fields = {}
    in_si = {field.name for field in setup.si_fields}
    for name, (dims, labels) in _labels(dataset, setup).items():
        origin = "displacement" if "component" in dims else "potential"
        if name in dataset or name not in in_si or origin not in dataset:
            continue
        fields[name] = (("shot", *dims), field_in_si(dataset, origin, name, setup), labels)
    return dataset.assign(fields)
