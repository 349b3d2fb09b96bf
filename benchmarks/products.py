"""Products of a field against exact ones: the tables of docs/physics.md.

    python benchmarks/products.py [--only maps integrals bands] [--seeds 20] [--side 96]

The truth is written out as formulae of the toroid, ∫B dz = D (r/σ) exp(½ - r²/2σ²): neither the
package's phantoms nor its products compute it.

- integrals: flux across a line and enclosed current of the exact field, and of noise-free and noisy
  inversions
- maps: ∫j_z dz of inversions, relative L2 error over the image
- bands: share of the truth inside the band of 68 %, over seeds, for each product
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import constants

from napari_shadowinv import Inversion, ProtonSetup, invert, synthetic_image
from napari_shadowinv.analysis import (
    Contrast,
    CurrentDensity,
    EnclosedCurrent,
    Flux,
    LineProfile,
    Product,
    Region,
    analyse,
)
from napari_shadowinv.inversion.result import RetrievedField
from napari_shadowinv.inversion.variables import dataset_from_field

FloatArray = NDArray[np.float64]
SETUP = ProtonSetup.example()
SHARE = 0.68
BORDER_PX = 8  # of a map, where it depends on what is outside


@dataclass(frozen=True)
class Toroid:
    """∫B dz = D (r/σ) exp(½ - r²/2σ²), counter-clockwise as shown, in the middle of an image."""

    side: int
    peak: float  # D in T m
    sigma: float  # m

    @property
    def middle(self) -> float:
        return (self.side - 1) / 2

    @property
    def places(self) -> tuple[FloatArray, FloatArray]:
        y, x = (np.mgrid[: self.side, : self.side] - self.middle) * SETUP.object_pixel_size
        return y, x

    def field(self, y: FloatArray, x: FloatArray) -> FloatArray:
        """Return (∫B_y dz, ∫B_x dz) in T m; with y downwards, it turns from x towards -y."""
        strength = self.peak / self.sigma * np.exp(0.5 - (x**2 + y**2) / (2 * self.sigma**2))
        return np.stack([-strength * x, strength * y])

    @property
    def displacement(self) -> FloatArray:
        return SETUP.displacement_from_path_integrated_b(self.field(*self.places))

    def flux(self, path: tuple[tuple[float, float], ...]) -> float:
        """Return the flux to the right of a line in Wb: ∮ of a vector potential."""
        (y0, x0), (y1, x1) = (np.subtract(point, self.middle) for point in (path[0], path[-1]))
        pixel = SETUP.object_pixel_size

        def potential(y: float, x: float) -> float:
            square = (y**2 + x**2) * pixel**2 / (2 * self.sigma**2)
            return self.peak * self.sigma * math.exp(0.5 - square)

        return potential(y1, x1) - potential(y0, x0)

    @property
    def current_density(self) -> FloatArray:
        """Return ∫j_z dz in A/m, positive into the image."""
        y, x = self.places
        square = (x**2 + y**2) / self.sigma**2
        scale = self.peak / self.sigma / constants.mu_0
        return -scale * np.exp(0.5 - square / 2) * (2 - square)

    def current(self, center: tuple[float, float], radius: float) -> float:
        """Return the current inside a circle in A m, by a sum over rings."""
        angles = (np.arange(2000) + 0.5) * 2 * np.pi / 2000
        pixel = SETUP.object_pixel_size
        y, x = (center[0] - self.middle) * pixel, (center[1] - self.middle) * pixel
        r = radius * pixel
        by, bx = self.field(y + r * np.sin(angles), x + r * np.cos(angles))
        along = by * np.cos(angles) - bx * np.sin(angles)
        return float(along.mean() * 2 * np.pi * r / constants.mu_0)


def recorded(toroid: Toroid, counts: float, seed: int | None) -> Inversion:
    """Invert an image with some counts a pixel; without noise if there is no seed."""
    image = counts * synthetic_image(toroid.displacement)
    if seed is not None:
        image = np.random.default_rng(seed).poisson(image).astype(float)
    # Bands of all images would share the chance of their samples.
    options = {"seed": seed or 0}
    return invert(image, source=np.full(image.shape, counts), options=options)


def exact_field(toroid: Toroid) -> RetrievedField:
    """Return the exact displacement as a field of another program."""
    return RetrievedField(dataset_from_field(toroid.displacement, None, SETUP))


def integrals(arguments: argparse.Namespace) -> None:
    """Print errors of fluxes and currents."""
    toroid = Toroid(200, 97e-4, 30e-6)
    c = toroid.middle
    paths = [((c, c), (c, c + length)) for length in (10.0, 20.0, 40.0)]
    paths += [((c - 5.0, c - 20.0), (c + 30.0, c + 3.0))]
    circles = [((c, c), radius) for radius in (10.0, 20.0, 28.0)]
    circles += [((c + 8.0, c - 12.0), 25.0)]
    products: list[Product] = [Flux(path=path) for path in paths]
    products += [EnclosedCurrent(center=center, radius=radius) for center, radius in circles]
    truths = [toroid.flux(path) for path in paths]
    truths += [toroid.current(center, radius) for center, radius in circles]
    results = {
        "exact field": exact_field(toroid),
        "image without noise": recorded(toroid, 1e7, None),
        "10 % noise": recorded(toroid, 100, 0),
    }
    print(
        "| field | flux across a line, largest error | enclosed current, largest error |\n|-|-|-|"
    )
    for name, result in results.items():
        products_measured = analyse(result, products, setup=SETUP)
        values = [float(next(iter(each.quantities.values())).value) for each in products_measured]
        errors = [abs(value / truth - 1) for value, truth in zip(values, truths, strict=True)]
        split = len(paths)
        print(f"| {name} | {max(errors[:split]):.2%} | {max(errors[split:]):.2%} |", flush=True)


def maps(arguments: argparse.Namespace) -> None:
    """Print errors of the current density."""
    toroid = Toroid(200, 97e-4, 30e-6)
    print("| image | seed | smoothing (px) | ∫j_z dz, L2 | band of 68 %, r.m.s. |\n|-|-|-|-|-|")
    truth = toroid.current_density
    size = np.sqrt((truth**2).mean())
    for counts, seed in ((1e7, None), (100, 0), (100, 1), (100, 2)):
        inversion = recorded(toroid, counts, seed)
        (measured,) = analyse(inversion, CurrentDensity(), setup=SETUP)
        error = np.sqrt(((measured["density"].value - truth) ** 2).mean()) / size
        spread = np.sqrt((measured["density"].std ** 2).mean()) / size
        noise = "without noise" if seed is None else "10 % noise"
        width = measured.product.smoothing
        print(f"| {noise} | {seed} | {width:.2g} | {error:.2%} | {spread:.2%} |", flush=True)


def banded(toroid: Toroid) -> Iterator[tuple[str, Product, Callable[[], dict[str, FloatArray]]]]:
    """Yield products with functions that return their true values, by the names of variables."""
    side, c = toroid.side, toroid.middle
    (y, x), pixel = toroid.places, SETUP.object_pixel_size
    field = toroid.field(y, x)

    def profile_of(row: float) -> dict[str, FloatArray]:
        places = np.arange(0.1 * side, 0.9 * side + 0.5)
        rows = (row - c + np.array([-1.0, 0.0, 1.0]))[:, None] * pixel  # the width is 3 px
        by, bx = toroid.field(rows, (places - c)[None] * pixel).mean(axis=1)
        return {"magnitude": np.hypot(by, bx), "along": bx, "normal": by}

    for row in (c, c + 0.12 * side):
        line = LineProfile(path=((row, 0.1 * side), (row, 0.1 * side + round(0.8 * side))), width=3)
        yield "profile", line, lambda row=row: profile_of(row)
    for corner in (0.2, 0.35, 0.5):
        low, high = corner * side, (corner + 0.3) * side
        rows, columns = (np.arange(math.ceil(low), math.floor(high) + 1),) * 2
        part = field[:, rows[:, None], columns]
        length = np.hypot(*part)
        truth = {
            "mean": length.mean(), "peak": length.max(), "rms": np.sqrt((length**2).mean()),
            "mean_y": part[0].mean(), "mean_x": part[1].mean(),
            "centroid_y": (length * rows[:, None]).sum() / length.sum() * pixel,
            "centroid_x": (length * columns).sum() / length.sum() * pixel,
        }  # fmt: skip
        region = Region(rectangle=((low, low), (high, high)))
        yield "region", region, lambda truth=truth: {k: np.asarray(v) for k, v in truth.items()}
    for dy, dx in ((0.3, 0.0), (0.0, 0.2), (-0.1, 0.1), (0.1, -0.3), (0.05, 0.1)):
        path = ((c, c), (c + dy * side, c + dx * side))
        yield "flux", Flux(path=path), lambda path=path: {"flux": np.asarray(toroid.flux(path))}
    for dy, dx, r in (
        (0, 0, 0.1),
        (0, 0, 0.2),
        (0.1, 0.1, 0.1),
        (0, -0.15, 0.1),
        (-0.2, 0.1, 0.15),
    ):
        circle = (c + dy * side, c + dx * side), r * side
        product = EnclosedCurrent(center=circle[0], radius=circle[1])
        yield (
            "current",
            product,
            lambda circle=circle: {"current": np.asarray(toroid.current(*circle))},
        )
    inner = np.s_[BORDER_PX:-BORDER_PX, BORDER_PX:-BORDER_PX]
    yield "current density", CurrentDensity(), lambda: {"density": toroid.current_density[inner]}
    # µ is the r.m.s. divergence of the displacement: of j_z, in pixels.
    per_density = -constants.mu_0 * pixel / SETUP.path_integrated_b(np.array([0.0, 1.0]))[0]
    contrast = per_density * toroid.current_density[4:-4, 4:-4]
    mu = float(np.sqrt((contrast**2).mean()))
    move = toroid.displacement[:, 4:-4, 4:-4]
    size = float(np.sqrt((move**2).sum(axis=0).mean())) * pixel
    truth_of_contrast = {"mu": mu, "displacement": size, "scale": size / mu}
    yield (
        "contrast",
        Contrast(),
        lambda: {name: np.asarray(value) for name, value in truth_of_contrast.items()},
    )


def bands(arguments: argparse.Namespace) -> None:
    """Print how often bands hold the truth."""
    toroid = Toroid(arguments.side, 40e-4, 0.1 * arguments.side * SETUP.object_pixel_size)
    cases = list(banded(toroid))
    inside: dict[str, list[float]] = {}
    begun = time.perf_counter()
    for seed in range(arguments.seeds):
        inversion = recorded(toroid, arguments.counts, seed)
        measured = analyse(inversion, [case[1] for case in cases], setup=SETUP)
        for (name, _, truth_of), result in zip(cases, measured, strict=True):
            for variable, truth in truth_of().items():
                low, high = result[variable].band(SHARE)
                if variable == "density":
                    low, high = (
                        end[BORDER_PX:-BORDER_PX, BORDER_PX:-BORDER_PX] for end in (low, high)
                    )
                share = float(((low <= truth) & (truth <= high)).mean())
                inside.setdefault(f"{name}: {variable}", []).append(share)
                inside.setdefault(f"{name}, all", []).append(share)
    seconds = time.perf_counter() - begun
    print(f"{arguments.seeds} seeds, {arguments.side}² px, {arguments.counts:g} counts a pixel, "
          f"{seconds:.0f} s\n\n| product | truth in the band of 68 % |\n|-|-|")  # fmt: skip
    for name, shares in inside.items():
        print(f"| {name} | {np.mean(shares):.0%} |")


PARTS: dict[str, Callable[[argparse.Namespace], None]] = {
    "integrals": integrals,
    "maps": maps,
    "bands": bands,
}


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--only", nargs="+", choices=PARTS, default=list(PARTS))
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--side", type=int, default=96)
    parser.add_argument("--counts", type=float, default=100)
    arguments = parser.parse_args()
    for part in arguments.only:
        print(f"\n## {part}\n", flush=True)
        PARTS[part](arguments)


if __name__ == "__main__":
    main()
