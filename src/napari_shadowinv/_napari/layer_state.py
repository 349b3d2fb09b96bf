"""How layers looked, kept with a result, so that they come back as they were."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from napari_shadowinv._napari.fit_layers import fit_layers, verdict_in_words
from napari_shadowinv._napari.frame import Frame, frame_for, frame_of, matrix_of
from napari_shadowinv._napari.kinds import main_layers
from napari_shadowinv._napari.layer_metadata import (
    SHOT,
    SOURCE,
    Result,
    mark_of,
    role_of,
    slot_of,
)
from napari_shadowinv._napari.layers import FullLayerData, result_layers
from napari_shadowinv._napari.packs import pack_frame, pack_layers, pack_result, warnings_of_pack
from napari_shadowinv.cautions import Caution
from napari_shadowinv.errors import InputError
from napari_shadowinv.inversion.labels import is_fit, is_pack, setup_from_dataset

if TYPE_CHECKING:
    import xarray

    from napari_shadowinv.fitting import Fit
    from napari_shadowinv.inversion import Inversion

_LOOKS, _NAME = "napari_layers", "napari_name"

# Attributes that the dataset of a result makes anew.
_OWN_ATTRIBUTES = {_LOOKS, _NAME, "format", "options", "report", "image_residual", "errors_si"}
_OWN_ATTRIBUTES |= {"setup", "provenance", "package_version", "created"}
_OWN_ATTRIBUTES |= {"verdict", "explanation", "folded", "fields", "setups"}

_PLACE = ("scale", "translate", "units")
_TURN = ("rotate", "shear", "affine")
_KEPT: dict[str, tuple[str, ...]] = {
    "image": ("colormap", "contrast_limits", "gamma", "interpolation2d"),
    "labels": (),
    "points": ("face_colormap", "face_contrast_limits"),
    "vectors": ("length", "edge_width", "vector_style"),
    "shapes": ("edge_width",),
}
_KEPT_BY_ALL = ("name", "visible", "opacity", "blending", *_PLACE, *_TURN)


def layers_of_result(
    result: Result, frame: Frame, name: str = "", *, cells: bool = False
) -> list[FullLayerData]:
    """Describe the layers of any result, the lowest first."""
    from napari_shadowinv.fitting import Fit

    if isinstance(result.content, Fit):
        return fit_layers(result, frame, name, alone=True)
    if _is_pack(result):
        return pack_layers(result, frame, name)
    return result_layers(result, frame, name, cells=cells)


def layers_of_dataset(dataset: xarray.Dataset, name: str) -> list[FullLayerData]:
    """Describe the layers of a result as they were saved, the main ones, and its image."""
    name = dataset.attrs.get(_NAME, name)
    looks: dict[str, dict[str, Any]] = json.loads(dataset.attrs.get(_LOOKS, "{}"))
    if is_pack(dataset.attrs):
        layers = pack_layers(pack_result(dataset), pack_frame(dataset), name)
        return _looking(layers, looks)
    setup = setup_from_dataset(dataset)
    result = Result(
        _content(dataset),
        setup,
        {key: value for key, value in dataset.attrs.items() if key not in _OWN_ATTRIBUTES},
    )
    place = next(iter(looks.values()), {})
    shape = dataset.sizes["y"], dataset.sizes["x"]
    frame = frame_for(shape, setup, **{key: place.get(key) for key in _PLACE})
    if all(name in place for name in _TURN):  # not in files of older versions
        frame = replace(
            frame,
            rotate=matrix_of(np.array(place["rotate"])[-2:, -2:]),
            shear=float(place["shear"][-1]),
            affine=matrix_of(np.array(place["affine"])[-3:, -3:]),
        )
    layers = layers_of_result(result, frame, name, cells="cells" in looks)
    return _looking(main_layers(layers, also={*looks, "image"}), looks)


def _looking(layers: list[FullLayerData], looks: dict[str, dict[str, Any]]) -> list[FullLayerData]:
    """Give layers the looks that were saved."""
    return [
        (data, keywords | looks.get(slot_of(keywords), {}), kind) for data, keywords, kind in layers
    ]


def missing_layers(viewer: Any, layer: Any) -> list[FullLayerData]:
    """Describe the layers of a result, or of a store, that a viewer does not show yet.

    `layer` shows a part of it. An image that was inverted as it was is a layer already.
    """
    from napari_shadowinv._napari.stores import store_layers

    facts = mark_of(layer)
    result, store = facts.get("result"), facts.get("store")
    if result is not None:
        described = layers_of_result(result, frame_of(layer), str(facts.get("name", "")))
    elif store is not None:
        described = store_layers(Path(store), str(facts.get("name", "")))
        place = {"cache": False, **frame_of(layer).keywords(stacked=True)}
        described = [(data, keywords | place, kind) for data, keywords, kind in described]
    else:
        raise InputError(
            f"'{layer.name}' shows no result: select a layer of one, or press Run first"
        )
    alike = [
        shown
        for shown in viewer.layers
        if mark_of(shown).get("result") is result and mark_of(shown).get("store") == store
    ]
    slots = {slot_of(shown) for shown in alike} | _inputs_shown(viewer, result)
    missing = [each for each in described if slot_of(each[1]) not in slots]
    for _, keywords, _ in missing:
        keywords["visible"] = False
    return missing


def _inputs_shown(viewer: Any, result: Result | None) -> set[str]:
    """Roles of what a viewer shows already as a shot and its source, because no step changed it."""
    content = None if result is None else result.content
    recipe = getattr(getattr(content, "provenance", None), "recipe", None)
    if recipe is None or recipe.steps:
        return set()
    planes: Any = getattr(content, "images", None)  # of a fit
    if planes is None:
        planes = getattr(content, "image", None)
    shape = () if planes is None else tuple(planes.shape[-2:])
    inputs = {SHOT: "image", SOURCE: "source", None: "image"}
    return {
        inputs[role_of(shown)]
        for shown in viewer.layers
        if type(shown).__name__ == "Image"
        and role_of(shown) in inputs
        and tuple(shown.data.shape) == shape
    }


def doubts_of(result: Result) -> tuple[Caution, ...]:
    """Return the reasons to doubt a result."""
    from napari_shadowinv.fitting import Fit
    from napari_shadowinv.inversion import Inversion

    content = result.content
    if _is_pack(result):
        return warnings_of_pack(content)  # type: ignore[arg-type]
    if isinstance(content, Inversion):
        return content.report.warnings
    if isinstance(content, Fit) and content.verdict_caution:
        return (replace(content.verdict_caution, text=verdict_in_words(content)),)
    return ()


def dataset_of_layers(layers: Sequence[FullLayerData], result: Result) -> xarray.Dataset:
    """Make the dataset of a result that keeps how its layers look, with caustics as painted."""
    import xarray as xr

    from napari_shadowinv.fitting import Fit

    content = result.content
    looks = {slot_of(keywords): _look(keywords, kind) for _, keywords, kind in layers}
    name = next((mark_of(keywords).get("name") for _, keywords, _ in layers), None)
    kept = {_LOOKS: json.dumps(looks), **({} if name is None else {_NAME: name})}
    if isinstance(content, xr.Dataset):
        return content.assign_attrs(kept)
    told = {**result.attributes, **kept}
    if isinstance(content, Fit):
        return content.to_dataset(attributes=told)
    for data, keywords, _ in layers:
        if role_of(keywords) == "caustic":
            content = replace(content, caustic=np.asarray(data) > 0)
    return content.to_dataset(result.setup, attributes=told)


def _is_pack(result: Result) -> bool:
    return is_pack(getattr(result.content, "attrs", {}))


def _content(dataset: xarray.Dataset) -> Inversion | Fit | xarray.Dataset:
    """The result that a dataset holds; itself where that is only a field."""
    from napari_shadowinv.fitting import Fit
    from napari_shadowinv.inversion import Inversion

    if is_fit(dataset.attrs):
        return Fit.from_dataset(dataset)
    return Inversion.from_dataset(dataset) if "report" in dataset.attrs else dataset


def _look(keywords: dict[str, Any], kind: str) -> dict[str, Any]:
    names = (*_KEPT_BY_ALL, *_KEPT.get(kind, ()))
    return {name: _plain(keywords[name]) for name in names if keywords.get(name) is not None}


def _plain(value: Any) -> Any:
    """Make a keyword fit for JSON."""
    if isinstance(value, dict):
        return _plain_colormap(value)
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    if isinstance(value, np.generic):
        return value.item()
    return value if isinstance(value, (bool, int, float)) else str(value)


def _plain_colormap(colormap: dict[str, Any]) -> Any:
    """Keep a colour map that napari knows by its name, any other by its colours."""
    from napari.utils.colormaps import AVAILABLE_COLORMAPS, ensure_colormap

    name = colormap.get("name")
    if name in AVAILABLE_COLORMAPS and np.array_equal(
        ensure_colormap(name).colors, colormap["colors"]
    ):
        return name
    kept = ("name", "colors", "controls")
    return {key: _plain(colormap[key]) for key in kept if key in colormap}
