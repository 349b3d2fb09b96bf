"""Results in files and stores: their layers, and napari's writers.

- a result: any of its layers save it whole
- a store of shots as lazy layers; only the first finished shot is read now: `store_layers`
"""

from __future__ import annotations

import json
import sys
import weakref
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from napari_shadowinv._napari import layer_metadata as about
from napari_shadowinv._napari.layer_metadata import (
    Frame,
    Result,
    frame_for,
    frame_of,
    main_layers,
    metadata_of,
)
from napari_shadowinv._napari.layers import (
    FullLayerData,
    LayerData,
    View,
    arrows_in_shot,
    dataset_layers,
    field_layers,
    fit_layers,
    pack_layers,
    result_layers,
    sample_arrows,
)
from napari_shadowinv._napari.viewer_sync import connect, connect_layers, without_proxy
from napari_shadowinv._system.safety import as_file_errors
from napari_shadowinv.errors import FileFormatError, InputError
from napari_shadowinv.facts import ResultKind
from napari_shadowinv.inversion.variables import setup_from_dataset
from napari_shadowinv.io import write
from napari_shadowinv.io.formats import PRADFORMAT, RESULT, Format
from napari_shadowinv.io.store import (
    DONE,
    STATUS_NAMES,
    StackStore,
    columns_of_store,
    open_dataset,
    read_stack,
    with_own_setups,
)
from napari_shadowinv.results import result_from_dataset

if TYPE_CHECKING:
    import xarray

    from napari_shadowinv.results import AnyResult

_STATE = "napari"  # attribute with a result's name, its place, and its origins in words


def layers_of_result(result: Result[AnyResult], frame: Frame, name: str = "") -> LayerData:
    """Describe the layers of any result, the lowest first."""
    functions: dict[ResultKind, Callable[..., LayerData]] = {
        ResultKind.INVERSION: result_layers,
        ResultKind.FIT: partial(fit_layers, with_images=True),
        ResultKind.FILM_DOSES: pack_layers,
        ResultKind.FIELD: field_layers,
    }
    return functions[result.content.kind](result, frame, name)


def layers_of_dataset(dataset: xarray.Dataset, name: str) -> LayerData:
    """Describe the main layers of a result, and its image, where they were saved."""
    state = json.loads(dataset.attrs.get(_STATE, "{}"))
    content = result_from_dataset(dataset)
    shape = dataset.sizes["y"], dataset.sizes["x"]
    if "frame" in state:
        affine = about.matrix_of(state["frame"].pop("affine"))
        frame = Frame(**{key: tuple(value) for key, value in state["frame"].items()}, affine=affine)
    else:  # written by a command or a script
        frame = frame_for(shape, content.setup, pixel_size=dataset.attrs.get("scan_pixel_size"))
    result = Result(content, dict(state.get("origins", {})))
    layers = layers_of_result(result, frame, state.get("name") or name)
    return main_layers(layers, also={"image"})


def missing_layers(viewer: Any, layer: Any) -> LayerData:
    """Describe the layers of a result or store that are missing in a viewer.

    `layer` belongs to it.
    """
    facts, frame = about.metadata_of(layer), frame_of(layer)
    result, store = facts.get("result"), facts.get("store")
    if result is not None:
        layer_data = layers_of_result(result, frame, str(facts.get("name", "")))
    elif store is not None:
        placement = {"cache": False, **frame.keywords(stacked=True)}
        layer_data = store_layers(Path(store), str(facts.get("name", "")))
        layer_data = [(data, keywords | placement, kind) for data, keywords, kind in layer_data]
    else:
        raise InputError(
            f"'{layer.name}' shows no result: select a layer of a result, or press Run first"
        )
    keys = {about.layer_key(each) for each in about.layers_of(viewer, layer)}
    return [
        (data, {**keywords, "visible": False}, kind)
        for data, keywords, kind in layer_data
        if about.layer_key(keywords) not in keys
    ]


def dataset_to_save(result: Result[AnyResult], layer: Any) -> xarray.Dataset:
    """Return the dataset of a result, with the name and the place of a layer that shows it."""
    name, frame = about.metadata_of(layer).get("name"), asdict(frame_of(layer))
    state = {"name": name, "frame": frame, "origins": dict(result.origins)}
    return result.content.to_dataset().assign_attrs({_STATE: json.dumps(state)})


def write_result(path: str, layers: Sequence[FullLayerData]) -> list[str]:
    """Write a complete result as ``.shadowinv``."""
    return _write(path, layers, RESULT)


def write_pradformat(path: str, layers: Sequence[FullLayerData]) -> list[str]:
    """Write a result's potential and deflection as a pradformat inversion."""
    return _write(path, layers, PRADFORMAT)


def _write(path: str, layers: Sequence[FullLayerData], form: Format) -> list[str]:
    try:
        target = Path(path)
        has_suffix = target.suffix.lower() in form.suffixes
        if not has_suffix:
            target = target.with_name(target.name + form.suffix)
        # napari's dialog asked about replacing the entered name only.
        return [str(write(target, _common_result(layers), overwrite=has_suffix))]
    except InputError as error:
        # napari takes a ValueError of a writer as "no writer" and hides its message.
        raise FileFormatError(str(error)) from error


def _common_result(layers: Sequence[FullLayerData]) -> xarray.Dataset:
    """Return the dataset of the one result that layers show."""
    from napari.layers import Layer

    shown = [(about.result_of(layer[1]), layer) for layer in layers]
    of_results = [(result, layer) for result, layer in shown if result is not None]
    if len({id(result) for result, _ in of_results}) > 1:
        raise InputError(
            "the layers belong to several results: select layers of one result and save the "
            "selected layers"
        )
    if not of_results:
        raise InputError(
            "no layer belongs to a result: expected at least one layer of an inversion; save other "
            "layers as images"
        )
    result, layer = of_results[0]
    return dataset_to_save(result, Layer.create(*layer))


