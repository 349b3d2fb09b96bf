"""The user's choices in napari's *Preferences*, which napari has from version 0.9 on.

- a choice: `preference`; the defaults, which `napari.yaml` repeats: `DEFAULTS`
- the colour map of a quantity: `colour_map`
- the number of threads of the next run: `use_preferred_threads`
"""

from __future__ import annotations

from typing import Any

from napari_shadowinv._system.machine import set_default_threads

DEFAULTS: dict[str, dict[str, Any]] = {
    "colour_maps": {
        "image": "gray",
        "field": "inferno",
        "signed": "RdBu_r",
        "potential": "viridis",
        "uncertainty": "magma",
    },
    "widgets": {"threads": 0, "last_setup": False},
}


def preference(group: str, name: str) -> Any:
    """Return the user's choice, or the default where napari has no such preferences."""
    try:
        from napari.settings import get_plugin_settings

        settings = get_plugin_settings("napari-shadowinv")
    except (ImportError, KeyError):  # KeyError: the plugin is disabled
        return DEFAULTS[group][name]
    return getattr(getattr(settings, group), name)


def colour_map(quantity: str) -> str:
    """Return the name of the colour map for new layers of a quantity, such as ``"field"``."""
    return str(preference("colour_maps", quantity))


def use_preferred_threads() -> None:
    """Use the preferred number of threads from now on, wherever the options set none."""
    set_default_threads(preference("widgets", "threads") or None)
