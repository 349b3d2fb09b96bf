"""What the menus *Layers > Measure* and *Filter* do with the selected image or shot in view."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from napari_shadowinv._napari import layer_metadata as about
from napari_shadowinv._napari import layers as results
from napari_shadowinv._napari import notifications
from napari_shadowinv._napari.frame import Frame, frame_of
from napari_shadowinv._napari.kinds import main_layers
from napari_shadowinv._napari.shots import loaded, radiograph_of, shot_layer
from napari_shadowinv._system.progress import ShouldStop
from napari_shadowinv._typing import FloatArray
from napari_shadowinv.errors import InputError, InversionCancelled
from napari_shadowinv.physics.units import intensity_limits

if TYPE_CHECKING:
    import napari.layers
    import napari.types

    import napari
    from napari_shadowinv.physics.setup import Setup
    from napari_shadowinv.preprocessing import Radiograph


@dataclass(frozen=True)
class _Picked:
    """The image that a command works on."""

    shot: Radiograph
    name: str
    frame: Frame
    setup: Setup | None
    setup_origin: str
    role: str | None

    @property
    def image(self) -> FloatArray:
        return self.shot.image


@notifications.notify_errors(otherwise=list)
def invert_uniform(
    layer: napari.layers.Layer | None = None, viewer: napari.Viewer | None = None
) -> list[napari.types.LayerDataTuple]:
    """Invert the selected image against a uniform source, with the default options."""
    return _begin(_picked(layer, viewer), _inverted, "Inverting", viewer)


@notifications.notify_errors(otherwise=list)
def refine(
    layer: napari.layers.Layer | None = None, viewer: napari.Viewer | None = None
) -> list[napari.types.LayerDataTuple]:
    """Fit the forward model to the image of the selected inversion; in a window by Invert shot."""
    if layer is None:
        raise InputError("no layer is selected: select a layer of an inversion's result")
    from napari_shadowinv._napari.fit_jobs import name_of_result, refinement

    name = name_of_result(layer)
    job = refinement(layer, layer, name, psf=0.0)
    if viewer is None or not notifications.in_event_loop():
        return list(job.run(lambda _: None, lambda: False).described)
    _, tool = viewer.window.add_plugin_dock_widget("napari-shadowinv", "Invert shot")
    tool.refine_layer(layer)
    return []


@notifications.notify_errors(otherwise=list)
def remove_hot_pixels(
    layer: napari.layers.Layer | None = None, viewer: napari.Viewer | None = None
) -> list[napari.types.LayerDataTuple]:
    """Replace pixels that stand out of the noise by the median of their neighbours."""
    picked = _picked(layer, viewer, about.may_be_source)
    return _begin(picked, _repaired, "Removing hot pixels from", viewer)


@notifications.notify_errors(otherwise=list)
def high_pass(
    layer: napari.layers.Layer | None = None, viewer: napari.Viewer | None = None
) -> list[napari.types.LayerDataTuple]:
    """Take away structures larger than some 0.15 of the image's shorter side; the mean stays."""
    return _begin(_picked(layer, viewer, about.may_be_source), _high_passed, "Filtering", viewer)


@notifications.notify_errors(otherwise=list)
def estimate_source(
    layer: napari.layers.Layer | None = None, viewer: napari.Viewer | None = None
) -> list[napari.types.LayerDataTuple]:
    """Estimate the undisturbed beam as the image of least total variation near the selected one."""
    return _begin(_picked(layer, viewer), _beam, "Estimating the source of", viewer)


