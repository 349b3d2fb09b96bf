"""Results of many shots in one Zarr store, written shot by shot.

- make a store for shots that are still to be inverted: `create_store`
- write one shot, or why it failed: `ShotWriter`
- what has been written: `read_stack` (lazy, for everyone), `StackStore` (for a run)
- tell such a store from other folders: `is_stack`

Each variable has one chunk for each shot, each chunk is a file that appears whole or not at
all, and the last one of a shot is its `status`: what is not marked there is pending and will be
written again. So workers can write side by side, and any of them may die.
"""

from __future__ import annotations

import json
import os
import secrets
import shutil
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from napari_shadowinv.errors import FileFormatError
from napari_shadowinv.interrupts import interrupts_put_off
from napari_shadowinv.io.dataset import field_in_si, setup_from_dataset, variable_labels
from napari_shadowinv.io.files import check_folder_of

if TYPE_CHECKING:
    import xarray

__all__ = [
    "DONE",
    "FAILED",
    "FORMAT",
    "PENDING",
    "STATUS_NAMES",
    "STORE_SUFFIX",
    "SUMMARY",
    "ShotWriter",
    "StackStore",
    "StoreError",
    "Variable",
    "check_store_path",
    "create_store",
    "is_stack",
    "read_stack",
]

FORMAT = "shadowinv stack"
STORE_SUFFIX = ".shadowinv.zarr"
# One number for each shot, gathered when a run ends.
SUMMARY: dict[str, tuple[type, dict[str, str]]] = {
    "converged": (bool, {"units": "1", "long_name": "The flux residual fell below the tolerance"}),
    "flux_residual": (float, {"units": "1", "long_name": "Largest relative flux error of a cell"}),
    "iterations": (int, {"units": "1", "long_name": "Solver steps, all levels together"}),
    "seconds": (float, {"units": "s", "long_name": "Time that its worker spent on the shot"}),
}
PENDING, DONE, FAILED = 0, 1, 2
STATUS_NAMES = ("pending", "done", "failed")
_OWN_ORDER = ("status", *SUMMARY, "report")


class StoreError(OSError):
    """A store that cannot be written: the run must end, no shot is to blame."""


@dataclass(frozen=True)
class Variable:
    """What a store shall hold under one name.

    Attributes
    ----------
    dims : tuple of str
        Dimensions; ``shot`` first where there is one value for each shot.
    dtype : numpy.dtype
        Type of the values.
    attributes : mapping
        ``units`` and ``long_name``.
    values : ndarray, optional
        Written at once; else shot by shot.
    """

    dims: tuple[str, ...]
    dtype: Any
    attributes: Mapping[str, Any]
    values: NDArray[Any] | None = None


def check_store_path(path: str | Path) -> Path:
    """Refuse a path that can be no store, before any work.

    Parameters
    ----------
    path : str or Path
        A folder that is there or is to be made, ``name.shadowinv.zarr``.

    Returns
    -------
    Path
        The same, absolute.

    Raises
    ------
    FileFormatError
        If it has another ending, cannot be written, or is something else already.
    """
    path = Path(path)
    if not path.name.endswith(STORE_SUFFIX) or path.name == STORE_SUFFIX:
        raise FileFormatError(
            f"{path} cannot be written: expected a name that ends with {STORE_SUFFIX}"
        )
    check_folder_of(path)
    if path.exists() and not is_stack(path):
        raise FileFormatError(
            f"{path} exists and holds no stack of shots: choose another name, or remove it"
        )
    return path.absolute()


def is_stack(path: str | Path) -> bool:
    """Tell whether a folder is a store that `create_store` made."""
    return _attributes(Path(path)).get("format") == FORMAT


def _attributes(path: Path) -> dict[str, Any]:
    try:
        found = json.loads((path / "zarr.json").read_text(encoding="utf-8"))
        return dict(found["attributes"])
    except (OSError, ValueError, KeyError, TypeError):
        return {}


