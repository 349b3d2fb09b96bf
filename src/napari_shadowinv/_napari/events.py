"""Events of napari's models: the only module that connects to them and disconnects.

- an event of a layer, of a viewer's dims, its layers or their selection: `connect`
- events of all layers, also of those to come: `connect_layers`

napari is replacing its emitters by psygnal's signals, which pass other arguments and which a model
may offer without a group ``events``. Here, callbacks do not depend on that.
"""

from __future__ import annotations

import weakref
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from inspect import ismethod
from typing import Any

Callback = Callable[[Any], Any]
Disconnect = Callable[[], None]

_OF_LAYERS = ("inserted", "removed")


def connect(model: Any, names: str | Sequence[str], callback: Callback) -> Disconnect:
    """Call a function at events of a model, and return a function that disconnects it.

    The callback gets the layer that was inserted or removed; at other events, the model. Methods
    are held weakly. Of several events, the model may lack some.
    """
    names = (names,) if isinstance(names, str) else names
    signals = {name: signal for name in names if (signal := _signal_of(model, name)) is not None}
    if not signals:
        raise AttributeError(f"{model!r} has no event {' or '.join(names)}")
    get_callback, source = _reference(callback), weakref.ref(without_proxy(model))

    def call_with_layer(*args: Any) -> None:
        # napari passes an event, psygnal the index and the layer.
        call(args[0].value if len(args) == 1 else args[-1])

    def call_with_model(*_: Any) -> None:
        call(source())

    def call(argument: Any) -> None:
        function = get_callback()
        if function is not None:
            function(argument)

    calls = [
        (signal, call_with_layer if name in _OF_LAYERS else call_with_model)
        for name, signal in signals.items()
    ]
    for signal, function in calls:
        signal.connect(function)

    def disconnect() -> None:
        for signal, function in calls:
            signal.disconnect(function)

    return disconnect


def connect_layers(layers: Any, names: str | Sequence[str], callback: Callback) -> Disconnect:
    """Call a function at events of each layer in a list, present or to come.

    The callback gets the layer. Methods are held weakly.
    """
    get_callback = _reference(callback)
    connections = ExitStack()

    def watch(layer: Any) -> None:
        function = get_callback()
        if function is not None:
            connections.callback(connect(layer, names, function))

    for layer in layers:
        watch(layer)
    connections.callback(connect(layers, "inserted", watch))
    return connections.close


def without_proxy(model: Any) -> Any:
    """Return a model itself where a widget got a proxy, perhaps a new one each time."""
    return getattr(model, "__wrapped__", model)


def _reference(callback: Callback) -> Callable[[], Callback | None]:
    return weakref.WeakMethod(callback) if ismethod(callback) else lambda: callback


def _signal_of(model: Any, name: str) -> Any | None:
    """Return the emitter or signal of an event: `events.name`, `name_changed` or `name`."""
    model = without_proxy(model)
    events = getattr(model, "events", None)
    for owner, attribute in ((events, name), (model, f"{name}_changed"), (model, name)):
        signal = getattr(owner, attribute, None)
        if hasattr(signal, "connect"):
            return signal
    return None
