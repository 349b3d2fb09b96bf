"""The README and the page "What limits my result?" work as they stand; links lead somewhere."""

from __future__ import annotations

import contextlib
import importlib
import io
import re
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
import xarray

from helpers.command_line import run_line
from helpers.pages import ROOT, WRITTEN_PAGES, blocks, run_python, text_of
from napari_shadowinv import Instrument, invert, read
from napari_shadowinv.physics.setup import SPECIES, setup_from_dict

README, LIMITS = "README.md", "docs/limits.md"


@pytest.fixture(scope="module")
def pages(tmp_path_factory: pytest.TempPathFactory) -> dict[str, tuple[Any, Path]]:
    """What pages print, and the folders in which they were run once, each with a shot."""
    results = {}
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(ROOT / "docs")
        check_page = importlib.import_module("check_numbers").check_page
        for page in (README, LIMITS):
            folder = tmp_path_factory.mktemp("page")
            with contextlib.chdir(folder):
                results[page] = check_page(ROOT / page), folder
    return results


@pytest.fixture
def readme(pages: dict[str, tuple[Any, Path]], monkeypatch: pytest.MonkeyPatch) -> Any:
    page, folder = pages[README]
    monkeypatch.chdir(folder)
    return page


@pytest.fixture
def limits(pages: dict[str, tuple[Any, Path]], monkeypatch: pytest.MonkeyPatch) -> Any:
    page, folder = pages[LIMITS]
    monkeypatch.chdir(folder)
    return page


@pytest.mark.parametrize("page", WRITTEN_PAGES, ids=lambda page: page.stem)
def test_a_link_leads_somewhere(page: Path) -> None:
    text = re.sub(r"```.*?```|`[^`\n]*`", "", page.read_text("utf-8"), flags=re.DOTALL)
    targets = re.findall(r"\]\((?!https?:|mailto:|reference/)([^)#]+)", text)
    assert [target for target in targets if not (page.parent / target).exists()] == []


@pytest.mark.parametrize(("page", "count"), [(README, 1), (LIMITS, 6)])
def test_a_page_shows_what_is_printed(
    pages: dict[str, tuple[Any, Path]], page: str, count: int
) -> None:
    result, _ = pages[page]
    assert (result.disagreements, result.left_out) == ([], [])
    assert result.compared >= count


def test_the_readme_finds_the_field_of_its_shot(readme: Any) -> None:
    (printed,) = re.findall(r"print\(.*# (.*) …", text_of(README))
    assert float(printed.split()[-6]) == pytest.approx(
        1e6 * np.hypot(*readme.names["field"]).max(), abs=0.5
    )
    result = readme.names["result"]
    assert isinstance(result, xarray.Dataset)
    assert result.potential.attrs["units"] == "pixel**2"
    peak = np.hypot(*readme.names["inversion"].displacement).max()
    assert peak == pytest.approx(20 / 6 * np.exp(-0.5), rel=0.05)


def test_commands_inside_the_sentences_of_the_readme_follow_the_others(readme: Any) -> None:
    inside = re.findall(r"`shadowinv ([^`\n]*)`", text_of(README))
    assert [line.split()[0] for line in inside] == ["info", "forward", "info"]
    for line in inside:
        run_line(line.replace("FILE", "shot.shadowinv"))
    assert Path("shot.png").read_bytes().startswith(b"\x89PNG")
    assert read("shot.shadowinv").potential.attrs["units"] == "pixel**2"
    assert tifffile.imread("shot_image.tif").shape == (40, 50)
    assert xarray.open_zarr("night.shadowinv.zarr", consolidated=False).sizes["shot"] == 2


def test_a_setup_for_electrons_is_as_the_readme_says() -> None:
    (setup,) = blocks(text_of(README), "toml")
    said = re.search(r"`(kind = .*?)`.*`(species = .*?)`", text_of(README))
    assert said is not None
    written = re.sub("^kind.*$", f"{said[1]}\n{said[2]}", setup, flags=re.MULTILINE)
    assert setup_from_dict(tomllib.loads(written)).particle == SPECIES["electron"]


