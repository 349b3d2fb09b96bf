"""Results of many shots in one Zarr store, written shot by shot.

- open the results: `read_stack` (lazy, for everyone), `StackStore` (for a run)
- the setup of each shot, where shots have different ones: `with_own_setups`

Each variable has one chunk for each shot, each chunk is a file that appears whole or not at
all, and the last one of a shot is its `status`: a shot that is not marked there is pending and will
be written again. So workers can write at the same time, and any of them may die.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import zarr

from napari_shadowinv._system.safety import as_file_errors, small_text
from napari_shadowinv._typing import AnyArray, FloatArray
from napari_shadowinv.errors import FileFormatError
from napari_shadowinv.inversion.variables import (
    SETUPS_LABEL,
    setup_from_dataset,
    variable_labels,
)
from napari_shadowinv.io.files import check_folder_of
from napari_shadowinv.io.formats import STORE
from napari_shadowinv.io.store_columns import ShotColumn, columns_of
from napari_shadowinv.io.store_damage import (
    Damage,
    Status,
    as_dask,
    find_damage,
    is_along_shots,
    read_values,
)

if TYPE_CHECKING:
    import xarray

FORMAT = "shadowinv stack"
STORE_SUFFIX = STORE.suffix
PENDING, DONE, FAILED, DAMAGED = Status
STATUS_NAMES = tuple(status.name.lower() for status in Status)
# Attribute of a store whose shots are rows of a table, each with its own setup in its report.
OWN_SETUPS = "table_of_shots"
_NO_TEXT = np.array([], object)


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
    return read_attributes(Path(path)).get("format") == FORMAT


def columns_of_store(attributes: Mapping[Any, Any]) -> tuple[ShotColumn, ...]:
    """Return the columns of a store, by its attributes."""
    if OWN_SETUPS not in attributes:
        return columns_of(None)
    return columns_of(json.loads(attributes.get("setup", "{}")).get("kind", "proton"))


def read_attributes(path: Path) -> dict[str, Any]:
    """Return the attributes of a store, empty for a folder of another kind."""
    try:
        return dict(json.loads(small_text(path / "zarr.json", "metadata of a store"))["attributes"])
    except Exception:
        # The error on opening it says more about the damage.
        return {}


class StackStore:
    """Store of a run: the status and the report of each shot, and damage to files.

    With `every_byte`, all files are read to find damage; otherwise damage within a field is noticed
    when the field is read. `columns` are the quantities that it lists of each shot.
    """

    def __init__(self, path: Path, *, every_byte: bool = False) -> None:
        self.path = path
        self._every_byte = every_byte
        if not path.exists():
            raise FileFormatError(
                f"{path} does not exist: expected a stack of shots, name{STORE_SUFFIX}; check the "
                "path"
            )
        self.attributes = read_attributes(path)
        if self.attributes.get("format") != FORMAT:
            raise FileFormatError(f"{path} is not a stack of shots: expected name{STORE_SUFFIX}")
        self.columns = _columns(path, self.attributes)
        self._arrays = _open_readable(path)
        names = read_values(path / "name", self._arrays["name"])
        self.names = tuple(map(str, names.tolist()))

    def statuses(self) -> AnyArray:
        """Return PENDING, DONE, FAILED or DAMAGED for each shot."""
        return np.array(self.damage.statuses, np.int8)

    def report(self, index: int) -> dict[str, Any]:
        """Return a shot's report; ``reason`` says why it failed, or how it is damaged."""
        if index in self.damage.shots:
            return {"reason": self.damage.shots[index]}
        return _parse_report(self.path, self.damage.reports[index])

    def reports(self) -> list[dict[str, Any]]:
        """Return the report of each shot, as `report` does."""
        return [self.report(index) for index in range(len(self.names))]

    @cached_property
    def damage(self) -> Damage:
        """Return the lost and damaged files, with the record of all shots."""
        is_copy = "store_id" not in self.attributes  # by another program, of what was read here
        return find_damage(self.path, self._arrays, every_byte=self._every_byte, is_copy=is_copy)


def check_files(store: StackStore) -> None:
    """Refuse a store with damage to files that belong to no single shot."""
    if store.damage.files:
        raise FileFormatError(
            f"{store.path} is damaged: {store.damage.files[0]}; copy it again, or repeat the run "
            "with overwriting"
        )


@as_file_errors
def _columns(_: Path, attributes: Mapping[Any, Any]) -> tuple[ShotColumn, ...]:
    return columns_of_store(attributes)


