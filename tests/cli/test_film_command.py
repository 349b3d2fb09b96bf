"""The command `shadowinv film`: its files, and its errors."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from helpers.command_line import content, done, refused, shadowinv
from napari_shadowinv import read, write
from napari_shadowinv.cli import _terminal
from napari_shadowinv.film import read_corners
from simulated_pack import Truth, simulate


@pytest.fixture(scope="module")
def truth(tmp_path_factory: pytest.TempPathFactory) -> Truth:
    folder = tmp_path_factory.mktemp("pack")
    return simulate(folder, layers=3, shape=(90, 120), seed=2, b_peak=2.0, e_peak=0.0)


def test_a_pack_from_scans_to_files_for_a_fit(truth: Truth, folder: Path) -> None:
    printed = done("film", truth.pack, "--layers", "layers", "--save-corners", "corners.csv")
    assert content(folder).keys() == {"pack.shadowinv", "pack.png", "corners.csv"}
    assert "Film pack" in printed
    dataset = read("pack.shadowinv")
    for energy in dataset["energy"].values:
        assert f"{energy:.3g} MeV" in printed
    corners = read_corners("corners.csv")
    np.testing.assert_allclose(list(corners.values()), dataset["corners"], atol=0.006)
    assert len((folder / "layers" / "layers.csv").read_text().splitlines()) == 4
    shadowinv("batch", "layers/layers.csv", "--out", "all.shadowinv.zarr", "-q")
    assert read("all.shadowinv.zarr").sizes["shot"] == 3
    refused("film", truth.pack, names="pack.shadowinv exists")
    elsewhere = ("--layers", "layers", "--out", "other.shadowinv")
    refused("film", truth.pack, *elsewhere, names="layers.csv exists")


def test_a_pack_is_described_and_repeated(truth: Truth, folder: Path) -> None:
    assert done("film", truth.pack, "-q") == ""
    output = done("info", "pack.shadowinv")
    for words in ("film pack of shadowinv", "films 3, ", "pixels 90 × 120, "):
        assert words in output
    dark = '[{"code": "film-range", "text": "film 2 is dark"}]'
    write("dark.shadowinv", read("pack.shadowinv").assign_attrs(cautions=dark))
    assert "film 2 is dark" in done("info", "dark.shadowinv")
    # A result may come from anybody: scans that lie elsewhere are asked for.
    elsewhere = ("film_01.tif, which is in another folder", "(--other-folders)")
    refused("rerun", "pack.shadowinv", names=elsewhere)
    repeated = "the same result, bit for bit"
    assert repeated in done("rerun", "pack.shadowinv", "--other-folders")
    assert "pack_again.png" in content(folder)
    for command, out in (("invert", "x.shadowinv"), ("fit", "x.shadowinv"), ("forward", "x.tif")):
        refused(command, "pack.shadowinv", "--out", out, names="pack.shadowinv")


def test_without_distances_the_table_lists_strengths(truth: Truth, folder: Path) -> None:
    text = truth.pack.read_text()
    text = re.sub(r"\[setup\].*?(?=\[films)", "", text, flags=re.DOTALL)
    pack = truth.folder / "no_setup.toml"
    pack.write_text(text)
    done("film", pack, "--layers", "layers", "-q")
    header, first, second, _ = (folder / "layers" / "layers.csv").read_text().splitlines()
    assert header == "file,mask,energy,strength"
    assert first.endswith(",1")
    energies = read("no_setup.shadowinv")["energy"].values
    listed = [float(line.split(",")[2]) for line in (first, second)]
    np.testing.assert_allclose(listed, energies[:2], rtol=1e-5)
    assert float(second.split(",")[-1]) == pytest.approx(
        (energies[0] / energies[1]) ** 0.5, rel=2e-3
    )


def test_a_cancelled_run_leaves_nothing(truth: Truth, folder: Path, monkeypatch) -> None:
    monkeypatch.setattr(_terminal, "is_interrupted", lambda: True)
    done("film", truth.pack, code=130)
    assert content(folder) == {}
