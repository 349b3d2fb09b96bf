"""Origins of shots and sources: globs, lists of files, pages, arrays."""

from __future__ import annotations

import glob
import inspect
import os
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, overload

import numpy as np

from napari_shadowinv._system.arrays import PLANE, unpack_array
from napari_shadowinv._typing import AnyArray, BoolArray
from napari_shadowinv.errors import FileFormatError, InputError
from napari_shadowinv.io.files import in_counting_order, text_of
from napari_shadowinv.io.formats import kind_of
from napari_shadowinv.io.images import tiff_pages
from napari_shadowinv.stack import _sources
from napari_shadowinv.stack._sources import Reader, Shot, read_shot

if TYPE_CHECKING:
    import xarray

_GLOB = re.compile(r"[*?\[]")
_MAX_SHAPE_READS = 3  # shots that are read for the shape of all


@dataclass(frozen=True, eq=False)
class Shots:
    """The shots of a stack, in order."""

    items: Sequence[Shot]
    names: tuple[str, ...]  # for messages and tables
    shape: tuple[int, int]  # that they should have
    coordinate: Any = None  # values of the coordinate ``shot`` of an xarray object
    array: Any = None  # the same images as one dask array, chunks of one shot, if they came so
    mask: BoolArray | None = None  # pixels that can be used, if they came as masked arrays

    def __len__(self) -> int:
        return len(self.items)

    def label(self, index: int) -> str:
        """Name and number of a shot, for messages."""
        name = self.names[index]
        return f"shot {index}" if name == str(index) else f"shot {index} ({name})"

    def reordered(self, order: Sequence[int]) -> Shots:
        """Return these shots in another order."""
        if list(order) == list(range(len(self))):
            return self
        array = None if self.array is None else self.array[list(order)].rechunk((1, -1, -1))
        is_lazy = isinstance(self.items, _Blocks)
        return replace(
            self,
            items=_Blocks(array) if is_lazy else [self.items[index] for index in order],
            names=tuple(self.names[index] for index in order),
            coordinate=None if self.coordinate is None else self.coordinate[list(order)],
            array=array,
        )


def find_shots(
    shots: Any, *, reader: Reader = read_shot, shape: tuple[int, int] | None = None
) -> Shots:
    """Return references to the shots of an array, of files or of a list."""
    if isinstance(shots, Shots):
        return replace(shots, shape=shape or usual_shape(shots.items))
    if isinstance(shots, (str, Path)):
        return _from_path(str(shots), reader, shape)
    if hasattr(shots, "dims") and hasattr(shots, "coords"):
        return _from_xarray(shots)
    if isinstance(shots, Sequence) and all(isinstance(item, (str, Path)) for item in shots):
        return _from_files([Path(item) for item in shots], reader, shape)
    if isinstance(shots, Sequence) and all(np.ndim(item) == 2 for item in shots):
        shapes = {np.shape(item) for item in shots}
        if len(shapes) > 1:
            raise InputError(
                f"shots have shapes {', '.join(map(str, sorted(shapes)))}: expected the same "
                "shape for all"
            )
        planes = [unpack_array(item, f"shots[{k}]") for k, item in enumerate(shots)]
        shots = np.stack([np.asarray(values) for values, _ in planes])
        if any(usable is not None for _, usable in planes):
            masked = [np.zeros(shots.shape[1:], bool) if use is None else ~use for _, use in planes]
            shots = np.ma.MaskedArray(shots, np.stack(masked))
    if not hasattr(shots, "ndim"):
        raise InputError(
            f"shots are a {type(shots).__name__}: expected an array (shot, y, x), an xarray "
            "object, paths, a glob such as 'shots/*.tif', or a multi-page TIFF"
        )
    return _from_array(shots)


def _from_path(text: str, reader: Reader, shape: tuple[int, int] | None) -> Shots:
    path = Path(text)
    # Path.is_dir raises an error if a name is too long.
    if os.path.isdir(path):
        raise InputError(f"{text} is a folder: specify the files, such as '{text}/*.tif'")
    if _GLOB.search(text) and not os.path.exists(path):
        paths = in_counting_order(map(Path, glob.glob(text, recursive=True)))
        if not paths:
            raise InputError(
                f"no file matches {text}: expected shots; check the folder and pattern"
            )
        return _from_files(paths, reader, shape)
    pages = _page_count(path, reader)
    if pages == 1:
        return _from_files([path], reader, shape)
    items = [_sources.PageShot(path.absolute(), page, reader) for page in range(pages)]
    names = tuple(f"{text_of(path.name)}[{page}]" for page in range(pages))
    return Shots(items, names, shape or usual_shape(items))


def _page_count(path: Path, reader: Reader) -> int:
    """Return the number of pages of a TIFF, if the reader can select them."""
    knows_pages = "page" in inspect.signature(reader).parameters
    return tiff_pages(path) if knows_pages and kind_of(path) == "tiff" else 1


def _from_files(paths: Sequence[Path], reader: Reader, shape: tuple[int, int] | None) -> Shots:
    if not paths:
        raise InputError("shots are an empty list: expected at least one path")
    items = [_sources.FileShot(path.absolute(), reader) for path in paths]
    return Shots(items, names_of(paths), shape or usual_shape(items))