def create_store(
    path: Path,
    sizes: Mapping[str, int],
    variables: Mapping[str, Variable],
    coordinates: Mapping[str, Variable],
    attributes: Mapping[str, str],
    *,
    overwrite: bool = False,
) -> StackStore:
    """Make a store in which every shot is pending, whole or not at all.

    Parameters
    ----------
    path : Path
        The folder to make.
    sizes : mapping of str to int
        Length of each dimension.
    variables, coordinates : mapping of str to Variable
        What it shall hold.
    attributes : mapping of str to str
        What is known about all shots.
    overwrite : bool
        Whether a store that is there may be replaced.

    Returns
    -------
    StackStore

    Raises
    ------
    FileFormatError
        If there is one and it must not be replaced.
    StoreError
        If it cannot be written.
    """
    if path.exists() and not overwrite:
        raise FileFormatError(f"{path} exists: resume it, overwrite it, or choose another name")
    arrays = {**coordinates, **variables, **_own_variables(sizes["shot"])}
    marks = {
        **attributes,
        "format": FORMAT,
        "store_id": secrets.token_hex(8),
        "coordinates": " ".join(name for name in coordinates if name not in sizes),
    }
    new = path.with_name(f".{path.name}-{secrets.token_hex(4)}")
    try:
        # Zarr writes in a thread of its own, which would go on behind our back.
        with interrupts_put_off():
            _write_arrays(new, sizes, arrays, marks)
        if path.exists():
            old = path.with_name(f".{path.name}-{secrets.token_hex(4)}")
            os.replace(path, old)
            os.replace(new, path)
            shutil.rmtree(old, ignore_errors=True)
        else:
            os.replace(new, path)
    except OSError as error:
        raise _store_error(path, error) from error
    finally:
        shutil.rmtree(new, ignore_errors=True)
    return StackStore(path)


def _own_variables(shots: int) -> dict[str, Variable]:
    """What every store holds, whatever was asked for."""
    own = {
        "status": Variable(
            ("shot",),
            np.dtype("int8"),
            {
                "units": "1",
                "long_name": "What became of the shot",
                "flag_values": [PENDING, DONE, FAILED],
                "flag_meanings": " ".join(STATUS_NAMES),
            },
        ),
        "report": Variable(
            ("shot",), str, {"units": "1", "long_name": "How it went, or why it failed (JSON)"}
        ),
    }
    for name, (kind, labels) in SUMMARY.items():
        nothing: NDArray[Any] = np.full(shots, np.nan if kind is float else 0, dtype=kind)
        own[name] = Variable(("shot",), np.dtype(kind), labels, nothing)
    return own


def _write_arrays(
    path: Path,
    sizes: Mapping[str, int],
    arrays: Mapping[str, Variable],
    attributes: Mapping[str, str],
) -> None:
    import zarr

    group = zarr.create_group(path, zarr_format=3, attributes=dict(attributes))
    for name, variable in arrays.items():
        _create_array(group, name, variable, sizes)
    with warnings.catch_warnings():
        # That other programs may not know it: they read the arrays' own metadata then.
        warnings.simplefilter("ignore")
        zarr.consolidate_metadata(path)


def _create_array(group: Any, name: str, variable: Variable, sizes: Mapping[str, int]) -> None:
    from zarr.codecs import BloscCodec

    shape = tuple(sizes[dim] for dim in variable.dims)
    each = variable.dims[:1] == ("shot",) and variable.values is None
    is_text = variable.dtype is str
    is_float = not is_text and np.dtype(variable.dtype).kind == "f"
    small = int(np.prod(shape[1:] if each else shape)) <= 64
    array = group.create_array(
        name,
        shape=shape,
        chunks=(1, *shape[1:]) if each else tuple(max(1, length) for length in shape),
        dtype=variable.dtype,
        fill_value="" if is_text else np.nan if is_float else 0,
        # Bytes that change slowly side by side: that is what makes fields compressible.
        compressors=None
        if small or is_text
        else BloscCodec(cname="zstd", clevel=3, shuffle="shuffle"),
        dimension_names=variable.dims,
        attributes=dict(variable.attributes),
    )
    if variable.values is not None:
        array[...] = variable.values


def _store_error(path: Path, error: OSError) -> StoreError:
    return StoreError(
        f"{path} cannot be written ({error.strerror or error}): make room or see to its folder, "
        "then run again to resume"
    )


def _damaged(path: Path, error: Exception) -> FileFormatError:
    return FileFormatError(
        f"{path} is a stack of shots but is damaged ({error}): run it again with overwriting"
    )


