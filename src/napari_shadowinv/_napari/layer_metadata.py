"""Metadata of this plugin's layers, a plain dict under `KEY`, and their place.

- the place of a plane, and of derived ones: `Frame`; layers on the pixels of an image:
  `matrix_between`, `mapped`, `pixel_mapper`, `labels_on`, `source_on` (which never resamples)
- the kind of each layer of a result; some kinds are shown by default: `KINDS`, `main_layers`
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Generic, Literal, TypeVar

import numpy as np
from scipy.ndimage import affine_transform

from napari_shadowinv._napari.preferences import colour_map
from napari_shadowinv._typing import BoolArray, FloatArray
from napari_shadowinv.errors import InputError
from napari_shadowinv.facts import Level

if TYPE_CHECKING:
    from napari_shadowinv.physics.setup import Setup
    from napari_shadowinv.results import AnyResult

Matrix = tuple[tuple[float, ...], ...]

_MAX_LENGTH = 0.01  # m; longer sides are in mm


@dataclass(frozen=True)
class Frame:
    """Pixel size, position (of the centre of pixel (0, 0)) and unit of a plane's axes (y, x)."""

    scale: tuple[float, float] = (1.0, 1.0)
    translate: tuple[float, float] = (0.0, 0.0)
    units: tuple[str, str] = ("pixel", "pixel")
    affine: Matrix = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))  # comes after them

    @property
    def matrix(self) -> FloatArray:
        """The matrix from (y, x, 1) in pixels to the world."""
        return np.array(self.affine) @ _upright(self.scale, self.translate)

    def beneath(self, matrix: FloatArray) -> Frame:
        """Return the frame of a derived image; `matrix` maps its (y, x, 1) to (y, x, 1) here."""
        derived = _upright(self.scale, self.translate) @ matrix
        y, x = (float(value) for value in derived[:2, 2])
        dy, dx = (float(side) for side in np.diagonal(derived)[:2])
        if np.array_equal(derived[:2, :2], np.diag([dy, dx])):
            return replace(self, translate=(y, x), scale=(dy, dx))
        dy, dx = (float(side) for side in np.hypot(*derived[:2, :2]))
        turn = derived @ np.linalg.inv(_upright((dy, dx), (y, x)))
        affine = matrix_of(np.array(self.affine) @ turn)
        return replace(self, translate=(y, x), scale=(dy, dx), affine=affine)

    def keywords(self, *, stacked: bool = False, stack_axis: str = "shot") -> dict[str, Any]:
        """Return the keywords that place a layer; `stacked` if an axis of shots comes first."""
        first = int(stacked)
        affine = np.eye(first + 3)
        affine[first:, first:] = self.affine
        return {
            "scale": (1.0, *self.scale) if stacked else self.scale,
            "translate": (0.0, *self.translate) if stacked else self.translate,
            "units": ("pixel", *self.units) if stacked else self.units,
            "axis_labels": (stack_axis, "y", "x") if stacked else ("y", "x"),
            "affine": affine,
        }


def _upright(scale: Sequence[float], translate: Sequence[float]) -> FloatArray:
    """Return the matrix of a scale followed by a translation."""
    matrix = np.diag([*scale, 1.0])
    matrix[:2, 2] = translate
    return matrix


def frame_for(
    shape: Sequence[int], setup: Setup | None, *, pixel_size: float | None = None
) -> Frame:
    """Choose a frame in the preferred unit of length, or in pixels.

    The automatic unit is µm, or mm above 1 cm. `pixel_size` (m) is used without a setup.
    """
    side = pixel_size if setup is None else setup.object_pixel_size
    if side is None:
        return Frame()
    unit, per_m = ("mm", 1e3) if max(shape[-2:]) * side > _MAX_LENGTH else ("um", 1e6)
    pixel = side * per_m
    return Frame(scale=(pixel, pixel), units=(unit, unit))


def frame_of(layer: Any) -> Frame:
    """Return the frame of a layer's last two axes."""
    translate = np.array(layer.translate[-2:])
    turn = np.eye(3)
    turn[:2, :2] = layer.rotate[-2:, -2:] @ [[1.0, layer.shear[-1]], [0.0, 1.0]]
    turn[:2, 2] = translate - turn[:2, :2] @ translate
    return Frame(
        scale=tuple(float(value) for value in layer.scale[-2:]),  # type: ignore[arg-type]
        translate=tuple(float(value) for value in translate),  # type: ignore[arg-type]
        units=tuple(str(unit) for unit in layer.units[-2:]),  # type: ignore[arg-type]
        affine=matrix_of(layer.affine.affine_matrix[-3:, -3:] @ turn),
    )


