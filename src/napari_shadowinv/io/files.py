"""What every file needs, whatever its format.

- tell the kind of a file from its first bytes: `kind_of`
- its fingerprint: `sha256`; its name as text: `text_of`
- order many, shot 2 before shot 10: `in_counting_order`
- refuse an output before hours of work: `check_output`, `check_folder_of`
- write all of a file or nothing: `replacing`
"""

from __future__ import annotations

import codecs
import errno
import hashlib
import os
import re
import secrets
from collections.abc import Collection, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

from napari_shadowinv._system.interrupts import interrupts_put_off
from napari_shadowinv._system.safety import check_regular, refusing_damage
from napari_shadowinv.errors import FileFormatError

__all__ = [
    "READABLE",
    "check_folder_of",
    "check_output",
    "in_counting_order",
    "kind_of",
    "replacing",
    "sha256",
    "text_of",
]

READABLE = (
    "TIFF, PNG, BMP, JPEG, NPY, MATLAB, PCO .b16, Princeton .spe, pradformat HDF5, .shadowinv, "
    "or numbers as .txt, .csv or .dat"
)

_READABLE_SIGNATURES: dict[bytes, str] = {
    b"II*\x00": "tiff",
    b"MM\x00*": "tiff",
    b"II+\x00": "tiff",
    b"MM\x00+": "tiff",
    b"\x89PNG\r\n\x1a\n": "png",
    b"BM": "bmp",
    b"\xff\xd8\xff": "jpeg",
    b"\x93NUMPY": "npy",
    b"\x89HDF\r\n\x1a\n": "hdf5",
    b"MATLAB": "mat",
    b"PCO-": "b16",
    b"pco-": "b16",
}

_TEXT_SUFFIXES = (".txt", ".csv", ".dat", ".asc")

# Where Princeton's header keeps two numbers that are always the same, and these.
_SPE_MARKS = ((2996, b"\x67\x45\x23\x01"), (4098, b"\x55\x55"))

# The disk is full, the quota used up, or the file longer than is allowed.
_NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)

_OTHER_SIGNATURES: dict[bytes, str] = {
    b"PK\x03\x04": "a zip archive (such as NPZ or XLSX)",
    b"\x1f\x8b": "a gzip archive",
    b"%PDF": "a PDF document",
    b"GIF8": "a GIF picture",
    b"SIMPLE  =": "a FITS file",
    b"CDF": "a NetCDF 3 file",
}


@refusing_damage
def kind_of(path: Path) -> str:
    """Tell the kind of a file from its content; its name may lie.

    Numbers as text have no mark: they need one of the usual endings too.

    Parameters
    ----------
    path : str or Path
        A file.

    Returns
    -------
    str
        ``"tiff"``, ``"png"``, ``"bmp"``, ``"jpeg"``, ``"npy"``, ``"hdf5"``, ``"mat"``, ``"b16"``,
        ``"spe"`` or ``"text"``.

    Raises
    ------
    FileFormatError
        If there is no such file, it cannot be opened, is empty, or of another kind.
    """
    head = _first_bytes(path)
    if not head:
        raise FileFormatError(f"{path} is empty (0 bytes): expected {READABLE}; copy it again")
    for signature, kind in _READABLE_SIGNATURES.items():
        if head.startswith(signature):
            return kind
    if is_spe(path):
        return "spe"
    if path.suffix.lower() in _TEXT_SUFFIXES and _is_text(head):
        return "text"
    raise FileFormatError(
        f"{path} is {_describe(head)}: expected {READABLE}; export the image to one of these"
    )


def is_spe(path: Path) -> bool:
    """Tell whether a file is SPE by the marks inside its header, or else by its name.

    Parameters
    ----------
    path : Path
        A file.

    Returns
    -------
    bool
        True for a file with either mark, and for one that is named ``.spe`` and no text: the
        oldest programs left the marks out.
    """
    with path.open("rb") as file:
        head = file.read(4100)
    marked = any(head[at : at + len(mark)] == mark for at, mark in _SPE_MARKS)
    return marked or (path.suffix.lower() == ".spe" and not _is_text(head[:64]))


def _first_bytes(path: Path, count: int = 64) -> bytes:
    check_regular(path, f"a file ({READABLE})")
    with path.open("rb") as file:
        return file.read(count)


def _describe(head: bytes) -> str:
    for signature, text in _OTHER_SIGNATURES.items():
        if head.startswith(signature):
            return text
    return "a text file" if _is_text(head) else "not in a recognised image format"


