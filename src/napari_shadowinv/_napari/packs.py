"""A film pack as layers.

- what `run_film` found, as stacks with a plane for each film: `pack_layers`
- each film as an image to be inverted or fitted: `film_layers`
- the mean spectrum in a region: `spectrum_in`
- pixels that were painted by hand: `painted_by_hand`
"""

from __future__ import annotations

import json
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from napari_shadowinv._napari.frame import Frame, frame_for
from napari_shadowinv._napari.kinds import Kind
from napari_shadowinv._napari.layer_metadata import CAME_WITH, Result, mark
from napari_shadowinv._napari.layers import FullLayerData, Limits
from napari_shadowinv._napari.shots import shot_layer
from napari_shadowinv._system.validation import validated
from napari_shadowinv._typing import AnyArray, BoolArray, FloatArray
from napari_shadowinv.cautions import Caution
from napari_shadowinv.film import Pack
from napari_shadowinv.physics.setup import setup_from_dict

if TYPE_CHECKING:
    import xarray

    from napari_shadowinv.physics.setup import Setup

FLUENCE, DOSE, UNUSABLE = "fluence", "dose", "unusable"
PER_AREA = "1/(m² MeV)"

KINDS = (
    Kind(DOSE, "dose", "dose (Gy)", "Gy", "magma"),
    Kind(FLUENCE, "fluence", f"fluence ({PER_AREA})", PER_AREA, "inferno", visible=True),
    Kind(UNUSABLE, "usable", "unusable", type="labels"),
)

LEFT_OUT, BY_HAND = 1, 2
"""Labels of unusable pixels: as `run_film` found them, and as somebody painted them."""

_LABEL_COLOURS = ["transparent", "#5dff5d", "#00c8ff"]
_MIN_SIGNIFICANCE = 2.0  # fluence over its error
_SHORT = 1e-9  # s
_DARK_AND_BRIGHT = (0.1, 99.7)  # percentiles
_NEARLY_DARK = 0.3


class Spectrum(NamedTuple):
    """Mean over the usable pixels of a region, by film; NaN for films without any."""

    energies: FloatArray  # MeV
    fluence: FloatArray  # protons per m² and MeV
    error: FloatArray  # median standard deviation of its pixels, which largely share it
    bands: FloatArray  # shape (n, 2), MeV
    is_measured: BoolArray
    """False for a layer without usable pixels, one whose fluence is below twice its error, and the
    last one, whose fluence depends on the assumed spectrum beyond it."""


def pack_layers(
    result: Result,
    frame: Frame,
    name: str,
    *,
    by_hand: BoolArray | None = None,
    plane: int = 0,
    **facts: Any,
) -> list[FullLayerData]:
    """Describe the layers of a pack, the lowest first.

    Parameters
    ----------
    result : Result
        Its content is what `run_film` returns.
    frame : Frame
    name : str
        Of the pack; the layers' names begin with it.
    by_hand : ndarray of bool, shape (n, H, W), optional
        Unusable pixels that were painted.
    plane : int
        The film in view, which decides on the contrast.
    **facts
        Kept with each layer.
    """
    dataset = _dataset_of(result)
    usable = dataset["usable"].values.astype(bool)
    films = {
        "films": film_texts(dataset),
        "energies": dataset["energy"].values.tolist(),
        "times_of_flight": _times(dataset),
    }
    layers = []
    for kind in KINDS:
        data: AnyArray = dataset[kind.variable].values
        look: dict[str, Any] = {}
        if kind.type == "labels":
            data, look = _labels(usable, by_hand)
        more: dict[str, Any] = {**films, **facts, "result": result}
        if kind.type == "image":
            limits = [_limits(one, used) for one, used in zip(data, usable, strict=True)]
            more["limits"] = limits
            look = {"colormap": kind.colormap, "contrast_limits": limits[plane]}
        keywords = {
            "name": f"{name} {kind.title}".strip(),
            "metadata": mark(kind.role, kind.unit, result.setup, **more),
            "visible": kind.visible,
            **frame.keywords(stacked=True),
            **look,
            "axis_labels": ("layer", "y", "x"),
        }
        layers.append((data, keywords, kind.type))
    return layers


def film_layers(dataset: xarray.Dataset, frame: Frame, name: str) -> list[FullLayerData]:
    """Describe an image of each film's fluence, with what an inversion needs to know of it.

    Films without usable pixels are left out; in others, unusable pixels are zero. Without setups
    the images know how strongly a magnetic field displaces their protons, relative to each other.
    Only the first is visible.
    """
    setups = _setups(dataset)
    layers: list[FullLayerData] = []
    for k, used in enumerate(dataset["usable"].values.astype(bool)):
        if not used.any():
            continue
        image = np.where(used, dataset["fluence"].values[k], 0.0)
        described = shot_layer(
            image,
            f"film {_number(dataset, k)}, {float(dataset['energy'][k]):.3g} MeV",
            setups[k] if setups else None,
            _limits(image, used),
            frame=frame,
            setup_origin=f"{CAME_WITH} {name}" if setups else None,
            usable=used,
            part=str(_number(dataset, k)),
            energies=[float(dataset["energy"][k])],
            strength=None if setups else float(dataset["strength"][k]),
        )
        described[1]["visible"] = not layers
        layers.append(described)
    return layers


