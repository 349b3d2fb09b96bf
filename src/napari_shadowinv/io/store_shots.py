"""Shots of a store, chosen by a text such as ``3:20``.

- the finished ones among them, opened lazily: `open_shots`
- the numbers that a text stands for: `parse_shots`
- a variable with an image of each shot: `check_images`
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from napari_shadowinv.errors import FileFormatError, InputError
from napari_shadowinv.io.store import DAMAGED, DONE, StackStore, read_stack
from napari_shadowinv.physics.arrays import PLANE

if TYPE_CHECKING:
    import xarray


def open_shots(path: Path, shots: str | None = None) -> xarray.Dataset:
    """Open a store as `read_stack` does, with only its finished shots among those chosen.

    The coordinate ``index`` is the number of each. An `InputError` refuses a selection without a
    finished shot, a `FileFormatError` one with a damaged shot.
    """
    dataset = read_stack(path)
    count = dataset.sizes["shot"]
    selection = dataset.assign_coords(index=("shot", np.arange(count)))
    if shots is not None:
        selection = selection.isel(shot=parse_shots(shots, count))
    for index in np.flatnonzero(selection["status"].values == DAMAGED)[:1]:
        number = int(selection["index"].values[index])
        store = StackStore(path)
        raise FileFormatError(
            f"{path} is damaged: shot {number} ({store.names[number]}): "
            f"{store.report(number)['reason']}; "
            "resume its run to invert it again, or choose other shots"
        )
    done = selection.isel(shot=np.flatnonzero(selection["status"].values == DONE))
    if not done.sizes["shot"]:
        raise InputError(
            f"{path} has no finished shots in this selection: wait for them, or choose other shots"
        )
    return done


def check_images(stack: xarray.Dataset, names: Sequence[str]) -> None:
    """Refuse names that are no images of each shot, or vectors at each pixel."""
    dims = {str(name): variable.dims for name, variable in stack.data_vars.items()}
    images = [name for name in dims if dims[name][:1] == ("shot",) and dims[name][-2:] == PLANE]
    for name in names:
        if name not in images:
            raise InputError(
                f"the stack has no images {name!r}: expected one or more of {', '.join(images)}"
            )


def parse_shots(text: str, count: int) -> list[int]:
    """Convert 3, 3:20, :10, ::5 or a list of these to numbers of `count` shots."""
    selection: list[int] = []
    for part in text.split(","):
        try:
            numbers = [int(piece) if piece.strip() else None for piece in part.split(":")]
            if len(numbers) == 1 and numbers[0] is not None:
                selection.append(range(count)[numbers[0]])
            elif 2 <= len(numbers) <= 3:
                selection.extend(range(count)[slice(*numbers)])
            else:
                raise ValueError(part)
        except (ValueError, IndexError):
            raise InputError(
                f"shots are {text!r}: expected numbers from 0 to {count - 1} such as 3, 3:20, or "
                "3,5,10:20"
            ) from None
    return selection
