"""What a layer of this plugin knows about itself, kept in its metadata.

- write it: `mark`
- read it from a layer: `role_of`, `unit_of`, `setup_of`, `result_of`, `source_of`
- everything behind the layers of one result: `Result`

Layers carry only the units of their axes; the unit of their values, the setup and the result
that they show are in ``layer.metadata["napari-shadowinv"]``, a plain dict.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    import xarray

    from napari_shadowinv.inversion import Inversion
    from napari_shadowinv.physics.setup import OpticalSetup, ProtonSetup

__all__ = [
    "KEY",
    "Result",
    "mark",
    "mark_of",
    "result_of",
    "role_of",
    "setup_of",
    "source_of",
    "unit_of",
]

KEY = "napari-shadowinv"


@dataclass(frozen=True, eq=False)
class Result:
    """What the layers of one result show, whole: all that is needed to write it.

    Attributes
    ----------
    content : Inversion or xarray.Dataset
        The result; a dataset where a file holds no more than a field.
    setup : ProtonSetup or OpticalSetup or None
        The experiment.
    attributes : mapping of str to str
        Which files it was made from, as `napari_shadowinv.io.provenance` tells.
    """

    content: Inversion | xarray.Dataset
    setup: ProtonSetup | OpticalSetup | None = None
    attributes: Mapping[str, str] = field(default_factory=dict)


def mark(
    role: str,
    unit: str,
    setup: ProtonSetup | OpticalSetup | None = None,
    **more: Any,
) -> dict[str, Any]:
    """Make the metadata of a layer.

    Parameters
    ----------
    role : str
        What it shows: ``"image"``, ``"source"``, ``"potential"``, ``"field"``, ``"sites"``, …
    unit : str
        Unit of its values; empty if they have none.
    setup : ProtonSetup or OpticalSetup, optional
        The experiment.
    **more
        Other facts, such as ``result`` (a `Result`) or ``source`` (an array).

    Returns
    -------
    dict
        To be passed to a layer as `metadata`.
    """
    described = {} if setup is None else {"setup": setup.model_dump()}
    return {KEY: {"role": role, "unit": unit, **described, **more}}


def mark_of(layer: Any) -> dict[str, Any]:
    """Return what a layer knows about itself; empty for a layer of other origin.

    Parameters
    ----------
    layer : napari.layers.Layer or mapping
        A layer, or the keywords of one.

    Returns
    -------
    dict
        With ``role`` and ``unit`` at least, if it is a layer of this plugin.
    """
    metadata = layer.get("metadata") if isinstance(layer, Mapping) else layer.metadata
    found = (metadata or {}).get(KEY)
    return found if isinstance(found, dict) else {}


def role_of(layer: Any) -> str | None:
    """Return what a layer shows, such as ``"potential"``; None for a layer of other origin."""
    return mark_of(layer).get("role")


def unit_of(layer: Any) -> str:
    """Return the unit of a layer's values; empty where it is unknown."""
    return str(mark_of(layer).get("unit", ""))


def setup_of(layer: Any) -> ProtonSetup | OpticalSetup | None:
    """Return the experiment that a layer belongs to, None where it is unknown."""
    from napari_shadowinv.physics.setup import setup_from_dict

    found = mark_of(layer).get("setup")
    return None if found is None else setup_from_dict(found, "the layer's setup")


def result_of(layer: Any) -> Result | None:
    """Return the result that a layer shows a part of, None for any other layer."""
    found = mark_of(layer).get("result")
    return found if isinstance(found, Result) else None


def source_of(layer: Any) -> NDArray[np.float64] | None:
    """Return the undisturbed beam that came with an image, None if none did."""
    found = mark_of(layer).get("source")
    return None if found is None else np.asarray(found)
