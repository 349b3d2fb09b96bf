"""Files that cannot be read: one sentence, soon, without asking for memory."""

import struct
import tracemalloc
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import imageio.v3 as iio
import numpy as np
import pytest
import tifffile
from scipy.io import savemat

from napari_shadowinv.errors import FileFormatError, InputError
from napari_shadowinv.io import read

Array = np.ndarray[Any, Any]
NOISE = np.random.default_rng(0).integers(1, 255, (64, 80)).astype(np.uint16)
NAN = np.full((64, 80), np.nan)
CUBE = np.ones((4, 5, 6), np.uint16)
HUGE = 100_000


def mat5(array: Array) -> Callable[[Path], object]:
    return lambda path: savemat(path, {"shot": array})


def mat7(array: Array) -> Callable[[Path], object]:
    return lambda path: savemat(path, {"shot": array}, do_compression=True)


def mat73(array: Array) -> Callable[[Path], object]:
    def write(path: Path) -> None:
        with h5py.File(path, "w", userblock_size=512) as file:
            file["shot"] = array.T
            file["shot"].attrs["MATLAB_class"] = np.bytes_(b"double")
        head = b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM"
        path.write_bytes(head + path.read_bytes()[len(head) :])

    return write


def prad(array: Array) -> Callable[[Path], object]:
    def write(path: Path) -> None:
        with h5py.File(path, "w") as file:
            file["image"] = array
            file.attrs["object_type"] = "radiograph"

    return write


def b16(array: Array, height: int | None = None, start: int = 24) -> Callable[[Path], object]:
    rows = array.shape[0] if height is None else height
    header = b"PCO-" + struct.pack("<5i", 24 + array.nbytes, start, array.shape[1], rows, 0)
    return lambda path: path.write_bytes(header + array.astype("<u2").tobytes())


def spe(
    array: Array, shape: tuple[int, ...] = (), code: int = 3, frames: int = 1, footer: int = 0
) -> Callable[[Path], object]:
    header = bytearray(4100)
    height, width = (shape or array.shape)[-2:]
    for form, offset, value in (
        ("<H", 42, width),
        ("<H", 656, height),
        ("<i", 1446, frames),
        ("<h", 108, code),
        ("<f", 1992, 3.0 if footer else 2.5),
        ("<Q", 678, footer),
    ):
        struct.pack_into(form, header, offset, value)
    tail = b"<SpeFormat/>" if footer else b""
    return lambda path: path.write_bytes(bytes(header) + array.tobytes() + tail)


def npy(array: Array) -> Callable[[Path], object]:
    return lambda path: np.save(path, array)


def tiff(array: Array) -> Callable[[Path], object]:
    return lambda path: tifffile.imwrite(path, array, photometric="minisblack")


def picture(path: Path) -> None:
    iio.imwrite(path, NOISE.astype(np.uint8))


def text(content: str | bytes) -> Callable[[Path], object]:
    raw = content if isinstance(content, bytes) else content.encode()
    return lambda path: path.write_bytes(raw)


def table(array: Array) -> Callable[[Path], object]:
    return lambda path: np.savetxt(path, array)


def cut(write: Callable[[Path], object], share: float) -> Callable[[Path], object]:
    def write_part(path: Path) -> None:
        write(path)
        content = path.read_bytes()
        path.write_bytes(content[: int(share * len(content))])

    return write_part


def patched(write: Callable[[Path], object], *changes: tuple[int, bytes]) -> Callable[[Path], Any]:
    def write_patched(path: Path) -> None:
        write(path)
        content = bytearray(path.read_bytes())
        for offset, new in changes:
            content[offset : offset + len(new)] = new
        path.write_bytes(content)

    return write_patched


def packed_promise(path: Path) -> None:
    """Write a small packed variable whose inner lengths ask for gigabytes."""
    savemat(path, {"shot": NOISE.astype(float)})
    content = bytearray(path.read_bytes())
    # Tag and flags take 24 bytes, dimensions 16, the name 8: then comes the values' tag.
    struct.pack_into("<I", content, 128 + 48 + 4, 4_000_000_000)
    body = zlib.compress(bytes(content[128:]))
    path.write_bytes(content[:128] + struct.pack("<II", 15, len(body)) + body)


