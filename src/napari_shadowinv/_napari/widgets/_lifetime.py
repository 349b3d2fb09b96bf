"""What is to be done when a Qt object is gone.

- call something then: `when_destroyed`
- listen to napari until then: `while_alive`
"""

from __future__ import annotations

import weakref
from collections.abc import Callable
from typing import Any

from qtpy.QtCore import QObject

__all__ = ["when_destroyed", "while_alive"]

# Held here, because a garbage collection that takes a widget away would first empty a function
# that only the widget holds, and then have Qt call it.
_callbacks: set[Callable[..., None]] = set()


def when_destroyed(thing: QObject, action: Callable[[], Any]) -> None:
    """Call a function when a Qt object is destroyed.

    Parameters
    ----------
    thing : QObject
        The object.
    action : callable
        It must not hold the object, which would then live for ever.
    """

    def once(*_: object) -> None:
        _callbacks.discard(once)
        action()

    _callbacks.add(once)
    thing.destroyed.connect(once)


def while_alive(thing: QObject, emitter: Any, method: Callable[..., Any]) -> None:
    """Connect a method to an event of a layer or viewer for as long as a Qt object lives.

    Parameters
    ----------
    thing : QObject
        The object.
    emitter : napari.utils.events.EventEmitter
        The event.
    method : bound method
        What to call.
    """
    emitter.connect(method)
    reference = weakref.WeakMethod(method)

    def disconnect() -> None:
        alive = reference()
        if alive is not None:
            emitter.disconnect(alive)

    when_destroyed(thing, disconnect)
