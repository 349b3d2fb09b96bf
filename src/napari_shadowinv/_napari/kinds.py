"""Kinds of layers of a result, their names, and the kinds shown by default."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from napari_shadowinv._napari.layer_metadata import (
    belongs_to_result,
    layer_key,
    metadata_of,
    role_of,
)

_LayerData = tuple[Any, dict[str, Any], str]


@dataclass(frozen=True)
class Kind:
    """A kind of layer; the setup sets ``{unit}`` and ``{symbol}`` in a title."""

    role: str
    variable: str
    title: str
    unit: str = ""
    colormap: str = ""
    type: str = "image"
    visible: bool = False
    main: bool = False  # shown by default; the others by *More layers*
    shown_of: Literal["shot", "stack", "both"] = "both"


KINDS = (
    Kind("image", "image", "image", "flux/px²", "gray"),
    Kind("source", "source", "source", "flux/px²", "gray", shown_of="shot"),
    Kind("reprojection", "reprojection", "re-projection", "flux/px²", "gray"),
    Kind("residual", "residual", "residual (% of mean)", "%", "RdBu_r", main=True, shown_of="shot"),
    Kind("residual", "residual", "residual", "flux/px²", "RdBu_r", main=True, shown_of="stack"),
    Kind("potential", "potential", "potential ({unit})", colormap="viridis"),
    Kind("field y", "displacement", "{symbol} ({unit})", colormap="RdBu_r"),
    Kind("field x", "displacement", "{symbol} ({unit})", colormap="RdBu_r"),
    Kind("field", "displacement", "{symbol} ({unit})", colormap="inferno", visible=True, main=True),
    Kind(
        "uncertainty",
        "displacement_uncertainty",
        "σ of {symbol} ({unit})",
        colormap="magma",
        main=True,
        shown_of="shot",
    ),
    Kind("caustic", "caustic", "caustics", type="labels", main=True),
    Kind("field arrows", "displacement", "{arrows}", type="vectors", shown_of="shot"),
    Kind(
        "arrows",
        "displacement",
        "displacement arrows",
        "px",
        type="vectors",
        visible=True,
        main=True,
    ),
    Kind("sites", "sites", "sites{share}", colormap="inferno", type="points", shown_of="shot"),
    Kind("cells", "sites", "power cells", type="shapes", main=True, shown_of="shot"),
)
_MAIN_ROLES = {kind.role for kind in KINDS if kind.main}
MASKED_ROLES = {"reprojection", "residual", "potential", "field y", "field x", "field"}
MASKED_ROLES |= {"uncertainty"}


def main_layers(layer_data: Sequence[_LayerData], also: Collection[str] = ()) -> list[_LayerData]:
    """Select the layers shown by default, and layers whose keys are in `also`."""
    return [
        layer
        for layer in layer_data
        if role_of(layer[1]) in _MAIN_ROLES
        or metadata_of(layer[1]).get("main", not belongs_to_result(layer[1]))
        or layer_key(layer[1]) in also
    ]


def layer_name(title: str, name: str) -> str:
    """Name a layer by its quantity, then its result: napari cuts long names in the middle."""
    return f"{title} – {name}" if name else title
