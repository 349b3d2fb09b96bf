"""Make the pictures and the table of verdicts of docs/tutorials/two-energies.md.

    python docs/make_two_energies_pictures.py [--table]

Runs the blocks of the page, so that the pictures show what the page tells. `--table` prints what
the fit says of the same radiographs with something wrong, too.
"""

from __future__ import annotations

import argparse
import re
import tempfile
from contextlib import chdir
from types import SimpleNamespace
from typing import Any

import numpy as np
from _drawing import BLUE, DARK, HERE, ORANGE, FloatArray, save, show, tidy
from make_pictures import save_small
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from napari_shadowinv import FitOptions, fit, synthetic_image
from napari_shadowinv.plotting import fit_figure
from napari_shadowinv.shot import shots_of

ROW = 47  # of the cuts


def names_of_page() -> Any:
    """Run the page's blocks; return their names."""
    text = (HERE / "tutorials" / "two-energies.md").read_text(encoding="utf-8")
    names: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as scratch, chdir(scratch):
        for block in re.findall(r"```python\n(.*?)```", text, re.DOTALL):
            exec(compile(block, "two-energies.md", "exec"), names)
    return SimpleNamespace(**names)


def panels(title: str) -> tuple[Figure, list[Axes]]:
    figure = Figure(figsize=(17.2, 4.4), layout="constrained")
    figure.suptitle(title, x=0.01, ha="left", fontsize=15, fontweight="bold")
    figure.get_layout_engine().set(wspace=0.05)
    return figure, list(figure.subplots(1, 4))


def shots_picture(page: Any) -> None:
    figure, axes = panels("Two radiographs, and what transport makes of the first")
    for one, shot, name in zip(axes, page.shots, ("14.7 MeV", "3 MeV"), strict=False):
        top = float(np.percentile(shot, 98))
        show(one, shot, name, "Protons", (0, top))
    true, guess = page.strength(page.truth), page.strength(page.guess.displacement)
    limits = (0, float(guess.max()))
    unit = "|∫B × dz| (MG µm)"
    show(axes[2], true, "True field", unit, limits, "inferno")
    show(axes[3], guess, "Transport, uniform source", unit, limits, "inferno")
    save(figure, "pictures/two-energies-shots.png")


def beam_picture(page: Any) -> None:
    figure, axes = panels("What the fit makes of both")
    true = page.beam / page.beam.mean()
    found = page.found.source[0] / page.found.source[0].mean()
    limits = (float(true.min()), float(true.max()))
    show(axes[0], true, "True beam", "Beam / mean", limits)
    show(axes[1], found, "Fitted beam", "Beam / mean", limits)
    difference = 100 * (found / true - 1)
    show(axes[2], difference, "Difference", "Fitted − true (%)", (-4, 4), "RdBu_r", "both")
    draw_cut(axes[3], page)
    save(figure, "pictures/two-energies-beam.png")


def draw_cut(axes: Axes, page: Any) -> None:
    setup = page.setups[0]

    def along_x(displacement: FloatArray) -> FloatArray:
        """∫B_y dz, which displaces along x, on one row."""
        return np.asarray(setup.path_integrated_b(displacement, unit="MG um")[0][ROW])

    x = np.arange(page.truth.shape[2])
    found, deviation = along_x(page.field.displacement), along_x(page.field.errors.per_pixel)
    two = 2 * np.abs(deviation)
    axes.plot(x, along_x(page.guess.displacement), color=BLUE, lw=1.2, label="transport, uniform")
    axes.fill_between(x, found - two, found + two, color=ORANGE, alpha=0.4, lw=0, label="fit ± 2 σ")
    axes.plot(x, found, color=ORANGE, lw=1.4)
    axes.plot(x, along_x(page.truth), color=DARK, lw=1.3, ls="--", label="truth")
    tidy(axes, f"∫B_y dz along y = {ROW}", "x (px)", "∫B_y dz (MG µm)", 1.0)
    axes.legend(frameon=False, fontsize=9)


def print_table(page: Any) -> None:
    """What the fit says of radiographs with something wrong."""
    first, second = page.setups
    typed = second.model_copy(update={"energy": 4.0})
    moved = np.roll(page.shots[1], 3, axis=1)
    cut = np.s_[:, 22:]
    aligned = {"options": FitOptions(align="shift")}
    verdict(page, "source uniform", page.shots, [first, second], source=None)
    for energy in (15.5, 30.0):
        other = first.model_copy(update={"energy": energy})
        displacement = page.truth * first.momentum / other.momentum
        expected = synthetic_image(displacement, 300 * page.beam)
        shot = np.random.default_rng(2).poisson(expected)
        verdict(page, f"{energy:g} MeV", [page.shots[0], shot], [first, other])
    verdict(page, "entered as 4 MeV", page.shots, [first, typed])
    verdict(page, "shifted", [page.shots[0], moved], [first, second])
    verdict(page, "aligned", [page.shots[0], moved], [first, second], **aligned)
    verdict(page, "cut", [shot[cut] for shot in page.shots], [first, second], cut)


def verdict(
    page: Any, name: str, shots: Any, setups: Any, part: Any = np.s_[:, :], **keywords: Any
) -> None:
    known = {"setup": setups, "source": "unknown", "noise": "poisson"}
    found = fit(shots_of(shots, **known), **keywords)
    truth = page.truth[(slice(None), *part)]
    away = np.linalg.norm(found.fields[0].displacement - truth) / np.linalg.norm(truth)
    chi2 = " and ".join(f"{one:.1f}" for one in found.chi2)
    print(f"| {name} | {found.verdict} | {chi2} | {100 * away:.1f} |", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--table", action="store_true", help="print the table of verdicts, too")
    arguments = parser.parse_args()
    page = names_of_page()
    shots_picture(page)
    beam_picture(page)
    figure = fit_figure(page.found, title="14.7 and 3 MeV")
    save_small(figure, HERE / "pictures" / "two-energies-fit.png", 1300)
    if arguments.table:
        print_table(page)


if __name__ == "__main__":
    main()
