"""Open napari with a shot and what its inversion retrieved.

python napari_view.py                    a sample shot
python napari_view.py result.shadowinv   a result that was saved
"""

import sys

import napari
from napari_shadowinv import InversionOptions, ProtonSetup, add_to_viewer, invert

viewer = napari.Viewer()
if len(sys.argv) > 1:
    viewer.open(sys.argv[1], plugin="napari-shadowinv")
else:
    *_, shot = viewer.open_sample("napari-shadowinv", "toroid_with_caustics")
    inversion = invert(shot.data, options=InversionOptions(n_sites=10_000))
    add_to_viewer(viewer, inversion, ProtonSetup.example(), name="toroid")

if __name__ == "__main__":
    napari.run()
