"""Results as napari layers, of one shot or of a stack of shots; the lowest layer comes first."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from napari_shadowinv._napari.frame import Frame, frame_for
from napari_shadowinv._napari.kinds import KINDS, MASKED_ROLES, Kind, layer_name, main_layers
from napari_shadowinv._napari.layer_metadata import (
    KEY,
    Result,
    mark,
    role_of,
)
from napari_shadowinv._napari.sites import Cells, power_cells, site_features
from napari_shadowinv._napari.viewer_sync import keep_in_step, show_scale_bar
from napari_shadowinv._typing import AnyArray, BoolArray, FloatArray
from napari_shadowinv.inversion.labels import VARIABLES
from napari_shadowinv.io.store_setups import of_each_setup
from napari_shadowinv.physics.units import (
    ShownField,
    intensity_limits,
    shown_fields,
    shown_potential,
)

if TYPE_CHECKING:
    import xarray

    from napari_shadowinv.inversion import Inversion
    from napari_shadowinv.physics.setup import Setup

FullLayerData = tuple[Any, dict[str, Any], str]
Limits = tuple[float, float]

# Both stand out of every colour of the field's map.
_CAUSTIC_COLOUR = "#5dff5d"
_ARROW_COLOURS = {"arrows": "#00c8ff", "field arrows": "#ffffff"}

_OF_A_FIELD = ("displacement", "potential")
_ARROWS_ALONG = 28
_SHORTEST_ARROW = 0.05
_MOST_SITES_SHOWN = 200_000
_BRIGHTEST = 99.7  # percentile
_ENOUGH_PIXELS = 100_000


def inversion_layers(
    inversion: Inversion,
    setup: Setup | None = None,
    *,
    name: str = "",
    cells: bool = False,
    attributes: Mapping[str, str] | None = None,
    **place: Any,
) -> list[FullLayerData]:
    """Describe the layers of a result; the keywords are those of `add_inversion`."""
    setup = inversion.setup if setup is None else setup
    frame = frame_for(inversion.potential.shape, setup, **place)
    return result_layers(Result(inversion, setup, dict(attributes or {})), frame, name, cells=cells)


def add_inversion(
    viewer: Any,
    inversion: Inversion,
    setup: Setup | None = None,
    *,
    name: str = "",
    all_layers: bool = False,
    **keywords: Any,
) -> list[Any]:
    """Add the layers of a result to a viewer, with a scale bar.

    The strength of the field and the arrows are visible; residual, caustics and the uncertainty
    are hidden.

    Parameters
    ----------
    viewer : napari.Viewer or napari.components.ViewerModel
        Where to add them; a `ViewerModel` needs neither a window nor a display.
    inversion : Inversion
    setup : Setup, optional
        Gives pixel size and SI units; default: that of the inversion's provenance, if any.
    name : str
        Name of the shot; the layers' names end with it.
    all_layers : bool
        Add all of the result, hidden: also image, source, re-projection, potential, components,
        field arrows and sites.
    **keywords
        ``scale``, ``translate``, ``units`` (in axis order y, x): place of the image in the world,
        where it is not the setup's, such as those of the layer that it was cropped from.
        ``cells`` (bool): whether to add the power cells as polygons, for up to 5,000 sites.
        ``attributes`` (mapping of str to str): words about its origin, kept for writing.

    Returns
    -------
    list of napari.layers.Layer
        The new layers, the lowest first.

    Raises
    ------
    InputError
        If cells are asked for and there are too many.

    Examples
    --------
    The names say that nothing deflects the rays of a blank image:

    >>> from napari.components import ViewerModel
    >>> from napari_shadowinv import invert
    >>> viewer = ViewerModel()
    >>> layers = add_inversion(viewer, invert(np.ones((20, 20))), name="blank")
    >>> [layer.name for layer in layers if layer.visible]
    ['|d| (px) – blank (doubtful)', 'displacement arrows – blank (doubtful)']
    """
    described = inversion_layers(inversion, setup, name=name, **keywords)
    return add_layers(viewer, described if all_layers else main_layers(described))


def add_layers(
    viewer: Any, described: Sequence[FullLayerData], *, below: Any | None = None
) -> list[Any]:
    """Add layers on top or below a layer, select the field, switch on scale bar and colour bar."""
    from napari.layers import Layer

    added = [Layer.create(*layer) for layer in described]
    for layer in added:
        place = len(viewer.layers) if below is None else viewer.layers.index(below)
        viewer.layers.insert(place, layer)
    for layer in added:
        if role_of(layer) in ("field", "fluence"):
            # The status line then tells the value below the mouse.
            viewer.layers.selection.active = layer
    show_scale_bar(viewer)
    keep_in_step(viewer)
    return added


def result_layers(
    result: Result, frame: Frame, name: str = "", *, cells: bool = False
) -> list[FullLayerData]:
    """Describe the layers of an inversion or of a mere field; with `cells`, its power cells."""
    import xarray as xr

    from napari_shadowinv.inversion import Inversion

    content = result.content
    facts = {"result": result, "made_from": dict(result.attributes), "name": name}
    if isinstance(content, xr.Dataset):
        field = content[[variable for variable in _OF_A_FIELD if variable in content]]
        return dataset_layers(field, result.setup, frame, name, facts)
    assert isinstance(content, Inversion)
    dataset = xr.Dataset(
        {name: (dims, getattr(content, name)) for name, (dims, _, _) in VARIABLES.items()}
    )
    diagram = power_cells(content) if cells else None
    described = dataset_layers(
        dataset,
        result.setup,
        frame,
        name,
        facts,
        cells=diagram,
        doubt=doubt_of_inversion(content),
    )
    for _, keywords, _ in described:
        if role_of(keywords) == "image":
            # With its beam and mask it can be inverted again.
            usable = None if content.mask.all() else content.mask
            keywords["metadata"][KEY] |= {"source": content.source, "usable": usable}
    return described


def doubt_of_inversion(inversion: Inversion) -> str:
    """Return the mark in the names of layers that must not be trusted blindly, or nothing."""
    from napari_shadowinv.facts import Level

    level = inversion.headline.level
    return "" if level is Level.SOUND else f"({level.value})"


def dataset_layers(
    dataset: xarray.Dataset,
    setup: Setup | None,
    frame: Frame,
    name: str,
    facts: Mapping[str, Any],
    shot: int | None = None,
    cells: Cells | None = None,
    deflector: str | None = None,
    doubt: str = "",
) -> list[FullLayerData]:
    """Describe the layers of a result, or of a stack in the units and contrast of one `shot`.

    All names end with `doubt`.
    """
    shown = _Shown(dataset, setup, shot, cells, deflector)
    layers = []
    for kind in KINDS:
        if not shown.has(kind):
            continue
        data, words, look = _CONTENTS[kind.type](shown, kind)
        if kind.role in MASKED_ROLES and shown.masked is not None:
            data = _where(shown.masked, np.nan, data)
        unit = words.get("unit", kind.unit)
        keywords = {
            "name": f"{layer_name(kind.title.format(**words), name)} {doubt}".rstrip(),
            "metadata": mark(kind.role, unit, setup, **facts),
            "visible": kind.visible,
            **frame.keywords(stacked=shot is not None),
            **look,
        }
        layers.append((data, keywords, kind.type))
    return layers


@dataclass
class _Shown:
    """A result, or a stack of which one shot decides on units and contrast."""

    dataset: xarray.Dataset
    setup: Setup | None
    shot: int | None
    cells: Cells | None
    deflector: str | None = None

    def has(self, kind: Kind) -> bool:
        if kind.shown_of == ("shot" if self.shot is not None else "stack"):
            return False
        if not self.along_shots(kind.variable):
            return False
        if kind.role == "field arrows":
            return bool(self.field.arrows)
        if kind.role == "cells":
            return self.cells is not None
        return kind.role != "source" or bool(np.ptp(self.plane("source")))

    def along_shots(self, variable: str) -> bool:
        """Whether there is a variable, in a stack one of each shot."""
        found = self.dataset.get(variable)
        return found is not None and (self.shot is None or "shot" in found.dims)

    def plane(self, variable: str) -> FloatArray:
        """Values in one shot, as numbers."""
        values = self.dataset[variable]
        one = values if self.shot is None else values.isel(shot=self.shot)
        return np.asarray(one, dtype=np.float64)

    @cached_property
    def masked(self) -> Any | None:
        """Pixels without data: of the shot, or of all shots, lazily; None if there are none."""
        mask = self.dataset.get("mask")
        if mask is None or (self.shot is not None and "shot" not in mask.dims and mask.all()):
            return None
        return None if self.shot is None and bool(mask.all()) else ~mask.data.astype(bool)

    @cached_property
    def used(self) -> BoolArray:
        """Pixels with data, in one shot."""
        if self.masked is None:
            return np.ones(self.dataset["displacement"].shape[-2:], dtype=np.bool_)
        plane = self.masked[self.shot] if self.masked.ndim == 3 else self.masked
        return ~np.asarray(plane)

    @cached_property
    def field(self) -> ShownField:
        (field,) = shown_fields([self.plane("displacement")], self.setup, self.deflector)
        return field

    @cached_property
    def magnitude(self) -> FloatArray:
        return self.field.magnitude

    @property
    def per_pixel(self) -> float:
        """Strength of the field, in its unit, that displaces by 1 px."""
        return _ratio(self.magnitude, np.hypot(*self.plane("displacement")))

    @cached_property
    def vectors(self) -> Any:
        """Components (y, x) of the field, in its unit."""
        if self.shot is None:
            return self.field.vectors
        # All fields are linear in the displacement.
        matrix = np.eye(2) if self.setup is None else _field_per_pixel(self.setup)
        first = np.tensordot(matrix, self.plane("displacement"), axes=1)
        matrix = matrix * _ratio(self.field.vectors, first)
        stack = self.dataset["displacement"].transpose("component", "shot", "y", "x").data
        own = self.relative_to_shot(lambda one: float(np.linalg.norm(_field_per_pixel(one))))
        return [
            sum((own * factor) * stack[k] for k, factor in enumerate(row) if factor)
            for row in matrix
        ]

    def relative_to_shot(self, measure: Callable[[Setup], Any]) -> Any:
        """What a setup tells of each shot, relative to `shot`; 1 where all share one setup."""
        of_each = of_each_setup(self.dataset, measure)
        if of_each is None or self.setup is None:
            return 1.0
        return (of_each / measure(self.setup))[:, np.newaxis, np.newaxis]

    @cached_property
    def intensity_limits(self) -> Limits:
        """Contrast that image, source and re-projection share."""
        for name in ("image", "reprojection"):
            if self.along_shots(name):
                return intensity_limits(self.plane(name))
        return 0.0, 1.0


def _field_per_pixel(setup: Setup) -> FloatArray:
    """What a setup's main field (y, x) is of displacements by 1 px along y and along x."""
    return setup.field_in_si(setup.main_field.name, np.eye(2))


