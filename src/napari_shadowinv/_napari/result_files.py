"""Results in files: their layers with the saved appearance, and napari's writers.

Any layers of a result save the complete result.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from napari_shadowinv._napari import layer_metadata as about
from napari_shadowinv._napari.layer_metadata import Frame, Result, frame_for, frame_of, main_layers
from napari_shadowinv._napari.layers import (
    FullLayerData,
    LayerData,
    field_layers,
    fit_layers,
    result_layers,
)
from napari_shadowinv._napari.packs import pack_layers
from napari_shadowinv.errors import FileFormatError, InputError
from napari_shadowinv.facts import ResultKind
from napari_shadowinv.io import write
from napari_shadowinv.io.formats import PRADFORMAT, RESULT, Format
from napari_shadowinv.results import result_from_dataset

if TYPE_CHECKING:
    import xarray

    from napari_shadowinv.results import AnyResult

_STATE = "napari"  # attribute with a result's name, its origins in words, its layers' looks
_MAX_NAMES = 3  # in a message

_PLACEMENT = ("scale", "translate", "units")
_TRANSFORM = ("rotate", "shear", "affine")
_SAVED_KEYWORDS: dict[str, tuple[str, ...]] = {
    "image": ("colormap", "contrast_limits", "gamma", "interpolation2d"),
    "points": ("face_colormap", "face_contrast_limits"),
    "vectors": ("length", "edge_width", "vector_style"),
}
_COMMON_KEYWORDS = ("name", "visible", "opacity", "blending", *_PLACEMENT, *_TRANSFORM)


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
    """Describe the saved layers of a result, the main layers, and its image."""
    state = json.loads(dataset.attrs.get(_STATE, "{}"))
    looks: dict[str, dict[str, Any]] = state.get("looks", {})
    content = result_from_dataset(dataset)
    result = Result(content, dict(state.get("origins", {})))
    placement = next(iter(looks.values()), {})
    shape = dataset.sizes["y"], dataset.sizes["x"]
    places = {key: placement.get(key) for key in _PLACEMENT}
    frame = frame_for(
        shape, content.setup, **places, pixel_size=dataset.attrs.get("scan_pixel_size")
    )
    if all(name in placement for name in _TRANSFORM):  # not in those of a script
        frame = replace(
            frame,
            rotate=about.matrix_of(np.array(placement["rotate"])[-2:, -2:]),
            shear=float(placement["shear"][-1]),
            affine=about.matrix_of(np.array(placement["affine"])[-3:, -3:]),
        )
    layers = layers_of_result(result, frame, state.get("name", name))
    return [
        (data, keywords | looks.get(about.layer_key(keywords), {}), kind)
        for data, keywords, kind in main_layers(layers, also={*looks, "image"})
    ]


def missing_layers(viewer: Any, layer: Any) -> LayerData:
    """Describe the layers of a result or store that are missing in a viewer.

    `layer` belongs to it. An image that no step changed counts as present.
    """
    from napari_shadowinv._napari.stores import store_layers

    facts = about.metadata_of(layer)
    result, store = facts.get("result"), facts.get("store")
    if result is not None:
        layer_data = layers_of_result(result, frame_of(layer), str(facts.get("name", "")))
    elif store is not None:
        layer_data = store_layers(Path(store), str(facts.get("name", "")))
        placement = {"cache": False, **frame_of(layer).keywords(stacked=True)}
        layer_data = [(data, keywords | placement, kind) for data, keywords, kind in layer_data]
    else:
        raise InputError(
            f"'{layer.name}' shows no result: select a layer of a result, or press Run first"
        )
    present = about.layers_of(viewer, layer)
    keys, inputs = {about.layer_key(layer) for layer in present}, _shown_inputs(viewer, result)
    missing = [
        entry
        for entry in layer_data
        if about.layer_key(entry[1]) not in keys and about.role_of(entry[1]) not in inputs
    ]
    for _, keywords, _ in missing:
        keywords["visible"] = False
    return missing


def _shown_inputs(viewer: Any, result: Result[AnyResult] | None) -> set[str]:
    """Return roles that a viewer shows as the shot and its source, unchanged by any step."""
    content = None if result is None else result.content
    recipe = getattr(getattr(content, "provenance", None), "recipe", None)
    if recipe is None or recipe.steps:
        return set()
    planes: Any = getattr(content, "images", getattr(content, "image", None))
    shape = () if planes is None else tuple(planes.shape[-2:])
    inputs = {about.SHOT: "image", about.SOURCE: "source", None: "image"}
    return {
        inputs[about.role_of(layer)]
        for layer in viewer.layers
        if about.kind_of(layer) == "image"
        and about.role_of(layer) in inputs
        and tuple(layer.data.shape) == shape
    }


def dataset_of_layers(layers: Sequence[FullLayerData], result: Result[AnyResult]) -> xarray.Dataset:
    """Return the dataset of a result with its layers' appearance and painted caustics."""
    content: Any = result.content
    looks = {about.layer_key(keywords): _look(keywords, kind) for _, keywords, kind in layers}
    state = {"looks": looks, "origins": dict(result.origins)}
    for data, keywords, _ in layers:
        if (name := about.metadata_of(keywords).get("name")) is not None:
            state["name"] = name
        if about.role_of(keywords) == "caustic":  # of an inversion
            content = replace(content, caustic=np.asarray(data) > 0)
    saved: xarray.Dataset = content.to_dataset()
    return saved.assign_attrs({_STATE: json.dumps(state, default=_plain)})