def test_the_first_line_of_the_limits_is_that_of_their_shot(limits: Any) -> None:
    (line,) = re.findall(r"^> (.*)$", text_of(LIMITS), re.MULTILINE)
    assert line == str(limits.names["result"].headline)
    assert read("shot.shadowinv").attrs["verdict"] == "too uncertain"


def test_the_totals_of_the_tables_of_limits_are_those_of_inversions(limits: Any) -> None:
    text, shot, reference = (text_of(LIMITS), limits.names["shot"], limits.names["reference"])
    (apart,) = re.findall(r"of another exposure \| .* \| ([\d.]+) %", text)
    row = r"^\| .* \| .* \| `--set instrument\.([a-z_]+)=([\d.]+)` \| ([\d.]+) %"
    rows = re.findall(row, text, re.MULTILINE)
    detectors = re.findall(r"^\| `([A-Za-z0-9 -]+)` \| ([\d.]+) % \|", text, re.MULTILINE)
    sources = re.findall(r"([\d.]+) % for (?:an? )?`([A-Za-z -]+)`", text)
    assert (len(rows), len(detectors), len(sources)) == (9, 4, 4)
    cases = [(reference, Instrument(), apart)]
    for name, value, total in rows:
        instrument = Instrument(**{"beam_rms": 0.0, name: float(value)})
        cases.append((None if name == "beam_rms" else reference, instrument, total))
    cases += [(None, Instrument(detector=name, beam_rms=0.005), total) for name, total in detectors]
    cases += [
        (None, Instrument(detector="film", beam_source=name), total) for total, name in sources
    ]
    for source, instrument, total in cases:
        errors = invert(shot, source=source, instrument=instrument).errors
        share = 100 * errors.total.rms / errors.rms
        assert share == pytest.approx(float(total), rel=0.06), instrument


@pytest.mark.usefixtures("no_causes")
def test_the_loop_of_the_page_on_fits_names_the_film_that_changed() -> None:
    """The page leaves out each film in turn; with a stronger object in one, its χ² is largest."""
    first, *_, loop = (
        block
        for block in blocks(text_of("docs/fit.md"), "python")
        if "ProtonSetup(" in block or "enumerate(films)" in block
    )
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        stronger = loop.replace("synthetic_image(", "synthetic_image(1.1 * ", 1)
        exec(first + stronger, {"__name__": "page"})
    chi2 = [float(line.split()[-1]) for line in printed.getvalue().splitlines()[-3:]]
    np.testing.assert_allclose(chi2, [1.8, 1.1, 2.3], atol=0.05)


def test_the_loop_of_the_page_on_plans_shows_what_a_beam_is_worth() -> None:
    names = run_python(text_of("docs/planning.md"))
    names["plt"].close("all")
    errors = [100 * plan.error.median for plan in names["plans"]]
    np.testing.assert_allclose(errors, [7, 22, 103], atol=0.6)


def test_the_luminescence_of_a_plate_is_that_of_its_formulas() -> None:
    (block,) = (each for each in blocks(text_of("docs/reading.md"), "python") if "psl =" in each)
    names: dict[str, Any] = {}
    exec(block, names)
    assert names["psl"][1, 1] == pytest.approx(0.0625 * 10**2.5)
    np.testing.assert_array_equal(names["mask"], [[True, True], [True, False]])
    rows = re.findall(r"^\| BAS-(\w+) ((?:\| [\d.]+ ){4})\|$", text_of("docs/reading.md"), re.M)
    after_an_hour = {}
    for plate, cells in rows:
        first, early, second, late = map(float, cells.split("|")[1:])
        assert first + second == pytest.approx(1)
        after_an_hour[plate] = first * np.exp(-60 / early) + second * np.exp(-60 / late)
    expected = {"MS": 0.8558, "SR": 0.4252, "TR": 0.5008, "MP": 0.4527}
    assert after_an_hour == pytest.approx(expected, abs=5e-5)
    assert names["left"] == pytest.approx(after_an_hour["TR"])