def matrix_of(values: Any) -> Matrix:
    """Return the rows of a matrix as tuples, which can be compared."""
    return tuple(tuple(float(value) for value in row) for row in values)


_LayerTuple = tuple[Any, dict[str, Any], str]


@dataclass(frozen=True)
class Kind:
    """A kind of layer; the setup sets ``{unit}`` and ``{symbol}`` in a title.

    `colormap` is a quantity of `preferences.colour_map`.
    """

    role: str
    variable: str
    title: str
    unit: str = ""
    colormap: str = ""
    type: str = "image"
    visible: bool = False
    main: bool = False  # shown by default, as visible ones are; the others by *More layers*
    shown_of: Literal["shot", "stack", "both"] = "both"

    def layer(
        self,
        data: Any,
        name: str,
        frame: Frame,
        setup: Setup | None,
        look: Mapping[str, Any],
        /,
        *,
        words: Mapping[str, str] = MappingProxyType({}),
        stack_axis: str = "",
        level: Level | None = None,
        **facts: Any,
    ) -> _LayerTuple:
        """Describe a layer of a result, of which `name` is the shot's; `words` are in its title."""
        has_colours = self.type == "image" and self.colormap
        keywords = {
            "name": layer_name(self.title.format(**words), name, level),
            "metadata": metadata_for(self.role, words.get("unit", self.unit), setup, **facts),
            "visible": self.visible,
            **({"colormap": colour_map(self.colormap)} if has_colours else {}),
            **frame.keywords(stacked=bool(stack_axis), stack_axis=stack_axis),
            **look,
        }
        return data, keywords, self.type


KINDS = (
    Kind("image", "image", "image", "flux/px²", "image"),
    Kind("source", "source", "source", "flux/px²", "image", shown_of="shot"),
    Kind("reprojection", "reprojection", "re-projection", "flux/px²", "image"),
    Kind("residual", "residual", "residual (% of mean)", "%", "signed", main=True, shown_of="shot"),
    Kind("residual", "residual", "residual", "flux/px²", "signed", main=True, shown_of="stack"),
    Kind("potential", "potential", "potential ({unit})", colormap="potential"),
    Kind("field y", "displacement", "{symbol} ({unit})", colormap="signed"),
    Kind("field x", "displacement", "{symbol} ({unit})", colormap="signed"),
    Kind("direction", "displacement", "direction of {symbol}", shown_of="shot"),
    Kind("field", "displacement", "{symbol} ({unit})", colormap="field", visible=True),
    Kind(
        "uncertainty",
        "displacement_uncertainty",
        "σ of {symbol} ({unit})",
        colormap="uncertainty",
        main=True,
        shown_of="shot",
    ),
    Kind("caustic", "caustic", "caustics", type="labels", main=True),
    Kind("arrows", "displacement", "displacement arrows", "px", type="vectors", visible=True),
    Kind("sites", "sites", "sites{share}", colormap="field", type="points", shown_of="shot"),
)
_MAIN_ROLES = {kind.role for kind in KINDS if kind.main or kind.visible}


def main_layers(layer_data: Sequence[_LayerTuple], also: Collection[str] = ()) -> list[_LayerTuple]:
    """Select the layers shown by default, and layers whose keys are in `also`."""
    return [
        layer
        for layer in layer_data
        if role_of(layer[1]) in _MAIN_ROLES
        or metadata_of(layer[1]).get("main", not belongs_to_result(layer[1]))
        or layer_key(layer[1]) in also
    ]


_MARKS = {
    Level.SOUND: "✓ ",
    Level.CONDITIONAL: "± ",
    Level.DOUBTFUL: "? ",
    Level.FAILED: "✗ ",
}


def layer_name(title: str, name: str, level: Level | None = None) -> str:
    """Name a layer by its quantity, then its result: napari cuts long names in the middle."""
    mark = "" if level is None else _MARKS[level]
    return f"{mark}{title} – {name}" if name else f"{mark}{title}"


KEY = "napari-shadowinv"

SHOT, SOURCE, MASK = "shot", "source", "mask"
"""Roles of inputs of an inversion. Layers of a result have other roles, and the result or its store
in their metadata."""

CAME_WITH = "came with"
"""Start of the origin of a setup from a file or sample; other setups are the user's."""


Content = TypeVar("Content", bound="AnyResult", covariant=True)


@dataclass(frozen=True, eq=False)
class Result(Generic[Content]):
    """The complete result that its layers show, with everything needed to save it."""

    content: Content
    origins: Mapping[str, str] = field(default_factory=dict)  # rows of its report: title, text


