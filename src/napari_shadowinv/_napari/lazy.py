"""Stacks whose planes are made when they are looked at: `lazy_stack`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["lazy_stack"]


def lazy_stack(
    make: Callable[..., NDArray[np.float64]],
    items: Sequence[Any],
    shape: tuple[int, int],
    ready: NDArray[np.float64] | None = None,
    at: int = 0,
) -> Any:
    """Stack planes without making them.

    Parameters
    ----------
    make : callable
        Makes the plane of an item.
    items : sequence
        What the planes are made of.
    shape : tuple of int
        Shape (H, W) of each plane.
    ready : ndarray, shape (H, W), optional
        A plane that is made already.
    at : int
        Its place.

    Returns
    -------
    dask.array.Array of float64, shape (len(items), H, W)
        One chunk for each plane.
    """
    from dask import array
    from dask.delayed import delayed

    made = delayed(make, pure=True)
    planes = [
        array.from_array(ready, chunks=shape)  # type: ignore[no-untyped-call]
        if ready is not None and index == at
        else array.from_delayed(made(item), shape=shape, dtype=np.float64)  # type: ignore[no-untyped-call]
        for index, item in enumerate(items)
    ]
    return array.stack(planes)  # type: ignore[no-untyped-call]
