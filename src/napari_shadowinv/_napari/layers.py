"""Results as layers.

- an inversion, with the features of its sites: `result_layers`; in a viewer: `add_to_viewer`
- a fit, with its images: `fit_layers`; a field: `field_layers`
- the doses of a film pack as stacks with a plane for each film: `pack_layers`
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from napari_shadowinv._napari import layer_metadata as about
from napari_shadowinv._napari.layer_metadata import Frame, Kind, Result, frame_for, role_of
from napari_shadowinv._napari.preferences import colour_map
from napari_shadowinv._napari.viewer_sync import connect_viewer, show_scale_bar
from napari_shadowinv._typing import AnyArray, BoolArray, FloatArray
from napari_shadowinv.inversion.error_budget import per_pixel_of
from napari_shadowinv.inversion.variables import VARIABLES
from napari_shadowinv.io.store import field_in_si
from napari_shadowinv.physics.arrays import PLANE, VECTOR
from napari_shadowinv.physics.setup import deflector_titles
from napari_shadowinv.physics.units import (
    ShownField,
    intensity_limits,
    shown_fields,
    shown_potential,
)

if TYPE_CHECKING:
    import xarray

    from napari_shadowinv.film_doses import FilmDoses
    from napari_shadowinv.fitting import Fit
    from napari_shadowinv.inversion import Inversion
    from napari_shadowinv.inversion.result import RetrievedField
    from napari_shadowinv.physics.setup import Setup

FullLayerData = tuple[Any, dict[str, Any], str]
LayerData = list[FullLayerData]
Limits = tuple[float, float]

_ARROW_COLOUR = "#00c8ff"
_LABEL_COLOURS = "#5dff5d", "#00c8ff"

_FIELD_VARIABLES = ("displacement", "potential", "displacement_uncertainty")
_MASKED_VARIABLES = (*_FIELD_VARIABLES, "reprojection", "residual")
_MAX_ARROWS_PER_SIDE = 20
_MIN_ARROW_LENGTH = 0.05  # relative to the longest
_MAX_SHOWN_SITES = 200_000
_LIMITS_PERCENTILE = 99.7
_LIMITS_SAMPLE_SIZE = 100_000  # pixels
_KINDS = {kind.role: kind for kind in about.KINDS if kind.shown_of != "stack"}
_MAX_BEAM_DIFFERENCE = 1e-6  # relative to the mean


def inversion_layers(
    inversion: Inversion,
    setup: Setup | None = None,
    *,
    name: str = "",
    origins: Mapping[str, str] | None = None,
    **placement: Any,
) -> LayerData:
    """Describe the layers of a result, with the keywords of `add_to_viewer`."""
    inversion = inversion if setup is None else inversion.in_units(setup)
    frame = frame_for(inversion.potential.shape, inversion.setup)
    place = {key: tuple(value) for key, value in placement.items() if value is not None}
    result = Result(inversion, dict(origins or {}))
    return result_layers(result, replace(frame, **place), name)


def add_to_viewer(
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
        Sets pixel size and SI units; default: the setup of the inversion's provenance, if any.
    name : str
        Name of the shot; the layers' names end with it.
    all_layers : bool
        Also add the hidden layers: image, source, re-projection, potential, components, direction
        and sites.
    **keywords
        ``scale``, ``translate``, ``units`` (in axis order y, x): placement of the image in the
        world instead of the setup's, such as the placement of the layer it was cropped from.
        ``origins`` (mapping of str to str): where its inputs come from, rows of its report.

    Returns
    -------
    list of napari.layers.Layer
        The new layers, the lowest first.

    Examples
    --------
    A blank image has no field:

    >>> from napari.components import ViewerModel
    >>> from napari_shadowinv import invert
    >>> viewer = ViewerModel()
    >>> layers = add_to_viewer(viewer, invert(np.ones((20, 20))), name="blank")
    >>> [layer.name for layer in layers if layer.visible]
    ['? |d| (px) – blank', '? displacement arrows – blank']
    """
    layer_data = inversion_layers(inversion, setup, name=name, **keywords)
    return add_layers(viewer, layer_data if all_layers else about.main_layers(layer_data))


def add_layers(
    viewer: Any, layer_data: Sequence[FullLayerData], *, below: Any | None = None
) -> list[Any]:
    """Add layers on top or below a layer, select the field, show scale bar and colour bar."""
    from napari.layers import Layer

    added = [Layer.create(*layer) for layer in layer_data]
    for layer in added:
        index = len(viewer.layers) if below is None else viewer.layers.index(below)
        viewer.layers.insert(index, layer)
    present(viewer, added)
    return added


