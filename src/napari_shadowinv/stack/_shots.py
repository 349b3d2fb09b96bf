"""Shots of a stack, each read on demand: `Exposure`, and where they come from.

- in an array, in a file, in a row of a table: `ArrayExposure`, `FileExposure`, `RowExposure`
- all shots of an array, of files or of a list: `find_shots`; of a table: `table_shots`
- their source: `find_source`
"""

from __future__ import annotations

import functools
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from napari_shadowinv._system.validation import map_paths
from napari_shadowinv._typing import AnyArray, BoolArray
from napari_shadowinv.cautions import Caution
from napari_shadowinv.errors import FileFormatError, InputError
from napari_shadowinv.io.files import name_of, sha256, split_address, text_of
from napari_shadowinv.io.formats import HDF5, PRADFORMAT, format_of
from napari_shadowinv.io.frames import FileFrame, find_frames
from napari_shadowinv.io.read_write import read_frame, read_shot
from napari_shadowinv.physics.arrays import (
    PLANE,
    checksum,
    refuse_masked,
    unpack_array,
)
from napari_shadowinv.physics.setup import Setup, setup_from_dict
from napari_shadowinv.pipeline.fit_run import read_row_images, row_setup
from napari_shadowinv.pipeline.shot_table import ShotRow, rows_to_invert
from napari_shadowinv.preprocessing import Recipe
from napari_shadowinv.shot import Shot

if TYPE_CHECKING:
    import xarray

_MAX_SHAPE_READS = 3  # shots that are read for the shape of all
_OF_FITS = ("strength", "psf", "noise")


class NoShotError(FileFormatError):
    """None of the shots can be read."""


@dataclass(frozen=True, eq=False)
class Exposure:
    """A shot of a stack, whose images are read on demand; it can be sent to a worker."""

    name: str  # for messages and tables

    def load(self) -> tuple[Shot, dict[str, Any]]:
        """Return the image with all that is known of it, and metadata for the shot's report.

        These are ``sha256``, and ``cautions`` if there are any.
        """
        raise NotImplementedError

    def stamp(self) -> dict[str, Any]:
        """Return metadata that are known before an image is read."""
        return {}

    def shape(self) -> tuple[int, ...]:
        """Return the shape of the image, which has to be read."""
        return np.shape(self.load()[0].image)

    def unchanged(self, origin: dict[str, Any]) -> bool:
        """Return whether the image still agrees with the metadata from `load`."""
        return bool(self.load()[1]["sha256"] == origin.get("sha256"))


@dataclass(frozen=True, eq=False)
class ArrayExposure(Exposure):
    """An image in an array (shot, H, W), of numpy, or of dask, whose scheduler computes it."""

    array: Any = field(repr=False)
    index: int = 0

    @property
    def is_lazy(self) -> bool:
        return not isinstance(self.array, np.ndarray)

    @property
    def block(self) -> Any:
        """The image as an array (1, H, W), without the tasks of other images."""
        if not self.is_lazy:
            return self.array[self.index : self.index + 1]
        dask: Any = import_module("dask")
        return dask.optimize(self.array.blocks[self.index])[0]

    def load(self) -> tuple[Shot, dict[str, Any]]:
        plane = _plain_image(self.block.compute()[0]) if self.is_lazy else self.array[self.index]
        # Sums depend on the order in memory.
        plane = np.ascontiguousarray(plane)
        return Shot(plane), {"sha256": checksum(plane)}

    def __reduce__(self) -> tuple[Any, ...]:
        # Otherwise all images, or their tasks, would be sent with it.
        return ArrayExposure, (self.name, self.block)


