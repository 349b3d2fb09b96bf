"""Commands of the menus *Layers > Measure*, *Filter*, *Transform* and *Register*.

They work on the selected image or shown shot.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from napari_shadowinv import preprocessing
from napari_shadowinv._napari import layer_metadata as about
from napari_shadowinv._napari import layers as results
from napari_shadowinv._napari import viewer_sync
from napari_shadowinv._napari.layer_metadata import frame_of, main_layers, source_on
from napari_shadowinv._napari.shots import shot_layer, shot_of_layer
from napari_shadowinv._napari.viewer_sync import without_proxy
from napari_shadowinv._system.progress import ShouldStop
from napari_shadowinv._typing import FloatArray
from napari_shadowinv.errors import InputError
from napari_shadowinv.physics.units import intensity_limits

if TYPE_CHECKING:
    import napari.layers
    import napari.types

    import napari
    from napari_shadowinv.preprocessing import Step
    from napari_shadowinv.shot import Shot


@dataclass(frozen=True)
class _Selection:
    """The plane on which a command works, with the name, setup, source and mask of its layer."""

    layer: Any
    shot: Shot

    @property
    def name(self) -> str:
        return str(self.shot.name)


Work = Callable[[ShouldStop], results.LayerData]


def _command(
    activity: str, usable: Callable[[Any], bool] = about.may_be_source
) -> Callable[[Callable[[_Selection, Any], Work]], Callable[..., list[Any]]]:
    """Make a command of the menus of a function of the selected image and its viewer.

    The work that it returns is done now, or in a thread if there is a window.
    """

    def as_command(plan: Callable[[_Selection, Any], Work]) -> Callable[..., list[Any]]:
        def command(
            layer: napari.layers.Layer | None = None, viewer: napari.Viewer | None = None
        ) -> list[napari.types.LayerDataTuple]:
            selection = _select_image(layer, viewer, usable)
            work = plan(selection, without_proxy(viewer))
            if viewer is None or not viewer_sync.in_event_loop():
                return list(work(lambda: False))
            from napari_shadowinv._napari.run import run_in_background

            run_in_background(
                f"{activity} {selection.name}",
                lambda _, should_stop: work(should_stop),
                lambda layers: results.add_layers(viewer, layers),
            )
            return []

        command.__name__, command.__doc__ = plan.__name__, plan.__doc__
        return viewer_sync.notify_errors(otherwise=list)(command)

    return as_command


@_command("Inverting", about.may_be_shot)
def invert_uniform(selection: _Selection, _: Any) -> Work:
    """Invert the selected image against a uniform source, with the default options."""
    from napari_shadowinv._napari.jobs import InversionJob

    origins = {"Source": "uniform", "Setup": about.setup_origin_of(selection.layer)}
    uniform = preprocessing.UniformEstimate()
    job = InversionJob(
        recipe=preprocessing.Recipe(source=uniform, setup=selection.shot.setup),
        name=selection.name,
        frame=frame_of(selection.layer),
        origins={title: text for title, text in origins.items() if text},
        shot=replace(selection.shot, name=None, setup=None, source=None, mask=None),
    )
    return lambda should_stop: main_layers(job.work(lambda _: None, should_stop).layer_data)


@_command("Removing hot pixels from")
def remove_hot_pixels(selection: _Selection, _: Any) -> Work:
    """Replace pixels that stand out of the noise by the median of their neighbours."""
    before = selection.shot.image

    def remove(should_stop: ShouldStop) -> results.LayerData:
        image = preprocessing.HotPixelFilter().filter_image(before, should_stop=should_stop)
        title = f"without {(image != before).sum()} hot or dead pixels"
        return [_derived(selection, image, title)]

    return remove


@_command("Filtering")
def high_pass(selection: _Selection, _: Any) -> Work:
    """Remove structures larger than about 0.15 of the image's shorter side; keep the mean."""
    image, width = selection.shot.image, 0.15 * min(selection.shot.shape)
    step, title = preprocessing.HighPassFilter(width=width), f"high-pass σ={width:.3g} px"
    return lambda _: [_derived(selection, step.filter_image(image), title)]


@_command("Cropping")
def crop(selection: _Selection, viewer: Any) -> Work:
    """Cut the selected image to the selected or last rectangle of the topmost shapes."""
    from napari_shadowinv._napari.widgets._layers import crop_of, image_of

    image_of(selection.layer)
    visible = [] if viewer is None else [each for each in viewer.layers if each.visible]
    shapes = [each for each in visible if _has_outline(each)]
    step = crop_of(shapes[-1], selection.layer) if shapes else None
    if step is None:
        raise InputError(
            f"there is no rectangle to crop to: draw one in a shapes layer, then select "
            f"'{selection.name}' again"
        )
    height, width = step.shape_after(selection.shot.shape)
    return lambda _: [_moved(selection, step, f"cropped to {width} × {height} px")]