def present(viewer: Any, layers: Sequence[Any]) -> None:
    """Show the scale bar and the colour bar for new layers, and select a visible field of them."""
    fields = [layer for layer in layers if role_of(layer) in ("field", "fluence")]
    if fields:
        # The status line then shows the value below the mouse.
        topmost = reversed(fields)
        viewer.layers.selection.active = max(topmost, key=lambda layer: bool(layer.visible))
    show_scale_bar(viewer)
    connect_viewer(viewer)


def field_layers(result: Result[RetrievedField], frame: Frame, name: str = "") -> LayerData:
    """Describe the layers of a field without images."""
    dataset = result.content.dataset
    field = dataset[[variable for variable in _FIELD_VARIABLES if variable in dataset]]
    facts = {"result": result, "name": name}
    return dataset_layers(View(field, result.content.setup), frame, name, facts)


def result_layers(result: Result[Inversion], frame: Frame, name: str = "") -> LayerData:
    """Describe the layers of an inversion."""
    import xarray as xr

    content = result.content
    variables = {name: (dims, content.variable(name)) for name, (dims, *_) in VARIABLES.items()}
    if (std := per_pixel_of(content.errors)) is not None:
        variables["displacement_uncertainty"] = VECTOR, std
    dataset = xr.Dataset(variables)
    facts = {"result": result, "name": name, "level": content.headline.level}
    layer_data = dataset_layers(View(dataset, content.setup), frame, name, facts)
    for _, keywords, _ in layer_data:
        if role_of(keywords) == "image":
            # With beam and mask, the image can be inverted again.
            usable = None if content.mask.all() else content.mask
            keywords["metadata"][about.KEY] |= {"source": content.source, "usable": usable}
    return layer_data


def fit_layers(
    result: Result[Fit], frame: Frame, name: str, *, with_images: bool = False
) -> LayerData:
    """Describe the layers of a fit, the lowest first; the first of its fields is visible.

    `with_images` as for a file.
    """
    fit = result.content
    facts = {"result": result, "name": name, "level": fit.headline.level}
    layers = _fitted_images(fit, frame, name, facts) if with_images else []
    layers += _predicted_images(fit, frame, name, facts)
    return layers + _fitted_fields(fit, frame, name, facts)


def _fitted_fields(fit: Fit, frame: Frame, name: str, facts: dict[str, Any]) -> LayerData:
    """Describe the fields of a fit, the first on top."""
    import xarray as xr

    layers: LayerData = []
    for m, field in reversed(list(enumerate(fit.fields))):
        variables: dict[str, Any] = {
            "displacement": (VECTOR, field.displacement),
            "potential": (PLANE, field.potential),
        }
        if fit.mask.shape[1:] == field.potential.shape:
            variables["mask"] = PLANE, fit.mask.any(axis=0)
        if (std := per_pixel_of(field.errors)) is not None:
            variables["displacement_uncertainty"] = VECTOR, std
        cause = deflector_titles()[field.name]
        more = facts | {"displacement": field.displacement, "cause": cause}
        more |= {"part": field.name} if m else {}
        title = name if len(fit.fields) == 1 else f"{name} {field.name}"
        view = View(xr.Dataset(variables), fit.setup, deflector=cause)
        for layer in dataset_layers(view, frame, title, more):
            layer[1]["visible"] &= m == 0
            layers.append(layer)
    return layers


def _predicted_images(fit: Fit, frame: Frame, name: str, facts: dict[str, Any]) -> LayerData:
    """Describe hidden layers of the re-projections, the residuals and a non-uniform beam."""
    grey = intensity_limits(fit.images[0])
    means = [image[use].mean() for image, use in zip(fit.images, fit.mask, strict=True)]
    percent = np.where(fit.mask, 100 * fit.residual / np.array(means)[:, None, None], np.nan)
    contents = {"reprojection": (fit.reprojection, grey)}
    contents["residual"] = percent, symmetric_limits(percent[0])
    if np.ptp(fit.source[0]):
        # One plane unless the beams differ in more than their brightness.
        beams = fit.source / fit.source.mean(axis=(1, 2), keepdims=True)
        is_common = np.allclose(beams, beams[0], rtol=_MAX_BEAM_DIFFERENCE)
        contents = {"source": (fit.source[:1] if is_common else fit.source, grey), **contents}
    layers: LayerData = []
    for role, (planes, limits) in contents.items():
        is_stack, look = len(planes) > 1, {"contrast_limits": limits}
        more = facts | {"main": role != "reprojection", "stack_axis": "image" if is_stack else ""}
        data = planes if is_stack else planes[0]
        layers.append(_KINDS[role].layer(data, name, frame, fit.setup, look, **more))
    return layers