def unwritten(path: Path, name: str, **root: str) -> None:
    with h5py.File(path, "w") as file:
        file.create_dataset(name, shape=(HUGE, HUGE), dtype="f8", chunks=(100, 100))
        file[name].attrs["MATLAB_class"] = np.bytes_(b"double")
        file.attrs.update(root)


def large_tiff(path: Path) -> None:
    tiff(NOISE)(path)
    with tifffile.TiffFile(path, mode="r+") as file:
        page = file.pages.first
        page.tags["ImageLength"].overwrite(HUGE)
        page.tags["ImageWidth"].overwrite(HUGE)


def large_png(path: Path) -> None:
    def chunk(name: bytes, data: bytes) -> bytes:
        return (
            struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))
        )

    header = struct.pack(">IIBBBBB", 12_000, 12_000, 8, 0, 0, 0, 0)
    body = chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(bytes(100))) + chunk(b"IEND", b"")
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + body)


GOOD: dict[str, Callable[[Path], object]] = {
    "five.mat": mat5(NOISE),
    "seven.mat": mat7(NOISE),
    "hdf.mat": mat73(NOISE),
    "shot.txt": table(NOISE),
    "shot.b16": b16(NOISE),
    "two.spe": spe(NOISE),
    "three.spe": spe(NOISE, footer=4100 + NOISE.nbytes),
    "shot.npy": npy(NOISE),
    "shot.tif": tiff(NOISE),
    "shot.h5": prad(NOISE),
    "shot.png": picture,
    "shot.bmp": picture,
    "shot.jpg": picture,
}
ZERO = NOISE[:0]
RANDOM = np.random.default_rng(7).integers(128, 256, 9000).astype(np.uint8).tobytes()
CUT = GOOD.keys() - {"shot.txt"}  # whose first rows are an image, too

