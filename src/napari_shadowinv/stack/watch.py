"""Watch a folder and invert each shot into a store as soon as it arrives: `watch_stack`."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from napari_shadowinv._system.locking import locked
from napari_shadowinv._system.machine import clear_up_when_terminated
from napari_shadowinv._system.progress import ShouldStop
from napari_shadowinv._system.validation import as_model
from napari_shadowinv.errors import InversionCancelled
from napari_shadowinv.inversion.compilation import ensure_compiled
from napari_shadowinv.io import read_stack
from napari_shadowinv.io.store import check_store_path
from napari_shadowinv.io.store_writing import remove_unfinished
from napari_shadowinv.options import WatchOptions
from napari_shadowinv.stack._folder_events import Arrivals, checked_folder, observing
from napari_shadowinv.stack._plan import describe_stack
from napari_shadowinv.stack._run import stored_variables
from napari_shadowinv.stack._sources import Reader, read_shot
from napari_shadowinv.stack._status import OnStatus
from napari_shadowinv.stack._watch_loop import StackMaker, Watch

if TYPE_CHECKING:
    import xarray

    from napari_shadowinv.preprocessing import Recipe


def watch_stack(
    folder: str | Path,
    out: str | Path,
    recipe: Recipe | None = None,
    *,
    source: Any = None,
    mask: ArrayLike | None = None,
    source_mask: ArrayLike | None = None,
    reader: Reader = read_shot,
    watch: WatchOptions | None = None,
    on_progress: OnStatus | None = None,
    should_stop: ShouldStop | None = None,
) -> xarray.Dataset | None:
    """Invert, or fit, each file that arrives in a folder as soon as it is completely written.

    Existing files come first, in counting order of their names, then new ones in the order in
    which they were completed; each gets the next number of the store. A file that cannot be
    inverted fails alone, with its reason. A file that is written again later is inverted again,
    under the same number. Another call with the same store resumes it, without repeating shots.

    Parameters
    ----------
    folder : str or Path
        Folder in which the files appear. Its subfolders are ignored.
    out : str or Path
        The store, ``name.shadowinv.zarr``, created when the first shot has been inverted.
    recipe, source, mask, source_mask, reader
        As for `run_stack`; one source for all shots. Without a number of sites, the first shots
        decide it for all: up to three that exist at the start, or the first that arrives.
    watch : WatchOptions, optional
        Choices of the watch: names of the files, when to stop, and those of a store. A mapping
        is converted.
    on_progress : callable, optional
        Receives a `RunStatus` at the start, after each shot, and at the end.
    should_stop : callable, optional
        Called regularly, also in other threads; the watch ends when it returns true. Unfinished
        shots are inverted when it is resumed.

    Returns
    -------
    xarray.Dataset or None
        The store, opened lazily; None if no shot could be inverted.

    Raises
    ------
    InputError
        If the arguments do not fit together, or not to the store.
    FileFormatError
        If the store cannot be used, another process is writing to it, or the folder disappears.
    OSError
        If the disk is full; the store can be resumed.
    """
    watch = as_model(WatchOptions, watch, "watch")
    place = checked_folder(folder, watch.pattern)
    path = check_store_path(out)
    describe = partial(
        describe_stack,
        recipe=recipe,
        variables=stored_variables(watch.variables, recipe, mask),
        source=source,
        mask=mask,
        source_mask=source_mask,
        reader=reader,
        warm_start=1,
    )
    existing = not watch.skip_existing
    arrivals = Arrivals(place, watch.pattern, settle=watch.settle, existing=existing)
    stacks = StackMaker(describe, place, reader, chained=watch.warm_start)
    loop = Watch(path, np.dtype(watch.dtype), stacks, arrivals, on_progress, should_stop)
    try:
        ensure_compiled(lambda news: loop.report(stage=f"compiling, {news.message}"), should_stop)
    except InversionCancelled:
        return None
    with clear_up_when_terminated(), locked(path):
        remove_unfinished(path)
        loop.open(overwrite=watch.overwrite, redo_failed=watch.redo_failed)
        note = partial(_report_note, loop)
        with observing(arrivals, polling=watch.polling, on_note=note):
            loop.run(watch.idle, watch.max_shots)
    return read_stack(path) if loop.store is not None else None


def _report_note(loop: Watch, sentence: str) -> None:
    loop.report(note=sentence)