_COMPARED_SHOTS = 16


@as_file_errors
def store_layers(path: Path, name: str = "") -> LayerData:
    """Describe the layers of a ``.shadowinv.zarr`` folder, with the arrows of one shot.

    Units and contrast suit the strongest of up to 16 finished shots.
    """
    dataset = _open(path)
    name = name or path.name.removesuffix(".zarr").removesuffix(RESULT.suffix)
    reference = _strongest_shot(dataset, path)
    setup = setup_from_dataset(dataset.isel(shot=reference))
    frame = frame_for(dataset["displacement"].shape, setup)
    facts = {"store": str(path), "name": name, "shots": _shot_names(dataset)}
    return dataset_layers(View(dataset, setup, reference), frame, name, facts)


@as_file_errors
def _open(path: Path) -> xarray.Dataset:
    """Open a store lazily with the axis of shots first, or raise a `FileFormatError`."""
    if not path.is_dir():
        raise FileFormatError(f"{path} does not exist: expected a folder made by an inversion")
    dataset = open_dataset(path)
    if "displacement" not in dataset or "shot" not in dataset["displacement"].dims:
        raise FileFormatError(
            f"{path} is a Zarr folder but not a store of inverted shots (it has no "
            "displacement): open it with napari's own reader"
        )
    return with_own_setups(dataset).transpose("shot", "component", "y", "x", ...)


@as_file_errors
def shot_of_store(path: Path, index: int) -> xarray.Dataset:
    """Read a shot of a store as the dataset of a single result; an `InputError` if not done."""
    store = StackStore(path)
    status = store.statuses()[index]
    if status != DONE:
        raise InputError(
            f"shot {index} ('{store.names[index]}') is {STATUS_NAMES[status]}: move the slider to "
            "a finished shot"
        )
    shot = read_stack(path).isel(shot=index)
    name = str(shot["name"].values) if "name" in shot else str(index)
    planes = [str(variable) for variable in shot.data_vars if "y" in shot[variable].dims]
    return shot[planes].drop_vars("shot", errors="ignore").compute().assign_attrs(shot=name)


@as_file_errors
def shot_rows(path: Path, index: int) -> list[tuple[str, str]]:
    """Return the quantities of a shot that tables list, as rows of a report."""
    dataset = _open(path)
    report = json.loads(str(dataset["report"][index].values) or "{}")
    columns = columns_of_store(dataset.attrs)
    texts = {"result": report.get("headline", "")}
    texts |= {column.title: column.text(report) for column in columns if column.show}
    rows = [(title.capitalize(), text) for title, text in texts.items() if text]
    return [("Shot", f"{index} ({_shot_names(dataset)[index]})"), *rows]


def _strongest_shot(dataset: xarray.Dataset, path: Path) -> int:
    """Return the shot with the largest displacement among some of the finished ones."""
    finished = np.arange(dataset.sizes["shot"])
    if "status" in dataset and "shot" in dataset["status"].dims:
        finished = np.flatnonzero(dataset["status"].values == DONE)
    places = np.linspace(0, len(finished) - 1, min(len(finished), _COMPARED_SHOTS))
    peaks: dict[int, float] = {}
    for shot in finished[np.rint(places).astype(int)].tolist():
        with suppress(FileFormatError, OSError):  # the shot is damaged
            peak = float(np.abs(dataset["displacement"][shot].values).max())
            if np.isfinite(peak):
                peaks[shot] = peak
    if not peaks:
        raise FileFormatError(f"{path} contains no finished shot yet: wait for the first one")
    return max(peaks, key=lambda shot: peaks[shot])


def _shot_names(dataset: xarray.Dataset) -> list[str]:
    names = dataset["name"].values if "name" in dataset else range(dataset.sizes["shot"])
    return list(map(str, names))


_followed: weakref.WeakSet[Any] = weakref.WeakSet()  # lists of layers
# By layer: its facts, the displacement in its store, and the shot that its arrows show.
_shown_arrows: weakref.WeakKeyDictionary[Any, Any] = weakref.WeakKeyDictionary()


def follow_arrows(viewer: Any) -> None:
    """Show the arrows of the shot in view, now and from now on; they cannot be lazy."""

    def follow(_: Any = None) -> None:
        for layer in viewer.layers:
            # Nothing is read for arrows that nobody sees.
            if about.role_of(layer) == "arrows" and "store" in metadata_of(layer) and layer.visible:
                _read_arrows(layer, viewer.dims.point)

    follow()
    layers = without_proxy(viewer.layers)
    if layers not in _followed:
        _followed.add(layers)
        connect(viewer.dims, "current_step", follow)
        connect_layers(viewer.layers, "visible", follow)


def _read_arrows(layer: Any, point: Any) -> None:
    facts = metadata_of(layer)
    known, displacement, before = _shown_arrows.get(layer, (None, None, None))
    if known is not facts:  # the store has grown
        displacement, before = _open(Path(facts["store"]))["displacement"], None
    shot = round(float(layer.world_to_data(point[-layer.ndim :])[0]))
    if shot == before or not 0 <= shot < len(displacement):
        return
    _shown_arrows[layer] = facts, displacement, shot
    with suppress(OSError):  # the field, from the same chunk, reports it
        data, _ = sample_arrows(displacement[shot].values)
        layer.data = arrows_in_shot(data, shot)
        layer.features = {"displacement": np.hypot(*data[:, 1].T)}


def viewer_in_window() -> Any | None:
    """Return the viewer of the current window, None without a window."""
    if "napari._qt" not in sys.modules:
        return None
    from napari import current_viewer

    return current_viewer()
