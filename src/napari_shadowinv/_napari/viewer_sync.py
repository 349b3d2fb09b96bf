"""Synchronisation with a viewer, and messages to its user.

Colour bar, placement of new images, label of the shown film; a sentence instead of a traceback for
a user's error.
"""

from __future__ import annotations

import functools
import sys
import weakref
from collections.abc import Callable
from typing import Any, TypeVar

from napari_shadowinv._napari.events import connect, connect_layers, without_proxy
from napari_shadowinv._napari.layer_metadata import Frame, frame_of, metadata_of, role_of
from napari_shadowinv._system.validation import FieldError
from napari_shadowinv.errors import InputError

USER_ERRORS = (InputError, OSError, MemoryError)
"""Errors that a user can resolve; all others are bugs, whose traceback is needed."""

ReturnValue = TypeVar("ReturnValue")


def in_event_loop() -> bool:
    """Whether the call comes from a menu, a dialog or napari's console, not from a script."""
    if "qtpy" not in sys.modules:
        return False
    from qtpy.QtCore import QThread

    thread = QThread.currentThread()
    return thread is not None and thread.loopLevel() > 0


def notify_errors(
    otherwise: Callable[[], ReturnValue],
) -> Callable[..., Callable[..., ReturnValue]]:
    """Show a user's error in a window as a notification, and return `otherwise()`."""

    def decorate(function: Callable[..., ReturnValue]) -> Callable[..., ReturnValue]:
        @functools.wraps(function)
        def guarded(*args: Any, **kwargs: Any) -> ReturnValue:
            try:
                return function(*args, **kwargs)
            except USER_ERRORS as error:
                if not in_event_loop():
                    raise
                show_user_error(error)
                return otherwise()

        return guarded

    return decorate


def error_text(error: BaseException) -> str:
    """Return the message of an error for the user; for a bug, its type and first line."""
    text = error.labelled if isinstance(error, FieldError) else str(error)
    if isinstance(error, MemoryError) and not text:
        text = "there is not enough memory for this"
    elif not isinstance(error, USER_ERRORS):
        first_line = text.partition("\n")[0]
        text = f"internal error: {type(error).__name__}: {first_line} (see the notification)"
    return text[:1].upper() + text[1:]


def show_user_error(error: BaseException) -> None:
    """Show a user's error as a notification."""
    from napari.utils.notifications import show_error

    show_error(error_text(error))


def show_caution(text: str) -> None:
    """Show a warning as a notification."""
    from napari.utils.notifications import show_warning

    show_warning(text)


# Longer names would be cut off next to the colour bar of a narrow window.
_NAME_SIZE_PT, _LINE_WIDTH_PT = 10, 460

_connected: weakref.WeakSet[Any] = weakref.WeakSet()


def connect_viewer(viewer: Any) -> None:
    """Connect to the layers of a viewer, once."""
    layers = without_proxy(viewer.layers)
    if layers not in _connected:
        _connected.add(layers)
        _follow_top_image(viewer)
        _place_new_images(viewer)
        _label_films(viewer)


def show_scale_bar(viewer: Any) -> None:
    """Switch on the scale bar."""
    overlays = getattr(getattr(viewer, "canvas", None), "overlays", viewer)  # napari before 0.9
    overlays.scale_bar.visible = True


def once_added(viewer: Any, count: int, show: Callable[[list[Any]], Any]) -> None:
    """Call a function with the next layers once napari has added and selected all of them."""
    from qtpy.QtCore import QTimer

    added: list[Any] = []

    def collect(layer: Any) -> None:
        added.append(layer)
        if len(added) == count:
            disconnect()
            # napari selects a layer after the event of its insertion.
            QTimer.singleShot(0, lambda: show(added))

    disconnect = connect(viewer.layers, "inserted", collect)


def _follow_top_image(viewer: Any) -> None:
    """Show colour bar and name of the plugin's topmost visible image, unless switched off."""
    active: list[Any] = []

    def follow(_: Any = None) -> None:
        top = _top_image(viewer.layers)
        if active and active[0] is top:
            return
        is_on = not active or active[0].colorbar.visible
        for layer in active:
            _show_bar(layer, False)
        if top is not None and role_of(top) is not None:
            active[:] = [top]
            _show_bar(top, is_on)
        elif is_on:
            active.clear()

    connect_layers(viewer.layers, "visible", follow)
    connect(viewer.layers, ("inserted", "removed", "reordered"), follow)
    follow()


def _top_image(layers: Any) -> Any | None:
    """Return the topmost visible image, unless it is a colour image without a colour bar."""
    for layer in reversed(layers):
        if layer.visible and layer.__class__.__name__ == "Image":
            return layer if hasattr(layer, "colorbar") and not layer.rgb else None
    return None