def pack_result(dataset: xarray.Dataset) -> Result:
    """What the layers of a pack show, with the setup of its first film, if it has setups."""
    setups = _setups(dataset)
    return Result(dataset, setups[0] if setups else None)


def pack_frame(dataset: xarray.Dataset) -> Frame:
    """Pixels of the object plane; without a setup those of the first film's scan."""
    setups = _setups(dataset)
    shape = dataset["fluence"].shape
    side = dataset.attrs.get("scan_pixel_size")
    return frame_for(shape, setups[0] if setups else None, pixel_size=side)


def pack_of(dataset: xarray.Dataset) -> Pack:
    """Return what a dataset was made from, or raise an `InputError`."""
    return validated(Pack, json.loads(dataset.attrs["pack"]), "the result's pack")


def warnings_of_pack(dataset: xarray.Dataset) -> tuple[Caution, ...]:
    """Return the reasons to doubt the dataset of a pack."""
    return tuple(map(Caution.from_json, json.loads(dataset.attrs.get("warnings", "[]"))))


def scales_of(dataset: xarray.Dataset) -> FloatArray:
    """Return how much larger each film shows the object than the first."""
    found = np.array([one.magnification for one in _setups(dataset)])
    return found / found[0] if found.size else np.ones(dataset.sizes["layer"])


def film_texts(dataset: xarray.Dataset) -> list[str]:
    """Tell number, energy and time of flight of each film."""
    texts = []
    times = _times(dataset)
    for k in range(dataset.sizes["layer"]):
        text = f"film {_number(dataset, k)}: {float(dataset['energy'][k]):.3g} MeV"
        if times is not None:
            time = times[k]
            text += f", {1e12 * time:.3g} ps" if time < _SHORT else f", {1e9 * time:.3g} ns"
        texts.append(text if dataset["usable"].values[k].any() else f"{text}, left out")
    return texts


def spectrum_in(dataset: xarray.Dataset, region: BoolArray | None = None) -> Spectrum:
    """Return the mean fluence of each film over the usable pixels of a region; None is all."""
    usable = dataset["usable"].values.astype(bool)
    inside = usable if region is None else usable & region

    def of_each(name: str, what: Callable[[AnyArray], Any]) -> FloatArray:
        planes = zip(dataset[name].values, inside, strict=True)
        return np.array([what(one[used]) if used.any() else np.nan for one, used in planes], float)

    fluence = of_each("fluence", partial(np.mean, dtype=np.float64))
    error = of_each("fluence_error", np.median)
    is_measured = fluence > _MIN_SIGNIFICANCE * error  # not where they are NaN
    is_measured[-1] = False
    bands = np.stack([dataset["energy_low"].values, dataset["energy_high"].values], axis=1)
    return Spectrum(dataset["energy"].values, fluence, error, bands, is_measured)


def painted_by_hand(labels: AnyArray, dataset: xarray.Dataset) -> BoolArray:
    """Return which pixels of the labels of a pack somebody painted."""
    usable = dataset["usable"].values.astype(bool)
    return np.asarray((labels == BY_HAND) | (usable & (labels > 0)))


def _labels(usable: BoolArray, by_hand: BoolArray | None) -> tuple[AnyArray, dict[str, Any]]:
    from napari.utils.colormaps import CyclicLabelColormap
    from napari.utils.colormaps.standardize_color import transform_color

    labels = np.where(usable, 0, LEFT_OUT).astype(np.uint8)
    if by_hand is not None:
        labels[by_hand] = BY_HAND
    colours = CyclicLabelColormap(transform_color(_LABEL_COLOURS))
    return labels, {"colormap": colours, "opacity": 0.5}


def _limits(plane: AnyArray, used: BoolArray) -> Limits:
    """Contrast of one film, by its usable pixels."""
    if not used.any():
        return 0.0, 1.0
    dark, bright = (float(value) for value in np.percentile(plane[used], _DARK_AND_BRIGHT))
    low = 0.0 if 0 <= dark < _NEARLY_DARK * bright else dark
    return (low, bright) if bright > low else (low, low + 1.0)


def _setups(dataset: xarray.Dataset) -> list[Setup]:
    found = json.loads(dataset.attrs.get("setups", "[]"))
    return [setup_from_dict(one, "the pack's setup") for one in found]


def _times(dataset: xarray.Dataset) -> list[float] | None:
    if "time_of_flight" not in dataset.coords:
        return None
    return [float(time) for time in dataset["time_of_flight"].values]


def _number(dataset: xarray.Dataset, k: int) -> int:
    return int(dataset["layer"].values[k])


def _dataset_of(result: Result) -> xarray.Dataset:
    import xarray as xr

    assert isinstance(result.content, xr.Dataset)
    return result.content
