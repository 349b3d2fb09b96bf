"""Invert the selected layer of a napari that is open already, and show the result in it.

Type this into napari's console (the button with ``>_``), or drop this file onto its window.
The layer's own setup is used; an image without one is shown in pixels.
"""

import napari
from napari_shadowinv import InversionOptions, add_to_viewer, invert

viewer = napari.current_viewer()
shot = viewer.layers.selection.active

setup = shot.metadata.get("napari-shadowinv", {}).get("setup")

inversion = invert(shot.data, options=InversionOptions(n_sites=4000))
add_to_viewer(
    viewer,
    inversion,
    setup,
    name=shot.name,
    scale=shot.scale,  # the result lies on the shot, also where that was cropped or moved
    translate=shot.translate,
    units=[str(unit) for unit in shot.units],
)