BAD: dict[str, tuple[str, Callable[[Path], object]]] = {
    **{f"empty {name}": (name, text(b"")) for name in GOOD},
    **{
        f"{share} of {name}": (name, cut(GOOD[name], share))
        for name in sorted(CUT)
        for share in (0.01, 0.5, 0.95)
    },
    "wrong magic mat": ("a.mat", patched(mat5(NOISE), (0, b"X"))),
    "wrong byte order mat": ("a.mat", patched(mat5(NOISE), (126, b"XX"))),
    "wrong element mat": ("a.mat", patched(mat5(NOISE), (152, b"\xff" * 40))),
    "wrong packed bytes mat": ("a.mat", patched(mat7(NOISE), (138, b"\xff" * 40))),
    "wrong values mat": ("a.mat", patched(mat7(NOISE), (3000, b"\xff" * 400))),
    "wrong magic hdf mat": ("a.mat", patched(mat73(NOISE), (512, b"X"))),
    "wrong magic b16": ("a.b16", patched(b16(NOISE), (0, b"X"))),
    "wrong magic npy": ("a.npy", patched(npy(NOISE), (1, b"X"))),
    "wrong header b16": ("a.b16", b16(NOISE, start=-5)),
    "wrong type spe": ("a.spe", spe(NOISE, code=77)),
    "huge shape mat": ("a.mat", patched(mat5(NOISE), (160, struct.pack("<ii", HUGE, HUGE)))),
    "huge element mat": ("a.mat", patched(mat5(NOISE), (132, b"\xf0\xff\xff\xff"))),
    "huge values mat": ("a.mat", patched(mat5(NOISE), (180, b"\xf0\xff\xff\xff"))),
    "huge packed values mat": ("a.mat", packed_promise),
    "huge hdf mat": ("a.mat", lambda path: unwritten(path, "shot")),
    "huge pradformat": (
        "a.h5",
        lambda path: unwritten(path, "image", object_type="radiograph"),
    ),
    "huge b16": ("a.b16", b16(NOISE, height=2**31 - 1)),
    "huge spe": ("a.spe", spe(NOISE, shape=(65535, 65535))),
    "huge footer spe": ("a.spe", spe(NOISE, footer=2**60)),
    "huge npy": ("a.npy", patched(npy(NOISE), (60, b"(900000, 800000), }"))),
    "huge tiff": ("a.tif", large_tiff),
    "huge png": ("a.png", large_png),
    "huge bmp": ("a.bmp", patched(picture, (18, struct.pack("<ii", 12_000, 12_000)))),
    "huge line": ("a.txt", text(b"7 " * 4_000_000)),
    "prose txt": ("a.txt", text("Dear colleague,\nthe film is in the post.\n")),
    "prose mat": ("a.mat", text("1 2 3\n4 5 6\n")),
    "prose spe": ("a.spe", text("Dear colleague,\n" * 1000)),
    "prose b16": ("a.b16", text("1 2 3\n4 5 6\n")),
    "late ragged txt": ("a.txt", text("1 2 3\n" * 20_000 + "4 5\n")),
    "late word csv": ("a.csv", text("1,2,3\n" * 20_000 + "4,5,six\n")),
    "comments only": ("a.dat", text("# energy = 14.7\n" * 10)),
    "random txt": ("a.txt", text(RANDOM)),
    "random spe": ("a.spe", text(RANDOM)),
    "random mat": ("a.mat", text(RANDOM)),
    "gzip csv": ("a.csv", text(b"\x1f\x8b\x08" + RANDOM)),
    "matlab name only": ("a.mat", text(b"MATLAB 5.0 MAT-file")),
    "matlab 7.3 name only": ("a.mat", text(b"MATLAB 7.3 MAT-file")),
    "matlab, nothing inside": ("a.mat", cut(mat5(NOISE), 128 / (128 + 56 + NOISE.nbytes))),
    "nan mat": ("a.mat", mat5(NAN)),
    "nan hdf mat": ("a.mat", mat73(NAN)),
    "nan txt": ("a.txt", table(NAN)),
    "nan spe": ("a.spe", spe(NAN, code=5)),
    "nan npy": ("a.npy", npy(NAN)),
    "nan tiff": ("a.tif", tiff(NAN.astype(np.float32))),
    "nan pradformat": ("a.h5", prad(NAN)),
    "colour npy": ("a.npy", npy(CUBE[..., :3])),
    "cut cube spe": ("a.spe", spe(CUBE, frames=9)),
    "cube pradformat": ("a.h5", prad(CUBE)),
    "zero mat": ("a.mat", mat5(ZERO)),
    "zero hdf mat": ("a.mat", mat73(ZERO)),
    "zero npy": ("a.npy", npy(ZERO)),
    "zero b16": ("a.b16", b16(NOISE, height=0)),
    "negative b16": ("a.b16", b16(NOISE, height=-64)),
    "zero spe": ("a.spe", spe(NOISE, shape=(0, 80))),
    "no frames spe": ("a.spe", spe(NOISE, frames=0)),
    "zero pradformat": ("a.h5", prad(ZERO)),
}


@pytest.fixture(scope="module")
def imported(tmp_path_factory: pytest.TempPathFactory) -> None:
    """Read each good file, so that imports do not count as memory."""
    folder = tmp_path_factory.mktemp("good")
    for name, write in GOOD.items():
        write(folder / name)
        if name != "shot.jpg":
            np.testing.assert_array_equal(read(folder / name).image, NOISE)


@pytest.mark.filterwarnings("ignore:Image size")
@pytest.mark.usefixtures("imported")
@pytest.mark.parametrize("case", BAD)
def test_refused_in_one_sentence_with_little_memory(tmp_path: Path, case: str) -> None:
    name, write = BAD[case]
    path = tmp_path / name
    write(path)
    size = path.stat().st_size
    tracemalloc.start()
    with pytest.raises((FileFormatError, InputError)) as error:
        read(path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    message = str(error.value)
    assert message.startswith(str(path))
    assert "\n" not in message
    assert ". " not in message.removeprefix(str(path))
    assert peak <= 2 * size + 8_000_000
