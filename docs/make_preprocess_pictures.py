"""Make the pictures of docs/sources.md and docs/filters.md.

    python docs/make_preprocess_pictures.py [--data ../shared/data]

The burner shadowgrams (see the README's credits) are looked for in the data folder and
left out where they are absent.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import _drawing as drawing
import numpy as np
from _drawing import BLUE, DARK, HERE, ORANGE, FloatArray, save
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from napari_shadowinv import ProtonSetup, invert, read, synthetic_image
from napari_shadowinv.options import BeamPrior
from napari_shadowinv.physics.phantoms import gaussian_blob
from napari_shadowinv.preprocessing import (
    BackgroundFilter,
    ButterworthFilter,
    GaussianEstimate,
    HighPassFilter,
    HotPixelFilter,
    IsotropicEstimate,
    KrigedEstimate,
    LowPassEstimate,
    LowPassFilter,
    PolynomialEstimate,
    UniformEstimate,
)
from napari_shadowinv.preprocessing.estimates import point_distance
from napari_shadowinv.preprocessing.kriging import kriged_prior

SHOT = "Image_20241017221829851.bmp"
SHAPE = (160, 200)
COUNTS = 2000.0


@dataclass(frozen=True)
class Scene:
    """A simulated shot with all that made it."""

    beam: FloatArray
    displacement: FloatArray
    shot: FloatArray
    row: int


def grid() -> tuple[FloatArray, FloatArray]:
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]].astype(float)
    return y, x


def blobs(*what: tuple[float, float, tuple[float, float]]) -> FloatArray:
    """Displacement of round blobs of some amplitude, radius and centre."""
    return np.sum([gaussian_blob(SHAPE, *blob).displacement for blob in what], axis=0)


def big_object() -> FloatArray:
    return blobs((70, 12, (78, 108)), (-14, 6, (58, 92)), (-16, 6, (96, 126)), (14, 5, (76, 72)))


def small_objects() -> FloatArray:
    rng = np.random.default_rng(4)
    centres = [(float(y), float(x)) for y in range(20, 150, 24) for x in range(22, 190, 26)]
    return blobs(
        *(
            (float(rng.choice([-3.5, 4.5])), 3.0, tuple(centre + rng.uniform(-5, 5, 2)))
            for centre in centres
        )
    )


def scene(beam: FloatArray, displacement: FloatArray, row: int = 78) -> Scene:
    beam = COUNTS * beam / beam.mean()
    shot = np.random.default_rng(0).poisson(synthetic_image(displacement, beam))
    return Scene(beam, displacement, shot.astype(float), row)


def gaussian_beam() -> FloatArray:
    y, x = grid()
    u, v = (y - 70) / 62, (x - 112) / 75
    return np.exp(-0.5 * (u**2 + v**2 + 0.5 * u * v)) + 0.05


def tilted_beam() -> FloatArray:
    y, x = (2 * axis / side - 1 for axis, side in zip(grid(), SHAPE, strict=True))
    return 1.9 + 0.6 * x - 0.3 * y - 0.45 * (x + 0.2) ** 2 - 0.35 * y**2


def patchy_beam(width: float, seed: int = 2) -> FloatArray:
    noise = np.random.default_rng(seed).normal(size=SHAPE)
    patches = LowPassFilter(width=width).filter_image(noise)
    return np.exp(0.28 * (patches - patches.mean()) / patches.std())


def displacement_error(shot: Scene, source: FloatArray) -> float:
    """Root mean square error of the retrieved displacement over that of the truth."""
    miss = invert(shot.shot, source=source).displacement - shot.displacement
    return float(np.sqrt((miss**2).mean() / (shot.displacement**2).mean()))


def page(title: str, widths: list[float], rows: int = 1) -> tuple[Figure, list[Axes]]:
    figure = Figure(figsize=(3.9 * sum(widths), 2.95 * rows + 0.7), layout="constrained")
    figure.suptitle(title, x=0.01, ha="left", fontsize=15, fontweight="bold")
    axes = figure.subplots(rows, len(widths), width_ratios=widths, squeeze=False)
    return figure, list(axes.ravel())


show = partial(drawing.show, extend="both")


def tidy(axes: Axes, title: str, x_label: str, y_label: str) -> None:
    drawing.tidy(axes, title, x_label, y_label, aspect=0.72)
    axes.legend(frameon=False, fontsize=9)


def range_of(image: FloatArray, share: float = 0.5) -> tuple[float, float]:
    low, high = np.percentile(image, [share, 100 - share])
    return float(low), float(high)


def source_picture(
    name: str,
    title: str,
    shot: Scene,
    source: FloatArray,
    mask: NDArray[np.bool_] | None = None,
    deviation: FloatArray | None = None,
) -> None:
    """Shot, estimate, their ratio, and a cut with the true beam and two relative deviations."""
    figure, axes = page(title, [1, 1, 1, 1.15])
    mean = shot.shot.mean()
    limits = range_of(shot.shot / mean)
    show(axes[0], shot.shot / mean, "Shot", "Intensity / mean", limits)
    show(axes[1], source / mean, "Estimated source", "Intensity / mean", limits)
    show(axes[2], shot.shot / source, "Shot / source", "Modulation", (0.3, 1.7), "RdBu_r")
    for image in axes[:2]:
        image.axhline(shot.row, color=ORANGE, lw=1, ls="--")
        if mask is not None:
            image.contour(mask, [0.5], colors=[BLUE], linewidths=1.3)
    x, width = np.arange(SHAPE[1]), 3.0 if deviation is None else 1.5
    axes[3].plot(x, shot.shot[shot.row] / mean, color="0.7", lw=1, label="shot")
    axes[3].plot(x, source[shot.row] / mean, color=ORANGE, lw=width, label="estimate")
    if deviation is not None:
        low, high = (source[shot.row] / mean * (1 + k * deviation[shot.row]) for k in (-2, 2))
        label = "± 2 standard deviations"
        axes[3].fill_between(x, low, high, color=ORANGE, alpha=0.35, lw=0, label=label)
    axes[3].plot(x, shot.beam[shot.row] / mean, color=DARK, lw=1.3, ls="--", label="true beam")
    axes[3].set_ylim(0, 1.15 * max(limits[1], float((shot.beam / mean).max())))
    tidy(axes[3], f"Cut at y = {shot.row} px", "x (px)", "Intensity / mean")
    beams = {"this source": source, "the true beam": shot.beam}
    if name != "uniform":
        beams["a uniform source"] = UniformEstimate().source(shot.shot)
    footer = "Error of the retrieved displacement:  " + "  ·  ".join(
        f"{displacement_error(shot, beam):.0%} with {text}" for text, beam in beams.items()
    )
    save(figure, f"sources-{name}.png", footer)


def source_pictures() -> None:
    y, x = grid()
    flat = scene(np.ones(SHAPE), big_object())
    source_picture("uniform", "uniform", flat, UniformEstimate().source(flat.shot))
    setup = ProtonSetup.example().model_copy(update={"pixel_size": 4e-6})
    isotropic = IsotropicEstimate().adapt_to(setup, SHAPE)
    point = scene(isotropic.source(np.ones(SHAPE)), 0.5 * big_object())
    source_picture(
        "isotropic",
        f"isotropic, {point_distance(setup):.0f} px from the detector",
        point,
        isotropic.source(point.shot),
    )
    spot = scene(gaussian_beam(), big_object())
    source_picture("gaussian", "gaussian", spot, GaussianEstimate().source(spot.shot))
    tilted = scene(tilted_beam(), big_object())
    source_picture(
        "polynomial",
        "polynomial, degree 2",
        tilted,
        PolynomialEstimate().source(tilted.shot),
    )
    patchy = scene(patchy_beam(24), small_objects(), row=67)
    source_picture(
        "low-pass",
        "low-pass, width 10 px",
        patchy,
        LowPassEstimate(width=10).source(patchy.shot),
    )
    mask = np.hypot((y - 78) / 38, (x - 102) / 50) > 1
    uneven = scene(patchy_beam(22, seed=9), big_object())
    source = KrigedEstimate().source(uneven.shot, mask)
    error = on_pixels(kriged_prior(uneven.shot, mask))
    source_picture("kriged", "kriged", uneven, source, mask, error)


def on_pixels(prior: BeamPrior) -> FloatArray:
    """Return the standard deviation of a prior of blocks on the pixels."""
    assert prior.components is not None
    blocks = np.sqrt((prior.components.patterns**2).sum(axis=0))
    places = (np.indices(SHAPE) + 0.5) / prior.components.block - 0.5
    return np.asarray(map_coordinates(blocks, places, order=1, mode="nearest"))


def burner_sources_picture(folder: Path) -> None:
    """How far each estimate is from the beam that was really there."""
    shot = read(folder / SHOT).bin_pixels(2).image
    reference = read(folder / "Image_00000.bmp").bin_pixels(2).image
    shot, reference = shot / shot.mean(), reference / reference.mean()
    y, x = np.mgrid[: shot.shape[0], : shot.shape[1]]
    mask = ~((x > 115) & (x < 530) & (y < 200)) & ~((x > 190) & (x < 440))
    estimates = {
        "Uniform": UniformEstimate().source(shot),
        "Gaussian": GaussianEstimate().source(shot, mask),
        "Polynomial, degree 4": PolynomialEstimate(degree=4).source(shot, mask),
        "Low pass, 60 px": LowPassEstimate(width=60).source(shot),
    }
    figure, axes = page("A real beam: plume of an alcohol burner", [1, 1, 1], rows=2)
    show(axes[0], shot, "Shot", "Intensity / mean", (0.75, 1.4))
    axes[0].contour(mask, [0.5], colors=[ORANGE], linewidths=1.3)
    show(axes[1], reference, "Recorded beam", "Intensity / mean", (0.75, 1.4))
    for panel, (name, beam) in zip(axes[2:], estimates.items(), strict=True):
        miss = beam / beam.mean() / reference - 1
        title = f"{name}: {100 * miss.std():.1f} % rms"
        miss = LowPassFilter(width=2.0).filter_image(100 * miss)
        show(panel, miss, title, "Estimate - beam (% of beam)", (-15, 15), "RdBu_r")
    footer = (
        "Orange: the Gaussian and the polynomial were fitted outside of it. The low pass saw all."
    )
    save(figure, "sources-burner.png", footer)


def waves() -> tuple[FloatArray, FloatArray]:
    """Waves that fit the mirrored image, one to a row, and their wavelengths in px."""
    numbers = np.unique(np.round(np.geomspace(1, 100, 15))).astype(int)
    x = (np.arange(SHAPE[1]) + 0.5) / SHAPE[1]
    return np.cos(np.pi * numbers[:, None] * x), 2 * SHAPE[1] / numbers


def gain_panel(axes: Axes, curves: dict[str, Callable[[FloatArray], FloatArray]]) -> None:
    """Amplitude that waves keep, measured by filtering them."""
    images, wavelengths = waves()
    colors = [ORANGE, BLUE, "#2a9d5c", "#8e44ad"]
    for color, (label, apply) in zip(colors, curves.items(), strict=False):
        gains = []
        for wave in images:
            image = np.tile(wave, (4, 1))
            gains.append(float((apply(image) * image).sum() / (image**2).sum()))
        axes.semilogx(wavelengths, gains, "o-", color=color, ms=4, lw=1.5, label=label)
    axes.set_ylim(-0.05, 1.2)
    tidy(axes, "What a wave keeps", "Wavelength (px)", "Amplitude after / before")


def pass_pictures() -> None:
    shot = scene(gaussian_beam(), big_object()).shot
    noisy = np.random.default_rng(3).poisson(shot / 60).astype(float)
    smooth = LowPassFilter(width=1.5).filter_image(noisy) / noisy.mean()
    noisy = noisy / noisy.mean()
    figure, axes = page("low-pass, width 1.5 px", [1, 1, 1.15])
    show(axes[0], noisy, "Shot of 33 counts per pixel", "Intensity / mean", range_of(smooth, 0.1))
    show(axes[1], smooth, "Filtered", "Intensity / mean", range_of(smooth, 0.1))
    gain_panel(
        axes[2],
        {
            f"width {width:g} px": LowPassFilter(width=width).filter_image
            for width in (1.5, 5.0, 15.0)
        },
    )
    save(figure, "filters-low-pass.png", "Mirrored at the border, so that nothing wraps around.")

    patchy = scene(patchy_beam(24), small_objects()).shot
    patchy /= patchy.mean()
    for name, title, filtered, curves in (
        (
            "high-pass",
            "high-pass, width 10 px",
            HighPassFilter(width=10.0).filter_image(patchy),
            {
                f"width {width:g} px": HighPassFilter(width=width).filter_image
                for width in (5.0, 10.0, 30.0)
            },
        ),
        (
            "butterworth",
            "butterworth, cutoff 40 px, order 2",
            ButterworthFilter(cutoff=40.0, order=2).filter_image(patchy),
            {
                f"order {order}": ButterworthFilter(cutoff=40.0, order=order).filter_image
                for order in (1, 2, 4, 8)
            },
        ),
    ):
        figure, axes = page(title, [1, 1, 1.15])
        show(axes[0], patchy, "Shot", "Intensity / mean", range_of(patchy))
        show(axes[1], filtered, "Filtered", "Intensity / mean", range_of(patchy))
        gain_panel(axes[2], curves)
        save(figure, f"filters-{name}.png", f"Least pixel after filtering: {filtered.min():.2f}")


def background_picture() -> None:
    tilted = scene(tilted_beam(), big_object())
    shot = tilted.shot / tilted.shot.mean()
    flat = BackgroundFilter(degree=2).filter_image(shot)
    figure, axes = page("background, degree 2", [1, 1, 1.15])
    show(axes[0], shot, "Shot", "Intensity / mean", range_of(shot))
    show(axes[1], flat, "Flattened", "Intensity / mean", range_of(shot))
    for panel in axes[:2]:
        panel.axhline(20, color=ORANGE, lw=1, ls="--")
    axes[2].plot(shot[20], color="0.6", lw=1, label="shot")
    axes[2].plot(flat[20], color=ORANGE, lw=1.2, label="flattened")
    axes[2].set_ylim(0, 1.6)
    tidy(axes[2], "Cut at y = 20 px", "x (px)", "Intensity / mean")
    save(figure, "filters-background.png")


def hot_pixels_picture() -> None:
    spot = scene(gaussian_beam(), big_object())
    rng = np.random.default_rng(5)
    shot = spot.shot.copy()
    places = [tuple(rng.integers(0, SHAPE, 2)) for _ in range(60)]
    for number, place in enumerate(places):
        shot[place] = 0 if number % 3 == 0 else rng.uniform(7000, 16000)
    clean = HotPixelFilter().filter_image(shot)
    hot, dead = clean < shot, clean > shot
    broken = np.zeros(SHAPE, dtype=bool)
    broken[tuple(np.transpose(places))] = True
    mean = np.median(shot)
    figure, axes = page("hot-pixels, threshold 6", [1, 1, 1])
    limits = (0.0, float(np.percentile(spot.shot, 99.9) / mean))
    show(axes[0], shot / mean, "Shot with broken pixels", "Intensity / median", limits)
    show(axes[1], clean / mean, "Repaired", "Intensity / median", limits)
    title = f"Found: {hot.sum()} hot (red), {dead.sum()} dead (blue)"
    show(axes[2], clean / mean, title, "Intensity / median", (0, 3 * limits[1]))
    for found, color in ((hot, "#ff5a36"), (dead, "#33b5ff")):
        y, x = np.nonzero(found)
        axes[2].plot(x, y, "o", mfc="none", mec=color, ms=7, mew=1.5)
    axes[2].set(xlim=(-0.5, SHAPE[1] - 0.5), ylim=(SHAPE[0] - 0.5, -0.5))
    missed, false = (broken & ~(hot | dead)).sum(), ((hot | dead) & ~broken).sum()
    footer = (
        f"{broken.sum()} broken pixels: {missed} missed, {false} false alarms, at the two foci."
    )
    save(figure, "filters-hot-pixels.png", footer)


def burner_filters_picture(folder: Path) -> None:
    """The paper's filtering of a shadowgram, of its potential, and of both."""
    shot = read(folder / SHOT).bin_pixels(4).image
    reference = read(folder / "Image_00000.bmp").bin_pixels(4).image
    flat = BackgroundFilter(degree=4).filter_image(shot)
    raw = invert(shot).potential
    potentials = {
        "Recorded beam, unfiltered": invert(shot, source=reference).potential,
        "Uniform source, unfiltered": raw,
        "Potential high-passed": HighPassFilter(width=25.0).filter_image(raw),
        "Image flattened": invert(flat).potential,
        "Both": HighPassFilter(width=25.0).filter_image(invert(flat).potential),
    }
    figure, axes = page("Filtering a real shot without its beam", [1, 1, 1], rows=2)
    show(axes[0], shot / shot.mean(), "Shot", "Intensity / mean", (0.75, 1.4))
    for panel, (name, potential) in zip(axes[1:], potentials.items(), strict=True):
        middle = float(np.median(potential))
        shown = potential - middle
        show(panel, shown, name, "Potential (px²)", range_of(shown), "viridis")
    footer = "Each potential on its own scale. Filters: polynomial of degree 4, Gaussian of 25 px."
    save(figure, "filters-burner.png", footer)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    default = HERE.parents[1] / "shared" / "data"
    parser.add_argument("--data", type=Path, default=default)
    folder = parser.parse_args().data / "burner" / "data"
    source_pictures()
    pass_pictures()
    background_picture()
    hot_pixels_picture()
    if folder.is_dir():
        burner_sources_picture(folder)
        burner_filters_picture(folder)
    else:
        print(f"no burner shadowgrams in {folder}: their pictures stay as they are")


if __name__ == "__main__":
    main()
