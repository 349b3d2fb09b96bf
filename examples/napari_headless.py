"""Layers without a window: make them, look at one, and save all of them.

A `ViewerModel` is napari's viewer without a window; it needs no display. What it saves opens in
napari with the same layers.

    python napari_headless.py [shot.tif]
"""

import sys
from pathlib import Path

import numpy as np
from napari.components import ViewerModel
from npe2 import PluginManager

from napari_shadowinv import InversionOptions, ProtonSetup, add_to_viewer, invert
from napari_shadowinv.io import read_shot
from napari_shadowinv.physics.forward import synthetic_image
from napari_shadowinv.physics.phantoms import toroid

setup = ProtonSetup.example()
if len(sys.argv) > 1:
    shot = read_shot(sys.argv[1]).image
else:
    shot = synthetic_image(toroid((100, 100), setup, peak=90, sigma=15e-6).displacement)

inversion = invert(shot, options=InversionOptions(n_sites=2500))

PluginManager.instance().discover()  # a window does this by itself
viewer = ViewerModel()
add_to_viewer(viewer, inversion, setup, name="shot 1")
for layer in viewer.layers:
    print(f"{layer.name:48s} {type(layer).__name__:8s} {'shown' if layer.visible else 'hidden'}")

field = viewer.layers.selection.active  # its name begins with the mark of the verdict
row, column = np.unravel_index(np.argmax(field.data), field.data.shape)
place = field.data_to_world((row, column))
print(f"strongest {field.data.max():.3g} mT·m at y, x = {place[0]:.4g}, {place[1]:.4g} µm")

target = Path("shot_1.shadowinv")
target.unlink(missing_ok=True)
viewer.layers.save(str(target), plugin="napari-shadowinv")
print(f"saved {target}, {target.stat().st_size // 1024} kB")
