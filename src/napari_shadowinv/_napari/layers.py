"""A result as napari layers.

- describe them, without a viewer: `inversion_layers`
- put them into a viewer, with or without a window: `add_inversion`

The lowest layer comes first. The strength of the field and the arrows are visible, all others
are there to be switched on. What each layer shows, in which unit, and the whole result behind
it are in its metadata; see `napari_shadowinv._napari.layer_metadata`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from napari_shadowinv._napari.frame import Frame, frame_for
from napari_shadowinv._napari.layer_metadata import Result, mark, role_of
from napari_shadowinv._napari.legend import follow_top_image
from napari_shadowinv._napari.placing import place_newcomers
from napari_shadowinv.physics.units import shown_fields, shown_potential

if TYPE_CHECKING:
    from napari_shadowinv.inversion import Inversion
    from napari_shadowinv.physics.setup import Setup

__all__ = [
    "FullLayerData",
    "add_inversion",
    "add_layers",
    "arrow_keywords",
    "caustic_keywords",
    "intensity_limits",
    "inversion_layers",
    "opened",
    "result_layers",
    "show_scale_bar",
    "symmetric_limits",
    "thinned_arrows",
]

Array = NDArray[np.float64]
FullLayerData = tuple[Any, dict[str, Any], str]

_INTENSITY_MAP = "gray"
_POTENTIAL_MAP = "viridis"
_FIELD_MAP = "inferno"
_SIGNED_MAP = "RdBu_r"
# Both stand out of every colour of the field's map.
_CAUSTIC_COLOUR = "#5dff5d"
_ARROW_COLOUR = "#00c8ff"
_FIELD_ARROW_COLOUR = "#ffffff"

_ARROWS_ALONG = 28
_SHORTEST_ARROW = 0.05
_MOST_SITES_SHOWN = 200_000
_BRIGHTEST = 99.7
_ENOUGH_PIXELS = 100_000
_LARGEST_INTENSITY = 3.5


def inversion_layers(
    inversion: Inversion,
    setup: Setup | None = None,
    *,
    name: str = "",
    scale: Sequence[float] | None = None,
    translate: Sequence[float] | None = None,
    units: Sequence[str] | None = None,
    cells: bool = False,
    attributes: Mapping[str, str] | None = None,
) -> list[FullLayerData]:
    """Describe the layers of a result.

    Parameters
    ----------
    inversion : Inversion
        The result.
    setup : Setup, optional
        Gives the pixel size and the field in SI units; pixels without.
    name : str
        Name of the shot; the layers' names begin with it.
    scale, translate, units : sequence, optional
        Place of the image in the world, axis order (y, x), where it is not the setup's:
        a binned or cropped image lies on its original with those of the original's layer.
    cells : bool
        Whether to add the power cells as polygons, for up to 5,000 sites.
    attributes : mapping of str to str, optional
        Where the result comes from, see `napari_shadowinv.io.provenance`; kept for writing.

    Returns
    -------
    list of (data, keywords, layer type)
        As napari's ``Layer.create`` takes them, the lowest first.

    Raises
    ------
    InputError
        If cells are asked for and there are too many.
    """
    result = Result(inversion, setup, dict(attributes or {}))
    frame = frame_for(
        inversion.potential.shape, setup, scale=scale, translate=translate, units=units
    )
    return result_layers(result, frame, name, cells=cells)


def add_inversion(
    viewer: Any,
    inversion: Inversion,
    setup: Setup | None = None,
    *,
    name: str = "",
    **keywords: Any,
) -> list[Any]:
    """Add the layers of a result to a viewer, with a scale bar.

    Parameters
    ----------
    viewer : napari.Viewer or napari.components.ViewerModel
        Where to add them; a `ViewerModel` needs neither a window nor a display.
    inversion : Inversion
        The result.
    setup : Setup, optional
        The experiment.
    name : str
        Name of the shot; the layers' names begin with it.
    **keywords
        More of `inversion_layers`.

    Returns
    -------
    list of napari.layers.Layer
        The new layers, the lowest first.

    Raises
    ------
    InputError
        As `inversion_layers`.

    Examples
    --------
    >>> from napari.components import ViewerModel
    >>> from napari_shadowinv import invert
    >>> viewer = ViewerModel()
    >>> layers = add_inversion(viewer, invert(np.ones((20, 20))), name="blank")
    >>> [layer.name for layer in layers if layer.visible]
    ['blank |d| (px)', 'blank displacement arrows']
    """
    return add_layers(viewer, inversion_layers(inversion, setup, name=name, **keywords))


def add_layers(
    viewer: Any, described: Sequence[FullLayerData], *, below: Any | None = None
) -> list[Any]:
    """Add described layers to a viewer, select the field, switch on scale bar and colour bar.

    Parameters
    ----------
    viewer : napari.Viewer or napari.components.ViewerModel
        Where to add them.
    described : sequence of (data, keywords, layer type)
        The layers.
    below : napari.layers.Layer, optional
        A layer of the viewer to put them under. Default: on top of all.

    Returns
    -------
    list of napari.layers.Layer
        The new layers, in the same order.
    """
    from napari.layers import Layer

    added = [Layer.create(*layer) for layer in described]
    for layer in added:
        place = len(viewer.layers) if below is None else viewer.layers.index(below)
        viewer.layers.insert(place, layer)
    for layer in added:
        if role_of(layer) == "field":
            # The status line then tells the field below the mouse.
            viewer.layers.selection.active = layer
    show_scale_bar(viewer)
    follow_top_image(viewer)
    place_newcomers(viewer)
    return added


def show_scale_bar(viewer: Any) -> None:
    """Switch on the scale bar of a viewer."""
    overlays = getattr(getattr(viewer, "canvas", None), "overlays", viewer)  # napari before 0.9
    overlays.scale_bar.visible = True


@dataclass(frozen=True)
class _Maker:
    """Makes layers that share a result, a frame and a name."""

    result: Result
    frame: Frame
    name: str

    def layer(
        self, data: Any, kind: str, role: str, title: str, unit: str = "", **keywords: Any
    ) -> FullLayerData:
        made_from = dict(self.result.attributes)
        metadata = mark(role, unit, self.result.setup, result=self.result, made_from=made_from)
        return (
            data,
            {
                "name": f"{self.name} {title}".strip(),
                "metadata": metadata,
                **self.frame.keywords(),
                **keywords,
            },
            kind,
        )

    def image(
        self, plane: ArrayLike, role: str, title: str, unit: str, limits: tuple[float, float],
        colormap: str, **keywords: Any,
    ) -> FullLayerData:  # fmt: skip
        choices = {"colormap": colormap, "contrast_limits": opened(limits), "visible": False}
        return self.layer(plane, "image", role, title, unit, **{**choices, **keywords})


def result_layers(
    result: Result, frame: Frame, name: str = "", *, cells: bool = False
) -> list[FullLayerData]:
    """Describe the layers of a result or of a mere field.

    Parameters
    ----------
    result : Result
        What to show.
    frame : Frame
        Where it lies.
    name : str
        Name of the shot.
    cells : bool
        See `inversion_layers`.

    Returns
    -------
    list of (data, keywords, layer type)
        The layers, the lowest first.
    """
    import xarray as xr

    make = _Maker(result, frame, name)
    content = result.content
    if isinstance(content, xr.Dataset):
        displacement = np.asarray(content["displacement"])
        return [
            *(
                [_potential(make, np.asarray(content["potential"]))]
                if "potential" in content
                else []
            ),
            *_field(make, displacement),
            *_arrows(make, displacement),
        ]
    return [
        *_intensities(make, content),
        _potential(make, content.potential),
        *_field(make, content.displacement),
        _caustics(make, content),
        *_arrows(make, content.displacement),
        _sites(make, content),
        *([_cells(make, content)] if cells else []),
    ]


def _intensities(make: _Maker, inversion: Inversion) -> list[FullLayerData]:
    """What was inverted, what the answer makes of it, and what is left over."""
    unit = "flux/px²"
    limits = intensity_limits(inversion.image)
    percent = 100 * inversion.residual / inversion.image[inversion.mask].mean()
    layers = [make.image(inversion.image, "image", "image", unit, limits, _INTENSITY_MAP)]
    if np.ptp(inversion.source):
        layers.append(
            make.image(inversion.source, "source", "source", unit, limits, _INTENSITY_MAP)
        )
    return [
        *layers,
        make.image(
            inversion.reprojection, "reprojection", "re-projection", unit, limits, _INTENSITY_MAP
        ),
        make.image(
            percent, "residual", "residual (% of mean)", "%", symmetric_limits(percent), _SIGNED_MAP
        ),
    ]


def _potential(make: _Maker, potential: Array) -> FullLayerData:
    plane, unit = shown_potential(potential, make.result.setup)
    limits = (float(plane.min()), float(plane.max()))
    return make.image(plane, "potential", f"potential ({unit})", unit, limits, _POTENTIAL_MAP)


def _field(make: _Maker, displacement: Array) -> list[FullLayerData]:
    """Components of the field, and on top of them its strength."""
    (field,) = shown_fields([displacement], make.result.setup)
    limit = float(np.abs(field.vectors).max())
    strength = field.magnitude
    return [
        *(
            make.image(
                plane, role, f"{symbol} ({field.unit})", field.unit, (-limit, limit), _SIGNED_MAP
            )
            for plane, role, symbol in zip(
                field.vectors, ("field y", "field x"), field.components, strict=True
            )
        ),
        make.image(
            strength,
            "field",
            f"{field.symbol} ({field.unit})",
            field.unit,
            (0.0, float(strength.max())),
            _FIELD_MAP,
            visible=True,
        ),
    ]


def _caustics(make: _Maker, inversion: Inversion) -> FullLayerData:
    return make.layer(
        inversion.caustic.astype(np.uint8),
        "labels",
        "caustic",
        "caustics",
        **caustic_keywords(),
    )


def caustic_keywords() -> dict[str, Any]:
    """Return how caustics look: one colour on nothing."""
    from napari.utils.colormaps import CyclicLabelColormap
    from napari.utils.colormaps.standardize_color import transform_color

    # A dictionary of colours would do, but napari compiles code for it, for two seconds.
    colours = transform_color(["transparent", _CAUSTIC_COLOUR])
    return {"colormap": CyclicLabelColormap(colours), "opacity": 0.5, "visible": False}


def _arrows(make: _Maker, displacement: Array) -> list[FullLayerData]:
    """Displacements of few enough rays to see each arrow; a field's own arrows are hidden."""
    data, spacing = thinned_arrows(displacement)
    title = "displacement arrows"
    arrows = [make.layer(data, "vectors", "arrows", title, "px", **arrow_keywords(data, spacing))]
    (field,) = shown_fields([displacement], make.result.setup)
    if not field.arrows:
        return arrows
    data, spacing = thinned_arrows(field.vectors)
    look = arrow_keywords(data, spacing, "field")
    hidden = make.layer(
        data, "vectors", "field arrows", field.arrows, field.unit, **{**look, "visible": False}
    )
    return [hidden, *arrows]