@dataclass(frozen=True)
class FileReader:
    """How files are read: by their format, or by a function of the user's."""

    function: Callable[[Path], ArrayLike] | None = None
    channel: str | int | None = None  # of colour images, as for `napari_shadowinv.io.read_shot`
    variable: str | None = None  # name of an array, of files that hold several

    def __post_init__(self) -> None:
        if self.function is not None and (self.channel is not None or self.variable is not None):
            raise InputError(
                "the shots are read by a function, which selects no array and no channel: leave "
                "them out"
            )

    @classmethod
    def of(cls, reader: Reader) -> FileReader:
        return reader if isinstance(reader, FileReader) else cls(reader)

    def frames(self, path: str | Path) -> list[FileFrame]:
        """Return all frames that a path stands for; of a user's function, a file is a frame."""
        if self.function is None:
            return find_frames(path, self.variable)
        if split_address(path)[1] is not None:
            raise InputError(
                f"shots are {path}, and a function that reads them selects no array: give the file "
                "alone"
            )
        return find_frames(path, numbered=False)

    def read(self, frame: FileFrame) -> Shot:
        if self.function is None:
            return read_frame(frame, channel=self.channel)
        return Shot(unpack_array(self.function(frame.path), "the shot"))

    @property
    def name(self) -> str:
        """A text by which a store is not continued with another reader."""
        if self.function is None:
            return "" if self.channel is None else f"channel {self.channel}"
        function: Any = self.function
        if isinstance(function, functools.partial):
            return f"{FileReader(function.func).name} {function.keywords}"
        kind = type(function).__qualname__
        return f"{function.__module__}.{getattr(function, '__qualname__', kind)}"


Reader = FileReader | Callable[[Path], ArrayLike]
FILES: FileReader = FileReader()  # mypy does not infer it for defaults of parameters


@dataclass(frozen=True, eq=False)
class FileExposure(Exposure):
    """A file that holds one image, or a page of a TIFF or frame of an array that holds many."""

    frame: FileFrame  # its path is absolute, so that a worker elsewhere finds it
    reader: FileReader

    def stamp(self) -> dict[str, Any]:
        # Before the image: it may be written to while it is read.
        frame = self.frame
        return {"variable": frame.variable, **stamp(frame.path)} if frame.number is None else {}

    def load(self) -> tuple[Shot, dict[str, Any]]:
        digest = sha256(self.frame.path) if self.frame.number is None else ""
        shot = self.reader.read(self.frame)
        cautions = list(shot.cautions)
        metadata = {
            "sha256": digest or checksum(shot.image),
            **({"cautions": cautions} if cautions else {}),
        }
        mask = None if shot.mask is None or np.all(shot.mask) else shot.mask
        return Shot(shot.image, mask=mask), metadata

    def unchanged(self, origin: dict[str, Any]) -> bool:
        """Compare a file as in a table's rows, and a page by its checksum."""
        if self.frame.number is not None:
            return super().unchanged(origin)
        return self.frame.variable == origin.get("variable") and _agrees(self.frame.path, origin)


@dataclass(frozen=True, eq=False)
class RowExposure(Exposure):
    """An image to invert as recorded, from a row of a table."""

    row: ShotRow
    recipe: Recipe
    channel: str | int | None = None
    setup: Setup | None = None

    def load(self) -> tuple[Shot, dict[str, Any]]:
        """Return the image, and the files of its row."""
        (image,) = read_row_images([self.row], self.recipe, channel=self.channel)
        files = {
            name: {**stamp(path), "sha256": sha256(path)} for name, path in self._files().items()
        }
        cautions = list(image.cautions)
        if unused := [name for name in _OF_FITS if getattr(image, name) is not None]:
            text = f"the row has {', '.join(unused)}, which only fits use: fit the image to use it"
            cautions.append(Caution("file", text))
        origin = {"files": files, "row": self.row.summary, "cautions": cautions}
        return replace(image, setup=self.setup), {**files["file"], **origin}

    def shape(self) -> tuple[int, ...]:
        return read_shot(self.row.file, channel=self.channel).shape

    def unchanged(self, origin: dict[str, Any]) -> bool:
        """Compare the row, its setup, and existing files by size and time or checksum."""
        before = origin.get("files", {})
        setup = origin.get("provenance", {}).get("recipe", {}).get("setup")
        # The setup of a row may have been in an image that was removed.
        is_lost = self.setup is None and not split_address(self.row.file)[0].exists()
        return (
            self.row.summary == origin.get("row")
            and (is_lost or self.setup == (setup and setup_from_dict(setup)))
            and all(_agrees(path, before.get(name, {})) for name, path in self._files().items())
        )

    def _files(self) -> dict[str, Path]:
        """Return the files by the names of their columns."""
        return {name: split_address(path)[0] for name, path in self.row.files.items()}


