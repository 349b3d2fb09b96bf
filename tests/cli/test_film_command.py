"""The command `shadowinv film`: its files, and its errors."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from helpers.command_line import content, flat, shadowinv
from napari_shadowinv import read, write
from napari_shadowinv.cli import _terminal
from napari_shadowinv.film import read_corners
from simulated_pack import Truth, simulate


@pytest.fixture(scope="module")
def truth(tmp_path_factory: pytest.TempPathFactory) -> Truth:
    folder = tmp_path_factory.mktemp("pack")
    return simulate(folder, layers=3, shape=(90, 120), seed=2, b_peak=2.0, e_peak=0.0)


def test_a_pack_from_scans_to_files_for_a_fit(
    truth: Truth, folder: Path, refused: Callable[..., None]
) -> None:
    options = ["--layers", "layers", "--save-corners", "corners.csv"]
    ended = shadowinv("film", truth.pack, *options)
    assert ended.exit_code == 0, ended.output
    names = {"pack.shadowinv", "pack.png", "corners.csv"}
    assert content(folder).keys() == names
    assert "Film pack" in flat(ended.output)
    dataset = read("pack.shadowinv")
    for energy in dataset["energy"].values:
        assert f"{energy:.3g} MeV" in ended.output
    corners = read_corners("corners.csv")
    np.testing.assert_allclose(list(corners.values()), dataset["corners"], atol=0.006)
    listed = (folder / "layers" / "layers.csv").read_text().splitlines()
    assert len(listed) == 4
    inverted = shadowinv("batch", "layers/layers.csv", "--out", "all.shadowinv.zarr", "-q")
    assert inverted.exit_code in (0, 3), inverted.output
    store = read("all.shadowinv.zarr")
    assert store.sizes["shot"] == 3

    refused("film", truth.pack, names="pack.shadowinv exists")
    elsewhere = ("--layers", "layers", "--out", "other.shadowinv")
    refused("film", truth.pack, *elsewhere, names="layers.csv exists")


def test_a_pack_is_described_and_repeated(
    truth: Truth, folder: Path, refused: Callable[..., None]
) -> None:
    assert shadowinv("film", truth.pack, "-q").output == ""
    output = flat(shadowinv("info", "pack.shadowinv").output)
    assert "film pack of shadowinv" in output
    assert "films 3, " in output
    assert "pixels 90 × 120, " in output
    dark = '[{"code": "film-range", "text": "film 2 is dark"}]'
    write("dark.shadowinv", read("pack.shadowinv").assign_attrs(cautions=dark))
    assert "film 2 is dark" in flat(shadowinv("info", "dark.shadowinv").output)
    # A result may come from anybody: scans that lie elsewhere are asked for.
    refused("rerun", "pack.shadowinv", names="film_01.tif, which is in another folder")
    again = shadowinv("rerun", "pack.shadowinv", "--other-folders")
    assert again.exit_code == 0, again.output
    assert "the same result, bit for bit" in flat(again.output)
    assert "pack_again.png" in content(folder)
    for command, out in (("invert", "x.shadowinv"), ("fit", "x.shadowinv"), ("forward", "x.tif")):
        refused(command, "pack.shadowinv", "--out", out, names="film pack")


def test_without_distances_the_table_lists_strengths(truth: Truth, folder: Path) -> None:
    text = truth.pack.read_text()
    text = re.sub(r"\[setup\].*?(?=\[films)", "", text, flags=re.DOTALL)
    pack = truth.folder / "no_setup.toml"
    pack.write_text(text)
    ended = shadowinv("film", pack, "--layers", "layers", "-q")
    assert ended.exit_code == 0, ended.output
    header, first, second, _ = (folder / "layers" / "layers.csv").read_text().splitlines()
    assert header == "file,mask,energy,strength"
    assert first.endswith(",1")
    energies = read("no_setup.shadowinv")["energy"].values
    listed = [float(line.split(",")[2]) for line in (first, second)]
    np.testing.assert_allclose(listed, energies[:2], rtol=1e-5)
    assert float(second.split(",")[-1]) == pytest.approx(
        (energies[0] / energies[1]) ** 0.5, rel=2e-3
    )


@pytest.mark.parametrize(
    ("name", "written", "message"),
    [
        ("lost.toml", None, "lost.toml does not exist: expected a TOML file"),
        ("bad.toml", "layers = 3", "'layers' is 3"),
        ("bad.toml", "[[layers]\n", "is not valid TOML"),
        ("bad.toml", '[[layers]]\nfilm = "EBT4"\n', "did you mean 'EBT3'?"),
        ("bad.toml", '[[layers]]\nfilm = "EBT3"\n', "layer 1 has no file"),
    ],
)
def test_mistakes_in_a_pack_leave_nothing(
    refused: Callable[..., None], name: str, written: str | None, message: str
) -> None:
    if written is not None:
        Path(name).write_text(written)
    refused("film", name, names=message)


def test_a_cancelled_run_leaves_nothing(truth: Truth, folder: Path, monkeypatch) -> None:
    monkeypatch.setattr(_terminal, "is_interrupted", lambda: True)
    ended = shadowinv("film", truth.pack)
    assert ended.exit_code == 130
    assert content(folder) == {}