@dataclass(frozen=True)
class ShotWriter:
    """Writes shots into a store that is there; it can be sent to a worker.

    Attributes
    ----------
    path : Path
        The store.
    store_id : str
        Which store it must be: another one may have taken its place.
    """

    path: Path
    store_id: str

    def write(self, index: int, arrays: Mapping[str, Any], report: Mapping[str, Any]) -> None:
        """Write a shot; it is done when this returns.

        Parameters
        ----------
        index : int
            Which.
        arrays : mapping of str to array
            Its variables.
        report : mapping
            How it went.

        Raises
        ------
        StoreError
            If the store cannot be written or has been replaced; the shot is pending then.
        """
        self._commit(index, arrays, report, DONE)

    def fail(self, index: int, report: Mapping[str, Any]) -> None:
        """Write why a shot failed; see `write`."""
        self._commit(index, {}, report, FAILED)

    def _commit(
        self, index: int, arrays: Mapping[str, Any], report: Mapping[str, Any], status: int
    ) -> None:
        if _attributes(self.path).get("store_id") != self.store_id:
            raise StoreError(
                f"{self.path} is not there or is another store than at the start: every worker "
                "must see the same file system, and nobody may replace the store meanwhile"
            )
        group = _opened(self.path, self.store_id)
        try:
            for name, values in arrays.items():
                group[name][index : index + 1] = np.asarray(values)[np.newaxis]
            group["report"][index : index + 1] = np.array([json.dumps(report)], dtype=object)
            group["status"][index : index + 1] = np.int8(status)
        except OSError as error:
            raise _store_error(self.path, error) from error


@lru_cache(maxsize=4)
def _opened(path: Path, store_id: str) -> dict[str, Any]:
    """Arrays of a store; it takes milliseconds to open them."""
    import zarr

    return dict(zarr.open_group(path, mode="r+").arrays())


class StackStore:
    """A store as a run sees it: what is done, failed, pending.

    Parameters
    ----------
    path : Path
        The store.

    Raises
    ------
    FileFormatError
        If it is no store, or is damaged.
    """

    def __init__(self, path: Path) -> None:
        import zarr

        self.path = path
        if not path.exists():
            raise FileFormatError(
                f"{path} does not exist: expected a stack of shots, name{STORE_SUFFIX}; check the "
                "path"
            )
        self.attributes = _attributes(path)
        if self.attributes.get("format") != FORMAT:
            raise FileFormatError(f"{path} is no stack of shots: expected name{STORE_SUFFIX}")
        try:
            self._arrays = dict(zarr.open_group(path, mode="r").arrays())
            self.names = tuple(map(str, np.asarray(self._arrays["name"][...]).tolist()))
            self.statuses()
        except Exception as error:
            raise _damaged(path, error) from error

    @property
    def writer(self) -> ShotWriter:
        """What workers write to it with."""
        return ShotWriter(self.path, self.attributes["store_id"])

    def statuses(self) -> NDArray[np.int8]:
        """Return the status of each shot, shape (shot,): PENDING, DONE or FAILED."""
        return np.asarray(self._arrays["status"][...])

    def report(self, index: int) -> dict[str, Any]:
        """Return how a shot went; ``reason`` tells why it failed."""
        return self._parsed([str(self._arrays["report"][index])])[0]

    def reports(self) -> Sequence[dict[str, Any]]:
        """Return how each shot went.

        Raises
        ------
        FileFormatError
            If the reports are damaged.
        """
        try:
            texts = np.asarray(self._arrays["report"][...]).tolist()
        except Exception as error:
            raise _damaged(self.path, error) from error
        return self._parsed(texts)

    def _parsed(self, texts: Sequence[str]) -> list[dict[str, Any]]:
        try:
            return [dict(json.loads(text)) if text else {} for text in texts]
        except ValueError as error:
            raise _damaged(self.path, error) from error

    def summarise(self) -> None:
        """Gather numbers of each shot from their reports, for those who open the store.

        Raises
        ------
        StoreError
            If it cannot be written.
        """
        reports = self.reports()
        group = _opened(self.path, self.attributes["store_id"])
        try:
            for name, (kind, _) in SUMMARY.items():
                missing = np.nan if kind is float else 0
                key = "residual" if name == "flux_residual" else name
                values = [report.get(key, missing) for report in reports]
                group[name][...] = np.array(values, dtype=kind)
        except OSError as error:
            raise _store_error(self.path, error) from error


def read_stack(path: str | Path) -> xarray.Dataset:
    """Open a store of many shots; arrays are read when they are asked for.

    Parameters
    ----------
    path : str or Path
        ``name.shadowinv.zarr``, also while it is being written.

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

    path = Path(path)
    store = StackStore(path)
    try:
        dataset: xr.Dataset = xr.open_zarr(
            path, decode_times=False, mask_and_scale=False, chunks={}
        )
        setup = setup_from_dataset(dataset)
        complete = _with_fields(dataset, setup)
        # The folder's own order is arbitrary.
        order = [*variable_labels(setup), *_OWN_ORDER]
        shown = complete[[name for name in order if name in complete]]
        return shown.assign(status=shown["status"].copy(data=store.statuses()))
    except Exception as error:
        raise _damaged(path, error) from error


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


def _field_of_block(block: NDArray[Any], name: str, setup: Any) -> NDArray[np.float64]:
    return np.stack([field_in_si(name, values, setup) for values in block])
