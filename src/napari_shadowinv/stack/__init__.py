"""Many shots: lazily with dask, or into one store that survives a crash.

- describe the inversion of many shots and let dask do it: `invert_stack`
- write them shot by shot to ``name.shadowinv.zarr``, and go on after a crash: `run_stack`
- mean, spread and peaks across shots: `stack_statistics`
"""

from napari_shadowinv.stack._lazy import invert_stack
from napari_shadowinv.stack._run import STORED, RunProgress, ShotOutcome, run_stack
from napari_shadowinv.stack._statistics import stack_statistics

__all__ = [
    "STORED",
    "RunProgress",
    "ShotOutcome",
    "invert_stack",
    "run_stack",
    "stack_statistics",
]
