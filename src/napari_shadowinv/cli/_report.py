"""What `shadowinv info --report` prints for a bug report: versions and the machine.

Versions come from the metadata of the installed packages, so neither napari nor Qt is loaded and
the report works where one of them fails to start.
"""

from __future__ import annotations

import os
import platform
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from napari_shadowinv import __version__
from napari_shadowinv._system.machine import physical_memory

PACKAGES = (
    "numpy",
    "scipy",
    "numba",
    "llvmlite",
    "dask",
    "distributed",
    "xarray",
    "zarr",
    "h5py",
    "h5netcdf",
    "scikit-image",
    "matplotlib",
    "pydantic",
    "typer",
    "napari",
    "npe2",
    "qtpy",
)
QT_BINDINGS = ("PyQt6", "PySide6", "PySide6_Essentials", "PyQt5", "PySide2")


def report_text() -> str:
    """Versions, platform, cores, memory and the folder of compiled code, one per line."""
    memory = physical_memory()
    rows = [
        ("napari-shadowinv", __version__),
        ("python", f"{platform.python_version()} ({platform.python_implementation()})"),
        *[(name, _version(name) or "not installed") for name in PACKAGES],
        ("Qt", ", ".join(_qt_bindings()) or "not installed"),
        ("platform", f"{platform.platform()}, {platform.machine()}"),
        ("cores", _cores()),
        ("memory", "not known" if memory is None else f"{memory / 2**30:.1f} GiB"),
        ("compiled code", _compiled_code()),
    ]
    width = max(len(name) for name, _ in rows)
    return "\n".join(f"{name:{width}}  {value}" for name, value in rows)


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None


def _qt_bindings() -> list[str]:
    found = ((name, _version(name)) for name in QT_BINDINGS)
    return [f"{name} {number}" for name, number in found if number]


def _cores() -> str:
    count = os.cpu_count()
    try:
        usable = len(os.sched_getaffinity(0))
    except AttributeError:  # not on macOS or Windows
        usable = count or 1
    return f"{count or 'not known'}, {usable} usable"


def _compiled_code() -> str:
    """The folder with the machine code; the home folder is written ~ to hide the user's name."""
    try:
        from napari_shadowinv.inversion.compilation import code_folder, is_compiled

        folder = code_folder()
        if folder is None:
            return "not kept: compiled anew in each process"
        state = "compiled" if is_compiled() else "not compiled yet"
    except Exception as error:  # a broken numba must not keep the rest from being reported
        return f"not known: {type(error).__name__}: {' '.join(str(error).split())}"
    home = Path.home()
    shown = Path("~") / folder.relative_to(home) if folder.is_relative_to(home) else folder
    return f"{shown} ({state})"
