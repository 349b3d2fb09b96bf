"""What an image can be predicted from, other than a phantom: potentials and results.

- which layers are offered: `may_be_a_field`, `is_surely_a_field`
- what a layer holds, for a job: `known_field`, with a `KnownField` as the answer
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from napari_shadowinv._napari.layer_metadata import (
    may_be_shot,
    result_of,
    role_of,
    setup_of,
    unit_of,
)
from napari_shadowinv._napari.widgets._quantities import parsed
from napari_shadowinv._napari.widgets._reading import image_of, shown_plane
from napari_shadowinv.errors import InputError

if TYPE_CHECKING:
    from napari_shadowinv.physics.setup import Setup

__all__ = ["KnownField", "is_surely_a_field", "known_field", "may_be_a_field"]

_FIELDS = ("field", "field y", "field x")


@dataclass(frozen=True, eq=False)
class KnownField:
    """A potential or a displacement.

    Attributes
    ----------
    values : array_like, shape (H, W) or (2, H, W)
        The potential, or the displacement in px.
    to_px2 : float
        Factor that brings the potential to px².
    made_with : Setup or None
        The experiment that it belongs to, where the layer knows it.
    text : str
        What it is taken for, in a sentence.
    """

    values: ArrayLike
    to_px2: float
    made_with: Setup | None
    text: str


def is_surely_a_field(layer: Any) -> bool:
    """Whether a layer says of itself that it is a potential, or the field of one result."""
    if role_of(layer) == "potential":
        return True
    return role_of(layer) in _FIELDS and result_of(layer) is not None


def may_be_a_field(layer: Any) -> bool:
    """Whether a layer is a field, or an image that does not tell what it is."""
    unknown = may_be_shot(layer) and result_of(layer) is None
    return is_surely_a_field(layer) or (unknown and not getattr(layer, "rgb", False))


def known_field(layer: Any | None, point: Any, setup: Any) -> KnownField:
    """Take what a layer holds.

    Parameters
    ----------
    layer : napari.layers.Image or None
        A potential, a layer of a result, or an image of a potential in px².
    point : sequence of float
        Where the viewer is along all axes: of a stack, the shot in view counts.
    setup : Setup or None
        The experiment of a potential in m that does not know its own.

    Raises
    ------
    InputError
        If there is no such layer, or nothing tells its pixels' size.
    """
    if layer is None:
        raise InputError(
            "there is no potential or result to start from: invert a shot (Plugins → Invert "
            "shot), open a .shadowinv file or an image of a potential in px² (File → Open), or "
            "choose one of the simulated objects"
        )
    result = result_of(layer)
    if result is not None and role_of(layer) in _FIELDS:
        content: Any = result.content
        displacement = np.asarray(
            content["displacement"] if hasattr(content, "data_vars") else content.displacement
        )
        return KnownField(displacement, 1.0, result.setup, "The displacement of this result.")
    potential = shown_plane(layer, point) if layer.ndim == 3 else image_of(layer, "potential")
    unit, own = unit_of(layer), setup_of(layer)
    if role_of(layer) != "potential":
        text = (
            "This image is not labelled as a potential: its values are treated as a potential "
            "in px² of the object plane."
        )
        return KnownField(potential, 1.0, own, text)
    if unit in ("", "px²"):
        return KnownField(potential, 1.0, own, "A potential in px².")
    made_with = own or setup
    if made_with is None:
        raise InputError(
            f"'{layer.name}' is in {unit}: choose the setup of its experiment, which is needed "
            "to convert it to pixels"
        )
    to_px2 = float(made_with.normalized_potential(parsed(f"1 {unit}", "m")))
    return KnownField(potential, to_px2, made_with, f"A potential in {unit}.")
