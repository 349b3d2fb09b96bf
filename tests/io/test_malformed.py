"""Files that cannot be read: one sentence, soon, without asking for memory."""

import struct
import tracemalloc
import zlib
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import h5py
import imageio.v3 as iio
import numpy as np
import pytest
import tifffile
from PIL import Image
from scipy.io import savemat

from helpers.image_files import save_b16, save_mat73, save_pradformat, save_spe
from napari_shadowinv._system.safety import LIMIT_VARIABLE
from napari_shadowinv.errors import FileFormatError, InputError
from napari_shadowinv.io import read

Array = np.ndarray[Any, Any]
Write = Callable[[Path], object]
NOISE = np.random.default_rng(0).integers(1, 255, (64, 80)).astype(np.uint16)
NAN = np.full((64, 80), np.nan)
CUBE = np.ones((4, 5, 6), np.uint16)
HUGE = 100_000


def mat5(array: Array) -> Write:
    return partial(savemat, mdict={"shot": array})


def mat7(array: Array) -> Write:
    return partial(savemat, mdict={"shot": array}, do_compression=True)


def mat73(array: Array) -> Write:
    return partial(save_mat73, arrays={"shot": array})


def b16(array: Array, **header: int) -> Write:
    return partial(save_b16, pixels=array, **header)


def spe(array: Array, code: int = 3, footer: bytes = b"", **header: int) -> Write:
    footer = footer or (b"<SpeFormat/>" if "offset" in header else b"")
    return partial(save_spe, pixels=array, code=code, footer=footer, marked=False, **header)


def prad(array: Array | None, **attributes: object) -> Write:
    return partial(save_pradformat, image=array, **attributes)


def npy(array: Array) -> Write:
    return partial(np.save, arr=array)


def tiff(array: Array, **options: Any) -> Write:
    return partial(tifffile.imwrite, data=array, **{"photometric": "minisblack", **options})


def imagej(function: int) -> Write:
    text = f"ImageJ=1.54f\ncf={function}\nc0=1\nc1=2\nvunit=OD\n"
    return tiff(NOISE, description=text, metadata=None)


def retagged(**tags: int) -> Write:
    def write(path: Path) -> None:
        tiff(NOISE)(path)
        with tifffile.TiffFile(path, mode="r+") as file:
            for name, value in tags.items():
                file.pages.first.tags[name].overwrite(value)

    return write


def pages_of_similar_size(path: Path) -> None:
    with tifffile.TiffWriter(path) as file:
        file.write(NOISE, metadata=None)
        file.write(NOISE[:50], metadata=None)


def packed_tiff_without_bytes(path: Path) -> None:
    tiff(NOISE, compression="zlib")(path)
    with tifffile.TiffFile(path) as file:
        page = file.pages.first
        start, count = page.dataoffsets[0], page.databytecounts[0]
    patched(lambda path: None, (start, bytes(count)))(path)


def picture(path: Path) -> None:
    iio.imwrite(path, NOISE.astype(np.uint8))


def text(content: str | bytes) -> Write:
    raw = content if isinstance(content, bytes) else content.encode()
    return lambda path: path.write_bytes(raw)


def table(array: Array) -> Write:
    return partial(np.savetxt, X=array)


def cut(write: Write, share: float) -> Write:
    def write_part(path: Path) -> None:
        write(path)
        content = path.read_bytes()
        path.write_bytes(content[: int(share * len(content))])

    return write_part


def patched(write: Write, *changes: tuple[int, bytes]) -> Write:
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


def png(side: int, bits: int, colour: int, pixels: bytes) -> Write:
    def chunk(name: bytes, data: bytes) -> bytes:
        return (
            struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))
        )

    header = struct.pack(">IIBBBBB", side, side, bits, colour, 0, 0, 0)
    body = chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(pixels)) + chunk(b"IEND", b"")
    return lambda path: path.write_bytes(b"\x89PNG\r\n\x1a\n" + body)


def ink(path: Path) -> None:
    Image.fromarray(np.stack([NOISE.astype(np.uint8)] * 4, axis=-1), "CMYK").save(path)


