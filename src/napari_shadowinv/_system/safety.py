"""Safety of readers: no file blocks them, fills the memory or ends them with a traceback.

- any error that a damaged file causes in a reader becomes one sentence: `as_file_errors`
- the same for the content of a dataset: `as_input_errors`
- only regular files are opened: `check_regular`; links followed: `resolved_path`
- a limit on the size of a file in memory: `check_size`
- a forecast of the memory that work on an image takes: `check_memory`
- small files of text, such as setups and calibrations: `small_text`
"""

from __future__ import annotations

import functools
import math
import os
import stat
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Concatenate, ParamSpec, TypeVar, cast

from pydantic import ValidationError

from napari_shadowinv._system.machine import physical_memory
from napari_shadowinv.errors import FileFormatError, InputError, InversionCancelled

# Gigabytes that a file may unfold to and work may take.
LIMIT_VARIABLE = "SHADOWINV_MAX_GB"

P = ParamSpec("P")
Content = TypeVar("Content")


class _DamagedContentError(InputError):
    """Content that its reader cannot use; a reader of files names the file, too."""


def as_file_errors(
    read: Callable[Concatenate[Path, P], Content],
) -> Callable[Concatenate[str | Path, P], Content]:
    """Turn any error of a reader of files into a `FileFormatError`, with it as the cause."""

    @functools.wraps(read)
    def guarded(path: str | Path, *args: P.args, **kwargs: P.kwargs) -> Content:
        try:
            return read(Path(path), *args, **kwargs)
        except _DamagedContentError as error:
            raise FileFormatError(f"{path}: {error}") from error
        except (FileFormatError, InputError, InversionCancelled):
            raise
        except MemoryError as error:
            raise FileFormatError(
                f"{path} needs more memory than is available: close other programs, or crop or "
                "bin the image first"
            ) from error
        except Exception as error:
            if isinstance(error, OSError) and error.strerror:
                raise FileFormatError(
                    f"{path} cannot be read ({error.strerror}): check its permissions and the disk"
                ) from error
            raise FileFormatError(
                f"{path} could not be read ({_error_reason(error)}): it is damaged, incomplete, "
                "or in a form that needs another reader; copy it again, or export it, an image as "
                "16-bit TIFF"
            ) from error

    return cast("Callable[Concatenate[str | Path, P], Content]", guarded)


def _error_reason(error: BaseException) -> str:
    text = f"{error} is missing" if isinstance(error, KeyError) else str(error)
    if isinstance(error, ValidationError):
        first = error.errors()[0]
        text = f"{'.'.join(map(str, first['loc']))}: {first['msg']}"
    return " ".join(text.split())[:120].rstrip(".") or type(error).__name__


@contextmanager
def as_input_errors(name: str) -> Iterator[None]:
    """Turn any error that the content of a dataset causes in a block into an `InputError`."""
    try:
        yield
    except (InputError, MemoryError):
        raise
    except Exception as error:
        raise _DamagedContentError(
            f"{name} is damaged or was changed ({_error_reason(error)}): expected it as this "
            "package writes it"
        ) from error


def check_regular(path: Path, expected: str) -> None:
    """Refuse anything but a regular file before it is opened: a pipe would block for ever."""
    try:
        mode = path.stat().st_mode
    except FileNotFoundError:
        raise FileFormatError(
            f"{path} does not exist: expected {expected}; check the path"
        ) from None
    except (OSError, ValueError) as error:  # a null character
        shown, reason = str(path).replace("\0", "\\0"), getattr(error, "strerror", error)
        raise FileFormatError(
            f"{shown} cannot be opened ({reason}): check its permissions and the path"
        ) from None
    if stat.S_ISDIR(mode):
        raise FileFormatError(f"{path} is a folder: expected {expected}")
    if not stat.S_ISREG(mode):
        raise FileFormatError(
            f"{path} is a pipe, socket or device: expected {expected}; save it as a file first"
        )


def resolved_path(path: str | Path) -> Path:
    """Return an absolute path without links; one that cannot be followed as far as it can be."""
    try:
        return Path(os.path.realpath(path))
    except ValueError as error:  # a null character
        raise FileFormatError(f"{str(path)!r} is no path ({error}): correct it") from None


def size_limit(*, share: float = 1 / 8, memory_if_unknown: int = 8_000_000_000) -> int:
    """Return the most bytes of a file in memory, by `LIMIT_VARIABLE` or a share of the memory.

    Reading needs a few copies of the image, and other programs some memory too.
    """
    text = os.environ.get(LIMIT_VARIABLE)
    if text is None:
        return int(share * (physical_memory() or memory_if_unknown))
    try:
        limit = float(text)
    except ValueError:
        limit = 0.0
    if not 0 < limit < float("inf"):
        raise InputError(f"{LIMIT_VARIABLE} is {text!r}: expected a number of gigabytes above 0")
    return int(1e9 * limit)


def check_size(path: str | Path, promised: int) -> None:
    """Refuse a file that would unfold to more bytes in memory than fit well, before it does."""
    limit = size_limit()
    if promised > limit:
        raise FileFormatError(
            f"{path} expands to {promised / 1e9:.3g} GB in memory, expected at most "
            f"{limit / 1e9:.3g} GB: crop or bin it, or raise the environment variable "
            f"{LIMIT_VARIABLE}"
        )


def check_memory(shape: Sequence[int], bytes_per_pixel: float, work: str) -> None:
    """Refuse an image of `shape` for which `work` needs more memory than there is."""
    needed = bytes_per_pixel * math.prod(shape)
    limit = size_limit() if LIMIT_VARIABLE in os.environ else physical_memory()
    if limit is not None and needed > limit:
        raise InputError(
            f"{work} of {' × '.join(map(str, shape))} pixels needs about {needed / 1e9:.3g} GB of "
            f"memory, expected at most {limit / 1e9:.3g} GB: crop or bin the image first, or raise "
            f"the environment variable {LIMIT_VARIABLE}"
        )


def small_text(path: Path, expected: str, encoding: str = "utf-8-sig", most: int = 10**6) -> str:
    """Return the text of a file, refusing one of more than `most` bytes."""
    check_regular(path, expected)
    with path.open("rb") as file:
        raw = file.read(most + 1)
    if len(raw) > most:
        raise FileFormatError(
            f"{path} is larger than {most // 1_000_000} MB: expected {expected}; check "
            "that it is the right file"
        )
    try:
        return raw.decode(encoding)
    except UnicodeDecodeError:
        raise FileFormatError(f"{path} is not a text file: expected {expected}") from None