def _picked(layer: Any, viewer: Any, usable: Callable[[Any], bool] = about.may_be_shot) -> _Picked:
    """Take the plane that is shown of an image layer."""
    from napari.layers import Image

    if layer is None:
        raise InputError("no layer is selected: select one image in the layer list")
    if not isinstance(layer, Image) or layer.rgb:
        is_colour = isinstance(layer, Image)
        kind = "a colour image" if is_colour else f"of type {layer.__class__.__name__}"
        raise InputError(f"layer '{layer.name}' is {kind}: select a grey image")
    if not usable(layer):
        kind = "a source" if about.role_of(layer) == about.SOURCE else "part of a result"
        raise InputError(f"layer '{layer.name}' is {kind}: select the shot")
    data, name = layer.data[0] if layer.multiscale else layer.data, layer.name
    if data.ndim > 2:
        steps = [0] * data.ndim if viewer is None else viewer.dims.current_step
        at = tuple(int(step) for step in steps[-data.ndim : -2])
        data, name = data[at], f"{name} {','.join(map(str, at))}"
    known = about.setup_of(layer), about.setup_origin_of(layer), about.role_of(layer)
    return _Picked(radiograph_of(layer, np.asarray(data)), name, frame_of(layer), *known)


Work = Callable[[_Picked, ShouldStop], list[results.FullLayerData]]


def _begin(picked: _Picked, work: Work, doing: str, viewer: Any) -> list[Any]:
    """Do the work at once, or beside a window."""
    if viewer is None or not notifications.in_event_loop():
        return list(work(picked, lambda: False))
    from napari.qt.threading import create_worker
    from napari.utils import cancelable_progress

    bar = cancelable_progress(total=0, desc=f"{doing} {picked.name}")

    def finish(outcome: tuple[list[results.FullLayerData], Exception | None]) -> None:
        layers, error = outcome
        bar.close()
        if error is None:
            results.add_layers(viewer, layers)
        elif isinstance(error, notifications.MISTAKES):
            notifications.show_mistake(error)
        elif not isinstance(error, InversionCancelled):
            raise error

    # An error must not leave the worker: what napari then does differs between its versions.
    def run() -> tuple[list[results.FullLayerData], Exception | None]:
        # A closing window asks its workers to stop; the cross only leaves a mark on the bar.
        try:
            return work(picked, lambda: bar.is_canceled or worker.abort_requested), None
        except Exception as error:
            return [], error

    worker = create_worker(run)
    worker.returned.connect(finish)
    worker.start()
    return []


def _inverted(picked: _Picked, should_stop: ShouldStop) -> list[results.FullLayerData]:
    from napari_shadowinv.pipeline._run import run
    from napari_shadowinv.preprocessing import Recipe, UniformEstimate

    recipe = Recipe(source=UniformEstimate(), setup=picked.setup)
    inversion = run(recipe, loaded(picked.shot, "the image"), should_stop=should_stop)
    told = {"source_origin": "uniform"}
    if picked.setup_origin:
        told["setup_origin"] = picked.setup_origin
    result = about.Result(inversion, picked.setup, told)
    return main_layers(results.result_layers(result, picked.frame, picked.name))


def _repaired(picked: _Picked, should_stop: ShouldStop) -> list[results.FullLayerData]:
    from napari_shadowinv.preprocessing import remove_hot_pixels as remove

    image, hot, dead = remove(picked.image, should_stop=should_stop)
    return [_filtered(picked, image, f"without {int((hot | dead).sum())} hot or dead pixels")]


def _high_passed(picked: _Picked, should_stop: ShouldStop) -> list[results.FullLayerData]:
    from napari_shadowinv.preprocessing import high_pass as remove_large

    width = 0.15 * min(picked.image.shape)
    return [_filtered(picked, remove_large(picked.image, width), f"high-pass σ={width:.3g} px")]


def _beam(picked: _Picked, should_stop: ShouldStop) -> list[results.FullLayerData]:
    from napari_shadowinv.preprocessing import total_variation_source

    source = total_variation_source(picked.image, should_stop=should_stop)
    return [_filtered(replace(picked, role=about.SOURCE), source, "source by total variation")]


def _filtered(picked: _Picked, image: FloatArray, title: str) -> results.FullLayerData:
    return shot_layer(
        image,
        f"{picked.name} {title}",
        picked.setup,
        intensity_limits(picked.image),  # the same limits show what a filter did
        picked.role,
        frame=picked.frame,
        setup_origin=picked.setup_origin or None,
    )
