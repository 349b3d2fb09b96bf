"""The registry of formats: one place for their names, endings, marks and functions."""

import ast
import re
from collections.abc import Iterator
from inspect import signature
from pathlib import Path

import numpy as np
import pytest
import tifffile
from typer.testing import CliRunner

import napari_shadowinv
from napari_shadowinv.cli import app
from napari_shadowinv.errors import FileFormatError
from napari_shadowinv.io import formats, read, read_shot
from napari_shadowinv.io.formats import FORMATS, Format, format_of, function

SOURCE = Path(napari_shadowinv.__file__).parent
SUFFIXES = {suffix for each in FORMATS for suffix in each.suffixes}


def strings() -> Iterator[tuple[str, str]]:
    for path in SOURCE.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Constant) and isinstance(node.value, str):
                yield path.relative_to(SOURCE).as_posix(), node.value


def test_an_ending_is_written_in_the_registry_alone() -> None:
    endings = "|".join(map(re.escape, sorted(SUFFIXES, reverse=True)))
    # Also as a pattern, or as the end of a name that is put together.
    spelled = re.compile(rf"(?:\*|_\w+)?({endings})")
    places: dict[str, set[str]] = {}
    for place, text in strings():
        if match := spelled.fullmatch(text):
            places.setdefault(match[1], set()).add(place)
    assert places == {suffix: {"io/formats.py"} for suffix in SUFFIXES}


def test_a_name_or_an_ending_means_one_format_and_its_marks_are_in_the_head() -> None:
    names = [each.name for each in FORMATS]
    assert len(set(names)) == len(names)
    for role in ("reader", "image_writer", "result_writer"):
        endings = [end for each in FORMATS if getattr(each, role) for end in each.suffixes]
        assert len(set(endings)) == len(endings), role
    ends = [at + len(mark) for each in FORMATS for at, mark in each.marks]
    assert max(ends) <= signature(format_of).parameters["head_bytes"].default


@pytest.mark.parametrize("each", FORMATS, ids=lambda each: each.name)
def test_its_functions_exist(each: Format) -> None:
    roles = (each.test, each.reader, each.named_reader, each.counter, each.lister)
    roles += (each.image_writer, each.result_writer)
    assert all(callable(function(name)) for name in roles if name)
    assert bool(each.reader or each.named_reader) == bool(each.title)  # what can be read is listed
    assert all(suffix == suffix.lower() and suffix[0] == "." for suffix in each.suffixes)


def test_messages_and_help_list_every_format(tmp_path: Path) -> None:
    (tmp_path / "empty").touch()
    with pytest.raises(FileFormatError) as error:
        format_of(tmp_path / "empty")
    listed = [each for each in FORMATS if each.title]
    assert all(each.title in str(error.value) for each in listed)
    output = CliRunner().invoke(app, ["invert", "--help"], env={"COLUMNS": "300"}).output
    words = " ".join(output.replace("│", " ").split())  # in a table of any width
    assert all(each.title in words for each in listed if "image" in each.holds)


def test_content_decides_before_the_ending(tmp_path: Path) -> None:
    (tmp_path / "zarr.json").write_text("{}")
    with pytest.raises(FileFormatError, match="is a Zarr store of another program"):
        read(tmp_path)
    for suffix in (".raw", ".img"):
        tifffile.imwrite(tmp_path / f"shot{suffix}", np.ones((4, 5), np.uint8))
        assert read_shot(tmp_path / f"shot{suffix}").image.shape == (4, 5)


def test_a_format_is_added_by_its_reader_and_its_entry(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def read_new(path: Path) -> tuple[np.ndarray, dict[str, int]]:
        return np.frombuffer(path.read_bytes()[4:], "<u2").reshape(2, 3), {"bits": 12}

    new = Format("new", (".new",), "New .new", ((0, b"NEW!"),), reader="images:read_new")
    monkeypatch.setattr("napari_shadowinv.io.images.read_new", read_new, raising=False)
    monkeypatch.setattr(formats, "FORMATS", (new, *FORMATS))
    path = tmp_path / "shot.tif"  # the content counts
    path.write_bytes(b"NEW!" + np.arange(6, dtype="<u2").tobytes())
    shot = read_shot(path)
    np.testing.assert_array_equal(shot.image, [[0, 1, 2], [3, 4, 5]])
    assert (shot.metadata["kind"], shot.metadata["bits"]) == ("new", 12)
