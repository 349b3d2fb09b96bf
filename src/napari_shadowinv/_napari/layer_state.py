"""How layers looked, kept with a result, so that they come back as they were."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from napari_shadowinv._napari.frame import frame_for, matrix_of
from napari_shadowinv._napari.layer_metadata import Result, role_of
from napari_shadowinv._napari.layers import FullLayerData, result_layers
from napari_shadowinv.inversion.labels import is_fit, setup_from_dataset

if TYPE_CHECKING:
    import xarray

_LOOKS = "napari_layers"

# Attributes that the dataset of a result makes anew.
_OWN_ATTRIBUTES = {_LOOKS, "format", "options", "report", "image_residual"}
_OWN_ATTRIBUTES |= {"setup", "provenance", "package_version", "created"}

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


def layers_of_dataset(dataset: xarray.Dataset, name: str) -> list[FullLayerData]:
    """Describe the layers of a result as they were saved; those that were not are hidden."""
    from napari_shadowinv.inversion import Inversion

    looks: dict[str, dict[str, Any]] = json.loads(dataset.attrs.get(_LOOKS, "{}"))
    setup = setup_from_dataset(dataset)
    inverted = "report" in dataset.attrs and not is_fit(dataset.attrs)
    result = Result(
        Inversion.from_dataset(dataset) if inverted else dataset,
        setup,
        {key: value for key, value in dataset.attrs.items() if key not in _OWN_ATTRIBUTES},
    )
    place = next(iter(looks.values()), {})
    shape = dataset["displacement"].shape[-2:]
    frame = frame_for(shape, setup, **{key: place.get(key) for key in _PLACE})
    if all(name in place for name in _TURN):  # not in files of older versions
        frame = replace(
            frame,
            rotate=matrix_of(place["rotate"]),
            shear=float(place["shear"][-1]),
            affine=matrix_of(place["affine"]),
        )
    layers = result_layers(result, frame, name, cells="cells" in looks)
    if not looks:
        return layers
    hidden = {"visible": False}
    return [
        (data, keywords | looks.get(role_of(keywords) or "", hidden), kind)
        for data, keywords, kind in layers
    ]


def dataset_of_layers(layers: Sequence[FullLayerData], result: Result) -> xarray.Dataset:
    """Make the dataset of a result that keeps how its layers look, with caustics as painted."""
    import xarray as xr

    content = result.content
    looks = {role_of(keywords): _look(keywords, kind) for _, keywords, kind in layers}
    kept = {_LOOKS: json.dumps(looks)}
    if isinstance(content, xr.Dataset):
        return content.assign_attrs(kept)
    for data, keywords, _ in layers:
        if role_of(keywords) == "caustic":
            content = replace(content, caustic=np.asarray(data) > 0)
    return content.to_dataset(result.setup, attributes={**result.attributes, **kept})


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
