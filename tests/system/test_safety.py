"""No file blocks a reader, fills the memory or ends it with a traceback."""

from __future__ import annotations

import os
import socket
import struct
import sys
from collections.abc import Callable
from pathlib import Path

import h5py
import pytest
import tifffile

from napari_shadowinv._system.machine import physical_memory
from napari_shadowinv._system.safety import LIMIT_VARIABLE, as_file_errors, size_limit
from napari_shadowinv.errors import FileFormatError, InputError, InversionCancelled
from napari_shadowinv.film import Calibration
from napari_shadowinv.io import read, read_toml


@pytest.mark.parametrize("reader", [read, read_toml, Calibration.from_csv])
@pytest.mark.parametrize("name", ["shot.tif", "shot.npy", "shot.h5", "shot.txt"])
@pytest.mark.skipif(sys.platform != "linux", reason="needs pipes and devices")
def test_special_files_are_refused_unopened(
    tmp_path: Path, name: str, reader: Callable[[Path], object], opened_paths: list[str]
) -> None:
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "device").symlink_to("/dev/zero")
    # The name of a socket must be short.
    before = Path.cwd()
    os.chdir(tmp_path)
    with socket.socket(socket.AF_UNIX) as end:
        end.bind("socket")
    os.chdir(before)
    for kind in ("pipe", "socket", "device"):
        path = tmp_path / f"{kind}-{name}"
        path.symlink_to(tmp_path / kind)
        with pytest.raises(FileFormatError, match=f"{name} is a pipe, socket or device: expected"):
            reader(path)
    assert not [path for path in opened_paths if path.startswith(str(tmp_path))]


def test_errors_of_readers_become_one_error_with_a_reason(tmp_path: Path) -> None:
    @as_file_errors
    def broken(path: Path, error: BaseException) -> None:
        raise error

    reasons = (
        struct.error("unpack requires a buffer of 4 bytes"),
        EOFError("end"),
        tifffile.TiffFileError("corrupted tag list"),
        OSError("Unable to open file (truncated file: eof = 96)"),
        SyntaxError("broken PNG file"),
        ImportError("could not import name 'jpegxl_decode' from 'imagecodecs'"),
        ModuleNotFoundError("No module named 'pandas'", name="pandas"),
        KeyError("x"),
        RecursionError("deep"),
        NotImplementedError("chroma subsampling not supported"),
    )
    for reason in reasons:
        with pytest.raises(FileFormatError, match=r"a\.tif could not be read \(.+\): ") as refused:
            broken(tmp_path / "a.tif", reason)
        assert refused.value.__cause__ is reason
    with pytest.raises(FileFormatError, match="more memory than is available"):
        broken("a.tif", MemoryError())
    with pytest.raises(FileFormatError, match="Permission denied"):
        broken("a.tif", PermissionError(13, "Permission denied"))
    for clear_error in (InputError("mine"), FileFormatError("mine"), InversionCancelled()):
        with pytest.raises(type(clear_error)) as refused:
            broken("a.tif", clear_error)
        assert refused.value is clear_error
    with pytest.raises(KeyboardInterrupt):
        broken("a.tif", KeyboardInterrupt())


def test_a_chunk_larger_than_its_array_counts(tmp_path: Path) -> None:
    path = tmp_path / "shot.h5"
    with h5py.File(path, "w") as file:
        file.create_dataset(
            "image", (4, 4), maxshape=(None, None), chunks=(60_000, 60_000), dtype="u1"
        )
        file.attrs["object_type"] = "radiograph"
    with pytest.raises(FileFormatError, match=LIMIT_VARIABLE):
        read(path)


def test_the_limit_is_a_share_of_the_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    memory = physical_memory()
    assert memory is None or size_limit() == memory // 8
    monkeypatch.setenv(LIMIT_VARIABLE, "2.5")
    assert size_limit() == 2_500_000_000
    for nonsense in ("much", "0", "-1", "nan", "inf"):
        monkeypatch.setenv(LIMIT_VARIABLE, nonsense)
        with pytest.raises(InputError, match=f"{LIMIT_VARIABLE} is {nonsense!r}"):
            size_limit()


@pytest.mark.parametrize("reader", [read_toml, Calibration.from_csv])
def test_small_files_of_text_are_small(tmp_path: Path, reader: Callable[[Path], object]) -> None:
    path = tmp_path / "setup.toml"
    path.write_bytes(b"# x\n" * 250_001)
    with pytest.raises(FileFormatError, match="larger than 1 MB"):
        reader(path)
    path.write_bytes(b"\xff\xfe")
    with pytest.raises(FileFormatError, match="is not a text file"):
        reader(path)
