"""Watching a viewer's layers, once for each viewer: `LayerEvents`."""

from __future__ import annotations

import weakref
from typing import Any

__all__ = ["LayerEvents"]


class LayerEvents:
    """The events of the layers of viewers, each handed out once."""

    def __init__(self) -> None:
        self._taken: weakref.WeakSet[Any] = weakref.WeakSet()

    def taken_from(self, viewer: Any) -> Any | None:
        """Return the events of a viewer's layers, None if they were taken before."""
        # A widget may be handed a proxy, made anew each time.
        events = getattr(viewer.layers.events, "__wrapped__", viewer.layers.events)
        if events in self._taken:
            return None
        self._taken.add(events)
        return events
