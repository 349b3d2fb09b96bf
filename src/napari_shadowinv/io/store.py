"""Results of many shots in one Zarr store, written shot by shot.

- write one shot, or why it failed: `ShotWriter`
- what has been written: `read_stack` (lazy, for everyone), `StackStore` (for a run)

Each variable has one chunk for each shot, each chunk is a file that appears whole or not at
all, and the last one of a shot is its `status`: what is not marked there is pending and will be
written again. So workers can write side by side, and any of them may die.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from napari_shadowinv._system.safety import refusing_damage, small_text
from napari_shadowinv._typing import AnyArray, FloatArray
from napari_shadowinv.errors import FileFormatError
from napari_shadowinv.inversion.labels import setup_from_dataset, variable_labels
from napari_shadowinv.io.files import check_folder_of
from napari_shadowinv.io.formats import STORE

if TYPE_CHECKING:
    import xarray

FORMAT = "shadowinv stack"
STORE_SUFFIX = STORE.suffix
# One number for each shot, gathered when a run ends.
SUMMARY: dict[str, tuple[type, dict[str, str]]] = {
    "converged": (bool, {"units": "1", "long_name": "Flux residual is below the tolerance"}),
    "flux_residual": (float, {"units": "1", "long_name": "Largest relative flux error of a cell"}),
    "image_residual": (
        float,
        {"units": "1", "long_name": "Image minus re-projection, r.m.s. relative to the mean"},
    ),
    "iterations": (int, {"units": "1", "long_name": "Solver iterations, summed over all levels"}),
    "seconds": (float, {"units": "s", "long_name": "Time its worker spent on the shot"}),
}
PENDING, DONE, FAILED = 0, 1, 2
STATUS_NAMES = ("pending", "done", "failed")
_OWN_ORDER = ("status", *SUMMARY, "report")


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
    """Tell whether a folder is a store of many shots."""
    return _attributes(Path(path)).get("format") == FORMAT


def _attributes(path: Path) -> dict[str, Any]:
    try:
        found = json.loads(small_text(path / "zarr.json", "metadata of a store"))
        return dict(found["attributes"])
    except Exception:
        # A folder of another kind, or a damaged one, is no store; who opens it tells more.
        return {}


def store_error(path: Path, error: OSError) -> StoreError:
    """Say that a store cannot be written, why, and what to do."""
    return StoreError(
        f"{path} cannot be written ({error.strerror or error}): free some disk space or check "
        "the folder's permissions, then run again to resume"
    )


@dataclass(frozen=True)
class ShotWriter:
    """Writes shots into a store that is there; it can be sent to a worker."""

    path: Path
    store_id: str  # another store may have taken its place
    shots: int  # it may have had fewer when this process opened it before

    def write(self, index: int, arrays: Mapping[str, Any], report: Mapping[str, Any]) -> None:
        """Write a shot and how it went; it is done when this returns, pending if this fails."""
        self._commit(index, arrays, report, DONE)

    def fail(self, index: int, report: Mapping[str, Any]) -> None:
        """Write why a shot failed."""
        self._commit(index, {}, report, FAILED)

    def _commit(
        self, index: int, arrays: Mapping[str, Any], report: Mapping[str, Any], status: int
    ) -> None:
        if _attributes(self.path).get("store_id") != self.store_id:
            raise StoreError(
                f"{self.path} is missing or is not the store the run started with: all workers "
                "must share one file system, and the store must not be replaced during the run"
            )
        group = self.arrays()
        try:
            for name, values in arrays.items():
                group[name][index : index + 1] = np.asarray(values)[np.newaxis]
            group["report"][index : index + 1] = np.array([json.dumps(report)], dtype=object)
            group["status"][index : index + 1] = np.int8(status)
        except OSError as error:
            raise store_error(self.path, error) from error

    def arrays(self) -> dict[str, Any]:
        return _opened(self.path, self.store_id, self.shots)


@lru_cache(maxsize=4)
def _opened(path: Path, store_id: str, shots: int) -> dict[str, Any]:
    import zarr

    arrays: dict[str, Any] = dict(zarr.open_group(path, mode="r+").arrays())
    found = arrays["status"].shape[0]
    if found != shots:
        raise StoreError(
            f"{path} has {found} shots here and {shots} where the run was started: wait until "
            "the file system is in sync on all machines, then run again to resume"
        )
    return arrays


class StackStore:
    """A store as a run sees it: what is done, failed, pending."""

    def __init__(self, path: Path) -> None:
        self.path = path
        if not path.exists():
            raise FileFormatError(
                f"{path} does not exist: expected a stack of shots, name{STORE_SUFFIX}; check the "
                "path"
            )
        self.attributes = _attributes(path)
        if self.attributes.get("format") != FORMAT:
            raise FileFormatError(f"{path} is not a stack of shots: expected name{STORE_SUFFIX}")
        self._arrays = _readable(path)
        self.names = tuple(map(str, self._values("name").tolist()))
        self.statuses()

    @property
    def writer(self) -> ShotWriter:
        return ShotWriter(self.path, self.attributes["store_id"], len(self.names))

    def statuses(self) -> AnyArray:
        """Return PENDING, DONE or FAILED for each shot."""
        return self._values("status")

    def report(self, index: int) -> dict[str, Any]:
        """Return how a shot went; ``reason`` tells why it failed."""
        return _parsed(self.path, [str(self._values("report", index))])[0]

    def reports(self) -> Sequence[dict[str, Any]]:
        return _parsed(self.path, self._values("report").tolist())

    def _values(self, name: str, which: Any = ...) -> AnyArray:
        return _values(self.path, self._arrays[name], which)

    def summarise(self) -> None:
        """Gather numbers of each shot from their reports, for those who open the store."""
        reports = self.reports()
        group = self.writer.arrays()
        try:
            for name, (kind, _) in SUMMARY.items():
                if name not in group:  # a store of an older version
                    continue
                missing = np.nan if kind is float else 0
                key = "residual" if name == "flux_residual" else name
                values = [report.get(key, missing) for report in reports]
                group[name][...] = np.array(values, dtype=kind)
        except OSError as error:
            raise store_error(self.path, error) from error


@refusing_damage
def _readable(path: Path) -> dict[str, Any]:
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


@refusing_damage
def _values(path: Path, array: Any, which: Any) -> AnyArray:
    return np.asarray(array[which])


@refusing_damage
def _parsed(path: Path, texts: Sequence[str]) -> list[dict[str, Any]]:
    return [dict(json.loads(text)) if text else {} for text in texts]


def is_along_shots(array: Any) -> bool:
    """Tell whether an array of a store has a value for each shot."""
    return tuple(array.metadata.dimension_names or ())[:1] == ("shot",)


@refusing_damage
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
        2 failed; the values of shots that are not done are NaN.

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
    setup = setup_from_dataset(dataset)
    complete = _with_fields(dataset, setup)
    # The folder's own order is arbitrary.
    order = [*variable_labels(setup), *_OWN_ORDER]
    shown = complete[[name for name in order if name in complete]]
    return shown.assign(status=shown["status"].copy(data=store.statuses()))


def _with_fields(dataset: xarray.Dataset, setup: Any) -> xarray.Dataset:
    """Add the fields in SI units that follow from what is stored, lazily."""
    if setup is None:
        return dataset
    found = {}
    for name, (dims, labels) in variable_labels(setup).items():
        origin = "displacement" if "component" in dims else "potential"
        if name in dataset or name in variable_labels() or origin not in dataset:
            continue
        blocks = dataset[origin].data.map_blocks(_field_of_block, name, setup, dtype=np.float64)
        found[name] = (("shot", *dims), blocks, labels)
    return dataset.assign(found)


def _field_of_block(block: AnyArray, name: str, setup: Any) -> FloatArray:
    return np.stack([setup.field_in_si(name, values) for values in block])