GOOD: dict[str, Write] = {
    "five.mat": mat5(NOISE),
    "seven.mat": mat7(NOISE),
    "hdf.mat": mat73(NOISE),
    "shot.txt": table(NOISE),
    "shot.b16": b16(NOISE),
    "two.spe": spe(NOISE),
    "three.spe": spe(NOISE, offset=4100 + NOISE.nbytes),
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

STACKS: tuple[dict[str, Any], ...] = (
    {},
    {"imagej": True},
    {"metadata": None},
    {"truncate": True},
    {"imagej": True, "truncate": True},
)
# The name of a file, what writes it, and words of the sentence that refuses it.
BAD: dict[str, tuple[str, Write, str]] = {
    **{f"empty {name}": (name, text(b""), "empty") for name in GOOD},
    **{
        f"{share} of {name}": (name, cut(GOOD[name], share), "")
        for name in sorted(CUT)
        for share in (0.01, 0.5, 0.95)
    },
    "wrong magic mat": ("a.mat", patched(mat5(NOISE), (0, b"X")), ""),
    "wrong byte order mat": ("a.mat", patched(mat5(NOISE), (126, b"XX")), ""),
    "wrong element mat": ("a.mat", patched(mat5(NOISE), (152, b"\xff" * 40)), ""),
    "wrong packed bytes mat": ("a.mat", patched(mat7(NOISE), (138, b"\xff" * 40)), ""),
    "wrong values mat": ("a.mat", patched(mat7(NOISE), (3000, b"\xff" * 400)), ""),
    "wrong magic hdf mat": ("a.mat", patched(mat73(NOISE), (512, b"X")), ""),
    "wrong magic b16": ("a.b16", patched(b16(NOISE), (0, b"X")), ""),
    "wrong magic npy": ("a.npy", patched(npy(NOISE), (1, b"X")), ""),
    "wrong header b16": ("a.b16", b16(NOISE, start=-5), ""),
    "wrong type spe": ("a.spe", spe(NOISE, code=77), ""),
    "huge shape mat": ("a.mat", patched(mat5(NOISE), (160, struct.pack("<ii", HUGE, HUGE))), ""),
    "huge element mat": ("a.mat", patched(mat5(NOISE), (132, b"\xf0\xff\xff\xff")), ""),
    "huge values mat": ("a.mat", patched(mat5(NOISE), (180, b"\xf0\xff\xff\xff")), ""),
    "huge packed values mat": ("a.mat", packed_promise, ""),
    "huge hdf mat": ("a.mat", lambda path: unwritten(path, "shot"), ""),
    "huge pradformat": (
        "a.h5",
        lambda path: unwritten(path, "image", object_type="radiograph"),
        "",
    ),
    "huge b16": ("a.b16", b16(NOISE, height=2**31 - 1), ""),
    "huge spe": ("a.spe", spe(NOISE, width=65535, height=65535), ""),
    "huge footer spe": ("a.spe", spe(NOISE, offset=2**60), ""),
    "huge npy": ("a.npy", patched(npy(NOISE), (60, b"(900000, 800000), }")), ""),
    "huge tiff": ("a.tif", retagged(ImageLength=HUGE, ImageWidth=HUGE), ""),
    "huge png": ("a.png", png(12_000, 8, 0, bytes(100)), ""),
    "huge bmp": ("a.bmp", patched(picture, (18, struct.pack("<ii", 12_000, 12_000))), ""),
    "huge line": ("a.txt", text(b"7 " * 4_000_000), ""),
    "prose txt": ("a.txt", text("Dear colleague,\nthe film is in the post.\n"), ""),
    "prose mat": ("a.mat", text("1 2 3\n4 5 6\n"), ""),
    "prose spe": ("a.spe", text("Dear colleague,\n" * 1000), ""),
    "prose b16": ("a.b16", text("1 2 3\n4 5 6\n"), ""),
    "late ragged txt": ("a.txt", text("1 2 3\n" * 20_000 + "4 5\n"), ""),
    "late word csv": ("a.csv", text("1,2,3\n" * 20_000 + "4,5,six\n"), ""),
    "comments only": ("a.dat", text("# energy = 14.7\n" * 10), ""),
    "random txt": ("a.txt", text(RANDOM), ""),
    "random spe": ("a.spe", text(RANDOM), ""),
    "random mat": ("a.mat", text(RANDOM), ""),
    "gzip csv": ("a.csv", text(b"\x1f\x8b\x08" + RANDOM), ""),
    "matlab name only": ("a.mat", text(b"MATLAB 5.0 MAT-file"), ""),
    "matlab 7.3 name only": ("a.mat", text(b"MATLAB 7.3 MAT-file"), ""),
    "matlab, nothing inside": ("a.mat", cut(mat5(NOISE), 128 / (128 + 56 + NOISE.nbytes)), ""),
    "nan mat": ("a.mat", mat5(NAN), ""),
    "nan hdf mat": ("a.mat", mat73(NAN), ""),
    "nan txt": ("a.txt", table(NAN), ""),
    "nan spe": ("a.spe", spe(NAN, code=5), ""),
    "nan npy": ("a.npy", npy(NAN), ""),
    "nan tiff": ("a.tif", tiff(NAN.astype(np.float32)), ""),
    "nan pradformat": ("a.h5", prad(NAN), ""),
    "colour npy": ("a.npy", npy(CUBE[..., :3]), r"shape \(4, 5, 3\), as of pictures in colour"),
    "cut cube spe": ("a.spe", spe(CUBE, frames=9), ""),
    "cube pradformat": ("a.h5", prad(CUBE), ""),
    "zero mat": ("a.mat", mat5(ZERO), ""),
    "zero hdf mat": ("a.mat", mat73(ZERO), ""),
    "zero npy": ("a.npy", npy(ZERO), ""),
    "zero b16": ("a.b16", b16(NOISE, height=0), ""),
    "negative b16": ("a.b16", b16(NOISE, height=-64), ""),
    "zero spe": ("a.spe", spe(NOISE, height=0), ""),
    "no frames spe": ("a.spe", spe(NOISE, frames=0), ""),
    "zero pradformat": ("a.h5", prad(ZERO), ""),
    # Content of other kinds
    "settings": ("a.tif", text("energy = 14.7\n"), "a text file: expected .*TIFF"),
    "words": ("a.tif", text("größe µm"), "a text file"),
    "numbers": ("a.tif", text("1 2\n3 4\n"), "a text file"),
    "bytes": ("a.tif", text(bytes(range(128, 200))), "not in a recognised image format"),
    "unmarked spe": ("a.xyz", spe(NOISE), "not in a recognised image format"),
    "Andor": ("a.asc", text("Andor Technology Multi-Channel File\n65538 1\n"), "no table of numb"),
    "edf": ("a.edf", text("{\nHeaderID = EH:000001:000000:000000 ;\nDim_1 = 9 ;\n"), "a text file"),
    "mrc": ("a.mrc", text(bytes(208) + b"MAP DD\0\0"), "not in a recognised image format"),
    "nef": ("a.nef", text(b"MM\0\x2a\0\0\0\x08"), "raw file of a photographic camera"),
    "cr2": ("a.CR2", text(b"II\x2a\0\x10\0\0\0CR\2\0"), "raw file of a photographic camera"),
    # Text
    "ragged": ("a.csv", text("# a\n1 2 3\n\n4 5\n"), "number of columns changed from 3 to 2"),
    "a word": ("a.csv", text("1 2\n3 four\n"), "could not convert string 'four'"),
    "last comma": ("a.csv", text("1,2\n3,\n"), "number of columns changed from 2 to 1"),
    "first comma": ("a.csv", text("1,2\n,3\n"), "could not convert string ''"),
    "commas": ("a.csv", text("1,5 2,5\n3,5 4,5\n"), "string '5 2' .*: .* with a decimal point"),
    "names": ("a.csv", text("x,y,z\n1,2,3\n"), "could not convert string 'x'"),
    "one row": ("a.csv", text("1 2 3\n"), "holds 1 row of numbers: expected at least two"),
    "no row": ("a.csv", text("# nothing\n\n"), "holds 0 rows of numbers"),
    "PRadReader": ("a.txt", text("# flux2D (1, 2)\n# mask (1, 2)\n1 2\n1 2\n"), "PRadReader's"),
    # Values that are no measure of light, or of which a program says what it does not hold
    "objects": ("a.npy", lambda path: np.save(path, [{}], allow_pickle=True), "Python objects"),
    "complex npy": ("a.npy", npy(NOISE * 1j), "complex128"),
    "complex mat": ("a.mat", mat5(NOISE * 1j), r"64×80 double\) as complex128 values"),
    "complex tiff": ("a.tif", tiff(NOISE.astype(np.complex64)), "COMPLEXIEEEFP"),
    "ink": ("a.jpg", ink, "kind CMYK"),
    "16-bit colours": ("a.png", png(4, 16, 2, bytes(100)), "16 bits per channel"),
    "colour b16": ("a.b16", b16(NOISE, colour=1), "colour camera"),
    "regions": ("a.spe", spe(NOISE, footer=b"<SpeFormat/>", height=32), "several regions"),
    "codec": (
        "a.tif",
        retagged(Compression=60123),
        "60123.* or in a form that needs another reader",
    ),
    **{
        f"photometric {name}": (
            "a.tif",
            retagged(PhotometricInterpretation=number),
            f"photometric kind {name}",
        )
        for name, number in {"60124": 60124, "CFA": 32803, "LINEAR_RAW": 34892, "CIELAB": 8}.items()
    },
    **{
        f"white {kind}": ("a.tif", tiff(NOISE.astype(kind), photometric="miniswhite"), "0 is white")
        for kind in ("i2", "f4")
    },
    **{
        f"ImageJ {number}": ("a.tif", imagej(number), f"calibration function {number} .*'OD'")
        for number in (4, 8, 21, 22)
    },
    # Parts that are missing or do not fit together
    "packed zeros": ("a.tif", packed_tiff_without_bytes, "damaged"),
    "two sizes": (
        "a.tif",
        pages_of_similar_size,
        "64×80 and of 50×80 pixels: expected shots of one",
    ),
    **{
        f"{share} of {options}": (
            "a.tif",
            cut(tiff(np.stack([NOISE] * 3), **options), share),
            "truncated|incomplete",
        )
        for options in STACKS
        for share in (1 / 3, 0.6, 0.99)
    },
    **{
        f"all of {options}": ("a.tif", tiff(np.stack([NOISE] * 3), **options), "lists 3 frames")
        for options in STACKS[3:]
    },
    "no image prad": ("a.h5", prad(None), "with no image"),
    "oblong prad": (
        "a.h5",
        prad(NOISE, pixel_width=3.1e-4, pixel_width_ax2=5e-4),
        r"0\.00031 m by 0\.0005 m: expected square",
    ),
    "no energy prad": (
        "a.h5",
        prad(
            NOISE, pixel_width=1.0, source_object_dist=1.0, object_image_dist=1.0, spec_energy=0.0
        ),
        "'energy' is 0",
    ),
}


@pytest.fixture(scope="module")
def imported(tmp_path_factory: pytest.TempPathFactory) -> None:
    """Read each good file, so that imports do not count as memory."""
    folder = tmp_path_factory.mktemp("good")
    tiff(np.stack([NOISE] * 2))(folder / "stack.tif")
    read(folder / "stack.tif")
    for name, write in GOOD.items():
        write(folder / name)
        if name != "shot.jpg":
            np.testing.assert_array_equal(read(folder / name).image, NOISE)


@pytest.mark.parametrize("name", GOOD)
def test_oversized_content_is_refused_with_a_way_to_allow_it(
    tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / name
    GOOD[name](path)
    monkeypatch.setenv(LIMIT_VARIABLE, "1e-5")  # 10 kB, and the image takes 41 in memory
    # Of text, the most numbers that its bytes can hold
    gigabytes = 4e-9 * path.stat().st_size if name == "shot.txt" else 8e-9 * NOISE.size
    with pytest.raises(FileFormatError, match=f"expands to {gigabytes:.3g} GB .* {LIMIT_VARIABLE}"):
        read(path)
    monkeypatch.setenv(LIMIT_VARIABLE, "1")
    assert read(path).image.shape == NOISE.shape


@pytest.mark.filterwarnings("ignore:Image size")
@pytest.mark.usefixtures("imported")
@pytest.mark.parametrize("case", BAD)
def test_refused_in_one_sentence_with_little_memory(tmp_path: Path, case: str) -> None:
    name, write, words = BAD[case]
    path = tmp_path / name
    write(path)
    size = path.stat().st_size
    tracemalloc.start()
    with pytest.raises((FileFormatError, InputError), match=words or None) as error:
        read(path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    message = str(error.value)
    assert message.startswith(str(path))
    assert "\n" not in message
    assert ". " not in message.removeprefix(str(path))
    assert peak <= 2 * size + 8_000_000
