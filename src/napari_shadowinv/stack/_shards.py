"""Shards: parts of a stack's shots that several processes write into one store at a time.

- the part of a run: `Shard`; the numbers of its shots: `numbers_of`
- the store when all shards have ended: `merge_stack`; what it waits for: `incomplete_shards`

Each shot has files of its own, which only its shard writes, and a store's other files are written
before the first shard and after the last. So shards hold no lock, on whatever file system.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Self

import numpy as np

from napari_shadowinv._system.hidden_files import locked
from napari_shadowinv._system.machine import clear_up_when_terminated
from napari_shadowinv._typing import AnyArray
from napari_shadowinv.errors import InputError
from napari_shadowinv.io import read_stack
from napari_shadowinv.io.store import (
    DAMAGED,
    DONE,
    FAILED,
    SHARDS,
    SHOT_FILES,
    StackStore,
    check_files,
    check_store_path,
)
from napari_shadowinv.io.store_writing import finish_shards, summarise
from napari_shadowinv.pipeline.run_options import RunOptions
from napari_shadowinv.stack._shots import Shots

if TYPE_CHECKING:
    import xarray


@dataclass(frozen=True)
class Shard:
    """Part of a stack's shots."""

    number: int  # from 1
    count: int  # of all shards
    files: str  # checksum of the places of all shots' files, which all shards must share

    @classmethod
    def of(cls, part: tuple[int, int] | None, shots: Shots, out: Path) -> Self | None:
        """Return a shard of the shots for a store; None for all shots."""
        if part is None:
            return None
        exposures = [each for shot in shots.items for each in (shot, shot.source)]
        lines = (f"{each.images.identity(out.parent) if each else ''}\n" for each in exposures)
        return cls(*part, hashlib.sha256("".join(lines).encode()).hexdigest())


def numbers_of(run: RunOptions, shots: int) -> list[int] | None:
    """Return the numbers of the shots of a run's shard, of `shots`; None for all."""
    if run.part is None:
        return None
    number, count = run.part
    return np.flatnonzero(_shard_numbers(shots, count, run.warm_start) == number).tolist()


def _shard_numbers(shots: int, count: int, group: int) -> AnyArray:
    """Return the shard of each shot: in turn, for similar times, but a group stays together."""
    return np.arange(shots) // group % count + 1


def check_shard(store: StackStore, shard: Shard | None) -> None:
    """Refuse to continue a store in other shards, or without a shard before they are merged."""
    count = store.attributes.get(SHARDS)
    if count == (None if shard is None else shard.count):
        return
    if shard is None:
        raise InputError(
            f"{store.path} is written in {count} shards: merge them before you continue without "
            "shards, overwrite the store, or choose another name"
        )
    if count is None:
        raise InputError(
            f"{store.path} was written without shards, or its shards are merged: continue without "
            "a shard, or choose another name"
        )
    raise InputError(
        f"{store.path} is written in {count} shards, received shard {shard.number} of "
        f"{shard.count}: use the same number of shards, or choose another name"
    )


def check_shots(store: StackStore, shard: Shard, shots: int) -> None:
    """Refuse shots that differ from the shots of the other shards, among them the store's."""
    if shots > len(store.names):
        raise InputError(
            f"{store.path} was started with {len(store.names)} shots, received {shots}: use the "
            "same for all shards; new shots can be appended once they are merged"
        )
    if store.attributes[SHOT_FILES] != shard.files:
        raise InputError(
            f"{store.path} was started with shots of the same names from other files or with "
            "other rows of a table: use the same for all shards, or choose another name"
        )


def incomplete_shards(store: StackStore) -> str:
    """Return the numbers of the shards with shots that have not ended, such as 3,7-9."""
    shots, count = len(store.names), store.attributes[SHARDS]
    shards = _shard_numbers(shots, count, int(store.attributes["warm_start"]))
    has_ended = np.isin(store.statuses(), (DONE, FAILED))
    numbers = np.unique(shards[~has_ended]).tolist()
    ranges = []
    for _, pairs in groupby(enumerate(numbers), lambda pair: pair[1] - pair[0]):
        first, *others = (number for _, number in pairs)
        ranges.append(f"{first}-{others[-1]}" if others else str(first))
    return ",".join(ranges)


def merge_stack(out: str | Path) -> xarray.Dataset:
    """Complete a store that was written in shards; it is then as if written by a single run.

    Nothing is changed unless all shots have ended, done or failed.

    Parameters
    ----------
    out : str or Path
        The store, ``name.shadowinv.zarr``. No shard may be running.

    Returns
    -------
    xarray.Dataset
        The store, opened lazily.

    Raises
    ------
    InputError
        If shards are incomplete, or there are none.
    FileFormatError
        If the store cannot be used or is damaged, or another process is merging it.
    OSError
        If the disk is full; repeat the call.
    """
    path = check_store_path(out)
    StackStore(path)  # a path without a store gets no lock
    with clear_up_when_terminated(), locked(path):
        store = StackStore(path)
        if SHARDS not in store.attributes:
            raise InputError(
                f"{path} has no shards to merge: they are merged already, or it was written "
                "without shards"
            )
        if shards := incomplete_shards(store):
            statuses = store.statuses()
            damaged = int((statuses == DAMAGED).sum())
            pending = int((~np.isin(statuses, (DONE, FAILED, DAMAGED))).sum())
            subject, verb = ("shard", "is") if shards.isdecimal() else ("shards", "are")
            counts = f"{pending} shots pending" + (f", {damaged} damaged" if damaged else "")
            raise InputError(
                f"{path} cannot be merged yet, as {subject} {shards} of {store.attributes[SHARDS]} "
                f"{verb} incomplete ({counts}): run {subject} {shards} again, then merge"
            )
        summarise(store)
        if store.damage.files:  # columns of a killed merge, which are intact by now, or others
            check_files(StackStore(path))
        finish_shards(path)
    return read_stack(path)
