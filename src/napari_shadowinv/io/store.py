"""Results of many shots in one Zarr store, written shot by shot.

- write one shot, or why it failed: `ShotWriter`
- what has been written: `read_stack` (lazy, for everyone), `StackStore` (for a run)

Each variable has one chunk for each shot, each chunk is a file that appears whole or not at
all, and the last one of a shot is its `status`: what is not marked there is pending and will be
written again. So workers can write side by side, and any of them may die.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from napari_shadowinv._system.safety import refusing_damage, small_text
from napari_shadowinv._typing import AnyArray, FloatArray
from napari_shadowinv.errors import FileFormatError
from napari_shadowinv.inversion.labels import (
    PIXEL,
    SETUPS_LABEL,
    fit_labels,
    place_label,
    setup_from_dataset,
    update_labels,
    variable_labels,
)
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
    "noise_error": (
        float,
        {"units": PIXEL, "long_name": "Standard error of the displacement by noise, r.m.s."},
    ),
    "discretisation_error": (
        float,
        {"units": PIXEL, "long_name": "Error of the displacement by too few sites, r.m.s."},
    ),
    "iterations": (int, {"units": "1", "long_name": "Solver iterations, summed over all levels"}),
    "seconds": (float, {"units": "s", "long_name": "Time its worker spent on the shot"}),
}
FIT_SUMMARY: dict[str, tuple[type, dict[str, str]]] = {
    "verdict": (str, {"units": "1", "long_name": "Whether the field may be believed"}),
    "chi2": (float, {"units": "1", "long_name": "Largest χ² of the shot's images"}),
    "folded": (float, {"units": "1", "long_name": "Share of the pixels whose rays have crossed"}),
    "uncertainty": (
        float,
        {"units": "1", "long_name": "Displacement's error bar, r.m.s., as a share of it"},
    ),
    "converged": (bool, {"units": "1", "long_name": "Ended before the most steps allowed"}),
    "iterations": (int, {"units": "1", "long_name": "Steps at full size"}),
    "seconds": SUMMARY["seconds"],
}
TABLE_SUMMARY: dict[str, tuple[type, dict[str, str]]] = {
    **SUMMARY,
    "energy": (float, {"units": "MeV", "long_name": "Energy of the particles"}),
}
# Attribute of a store whose shots are rows of a table, each with its own setup in its report.
OWN_SETUPS = "table_of_shots"
PENDING, DONE, FAILED = 0, 1, 2
STATUS_NAMES = ("pending", "done", "failed")
_NO_TEXT = np.array([], object)
_OWN_ORDER = ("status", *dict.fromkeys((*FIT_SUMMARY, *TABLE_SUMMARY)), "setup", "report")


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


def fitted_field(attributes: Mapping[Any, Any]) -> str | None:
    """Return the field that was fitted to each shot of a store; None if shots were inverted."""
    names = json.loads(attributes.get("fields", "[]"))
    return str(names[0]) if names else None


def summary_of(attributes: Mapping[Any, Any]) -> dict[str, tuple[type, dict[str, str]]]:
    """Return the numbers that are gathered of each shot of a store: their types and labels."""
    if fitted_field(attributes) is not None:
        return FIT_SUMMARY
    return TABLE_SUMMARY if OWN_SETUPS in attributes else SUMMARY


def nothing_yet(kind: type) -> Any:
    """Return what stands for a number of a shot that is not known."""
    return "" if kind is str else np.nan if kind is float else 0


def number_of(report: Mapping[str, Any], name: str, kind: type) -> Any:
    """Return what a shot's report says of one of the numbers that are gathered."""
    return report.get("residual" if name == "flux_residual" else name, nothing_yet(kind))


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
    """A store as a run sees it: what is done, failed, pending.

    The `field`, if it was fitted; `own_setups` tells whether its shots are rows of a table.
    """

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
        self.field = fitted_field(self.attributes)
        self.own_setups = OWN_SETUPS in self.attributes
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
            for name, (kind, _) in summary_of(self.attributes).items():
                if name not in group:  # a store of an older version
                    continue
                values = [number_of(report, name, kind) for report in reports]
                group[name][...] = np.array(values, dtype=object if kind is str else kind)
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
        2 failed; the values of shots that are not done are NaN. Where shots have setups of their
        own, ``setup`` has that of each, empty until it is done.

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
    setup = setup_from_dataset(dataset)
    complete = _with_fields(with_own_setups(dataset), setup)
    # The folder's own order is arbitrary.
    order = [*_labels(dataset, setup), *_OWN_ORDER]
    shown = complete[[name for name in order if name in complete]]
    return shown.assign(status=shown["status"].copy(data=store.statuses()))


