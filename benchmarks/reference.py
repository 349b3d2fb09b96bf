"""The images that the benchmarks share: reference files and images made on the spot."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from napari_shadowinv import ProtonSetup, synthetic_image
from napari_shadowinv.physics.phantoms import ellipse_pair, toroid

DATA = Path(__file__).parents[2] / "shared" / "data"


@dataclass(frozen=True)
class Case:
    """An image with the displacement that made it."""

    name: str
    image: NDArray[np.float64]
    displacement: NDArray[np.float64]


def toroid_case(peak: int, noise: bool = False) -> Case:
    """The paper's toroid of `peak` MG µm: the reference file, or our own where it is absent."""
    name = f"toroid {peak}" + (" with noise" if noise else "")
    folder = DATA / "toroid"
    file = folder / f"dm{peak:03d}{'_noise' if noise else ''}.npy"
    if file.exists():
        return Case(name, np.load(file), np.load(folder / f"dm{peak:03d}_displacement.npy"))
    truth = toroid((200, 200), ProtonSetup.example(), float(peak), 30e-6).displacement
    image = synthetic_image(truth)
    if noise:
        image += 0.1 * np.random.default_rng(peak).normal(size=image.shape)
    return Case(f"{name} (own)", image, truth)


def donut_case() -> Case | None:
    """A published example with Poisson noise; None where the file is absent."""
    folder = DATA / "donut"
    if not folder.is_dir():
        return None
    return Case("donut", np.load(folder / "intensity.npy"), np.load(folder / "displacement.npy"))


def ellipses_case(shape: tuple[int, int] = (160, 240)) -> Case:
    """An off-centre, asymmetric pair of ellipses."""
    truth = ellipse_pair(shape).displacement
    return Case(f"ellipses {shape[0]}×{shape[1]}", synthetic_image(truth), truth)


def errors(found: NDArray[np.float64], true: NDArray[np.float64]) -> tuple[float, float]:
    """Peak and L2 error of a displacement field, in per cent."""
    peak = np.hypot(*found).max() / np.hypot(*true).max() - 1
    return 100 * float(peak), 100 * float(np.linalg.norm(found - true) / np.linalg.norm(true))
