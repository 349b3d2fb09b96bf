"""Errors of fields by the estimate of the source: the table of docs/sources.md.

    python benchmarks/sources.py [--seeds 6] [--side 96]

Each image is counted rays (`counted` of `fit.py`; the package's forward model is not used) of an
object in the middle of a beam that varies smoothly by 5 % (r.m.s.) over a quarter or half of the
image, with the noise of 1,000 counts a pixel. The rows are the objects and estimates, with a mask
of the object where there is one, the columns the median error of the displacement, how much of the
object the field retains (1 is right), and for predictions the r.m.s. ratio of the error to the
total of the budget.
"""

from __future__ import annotations

import argparse
import time

import numpy as np

from fit import Field
from instrument import Shot, objects
from napari_shadowinv import Recipe
from napari_shadowinv.pipeline import run
from napari_shadowinv.shot import Shot as Radiograph

METHODS = {
    "uniform": ({"method": "uniform"}, False),
    "fitted Gaussian, mask": ({"method": "gaussian"}, True),
    "polynomial, degree 2": ({"method": "polynomial"}, False),
    "polynomial, degree 2, mask": ({"method": "polynomial"}, True),
    "polynomial, degree 6": ({"method": "polynomial", "degree": 6}, False),
    "polynomial, degree 6, mask": ({"method": "polynomial", "degree": 6}, True),
    "kriged, mask": ({"method": "kriged"}, True),
}
OBJECTS = ("weak ring", "ring", "focus", "filament")


def in_middle(displaced: Field, side: int) -> Field:
    """Return an object of half the side in the middle of an image."""
    shift = side / 4
    return lambda y, x: displaced(y - shift, x - shift)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=6)
    parser.add_argument("--side", type=int, default=128)
    choices = parser.parse_args()
    side = choices.side
    y, x = np.indices((side, side), dtype=np.float64)
    for name in OBJECTS:
        displaced = in_middle(objects(side // 2)[name], side)
        true = np.array(displaced(y, x))
        size = np.sqrt((true**2).sum(axis=0).mean())
        bare = np.hypot(*true) < 0.005 * np.hypot(*true).max()
        rows: dict[str, list[tuple[float, float, float, float]]] = {key: [] for key in METHODS}
        for seed in range(choices.seeds):
            shot = Shot(side, displaced, seed)
            wave = shot.waves((0.25, 0.5)[seed % 2])
            shot.beam = lambda y, x, wave=wave: np.exp(0.05 * wave(y, x))
            image = shot.image()
            for key, (source, masked) in METHODS.items():
                recipe = Recipe(source=source, options={"n_sites": 3000})
                start = time.perf_counter()
                try:
                    radiograph = Radiograph(image, source_mask=bare if masked else None)
                    result = run(recipe, radiograph)
                except ValueError as error:
                    print(f"{name}, {key}: {error}")
                    continue
                seconds = time.perf_counter() - start
                error = np.sqrt(((result.displacement - true) ** 2).sum(axis=0).mean())
                kept = (result.displacement * true).sum() / (true**2).sum()
                total = result.errors.total.rms
                rows[key].append((error / size, kept, error / total, seconds))
        print(f"\n{name}: {1 - bare.mean():.0%} of the image")
        for key, values in rows.items():
            if values:
                table = np.array(values)
                ratio = np.sqrt((table[:, 2] ** 2).mean())
                worst = table[:, 0].max()
                middle = np.median(table, axis=0)
                print(
                    f"| {key} | {middle[0]:.0%} | {worst:.0%} | {middle[1]:.2f} | {ratio:.2f} | "
                    f"{middle[3]:.1f} s | {len(values)}",
                    flush=True,
                )


if __name__ == "__main__":
    main()
