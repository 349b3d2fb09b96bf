"""What the tutorials show must work as it stands there, with the numbers that they tell."""

from __future__ import annotations

import re
import shlex
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from helpers.command_line import run_line
from helpers.pages import (
    assert_rows_are_shown,
    assert_same_but_for_rounding,
    blocks,
    commands,
    run_python,
    text_of,
)
from helpers.public_data import public_file, public_names
from napari_shadowinv import InversionOptions, invert, read
from napari_shadowinv.analysis import product_from_text
from napari_shadowinv.facts import percent
from napari_shadowinv.inversion.variables import setup_from_dataset
from napari_shadowinv.physics.setup import ProtonSetup

SETUP = """kind = "proton"
energy = 14.7
source_object_distance = 1.3e-3
object_image_distance = 20e-3
detector_pixel_size = 24.57e-6
"""


@pytest.fixture(autouse=True)
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def run_page(name: str, capsys: pytest.CaptureFixture[str]) -> tuple[str, str, dict[str, Any]]:
    """Run the Python of a tutorial; return its text, what it printed, and its names."""
    page = text_of(f"docs/tutorials/{name}.md")
    names = run_python(page)
    return page, capsys.readouterr().out, names


def test_the_script_finds_the_field_that_it_simulates(capsys):
    _, printed, names = run_page("script", capsys)
    assert names["report"].converged
    assert names["report"].cautions == ()
    assert names["report"].image_residual < 0.05
    true_peak = names["true_strength"].max()
    assert true_peak == pytest.approx(97, rel=0.01)
    assert names["strength"].max() == pytest.approx(true_peak, rel=0.03)
    assert names["linear_strength"].max() < 0.9 * true_peak
    assert 0 < names["deviation"][0][names["place"]] < 0.1 * true_peak
    assert names["peaks"] == pytest.approx([names["peaks"][0]] * 3, rel=0.03)
    saved = read("toroid.shadowinv")
    np.testing.assert_allclose(saved.potential, names["inversion"].potential)
    assert "pixel**2" in printed


def test_the_proton_radiograph_has_the_numbers_of_its_page(capsys):
    page, _, _ = run_page("proton-radiograph", capsys)
    Path("setup.toml").write_text(SETUP, encoding="utf-8")
    Path("other.toml").write_text(SETUP.replace("14.7", "3.0"), encoding="utf-8")
    assert [line.split()[0] for line in commands(page)] == ["invert", "forward"]
    for line in commands(page):
        run_line(line)
    measured = read("shot.shadowinv")
    residual = float(measured.attrs["image_residual"])
    assert residual == pytest.approx(0.0825, abs=5e-4)
    assert f"**Image residual** {percent(residual)}" in page
    assert "**Caustics**, under *More*, 0 % of the pixels" in page
    assert not measured.caustic.any()
    setup = setup_from_dataset(measured)

    def peak(displacement):
        return 1e3 * np.hypot(*setup.path_integrated_b(displacement)).max()

    assert peak(np.asarray(measured.displacement)) == pytest.approx(15.0, abs=0.1)
    uniform = invert(read("shot.tif").image, options=InversionOptions())
    assert peak(uniform.displacement) == pytest.approx(13.8, abs=0.1)
    assert uniform.report.image_residual == pytest.approx(0.0603, abs=5e-4)
    assert f"even smaller ({percent(uniform.report.image_residual)})" in page
    assert "edge" in {caution.code for caution in uniform.report.cautions}


def test_the_recipe_of_the_first_shadowgram_repeats_its_report(make_napari_viewer, tmp_path):
    from qtpy.QtCore import QSettings

    from napari_shadowinv._napari.widgets.invert import Invert

    # The widget must not remember the settings of whoever runs the test.
    QSettings.setPath(QSettings.Format.IniFormat, QSettings.Scope.UserScope, str(tmp_path))
    viewer = make_napari_viewer()
    viewer.open_sample("napari-shadowinv", "toroid")
    tool = Invert(viewer)
    assert tool.source.choice.current_choice == "supplied with the shot"
    tool.recipes.save(Path("recipe.toml"))
    viewer.layers["toroid"].save("toroid.tif")
    page = text_of("docs/tutorials/first-shadowgram.md")
    (line,) = commands(page)
    run_line(line)
    assert Path("recipe_source.npy").exists()
    residual = float(read("toroid.shadowinv").attrs["image_residual"])
    assert f"an image residual of {percent(residual)}" in page


def test_two_energies_have_the_numbers_of_their_page(capsys):
    page, printed, names = run_page("two-energies", capsys)
    *shown, shown_by_command = blocks(page, "text")
    assert_same_but_for_rounding(printed, "".join(shown))
    assert names["found"].verdict == "determined"
    assert names["one"].verdict == "does not fit"
    assert names["error"](names["field"].displacement) < 1.2
    assert names["beam"].std() / names["beam"].mean() == pytest.approx(0.1, abs=0.005)
    assert names["ratio"].std() < 0.01
    assert Path("two-energies.png").exists()
    assert read("two-energies.shadowinv").attrs["verdict"] == "determined"

    (setup,), (line,) = blocks(page, "toml"), commands(page)
    Path("setup.toml").write_text(setup, encoding="utf-8")
    assert_rows_are_shown(run_line(line).output, shown_by_command)
    saved = read("14.7MeV_fit.shadowinv")
    np.testing.assert_allclose(
        saved.displacement, names["field"].displacement, atol=0.02, err_msg="command and Python"
    )


