"""The results of a run of shots as lazy layers; only the first finished shot is read at once."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from napari_shadowinv._napari.frame import frame_for
from napari_shadowinv._napari.layer_metadata import mark_of, role_of
from napari_shadowinv._napari.layers import FullLayerData, at_shot, dataset_layers, thinned_arrows
from napari_shadowinv._system.safety import refusing_damage
from napari_shadowinv.errors import FileFormatError, InputError
from napari_shadowinv.inversion.labels import setup_from_dataset
from napari_shadowinv.io.formats import RESULT
from napari_shadowinv.io.store_setups import with_own_setups

if TYPE_CHECKING:
    import xarray


@refusing_damage
def store_layers(path: Path, name: str = "", first: int | None = None) -> list[FullLayerData]:
    """Describe the layers of a ``.shadowinv.zarr`` folder, with the arrows of one shot.

    That is the first one that is done, which also decides on units, unless it is given.
    """
    dataset = _opened(path)
    name = name or path.name.removesuffix(".zarr").removesuffix(RESULT.suffix)
    first = _first_done(dataset, path) if first is None else first
    setup = setup_from_dataset(dataset.isel(shot=first))
    frame = frame_for(dataset["displacement"].shape, setup)
    facts = {"store": str(path), "name": name, "shots": _shot_names(dataset)}
    return dataset_layers(dataset, setup, frame, name, facts, first)


@refusing_damage
def first_shot(path: Path) -> int:
    """Return the number of the first shot of a store that is done."""
    return _first_done(_opened(path), path)


@refusing_damage
def _opened(path: Path) -> xarray.Dataset:
    """Open a store lazily, the axis of shots first, or say why it is none."""
    import xarray as xr

    from napari_shadowinv.io.store_files import CheckedStore, describes_arrays

    if not path.is_dir():
        raise FileFormatError(f"{path} does not exist: expected a folder made by an inversion")
    # Nothing in it is a time, whatever its units look like. While a store grows, only the folder's
    # own copy gives all arrays one length.
    dataset: xr.Dataset = xr.open_zarr(
        CheckedStore(path),
        chunks={},
        decode_times=False,
        mask_and_scale=False,
        consolidated=describes_arrays(path),
    )
    if "displacement" not in dataset or "shot" not in dataset["displacement"].dims:
        raise FileFormatError(
            f"{path} is a Zarr folder but not a store of inverted shots (it has no "
            "displacement): open it with napari's own reader"
        )
    return with_own_setups(dataset).transpose("shot", "component", "y", "x", ...)


@refusing_damage
def shot_of_store(path: Path, index: int) -> xarray.Dataset:
    """Read one shot of a store as the dataset of its own result.

    Raises
    ------
    InputError
        If the shot is not done.
    """
    from napari_shadowinv.io.store import DONE, STATUS_NAMES, StackStore, read_stack

    store = StackStore(path)
    status = store.statuses()[index]
    if status != DONE:
        raise InputError(
            f"shot {index} ('{store.names[index]}') is {STATUS_NAMES[status]}: move the slider to "
            "a finished shot"
        )
    shot = read_stack(path).isel(shot=index)
    labels = {name: str(shot[name].values) for name in ("name", "report") if name in shot}
    planes = [str(name) for name in shot.data_vars if "y" in shot[name].dims]
    saved: xarray.Dataset = shot[planes].drop_vars("shot", errors="ignore").compute()
    return saved.assign_attrs(shot=labels.get("name", str(index)))


def _first_done(dataset: xarray.Dataset, path: Path) -> int:
    from napari_shadowinv.io.store import DONE

    displacement = dataset["displacement"]
    shots: Iterable[int] = range(displacement.sizes["shot"])
    if "status" in dataset and "shot" in dataset["status"].dims:
        shots = np.flatnonzero(dataset["status"].values == DONE)
    for shot in shots:
        with suppress(FileFormatError):  # it is damaged
            if np.isfinite(displacement[shot].values).all():
                return int(shot)
    raise FileFormatError(f"{path} contains no finished shot yet: wait for the first one")


def _shot_names(dataset: xarray.Dataset) -> list[str]:
    for name in ("name", "shot"):
        if name in dataset.variables and dataset[name].dims == ("shot",):
            return [str(value) for value in dataset[name].values]
    return [str(shot) for shot in range(dataset.sizes["shot"])]


def follow_shots(viewer: Any, layer: Any) -> Callable[[], None]:
    """Let arrows, which cannot be lazy, show the shot in view; return what reads them again."""
    displacement = _displacement(layer)
    shown: list[int] = []

    def shot_in_view() -> int:
        return round(float(layer.world_to_data(viewer.dims.point[-layer.ndim :])[0]))

    def read() -> None:
        shot = shot_in_view()
        if not layer.visible or not 0 <= shot < len(displacement):
            return
        shown[:] = [shot]
        try:
            plane = displacement[shot].values
        except OSError:
            return  # the field comes from the same place, and reports it
        data, _ = thinned_arrows(plane)
        layer.data = at_shot(data, shot)
        layer.features = {"displacement": np.hypot(*data[:, 1].T)}

    def read_again() -> None:
        nonlocal displacement
        displacement = _displacement(layer)
        read()

    def follow(_: Any = None) -> None:
        if shown != [shot_in_view()]:
            read()

    def leave(event: Any) -> None:
        if event.value is layer:
            viewer.dims.events.current_step.disconnect(follow)
            viewer.layers.events.removed.disconnect(leave)

    viewer.dims.events.current_step.connect(follow)
    viewer.layers.events.removed.connect(leave)
    layer.events.visible.connect(follow)
    follow()
    return read_again


def _displacement(layer: Any) -> xarray.DataArray:
    return _opened(Path(mark_of(layer)["store"]))["displacement"]


def viewer_in_window() -> Any | None:
    """Return the viewer of the window that asks, None without a window."""
    if "napari._qt" not in sys.modules:
        return None
    from napari import current_viewer

    return current_viewer()


def follow_once_added(described: Sequence[FullLayerData]) -> None:
    """Let arrows follow in the window that asked for them; without one, nobody leafs."""
    viewer = viewer_in_window()
    stores = {mark_of(one[1]).get("store") for one in described if role_of(one[1]) == "arrows"}
    if viewer is None or not stores:
        return

    def begin(event: Any) -> None:
        layer = event.value
        if role_of(layer) == "arrows" and mark_of(layer).get("store") in stores:
            viewer.layers.events.inserted.disconnect(begin)
            follow_shots(viewer, layer)

    viewer.layers.events.inserted.connect(begin)
