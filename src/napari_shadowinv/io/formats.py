"""Formats of files: how each is named, recognised, read and written.

- every format, once: `FORMATS`, in the order in which they are tried; one of them: `Format`
- the format of a file, by its content: `format_of`, or its name alone: `kind_of`

A new format takes a reader and an entry in `FORMATS`; `napari.yaml` lists the endings once more,
and a test compares the two. Functions are named and not imported, because the command's help lists
the formats and must not wait for numpy.
"""

from __future__ import annotations

import codecs
import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from math import prod
from pathlib import Path
from pkgutil import resolve_name
from typing import Any, Literal

from napari_shadowinv._system.safety import as_file_errors, check_regular
from napari_shadowinv.errors import FileFormatError
from napari_shadowinv.facts import ResultKind
from napari_shadowinv.io.files import split_address


@dataclass(frozen=True)
class Format:
    """A format of files; functions are named as ``module:name``, of this package."""

    name: str  # also ``Shot.metadata["kind"]``
    suffixes: tuple[str, ...]  # in lower case, the usual one first
    title: str = ""  # in messages and the command's help; empty if it cannot be read
    marks: tuple[tuple[int, bytes], ...] = ()  # where its files hold which bytes; one is enough
    test: str = ""  # of a path with a mark: whether it is one, where others begin the same way
    unmarked: Literal["text", "binary", ""] = ""  # its appearance without a mark
    holds: tuple[Literal["image", "result"], ...] = ("image",)
    reader: str = ""  # of a path: image and metadata, which replace those of `read`, or a dataset
    named_reader: str = ""  # the same, of a path and the name of an array
    # Of a path, and the name of an array if it is known: the lengths of the axes that count frames.
    # The readers then take the number of a frame, by default that of the first.
    counter: str = ""
    lister: str = ""  # of a path: the names of the images in it, and all arrays
    image_writer: str = ""  # of a file in memory, an image and its pixel size (m) or None
    result_writer: str = ""  # of a file in memory and a dataset
    results: tuple[ResultKind, ...] = ()  # kinds of the results that it writes
    is_scan: bool = False  # may it be a scan of film, whose grey levels fall with dose

    @property
    def suffix(self) -> str:
        """Usual ending."""
        return self.suffixes[0]

    def array_name(self, path: Path, variable: str | None) -> str | None:
        """Return the name of the array that is read, if arrays have names."""
        if variable is not None or not self.lister:
            return variable
        return str(function("arrays:only_image")(path, *self._call(self.lister, path)))

    def image_names(self, path: Path) -> list[str]:
        """Return the names of the images in a file; none where they have no names."""
        return self._call(self.lister, path)[0] if self.lister else []

    def read(self, path: Path, variable: str | None = None, number: int | None = None) -> Any:
        """Return the content of a file, one of its arrays, or one of the frames; see `reader`.

        Many frames are refused where one is read without its number.
        """
        variable = self.array_name(path, variable)
        names = () if variable is None else (variable,)
        numbers = {} if number is None else {"number": number}
        axes = self.count_frames(path, variable) if number is None else ()
        if prod(axes) == 1:
            reader = self.named_reader if names else self.reader
            return self._call(reader, path, *names, **numbers)
        first = f"{variable}[{','.join('0' * len(axes))}]"
        advice = "" if variable is None else f"choose one, such as {first!r}, or "
        raise FileFormatError(
            f"{path} holds {prod(axes)} frames: expected one image; {advice}invert all as a stack "
            "of shots"
        )

    def count_frames(self, path: Path, variable: str | None = None) -> tuple[int, ...]:
        """Return the lengths of the axes that count frames; none if the file holds one image."""
        if not self.counter or (variable is None) == bool(self.named_reader):
            return ()
        axes = self._call(self.counter, path, *(() if variable is None else (variable,)))
        return axes if isinstance(axes, tuple) else (axes,)

    @staticmethod
    def _call(reference: str, path: Path, *args: Any, **numbers: int) -> Any:
        """Call a function of a path; what a damaged file makes it raise is one kind of error."""
        return as_file_errors(function(reference))(path, *args, **numbers)

    def fits(self, path: Path, head: bytes) -> bool:
        """Return whether a file that begins with `head` is of this format."""
        if any(head[at : at + len(mark)] == mark for at, mark in self.marks):
            return not self.test or bool(function(self.test)(path))
        appearance = "text" if _is_text(head) else "binary"
        return appearance == self.unmarked and path.suffix.lower() in self.suffixes


def function(reference: str) -> Callable[..., Any]:
    """Import the function that a format names."""
    resolved: Callable[..., Any] = resolve_name(f"napari_shadowinv.io.{reference}")
    return resolved


# MATLAB 7.3 is HDF5 behind a header of its own, which other programs keep when they add to a file.
_HDF5 = ((0, b"\x89HDF\r\n\x1a\n"), (0, b"MATLAB"))

