"""One shot of a stack: a reference, `Shot`, that is read when it is needed."""

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
    """One image that is read when it is asked for; it can be sent to a worker."""

    def load(self) -> tuple[AnyArray, dict[str, Any]]:
        """Return the image and its ``sha256``, with ``warnings`` for the shot's report if any."""
        raise NotImplementedError

    def shape(self) -> tuple[int, ...]:
        """Return the shape of the image, which is read for it."""
        return np.shape(self.load()[0])

    def unchanged(self, origin: dict[str, Any]) -> bool:
        """Whether it is still the image of which `load` said this."""
        return bool(self.load()[1]["sha256"] == origin.get("sha256"))


def read_shot(
    path: Path,
    *,
    page: int | None = None,
    channel: str | int | None = None,
    variable: str | None = None,
    warnings: list[Caution] | None = None,
) -> FloatArray:
    """Read the image of a shot; this is the reader where none is given.

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
        image, told = read_tiff_page(path, page, channel=channel)
        shot = Radiograph(image, warnings=told)
    if warnings is not None:
        warnings.extend(doubts_of_file(shot))
    return shot.image


def doubts_of_file(shot: Radiograph) -> list[Caution]:
    """Reasons to doubt the image of a file in a stack."""
    ignored = [name for name in ("source", "mask") if getattr(shot, name) is not None]
    told = f"the file contains its own {' and '.join(ignored)}, which a stack ignores: pass one"
    if not ignored:
        return list(shot.warnings)
    return [*shot.warnings, Caution("file", f"{told} for the whole stack")]


def _read(reader: Reader, path: Path, **chosen: int) -> tuple[AnyArray, dict[str, Any]]:
    """Image of a file, and warnings if the reader can tell some."""
    if "warnings" not in inspect.signature(reader).parameters:
        return _plain(reader(path, **chosen)), {}
    warnings: list[Caution] = []
    image = _plain(reader(path, **chosen, warnings=warnings))
    return image, {"warnings": warnings} if warnings else {}


def _plain(image: Any) -> AnyArray:
    """Image without labels; a mask of its own is refused, as all shots share one."""
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
        # A file that changed is another input, and what dask has of it another result.
        from dask.base import normalize_token

        known = stamp(self.path) if self.path.exists() else {}
        return (str(self.path), normalize_token(self.reader), *known.values())

    def load(self) -> tuple[AnyArray, dict[str, Any]]:
        image, told = _read(self.reader, self.path)
        return image, {**stamp(self.path), "sha256": sha256(self.path), **told}

    def unchanged(self, origin: dict[str, Any]) -> bool:
        """Compare size and time, and only where these differ the checksum."""
        if not self.path.exists():
            return True  # put away after it was inverted
        if stamp(self.path).items() <= origin.items():
            return True
        return bool(sha256(self.path) == origin.get("sha256"))


def stamp(path: Path) -> dict[str, int]:
    """Return size and time of a file, by which it is taken for the same."""
    status = path.stat()
    return {"size": status.st_size, "mtime_ns": status.st_mtime_ns}


@dataclass(frozen=True)
class PageShot(Shot):
    """A page of a TIFF that holds many; its reader takes the keyword ``page``."""

    path: Path
    page: int
    reader: Reader = read_shot

    def load(self) -> tuple[AnyArray, dict[str, Any]]:
        image, told = _read(self.reader, self.path, page=self.page)
        return image, {"sha256": checksum(image), **told}


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
        return ArrayShot(_plain(self.block.compute()[0])).load()


def checksum(array: AnyArray) -> str:
    """Return the SHA-256 of an array's values, shape and type, in hexadecimal."""
    digest = hashlib.sha256(f"{array.dtype.str}{array.shape}".encode())
    digest.update(np.ascontiguousarray(array).data)
    return digest.hexdigest()


def described_reader(reader: Reader) -> str:
    """Name a reader, so that a store is not continued with another."""
    if isinstance(reader, functools.partial):
        named = ", ".join(f"{name}={value!r}" for name, value in sorted(reader.keywords.items()))
        return f"{described_reader(reader.func)}({named})"
    module, name = reader.__module__, getattr(reader, "__qualname__", type(reader).__qualname__)
    own = __name__.partition(".")[0]
    # Where ours lie may change; the stores that were begun with them go on.
    return f"{own}.{name}" if module.startswith(f"{own}.") else f"{module}.{name}"