def _fitted_images(fit: Fit, frame: Frame, name: str, facts: dict[str, Any]) -> LayerData:
    """Describe a hidden layer of each image, which can be fitted again, a single one inverted."""
    look, is_single = {"contrast_limits": intensity_limits(fit.images[0])}, len(fit.images) == 1
    layers: LayerData = []
    for k, (image, used) in enumerate(zip(fit.images, fit.mask, strict=True)):
        setup = fit.setups[k] if fit.setups else None
        more = facts | {"main": True, "usable": None if used.all() else used}
        if is_single:
            more["source"] = fit.source[k]
        else:
            more |= {"part": str(k + 1)}
        title = name if is_single else f"{name} {k + 1}"
        layers.append(_KINDS["image"].layer(image, title, frame, setup, look, **more))
    return layers


FLUENCE, DOSE, UNUSABLE = "fluence", "dose", "unusable"
PER_AREA = "1/(m² MeV)"

PACK_KINDS = (
    Kind(DOSE, "dose", "dose (Gy)", "Gy", "uncertainty"),
    Kind(FLUENCE, "fluence", f"fluence ({PER_AREA})", PER_AREA, "field", visible=True),
    Kind(UNUSABLE, "usable", "unusable", type="labels"),
)

EXCLUDED, BY_HAND = 1, 2
"""Labels of unusable pixels: excluded by `run_film`, and painted by the user."""


def pack_layers(
    result: Result[FilmDoses],
    frame: Frame,
    name: str,
    *,
    by_hand: BoolArray | None = None,
    plane: int = 0,
    **facts: Any,
) -> LayerData:
    """Describe the layers of a pack, the lowest first; their names end with the pack's.

    Painted pixels, `by_hand`, shape (n, H, W), are not usable. The displayed film, `plane`, sets
    the contrast. `facts` are metadata of each layer.
    """
    doses = result.content
    layers = []
    for kind in PACK_KINDS:
        more: dict[str, Any] = {**facts, "name": name, "result": result, "main": True}
        if kind.type == "labels":
            data: AnyArray = np.where(doses.usable, 0, EXCLUDED).astype(np.uint8)
            if by_hand is not None:
                data[by_hand] = BY_HAND
            look = _label_look()
        else:
            data = getattr(doses, kind.variable)
            limits = list(map(film_limits, data, doses.usable))
            more |= {"limits": limits, "plane": plane}
            look = {"contrast_limits": limits[plane]}
        layers.append(kind.layer(data, name, frame, doses.setup, look, stack_axis="layer", **more))
    return layers


def film_limits(plane: AnyArray, used: BoolArray) -> Limits:
    """Return the contrast limits of a film from its usable pixels."""
    return intensity_limits(np.where(used, plane, np.nan), peak=np.inf)


def dataset_layers(view: View, frame: Frame, name: str, facts: Mapping[str, Any]) -> LayerData:
    """Describe the layers of a result, or of a stack; `facts` as for `Kind.layer`."""
    layers = []
    for kind in about.KINDS:
        if not view.has(kind):
            continue
        data, words, look = _CONTENTS[kind.type](view, kind)
        axis = "" if view.shot is None else "shot"
        choices: Any = {"words": words, "stack_axis": axis, **facts}
        layers.append(kind.layer(data, name, frame, view.setup, look, **choices))
    return layers


