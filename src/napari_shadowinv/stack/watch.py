"""Watch a folder and invert each shot into a store as soon as it arrives: `watch_stack`."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from numpy.typing import ArrayLike

from napari_shadowinv._system.locking import locked
from napari_shadowinv._system.machine import clear_up_when_terminated
from napari_shadowinv._system.progress import ShouldStop
from napari_shadowinv.errors import InputError, InversionCancelled
from napari_shadowinv.inversion.compilation import ensure_compiled
from napari_shadowinv.io import read_stack
from napari_shadowinv.io.formats import NEW_SHOTS
from napari_shadowinv.io.store import check_store_path
from napari_shadowinv.io.store_writing import remove_unfinished
from napari_shadowinv.options import InversionOptions
from napari_shadowinv.stack._folder_events import Arrivals, checked_folder, observing
from napari_shadowinv.stack._plan import describe_stack
from napari_shadowinv.stack._run import stored_type, stored_variables
from napari_shadowinv.stack._sources import Reader, read_shot
from napari_shadowinv.stack._status import OnStatus
from napari_shadowinv.stack._watch_loop import StackMaker, Watch

if TYPE_CHECKING:
    import xarray

    from napari_shadowinv.physics.setup import Setup
    from napari_shadowinv.preprocessing import Recipe, Step


def watch_stack(
    folder: str | Path,
    out: str | Path,
    *,
    pattern: str = NEW_SHOTS,
    source: Any = None,
    mask: ArrayLike | None = None,
    recipe: Recipe | None = None,
    options: InversionOptions | None = None,
    setup: Setup | None = None,
    filters: Sequence[Step] = (),
    source_mask: ArrayLike | None = None,
    reader: Reader = read_shot,
    warm_start: bool = True,
    variables: Collection[str] | None = None,
    dtype: str = "float32",
    overwrite: bool = False,
    redo_failed: bool = False,
    skip_existing: bool = False,
    settle: float = 1.0,
    polling: bool = False,
    idle: float | None = None,
    shots: int | None = None,
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
    pattern : str, optional
        Pattern of the file names of shots; names that begin with a dot are ignored.
    source, mask, recipe, options, setup, filters, source_mask, reader
        As for `run_stack`; one source for all shots. Without a number of sites, the first shots
        decide it for all: up to three that exist at the start, or the first that arrives.
    warm_start : bool, optional
        Initialise each shot from the last but one, because two are inverted simultaneously, unless
        that one failed or did not converge. Fits, and shots with estimated sources, always start
        from zero.
    variables, dtype, overwrite, redo_failed
        As for `run_stack`.
    skip_existing : bool, optional
        Ignore files that exist at the start.
    settle : float, optional
        Seconds without a change after which a file is complete if the system does not report
        closed files: on network file systems, and on systems other than Linux.
    polling : bool, optional
        Poll the folder once a second instead of relying on file-system events.
    idle : float, optional
        Return after this many seconds without a new file.
    shots : int, optional
        Return after this many shots.
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
    place = checked_folder(folder, pattern)
    path = check_store_path(out)
    _check_numbers(settle=settle, idle=idle, shots=shots)
    describe = partial(
        describe_stack,
        variables=stored_variables(variables, recipe, mask),
        source=source,
        mask=mask,
        recipe=recipe,
        options=options,
        setup=setup,
        filters=filters,
        source_mask=source_mask,
        reader=reader,
        warm_start=1,
    )
    stored = stored_type(dtype)
    arrivals = Arrivals(place, pattern, settle=settle, existing=not skip_existing)
    stacks = StackMaker(describe, place, reader, chained=warm_start)
    watch = Watch(path, stored, stacks, arrivals, on_progress, should_stop)
    try:
        ensure_compiled(lambda news: watch.report(stage=f"compiling, {news.message}"), should_stop)
    except InversionCancelled:
        return None
    with clear_up_when_terminated(), locked(path):
        remove_unfinished(path)
        watch.open(overwrite=overwrite, redo_failed=redo_failed)
        with observing(arrivals, polling=polling, on_note=lambda note: watch.report(note=note)):
            watch.run(idle, shots)
    return read_stack(path) if watch.store is not None else None


def _check_numbers(**numbers: float | None) -> None:
    for name, value in numbers.items():
        if value is not None and not value > 0:
            raise InputError(f"{name} is {value:g}: expected a number above 0")