Content = tuple[Any, dict[str, str], dict[str, Any]]  # data, words of the title, keywords


def _image(shown: _Shown, kind: Kind) -> Content:
    words: dict[str, str] = {}
    data = shown.dataset[kind.variable].data
    if kind.role == "uncertainty":
        # Whatever the unit, a field is as long as its displacement, but for a factor.
        data = shown.per_pixel * np.hypot(*shown.plane(kind.variable))
        words = {"unit": shown.field.unit, "symbol": shown.field.symbol}
        limits = 0.0, float(np.percentile(data[shown.used], _BRIGHTEST))
    elif kind.variable == "displacement":
        data, limits, words = _field(shown, kind.role)
    elif kind.role == "potential":
        plane = shown.plane("potential")
        values, unit = shown_potential(plane, shown.setup)
        if shown.shot is None:
            data = values
        else:
            own = shown.relative_to_shot(lambda one: float(one.potential(np.ones(1))[0]))
            data = data * (own * _ratio(values, plane))
        used = values[shown.used]
        limits, words = (float(used.min()), float(used.max())), {"unit": unit}
    elif kind.role == "residual":
        if kind.unit == "%":
            used = shown.plane("image")[shown.dataset["mask"].values]
            data = 100 * data / used.mean()
        plane = data if shown.shot is None else shown.plane("residual")
        limits = symmetric_limits(plane)
    else:
        limits = shown.intensity_limits
    return data, words, {"colormap": kind.colormap, "contrast_limits": _opened(limits)}


