"""What keeps in step with a viewer: a colour bar, where images lie, which film is in view."""

from __future__ import annotations

import weakref
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from napari_shadowinv._napari.frame import Frame, frame_of
from napari_shadowinv._napari.layer_metadata import mark_of, role_of

# Beyond this length a name would be cut off beside the colour bar of a narrow window.
_NAME_SIZE_PT, _LINE_PT = 10, 460

_watched: weakref.WeakSet[Any] = weakref.WeakSet()


def keep_in_step(viewer: Any) -> None:
    """Watch the layers of a viewer; calling it again does nothing more."""
    # A widget may be handed a proxy, made anew each time.
    events = getattr(viewer.layers.events, "__wrapped__", viewer.layers.events)
    if events not in _watched:
        _watched.add(events)
        _follow_top_image(viewer, events)
        _place_newcomers(viewer, events)
        _tell_films(viewer, events)


def show_scale_bar(viewer: Any) -> None:
    """Switch on the scale bar."""
    overlays = getattr(getattr(viewer, "canvas", None), "overlays", viewer)  # napari before 0.9
    overlays.scale_bar.visible = True


def select_once_added(viewer: Any, described: Sequence[Any]) -> None:
    """Select the field of a result, with a scale bar, once napari has added its last layer."""
    from qtpy.QtCore import QTimer

    added: list[Any] = []

    def select() -> None:
        show_scale_bar(viewer)
        fields = [layer for layer in added if role_of(layer) == "field" and layer in viewer.layers]
        shown = [layer for layer in fields if layer.visible] or fields
        if shown:
            viewer.layers.selection.active = shown[-1]

    def collect(event: Any) -> None:
        added.append(event.value)
        if len(added) == len(described):
            viewer.layers.events.inserted.disconnect(collect)
            # napari selects a layer after it has announced it.
            QTimer.singleShot(0, select)

    viewer.layers.events.inserted.connect(collect)


def _follow_top_image(viewer: Any, events: Any) -> None:
    """Show colour bar and name of the topmost visible image of ours, unless switched off."""
    shown: list[Any] = []

    def follow(_: Any = None) -> None:
        top = _top_image(viewer.layers)
        if shown and shown[0] is top:
            return
        wanted = not shown or shown[0].colorbar.visible
        for layer in shown:
            _show_bar(layer, False)
        if top is not None and role_of(top) is not None:
            shown[:] = [top]
            _show_bar(top, wanted)
        elif wanted:
            shown.clear()

    def watch(event: Any) -> None:
        event.value.events.visible.connect(follow)
        follow()

    def leave(event: Any) -> None:
        event.value.events.visible.disconnect(follow)
        follow()

    for layer in viewer.layers:
        layer.events.visible.connect(follow)
    events.inserted.connect(watch)
    events.removed.connect(leave)
    events.reordered.connect(follow)
    follow()


def _top_image(layers: Any) -> Any | None:
    """The topmost visible layer that has a colour bar; napari has none for colour images."""
    for layer in reversed(layers):
        if layer.visible and layer.__class__.__name__ == "Image":
            return layer if hasattr(layer, "colorbar") and not layer.rgb else None
    return None


def _show_bar(layer: Any, on: bool) -> None:
    layer.colorbar.visible = on
    # Beside the bar, as napari lays out what shares a corner.
    layer.name_overlay.position = layer.colorbar.position
    layer.name_overlay.font_size = min(_NAME_SIZE_PT, _LINE_PT / len(layer.name or " "))
    layer.name_overlay.visible = on


def _place_newcomers(viewer: Any, events: Any) -> None:
    """Lay new images without a scale over results of the same size, or say how to."""
    # Of pixels and lengths side by side, napari drops the unit of its scale bar.

    def receive(event: Any) -> None:
        layer = event.value
        fields = [one for one in viewer.layers if role_of(one) == "field"]
        fields = [one for one in fields if frame_of(one).units != Frame().units]
        if fields and _is_bare_image(layer):
            _receive(layer, fields)

    events.inserted.connect(receive)


