"""Many shots with dask, into one store that survives a crash.

- invert shots one by one into ``name.shadowinv.zarr``, and resume after a crash: `run_stack`
- watch a folder and invert each shot as soon as it arrives: `watch_stack`
- read one channel of colour images: `FileReader`
- what a run reports: `RunStatus`
"""

from napari_shadowinv.stack._plan import STORED
from napari_shadowinv.stack._run import RunStatus, run_stack
from napari_shadowinv.stack._shots import FileReader
from napari_shadowinv.stack._worker import ShotOutcome
from napari_shadowinv.stack.watch import watch_stack

__all__ = [
    "STORED",
    "FileReader",
    "RunStatus",
    "ShotOutcome",
    "run_stack",
    "watch_stack",
]