def metadata_for(
    role: str | None, unit: str, setup: Setup | None = None, **more: Any
) -> dict[str, Any]:
    """Return the metadata of a layer; an unknown role is None, an unknown unit empty."""
    entries = {} if setup is None else {"setup": setup}
    return {KEY: {"role": role, "unit": unit, **entries, **more}}


def kind_of(layer: Any) -> str:
    """Return a layer's type, such as ``"image"`` or ``"labels"``."""
    # Not by type(): a widget may get a proxy, whose class is its content's only here.
    return str(layer.__class__.__name__).lower()


def data_of(layer: Any) -> Any:
    """Return a layer's data, of a pyramid of images the largest."""
    return layer.data[0] if getattr(layer, "multiscale", False) else layer.data


def metadata_of(layer: Any) -> dict[str, Any]:
    """Return this plugin's metadata of a layer or of its keywords; empty for other layers."""
    metadata = layer.get("metadata") if isinstance(layer, Mapping) else layer.metadata
    entries = (metadata or {}).get(KEY)
    return entries if isinstance(entries, dict) else {}


def role_of(layer: Any) -> str | None:
    """Return the role of a layer, such as ``"potential"``; None for other layers."""
    return metadata_of(layer).get("role")


def layer_key(layer: Any) -> str:
    """Return the key of a layer in its result: its role and, if any, its `part`."""
    return f"{role_of(layer)} {metadata_of(layer).get('part', '')}".strip()


def unit_of(layer: Any) -> str:
    """Return the unit of a layer's values; empty where it is unknown."""
    return str(metadata_of(layer).get("unit", ""))


def setup_of(layer: Any) -> Setup | None:
    """Return the setup of a layer, or None."""
    setup: Setup | None = metadata_of(layer).get("setup")
    return setup


def setup_origin_of(layer: Any) -> str:
    """Return where a layer's setup comes from, such as ``"came with shot.h5"``; empty if none."""
    return str(metadata_of(layer).get("setup_origin", ""))


def store_setup(layer: Any, setup: Setup | None, origin: str) -> None:
    """Store a setup and its origin with a layer; None removes the setup."""
    # A new dict: a duplicate of the layer may share the old one.
    entries = dict(metadata_of(layer))
    entries.pop("setup", None)
    entries.pop("setup_origin", None)
    if setup is not None:
        entries |= {"setup": setup, "setup_origin": origin}
    layer.metadata[KEY] = entries


def may_be_shot(layer: Any) -> bool:
    """Whether a layer may be a shot; of a result's layers only its image."""
    return role_of(layer) in (None, SHOT, "image")


def may_be_source(layer: Any) -> bool:
    """Whether a layer may be an undisturbed beam, including a shot without the object."""
    return role_of(layer) in (None, SHOT, SOURCE)


def is_estimate(layer: Any) -> bool:
    """Whether a layer is a source that was estimated from a shot."""
    return role_of(layer) == SOURCE and "estimate" in metadata_of(layer).get("made_from", {})


def may_be_mask(layer: Any) -> bool:
    """Whether a layer may be a painted mask, unlike the labels of a result."""
    return role_of(layer) in (None, MASK)


def result_of(layer: Any) -> Result[AnyResult] | None:
    """Return the result that a layer belongs to, or None."""
    result = metadata_of(layer).get("result")
    return result if isinstance(result, Result) else None


def layers_of(viewer: Any, layer: Any) -> list[Any]:
    """Return the layers of a viewer that show the same result, or the same store, as a layer."""

    def shown(each: Any) -> tuple[Any, Any]:
        return result_of(each), metadata_of(each).get("store")

    return [each for each in viewer.layers if shown(each) == shown(layer)]


def belongs_to_result(layer: Any) -> bool:
    """Whether a layer belongs to a result or to a store of results."""
    return not {"result", "store"}.isdisjoint(metadata_of(layer))


def displacement_of(layer: Any) -> FloatArray | None:
    """Return the displacement in px behind a layer of a result, or None."""
    content = getattr(result_of(layer), "content", None)
    common = getattr(content, "displacement", None)  # a film pack has none, a fit several
    displacement = metadata_of(layer).get("displacement", common)
    return None if displacement is None else np.asarray(displacement)


def usable_of(layer: Any) -> BoolArray | None:
    """Return the usable pixels that came with an image, or None."""
    usable = metadata_of(layer).get("usable")
    return None if usable is None else np.asarray(usable, dtype=np.bool_)