def differences(before: Mapping[str, Any], now: Mapping[str, Any], missing: Any = None) -> str:
    """Describe the entries that differ; `missing` stands for one that is not there."""
    return ", ".join(
        f"{name}: {before.get(name, missing)} there, {now.get(name, missing)} now"
        for name in {**before, **now}
        if before.get(name) != now.get(name)
    )


def _agrees(path: Path, before: Mapping[str, Any]) -> bool:
    """Compare a file by size and time, and only where these differ by its checksum."""
    if not path.exists():
        return True  # removed after it was inverted
    return stamp(path).items() <= before.items() or sha256(path) == before.get("sha256")


def stamp(path: Path) -> dict[str, int]:
    """Return size and time of a file, which identify its content."""
    status = path.stat()
    return {"size": status.st_size, "mtime_ns": status.st_mtime_ns}


def _plain_image(image: Any) -> AnyArray:
    """Return an image without labels."""
    return np.asarray(unpack_array(image, "the shot"))


@dataclass(frozen=True, eq=False)
class Shots:
    """The shots of a stack, in order."""

    items: Sequence[Exposure]
    shape: tuple[int, int]  # that they should have
    mask: BoolArray | None = None  # pixels that can be used, if they came as masked arrays

    def __len__(self) -> int:
        return len(self.items)

    @cached_property
    def names(self) -> tuple[str, ...]:
        return tuple(shot.name for shot in self.items)

    def label(self, index: int) -> str:
        """Name and number of a shot, for messages."""
        name = self.items[index].name
        return f"shot {index}" if name == str(index) else f"shot {index} ({name})"

    def reordered(self, order: Sequence[int]) -> Shots:
        return replace(self, items=[self.items[index] for index in order])


def find_shots(
    shots: Any, reader: FileReader = FILES, shape: tuple[int, int] | None = None
) -> Shots:
    """Return references to the shots of an array, of files or of a list."""
    if isinstance(shots, Shots):
        return replace(shots, shape=shape or usual_shape(shots.items))
    if isinstance(shots, (str, Path)):
        items = _shots_of(reader.frames(shots), reader)
        return Shots(items, shape or usual_shape(items))
    if hasattr(shots, "dims") and hasattr(shots, "coords"):
        return _from_xarray(shots)
    if isinstance(shots, Sequence) and all(isinstance(item, (str, Path)) for item in shots):
        items = _shots_of_files(shots, reader)
        return Shots(items, shape or usual_shape(items))
    if not hasattr(shots, "ndim"):
        raise InputError(
            f"shots are a {type(shots).__name__}: expected an array (shot, y, x), such as "
            "numpy.stack makes of images, an xarray object, paths, a glob such as 'shots/*.tif', "
            "or a file with many frames"
        )
    return _from_array(shots)


def _shots_of(frames: Sequence[FileFrame], reader: FileReader) -> list[Exposure]:
    names = _distinct_names(frames)
    return [
        FileExposure(name, replace(frame, path=frame.path.absolute()), reader)
        for name, frame in zip(names, frames, strict=True)
    ]


def _shots_of_files(paths: Sequence[str | Path], reader: FileReader) -> list[Exposure]:
    if not paths:
        raise InputError("shots are an empty list: expected at least one path")
    frames: list[FileFrame] = []
    for path in paths:
        if split_address(path, reader.variable)[1] is None:
            frames.append(FileFrame(Path(path), text_of(Path(path).name)))
        else:
            frames += reader.frames(path)
    return _shots_of(frames, reader)


def _distinct_names(frames: Sequence[FileFrame]) -> tuple[str, ...]:
    """Return the names of frames, with their folders if they differ only there."""
    names = tuple(frame.name for frame in frames)
    if len(set(names)) < len(names):
        names = tuple(text_of(frame.path.with_name(frame.name)) for frame in frames)
    if len(set(names)) < len(names):
        twice = next(name for name, count in Counter(names).items() if count > 1)
        raise InputError(f"shots contain {twice} twice: expected each file once")
    return names


