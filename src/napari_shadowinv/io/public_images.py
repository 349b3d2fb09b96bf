"""Published images and tables, downloaded on request, verified by checksum and cached.

- any file of the list `public_files.csv`: `fetch_public_file`
- the plume of an alcohol burner with its reference: `fetch_burner`
"""

from __future__ import annotations

import csv
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path


@dataclass(frozen=True)
class PublicFile:
    """A file in a public repository, at a fixed commit, whose licence allows its use."""

    name: str  # path in the cache, such as rcf/HDV2.tif
    size: int  # in bytes
    sha256: str  # checksum, hexadecimal
    licence: str  # of the repository, as an SPDX identifier
    address: str  # URL


_LIST = files(__package__).joinpath("public_files.csv").read_text(encoding="utf-8")
PUBLIC_FILES = {
    name: PublicFile(name, int(size), *texts)
    for name, size, *texts in list(csv.reader(_LIST.splitlines()))[1:]
}
"""By name. The burner's first file is the reference beam, the others are frames."""


def cache_folder() -> Path:
    """Return the folder of the user in which downloaded files are kept."""
    import pooch

    return Path(pooch.os_cache("napari-shadowinv"))


def fetch_public_file(name: str, *, cache: Path | None = None, timeout: float = 10.0) -> Path:
    """Download a public file, unless it is in the cache already.

    Parameters
    ----------
    name : str
        A name of `PUBLIC_FILES`.
    cache : Path, optional
        Folder in which the files are kept. Default: the user's cache folder.

    Returns
    -------
    Path
        The file in the cache.

    Raises
    ------
    OSError
        If the file cannot be downloaded, or its checksum differs; nothing is kept then.
    """
    import pooch

    file = PUBLIC_FILES[name]
    path = (cache or cache_folder()) / name
    pooch.get_logger().setLevel("ERROR")
    try:
        pooch.retrieve(
            file.address,
            f"sha256:{file.sha256}",
            fname=path.name,
            path=path.parent,
            downloader=pooch.HTTPDownloader(timeout=timeout),
        )
    except (OSError, ValueError) as error:
        reason = "no connection"
        if isinstance(error, ValueError):
            reason = "its checksum differs"
        elif (response := getattr(error, "response", None)) is not None:
            reason = f"the server answered {response.status_code}"
        raise OSError(
            f"{path.name} could not be downloaded ({reason}): connect to the network, or save "
            f"{file.address} in {path.parent}"
        ) from error
    return path


def fetch_burner(frames: int = 1, *, cache: Path | None = None) -> list[Path]:
    """Download the reference beam and the first frames of a burner's plume.

    The data belong to doi:10.1016/j.expthermflusci.2025.111562.

    Parameters
    ----------
    frames : int
        Number of frames, 1 to 11.
    cache : Path, optional
        Folder in which the files are kept. Default: the user's cache folder.

    Returns
    -------
    list of Path
        The reference beam and the frames in order of time, 8-bit BMP of 1152×928 px.

    Raises
    ------
    OSError
        If a file cannot be downloaded, or its checksum differs.
    """
    names = [name for name in PUBLIC_FILES if name.startswith("burner/")]
    return [fetch_public_file(name, cache=cache) for name in names[: 1 + frames]]
