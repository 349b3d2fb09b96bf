"""The result of a fit as napari layers: its fields, its beam, and how it explains the images."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.ndimage import map_coordinates

from napari_shadowinv._napari.frame import Frame
from napari_shadowinv._napari.layer_metadata import KEY, SOURCE, Result, mark, role_of
from napari_shadowinv._napari.layers import (
    FullLayerData,
    dataset_layers,
    intensity_limits,
    result_layers,
    symmetric_limits,
)
from napari_shadowinv._typing import AnyArray, FloatArray
from napari_shadowinv.fitting import FIELDS

if TYPE_CHECKING:
    from napari_shadowinv.fitting import Basin, Fit, FittedField
    from napari_shadowinv.physics.setup import Setup

# In another answer only what differs is of interest.
_COMPARED = ("field", "arrows")


def fit_layers(
    fit: Fit,
    frame: Frame,
    name: str,
    *,
    with_source: bool = False,
    attributes: Mapping[str, str] | None = None,
) -> list[FullLayerData]:
    """Describe the layers of a fit, the lowest first; of several fields the first is visible."""
    setup = setup_of_fit(fit)
    layers = _image_layers(fit, frame, name, with_source)
    for number, field in reversed(list(enumerate(fit.fields))):
        # A layer stands for its field: each can be saved, and projected, alone.
        one = slice(number, number + 1)
        basins = (replace(b, displacement=b.displacement[one]) for b in fit.basins)
        alone = replace(fit, fields=(field,), strengths=fit.strengths[:, one], basins=tuple(basins))
        content = alone.to_dataset(attributes=attributes)
        described = result_layers(
            Result(content, setup, dict(attributes or {})), frame, _titled(name, fit, field)
        )
        layers += _parted(described, number, field)
    return layers


def answer_layers(fit: Fit, number: int, frame: Frame, name: str) -> list[FullLayerData]:
    """Describe the fields of another answer, the one of the fit's basin `number`."""
    import xarray as xr

    basin = fit.basins[number]
    layers: list[FullLayerData] = []
    for m, field in reversed(list(enumerate(fit.fields))):
        displacement = _full_size(basin.displacement[m], field.potential.shape)
        described = dataset_layers(
            xr.Dataset({"displacement": (("component", "y", "x"), displacement)}),
            setup_of_fit(fit),
            frame,
            _titled(f"{name} {start_in_words(basin)}", fit, field),
            {},
            deflector=FIELDS[field.name],
        )
        kept = [layer for layer in described if role_of(layer[1]) in _COMPARED]
        layers += _parted(kept, m, field)
    return layers


def start_in_words(basin: Basin) -> str:
    """Return from where an answer was reached; the only field that is given is an inversion's."""
    return "from the inversion" if basin.start == "given" else basin.start


def setup_of_fit(fit: Fit) -> Setup | None:
    """Return the experiment that the fields are told in: that of the first image."""
    return fit.setups[0] if fit.setups else None


def _titled(name: str, fit: Fit, field: FittedField) -> str:
    return name if len(fit.fields) == 1 else f"{name} {field.name}"


def _parted(
    described: Sequence[FullLayerData], number: int, field: FittedField
) -> list[FullLayerData]:
    """Tell the layers of a further field from those of the first, and hide them."""
    if number == 0:
        return list(described)
    for _, keywords, _ in described:
        keywords["metadata"][KEY]["part"] = field.name
        keywords["visible"] = False
    return list(described)


def _image_layers(fit: Fit, frame: Frame, name: str, with_source: bool) -> list[FullLayerData]:
    """Hidden layers of the beam, if it was fitted, and of how the images are explained."""
    setup = setup_of_fit(fit)
    limits = intensity_limits(fit.images[0])
    means = [image[use].mean() for image, use in zip(fit.images, fit.mask, strict=True)]
    percent = 100 * fit.residual / np.array(means)[:, None, None]

    def described(data: AnyArray, role: str, title: str, unit: str, **look: Any) -> FullLayerData:
        keywords = {
            "name": f"{name} {title}",
            "metadata": mark(role, unit, setup),
            "visible": False,
            **frame.keywords(stacked=data.ndim == 3),
            **look,
        }
        if data.ndim == 3:
            keywords["axis_labels"] = ("image", "y", "x")
        return data, keywords, "image"

    grey = {"colormap": "gray", "contrast_limits": limits}
    red_blue = {"colormap": "RdBu_r", "contrast_limits": symmetric_limits(percent[0])}
    layers = [
        described(
            _unstacked(fit.reprojection), "reprojection", "re-projection", "flux/px²", **grey
        ),
        described(_unstacked(percent), "residual", "residual (% of mean)", "%", **red_blue),
    ]
    if with_source:
        layers.insert(0, described(fit.source[0], SOURCE, "fitted source", "flux/px²", **grey))
    return layers


def _unstacked(planes: FloatArray) -> FloatArray:
    return planes[0] if len(planes) == 1 else planes


def _full_size(displacement: FloatArray, shape: tuple[int, ...]) -> FloatArray:
    """Values at every other pixel, between pairs of pixels, at each of them."""
    grid = np.mgrid[: shape[0], : shape[1]]
    places = (grid - 0.5) / 2
    return np.stack([map_coordinates(one, places, order=1, mode="nearest") for one in displacement])
