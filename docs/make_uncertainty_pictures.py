"""Make the pictures of docs/uncertainty.md.

    python docs/make_uncertainty_pictures.py

Everything is simulated, so that the truth is known.
"""

from __future__ import annotations

import numpy as np
from _drawing import DARK, ORANGE, FloatArray, save, show, tidy
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from napari_shadowinv import invert, synthetic_image
from napari_shadowinv.inversion import ErrorSamples
from napari_shadowinv.physics.phantoms import gaussian_blob

SHAPE = (160, 160)
COUNTS = 30.0
ASPECT = 0.8  # of a plot


def page(title: str, columns: int, rows: int, height: float) -> tuple[Figure, list[Axes]]:
    figure = Figure(figsize=(4.3 * columns, height), layout="constrained")
    figure.suptitle(title, x=0.01, ha="left", fontsize=15, fontweight="bold")
    figure.get_layout_engine().set(wspace=0.06, hspace=0.06)
    axes = figure.subplots(rows, columns, squeeze=False)
    return figure, list(axes.ravel())


def draw_cut(axes: Axes, values: FloatArray, std: FloatArray, truth: FloatArray) -> None:
    """Draw retrieved values with a band of one and two error bars, and the truth."""
    x = np.arange(len(values))
    for times, alpha, label in ((2, 0.22, None), (1, 0.45, "±1 and ±2 error bars")):
        axes.fill_between(
            x, values - times * std, values + times * std, color=ORANGE, alpha=alpha, lw=0,
            label=label,
        )  # fmt: skip
    axes.plot(x, values, color=ORANGE, lw=1.2, label="retrieved")
    axes.plot(x, truth, color=DARK, lw=1.3, ls="--", label="truth")
    axes.legend(frameon=False, fontsize=9)


def field_picture() -> None:
    """A shot of few protons: field, error bars, a cut, and how often they hold the truth."""
    parts = [(18.0, 9.0, (84.0, 52.0)), (5.0, 9.0, (84.0, 118.0)), (-12.0, 7.0, (36.0, 96.0))]
    truth = np.sum([gaussian_blob(SHAPE, *part).displacement for part in parts], axis=0)
    rng = np.random.default_rng(3)
    shots = [rng.poisson(COUNTS * synthetic_image(truth)) for _ in range(20)]
    source = np.full(SHAPE, COUNTS)
    field, found = sampled(shots[0], source, 40)
    std = found.displacement_std[1]
    row = 84
    title = f"Error bars from one shot of {COUNTS:.0f} protons per pixel"
    figure, axes = page(title, 3, 2, 7.5)
    show(axes[0], shots[0], "Shot", "Protons", (0, float(np.percentile(shots[0], 99.8))), "gray")
    largest = float(np.abs(truth[1]).max())
    limits = (-largest, largest)
    show(axes[1], field[1], "Displacement along x", "Displacement (px)", limits, "RdBu_r")
    top = float(np.percentile(std, 99.8))
    show(axes[2], std, "Its error bar", "Standard deviation (px)", (0, top), "viridis")
    axes[1].axhline(row, color=DARK, lw=1, ls="--")
    axes[2].axhline(row, color="white", lw=1, ls="--")
    draw_cut(axes[3], field[1, row], std[row], truth[1, row])
    tidy(axes[3], f"Cut at y = {row} px", "x (px)", "Displacement along x (px)", ASPECT)
    show_potential(axes[4], found)
    others = [invert(shot, source=source).displacement - truth for shot in shots]
    draw_calibration(axes[5], np.array(others) / found.displacement_std)
    save(figure, "uncertainty.png")


def sampled(shot: FloatArray, source: FloatArray, n: int) -> tuple[FloatArray, ErrorSamples]:
    """Return the displacement of a shot, and samples of its noise."""
    result = invert(shot, source=source).uncertainty(n, noise="poisson", noise_only=True)
    assert result.errors is not None
    assert result.errors.samples is not None
    return result.displacement, result.errors.samples


def show_potential(axes: Axes, found: ErrorSamples) -> None:
    top = float(found.potential_std.max())
    show(
        axes, found.potential_std, "Error bar of the potential", "Standard deviation (px²)",
        (0, top), "viridis",
    )  # fmt: skip


def draw_calibration(axes: Axes, miss: FloatArray) -> None:
    """Compare the error in units of the error bar with a normal distribution."""
    edges = np.linspace(-4.5, 4.5, 61)
    held = np.mean(np.abs(miss) < 1)
    axes.hist(
        miss.ravel(), edges, density=True, color=ORANGE, alpha=0.45, label="all pixels, 20 shots"
    )
    normal = np.exp(-0.5 * edges**2) / np.sqrt(2 * np.pi)
    axes.plot(edges, normal, color=DARK, lw=1.3, ls="--", label="normal distribution")
    axes.legend(frameon=False, fontsize=9, loc="upper right")
    axes.set_ylim(0, 0.56)
    tidy(axes, f"{held:.0%} within one error bar", "Error / error bar", "Share per unit", ASPECT)


def limits_picture() -> None:
    """What the error bars do not know of: another source, and an object at the edge."""
    shape = (120, 160)
    counts = 300.0
    rng = np.random.default_rng(0)
    flat = np.full(shape, counts)
    x = np.arange(shape[1])
    blob = gaussian_blob(shape, 30.0, 9.0, (60.0, 80.0))
    at_edge = gaussian_blob(shape, 30.0, 9.0, (60.0, 4.0))
    uneven = flat * (1 + 0.05 * np.cos(np.pi * x / shape[1]))
    cases = [
        ("Source known", blob.displacement, flat),
        ("Beam tilted by ±5 %, taken as flat", blob.displacement, uneven),
        ("Object across the left edge", at_edge.displacement, flat),
    ]
    figure, axes = page("What error bars from noise do not contain", 3, 1, 4.3)
    for panel, (title, truth, beam) in zip(axes, cases, strict=True):
        shot = rng.poisson(counts * synthetic_image(truth, beam / beam.mean()))
        field, found = sampled(shot, flat, 20)
        draw_cut(panel, field[1, 60], found.displacement_std[1, 60], truth[1, 60])
        tidy(panel, title, "x (px)", "Displacement along x (px)", ASPECT)
        held = np.mean(np.abs(field - truth) < found.displacement_std)
        panel.set_xlabel(f"x (px)\ntruth within one error bar: {held:.0%} of all pixels")
    save(figure, "uncertainty-limits.png")


def main() -> None:
    invert(np.ones((20, 20)) + np.eye(20))  # compile first
    field_picture()
    limits_picture()


if __name__ == "__main__":
    main()