@as_file_errors
def _open_readable(path: Path) -> dict[str, Any]:
    arrays: dict[str, Any] = dict(zarr.open_group(path, mode="r").arrays())
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
def _parse_report(path: Path, text: str) -> dict[str, Any]:
    return dict(json.loads(text)) if text else {}


def open_dataset(path: Path) -> xarray.Dataset:
    """Open the arrays of a Zarr folder lazily; an error on reading names the damaged chunk."""
    import xarray as xr

    # No variable is a time, whatever its unit. While a store grows, only the folder's consolidated
    # metadata give all arrays the same length.
    dataset = xr.open_dataset(
        path,
        engine="zarr",
        chunks=None,
        cache=False,
        decode_times=False,
        mask_and_scale=False,
        consolidated=_describes_arrays(path),
    )
    stored = {k: v for k, v in dataset.variables.items() if k not in dataset.indexes}
    return dataset.assign({name: as_dask(path / str(name), v) for name, v in stored.items()})


def _describes_arrays(path: Path) -> bool:
    """Return whether a folder has its own copy of the descriptions of its arrays."""
    return zarr.open_group(path, mode="r").metadata.consolidated_metadata is not None


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
        2 failed, 3 damaged; the values of shots that are not done are NaN, as are lost ones. The
        numbers of each shot, such as ``image_residual``, come from its ``report``. Where shots have
        different setups, ``setup`` has one for each shot, empty until the shot is done.

    Raises
    ------
    FileFormatError
        If it is no store, or is damaged.
    """
    store = StackStore(path)
    dataset = open_dataset(path)
    if dataset.sizes["shot"] > len(store.names):  # grown since
        dataset = dataset.isel(shot=slice(len(store.names)))
    check_files(store)
    dataset.attrs.pop("store_id", None)  # of this folder, not of datasets derived from it
    setup = setup_from_dataset(dataset)
    complete = _with_fields(with_own_setups(dataset), setup)
    reports = store.reports()
    columns = {
        column.key: (("shot",), column.values(reports), column.labels) for column in store.columns
    }
    status = complete["status"].copy(data=store.statuses())
    return complete.assign({**columns, "status": status})


def _with_fields(dataset: xarray.Dataset, setup: Any) -> xarray.Dataset:
    """Add the fields in SI units, computed lazily from the stored ones."""
    if setup is None:
        return dataset
    fields = {}
    in_si = {field.name for field in setup.si_fields}
    for name, (dims, labels) in variable_labels(setup).items():
        origin = "displacement" if "component" in dims else "potential"
        if name in dataset or name not in in_si or origin not in dataset:
            continue
        fields[name] = (("shot", *dims), field_in_si(dataset, origin, name, setup), labels)
    return dataset.assign(fields)


def with_own_setups(dataset: xarray.Dataset) -> xarray.Dataset:
    """Add the setup of each shot, read lazily, if shots have different ones."""
    if OWN_SETUPS not in dataset.attrs or "setup" not in dataset.attrs:
        return dataset
    texts = dataset["report"].data.map_blocks(_setups_of_block, dtype=object, meta=_NO_TEXT)
    return dataset.assign(setup=(("shot",), texts, SETUPS_LABEL))


def _setups_of_block(reports: AnyArray) -> AnyArray:
    provenances = (json.loads(str(text) or "{}").get("provenance", {}) for text in reports)
    setups = (provenance.get("setup") for provenance in provenances)
    return np.array(["" if setup is None else json.dumps(setup) for setup in setups], object)


def field_in_si(dataset: xarray.Dataset, origin: str, name: str, setup: Any) -> Any:
    """Return a field of all shots in SI units, lazily, by one setup for each or for all."""
    data, texts = dataset[origin].data, None
    if "setup" in dataset:
        texts = dataset["setup"].data[(..., *[np.newaxis] * (data.ndim - 1))]
    return data.map_blocks(
        _field_of_block, texts, name, setup, dtype=np.float64, chunks=data.chunks
    )


def _field_of_block(block: AnyArray, texts: AnyArray | None, name: str, setup: Any) -> FloatArray:
    setups = [None] * len(block) if texts is None else _parse_setups(texts)
    # A shot that is not done yet is NaN with any setup.
    pairs = zip(setups, block, strict=True)
    return np.stack([(each or setup).field_in_si(name, values) for each, values in pairs])


def _parse_setups(texts: AnyArray) -> list[Any]:
    from napari_shadowinv.physics.setup import setup_from_dict

    return [setup_from_dict(json.loads(text)) if text else None for text in texts.flat]
