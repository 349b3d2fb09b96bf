"""A store that grows by one shot at a time while its run goes on: `GrowingStore`.

It is opened once. The cost of a shot does not depend on how many there are already.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from napari_shadowinv.io.store import (
    DONE,
    FAILED,
    PENDING,
    STATUS_NAMES,
    ShotWriter,
    StackStore,
    kind_of_shots,
    open_to_write,
    store_error,
)
from napari_shadowinv.io.store_checksums import read_labels
from napari_shadowinv.io.store_columns import columns_of
from napari_shadowinv.io.store_layout import lengthen


@dataclass(frozen=True)
class _OpenWriter(ShotWriter):
    """Writer that does not open the store for each shot."""

    opened: dict[str, Any]

    def arrays(self) -> dict[str, Any]:
        return self.opened

    def labels(self, index: int, attributes: Mapping[str, Any]) -> dict[str, Any]:
        numbers = [column.key for column in columns_of(kind_of_shots(attributes))]
        labels = read_labels(self.opened, numbers, slice(index, index + 1))
        return labels[0] if labels else {}


class GrowingStore:
    """Store that this process alone writes; it remembers the name and status of each shot."""

    def __init__(self, store: StackStore, attributes: Mapping[str, Any]) -> None:
        self.path = store.path
        self._attributes = attributes  # of a store that has grown so
        # Not the cached arrays, as these grow: other code in this process needs a fixed length.
        arrays = open_to_write(store.path)
        count = len(store.names)
        self._writer = _OpenWriter(store.path, store.attributes["store_id"], count, arrays)
        self._columns = [column for column in store.columns if column.key in arrays]
        self._numbers = {name: index for index, name in enumerate(store.names)}
        self._statuses = bytearray(store.statuses().astype(np.uint8).tobytes())
        self._counts = [self._statuses.count(status) for status in range(len(STATUS_NAMES))]

    def __len__(self) -> int:
        return len(self._statuses)

    def count(self, status: int) -> int:
        """Return how many shots are pending, done or failed."""
        return self._counts[status]

    def number(self, name: str) -> int | None:
        """Return the number of a shot, None if it is not there yet."""
        return self._numbers.get(name)

    def done(self) -> Iterator[str]:
        """Yield the names of the shots that are done."""
        for name, index in self._numbers.items():
            if self._statuses[index] == DONE:
                yield name

    def status(self, index: int) -> int:
        return self._statuses[index]

    def report(self, index: int) -> dict[str, Any]:
        """Return the report of a shot that has ended."""
        text = str(self._writer.opened["report"][index])
        return dict(json.loads(text or "{}"))

    def append(self, name: str) -> int:
        """Make room for one more shot, pending, and return its number."""
        index = len(self)
        values = {"shot": np.array([index]), "name": np.array([name], dtype=object)}
        lengthen(self.path, self._writer.opened, index + 1, values, self._attributes)
        self._numbers[name] = index
        self._statuses.append(PENDING)
        self._counts[PENDING] += 1
        return index

    def reopen(self, index: int) -> None:
        """Mark a shot as pending that is to be done again, and forget its fields."""
        self._writer.reopen(index)
        self._set_status(index, PENDING)

    def write(self, index: int, arrays: Mapping[str, Any], report: Mapping[str, Any]) -> None:
        """As `ShotWriter.write`; the shot's numbers are there as soon as it is done."""
        self._gather(index, report)
        self._writer.write(index, arrays, report)
        self._set_status(index, DONE)

    def fail(self, index: int, report: Mapping[str, Any]) -> None:
        """As `ShotWriter.fail`."""
        self._gather(index, report)
        self._writer.fail(index, report)
        self._set_status(index, FAILED)

    def _gather(self, index: int, report: Mapping[str, Any]) -> None:
        try:
            for column in self._columns:
                value: Any = np.array([column.of(report)], column.dtype)
                self._writer.opened[column.key][index : index + 1] = value
        except OSError as error:
            raise store_error(self.path, error) from error

    def _set_status(self, index: int, status: int) -> None:
        self._counts[self._statuses[index]] -= 1
        self._counts[status] += 1
        self._statuses[index] = status
