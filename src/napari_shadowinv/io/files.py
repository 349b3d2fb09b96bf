"""Checks, checksums and safe writing of files of any format.

- the file of ``file.h5::/entry/data`` and the name of the array: `split_address`, `join_address`
- its fingerprint: `sha256`; its name as text: `text_of`; many in order: `in_counting_order`
- refuse a header that promises more than there is: `check_promise`
- refuse an output before hours of work: `check_output`, `check_folder_of`
- write all of a file or nothing: `replacing`, `write_toml`; make a folder: `make_folder`
"""

from __future__ import annotations

import errno
import hashlib
import os
import re
from collections.abc import Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from napari_shadowinv._system.hidden_files import hidden_name, locked
from napari_shadowinv._system.machine import clear_up_when_terminated, defer_interrupts
from napari_shadowinv._system.safety import check_regular
from napari_shadowinv.errors import FileFormatError, InputError

DEFLATE_RATIO = 1040  # the most that zlib can pack into one byte, a little rounded up
_ADDRESS = "::"  # between a file and the name of an array in it
_NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


def split_address(path: str | Path, variable: str | None = None) -> tuple[Path, str | None]:
    """Return the file of an image, and the name of the array that its path ends with.

    Every path of an image goes through here.
    """
    text = str(path)
    if not text:
        raise InputError("received an empty text: expected the path of a file")
    if os.path.exists(path):
        return Path(path), variable
    file, separator, name = text.partition(_ADDRESS)
    if not separator:
        return Path(path), variable
    if variable is not None:
        raise InputError(f"{text} names an array, as does the variable {variable!r}: name it once")
    if not file:
        raise InputError(f"{text} names an array without its file: expected file.h5{text}")
    return Path(file), name or "/"


def check_promise(path: Path, header: str, promised: int, present: int) -> None:
    """Refuse a file whose `header` promises more bytes than the file has, before allocating."""
    if promised > present:
        raise FileFormatError(
            f"{path} is damaged or truncated: its {header} header implies {promised} bytes, but "
            f"at most {present} are present; copy it again"
        )


def sha256(path: str | Path) -> str:
    """Return the SHA-256 checksum of a file, in hexadecimal; of an array's, that of its file."""
    path, _ = split_address(path)
    check_regular(path, "a file")
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def text_of(path: str | Path) -> str:
    """Return a path as text that a file can store, with undecodable bytes as escapes."""
    return os.fsencode(path).decode("utf-8", errors="backslashreplace")


def join_address(file: Path | str, variable: str | None) -> Path:
    """Return the path of an array in a file, or of the file alone without one."""
    return Path(file) if variable is None else Path(f"{file}{_ADDRESS}{variable}")


def name_of(path: str | Path) -> str:
    """Return the name of a file as text, with that of the array in it."""
    file, variable = split_address(path)
    return text_of(join_address(file.name, variable))


def in_counting_order(paths: Iterable[Path]) -> list[Path]:
    """Sort files folder by folder, with numbers in their names by value: A1, a9, a10, b2."""
    return sorted(paths, key=lambda path: ([_counting_key(part) for part in path.parts], path))


def _counting_key(name: str) -> list[tuple[int, int, str]]:
    parts = re.split(r"(\d+)", name.lower())
    return [(0, int(part), "") if part.isdecimal() else (1, 0, part) for part in parts if part]


def check_output(
    path: str | Path, overwrite: bool = False, *, suffixes: Collection[str] = ()
) -> Path:
    """Refuse a path that cannot be written, before any long work; return it.

    Parameters
    ----------
    path : str or Path
    overwrite : bool
        Whether an existing file may be replaced.
    suffixes : collection of str
        The endings that are allowed; empty for all.

    Raises
    ------
    FileFormatError
        If the path exists, is a folder, is in no folder, or cannot be written.
    """
    path = Path(path)
    if suffixes and path.suffix.lower() not in suffixes:
        ending = f"'{path.suffix}'" if path.suffix else "none"
        raise FileFormatError(
            f"{path} cannot be written: its ending is {ending}, expected one of "
            f"{', '.join(sorted(suffixes))}"
        )
    check_folder_of(path)
    if path.is_dir():
        raise FileFormatError(f"{path} is a folder: give a file name")
    if path.exists() and not overwrite:
        raise FileFormatError(
            f"{path} exists: choose another name, or allow to overwrite it", option="overwrite"
        )
    return path


def check_folder_of(path: Path) -> None:
    """Refuse a path whose folder does not exist or is read-only."""
    if not path.parent.is_dir():
        raise FileFormatError(
            f"{path} cannot be written: the folder {path.parent} does not exist; create it first"
        )
    if not os.access(path.parent, os.W_OK):
        raise FileFormatError(
            f"{path} cannot be written: the folder {path.parent} is read-only; choose another"
        )


def make_folder(path: Path) -> None:
    """Make a folder and its parents, unless they exist."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise FileFormatError(
            f"{path} cannot be created as a folder ({error.strerror}): choose another name"
        ) from None


def write_toml(path: str | Path, content: Mapping[str, Any], overwrite: bool = False) -> None:
    """Write keys and values as a TOML file, completely or not at all."""
    import tomli_w

    with replacing(path, overwrite) as temporary:
        temporary.write_text(tomli_w.dumps(content), encoding="utf-8")


@contextmanager
def replacing(path: str | Path, overwrite: bool = False) -> Iterator[Path]:
    """Write a file completely or not at all; path and overwrite as in `check_output`.

    Yields
    ------
    Path
        A temporary path in the folder of `path`, with the same ending. It becomes `path` when the
        block ends well and the disk has taken it, and is removed on any error or interruption.

    Raises
    ------
    FileFormatError
        As `check_output`, before the block and again after it; if another process is writing the
        file; and if there is no room.

    Examples
    --------
    >>> import tempfile
    >>> path = Path(tempfile.mkdtemp()) / "note.txt"
    >>> with replacing(path) as temporary:
    ...     _ = temporary.write_text("done")
    >>> path.read_text()
    'done'
    """
    path = check_output(path, overwrite)
    temporary = hidden_name(path, f".part{path.suffix}")
    with clear_up_when_terminated(), locked(path):
        try:
            temporary.unlink(missing_ok=True)  # left by a killed process
            yield temporary
            # Someone else may have written the file during the work.
            check_output(path, overwrite)
            with defer_interrupts():
                # Only when the disk has the file is it known that there was room for it.
                with temporary.open("rb+") as file:
                    os.fsync(file.fileno())
                os.replace(temporary, path)
        except OSError as error:
            if error.errno not in _NO_ROOM:
                raise
            raise FileFormatError(
                f"{path} cannot be written ({error.strerror}): free some disk space, or choose "
                "another folder"
            ) from error
        finally:
            # A second Ctrl-C must not leave the half of it behind.
            with defer_interrupts():
                temporary.unlink(missing_ok=True)