def _field(shown: _Shown, role: str) -> tuple[Any, Limits, dict[str, str]]:
    """Strength or a component of the field, its limits, its unit and symbol."""
    field = shown.field
    strongest = float(shown.magnitude[shown.used].max())
    if role == "field":
        # On lazy arrays, numpy's functions are dask's.
        data = shown.magnitude if shown.shot is None else np.hypot(*shown.vectors)
        return data, (0.0, strongest), {"unit": field.unit, "symbol": field.symbol}
    axis = "yx".index(role[-1])
    # In another shot of a stack the field may lie along the other axis.
    limit = strongest if shown.shot is not None else _largest(field.vectors, shown.used)
    words = {"unit": field.unit, "symbol": field.components[axis]}
    return shown.vectors[axis], (-limit, limit), words


def _largest(vectors: FloatArray, used: BoolArray) -> float:
    return float(np.abs(vectors[:, used]).max())


def _where(condition: Any, value: float, data: Any) -> Any:
    """Do as `numpy.where`, lazily where either array is lazy."""
    if isinstance(condition, np.ndarray) and isinstance(data, np.ndarray):
        return np.where(condition, value, data)
    from dask import array

    return array.where(condition, value, data)


def _caustics(shown: _Shown, kind: Kind) -> Content:
    from napari.utils.colormaps import CyclicLabelColormap
    from napari.utils.colormaps.standardize_color import transform_color

    # A dictionary of colours would do, but napari compiles code for it, for two seconds.
    colours = transform_color(["transparent", _CAUSTIC_COLOUR])
    look = {"colormap": CyclicLabelColormap(colours), "opacity": 0.5}
    return shown.dataset["caustic"].data.astype(np.uint8), {}, look


