"""Images that are downloaded: kept, checked, and one sentence where there is no network."""

from __future__ import annotations

import hashlib
import threading
from collections.abc import Iterator
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest

from napari_shadowinv.io import public_images
from napari_shadowinv.io.public_images import BURNER_FILES, fetch_burner

CONTENT = {name: f"frame {name}".encode() for name in list(BURNER_FILES)[:3]}


class CountingHandler(SimpleHTTPRequestHandler):
    requests: list[str] = []  # noqa: RUF012

    def log_message(self, format: str, *arguments: object) -> None:
        self.requests.append(self.path)


@pytest.fixture
def server(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[str, Path]]:
    folder = tmp_path / "public"
    folder.mkdir()
    for name, content in CONTENT.items():
        (folder / name).write_bytes(content)
    checksums = {name: hashlib.sha256(content).hexdigest() for name, content in CONTENT.items()}
    monkeypatch.setattr(public_images, "BURNER_FILES", checksums)
    CountingHandler.requests.clear()
    handler = partial(CountingHandler, directory=str(folder))
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as http:
        thread = threading.Thread(target=http.serve_forever)
        thread.start()
        yield f"http://127.0.0.1:{http.server_port}/", folder
        http.shutdown()
        thread.join()


def test_a_file_is_downloaded_once(server: tuple[str, Path], tmp_path: Path) -> None:
    for _ in range(2):
        paths = fetch_burner(2, url=server[0], cache=tmp_path / "cache")
        assert {path.name: path.read_bytes() for path in paths} == CONTENT
    assert CountingHandler.requests == [f"/{name}" for name in CONTENT]


def test_a_changed_file_is_refused(server: tuple[str, Path], tmp_path: Path) -> None:
    name = next(iter(CONTENT))
    (server[1] / name).write_bytes(b"another frame")
    with pytest.raises(OSError, match=rf"{name} could not be downloaded \(its checksum differs\)"):
        fetch_burner(url=server[0], cache=tmp_path / "cache")
    assert not [path for path in (tmp_path / "cache").iterdir() if path.stat().st_size]


def test_without_a_network_one_sentence_says_so(server: tuple[str, Path], tmp_path: Path) -> None:
    with pytest.raises(OSError, match=r"\(no connection\): connect to the network") as error:
        fetch_burner(url="http://127.0.0.1:9/", cache=tmp_path / "cache")
    assert "\n" not in str(error.value)


def test_the_cached_frames_are_those_published(burner: list[Path]) -> None:
    for path in burner:
        assert hashlib.sha256(path.read_bytes()).hexdigest() == BURNER_FILES[path.name]
