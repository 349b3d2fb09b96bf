"""Synchronisation with a viewer, and messages to its user.

- events of napari's models: `connect`, of all layers: `connect_layers`
- a sentence instead of a traceback for a user's error: `notify_errors`
- colour bar, and the label of the shown film: `connect_viewer`
"""

from __future__ import annotations

import functools
import sys
import weakref
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from typing import Any, TypeVar

from napari_shadowinv._napari.layer_metadata import (
    kind_of,
    metadata_of,
    result_of,
    role_of,
)
from napari_shadowinv._system.validation import FieldError
from napari_shadowinv.errors import InputError

USER_ERRORS = (InputError, OSError, MemoryError)
"""Errors that a user can resolve; all others are bugs, whose traceback is needed."""

ReturnValue = TypeVar("ReturnValue")
Disconnect = Callable[[], None]


def without_proxy(model: Any) -> Any:
    """Return a model itself where a widget got a proxy, perhaps a new one each time."""
    return getattr(model, "__wrapped__", model)


def connect(model: Any, names: str | Sequence[str], callback: Callable[[Any], Any]) -> Disconnect:
    """Call a function at events of a model, and return a function that disconnects it.

    It gets napari's event. Of several events, the model may lack some.
    """
    events = without_proxy(model).events
    names = (names,) if isinstance(names, str) else names
    emitters = [getattr(events, name) for name in names if name in events]
    for emitter in emitters:
        emitter.connect(callback)

    def disconnect() -> None:
        for emitter in emitters:
            emitter.disconnect(callback)

    return disconnect


def connect_layers(
    layers: Any, names: str | Sequence[str], callback: Callable[[Any], Any]
) -> Disconnect:
    """Call a function at events of each layer in a list, present or to come."""
    connections = ExitStack()

    def watch(layer: Any) -> None:
        connections.callback(connect(layer, names, callback))

    for layer in layers:
        watch(layer)
    connections.callback(connect(layers, "inserted", lambda event: watch(event.value)))
    return connections.close


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
    starts_with_name = bool(set("./\\_") & set(text.partition(" ")[0].rstrip(":.")))  # of a file
    return text if starts_with_name else text[:1].upper() + text[1:]


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
        _label_films(viewer)


def show_scale_bar(viewer: Any) -> None:
    """Switch on the scale bar."""
    overlays = getattr(getattr(viewer, "canvas", None), "overlays", viewer)  # napari before 0.9
    overlays.scale_bar.visible = True


def once_added(viewer: Any, count: int, show: Callable[[list[Any]], Any]) -> None:
    """Call a function with the next layers once napari has added and selected all of them."""
    from qtpy.QtCore import QTimer

    added: list[Any] = []

    def collect(event: Any) -> None:
        added.append(event.value)
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
        if layer.visible and kind_of(layer) == "image":
            return layer if hasattr(layer, "colorbar") and not layer.rgb else None
    return None


def _show_bar(layer: Any, on: bool) -> None:
    layer.colorbar.visible = on
    # napari lays out overlays of a corner next to each other.
    layer.name_overlay.position = layer.colorbar.position
    layer.name_overlay.font_size = min(_NAME_SIZE_PT, _LINE_WIDTH_PT / len(layer.name or " "))
    layer.name_overlay.visible = on


def plane_in_view(viewer: Any, layer: Any) -> int:
    """Return the index of a stack's shown plane."""
    index = round(float(layer.world_to_data(viewer.dims.point[-layer.ndim :])[0]))
    return min(max(index, 0), len(layer.data) - 1)


def _label_films(viewer: Any) -> None:
    """Label the shown film of a pack on the canvas, and restore its contrast."""
    labels: list[str] = []

    def follow(_: Any = None) -> None:
        text = ""
        for layer in viewer.layers:
            doses: Any = getattr(result_of(layer), "content", None)
            if not hasattr(doses, "film_label"):
                continue
            plane = plane_in_view(viewer, layer)
            _restore_contrast(layer, plane)
            if layer.visible:
                text = doses.film_label(plane)
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


def _restore_contrast(layer: Any, plane: int) -> None:
    """Restore the contrast limits that a film had when it was last shown."""
    facts = metadata_of(layer)
    limits, before, facts["plane"] = facts.get("limits"), facts.get("plane", plane), plane
    if limits is not None and before != plane:
        limits[before] = tuple(layer.contrast_limits)
        low, high = limits[plane]
        # Fluences of films differ by powers of ten: the slider spans the range of one film.
        layer.contrast_limits_range = (min(0.0, low), 2 * high)
        layer.contrast_limits = (low, high)


def _text_overlay(viewer: Any) -> Any:
    overlays = getattr(getattr(viewer, "canvas", None), "overlays", None)
    return viewer.text_overlay if overlays is None else overlays.text  # napari before 0.9
