"""The result of a fit as napari layers: fields, beam, re-projections and residuals."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.ndimage import map_coordinates

from napari_shadowinv._napari import layer_metadata as about
from napari_shadowinv._napari.layer_metadata import Frame, Result, role_of
from napari_shadowinv._napari.layers import (
    LayerData,
    View,
    dataset_layers,
    shared_metadata,
    significance_variables,
    symmetric_limits,
)
from napari_shadowinv._napari.preferences import colour_map
from napari_shadowinv._typing import FloatArray
from napari_shadowinv.facts import Level
from napari_shadowinv.inversion.error_budget import per_pixel_of
from napari_shadowinv.physics.setup import deflector_titles
from napari_shadowinv.physics.units import intensity_limits

if TYPE_CHECKING:
    from napari_shadowinv.fitting import Basin, Fit, FittedField

# Of alternative solutions only these are shown.
_ALTERNATIVE_ROLES = ("field", "arrows")
_KINDS = {kind.role: kind for kind in about.KINDS if kind.shown_of != "stack"}
_MAX_BEAM_DIFFERENCE = 1e-6  # relative to the mean


def fit_layers(result: Result[Fit], frame: Frame, name: str, *, alone: bool = False) -> LayerData:
    """Describe the layers of a fit, the lowest first; the first of several fields is visible.

    With `alone`, as for a file, they include the images and all alternative solutions.
    """
    fit, facts = result.content, _facts(result, name)
    layers = _image_layers(fit, frame, name, facts, with_images=alone)
    if alone:
        for number in range(len(fit.basins) - 1, 0, -1):
            for layer in alternative_layers(result, number, frame, name):
                layer[1]["visible"] = False
                layers.append(layer)
    for m, field in reversed(list(enumerate(fit.fields))):
        variables: dict[str, Any] = {
            "potential": (("y", "x"), field.potential),
            "displacement": (("component", "y", "x"), field.displacement),
        }
        if fit.mask.shape[1:] == field.potential.shape:
            variables["mask"] = ("y", "x"), fit.mask.any(axis=0)
        std = per_pixel_of(field.errors)
        variables |= significance_variables(field.displacement, std, fit.structures(field))
        title = _field_title(name, fit, field)
        part = {"part": field.name} if m else {}
        level = fit.headline.level
        layers += _field_layers(variables, fit, m, frame, title, facts | part, level)
    return layers


def alternative_layers(result: Result[Fit], number: int, frame: Frame, name: str) -> LayerData:
    """Describe the fields of an alternative solution, the fit's basin `number`."""
    fit, facts = result.content, _facts(result, name)
    basin = fit.basins[number]
    layers: LayerData = []
    for m, field in reversed(list(enumerate(fit.fields))):
        displacement = _full_size(basin.displacement[m], field.potential.shape)
        variables = {"displacement": (("component", "y", "x"), displacement)}
        title = _field_title(f"{name} {start_name(basin)}", fit, field)
        part = {"part": f"{field.name} {number}"}
        layer_data = _field_layers(variables, fit, m, frame, title, facts | part)
        layers += [layer for layer in layer_data if role_of(layer[1]) in _ALTERNATIVE_ROLES]
    return layers


def start_name(basin: Basin) -> str:
    """Return the name of a solution's starting point; a given start is always an inversion."""
    return "from the inversion" if basin.start == "given" else basin.start


def _facts(result: Result[Fit], name: str) -> dict[str, Any]:
    """Collect the metadata that all layers of a fit share."""
    fit = result.content
    verdict = {"verdict": fit.verdict.value, "explanation": fit.explanation}
    return shared_metadata(result, name) | verdict


def _field_title(name: str, fit: Fit, field: FittedField) -> str:
    return name if len(fit.fields) == 1 else f"{name} {field.name}"


def _field_layers(
    variables: dict[str, Any],
    fit: Fit,
    m: int,
    frame: Frame,
    title: str,
    facts: dict[str, Any],
    level: Level | None = None,
) -> LayerData:
    """Describe the layers of the field number `m`; only the layers of the first are visible."""
    import xarray as xr

    facts = {**facts, "displacement": variables["displacement"][1]}
    deflector = deflector_titles()[fit.fields[m].name]
    view = View(xr.Dataset(variables), fit.setup, deflector=deflector)
    layer_data = dataset_layers(view, frame, title, facts, level)
    for _, keywords, _ in layer_data:
        keywords["visible"] &= m == 0
    return layer_data


def _image_layers(
    fit: Fit, frame: Frame, name: str, facts: dict[str, Any], *, with_images: bool
) -> LayerData:
    """Describe hidden layers of the re-projections, the residuals and a non-uniform beam."""
    grey = intensity_limits(fit.images[0])
    means = [image[use].mean() for image, use in zip(fit.images, fit.mask, strict=True)]
    percent = np.where(fit.mask, 100 * fit.residual / np.array(means)[:, None, None], np.nan)
    content = {"reprojection": (fit.reprojection, grey), "residual": (percent, None)}
    if np.ptp(fit.source[0]):
        # One plane unless the beams differ in more than their brightness.
        beams = fit.source / fit.source.mean(axis=(1, 2), keepdims=True)
        is_common = np.abs(beams - beams[0]).max() < _MAX_BEAM_DIFFERENCE
        content = {"source": (fit.source[:1] if is_common else fit.source, grey), **content}
    if with_images:
        content = {"image": (fit.images, grey), **content}
    layers: LayerData = []
    for role, (planes, limits) in content.items():
        kind = _KINDS[role]
        data = planes[0] if len(planes) == 1 else planes
        more = facts | {"main": role != "reprojection"}
        if role == "image" and len(planes) == 1:
            # With beam and mask, the image can be inverted again.
            usable = None if fit.mask.all() else fit.mask[0]
            more |= {"source": fit.source[0], "usable": usable}
        look = {
            "visible": False,
            "colormap": colour_map(kind.colormap),
            "contrast_limits": limits or symmetric_limits(planes[0]),
        }
        more |= {"level": fit.headline.level, "stack_axis": "image" if data.ndim == 3 else ""}
        layers.append(kind.layer(data, name, frame, fit.setup, look, **more))
    return layers


def _full_size(displacement: FloatArray, shape: tuple[int, ...]) -> FloatArray:
    """Interpolate values at every second pixel, between pixel pairs, to all pixels."""
    points = (np.mgrid[: shape[0], : shape[1]] - 0.5) / 2
    planes = [map_coordinates(plane, points, order=1, mode="nearest") for plane in displacement]
    return np.stack(planes)