@dataclass
class View:
    """A result, or a stack with the units and contrast of one shot; masked pixels are NaN."""

    dataset: xarray.Dataset
    setup: Setup | None
    shot: int | None = None
    deflector: str | None = None

    def __post_init__(self) -> None:
        mask = self.dataset.get("mask")
        if mask is not None and ("shot" in mask.dims or not mask.all()):
            hidden = [name for name in _MASKED_VARIABLES if name in self.dataset]
            self.dataset = self.dataset.assign({n: self.dataset[n].where(mask) for n in hidden})

    def has(self, kind: Kind) -> bool:
        excluded = "stack" if self.shot is None else "shot"
        if kind.shown_of == excluded or not self.along_shots(kind.variable):
            return False
        return kind.role != "source" or bool(np.ptp(self.plane("source")))

    def along_shots(self, variable: str) -> bool:
        """Whether the dataset has a variable, in a stack for each shot."""
        values = self.dataset.get(variable)
        return values is not None and (self.shot is None or "shot" in values.dims)

    def plane(self, variable: str) -> FloatArray:
        """Return the values of a variable in the shot."""
        values = self.dataset[variable]
        plane = values if self.shot is None else values.isel(shot=self.shot)
        return np.asarray(plane, dtype=np.float64)

    @cached_property
    def field(self) -> ShownField:
        (field,) = shown_fields([self.plane("displacement")], self.setup, self.deflector)
        return field

    @cached_property
    def vectors(self) -> Any:
        """Components (y, x) of the field, in its unit."""
        name = "" if self.setup is None else self.setup.main_field.name
        vectors = self.like(self.field.vectors, "displacement", name)
        return vectors[..., 0, :, :], vectors[..., 1, :, :]

    def like(self, shown: FloatArray, variable: str, name: str) -> Any:
        """Return a variable as it is `shown` of the shot; of a stack for all shots, lazily.

        `name` is that of the field in SI units, by the setup of each shot.
        """
        if self.shot is None:
            return shown
        values = self.dataset[variable].data
        if self.setup is not None:
            values = field_in_si(self.dataset, variable, name, self.setup)
        return values * _ratio(shown, np.asarray(values[self.shot]))

    @cached_property
    def intensity_limits(self) -> Limits:
        """Contrast that image, source and re-projection share."""
        for name in ("image", "reprojection"):
            if self.along_shots(name):
                return intensity_limits(self.plane(name))
        return 0.0, 1.0


Content = tuple[Any, dict[str, str], dict[str, Any]]  # data, words of the title, keywords


def _image(view: View, kind: Kind) -> Content:
    words: dict[str, str] = {}
    data = view.dataset[kind.variable].data
    if kind.role == "direction":
        colours = direction_colours(np.nan_to_num(view.field.vectors))
        return colours, {"symbol": view.field.symbol}, {"rgb": True}
    if kind.role == "uncertainty":
        # A field is proportional to its displacement.
        strength_per_pixel = _ratio(view.field.magnitude, np.hypot(*view.plane("displacement")))
        data = strength_per_pixel * np.hypot(*view.plane(kind.variable))
        words = {"unit": view.field.unit, "symbol": view.field.symbol}
        limits = 0.0, float(np.nanpercentile(data, _LIMITS_PERCENTILE))
    elif kind.variable == "displacement":
        data, limits, words = _field(view, kind.role)
    elif kind.role == "potential":
        values, unit = shown_potential(view.plane("potential"), view.setup)
        data = view.like(values, "potential", "potential_si")
        limits, words = (float(np.nanmin(values)), float(np.nanmax(values))), {"unit": unit}
    elif kind.role == "residual":
        if kind.unit == "%":
            used = view.plane("image")[view.dataset["mask"].values]
            data = 100 * data / used.mean()
        plane = data if view.shot is None else view.plane("residual")
        limits = symmetric_limits(plane)
    else:
        limits = view.intensity_limits
    return data, words, {"contrast_limits": _nonempty(limits)}


def direction_colours(vectors: FloatArray) -> FloatArray:
    """Return vectors (y, x) as colours (H, W, 3): the direction as hue, the length as brightness.

    Red points to the right; the hue grows anticlockwise, so that cyan points to the left.
    """
    from skimage.color import hsv2rgb

    length = np.hypot(*vectors)
    hue = np.arctan2(-vectors[0], vectors[1]) / (2 * np.pi) % 1
    brightness = length / (length.max() or 1.0)
    colours: FloatArray = hsv2rgb(np.stack([hue, np.ones_like(hue), brightness], axis=-1))
    return colours


def _field(view: View, role: str) -> tuple[Any, Limits, dict[str, str]]:
    """Return strength or a component of the field, its limits, unit and symbol."""
    field = view.field
    peak = field.largest
    if role == "field":
        data = field.magnitude if view.shot is None else np.hypot(*view.vectors)
        return data, (0.0, peak), {"unit": field.unit, "symbol": field.symbol}
    axis = "yx".index(role[-1])
    words = {"unit": field.unit, "symbol": field.components[axis]}
    return view.vectors[axis], (-peak, peak), words


def _labels(view: View, kind: Kind) -> Content:
    return view.dataset["caustic"].data.astype(np.uint8), {}, _label_look()


