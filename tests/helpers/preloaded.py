"""What processes of tests need: imported once by the process that they are forked from."""

import importlib
import os

from helpers.night import OPTIONS, make_shots
from napari_shadowinv import invert

if "PRELOADING" in os.environ:  # as `helpers.forked` says; pytest looks for examples here, too
    for name in ("dask.array", "distributed", "zarr", "napari_shadowinv.stack"):
        importlib.import_module(name)
    importlib.import_module("xarray").backends.list_engines()
    images, source = make_shots(1)
    # A store, or several threads, would start some, which are not forked.
    invert(images[0], source=source, options=OPTIONS.model_copy(update={"threads": 1}))
