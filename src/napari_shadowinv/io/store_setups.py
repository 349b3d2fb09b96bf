"""Setups of the shots of a store, which may differ.

- the setup of each shot, and where its pixels are in metres: `with_own_setups`, `with_places`
- a number of each setup: `of_each_setup`; a field in SI units: `field_in_si`
"""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from napari_shadowinv._typing import AnyArray, FloatArray
from napari_shadowinv.inversion.variables import SETUPS_LABEL, place_label

if TYPE_CHECKING:
    import xarray

# Attribute of a store whose shots are rows of a table, each with its own setup in its report.
OWN_SETUPS = "table_of_shots"
_NO_TEXT = np.array([], object)


def with_own_setups(dataset: xarray.Dataset) -> xarray.Dataset:
    """Add the setup of each shot, read lazily, if shots have different ones."""
    if OWN_SETUPS not in dataset.attrs or "setup" not in dataset.attrs:
        return dataset
    texts = dataset["report"].data.map_blocks(_setups_of_block, dtype=object, meta=_NO_TEXT)
    return with_places(dataset.assign(setup=(("shot",), texts, SETUPS_LABEL)))


def with_places(dataset: xarray.Dataset) -> xarray.Dataset:
    """Add the coordinates of each shot's pixels in metres, by the shot's own setup."""
    sizes = of_each_setup(dataset, _pixel_size)[:, np.newaxis]
    places = {
        f"{name}_si": (("shot", name), sizes * dataset[name].values, place_label(name))
        for name in ("y", "x")
    }
    return dataset.assign_coords(places)


def _pixel_size(setup: Any) -> float:
    return float(setup.object_pixel_size)


def _setups_of_block(reports: AnyArray) -> AnyArray:
    provenances = (json.loads(str(text) or "{}").get("provenance", {}) for text in reports)
    setups = (provenance.get("setup") for provenance in provenances)
    return np.array(["" if setup is None else json.dumps(setup) for setup in setups], object)


def of_each_setup(dataset: xarray.Dataset, measure: Callable[[Any], float]) -> Any:
    """Return a number of each shot's setup, NaN until it is done; None if all share one setup."""
    if "setup" not in dataset:
        return None
    return dataset["setup"].data.map_blocks(_measure_setups, measure, dtype=np.float64)


def _measure_setups(texts: AnyArray, measure: Callable[[Any], float]) -> FloatArray:
    from napari_shadowinv.physics.setup import setup_from_dict

    measures = (measure(setup_from_dict(json.loads(text))) if text else np.nan for text in texts)
    return np.array(list(measures))


def field_in_si(dataset: xarray.Dataset, origin: str, name: str, setup: Any) -> Any:
    """Return a field of all shots in SI units, lazily, by one setup for each or for all."""
    data = dataset[origin].data
    if "setup" not in dataset:
        return data.map_blocks(_field_of_block, None, name, setup, dtype=np.float64)
    texts = dataset["setup"].data[(..., *[np.newaxis] * (data.ndim - 1))]
    return data.map_blocks(
        _field_of_block, texts, name, setup, dtype=np.float64, chunks=data.chunks
    )


def _field_of_block(block: AnyArray, texts: AnyArray | None, name: str, setup: Any) -> FloatArray:
    from napari_shadowinv.physics.setup import setup_from_dict

    setups = [setup] * len(block)
    if texts is not None:
        # A shot that is not done yet is NaN with any setup.
        setups = [setup_from_dict(json.loads(text)) if text else setup for text in texts.flat]
    pairs = zip(setups, block, strict=True)
    return np.stack([shot_setup.field_in_si(name, values) for shot_setup, values in pairs])