def _is_text(head: bytes) -> bool:
    try:
        # Incremental, because the last character may have been cut in two.
        text = codecs.getincrementaldecoder("utf-8-sig")().decode(head)
    except UnicodeDecodeError:
        # Comments that Windows wrote, such as µm in latin-1.
        text = head.decode("latin-1")
        return _is_plain(text) and text[0] in "#%"
    return _is_plain(text)


def _is_plain(text: str) -> bool:
    return all(character.isprintable() or character.isspace() for character in text)


def sha256(path: str | Path) -> str:
    """Return the SHA-256 checksum of a file, in hexadecimal."""
    with Path(path).open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def text_of(path: str | Path) -> str:
    """Return a path as text that can be kept in a file.

    Names that are no text in this system's encoding, as an old disk may hold them, show the
    bytes that are not understood.

    Parameters
    ----------
    path : str or Path
        A path or a name.

    Returns
    -------
    str
    """
    return os.fsencode(path).decode("utf-8", errors="backslashreplace")


def in_counting_order(paths: Iterable[Path]) -> list[Path]:
    """Sort files as one counts, folder by folder.

    Parameters
    ----------
    paths : iterable of Path
        Files.

    Returns
    -------
    list of Path
        The same; numbers in their names, and in those of their folders, count by their value.
        Upper and lower case are the same but for names that differ in nothing else.

    Examples
    --------
    >>> [path.name for path in in_counting_order(map(Path, ["b2", "a10", "a9", "A1"]))]
    ['A1', 'a9', 'a10', 'b2']
    """
    return sorted(paths, key=lambda path: ([_counting(part) for part in path.parts], path))


def _counting(name: str) -> list[tuple[int, int, str]]:
    parts = re.split(r"(\d+)", name.lower())
    return [(0, int(part), "") if part.isdecimal() else (1, 0, part) for part in parts if part]


def check_output(
    path: str | Path, overwrite: bool = False, *, suffixes: Collection[str] = ()
) -> Path:
    """Refuse a path that cannot be written, before any long work.

    Parameters
    ----------
    path : str or Path
        The file to be written later.
    overwrite : bool
        Whether an existing file may be replaced.
    suffixes : collection of str
        The endings that name a format here; empty if any will do.

    Returns
    -------
    Path
        The same path.

    Raises
    ------
    FileFormatError
        If the path exists, is a folder, has no folder to lie in, cannot be written, or
        has an ending that names no format.
    """
    path = Path(path)
    if suffixes and path.suffix.lower() not in suffixes:
        found = f"'{path.suffix}'" if path.suffix else "none"
        raise FileFormatError(
            f"{path} cannot be written: its ending is {found}, expected one of "
            f"{', '.join(sorted(suffixes))}"
        )
    if path.is_dir():
        raise FileFormatError(f"{path} is a folder: give a file name")
    if path.exists() and not overwrite:
        raise FileFormatError(
            f"{path} exists: choose another name or allow overwriting (overwrite=True, or "
            "--overwrite on the command line)"
        )
    check_folder_of(path)
    return path


def check_folder_of(path: Path) -> None:
    """Refuse a path that has no folder to lie in, or one that nothing can be written to.

    Parameters
    ----------
    path : Path
        The file or folder to be made later.

    Raises
    ------
    FileFormatError
        If its folder is missing or read-only.
    """
    if not path.parent.is_dir():
        raise FileFormatError(
            f"{path} cannot be written: the folder {path.parent} does not exist; create it first"
        )
    if not os.access(path.parent, os.W_OK):
        raise FileFormatError(
            f"{path} cannot be written: the folder {path.parent} is read-only; choose another"
        )


@contextmanager
def replacing(path: str | Path, overwrite: bool = False) -> Iterator[Path]:
    """Write a file completely or not at all.

    Parameters
    ----------
    path : str or Path
        The file to be made.
    overwrite : bool
        Whether an existing file may be replaced.

    Yields
    ------
    Path
        A new name beside `path`, with the same ending, to write to. It becomes `path`
        when the block ends well and the disk has taken it, and is removed on any error or
        interruption.

    Raises
    ------
    FileFormatError
        As `check_output`, before the block and again when it has ended; and if there is no
        room for the file.

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
    temporary = path.with_name(f".{path.stem}-{secrets.token_hex(4)}{path.suffix}")
    try:
        yield temporary
        # Someone else may have written the file during the work.
        check_output(path, overwrite)
        with interrupts_put_off():
            _flush(temporary)
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
        with interrupts_put_off():
            temporary.unlink(missing_ok=True)


def _flush(path: Path) -> None:
    """Wait until the disk has a file; only then is it known that there was room for it."""
    with path.open("rb+") as file:
        os.fsync(file.fileno())