def _show_bar(layer: Any, on: bool) -> None:
    layer.colorbar.visible = on
    # napari lays out overlays of a corner next to each other.
    layer.name_overlay.position = layer.colorbar.position
    layer.name_overlay.font_size = min(_NAME_SIZE_PT, _LINE_WIDTH_PT / len(layer.name or " "))
    layer.name_overlay.visible = on


def _place_new_images(viewer: Any) -> None:
    """Place new images without a scale on results of the same size, or explain how to."""
    # With pixels and lengths together, napari drops the unit of its scale bar.

    def receive(layer: Any) -> None:
        fields = [result for result in viewer.layers if role_of(result) == "field"]
        fields = [field for field in fields if frame_of(field).units != Frame().units]
        if fields and _is_bare_image(layer):
            _place_on_result(layer, fields)

    connect(viewer.layers, "inserted", receive)


def _place_on_result(layer: Any, fields: list[Any]) -> None:
    from napari.utils.notifications import show_info, show_warning

    data = layer.data[0] if layer.multiscale else layer.data
    shape = data.shape[:-1] if layer.rgb else data.shape
    same_size = [field for field in fields if field.data.shape[-2:] == tuple(shape[-2:])]
    if not same_size:
        unit = f"{fields[-1].units[-1]:~P}"
        show_warning(
            f"'{layer.name}' is in pixels, the results are in {unit}, and their sizes differ, so "
            "they do not overlap. To set the scale, select the layer and its setup in 'Invert' "
            "and press 'Show at scale', or move the layer (layer controls → transform)"
        )
        return
    frame = frame_of(same_size[-1])
    for name, value in frame.keywords(stacked=layer.ndim > 2).items():
        setattr(layer, name, value)
    show_info(
        f"'{layer.name}' has the same size in pixels as '{same_size[-1].name}': it was placed at "
        f"the same position, with pixels of {frame.scale[-1]:.4g} {same_size[-1].units[-1]:~P}"
    )


def _is_bare_image(layer: Any) -> bool:
    """Whether a layer is the user's image at napari's default placement."""
    if layer.__class__.__name__ != "Image" or not 2 <= layer.ndim <= 3:
        return False
    is_plugin_layer = role_of(layer) is not None and layer.source.path is None
    return not is_plugin_layer and frame_of(layer) == Frame()


def plane_in_view(viewer: Any, layer: Any) -> int:
    """Return the index of a stack's shown plane."""
    index = round(float(layer.world_to_data(viewer.dims.point[-layer.ndim :])[0]))
    return min(max(index, 0), len(layer.data) - 1)


# The contrast limits of a stack's films, and the one in view.
_Planes = weakref.WeakKeyDictionary[Any, tuple[list[Any], int]]


def _label_films(viewer: Any) -> None:
    """Label the shown film of a pack on the canvas, and restore its contrast."""
    planes: _Planes = weakref.WeakKeyDictionary()
    labels: list[str] = []

    def follow(_: Any = None) -> None:
        text = ""
        for layer in viewer.layers:
            films = metadata_of(layer).get("films")
            if films is None or layer.ndim != 3:
                continue
            plane = plane_in_view(viewer, layer)
            _restore_contrast(planes, layer, plane)
            if layer.visible:
                text = films[plane]
        if text or labels:
            overlay = _text_overlay(viewer)
            if not text and overlay.text in labels:
                overlay.visible = False
            elif text:
                overlay.text, overlay.visible = text, True
            labels[:] = [text]

    connect_layers(viewer.layers, ("visible", "metadata"), follow)
    connect(viewer.layers, ("inserted", "removed"), follow)
    connect(viewer.dims, "current_step", follow)
    follow()


def _restore_contrast(planes: _Planes, layer: Any, plane: int) -> None:
    """Restore the contrast limits that a film had when it was last shown."""
    limits = metadata_of(layer).get("limits")
    if limits is None:
        return
    old_limits, old = planes.get(layer, (None, plane))
    planes[layer] = limits, plane
    if old_limits is not None and old_limits is limits and old != plane:
        limits[old] = tuple(layer.contrast_limits)
        low, high = limits[plane]
        # Fluences of films differ by powers of ten: the slider spans the range of one film.
        layer.contrast_limits_range = (min(0.0, low), 2 * high)
        layer.contrast_limits = (low, high)


def _text_overlay(viewer: Any) -> Any:
    overlays = getattr(getattr(viewer, "canvas", None), "overlays", None)
    return viewer.text_overlay if overlays is None else overlays.text  # napari before 0.9
