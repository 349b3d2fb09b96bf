"""A folder watched: each shot into the store as soon as it has arrived, see `watch_stack`."""

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
from napari_shadowinv.io.store_layout import remove_unfinished
from napari_shadowinv.options import InversionOptions
from napari_shadowinv.stack._folder_events import Arrivals, checked_folder, observing
from napari_shadowinv.stack._plan import describe_stack
from napari_shadowinv.stack._run import stored_type, stored_variables
from napari_shadowinv.stack._sources import Reader, read_shot
from napari_shadowinv.stack._watch_loop import Books, OnWatchProgress, StackMaker, Watch

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
    on_progress: OnWatchProgress | None = None,
    should_stop: ShouldStop | None = None,
) -> xarray.Dataset | None:
    """Invert, or fit, each file that arrives in a folder as soon as it is completely written.

    Files that are there already come first, in counting order of their names, then new ones in
    the order in which they were completed; each gets the next number of the store. A file that
    cannot be inverted fails alone, with its reason. One that is written again later is inverted
    again, under the same number. Watch again with the same store, and it goes on: shots that are
    there are not done again.

    Parameters
    ----------
    folder : str or Path
        Folder in which the files appear. Those in folders inside it are not looked at.
    out : str or Path
        The store, ``name.shadowinv.zarr``, made when the first shot has been inverted.
    pattern : str, optional
        What names of shots look like; names that begin with a dot are never shots.
    source, mask, recipe, options, setup, filters, source_mask, reader
        As for `run_stack`; one source for all shots. Without a number of sites, the first shots
        decide how many all of them get: up to three that are there at the start, or the first
        that arrives.
    warm_start : bool, optional
        Initialise each shot from the last but one, as two are inverted at once, unless that failed
        or did not converge. Shots with a source estimated from each, and fits, always start
        afresh.
    variables, dtype, overwrite, redo_failed
        As for `run_stack`.
    skip_existing : bool, optional
        Leave out files that are there at the start.
    settle : float, optional
        Seconds without a change after which a file is complete where the system does not tell
        when a file is closed: on network file systems, and other systems than Linux.
    polling : bool, optional
        Look at the folder every second instead of being told by the system.
    idle : float, optional
        Return when nothing has arrived for so many seconds.
    shots : int, optional
        Return when so many shots have ended.
    on_progress : callable, optional
        Receives a `WatchProgress` at the start, when a shot has ended, and at the end.
    should_stop : callable, optional
        Asked now and then, also in other threads; when it returns true, the watch ends. What was
        not finished is done when it is resumed.

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
    kept = stored_type(dtype)
    arrivals = Arrivals(place, pattern, settle=settle, existing=not skip_existing)
    books = Books(arrivals, on_progress)
    try:
        ensure_compiled(lambda news: books.prepare(f"compiling, {news.message}"), should_stop)
    except InversionCancelled:
        return None
    with clear_up_when_terminated(), locked(path):
        remove_unfinished(path)
        stacks = StackMaker(describe, place, reader, chained=warm_start)
        watch = Watch(path, kept, stacks, arrivals, books, should_stop)
        watch.open(overwrite=overwrite, redo_failed=redo_failed)
        with observing(arrivals, polling=polling, on_note=books.note):
            watch.run(idle, shots)
    return read_stack(path) if books.store is not None else None


def _check_numbers(**given: float | None) -> None:
    for name, value in given.items():
        if value is not None and not value > 0:
            raise InputError(f"{name} is {value:g}: expected a number above 0")