def arrow_keywords(data: Array, spacing: float, shown: str = "displacement") -> dict[str, Any]:
    """Return how arrows look, from those of one result; see `thinned_arrows`."""
    lengths = np.hypot(*data[:, 1].T)
    # Most arrows keep to their own place; the strongest reach to the next but one at most.
    usual = max(np.percentile(lengths, 95), 0.5 * lengths.max()) if len(lengths) else 0.0
    return {
        "features": {shown: lengths},
        "vector_style": "arrow",
        "edge_color": _FIELD_ARROW_COLOUR if shown == "field" else _ARROW_COLOUR,
        "edge_width": spacing / 9,
        # The data keep their unit; only the drawing is stretched.
        "length": float(0.95 * spacing / usual) if usual else 1.0,
        "opacity": 0.75,
    }


def thinned_arrows(displacement: Array, along: int = _ARROWS_ALONG) -> tuple[Array, float]:
    """Pick the displacement of rays, or another field of vectors, on a coarse grid.

    Parameters
    ----------
    displacement : ndarray, shape (2, H, W)
        Displacement in px, or a field in its unit.
    along : int
        Number of rays along the longer side.

    Returns
    -------
    data : ndarray, shape (n, 2, 2)
        Start of each ray in px and its vector, both (y, x). Rays that go nearly nowhere are
        left out.
    spacing : float
        Distance of the rays in px.
    """
    height, width = displacement.shape[1:]
    step = max(1, -(-max(height, width) // along))
    rows, columns = (
        index.ravel() for index in np.mgrid[step // 2 : height : step, step // 2 : width : step]
    )
    data = np.stack(
        [np.column_stack([rows, columns]), displacement[:, rows, columns].T], axis=1
    ).astype(np.float64)
    lengths = np.hypot(*data[:, 1].T)
    return data[lengths > _SHORTEST_ARROW * lengths.max(initial=0.0)], float(step)


def _sites(make: _Maker, inversion: Inversion) -> FullLayerData:
    from napari_shadowinv._napari.sites import site_features, site_spacing

    every = -(-len(inversion.sites) // _MOST_SITES_SHOWN)
    shown = slice(None, None, every)
    features = {name: values[shown] for name, values in site_features(inversion).items()}
    return make.layer(
        inversion.sites[shown],
        "points",
        "sites",
        "sites" if every == 1 else f"sites (1 in {every})",
        features=features,
        face_color="displacement",
        face_colormap=_FIELD_MAP,
        face_contrast_limits=opened((0.0, float(features["displacement"].max(initial=0.0)))),
        border_width=0.0,
        size=0.7 * site_spacing(inversion) * every**0.5,
        symbol="disc",
        visible=False,
    )


def _cells(make: _Maker, inversion: Inversion) -> FullLayerData:
    from napari_shadowinv._napari.sites import power_cells, site_features

    polygons, kept = power_cells(inversion)
    features = site_features(inversion)
    return make.layer(
        polygons,
        "shapes",
        "cells",
        "power cells",
        shape_type="polygon",
        features={name: values[kept] for name, values in features.items()},
        face_color="transparent",
        edge_color=_CAUSTIC_COLOUR,
        edge_width=0.05,
        opacity=0.7,
        visible=False,
    )


def intensity_limits(image: NDArray[Any]) -> tuple[float, float]:
    """Return limits that neither a caustic's few bright pixels nor a faint contrast can spoil.

    Parameters
    ----------
    image : ndarray, shape (H, W)
        An image; pixels that are not finite do not count.

    Returns
    -------
    tuple of float
        Lowest and highest value to tell apart.
    """
    sample = _sample(image)
    finite = sample[np.isfinite(sample)]
    if not finite.size:
        return 0.0, 1.0
    dark, bright = (float(value) for value in np.percentile(finite, (0.1, _BRIGHTEST)))
    mean = float(finite.mean())
    high = min(bright, _LARGEST_INTENSITY * mean) if mean > 0 else bright
    return opened((0.0 if 0 <= dark < 0.3 * high else dark, high))


def symmetric_limits(plane: Array) -> tuple[float, float]:
    """Return limits around zero that a handful of pixels at a caustic cannot blow up."""
    limit = float(np.percentile(np.abs(_sample(plane)), _BRIGHTEST))
    return -limit, limit


def _sample(plane: NDArray[Any]) -> NDArray[Any]:
    """Enough pixels of a large image for its limits."""
    step = max(1, int(np.sqrt(plane.size / _ENOUGH_PIXELS)))
    return plane[::step, ::step]


def opened(limits: tuple[float, float]) -> tuple[float, float]:
    """Return limits with something between them, also where all values are one."""
    low, high = limits
    return (low, high) if high > low else (low, low + 1.0)
