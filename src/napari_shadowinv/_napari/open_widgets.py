"""Commands of menus that open a widget for the selected layer; `open_widget`."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from napari_shadowinv._napari.events import without_proxy
from napari_shadowinv._napari.viewer_sync import notify_errors
from napari_shadowinv.errors import InputError

if TYPE_CHECKING:
    import napari.layers

    import napari

_PLUGIN = "napari-shadowinv"


def open_widget(viewer: Any, name: str) -> Any:
    """Open one of the plugin's widgets, or bring it to the front, and return it."""
    window = _window_of(viewer)
    # napari's menus know the plugin by another name, under which it would be opened twice.
    for title, widget in window.dock_widgets.items():
        if title.startswith(f"{name} ("):
            widget = without_proxy(widget)
            widget.come_to_front()
            return widget
    _, widget = window.add_plugin_dock_widget(_PLUGIN, name)
    return widget


@notify_errors(otherwise=lambda: None)
def plot_along_line(
    layer: napari.layers.Layer | None = None, viewer: napari.Viewer | None = None
) -> None:
    """Plot the selected image along a line, in *Analyse*."""
    open_widget(viewer, "Analyse").plot_layer(without_proxy(layer))


@notify_errors(otherwise=lambda: None)
def measure_products(
    layer: napari.layers.Layer | None = None, viewer: napari.Viewer | None = None
) -> None:
    """Measure products of the result that the selected layer belongs to, in *Analyse*."""
    open_widget(viewer, "Analyse").measure_layer(without_proxy(layer))


@notify_errors(otherwise=lambda: None)
def predict_image(
    layer: napari.layers.Layer | None = None, viewer: napari.Viewer | None = None
) -> None:
    """Predict the image of the selected field or potential, in *Forward model*."""
    open_widget(viewer, "Forward model").start_from(without_proxy(layer))


@notify_errors(otherwise=lambda: None)
def watch_folder(viewer: napari.Viewer | None = None) -> None:
    """Choose a folder whose shots are inverted as they arrive, in *Invert stack*."""
    open_widget(viewer, "Invert stack").choose_folder()


@notify_errors(otherwise=lambda: None)
def edit_setup(
    layer: napari.layers.Layer | None = None, viewer: napari.Viewer | None = None
) -> None:
    """Enter the setup of the selected image."""
    window = _window_of(viewer)
    from napari_shadowinv._napari.widgets.image_setup import ImageSetup

    title = "Setup of an image"
    widget = window.dock_widgets.get(title)
    if widget is None:
        widget = ImageSetup(without_proxy(viewer))
        window.add_dock_widget(widget, name=title, area="right")
    else:
        without_proxy(widget).come_to_front()
    widget.choose(without_proxy(layer))


def _window_of(viewer: Any) -> Any:
    window = getattr(viewer, "window", None)
    if window is None:
        raise InputError("there is no window: choose this in a menu of napari")
    return window