def _arrows(shown: _Shown, kind: Kind) -> Content:
    """Vectors of few enough rays that each arrow can be seen."""
    is_field = kind.role == "field arrows"
    vectors = shown.field.vectors if is_field else shown.plane("displacement")
    data, spacing = thinned_arrows(np.where(shown.used, vectors, 0.0))
    lengths = np.hypot(*data[:, 1].T)
    # Most arrows keep to their own place; the strongest reach to the next but one at most.
    usual = max(np.percentile(lengths, 95), 0.5 * lengths.max()) if len(lengths) else 0.0
    look = {
        "features": {"field" if is_field else "displacement": lengths},
        "vector_style": "arrow",
        "edge_color": _ARROW_COLOURS[kind.role],
        "edge_width": spacing / 9,
        # The data keep their unit; only the drawing is stretched.
        "length": float(0.95 * spacing / usual) if usual else 1.0,
        "opacity": 0.75,
    }
    words = {"unit": shown.field.unit, "arrows": shown.field.arrows} if is_field else {}
    return data if shown.shot is None else at_shot(data, shown.shot), words, look


def thinned_arrows(field: FloatArray) -> tuple[FloatArray, float]:
    """Pick long enough vectors (y, x) on a grid: starts and vectors (n, 2, 2), and the spacing."""
    height, width = field.shape[1:]
    step = max(1, -(-max(height, width) // _ARROWS_ALONG))
    rows, columns = (
        index.ravel() for index in np.mgrid[step // 2 : height : step, step // 2 : width : step]
    )
    starts = np.column_stack([rows, columns])
    data = np.stack([starts, field[:, rows, columns].T], axis=1).astype(np.float64)
    lengths = np.hypot(*data[:, 1].T)
    return data[lengths > _SHORTEST_ARROW * lengths.max(initial=0.0)], float(step)


def at_shot(arrows: FloatArray, shot: int) -> FloatArray:
    """Return arrows of a plane, shape (n, 2, 2), as those of a shot, shape (n, 2, 3)."""
    stacked = np.zeros((len(arrows), 2, 3))
    stacked[:, 0, 0] = shot
    stacked[:, :, 1:] = arrows
    return stacked


def _sites(shown: _Shown, kind: Kind) -> Content:
    sites = shown.dataset["sites"].values
    every = -(-len(sites) // _MOST_SITES_SHOWN)
    features = {key: values[::every] for key, values in site_features(shown.dataset).items()}
    spacing = (shown.dataset["potential"].size / len(sites)) ** 0.5
    look = {
        "features": features,
        "face_color": "displacement",
        "face_colormap": kind.colormap,
        "face_contrast_limits": _opened((0.0, float(features["displacement"].max(initial=0.0)))),
        "border_width": 0.0,
        "size": 0.7 * spacing * every**0.5,
        "symbol": "disc",
    }
    return sites[::every], {"share": "" if every == 1 else f" (1 in {every})"}, look


def _cells(shown: _Shown, kind: Kind) -> Content:
    polygons, kept = shown.cells or ([], [])
    look = {
        "shape_type": "polygon",
        "features": {key: values[kept] for key, values in site_features(shown.dataset).items()},
        "face_color": "transparent",
        "edge_color": _CAUSTIC_COLOUR,
        "edge_width": 0.05,
        "opacity": 0.7,
    }
    return polygons, {}, look


_CONTENTS: dict[str, Callable[[_Shown, Kind], Content]] = {
    "image": _image,
    "labels": _caustics,
    "vectors": _arrows,
    "points": _sites,
    "shapes": _cells,
}


def _ratio(shown: FloatArray, plane: FloatArray) -> float:
    """Factor between two planes that differ by a factor only."""
    largest = np.unravel_index(np.argmax(np.abs(plane)), plane.shape)
    return float(shown[largest] / plane[largest]) if plane[largest] else 1.0


def symmetric_limits(residual: AnyArray) -> Limits:
    """Return limits around 0 that a handful of pixels at a caustic cannot blow up."""
    limit = float(np.nanpercentile(np.abs(_sample(residual)), _BRIGHTEST))
    return _opened((-limit, limit))


def _sample(plane: AnyArray) -> AnyArray:
    """Enough pixels of a large image for its limits."""
    step = max(1, int(np.sqrt(plane.size / _ENOUGH_PIXELS)))
    return plane[::step, ::step]


def _opened(limits: Limits) -> Limits:
    """Return limits with something between them, also where all values are one."""
    low, high = limits
    return (low, high) if high > low else (low, low + 1.0)