def source_of(layer: Any) -> FloatArray | None:
    """Return the undisturbed beam that came with an image, or None."""
    source = metadata_of(layer).get("source")
    return None if source is None else np.asarray(source)


_MAX_OFFSET_PX = 0.1  # of a beam from whole pixels


def matrix_between(layer: Any, image: Any) -> FloatArray:
    """Return the matrix from (y, x, 1) in pixels of a layer to those of an image."""
    return (
        np.linalg.inv(frame_of(image).matrix) @ _unit_ratios(layer, image) @ frame_of(layer).matrix
    )


def mapped(matrix: FloatArray, points: Any) -> FloatArray:
    """Return points (n, 2) after a matrix; of points with more axes the last two count."""
    return np.asarray(points)[:, -2:] @ matrix[:2, :2].T + matrix[:2, 2]


def pixel_mapper(image: Any, drawn: Any) -> Callable[[Any], Any]:
    """Return the function from world points of a drawn layer to an image's pixels."""
    matrix = np.linalg.inv(frame_of(image).matrix) @ _unit_ratios(drawn, image)
    return lambda points: mapped(matrix, points)


def labels_on(layer: Any, image: Any) -> BoolArray:
    """Return the pixels of an image whose centres lie on painted labels, or an `InputError`."""
    if frame_of(layer) == frame_of(image) and _shape(layer) != _shape(image):
        raise _mismatch("mask", layer, image)
    to_layer, painted = matrix_between(image, layer), (np.asarray(layer.data) != 0).view(np.uint8)
    on_image = affine_transform(
        painted, to_layer[:2], output_shape=_shape(image), order=0, mode="grid-constant"
    )
    return on_image.astype(np.bool_)


def source_on(layer: Any, data: Any, image: Any) -> Any:
    """Return a beam on an image's pixels, or an `InputError`."""
    height, width = _shape(image)
    if frame_of(layer) == frame_of(image) or _is_unplaced(layer, image):
        if _shape(layer) != (height, width):
            raise _mismatch("source", layer, image)
        return data
    matrix = matrix_between(image, layer)
    corners = np.array([[0, 0], [height - 1, 0], [0, width - 1], [height - 1, width - 1]])
    moves = mapped(matrix, corners) - corners
    top, left = np.round(moves[0]).astype(int)
    if np.abs(moves - (top, left)).max() > _MAX_OFFSET_PX:
        raise InputError(
            f"{_sizes('source', layer, image)}: expected pixels that lie on each other; give both "
            "layers the same scale and place (layer controls → transform), or bin one of them"
        )
    below, beyond = data.shape[-2] - top - height, data.shape[-1] - left - width
    if min(top, left, below, beyond) < 0:
        raise InputError(
            f"{_sizes('source', layer, image)}: the source covers only a part of the image; crop "
            "the image, or give both layers the same place (layer controls → transform)"
        )
    return data[..., top : top + height, left : left + width]


def _mismatch(role: str, layer: Any, image: Any) -> InputError:
    """Return the refusal of two sizes at one place: nobody has said which pixels are the same."""
    return InputError(
        f"{_sizes(role, layer, image)}: they must match; crop one of them, or move it to where it "
        "belongs (layer controls → transform)"
    )


def _sizes(role: str, layer: Any, image: Any) -> str:
    return f"the {role} '{layer.name}' has {_size(layer)}, the image '{image.name}' {_size(image)}"


def _size(layer: Any) -> str:
    (height, width), frame = _shape(layer), frame_of(layer)
    dy, dx = frame.scale
    unit = "" if frame.units == Frame().units else f" {layer.units[-1]:~P}"
    place = "" if frame == Frame() else f" (scale {dx:.4g} × {dy:.4g}{unit})"
    return f"{width} × {height} px{place}"


def _shape(layer: Any) -> tuple[int, int]:
    height, width = data_of(layer).shape[-2:]
    return height, width


def _unit_ratios(layer: Any, image: Any) -> FloatArray:
    """Return the matrix between the worlds of two layers; pixels and lengths are mixed as drawn."""
    pairs = zip(layer.units[-2:], image.units[-2:], strict=True)
    ratios = [
        (1 * unit).to(other).magnitude if unit.dimensionality == other.dimensionality else 1.0
        for unit, other in pairs
    ]
    return np.diag([*ratios, 1.0])


def _is_unplaced(layer: Any, image: Any) -> bool:
    """Whether only one of two layers has a place in lengths, and the other none at all."""
    units, other_units = layer.units[-1], image.units[-1]
    is_mixed = units.dimensionality != other_units.dimensionality
    return is_mixed and Frame() in (frame_of(layer), frame_of(image))
