"""Published images and tables, which pooch downloads on request, verifies and keeps.

- any file of the list `public_files.csv`: `fetch_public_file`
- the plume of an alcohol burner with its reference: `fetch_burner`
"""

from __future__ import annotations

import csv
from importlib.resources import files
from pathlib import Path

from napari_shadowinv.errors import InputError

_LIST = files(__package__).joinpath("public_files.csv").read_text(encoding="utf-8")
PUBLIC_FILES = {row["name"]: row for row in csv.DictReader(_LIST.splitlines())}
"""By name, with size, sha256, licence (SPDX) and address; a name is a path in the cache, such as
rcf/HDV2.tif. The burner's first file is the reference beam, the others are frames."""


def fetch_public_file(name: str, *, cache: Path | None = None, timeout: float = 10.0) -> Path:
    """Download one of the `PUBLIC_FILES`, unless the cache has it; return its path there.

    The cache is the user's by default. An `OSError` says why a file cannot be downloaded, or that
    its checksum differs; nothing is kept then. An `InputError` says that the package pooch is
    missing.
    """
    try:
        import pooch
    except ModuleNotFoundError:
        raise InputError(
            f"{name} is downloaded by the package pooch, which is missing: install it with pip "
            "install 'napari-shadowinv[samples]'"
        ) from None
    address, checksum = PUBLIC_FILES[name]["address"], f"sha256:{PUBLIC_FILES[name]['sha256']}"
    path = (cache or Path(pooch.os_cache("napari-shadowinv"))) / name
    pooch.get_logger().setLevel("ERROR")
    downloader = pooch.HTTPDownloader(timeout=timeout)
    try:
        pooch.retrieve(address, checksum, path.name, path.parent, downloader=downloader)
    except (OSError, ValueError) as error:
        reason = "its checksum differs" if isinstance(error, ValueError) else "no connection"
        if (response := getattr(error, "response", None)) is not None:
            reason = f"the server answered {response.status_code}"
        raise OSError(
            f"{path.name} could not be downloaded ({reason}): connect to the network, or save "
            f"{address} in {path.parent}"
        ) from error
    return path


def fetch_burner(frames: int = 1, *, cache: Path | None = None) -> list[Path]:
    """Download the reference beam and the first frames, 1 to 11, of a burner's plume.

    They are 8-bit BMP of 1152×928 px in the order of time, of
    doi:10.1016/j.expthermflusci.2025.111562. Cache and errors as of `fetch_public_file`.
    """
    names = [name for name in PUBLIC_FILES if name.startswith("burner/")]
    return [fetch_public_file(name, cache=cache) for name in names[: 1 + frames]]