def usual_shape(items: Sequence[Exposure]) -> tuple[int, int]:
    """Shape of most of the first few shots that can be read; bad ones fail later, by name."""
    shapes: list[tuple[int, ...]] = []
    errors: list[Exception] = []
    for shot in items:
        try:
            shapes.append(shot.shape())
        except Exception as error:
            errors.append(error)
        if len(shapes) == _MAX_SHAPE_READS:
            break
    if not shapes:
        first = f", the first: {errors[0]}" if errors else ""
        raise NoShotError(f"none of {len(items)} shots can be read{first}")
    usual = Counter(shapes).most_common(1)[0][0]
    if len(usual) != 2:
        raise InputError(f"shots have shape {usual}, expected (y, x): choose one channel or plane")
    return usual[0], usual[1]


def failure_text(error: Exception) -> str:
    if isinstance(error, MemoryError):
        return "there is not enough memory for this shot on its worker"
    kind = type(error).__name__
    if isinstance(error, InputError | OSError):
        return str(error) or kind
    return f"{kind}: {error}"


def _from_xarray(shots: xarray.DataArray | xarray.Dataset) -> Shots:
    usable = None
    if hasattr(shots, "data_vars"):
        usable = shots.get("mask")
        planes = [name for name, variable in shots.data_vars.items() if variable.ndim == 3]
        chosen = ["image"] if "image" in planes else planes
        if len(chosen) != 1:
            raise InputError(
                f"the dataset has {len(planes)} variables with three dimensions: expected one, "
                "(shot, y, x), or one called 'image'; select it"
            )
        shots = shots[chosen[0]]
    name = next((dim for dim in shots.dims if str(dim).lower() not in PLANE), "shot")
    labels = shots.coords.get("name")
    if not shots.variable._in_memory and name in shots.dims:
        shots = shots.chunk({name: 1})  # otherwise the whole file would be read
    values = unpack_array(shots, "shots", ("shot", *PLANE))
    if labels is None or labels.dims != (name,):
        labels = shots.coords.get(name)
    frames = _from_array(values, None if labels is None else labels.values)
    if usable is None or usable.dims != PLANE or usable.dtype != np.bool_:
        return frames
    return replace(frames, mask=usable.values)


def _from_array(shots: Any, labels: Any = None) -> Shots:
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
    if isinstance(shots, np.ndarray):
        array = np.asarray(refuse_masked(shots, "shots"))
    elif isinstance(shots, da.Array):
        array = shots.rechunk((1, -1, -1))
    else:  # of h5py or zarr
        array = da.from_array(shots, chunks=(1, -1, -1))
    names = map(str, range(count) if labels is None else labels)
    items = [ArrayExposure(name, array, index) for index, name in enumerate(names)]
    return Shots(items, (shots.shape[1], shots.shape[2]))


def find_source(source: Any, reader: FileReader) -> AnyArray | None:
    """Return the undisturbed beam of all shots."""
    if source is None:
        return None
    content = f"a {type(source).__name__}"
    if isinstance(source, (str, Path)):
        frames = reader.frames(source)
        if len(frames) == 1:
            return np.asarray(reader.read(frames[0]).image)
        content = f"{len(frames)} images"
    elif getattr(source, "ndim", None) == 2:
        return np.asarray(source)
    elif hasattr(source, "shape"):
        content = f"an array of shape {source.shape}"
    raise InputError(
        f"the source of the shots is {content}: expected one image for all; give shots with a "
        "source each as a table"
    )


def table_shots(
    table: Path | Sequence[ShotRow], recipe: Recipe, channel: str | int | None
) -> list[RowExposure]:
    """Return the shots of a table, or of its rows."""
    # For workers elsewhere, paths are absolute.
    rows = [map_paths(row, Path.absolute) for row in rows_to_invert(table)]
    names = _distinct_names([FileFrame(row.file, name_of(row.file)) for row in rows])
    return [
        RowExposure(
            name, row, recipe, channel, row_setup(row, _read_geometry(row, channel), recipe)
        )
        for name, row in zip(names, rows, strict=True)
    ]


def _read_geometry(row: ShotRow, channel: str | int | None) -> Shot:
    """Read an image if its file may contain a geometry; return an empty one otherwise."""
    try:
        if format_of(row.file) in (PRADFORMAT, HDF5):
            return read_shot(row.file, channel=channel)
    except (OSError, ValueError):
        pass  # its shot fails, by name
    return Shot(np.zeros((1, 1)))
