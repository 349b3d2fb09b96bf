"""Many shots: lazily with dask, or into one store that survives a crash.

- describe the inversion of many shots and let dask do it: `invert_stack`
- write them shot by shot to ``name.shadowinv.zarr``, inverted or fitted, and go on after a crash:
  `run_stack`
- read a shot's file with a colour channel chosen, or binned: `read_shot`
- mean, spread and peaks across shots: `stack_statistics`
"""

from napari_shadowinv.stack._lazy import invert_stack
from napari_shadowinv.stack._references import read_shot
from napari_shadowinv.stack._run import RunProgress, run_stack
from napari_shadowinv.stack._spec import STORED
from napari_shadowinv.stack._statistics import stack_statistics
from napari_shadowinv.stack._worker import ShotOutcome

__all__ = [
    "STORED",
    "RunProgress",
    "ShotOutcome",
    "invert_stack",
    "read_shot",
    "run_stack",
    "stack_statistics",
]
