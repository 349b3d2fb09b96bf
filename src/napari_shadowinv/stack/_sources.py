"""One shot of a stack: a reference, `Shot`, that is read on demand."""

from __future__ import annotations

import functools
import hashlib
import inspect
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from napari_shadowinv._system.arrays import unpack_array
from napari_shadowinv._typing import AnyArray, FloatArray
from napari_shadowinv.cautions import Caution
from napari_shadowinv.errors import InputError
from napari_shadowinv.io.files import sha256
from napari_shadowinv.io.images import read_tiff_page
from napari_shadowinv.io.reading import read_radiograph
from napari_shadowinv.preprocessing import Radiograph

Reader = Callable[..., ArrayLike]


class Shot:
    """One image that is read on demand; it can be sent to a worker."""

    def load(self) -> tuple[AnyArray, dict[str, Any]]:
        """Return the image and its ``sha256``, with ``warnings`` for the shot's report if any."""
        raise NotImplementedError

    def shape(self) -> tuple[int, ...]:
        """Return the shape of the image, which has to be read."""
        return np.shape(self.load()[0])

    def unchanged(self, origin: dict[str, Any]) -> bool:
        """Return whether the image still agrees with the metadata from `load`."""
        return bool(self.load()[1]["sha256"] == origin.get("sha256"))


def read_shot(
    path: Path,
    *,
    page: int | None = None,
    channel: str | int | None = None,
    variable: str | None = None,
    warnings: list[Caution] | None = None,
) -> FloatArray:
    """Read the image of a shot; this is the default reader.

    Parameters
    ----------
    path, channel, variable
        As for `napari_shadowinv.io.read_radiograph`, whose errors this raises.
    page : int, optional
        Of a TIFF with many pages, from 0.
    warnings : list of Caution, optional
        Receives the reasons to doubt the image.

    Returns
    -------
    ndarray, shape (H, W)
    """
    if page is None:
        shot = read_radiograph(path, channel=channel, variable=variable)
    else:
        image, file_warnings = read_tiff_page(path, page, channel=channel)
        shot = Radiograph(image, warnings=file_warnings)
    if warnings is not None:
        warnings.extend(file_doubts(shot))
    return shot.image


def file_doubts(shot: Radiograph) -> list[Caution]:
    """Return the reasons to doubt the image of a file in a stack."""
    ignored = [name for name in ("source", "mask") if getattr(shot, name) is not None]
    if not ignored:
        return list(shot.warnings)
    text = (
        f"the file contains its own {' and '.join(ignored)}, which a stack ignores: pass one for "
        "the whole stack"
    )
    return [*shot.warnings, Caution("file", text)]


def _read(reader: Reader, path: Path, **options: int) -> tuple[AnyArray, dict[str, Any]]:
    """Read the image of a file, and warnings if the reader supports them."""
    if "warnings" not in inspect.signature(reader).parameters:
        return _plain_image(reader(path, **options)), {}
    warnings: list[Caution] = []
    image = _plain_image(reader(path, **options, warnings=warnings))
    return image, {"warnings": warnings} if warnings else {}


def _plain_image(image: Any) -> AnyArray:
    """Return an image without labels; an `InputError` if it has its own mask."""
    values, usable = unpack_array(image, "the shot")
    if usable is not None:
        raise InputError(
            f"the shot has {int((~usable).sum())} masked pixels of its own: give one mask for the "
            "whole stack, or describe the shots in a table with a mask each"
        )
    return np.asarray(values)


@dataclass(frozen=True)
class FileShot(Shot):
    """A file that holds one image."""

    path: Path  # absolute, so that a worker elsewhere finds it
    reader: Reader = read_shot

    def __dask_tokenize__(self) -> tuple[Any, ...]:
        # A changed file is another input, so dask must not reuse its result.
        from dask.base import normalize_token

        file_stamp = stamp(self.path) if self.path.exists() else {}
        return (str(self.path), normalize_token(self.reader), *file_stamp.values())

    def load(self) -> tuple[AnyArray, dict[str, Any]]:
        image, metadata = _read(self.reader, self.path)
        return image, {**stamp(self.path), "sha256": sha256(self.path), **metadata}

    def unchanged(self, origin: dict[str, Any]) -> bool:
        """Compare size and time, and only where these differ the checksum."""
        if not self.path.exists():
            return True  # removed after it was inverted
        if stamp(self.path).items() <= origin.items():
            return True
        return bool(sha256(self.path) == origin.get("sha256"))


def stamp(path: Path) -> dict[str, int]:
    """Return size and time of a file, which identify its content."""
    status = path.stat()
    return {"size": status.st_size, "mtime_ns": status.st_mtime_ns}


@dataclass(frozen=True)
class PageShot(Shot):
    """A page of a TIFF that holds many; its reader takes the keyword ``page``."""

    path: Path
    page: int
    reader: Reader = read_shot

    def load(self) -> tuple[AnyArray, dict[str, Any]]:
        image, metadata = _read(self.reader, self.path, page=self.page)
        return image, {"sha256": checksum(image), **metadata}


@dataclass(frozen=True, eq=False)
class ArrayShot(Shot):
    """An image in memory."""

    image: AnyArray = field(repr=False)

    def load(self) -> tuple[AnyArray, dict[str, Any]]:
        return self.image, {"sha256": checksum(self.image)}


@dataclass(frozen=True, eq=False)
class BlockShot(Shot):
    """An image of a dask array of shape (1, H, W), computed by dask's current scheduler."""

    block: Any = field(repr=False)

    def load(self) -> tuple[AnyArray, dict[str, Any]]:
        return ArrayShot(_plain_image(self.block.compute()[0])).load()


def checksum(array: AnyArray) -> str:
    """Return the SHA-256 of an array's values, shape and type, in hexadecimal."""
    digest = hashlib.sha256(f"{array.dtype.str}{array.shape}".encode())
    digest.update(np.ascontiguousarray(array).data)
    return digest.hexdigest()


def reader_text(reader: Reader) -> str:
    """Return the name of a reader, so that a store is not continued with another."""
    if isinstance(reader, functools.partial):
        keywords = ", ".join(f"{name}={value!r}" for name, value in sorted(reader.keywords.items()))
        return f"{reader_text(reader.func)}({keywords})"
    module, name = reader.__module__, getattr(reader, "__qualname__", type(reader).__qualname__)
    package = __name__.partition(".")[0]
    # Modules of this package may move; existing stores can still be continued.
    return f"{package}.{name}" if module.startswith(f"{package}.") else f"{module}.{name}"
