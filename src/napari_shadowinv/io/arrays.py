"""Arrays in files.

- by their names: `find_array`, `only_image`; the choice, for messages: `ArrayEntry`, `list_arrays`
- frames of an array: lengths of their axes, `frame_axes`; the one that a name ends with,
  `frame_number`
- of numpy, ``.npy``: `read_npy`, an image or frame `read_npy_plane`, `write_npy`
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Sequence
from io import BytesIO
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np

from napari_shadowinv._system.safety import as_file_errors, check_size
from napari_shadowinv._system.validation import nearest
from napari_shadowinv._typing import AnyArray
from napari_shadowinv.errors import FileFormatError, InputError

_FRAME_INDEX = re.compile(r"(?P<name>.*)\[(?P<index>\d+(,\d+)*)\]")  # of an array, as data[3]
ONE_AXIS = "1 axis"

Item = TypeVar("Item")


class ArrayEntry(NamedTuple):
    """An array in a file, and the reason why it is no image; empty if it is one."""

    name: str
    size: str  # shape and type
    reason: str

    def __str__(self) -> str:
        notes = ", ".join(filter(None, (self.size, self.reason)))
        return f"{self.name!r} ({notes})"


def list_arrays(entries: Iterable[ArrayEntry], *, most: int = 8) -> str:
    """Describe the first arrays of a file, images first."""
    entries = sorted(entries, key=lambda entry: (bool(entry.reason), entry.reason == ONE_AXIS))
    # Times and names are no choice where there are images.
    count = sum(entry.reason != ONE_AXIS for entry in entries) or len(entries)
    names = [str(entry) for entry in entries[: min(count, most)]]
    more = [f"and {count - most} more"] if count > most else []
    return ", ".join([*names, *more]) or "no array"


def only_image(path: Path, names: Sequence[str], entries: Iterable[ArrayEntry]) -> str:
    """Return the only one of the names of images, or refuse the file."""
    if len(names) == 1:
        return names[0]
    raise FileFormatError(
        f"{path} has {f'{len(names)} images' if names else 'no image'}: expected one, or the name "
        f"of one, as {path.name}::{[*names, '/name'][0]}; it holds {list_arrays(entries)}"
    )


def find_array(
    path: Path, name: str, find: Callable[[str], Item | None], entries: Iterable[ArrayEntry]
) -> tuple[Item, re.Match[str] | None]:
    """Return what `find` returns for a name, also without the frame that it may end with."""
    item, frame = find(name), None
    if item is None and (frame := _FRAME_INDEX.fullmatch(name)):
        item = find(frame["name"])
    if item is not None:
        return item, frame
    entries = list(entries)
    similar = nearest(name.strip("/"), [entry.name for entry in entries if not entry.reason])
    hint = f"did you mean {similar!r}? " if similar else ""
    raise InputError(f"{path} has no array {name!r}: {hint}it holds {list_arrays(entries)}")


def frame_axes(path: Path, title: str, shape: tuple[int, ...]) -> tuple[int, ...]:
    """Return the lengths of the axes before the last two, which count frames; none for an image."""
    if len(shape) < 2 or 0 in shape:
        raise FileFormatError(
            f"{path} holds {title} with shape {shape}: expected an image of shape "
            "(height, width), or many with the shots first; choose another array"
        )
    if len(shape) > 2 and shape[-1] in (3, 4):  # colours of a picture
        raise FileFormatError(
            f"{path} holds {title} with shape {shape}, as of pictures in colour: expected images "
            "of shape (height, width), many with the shots first; save one colour, or turn the axes"
        )
    return shape[:-2]


def frame_number(path: Path, match: re.Match[str] | None, axes: tuple[int, ...]) -> int | None:
    """Return the number over all `axes` of the frame that a name ends with."""
    if match is None:
        return None
    index = tuple(map(int, match["index"].split(",")))
    if len(index) != len(axes) or any(map(int.__ge__, index, axes)):
        last = ",".join(str(length - 1) for length in axes)
        frames = f"frames from [{','.join('0' * len(axes))}] to [{last}]" if axes else "one image"
        raise InputError(f"{path} has no {match[0]!r}: it holds {frames}; correct the index")
    return int(np.ravel_multi_index(index, axes)) if axes else 0


@as_file_errors
def read_npy(path: Path, number: int | None = None) -> AnyArray:
    """Read real numbers in their own dtype: an array of any shape, or frame `number` of it."""
    mapped = _map_npy(path)
    if number is not None:
        mapped = mapped[np.unravel_index(number, mapped.shape[:-2])]
    check_size(path, mapped.size * max(8, mapped.dtype.itemsize))
    array = np.array(mapped)
    if array.dtype.kind not in "buif":
        raise FileFormatError(
            f"{path} holds {array.dtype} values: expected whole or real numbers; convert them"
        )
    return array


def _map_npy(path: Path) -> AnyArray:
    # Mapped first: a header that promises too much then fails before memory is asked for.
    try:
        return np.asarray(np.load(path, allow_pickle=False, mmap_mode="r"))
    except ValueError as error:
        if "Python objects" not in str(error):
            raise
        raise FileFormatError(
            f"{path} contains Python objects: expected an array of numbers; save it again with "
            "array.astype(float)"
        ) from error


def count_npy(path: Path) -> tuple[int, ...]:
    """Return the lengths of the axes that count frames; see `frame_axes`."""
    return frame_axes(path, "an array", _map_npy(path).shape)


def read_npy_plane(path: Path, number: int = 0) -> tuple[AnyArray, dict[str, Any]]:
    """Read an image, or a frame of many."""
    return read_npy(path, number), {}


def write_npy(content: BytesIO, array: AnyArray, pixel_size: float | None = None) -> None:
    """Write an array as it is; the format does not keep the size of a pixel."""
    np.save(content, array, allow_pickle=False)