def _labels(dataset: xarray.Dataset, setup: Any) -> dict[str, Any]:
    """What a store's dataset may hold, by name, and how it is labelled."""
    field = fitted_field(dataset.attrs)
    return variable_labels(setup) if field is None else fit_labels(field, setup)


def with_own_setups(dataset: xarray.Dataset) -> xarray.Dataset:
    """Add the setup of each shot, read when it is asked for, if shots have their own."""
    if OWN_SETUPS not in dataset.attrs or "setup" not in dataset.attrs:
        return dataset
    texts = dataset["report"].data.map_blocks(_setups_of_block, dtype=object, meta=_NO_TEXT)
    return with_places(dataset.assign(setup=(("shot",), texts, SETUPS_LABEL)))


def with_places(dataset: xarray.Dataset) -> xarray.Dataset:
    """Add where the pixels of each shot are in metres, by the shot's own setup."""
    sizes = of_each_setup(dataset, _pixel_size)[:, np.newaxis]
    places = {
        f"{name}_si": (("shot", name), sizes * dataset[name].values, place_label(name))
        for name in ("y", "x")
    }
    return dataset.assign_coords(places)


def _pixel_size(setup: Any) -> float:
    return float(setup.object_pixel_size)


def _setups_of_block(reports: AnyArray) -> AnyArray:
    made = (json.loads(str(text) or "{}").get("provenance", {}) for text in reports)
    return np.array([json.dumps(one["setup"]) if "setup" in one else "" for one in made], object)


def _with_fields(dataset: xarray.Dataset, setup: Any) -> xarray.Dataset:
    """Add the fields in SI units that follow from what is stored, lazily."""
    if setup is None:
        return dataset
    found = {}
    in_si = {field.name for field in setup.si_fields}
    for name, (dims, labels) in _labels(dataset, setup).items():
        origin = "displacement" if "component" in dims else "potential"
        if name in dataset or name not in in_si or origin not in dataset:
            continue
        found[name] = (("shot", *dims), field_in_si(dataset, origin, name, setup), labels)
    return dataset.assign(found)


def of_each_setup(dataset: xarray.Dataset, measure: Callable[[Any], float]) -> Any:
    """A number of the setup of each shot, NaN until it is done; None if all share one setup."""
    if "setup" not in dataset:
        return None
    return dataset["setup"].data.map_blocks(_measured, measure, dtype=np.float64)


def _measured(texts: AnyArray, measure: Callable[[Any], float]) -> FloatArray:
    from napari_shadowinv.physics.setup import setup_from_dict

    found = (measure(setup_from_dict(json.loads(text))) if text else np.nan for text in texts)
    return np.array(list(found))


def field_in_si(dataset: xarray.Dataset, origin: str, name: str, setup: Any) -> Any:
    """A field of all shots in SI units, by the setup of each or by one for all; not read yet."""
    data = dataset[origin].data
    if "setup" not in dataset:
        return data.map_blocks(_field_of_block, None, name, setup, dtype=np.float64)
    texts = dataset["setup"].data[(..., *[np.newaxis] * (data.ndim - 1))]
    return data.map_blocks(
        _field_of_block, texts, name, setup, dtype=np.float64, chunks=data.chunks
    )


def _field_of_block(block: AnyArray, texts: AnyArray | None, name: str, setup: Any) -> FloatArray:
    from napari_shadowinv.physics.setup import setup_from_dict

    own = [setup] * len(block)
    if texts is not None:
        # What is not done yet is NaN with any setup.
        own = [setup_from_dict(json.loads(text)) if text else setup for text in texts.flat]
    pairs = zip(own, block, strict=True)
    return np.stack([one.field_in_si(name, values) for one, values in pairs])
