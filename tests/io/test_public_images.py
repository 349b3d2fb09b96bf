"""Files that are downloaded: kept, checked, and one sentence where there is no network."""

from __future__ import annotations

import hashlib
import threading
from collections.abc import Iterator
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest

from helpers import public_data
from helpers.public_data import SHARED_DATA
from napari_shadowinv.io import public_images
from napari_shadowinv.io.public_images import PUBLIC_FILES, fetch_burner

NAMES = [name for name in PUBLIC_FILES if name.startswith("burner/")][:3]
CONTENT = {name: f"frame {name}".encode() for name in NAMES}


class CountingHandler(SimpleHTTPRequestHandler):
    requests: list[str] = []  # noqa: RUF012

    def log_message(self, format: str, *arguments: object) -> None:
        self.requests.append(self.path)


@pytest.fixture
def server(tmp_path: Path) -> Iterator[tuple[str, Path]]:
    """Address and folder of a server of files."""
    folder = tmp_path / "public"
    folder.mkdir()
    CountingHandler.requests.clear()
    handler = partial(CountingHandler, directory=str(folder))
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as http:
        thread = threading.Thread(target=http.serve_forever)
        thread.start()
        yield f"http://127.0.0.1:{http.server_port}/", folder
        http.shutdown()
        thread.join()


@pytest.fixture
def published(server: tuple[str, Path], monkeypatch: pytest.MonkeyPatch) -> Path:
    """Folder of a server that has the first files of the burner with other content."""
    address, folder = server
    for name, content in CONTENT.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)
        sha256 = hashlib.sha256(content).hexdigest()
        file = PUBLIC_FILES[name] | {"sha256": sha256, "address": address + name}
        monkeypatch.setitem(public_images.PUBLIC_FILES, name, file)
    return folder


def test_a_file_is_downloaded_once(published: Path, tmp_path: Path) -> None:
    for _ in range(2):
        paths = fetch_burner(2, cache=tmp_path / "cache")
        assert [path.read_bytes() for path in paths] == list(CONTENT.values())
    assert CountingHandler.requests == [f"/{name}" for name in CONTENT]


@pytest.mark.parametrize("problem", ["changed", "missing", "no network"])
def test_one_sentence_says_what_is_missing(
    published: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, problem: str
) -> None:
    name = NAMES[0]
    if problem == "changed":
        (published / name).write_bytes(b"another frame")
    elif problem == "missing":
        (published / name).unlink()
    else:
        file = PUBLIC_FILES[name] | {"address": f"http://127.0.0.1:9/{name}"}
        monkeypatch.setitem(public_images.PUBLIC_FILES, name, file)
    with pytest.raises(OSError, match="could not be downloaded") as error:
        fetch_burner(cache=tmp_path / "cache")
    assert "\n" not in str(error.value)
    assert Path(name).name in str(error.value)
    assert not [path for path in (tmp_path / "cache").rglob("*") if path.is_file()]


def test_every_public_file_can_be_used() -> None:
    for name, file in PUBLIC_FILES.items():
        assert file["licence"] in {"MIT", "BSD-3-Clause"}
        repository = "https://raw.githubusercontent.com/"
        assert file["address"].startswith(repository)
        assert file["address"].endswith(name.rsplit("/", 1)[1])
        assert len(file["address"].removeprefix(repository).split("/")[2]) == 40, "a fixed commit"


def test_the_files_of_tests_are_those_published() -> None:
    for folder in (SHARED_DATA, public_data.CACHE):
        for name, file in PUBLIC_FILES.items():
            if (folder / name).is_file():
                content = (folder / name).read_bytes()
                assert len(content) == int(file["size"]), name
                assert hashlib.sha256(content).hexdigest() == file["sha256"], name