def _label_look() -> dict[str, Any]:
    """Return colours of labels that are seen on a field; napari's own first one is brown."""
    from napari.utils import CyclicLabelColormap

    return {"colormap": CyclicLabelColormap(["transparent", *_LABEL_COLOURS]), "opacity": 0.5}


def _arrows(view: View, kind: Kind) -> Content:
    """Return arrows on a grid, few enough to be distinguishable."""
    data, spacing = sample_arrows(np.nan_to_num(view.plane("displacement")))
    lengths = np.hypot(*data[:, 1].T)
    # Most arrows stay within their cell of the grid; the longest cross two cells at most.
    typical_length = max(np.percentile(lengths, 95), 0.5 * lengths.max()) if len(lengths) else 0.0
    look = {
        "features": {"displacement": lengths},
        "vector_style": "arrow",
        "edge_color": _ARROW_COLOUR,
        "edge_width": spacing / 9,
        # The data keep their unit; only the drawing is scaled.
        "length": float(0.95 * spacing / typical_length) if typical_length else 1.0,
        "opacity": 0.75,
    }
    return data if view.shot is None else arrows_in_shot(data, view.shot), {}, look


def sample_arrows(field: FloatArray) -> tuple[FloatArray, float]:
    """Sample long vectors (y, x) on a grid: starts and vectors (n, 2, 2), and the spacing."""
    height, width = field.shape[1:]
    step = max(1, -(-max(height, width) // _MAX_ARROWS_PER_SIDE))
    grid = np.mgrid[step // 2 : height : step, step // 2 : width : step]
    rows, columns = (index.ravel() for index in grid)
    starts = np.column_stack([rows, columns])
    data = np.stack([starts, field[:, rows, columns].T], axis=1).astype(np.float64)
    lengths = np.hypot(*data[:, 1].T)
    return data[lengths > _MIN_ARROW_LENGTH * lengths.max(initial=0.0)], float(step)


def arrows_in_shot(arrows: FloatArray, shot: int) -> FloatArray:
    """Return arrows of a plane, shape (n, 2, 2), in a shot of a stack, shape (n, 2, 3)."""
    stacked = np.zeros((len(arrows), 2, 3))
    stacked[:, 0, 0] = shot
    stacked[:, :, 1:] = arrows
    return stacked


def _sites(view: View, kind: Kind) -> Content:
    sites = view.dataset["sites"].values
    step = -(-len(sites) // _MAX_SHOWN_SITES)
    features = {key: values[::step] for key, values in site_features(view.dataset).items()}
    spacing = (view.dataset["potential"].size / len(sites)) ** 0.5
    look = {
        "features": features,
        "face_color": "displacement",
        "face_colormap": colour_map(kind.colormap),
        "face_contrast_limits": _nonempty((0.0, float(features["displacement"].max(initial=0.0)))),
        "border_width": 0.0,
        "size": 0.7 * spacing * step**0.5,
        "symbol": "disc",
    }
    return sites[::step], {"share": "" if step == 1 else f" (1 in {step})"}, look


_CONTENTS: dict[str, Callable[[View, Kind], Content]] = {
    "image": _image,
    "labels": _labels,
    "vectors": _arrows,
    "points": _sites,
}


def _ratio(values: FloatArray, plane: FloatArray) -> float:
    """Return the factor between two proportional planes."""
    largest = np.unravel_index(np.nanargmax(np.abs(plane)), plane.shape)
    return float(values[largest] / plane[largest]) if plane[largest] else 1.0


def symmetric_limits(residual: AnyArray) -> Limits:
    """Return limits around 0 that ignore a few extreme pixels at caustics."""
    # A large image is sampled.
    step = max(1, int(np.sqrt(residual.size / _LIMITS_SAMPLE_SIZE)))
    limit = float(np.nanpercentile(np.abs(residual[::step, ::step]), _LIMITS_PERCENTILE))
    return _nonempty((-limit, limit))


def _nonempty(limits: Limits) -> Limits:
    """Return limits that differ, also for constant values."""
    low, high = limits
    return (low, high) if high > low else (low, low + 1.0)


def site_features(dataset: xarray.Dataset) -> dict[str, FloatArray]:
    """Return weight (px²), mass (flux), displacement (px) and flux residual of each site."""
    mass = dataset["site_mass"].values
    return {
        "weight": dataset["weights"].values,
        "mass": mass,
        "displacement": np.hypot(*dataset["site_displacement"].values.T),
        # Excess of the cell's flux in the image, relative to the mass.
        "flux residual": dataset["site_flux"].values / mass - 1,
    }