# fmt: off
TIFF = Format(
    "tiff", (".tif", ".tiff"), "TIFF",
    ((0, b"II*\x00"), (0, b"MM\x00*"), (0, b"II+\x00"), (0, b"MM\x00+")),
    reader="tiff:read_tiff", counter="tiff:count_tiff_frames", image_writer="tiff:write_tiff",
    is_scan=True,
)
PNG = Format(
    "png", (".png",), "PNG", ((0, b"\x89PNG\r\n\x1a\n"),),
    reader="images:read_picture", image_writer="images:write_png", is_scan=True,
)
BMP = Format("bmp", (".bmp",), "BMP", ((0, b"BM"),), reader="images:read_picture", is_scan=True)
JPEG = Format(
    "jpeg", (".jpg", ".jpeg"), "JPEG", ((0, b"\xff\xd8\xff"),),
    reader="images:read_picture", is_scan=True,
)
NPY = Format(
    "npy", (".npy",), "NPY", ((0, b"\x93NUMPY"),),
    reader="arrays:read_npy_plane", counter="arrays:count_npy", image_writer="arrays:write_npy",
)
MATLAB = Format(
    "mat", (".mat",), "MATLAB", ((0, b"MATLAB"),), test="matlab:is_matlab",
    lister="matlab:list_images", named_reader="matlab:read_mat", counter="matlab:count_mat",
)
PCO = Format("b16", (".b16",), "PCO .b16", ((0, b"PCO-"), (0, b"pco-")), reader="cameras:read_b16")
RESULT = Format(
    "shadowinv", (".shadowinv",), ".shadowinv", _HDF5, test="pradformat:is_result",
    holds=("result",), reader="read_write:read_result", named_reader="hdf5_arrays:read_plane",
    counter="hdf5_arrays:count_frames", result_writer="read_write:write_result",
    results=tuple(ResultKind),
)
PRADFORMAT = Format(
    "pradformat", (".h5", ".hdf5"), "pradformat", _HDF5, test="pradformat:is_pradformat",
    reader="pradformat:read_pradformat",
    named_reader="hdf5_arrays:read_plane", counter="hdf5_arrays:count_frames",
    result_writer="pradformat:write_pradformat",
    results=(ResultKind.INVERSION, ResultKind.FIT, ResultKind.FIELD),
)
HDF5 = Format(
    "hdf5", (*PRADFORMAT.suffixes, ".hdf", ".nxs", ".nx5", ".cxi", ".nc"), "HDF5 (NeXus, NetCDF 4)",
    _HDF5, lister="hdf5_arrays:list_images",
    named_reader="hdf5_arrays:read_plane", counter="hdf5_arrays:count_frames",
)
CPSA = Format(
    "cpsa", (".cpsa",), "CR-39 .cpsa", unmarked="binary",
    reader="cpsa:read_image",
)
# The oldest programs left the marks out.
SPE = Format(
    "spe", (".spe",), "Princeton .spe", ((2996, b"\x67\x45\x23\x01"), (4098, b"\x55\x55")),
    unmarked="binary", reader="cameras:read_spe", counter="cameras:count_spe",
)
TABLE = Format("table", (".csv",), holds=())
TEXT = Format(
    "text", (".txt", TABLE.suffix, ".dat", ".asc"), "numbers as .txt, .csv or .dat",
    unmarked="text", reader="text:read_text",
)
STORE = Format("store", (".shadowinv.zarr",), holds=("result",))

FORMATS = (
    TIFF, PNG, BMP, JPEG, NPY, PCO, MATLAB, RESULT, PRADFORMAT, HDF5, CPSA, SPE, TEXT, STORE,
)
# fmt: on


def _join_titles(titles: Iterable[str]) -> str:
    *most, last = filter(None, titles)
    return f"{', '.join(most)}, or {last}"


def _collect_suffixes(formats: Iterable[Format]) -> frozenset[str]:
    return frozenset(suffix for each in formats for suffix in each.suffixes)


def formats_for(kind: ResultKind) -> tuple[Format, ...]:
    """Return the formats that hold a kind of result, the complete one first."""
    return tuple(each for each in FORMATS if kind in each.results)


def suffixes_for(kind: ResultKind) -> tuple[str, ...]:
    """Return the endings of files for a kind of result, the usual one first."""
    return tuple(suffix for each in formats_for(kind) for suffix in each.suffixes)


READABLE = _join_titles(each.title for each in FORMATS)
IMAGE_TITLES = _join_titles(each.title for each in FORMATS if "image" in each.holds)
IMAGE_SUFFIXES = _collect_suffixes(each for each in FORMATS if "image" in each.holds)
SCAN_SUFFIXES = _collect_suffixes(each for each in FORMATS if each.is_scan)
# By the ending.
IMAGE_WRITERS = {
    suffix: each.image_writer for each in FORMATS if each.image_writer for suffix in each.suffixes
}
FIGURE_SUFFIXES = (PNG.suffix, ".pdf", ".svg")

# Their marks are those of TIFF.
_CAMERA_RAW = re.compile(
    r"\.(nef|nrw|cr2|arw|sr2|dng|pef|srw|3fr|iiq|erf|kdc|dcr|mef|mos)", re.IGNORECASE
)


@as_file_errors
def format_of(path: Path, *, head_bytes: int = 4100) -> Format:
    """Return the format of a file by its content, because its name may be wrong.

    Numbers as text have no mark, so they also need one of the usual endings. The head holds every
    mark.
    """
    path, _ = split_address(path)
    check_regular(path, f"a file ({READABLE})")
    with path.open("rb") as file:
        head = file.read(head_bytes)
    if not head:
        raise FileFormatError(f"{path} is empty (0 bytes): expected {READABLE}; copy it again")
    title = "a text file" if _is_text(head) else "not in a recognised image format"
    if _CAMERA_RAW.fullmatch(path.suffix):
        title = "a raw file of a photographic camera, whose pixels have different colour filters"
    elif fitting := [each for each in FORMATS if each.fits(path, head)]:
        return fitting[0]
    raise FileFormatError(
        f"{path} is {title}: expected {READABLE}; export the image to one of these, such as "
        "16-bit TIFF"
    )


def kind_of(path: str | Path) -> str:
    """Return the name of a file's format; see `format_of`."""
    return format_of(path).name


def _is_text(head: bytes, enough: int = 64) -> bool:
    """Return whether a file's first bytes are text; the first few show the kind."""
    head = head[:enough]
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
