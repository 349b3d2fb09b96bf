"""Published shadowgrams, downloaded on request, verified by checksum and cached.

- the plume of an alcohol burner with its reference, ten frames and the beam: `fetch_burner`
"""

from __future__ import annotations

from pathlib import Path

# Data of doi:10.1016/j.expthermflusci.2025.111562, MIT licence.
BURNER_URL = (
    "https://raw.githubusercontent.com/pyrimidine/"
    "Physics-informed-Shadowgraph-Density-Field-Reconstruction/"
    "25b5ba1513a24cd39ac1ab456eebec7766385e82/data/"
)
_REGISTRY = """
Image_00000.bmp ecf09c0f133b4493f930cbe1e80a1ca5c8ed4c30a161dc0e364c2f67b07fe0a1
Image_20241017221829662.bmp 235e1d888a18e311fe2e0e95620d7f5313398816bf44304e956dd7259690401b
Image_20241017221829757.bmp 3d79feee43d93557a98a381942765e33f86bac7dc3e463abf5fb4dd545a73b61
Image_20241017221829851.bmp d1e0508ec9d13bb9be5b3d6d8d43535ae62d4096fe77aac82ebc500a8d9079fa
Image_20241017221829959.bmp 9d616896d0b51d5c32ca3886f9875b85c8ff1625712bff48db644f02950995f1
Image_20241017221830054.bmp 61b0ce051b868c3b0ee68fd70fd8b8e1d12f5c6edbcac1c5370bcda6c25d74ca
Image_20241017221830162.bmp 5f96e2be4129ba763ad5f75381e79f38c9c94e3eeddd31f02fe99f008d677266
Image_20241017221830257.bmp 027d0e4cbff29512ebf3a517e208a4fcf31efb2e2537a5eec70f7ee4031e61da
Image_20241017221830348.bmp 93c09a8cf704541ef4e2e1bc11107b86211639a95a4747a9f694ac1107252890
Image_20241017221830459.bmp c942ae36f421e1c19e194627f11f981f72822c3649762a4a9d9f59476547f717
Image_20241017221830553.bmp c125a1f3b632b64455027668107651a8d37135d7920eda3ba2890320a8a82379
Image_20241017221830650.bmp ae7f5ca28c0d39c95ab19554c9c54f01baed0919a88bf1a1215f75e61b5eb96b
"""
BURNER_FILES: dict[str, str] = dict(line.split() for line in _REGISTRY.strip().splitlines())
"""SHA-256 by file name; the first is the reference beam, the others are frames."""

_TIMEOUT_S = 10.0


def fetch_burner(
    frames: int = 1, *, url: str = BURNER_URL, cache: Path | None = None
) -> list[Path]:
    """Download the reference beam and the first frames of a burner's plume.

    Files that are in the cache already are not downloaded again.

    Parameters
    ----------
    frames : int
        Number of frames, 1 to 11.
    url : str, optional
        Address of the folder that holds the files.
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
    import pooch

    folder = pooch.os_cache("napari-shadowinv") / "burner" if cache is None else cache
    pooch.get_logger().setLevel("ERROR")
    paths = []
    for name in list(BURNER_FILES)[: 1 + frames]:
        try:
            path = pooch.retrieve(
                url + name,
                f"sha256:{BURNER_FILES[name]}",
                fname=name,
                path=folder,
                downloader=pooch.HTTPDownloader(timeout=_TIMEOUT_S),
            )
        except (OSError, ValueError) as error:
            reason = "its checksum differs" if isinstance(error, ValueError) else "no connection"
            raise OSError(
                f"{url}{name} could not be downloaded ({reason}): connect to the network, or put "
                f"the file into {folder}"
            ) from error
        paths.append(Path(path))
    return paths
