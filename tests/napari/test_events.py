"""Callbacks of events: the same with napari's emitters and with psygnal's signals."""

from __future__ import annotations

import gc
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import psygnal
import pytest
from napari.components import LayerList
from napari.layers import Image
from psygnal.containers import EventedList

from napari_shadowinv._napari.events import connect, connect_layers, without_proxy


@dataclass(eq=False)
class GroupedLayer:
    """A layer whose signals are in psygnal's group."""

    name: str = "a"
    visible: bool = True
    events: ClassVar[psygnal.SignalGroupDescriptor] = psygnal.SignalGroupDescriptor()


class SignallingLayer:
    """A layer with psygnal's signals, without a group."""

    name_changed = psygnal.Signal(str)
    visible_changed = psygnal.Signal(bool)
    _name, _visible = "a", True

    @property
    def name(self) -> str:
        return self._name

    @name.setter
    def name(self, name: str) -> None:
        self._name = name
        self.name_changed.emit(name)

    @property
    def visible(self) -> bool:
        return self._visible

    @visible.setter
    def visible(self, visible: bool) -> None:
        self._visible = visible
        self.visible_changed.emit(visible)


MODELS = {
    "napari": (LayerList, lambda: Image(np.ones((4, 5)))),
    "psygnal's group": (EventedList, GroupedLayer),
    "psygnal's signals": (EventedList, SignallingLayer),
}


@pytest.fixture(params=MODELS)
def models(request: pytest.FixtureRequest) -> tuple[Callable[[], Any], Callable[[], Any]]:
    """What makes a list of layers, and a layer."""
    return MODELS[request.param]


def test_a_callback_gets_the_layer_or_the_model(models: Any) -> None:
    layers, layer = (make() for make in models)
    calls: list[Any] = []
    connect(layers, ("inserted", "removed"), lambda each: calls.append(("list", each)))
    connect(layer, "name", lambda each: calls.append(("name", each)))
    layers.append(layer)
    layer.name = "b"
    layers.remove(layer)
    assert [kind for kind, _ in calls] == ["list", "name", "list"]
    assert all(each is layer for _, each in calls)


def test_each_layer_is_followed_until_it_is_disconnected(models: Any) -> None:
    make_layers, make_layer = models
    layers, first, second = make_layers(), make_layer(), make_layer()
    layers.append(first)
    calls: list[Any] = []
    disconnect = connect_layers(layers, ("name", "visible"), calls.append)
    layers.append(second)
    first.visible, second.name = False, "c"
    assert len(calls) == 2
    assert calls[0] is first
    assert calls[1] is second
    disconnect()
    layers.append(third := make_layer())
    first.visible, second.name, third.name = True, "d", "e"
    assert len(calls) == 2


def test_a_method_is_not_kept_alive(models: Any) -> None:
    layers, layer = (make() for make in models)
    calls: list[Any] = []

    class Owner:
        def note(self, model: Any) -> None:
            calls.append(model)

    owner = Owner()
    connect(layers, "inserted", owner.note)
    connect_layers(layers, "name", owner.note)
    layers.append(layer)
    layer.name = "b"
    assert len(calls) == 2
    del owner
    gc.collect()
    layer.name = "c"
    layers.remove(layer)
    layers.append(layer)
    assert len(calls) == 2


def test_an_event_that_does_not_exist_is_an_error(models: Any) -> None:
    _, make_layer = models
    layer = make_layer()
    calls: list[Any] = []
    with pytest.raises(AttributeError, match="no event naem"):
        connect(layer, "naem", calls.append)
    connect(layer, ("name", "paint"), calls.append)  # images have no `paint`
    layer.name = "b"
    assert len(calls) == 1


def test_the_list_behind_a_proxy_is_the_same_each_time(viewer: Any) -> None:
    from napari.utils._proxies import PublicOnlyProxy

    proxies = [PublicOnlyProxy(viewer) for _ in range(2)]
    assert all(without_proxy(proxy.layers) is viewer.layers for proxy in proxies)
    calls: list[Any] = []
    connect(proxies[0].layers, "inserted", calls.append)
    layer = viewer.add_image(np.ones((4, 5)))
    assert calls[0] is layer
