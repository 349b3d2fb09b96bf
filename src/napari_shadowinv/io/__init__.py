"""Files: radiographs in, results out, a module for each family of formats.

- read an image or a result: `read`; only one of them: `read_shot`, `read_dataset`
- the tracks of a scan of CR-39: `read_tracks`
- an image with its metadata: `Shot`; sum its pixels: `Shot.bin_pixels`
- write a result or an image: `write`; check the path beforehand: `check_output`
- results of many shots in one store: `read_stack`; recognise its folder: `is_stack`
- write a file of your own, whole or not at all: `replacing`
- a 3-D field of a simulation: `read_field_grid`; recognise it: `is_field_grid`
- every format, and how to add one: `napari_shadowinv.io.formats`
"""

import lazy_loader

# The command's help lists the formats without numpy.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
