"""Make the picture of docs/tutorials/film-without-reference.md.

    python docs/make_film_without_reference_pictures.py [--table]

Runs the blocks of the page, so that the picture shows what the page says. `--table` prints what
a second film is worth instead.
"""

from __future__ import annotations

import argparse
import re
import tempfile
from contextlib import chdir
from types import SimpleNamespace
from typing import Any

import numpy as np
from _drawing import HERE, FloatArray, save, show
from matplotlib.figure import Figure
from scipy.ndimage import gaussian_filter

from napari_shadowinv import Instrument, ProtonSetup, fit, invert, synthetic_image
from napari_shadowinv.physics import toroid
from napari_shadowinv.shot import shots_of

UNIT = "|∫B × dz| (mT·m)"


def names_of_page() -> Any:
    """Run the page's blocks; return their names."""
    text = (HERE / "tutorials" / "film-without-reference.md").read_text(encoding="utf-8")
    names: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as scratch, chdir(scratch):
        for block in re.findall(r"```python\n(.*?)```", text, re.DOTALL):
            exec(compile(block, "film-without-reference.md", "exec"), names)
    return SimpleNamespace(**names)


def print_table(side: int = 48) -> None:
    """Print the errors of one and of two films for beams that differ in several ways."""
    lengths = {"source_object_distance": 0.01, "object_image_distance": 0.1, "pixel_size": 10e-6}
    setups = [ProtonSetup(energy=energy, **lengths) for energy in (8.0, 20.0)]
    shape = (side, side)
    strong = toroid(shape, setups[0], peak=20.0, sigma=48e-6, center=(21.5, 19))
    weak = toroid(shape, setups[0], peak=-14.0, sigma=34e-6, center=(29.5, 33.5))
    truth = strong.displacement + weak.displacement

    def error(displacement: FloatArray) -> float:
        return float(np.linalg.norm(displacement - truth) / np.linalg.norm(truth))

    both = {"beam_rms": 0.1, "beam_between": 0.05}
    cases = {
        "uniform, known": (0.0, 0.0, Instrument(beam_rms=0.0)),
        "uneven, the same": (0.1, 0.0, Instrument(beam_rms=0.1)),
        "uneven, different": (0.0, 0.05, Instrument(beam_rms=0.0, beam_between=0.05)),
        "both": (0.1, 0.05, Instrument(**both)),
        "both, film": (0.1, 0.05, Instrument(detector="film", beam_source="TNSA")),
    }
    for name, (rms, between, instrument) in cases.items():
        random = np.random.default_rng(0)

        def waves(size: float, random: np.random.Generator = random) -> FloatArray:
            noise = random.normal(size=(3 * side, 3 * side))
            smooth = gaussian_filter(noise, side / 4 / np.sqrt(2))
            middle = smooth[side : 2 * side, side : 2 * side]
            return np.asarray(size * middle * np.sqrt(2 * np.pi) * side / 4)

        common = waves(rms)
        films = []
        for setup in setups:
            beam = 1 + common + waves(between)
            film = synthetic_image(truth * setups[0].momentum / setup.momentum, beam)
            films.append(film + 0.03 * random.normal(size=shape))
        single = error(invert(films[0]).displacement)
        result = fit(shots_of(films, setup=setups, noise=0.03), instrument=instrument)
        print(
            f"| {name} | {single:.0%} | {error(result.fields[0].displacement):.1%} | "
            f"{result.total_error:.1%} | {result.verdict} |",
            flush=True,
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--table", action="store_true", help="print the table of two films")
    if parser.parse_args().table:
        print_table()
        return
    page = names_of_page()
    figure = Figure(figsize=(17.2, 3.1), layout="constrained")
    figure.get_layout_engine().set(wspace=0.05)
    axes = figure.subplots(1, 5)
    film = page.films[0]
    show(axes[0], film, "Film, 8 MeV", "Dose (Gy)", (0, float(np.percentile(film, 99))))
    measured, true = (page.strength(field) for field in (page.result.displacement, page.truth))
    limits = (0, float(measured.max()))
    show(axes[1], measured, "Field of one film", UNIT, limits, "inferno")
    show(axes[2], true, "True field", UNIT, limits, "inferno")
    without = [page.strength(field) for field in page.fine]
    limits = (0, float(without[1].max()))
    show(axes[3], without[0], "… without long waves", UNIT, limits, "inferno")
    show(axes[4], without[1], "True, without them", UNIT, limits, "inferno")
    save(figure, "pictures/film-without-reference.png")


if __name__ == "__main__":
    main()
