"""Repeat the paper's figures: pictures and measured numbers, written as docs/paper.md.

    python benchmarks/paper.py [--out docs]

Kasim et al., "Quantitative shadowgraphy and proton radiography for large intensity
modulations", arXiv:1607.04179. All numbers on the page are measured by this run, also
those that fall short of the paper's or of what was aimed at.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import matplotlib as mpl
import numpy as np

from napari_shadowinv import invert
from paper_parts import page
from paper_parts.beyond_caustics import figure_folded, folded_shots
from paper_parts.drawing import STYLE
from paper_parts.figures_method import figure_algorithm, figure_diagrams, walk_through
from paper_parts.figures_structures import figure_structures, figure_wave
from paper_parts.figures_toroid import figure_intensity, figure_setup, figure_sweep
from paper_parts.measurements import caustic_onset, plasma_wave, structures, sweep


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    default = Path(__file__).resolve().parents[1] / "docs"
    parser.add_argument("--out", type=Path, default=default, help="folder of page and pictures")
    out = parser.parse_args().out
    out.mkdir(parents=True, exist_ok=True)
    with mpl.rc_context(STYLE):
        text = make_everything(out)
    (out / "paper.md").write_text(text, encoding="utf-8")
    print(f"wrote {out / 'paper.md'}")


def make_everything(out: Path) -> str:
    """Draw all figures; return the page that shows them."""
    start = time.perf_counter()
    invert(np.ones((20, 20)) + np.eye(20))  # compile, so that the seconds are the work's
    figure_diagrams(out / "paper-diagrams.png")
    walk = walk_through()
    figure_algorithm(walk, out / "paper-algorithm.png")
    figure_setup(out / "paper-setup.png")
    figure_intensity(out / "paper-intensity.png")
    rows, onset = sweep(), caustic_onset()
    figure_sweep(rows, onset, out / "paper-sweep.png")
    folded = folded_shots()
    figure_folded(folded, onset, out / "paper-folded.png")
    found = structures()
    figure_structures(found, out / "paper-structures.png")
    wave = plasma_wave()
    figure_wave(wave, out / "paper-wakefield.png")
    minutes = (time.perf_counter() - start) / 60
    return page.write(rows, onset, folded, found, wave, len(walk.weights) - 1, minutes)


if __name__ == "__main__":
    main()
