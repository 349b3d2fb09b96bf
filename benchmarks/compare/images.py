"""The images of the comparison, each with the displacement that made it: `write_images`.

No image is made by a solver or by the package's forward model: rays are sent through the exact
displacement and counted, 16 to 64 a pixel, each as the rectangle that its part of the pixel
becomes (`count_rays`).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from compare import densities, fields
from compare.fields import Field

Array = NDArray[np.float64]

NOISES = (0.01, 0.03, 0.1)
GROUPS = {
    "paper": "structures of Kasim et al. (2017)",
    "hard": "peaks, voids, contrast, border, after Davies, Heuer and Bott (2023)",
    "densities": "ten classes of densities after DOTmark",
    "traced": "particles traced through 3-D fields",
    "noise": "toroid 97 with noise",
}
_RAYS = 8  # along each side of a pixel
_RAYS_OF_IMAGE = {"traced": 512}  # along each side of an image, at most; tracing takes time
_MOST_RAYS_OF_IMAGE = 2048
_BAND_RAYS = 4096 * 1024  # that are counted at a time


@dataclass(frozen=True)
class Case:
    """An image to be made: a source, a displacement, noise in parts of the mean."""

    group: str
    name: str
    size: int
    field: Field
    density: str = ""
    noise: float = 0.0

    @property
    def key(self) -> str:
        return f"{self.name} {self.size}"

    @property
    def rays(self) -> int:
        """Rays along each side of a pixel."""
        most = _RAYS_OF_IMAGE.get(self.group, _MOST_RAYS_OF_IMAGE)
        return min(_RAYS, most // self.size)

    def source(self) -> Array:
        if self.density:
            return densities.density(self.density, self.size)
        if self.name == "coaxial line":
            return fields.coaxial_source(self.size)
        return np.ones((self.size, self.size))


def count_rays(field: Field, source: Array, rays: int = _RAYS) -> Array:
    """Image of a source: rays from a fine grid, each spread over its rectangle on the detector."""
    n = source.shape[0]
    fine = field(n * rays)
    image = np.zeros(source.shape)
    rows = max(1, _BAND_RAYS // (n * rays**2))
    stretch_y, stretch_x = np.gradient(fine[0], axis=0), np.gradient(fine[1], axis=1)
    for top in range(0, n, rows):
        band = slice(top * rays, min(top + rows, n) * rays)
        y, x = fields.centres(n * rays)
        flux = np.repeat(np.repeat(source[top : top + rows], rays, 0), rays, 1) / rays**2
        places_y = (y[band] + fine[0, band] + 0.5) * n
        places_x = (x + fine[1, band] + 0.5) * n
        width_y = np.abs(1 + stretch_y[band] * n * rays) / rays
        width_x = np.abs(1 + stretch_x[band] * n * rays) / rays
        for row, share_y in _shares(places_y, width_y):
            for column, share_x in _shares(places_x, width_x):
                inside = (row >= 0) & (row < n) & (column >= 0) & (column < n)
                weights = (flux * share_y * share_x)[inside]
                index = (row * n + column)[inside]
                image += np.bincount(index, weights, minlength=n * n).reshape(n, n)
    return image


def _shares(places: Array, widths: Array) -> Iterator[tuple[NDArray[np.int64], Array]]:
    """Pixels along an axis that rectangles reach, and the share of each in them."""
    # Where the displacement jumps, neighbours are no measure of the width.
    widths = np.clip(widths, 1e-6, 1.0)
    low, high = places - widths / 2, places + widths / 2
    first = np.floor(low).astype(np.int64)
    for offset in range(int(np.ceil(widths.max())) + 1):
        pixel = first + offset
        yield pixel, np.clip(np.minimum(high, pixel + 1) - np.maximum(low, pixel), 0, None) / widths


def make_image(case: Case) -> tuple[Array, Array, Array]:
    """Source, image and true displacement in px; noise is Gaussian, negative values are cut."""
    source = case.source()
    image = count_rays(case.field, source, case.rays)
    if case.noise:
        rng = np.random.default_rng([case.size, round(1000 * case.noise)])
        image = np.maximum(image + case.noise * image.mean() * rng.normal(size=image.shape), 0)
    return source, image, case.field(case.size) * case.size


def cases(quick: bool = False) -> list[Case]:
    """All images, small ones first; `quick` leaves two of 32×32."""
    paper, toroid = fields.paper_fields(), fields.paper_fields()["toroid 97"]

    def smooth(number: int) -> Field:
        return fields.waves(seed=number, modes=3, smallest=0.4)

    if quick:
        return [
            Case("paper", "toroid 97", 32, toroid),
            Case("densities", "GRFsmooth", 32, smooth(3), "GRFsmooth"),
        ]
    chosen: list[Case] = []
    for size in (64, 128, 256, 512):
        large = size > 128
        chosen.append(Case("paper", "toroid 97", size, toroid))
        chosen += [
            Case("densities", name, size, smooth(number), name)
            for number, name in enumerate(densities.CLASSES)
        ]
        hard = {"peak 100": partial(fields.blob, strength=-0.9)} if large else fields.hard_fields()
        chosen += [Case("hard", name, size, field) for name, field in hard.items()]
        if large:
            continue
        chosen += [
            Case("noise", f"toroid 97, noise {noise:.0%}", size, toroid, noise=noise)
            for noise in NOISES
        ]
        chosen += [
            Case("paper", name, size, field) for name, field in paper.items() if name != "toroid 97"
        ]
        chosen += [
            Case("traced", name, size, field) for name, field in fields.traced_fields().items()
        ]
    return chosen


def write_images(folder: Path, chosen: list[Case]) -> None:
    """Write each image that is missing as an .npz of source, image and displacement."""
    folder.mkdir(parents=True, exist_ok=True)
    for case in chosen:
        path = folder / f"{case.key}.npz"
        if not path.exists():
            source, image, displacement = make_image(case)
            np.savez(path, source=source, image=image, displacement=displacement)
