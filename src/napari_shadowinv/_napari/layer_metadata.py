"""What a layer of this plugin knows about itself: a plain dict in its metadata, under `KEY`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from napari_shadowinv._typing import BoolArray, FloatArray

if TYPE_CHECKING:
    import xarray

    from napari_shadowinv.fitting import Fit
    from napari_shadowinv.inversion import Inversion
    from napari_shadowinv.physics.setup import Setup

KEY = "napari-shadowinv"

SHOT, SOURCE, MASK = "shot", "source", "mask"
"""Roles of what goes into an inversion. The layers of a result have roles of their own, and
either the result or its store in their metadata."""

CAME_WITH = "came with"
"""How the origin of a setup begins that a file or a sample brought; all others are the user's."""


@dataclass(frozen=True, eq=False)
class Result:
    """What the layers of one result show, whole: all that is needed to write it."""

    content: Inversion | Fit | xarray.Dataset  # a dataset where a file holds only a field
    setup: Setup | None = None
    attributes: Mapping[str, str] = field(default_factory=dict)  # words about its origin


def mark(role: str | None, unit: str, setup: Setup | None = None, **more: Any) -> dict[str, Any]:
    """Make the metadata of a layer; `role` and `unit` are None and empty where unknown."""
    described = {} if setup is None else {"setup": setup.model_dump()}
    return {KEY: {"role": role, "unit": unit, **described, **more}}


def mark_of(layer: Any) -> dict[str, Any]:
    """Return what a layer, or the keywords of one, tell about it; empty for other origins."""
    metadata = layer.get("metadata") if isinstance(layer, Mapping) else layer.metadata
    found = (metadata or {}).get(KEY)
    return found if isinstance(found, dict) else {}


def role_of(layer: Any) -> str | None:
    """Return what a layer shows, such as ``"potential"``; None for a layer of other origin."""
    return mark_of(layer).get("role")


def slot_of(layer: Any) -> str:
    """Return what tells a layer from all others of its result: its role, and its `part`, if any."""
    return f"{role_of(layer)} {mark_of(layer).get('part', '')}".strip()


def unit_of(layer: Any) -> str:
    """Return the unit of a layer's values; empty where it is unknown."""
    return str(mark_of(layer).get("unit", ""))


def setup_of(layer: Any) -> Setup | None:
    """Return the experiment that a layer belongs to, None where it is unknown."""
    from napari_shadowinv.physics.setup import setup_from_dict

    found = mark_of(layer).get("setup")
    return None if found is None else setup_from_dict(found, "the layer's setup")


def setup_origin_of(layer: Any) -> str:
    """Return where a layer's setup comes from, such as ``"came with shot.h5"``; empty if none."""
    return str(mark_of(layer).get("setup_origin", ""))


def keep_setup(layer: Any, setup: Setup | None, origin: str) -> None:
    """Make a setup, which comes from `origin`, the one of a layer; None takes it away."""
    # A new dict: a duplicate of the layer may share the old one.
    known = dict(mark_of(layer))
    known.pop("setup", None)
    known.pop("setup_origin", None)
    given = {} if setup is None else {"setup": setup.model_dump(), "setup_origin": origin}
    layer.metadata[KEY] = known | given


def may_be_shot(layer: Any) -> bool:
    """Whether a layer is a shot, or may be one; of a result's layers only its image."""
    return role_of(layer) in (None, SHOT, "image")


def may_be_source(layer: Any) -> bool:
    """Whether a layer may be an undisturbed beam: also a shot, of which the object was taken."""
    return role_of(layer) in (None, SHOT, SOURCE)


def may_be_mask(layer: Any) -> bool:
    """Whether somebody may have painted a layer to mark pixels; a result has labels, too."""
    return role_of(layer) in (None, MASK)


def result_of(layer: Any) -> Result | None:
    """Return the result that a layer shows a part of, None for any other layer."""
    found = mark_of(layer).get("result")
    return found if isinstance(found, Result) else None


def belongs_to_result(layer: Any) -> bool:
    """Whether a layer shows a part of a result, or of a store of results."""
    return not {"result", "store"}.isdisjoint(mark_of(layer))


def displacement_of(layer: Any) -> FloatArray | None:
    """Return the displacement in px that a layer of a result stands for, None for any other."""
    result, own = result_of(layer), mark_of(layer).get("displacement")
    if own is not None or result is None:
        return own
    content: Any = result.content
    found = getattr(content, "displacement", None)  # a film pack has none
    return None if found is None else np.asarray(found)


def usable_of(layer: Any) -> BoolArray | None:
    """Return the usable pixels that came with an image, None if all are, or nobody knows."""
    found = mark_of(layer).get("usable")
    return None if found is None else np.asarray(found, dtype=np.bool_)


def source_of(layer: Any) -> FloatArray | None:
    """Return the undisturbed beam that came with an image, None if none did."""
    found = mark_of(layer).get("source")
    return None if found is None else np.asarray(found)
