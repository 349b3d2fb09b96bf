"""Frames: images of a file that holds many, or of a folder, each read on demand.

- all frames that a path stands for: `find_frames`
- the images of a folder: `images_in`, and the others: `left_out_of`; files by a pattern:
  `matching_files`
- frames as a lazy dataset: `lazy_frames`

Any axes of an array before the last two count frames. At most one frame is in memory at a time.
"""

from __future__ import annotations

import glob
import math
import os
import re
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any
from uuid import uuid4

import numpy as np

from napari_shadowinv._system.safety import as_file_errors
from napari_shadowinv._typing import AnyArray
from napari_shadowinv.errors import FileFormatError, InputError
from napari_shadowinv.io.files import in_counting_order, split_address, text_of
from napari_shadowinv.io.formats import FORMATS, IMAGE_SUFFIXES, format_of

if TYPE_CHECKING:
    import xarray

    from napari_shadowinv.shot import Shot

_GLOB = re.compile(r"[*?\[]")
FRAMES_FORMAT = "shadowinv frames"


@dataclass(frozen=True)
class FileFrame:
    """One image of a file."""

    path: Path
    name: str  # for messages and tables
    # Page of a TIFF, or frame of an array over all other axes; None if there is one image.
    number: int | None = None
    variable: str | None = None  # name of the array in its file


def spellings(suffix: str) -> tuple[str, ...]:
    """Return the endings in lower case that mean the same as one, such as .tif and .tiff."""
    suffix = suffix.lower()
    pictures = (each.suffixes for each in FORMATS if each.is_scan)
    return next((suffixes for suffixes in pictures if suffix in suffixes), (suffix,))


def is_pattern(path: str | Path) -> bool:
    """Return whether a path stands for the files that match it; brackets may be in a name."""
    return bool(_GLOB.search(str(path))) and not os.path.exists(path)


def matching_files(pattern: str | Path) -> list[Path]:
    """List the files that match a pattern, in natural order; existing folders are not patterns."""
    pattern = Path(pattern)
    folders = pattern.parents
    exists = next(place for place in folders if place == Path() or place.exists())
    rest = pattern.relative_to(exists)
    names = glob.glob(os.path.join(glob.escape(str(exists)), rest), recursive=True)
    return in_counting_order(map(Path, names))


def images_in(folder: Path) -> list[Path]:
    """List a folder's images of the most frequent kind, in natural order."""
    # A table of settings next to a run of TIFFs is not a shot.
    files = _files_in(folder)
    kinds = Counter(spellings(path.suffix) for path in files)
    images = [kind for kind in kinds if IMAGE_SUFFIXES.issuperset(kind)]
    most_frequent = max(sorted(images), key=lambda kind: kinds[kind], default=())
    return in_counting_order(path for path in files if path.suffix.lower() in most_frequent)


def left_out_of(folder: Path) -> str:
    """Say which files of a folder `images_in` leaves out; empty if none."""
    images = set(images_in(folder))
    return counts_text(count_endings(path.name for path in _files_in(folder) if path not in images))


def count_endings(names: Iterable[str]) -> Counter[str]:
    """Count the endings of files."""
    return Counter(os.path.splitext(name)[1].lower() or "without an ending" for name in names)


def counts_text(counts: Mapping[str, int]) -> str:
    """Return numbers of files by their endings as text; empty without one."""
    return ", ".join(f"{count} {suffix}" for suffix, count in sorted(counts.items()))


def _files_in(folder: Path) -> list[Path]:
    return [path for path in folder.iterdir() if path.is_file() and path.name[0] != "."]


def find_frames(
    path: str | Path, variable: str | None = None, *, numbered: bool = True
) -> list[FileFrame]:
    """Return the frames of a file, a folder of images, or a pattern such as ``shots/*.tif``.

    The `variable` is the array in each HDF5 file. Unless frames are `numbered`, each file is one;
    one that holds a single image has no number. Files of a folder or pattern are opened only to
    count the frames in their arrays. A `FileFormatError` says that a file cannot be read or a
    folder has no image, an `InputError` that there is no such array, or no file.
    """
    file, variable = split_address(path, variable)
    if os.path.isdir(file):
        files = images_in(file)
        if not files:
            is_zarr = any((file / name).exists() for name in ("zarr.json", ".zgroup", ".zarray"))
            kind = "is a Zarr store of another program" if is_zarr else "contains no image"
            raise FileFormatError(f"{file} {kind}: expected a folder of radiographs, such as TIFF")
    elif is_pattern(file):
        files = matching_files(file)
        if not files:
            raise InputError(
                f"no file matches {file}: expected shots; check the folder and pattern"
            )
    elif numbered and variable is None:
        return _frames_of_file(file)
    else:
        files = [file]
    if not numbered or variable is None:
        return [FileFrame(each, text_of(each.name), variable=variable) for each in files]
    if len(files) == 1:
        return _frames_of_file(files[0], variable)
    return [frame for each in files for frame in _readable_frames(each, variable)]


def _readable_frames(path: Path, variable: str) -> list[FileFrame]:
    """Return the frames of one file among many, which fails alone if it cannot be read."""
    try:
        return _frames_of_file(path, variable)
    except (OSError, ValueError):
        return [FileFrame(path, text_of(path.name), variable=variable)]


@as_file_errors
def _frames_of_file(path: Path, variable: str | None = None) -> list[FileFrame]:
    """Return the pages of a TIFF, or the frames of an array."""
    name, file_format = text_of(path.name), format_of(path)
    variable = file_format.array_name(path, variable)
    axes = file_format.count_frames(path, variable)
    if math.prod(axes) == 1:
        return [FileFrame(path, name, variable=variable)]
    return [
        FileFrame(path, f"{name}[{','.join(map(str, index))}]", number, variable)
        for number, index in enumerate(np.ndindex(*axes))
    ]


def lazy_frames(frames: Sequence[FileFrame], read: Callable[[FileFrame], Shot]) -> xarray.Dataset:
    """Return ``image`` (shot, y, x), a chunk for each frame, whose frames dask reads on demand.

    The first is read now; its ``mask`` is kept if it has one. The coordinate ``name`` is that of
    the shot.
    """
    import xarray as xr

    da: Any = import_module("dask.array")
    shot = read(frames[0])
    first = shot.image
    layer = f"frames-{uuid4().hex}"  # not by content, which may change
    tasks = {
        (layer, index, 0, 0): (_read_block, read, frame, first.shape)
        for index, frame in enumerate(frames)
    }
    chunks = ((1,) * len(frames), *((side,) for side in first.shape))
    image = da.Array(tasks, layer, chunks, dtype=first.dtype)
    names = np.array([frame.name for frame in frames], dtype=str)
    variables: dict[str, Any] = {
        "image": (("shot", "y", "x"), image, {"units": "1", "long_name": "Image"})
    }
    if shot.mask is not None:
        variables["mask"] = (("y", "x"), shot.mask, {"long_name": "Usable pixels of the first"})
    return xr.Dataset(
        variables,
        coords={"name": ("shot", names, {"long_name": "Name of the shot"})},
        attrs={"format": FRAMES_FORMAT},
    )


def _read_block(
    read: Callable[[FileFrame], Shot], frame: FileFrame, shape: tuple[int, ...]
) -> AnyArray:
    image = read(frame).image
    if image.shape != shape:
        raise FileFormatError(
            f"{frame.name} has {' × '.join(map(str, image.shape))} pixels, the first frame "
            f"{' × '.join(map(str, shape))}: expected images of one size; leave it out"
        )
    return np.asarray(image[np.newaxis])