def names_of(paths: Sequence[Path]) -> tuple[str, ...]:
    """Names of files, with their folders if they differ only there."""
    names = tuple(text_of(path.name) for path in paths)
    if len(set(names)) < len(names):
        names = tuple(text_of(path) for path in paths)
    if len(set(names)) < len(names):
        twice = next(name for name, count in Counter(names).items() if count > 1)
        raise InputError(f"shots contain {twice} twice: expected each file once")
    return names


def usual_shape(items: Sequence[Shot]) -> tuple[int, int]:
    """Shape of most of the first few shots that can be read; bad ones fail later, by name."""
    shapes: Counter[tuple[int, ...]] = Counter()
    first_error: Exception | None = None
    for shot in items:
        try:
            shapes[shot.shape()] += 1
        except (OSError, ValueError) as error:
            first_error = first_error or error
        if shapes.total() == _MAX_SHAPE_READS:
            break
    if not shapes:
        raise FileFormatError(f"none of {len(items)} shots can be read, the first: {first_error}")
    usual = shapes.most_common(1)[0][0]
    if len(usual) != 2:
        raise InputError(f"shots have shape {usual}, expected (y, x): choose one channel or plane")
    return usual[0], usual[1]


def _from_xarray(shots: xarray.DataArray | xarray.Dataset) -> Shots:
    if hasattr(shots, "data_vars"):
        planes = [name for name, variable in shots.data_vars.items() if variable.ndim == 3]
        chosen = ["image"] if "image" in planes else planes
        if len(chosen) != 1:
            raise InputError(
                f"the dataset has {len(planes)} variables with three dimensions: expected one, "
                "(shot, y, x), or one called 'image'; select it"
            )
        shots = shots[chosen[0]]
    name = next((dim for dim in shots.dims if str(dim).lower() not in PLANE), "shot")
    coordinate = shots.coords.get(name)
    values, _ = unpack_array(shots, "shots", ("shot", *PLANE))
    return _from_array(values, None if coordinate is None else coordinate.values)


def _from_array(shots: Any, coordinate: Any = None) -> Shots:
    da: Any = import_module("dask.array")
    if shots.ndim != 3 or 0 in shots.shape:
        raise InputError(
            f"shots have shape {shots.shape}, expected (shot, y, x) with at least one shot"
        )
    count = shots.shape[0]
    if not np.isfinite(shots.shape).all():
        raise InputError(
            f"shots have the unknown shape {shots.shape}: call compute_chunk_sizes() first"
        )
    mask = _common_mask(shots)
    items: Sequence[Shot]
    if isinstance(shots, da.Array):
        array = shots.rechunk((1, -1, -1))
        items = _Blocks(array)
    else:
        array = da.from_array(np.asarray(shots), chunks=(1, -1, -1))
        items = [_sources.ArrayShot(plane) for plane in np.asarray(shots)]
    names = tuple(str(value) for value in (range(count) if coordinate is None else coordinate))
    return Shots(items, names, (shots.shape[1], shots.shape[2]), coordinate, array, mask)


def _common_mask(shots: Any) -> BoolArray | None:
    """Return the pixels that no shot of a masked array masks."""
    if isinstance(getattr(shots, "_meta", None), np.ma.MaskedArray):
        raise InputError(
            "shots are a dask array of masked arrays: give the mask as mask=, and the values as "
            "dask.array.ma.getdata(shots)"
        )
    if not isinstance(shots, np.ma.MaskedArray) or not np.ma.getmaskarray(shots).any():
        return None
    masked: BoolArray = np.ma.getmaskarray(shots)
    if (masked != masked[0]).any():
        raise InputError(
            "shots have different masks, expected the same in all: mask pixels that are masked in "
            "any (mask=~shots.mask.any(axis=0)), or describe them in a table with a mask each"
        )
    common: BoolArray = ~masked[0]
    return common


class _Blocks(Sequence[Shot]):
    """Shots of a dask array, cut out on access; a slice is a shorter sequence."""

    def __init__(self, array: Any) -> None:
        self._array = array

    def __len__(self) -> int:
        return int(self._array.shape[0])

    @overload
    def __getitem__(self, index: int) -> Shot: ...

    @overload
    def __getitem__(self, index: slice) -> _Blocks: ...

    def __getitem__(self, index: int | slice) -> Shot | _Blocks:
        if isinstance(index, slice):
            return _Blocks(self._array[index])
        dask: Any = import_module("dask")
        # Without the tasks of other shots, which would be sent with it.
        return _sources.BlockShot(dask.optimize(self._array.blocks[index])[0])


def find_source(source: Any, *, reader: Reader = read_shot) -> AnyArray | Shots | None:
    """Return the undisturbed beam as one image, or as many."""
    if source is None:
        return None
    single = isinstance(source, (str, Path)) and not _GLOB.search(str(source))
    if single and _page_count(Path(source), reader) == 1:
        return _sources.FileShot(Path(source).absolute(), reader).load()[0]
    if getattr(source, "ndim", None) == 2:
        return np.asarray(source)
    sources = find_shots(source, reader=reader)
    return sources.items[0].load()[0] if len(sources) == 1 else sources
