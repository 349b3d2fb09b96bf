"""Layers of a viewer by their roles."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from napari_shadowinv._napari.layer_metadata import role_of, unit_of


def by_role(layers: Iterable[Any]) -> dict[str, Any]:
    return {str(role_of(layer)): layer for layer in layers}


def layer_of(viewer: Any, role: str, word: str = "") -> Any:
    """Return the only layer with a role, and with a word in its name."""
    matches = [layer for layer in viewer.layers if role_of(layer) == role and word in layer.name]
    assert len(matches) == 1, [layer.name for layer in viewer.layers]
    return matches[0]


def in_its_unit(layer: Any, tesla_metres: Any) -> Any:
    """Convert path-integrated fields to the unit that a layer names."""
    return {"T·m": 1.0, "mT·m": 1e3, "µT·m": 1e6}[unit_of(layer)] * tesla_metres