def _look(keywords: dict[str, Any], kind: str) -> dict[str, Any]:
    names = (*_COMMON_KEYWORDS, *_SAVED_KEYWORDS.get(kind, ()))
    look = {name: keywords[name] for name in names if keywords.get(name) is not None}
    return {
        name: _colormap_look(value) if isinstance(value, dict) else value
        for name, value in look.items()
    }


def _plain(value: Any) -> Any:
    """Convert a value that JSON does not have."""
    return value.tolist() if isinstance(value, (np.ndarray, np.generic)) else str(value)


def _colormap_look(colormap: dict[str, Any]) -> Any:
    """Return the name of one of napari's colour maps, or else its colours."""
    from napari.utils.colormaps import AVAILABLE_COLORMAPS, ensure_colormap

    name = colormap.get("name")
    if name in AVAILABLE_COLORMAPS and np.array_equal(
        ensure_colormap(name).colors, colormap["colors"]
    ):
        return name
    return {key: colormap[key] for key in ("name", "colors", "controls") if key in colormap}


def write_result(path: str, layers: Sequence[FullLayerData]) -> list[str]:
    """Write a complete result, with the appearance of its layers, as ``.shadowinv``."""
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
        return [str(write(target, dataset_to_save(layers), overwrite=has_suffix))]
    except InputError as error:
        # napari takes a ValueError of a writer as "no writer" and hides its message.
        raise FileFormatError(str(error)) from error


def dataset_to_save(layers: Sequence[FullLayerData]) -> xarray.Dataset:
    """Return the dataset of the result that layers show, as it was computed."""
    return dataset_of_layers(*_common_result(layers))


def _common_result(layers: Sequence[FullLayerData]) -> tuple[LayerData, Result[AnyResult]]:
    owners = [about.result_of(layer[1]) for layer in layers]
    results = {id(result): result for result in owners if result is not None}
    if len(results) > 1:
        names = [_name(layer) for layer in layers if about.result_of(layer[1]) is not None]
        raise InputError(
            f"the layers belong to {len(results)} results ({_quote_names(names)}): select layers "
            "of one result and save the selected layers"
        )
    if not results:
        raise InputError(
            f"no layer belongs to a result ({_quote_names([_name(layer) for layer in layers])}): "
            "expected at least one layer of an inversion; save other layers as images"
        )
    (common,) = results.values()
    return [layer for layer in layers if about.result_of(layer[1]) is common], common


def _name(layer: FullLayerData) -> str:
    return str(layer[1].get("name", "?"))


def _quote_names(names: Sequence[str]) -> str:
    text = ", ".join(f"'{name}'" for name in names[:_MAX_NAMES])
    return text + (f" and {len(names) - _MAX_NAMES} more" if len(names) > _MAX_NAMES else "")