def _receive(layer: Any, fields: list[Any]) -> None:
    from napari.utils.notifications import show_info, show_warning

    alike = [one for one in fields if one.data.shape[-2:] == _size(layer)]
    if not alike:
        unit = f"{fields[-1].units[-1]:~P}"
        show_warning(
            f"'{layer.name}' is in pixels, the results are in {unit}, and their sizes differ, so "
            "they do not overlap. Set a scale: choose the layer in 'Invert shot' with its setup "
            "and press Run, or move it into place (layer controls → transform)"
        )
        return
    frame = frame_of(alike[-1])
    for name, value in frame.keywords(stacked=layer.ndim > 2).items():
        setattr(layer, name, value)
    show_info(
        f"'{layer.name}' has the same size in pixels as '{alike[-1].name}': it was placed at the "
        f"same position, with pixels of {frame.scale[-1]:.4g} {alike[-1].units[-1]:~P}"
    )


def _is_bare_image(layer: Any) -> bool:
    """Whether it is an image of the user's that lies where napari puts it by default."""
    if layer.__class__.__name__ != "Image" or not 2 <= layer.ndim <= 3:
        return False
    own = role_of(layer) is not None and layer.source.path is None
    return not own and frame_of(layer) == Frame()


def _size(layer: Any) -> tuple[int, ...]:
    data = layer.data[0] if layer.multiscale else layer.data
    shape = data.shape[:-1] if layer.rgb else data.shape
    return tuple(shape[-2:])


@dataclass
class _InView:
    """The plane of a stack of films that is seen, and the contrast of each."""

    given: Any
    limits: list[Any]
    plane: int


def plane_in_view(viewer: Any, layer: Any) -> int:
    """Return which plane of a stack is shown."""
    at = round(float(layer.world_to_data(viewer.dims.point[-layer.ndim :])[0]))
    return min(max(at, 0), len(layer.data) - 1)


def _tell_films(viewer: Any, events: Any) -> None:
    """Write above the canvas which film of a pack is in view; give each its own contrast."""
    seen: weakref.WeakKeyDictionary[Any, _InView] = weakref.WeakKeyDictionary()
    written: list[str] = []

    def follow(_: Any = None) -> None:
        text = ""
        for layer in viewer.layers:
            films = mark_of(layer).get("films")
            if films is None or layer.ndim != 3:
                continue
            plane = plane_in_view(viewer, layer)
            _adjust(seen, layer, plane)
            if layer.visible:
                text = films[plane]
        if text or written:
            overlay = _text_overlay(viewer)
            if not text and overlay.text in written:
                overlay.visible = False
            elif text:
                overlay.text, overlay.visible = text, True
            written[:] = [text]

    def watch(event: Any) -> None:
        for emitter in (event.value.events.visible, event.value.events.metadata):
            emitter.connect(follow)
        follow()

    for layer in viewer.layers:
        layer.events.visible.connect(follow)
        layer.events.metadata.connect(follow)
    events.inserted.connect(watch)
    events.removed.connect(follow)
    viewer.dims.events.current_step.connect(follow)
    follow()


def _adjust(seen: weakref.WeakKeyDictionary[Any, _InView], layer: Any, plane: int) -> None:
    """Let the dose or fluence of a film have the contrast that it had when it was last seen."""
    given = mark_of(layer).get("limits")
    if given is None:
        return
    before = seen.get(layer)
    if before is None or before.given is not given:
        seen[layer] = _InView(given, list(given), plane)
        return
    if before.plane == plane:
        return
    before.limits[before.plane] = tuple(layer.contrast_limits)
    before.plane = plane
    low, high = before.limits[plane]
    # Fluences of films differ by powers of ten: the slider should span those of one.
    layer.contrast_limits_range = (min(0.0, low), 2 * high)
    layer.contrast_limits = (low, high)


def _text_overlay(viewer: Any) -> Any:
    overlays = getattr(getattr(viewer, "canvas", None), "overlays", None)
    return viewer.text_overlay if overlays is None else overlays.text  # napari before 0.9
