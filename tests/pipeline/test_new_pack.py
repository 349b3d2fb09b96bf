"""Facts about a pack file that is drafted from a folder of scans."""

from __future__ import annotations

from pathlib import Path

import pytest

from helpers.command_line import done
from napari_shadowinv.errors import FileFormatError, InputError
from napari_shadowinv.pipeline import read_pack
from napari_shadowinv.pipeline.film_files import draft_pack, write_new_pack

TABLE = "Dose,Red,Green,Blue\n1,30000,31000,29000\n10,20000,24000,26000\n100,8000,12000,20000\n"


@pytest.fixture
def scans(tmp_path: Path) -> Path:
    for name in ("film_10.tif", "film_2.tif", "EBT3_film_11.tif", "HDV2.tif"):
        (tmp_path / name).touch()
    (tmp_path / "HDV2_table.csv").write_text(TABLE)
    (tmp_path / "notes.csv").write_text("a,b\n1,2\n")
    (tmp_path / "notes.txt").touch()
    return tmp_path


def test_draft_has_the_scans_in_order(scans: Path) -> None:
    entries = draft_pack(scans)
    assert [(layer["film"], layer["file"]) for layer in entries["layers"]] == [
        *(("EBT3", "EBT3_film_11.tif"), ("HDV2", "film_2.tif"), ("HDV2", "film_10.tif"))
    ]
    assert entries["films"] == {"HDV2": {"calibration": "HDV2_table.csv", "unexposed": "HDV2.tif"}}


def test_draft_is_read_as_a_pack(scans: Path) -> None:
    entries = draft_pack(scans)
    entries["layers"][1]["filters"] = ["13 um Al", "25 um Fe"]
    pack = read_pack(write_new_pack(scans, entries))
    assert [slab.material for slab in pack.layers[1].filters] == ["Al", "Fe"]
    assert pack.films["HDV2"].calibration == scans / "HDV2_table.csv"
    with pytest.raises(FileFormatError, match=r"pack.toml exists"):
        write_new_pack(scans, entries)


def test_other_folders_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="has no scans of films"):
        draft_pack(tmp_path)
    with pytest.raises(FileFormatError, match="cannot be read as a folder"):
        draft_pack(tmp_path / "missing")


def test_film_command_writes_a_new_pack(scans: Path) -> None:
    printed = done("film", "--new", scans)
    for words in ("calibration of EBT3", "filters: those in front", "seen from", "pack.toml"):
        assert words in printed
    assert len(read_pack(scans / "pack.toml").layers) == 3
    assert "exists" in done("film", "--new", scans, code=2)
