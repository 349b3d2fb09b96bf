"""The result of a fit as napari layers: its fields, its beam, and how it explains the images."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.ndimage import map_coordinates

from napari_shadowinv._napari.frame import Frame
from napari_shadowinv._napari.kinds import KINDS, layer_name
from napari_shadowinv._napari.layer_metadata import KEY, Result, mark, role_of
from napari_shadowinv._napari.layers import FullLayerData, dataset_layers, symmetric_limits
from napari_shadowinv._napari.notifications import window_text
from napari_shadowinv._typing import FloatArray
from napari_shadowinv.fitting import FIELDS
from napari_shadowinv.physics.units import intensity_limits

if TYPE_CHECKING:
    from napari_shadowinv.fitting import Basin, Fit, FittedField
    from napari_shadowinv.physics.setup import Setup

# In another answer only what differs is of interest.
_COMPARED = ("field", "arrows")
_KINDS = {kind.role: kind for kind in KINDS if kind.shown_of != "stack"}
_SAME_BEAM = 1e-6  # of the beam's mean, but for a gain


def fit_layers(
    result: Result, frame: Frame, name: str, *, alone: bool = False
) -> list[FullLayerData]:
    """Describe the layers of a fit, the lowest first; of several fields the first is visible.

    A fit that comes `alone`, as from a file, has layers of its images and of all other answers.
    """
    fit = _fit_of(result)
    facts = _facts(result, fit, name)
    layers = _image_layers(fit, frame, name, facts, with_images=alone)
    if alone:
        for number in range(len(fit.basins) - 1, 0, -1):
            for layer in answer_layers(result, number, frame, name):
                layer[1]["visible"] = False
                layers.append(layer)
    for number, field in reversed(list(enumerate(fit.fields))):
        variables: dict[str, Any] = {
            "potential": (("y", "x"), field.potential),
            "displacement": (("component", "y", "x"), field.displacement),
        }
        if fit.mask.shape[1:] == field.potential.shape:
            variables["mask"] = ("y", "x"), fit.mask.any(axis=0)
        if field.uncertainty is not None:
            variables["displacement_uncertainty"] = ("component", "y", "x"), field.uncertainty
        titled = f"{_titled(name, fit, field)}{doubt_in_words(fit)}"
        described = _field_layers(variables, field, setup_of_fit(fit), frame, titled, facts)
        if number:
            _part(described, field.name)
        for _, keywords, _ in described:
            keywords["visible"] &= number == 0
        layers += described
    return layers


def answer_layers(result: Result, number: int, frame: Frame, name: str) -> list[FullLayerData]:
    """Describe the fields of another answer, the one of the fit's basin `number`."""
    fit = _fit_of(result)
    basin = fit.basins[number]
    layers: list[FullLayerData] = []
    for m, field in reversed(list(enumerate(fit.fields))):
        displacement = _full_size(basin.displacement[m], field.potential.shape)
        described = _field_layers(
            {"displacement": (("component", "y", "x"), displacement)},
            field,
            setup_of_fit(fit),
            frame,
            _titled(f"{name} {start_in_words(basin)}", fit, field),
            _facts(result, fit, name),
        )
        kept = [layer for layer in described if role_of(layer[1]) in _COMPARED]
        for _, keywords, _ in kept:
            keywords["visible"] &= m == 0
        layers += _part(kept, f"{field.name} {number}")
    return layers


def start_in_words(basin: Basin) -> str:
    """Return from where an answer was reached; the only field that is given is an inversion's."""
    return "from the inversion" if basin.start == "given" else basin.start


def doubt_in_words(fit: Fit) -> str:
    """Return what a name has after it unless the fields are determined, the verdict."""
    from napari_shadowinv.fitting import Verdict

    return "" if fit.verdict is Verdict.DETERMINED else f" ({fit.verdict.value})"


def verdict_in_words(fit: Fit) -> str:
    """Return the verdict and why, in a sentence."""
    return f"the fit's verdict is '{fit.verdict.value}': {window_text(fit.explanation)}"


def setup_of_fit(fit: Fit) -> Setup | None:
    """Return the experiment that the fields are told in: that of the first image."""
    return fit.setups[0] if fit.setups else None


def _fit_of(result: Result) -> Fit:
    from napari_shadowinv.fitting import Fit

    assert isinstance(result.content, Fit)
    return result.content


def _facts(result: Result, fit: Fit, name: str) -> dict[str, Any]:
    """Collect the metadata that all layers of a fit share."""
    return {
        "result": result,
        "name": name,
        "made_from": dict(result.attributes),
        "verdict": fit.verdict.value,
        "explanation": fit.explanation,
    }


def _titled(name: str, fit: Fit, field: FittedField) -> str:
    return name if len(fit.fields) == 1 else f"{name} {field.name}"


def _field_layers(
    variables: dict[str, Any],
    field: FittedField,
    setup: Setup | None,
    frame: Frame,
    name: str,
    facts: dict[str, Any],
) -> list[FullLayerData]:
    import xarray as xr

    facts = {**facts, "displacement": variables["displacement"][1]}
    dataset = xr.Dataset(variables)
    return dataset_layers(dataset, setup, frame, name, facts, deflector=FIELDS[field.name])


def _part(described: Sequence[FullLayerData], part: str) -> list[FullLayerData]:
    """Tell layers from those of the first field."""
    for _, keywords, _ in described:
        keywords["metadata"][KEY]["part"] = part
    return list(described)


def _image_layers(
    fit: Fit, frame: Frame, name: str, facts: dict[str, Any], *, with_images: bool
) -> list[FullLayerData]:
    """Hidden layers of the beam, if it is uneven, and of how the images are explained."""
    setup = setup_of_fit(fit)
    grey = intensity_limits(fit.images[0])
    means = [image[use].mean() for image, use in zip(fit.images, fit.mask, strict=True)]
    percent = np.where(fit.mask, 100 * fit.residual / np.array(means)[:, None, None], np.nan)
    shown = {"reprojection": (fit.reprojection, grey), "residual": (percent, None)}
    if np.ptp(fit.source[0]):
        shown = {"source": (_without_gains(fit.source), grey), **shown}
    if with_images:
        shown = {"image": (fit.images, grey), **shown}
    layers: list[FullLayerData] = []
    for role, (planes, limits) in shown.items():
        kind = _KINDS[role]
        data = planes[0] if len(planes) == 1 else planes
        keywords = {
            "name": layer_name(kind.title, name),
            "metadata": mark(role, kind.unit, setup, **facts, main=role != "reprojection"),
            "visible": False,
            **frame.keywords(stacked=data.ndim == 3),
            "colormap": kind.colormap,
            "contrast_limits": limits or symmetric_limits(planes[0]),
        }
        if data.ndim == 3:
            keywords["axis_labels"] = ("image", "y", "x")
        layers.append((data, keywords, "image"))
    return layers


def _without_gains(beams: FloatArray) -> FloatArray:
    """The first beam only, where all are the same but for a factor."""
    scaled = beams / beams.mean(axis=(1, 2), keepdims=True)
    return beams[:1] if np.abs(scaled - scaled[0]).max() < _SAME_BEAM else beams


def _full_size(displacement: FloatArray, shape: tuple[int, ...]) -> FloatArray:
    """Values at every other pixel, between pairs of pixels, at each of them."""
    grid = np.mgrid[: shape[0], : shape[1]]
    places = (grid - 0.5) / 2
    return np.stack([map_coordinates(one, places, order=1, mode="nearest") for one in displacement])
