"""What processes of tests need: imported once by the process that they are forked from."""

import importlib

from helpers.night import OPTIONS, make_shots
from napari_shadowinv import invert

for name in ("dask.array", "distributed", "zarr", "napari_shadowinv.stack"):
    importlib.import_module(name)
importlib.import_module("xarray").backends.list_engines()
IMAGES, SOURCE = make_shots(1)
# A store, or several threads, would start some, which are not forked.
invert(IMAGES[0], source=SOURCE, options=OPTIONS.model_copy(update={"threads": 1}))