@pytest.mark.usefixtures("blank_pages")
def test_the_film_pack_has_the_numbers_of_its_page():
    Path("stopping").mkdir()
    for name in public_names("rcf"):
        Path(name).relative_to("rcf").symlink_to(public_file(name))
    page = text_of("docs/tutorials/film-pack.md")
    films, summary, layers, *_ = blocks(page, "text")
    (pack,) = blocks(page, "toml")
    Path("films.csv").write_text(films, encoding="utf-8")
    Path("pack.toml").write_text(pack, encoding="utf-8")
    assert_same_but_for_rounding(run_line(commands(page)[0], columns=200).output, summary)
    rows = Path("layers/layers.csv").read_text(encoding="utf-8").splitlines()
    expected_rows = layers.splitlines()
    assert_same_but_for_rounding("\n".join([*rows[:3], "…", rows[-1]]), "\n".join(expected_rows))

    doses = read("pack.shadowinv")
    by_images = doses["layer"].values[doses["by_images"].values]
    assert by_images.tolist() == list(range(1, 9)), "laid by what they show"
    assert "Films 1 to 8 are laid by what they show" in page
    assert np.abs(doses["shift"].values).max() == pytest.approx(8.3, abs=0.1)
    assert f"{float(doses['peak'][-1]):.1f} MeV" in page
    nominal = np.genfromtxt("RCF_Stack_Design.csv", delimiter=",", skip_header=2, max_rows=1)[1:]
    # The last film sees all protons beyond its peak, too.
    assert np.abs(doses["energy"].values / nominal - 1)[:-1].max() < 0.05
    assert doses["peak"].values[-1] == pytest.approx(nominal[-1], rel=0.01)


def test_the_table_of_sources_is_as_the_inversions_say():
    from napari_shadowinv._napari.samples import four_toroids
    from napari_shadowinv.physics import phantoms
    from napari_shadowinv.preprocessing import ESTIMATES

    (source, *_), (image, *_) = four_toroids()
    setup = ProtonSetup.example()
    truth = phantoms.four_toroids(image.shape, setup, 0.8).displacement
    assert 1e3 * np.hypot(*setup.path_integrated_b(truth)).max() == pytest.approx(10.8, abs=0.05)
    pattern = r"^\| ([a-z].*?) \| ([\d.]+) \| (\d+) \| ([\d.]+) \|"
    rows = re.findall(pattern, text_of("docs/tutorials/no-reference.md"), re.M)
    by_title = {f"estimate: {model.title}": model for model in ESTIMATES.values()}
    by_title["uniform"] = ESTIMATES["uniform"]
    assert len(rows) == 4
    for title, peak, error, residual in rows:
        beam = source if title.startswith("supplied") else by_title[title]().source(image, None)
        inversion = invert(image, source=beam)
        strength = 1e3 * np.hypot(*setup.path_integrated_b(inversion.displacement))
        assert strength.max() == pytest.approx(float(peak), abs=0.06), title
        wrong = 100 * np.linalg.norm(inversion.displacement - truth) / np.linalg.norm(truth)
        assert wrong == pytest.approx(float(error), abs=0.6), title
        assert 100 * inversion.report.image_residual == pytest.approx(float(residual), abs=0.06)
        codes = {caution.code for caution in inversion.report.cautions}
        assert ("edge" in codes) != title.startswith("supplied"), title


def test_the_film_without_reference_has_the_numbers_of_its_page(capsys):
    page, printed, names = run_page("film-without-reference", capsys)
    shown_by_command, shown, *_ = blocks(page, "text")
    assert_same_but_for_rounding(printed, shown)
    result = names["result"]
    assert result.verdict == "too uncertain"
    away = names["strength"](result.displacement).max() - names["strength"](names["truth"]).max()
    assert abs(away) < names["bar"], "the peak is right within its error"

    (setup,), (line, fit_line) = blocks(page, "toml"), commands(page)
    Path("setup.toml").write_text(setup, encoding="utf-8")
    assert_rows_are_shown(run_line(line).output, shown_by_command)
    # The fit takes too long for a test; its flags must be those of the command.
    assert fit_line.startswith("fit ")
    listing = run_line("fit --help", columns=200).output
    assert set(re.findall(r"--[a-z-]+", fit_line)) <= set(re.findall(r"--[a-z-]+", listing))


def test_the_turbulence_has_the_spectrum_of_its_cube(capsys):
    page, printed, names = run_page("turbulence", capsys)
    assert_same_but_for_rounding(printed, "".join(blocks(page, "text")))
    power, is_in_range = names["power"], names["in_range"]
    true = {"slope": -5 / 3, "rms_field": np.sqrt(power[is_in_range].sum())}
    for name, value in true.items():
        low, high = names["spectrum"].band(name, 0.95)
        assert low < value < high

    (line,) = commands(page)
    product = product_from_text(shlex.split(line)[-1])
    used = names["spectrum"].product
    assert (product.path_length, product.shortest) == (used.path_length, used.shortest)


def test_the_flame_has_the_temperatures_of_its_page(capsys):
    page, printed, names = run_page("flame", capsys)
    shown = "".join(blocks(page, "text"))
    starts = [text.partition("Axis offset")[0] for text in (printed, shown)]  # nearly 0, random
    assert_same_but_for_rounding(*starts)
    true = np.array([[names["temperature"](r, row) for r in range(40)] for row in names["rows"]])
    hot = true > 600
    error = np.abs(names["hot"][:, :40] - true)[hot] / true[hot]
    assert error.max() < 0.05
    low, high = names["profile"].band("temperature", 0.95)
    inside = (low[:, :40] <= true) & (true <= high[:, :40])
    assert inside[hot].mean() > 0.6

    (line,) = commands(page)
    product = product_from_text(shlex.split(line)[-1])
    used = names["profile"].product
    assert product.ambient_temperature == used.ambient_temperature
    assert product.slice_width == used.slice_width
