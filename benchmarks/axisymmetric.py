"""Profiles of axisymmetric objects against exact ones: a table, printed as Markdown.

    python benchmarks/axisymmetric.py [--seeds 20]

Objects f(r) in images of 200² px with 250 counts a pixel, half as strong as one with caustics. The
truth is their formula; projections and deflections are sums along the beam.

Accuracy: L2 error of the profile inside the radius, in all slices. The hollow cylinder does not
change along its axis and has one profile.
Coverage: share of the truth inside the band of 68 %, where the profile exceeds 5 % of its largest
value.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.special import erf

from napari_shadowinv import Inversion, invert, synthetic_image
from napari_shadowinv.analysis import AxisymmetricProfile, ProductResult, analyse

Array = NDArray[np.float64]
SIDE, COUNTS = 200, 250.0
STEP_PX, DEPTH_PX, SLOPE_PX = 0.1, 160.0, 0.01
MIDDLE = (SIDE - 1) / 2

OBJECTS: dict[str, Callable[[Array, Array], Array]] = {
    "Gaussian": lambda r, s: np.exp(-(r**2 + s**2) / (2 * 20.0**2)),
    "ring": lambda r, s: np.exp(-((r - 40) ** 2 + s**2) / (2 * 16.0**2)),
    "hollow cylinder": lambda r, s: (1 + erf((r - 25) / 12)) * (1 + erf((55 - r) / 12)) / 4 + 0 * s,
}


def potential_of(profile: Callable[[Array, Array], Array]) -> Array:
    """Return ∫f dz in px² and minus its gradient in px, (3, H, W)."""
    depth = (np.arange(0.0, DEPTH_PX, STEP_PX) + STEP_PX / 2)[:, None]
    places = np.arange(SIDE) - MIDDLE

    def projection(s: Array, x: Array) -> Array:
        return 2 * STEP_PX * profile(np.hypot(x, depth), s).sum(axis=0)

    rows = []
    for s in places:
        down, up = (projection(s + step, places) for step in (-SLOPE_PX, SLOPE_PX))
        left, right = (projection(s, places + step) for step in (-SLOPE_PX, SLOPE_PX))
        rows.append(
            [projection(s, places), (down - up) / (2 * SLOPE_PX), (left - right) / (2 * SLOPE_PX)]
        )
    return np.moveaxis(np.array(rows), 0, 1)


def caustic_strength(displacement: Array) -> float:
    """Return the factor at which rays begin to cross."""
    slopes = np.array([np.gradient(part) for part in displacement])
    strength, determinant = 1e-3, 1.0
    while determinant > 0:
        strength *= 1.02
        a, b, c, d = (strength * slopes[i, k] for i in (0, 1) for k in (0, 1))
        determinant = float(((1 + a) * (1 + d) - b * c).min())
    return strength


def record(displacement: Array, seed: int) -> Inversion:
    image = np.random.default_rng(seed).poisson(COUNTS * synthetic_image(displacement))
    return invert(image, source=np.full(image.shape, COUNTS))


def measure(name: str, inversion: Inversion, samples: int) -> ProductResult:
    slices = 0.0 if name == "hollow cylinder" else 1.0
    product = AxisymmetricProfile(axis=((0.0, MIDDLE), (SIDE - 1.0, MIDDLE)), slice_width=slices)
    (result,) = analyse(inversion, product, samples=samples)
    return result


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=20)
    arguments = parser.parse_args()
    print("| object | strength over that of caustics | largest displacement, px | L2, % (median, "
          "worst) | exact displacement, % | band of 68 % holds, % |")  # fmt: skip
    print("|---|---|---|---|---|---|")
    for name, profile in OBJECTS.items():
        planes = potential_of(profile)
        potential, displacement = planes[0], planes[1:]
        limit = caustic_strength(displacement)
        for share in (0.5, 0.8):
            strength = share * limit
            moves = strength * displacement
            errors, inside = [], []
            for seed in range(arguments.seeds):
                result = measure(name, record(moves, seed), 40)
                value = result["profile"].value
                radii, along = np.arange(value.shape[-1] * 1.0), np.arange(SIDE)[:, None] - MIDDLE
                truth = strength * (profile(radii, along) if value.ndim == 2 else
                                    profile(radii, np.zeros(1)))  # fmt: skip
                errors.append(float(np.linalg.norm(value - truth) / np.linalg.norm(truth)))
                low, high = result.band("profile")
                strong = truth > 0.05 * truth.max()
                inside.append(float(((low <= truth) & (truth <= high))[strong].mean()))
            product = AxisymmetricProfile(axis=result.product.axis, smoothing=1.0,
                                          slice_width=result.product.slice_width)  # fmt: skip
            exact = product.measure(strength * potential, moves, result_frame(result))["profile"]
            of_operator = np.linalg.norm(exact - truth) / np.linalg.norm(truth)
            print(
                f"| {name} | {share} | {np.hypot(*moves).max():.1f} "
                f"| {100 * np.median(errors):.2f}, {100 * max(errors):.2f} "
                f"| {100 * of_operator:.2f} | {100 * np.mean(inside):.0f} |",
                flush=True,
            )


def result_frame(result: ProductResult):  # type: ignore[no-untyped-def]
    """Return the frame of an image without setup."""
    from napari_shadowinv.analysis import FieldFrame

    mask = np.ones((SIDE, SIDE), bool)
    return FieldFrame((SIDE, SIDE), mask, None, "", result.unit)


if __name__ == "__main__":
    main()
