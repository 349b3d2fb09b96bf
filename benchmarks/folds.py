"""How wrong the field is beyond the first caustic: one table, printed as Markdown.

    python benchmarks/folds.py [--n-sites 40000]

The images are counted rays: 400 start in each pixel, each at a random place of a cell of its own
(20 × 20), is displaced by the exact formula, and counts in the pixel where it lands. The package's
forward model is not used. Objects of 200×200 px: the paper's toroid, which drives rays apart and
folds into a ring (caustics begin at 185 MG µm); the same of the other sign, which gathers them into
a spot; a narrow toroid of twice the height, which folds on two sides only. L2: norm of the error of
the displacement against the norm of the truth. With each the share of pixels marked as caustics,
and whether the report warns of deep folds.
"""

from __future__ import annotations

import argparse

import numpy as np
from numpy.typing import NDArray

from napari_shadowinv import InversionOptions, invert

SIDE, RAYS = 200, 20
STRENGTHS = (1.0, 1.05, 1.1, 1.2, 1.34, 1.5, 2.0)
OBJECTS = {"ring": (1.0, 20.0, 20.0), "spot": (-1.0, 20.0, 20.0), "two sides": (1.0, 20.0, 10.0)}
"""Sign, and radii σ along y and x in px."""

FloatArray = NDArray[np.float64]


def displaced(
    y: FloatArray, x: FloatArray, strength: float, sign: float, tall: float, wide: float
) -> tuple[FloatArray, FloatArray]:
    """Displacement by a Gaussian potential, in units of the strength at which caustics begin.

    Along its narrow axis it is a x exp(-x²/2σ²). Its slope is least at the square root of 3 σ,
    -2 a exp(-3/2), and largest in the middle, a: rays meet at a slope of -1.
    """
    onset = np.exp(1.5) / 2 if sign > 0 else 1.0
    v, u = y - (SIDE - 1) / 2, x - (SIDE - 1) / 2
    slope = sign * strength * onset * np.exp(-((v / tall) ** 2 + (u / wide) ** 2) / 2)
    return slope * v * (wide / tall) ** 2, slope * u


def counted(strength: float, sign: float, tall: float, wide: float) -> FloatArray:
    """The image: rays counted where they land."""
    rng = np.random.default_rng(0)
    counts = np.zeros(SIDE * SIDE)
    cells = np.arange(SIDE * RAYS)
    for row in range(SIDE * RAYS):
        y = (row + rng.random(cells.size)) / RAYS - 0.5
        x = (cells + rng.random(cells.size)) / RAYS - 0.5
        dy, dx = displaced(y, x, strength, sign, tall, wide)
        rows, columns = np.rint(y + dy).astype(int), np.rint(x + dx).astype(int)
        inside = (rows >= 0) & (rows < SIDE) & (columns >= 0) & (columns < SIDE)
        counts += np.bincount(rows[inside] * SIDE + columns[inside], minlength=counts.size)
    return counts.reshape(SIDE, SIDE) / RAYS**2


def cell(strength: float, name: str, n_sites: int) -> str:
    y, x = np.indices((SIDE, SIDE)).astype(float)
    true = np.array(displaced(y, x, strength, *OBJECTS[name]))
    inversion = invert(
        counted(strength, *OBJECTS[name]),
        source=np.ones((SIDE, SIDE)),
        options=InversionOptions(n_sites=n_sites),
    )
    error = np.linalg.norm(inversion.displacement - true) / np.linalg.norm(true)
    warned = "folds" in {caution.code for caution in inversion.report.cautions}
    return f"{error:.1%}, {inversion.caustic.mean():.1%}, {'yes' if warned else 'no'}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--n-sites", type=int, default=40_000)
    n_sites = parser.parse_args().n_sites
    print(f"| strength | {' | '.join(f'{name}: L2, caustics, warned' for name in OBJECTS)} |")
    print("|---" * (len(OBJECTS) + 1) + "|")
    for strength in STRENGTHS:
        cells = [cell(strength, name, n_sites) for name in OBJECTS]
        print(f"| {strength:g} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