@_command("Binning")
def bin_pixels(selection: _Selection, _: Any) -> Work:
    """Sum blocks of 2 × 2 pixels of the selected image."""
    return lambda _: [_moved(selection, preprocessing.Bin(factor=2), "binned 2 × 2")]


@_command("Aligning the source with", about.may_be_shot)
def align_source(selection: _Selection, viewer: Any) -> Work:
    """Shift a source so that it fits the selected image."""
    source, name = _source_for(selection, viewer)

    def align(_: ShouldStop) -> results.LayerData:
        measured = preprocessing.measure_shift(selection.shot.image, source, selection.shot.mask)
        if not measured.is_significant.any():
            raise InputError(f"'{name}' need not be moved, or cannot: its shift is {measured.text}")
        aligned = preprocessing.move(source, measured.significant)
        title = f"moved by {measured.text}"
        made_from = {"image": selection.name, "source": f"{name}, {title}"}
        beam = replace(selection, shot=replace(selection.shot, name=name))
        return [_derived(beam, aligned, title, role=about.SOURCE, made_from=made_from)]

    return align


def _source_for(selection: _Selection, viewer: Any) -> tuple[FloatArray, str]:
    """Return the source of an image and its name: selected with it, supplied, or the only one."""
    layer = selection.layer
    layers = [] if viewer is None else [each for each in viewer.layers if each is not layer]
    fitting = [
        each
        for each in layers
        if _is_image(each) and each.ndim == 2 and tuple(each.data.shape) == selection.shot.shape
    ]
    selected = [each for each in fitting if each in viewer.layers.selection]
    sources = [each for each in fitting if about.role_of(each) == about.SOURCE]
    for candidates in (selected, sources):
        if len(candidates) == 1:
            beam = source_on(candidates[0], candidates[0].data, layer)
            return np.asarray(beam, dtype=np.float64), candidates[0].name
    if selection.shot.source is None:
        raise InputError(
            f"no source for '{selection.name}' is selected: select its source, too (Ctrl+click), "
            "an image of the same size"
        )
    return selection.shot.source, f"{selection.name} source"


def _has_outline(layer: Any) -> bool:
    """Whether a layer has shapes other than lines."""
    is_of_shapes = about.kind_of(layer) == "shapes"
    return is_of_shapes and not {"line", "path"}.issuperset(layer.shape_type)


def _is_image(layer: Any) -> bool:
    return about.kind_of(layer) == "image" and not layer.rgb


def _select_image(
    layer: Any, viewer: Any, usable: Callable[[Any], bool] = about.may_be_shot
) -> _Selection:
    """Return the displayed plane of an image layer."""
    from napari.layers import Image

    if layer is None:
        raise InputError("no layer is selected: select an image in the layer list")
    if not isinstance(layer, Image) or layer.rgb:
        is_colour = isinstance(layer, Image)
        kind = "a colour image" if is_colour else f"of type {layer.__class__.__name__}"
        raise InputError(f"layer '{layer.name}' is {kind}: select a grey image")
    if not usable(layer):
        kind = "a source" if about.role_of(layer) == about.SOURCE else "part of a result"
        raise InputError(f"layer '{layer.name}' is {kind}: select the shot")
    data, name = about.data_of(layer), layer.name
    if data.ndim > 2:
        steps = [0] * data.ndim if viewer is None else viewer.dims.current_step
        index = tuple(int(step) for step in steps[-data.ndim : -2])
        data, name = data[index], f"{name} {','.join(map(str, index))}"
    shot = replace(
        shot_of_layer(layer, np.asarray(data)),
        name=name,
        setup=about.setup_of(layer),
        source=about.source_of(layer),
        mask=about.usable_of(layer),
    )
    return _Selection(without_proxy(layer), shot)


def _moved(selection: _Selection, step: Step, title: str) -> results.FullLayerData:
    """Return an image after a step that moves pixels, with its source and usable pixels."""
    moved, before = step.apply(selection.shot), selection.shot.shape
    frame = frame_of(selection.layer).beneath(step.matrix(before))
    properties = {
        "frame": frame,
        "setup": moved.setup,
        "source": moved.source,
        "usable": moved.mask,
    }
    return _derived(selection, moved.image, title, **properties)


def _derived(
    selection: _Selection, image: FloatArray, title: str, role: str | None = None, **changes: Any
) -> results.FullLayerData:
    """Return an image that was made from the selected one, of its setup, place and role."""
    layer = selection.layer
    place = {"frame": frame_of(layer), "setup": selection.shot.setup, **changes}
    return shot_layer(
        image,
        f"{selection.name} {title}",
        limits=intensity_limits(selection.shot.image),  # they show the effect of the filter
        role=role or about.role_of(layer),
        setup_origin=about.setup_origin_of(layer) or None,
        **place,
    )
