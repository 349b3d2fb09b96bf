"""Fits of rings as narrow as a few pixels: one table, printed as Markdown.

    python benchmarks/narrow.py [--seeds 5]

Two images of 64×64 px, at strengths 1 and 0.6, are counted rays: 24² start in each pixel, at the
middles of a grid, and count in the pixel where an exact formula puts them; then the counts are
drawn. The package's forward model is not used. L2: norm of the error of the displacement against
the norm of the truth. Coverage: the share of the ring's pixels whose error is below one and below
two of the fit's own standard deviations.
"""

from __future__ import annotations

import argparse

import numpy as np
from numpy.typing import NDArray

from napari_shadowinv import FitOptions, Shot, fit

SIDE, RADIUS, RAYS, AROUND = 64, 16.0, 24, 6
STRENGTHS = (1.0, 0.6)
RINGS = ((3.5, 3.0), (5.0, 4.0), (7.0, 5.0))
"""Full width at half maximum, and largest displacement, px."""
COUNTS = (10_000, 1_000, 300)

FloatArray = NDArray[np.float64]


def outward(y: FloatArray, x: FloatArray, width: float, most: float) -> FloatArray:
    """Displacement away from the middle by a Gaussian ring."""
    v, u = y - (SIDE - 1) / 2, x - (SIDE - 1) / 2
    radius = np.hypot(v, u) + 1e-12
    return (
        most * np.exp(-4 * np.log(2) * ((radius - RADIUS) / width) ** 2) * np.array([v, u]) / radius
    )


def counted(strength: float, width: float, most: float) -> FloatArray:
    """The image of an even beam of 1 a pixel."""
    line = (np.arange((SIDE + 2 * AROUND) * RAYS) + 0.5) / RAYS - 0.5 - AROUND
    flux = np.zeros(SIDE * SIDE)
    for y in line:
        away = outward(np.full(line.size, y), line, width, most)
        rows, columns = np.rint(np.array([np.full(line.size, y), line]) + strength * away).astype(
            int
        )
        inside = (rows >= 0) & (rows < SIDE) & (columns >= 0) & (columns < SIDE)
        flux += np.bincount(rows[inside] * SIDE + columns[inside], minlength=flux.size)
    return flux.reshape(SIDE, SIDE) / RAYS**2


def row(width: float, most: float, counts: int, seeds: int) -> str:
    y, x = np.indices((SIDE, SIDE), dtype=float)
    truth = outward(y, x, width, most)
    on_ring = np.hypot(*truth) > 0.05 * most
    planes = [counted(strength, width, most) for strength in STRENGTHS]
    source = np.full((SIDE, SIDE), float(counts))
    l2, covered, verdicts = [], [], []
    for seed in range(seeds):
        rng = np.random.default_rng(seed)
        shots = [
            Shot(
                rng.poisson(counts * plane).astype(float),
                source=source,
                strength=s,
                noise="poisson",
            )
            for plane, s in zip(planes, STRENGTHS, strict=True)
        ]
        result = fit(shots, options=FitOptions(seed=seed))
        field = result.fields[0]
        error = field.displacement - truth
        l2.append(100 * np.linalg.norm(error) / np.linalg.norm(truth))
        deviations = np.abs(error / field.errors.per_pixel)[:, on_ring]
        covered.append([(deviations < limit).mean() for limit in (1, 2)])
        verdicts.append(result.verdict.value)
    one, two = np.mean(covered, axis=0)
    return (
        f"| {width:g} | {most:g} | {counts:,} | {np.median(l2):.2f} | {one:.2f} / {two:.2f} "
        f"| {', '.join(sorted(set(verdicts)))} |"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=5)
    seeds = parser.parse_args().seeds
    print("| width, px | displacement, px | counts a pixel | L2, % | coverage | verdict |")
    print("|---|---|---|---|---|---|")
    for counts in COUNTS:
        for width, most in RINGS:
            print(row(width, most, counts, seeds), flush=True)


if __name__ == "__main__":
    main()
