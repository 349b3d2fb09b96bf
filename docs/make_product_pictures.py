"""Make the picture of docs/physics.md.

    python docs/make_product_pictures.py

A simulated toroid with 10 % noise a pixel, inverted and analysed.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from napari_shadowinv import ProtonSetup, analyse, invert, synthetic_image
from napari_shadowinv.physics.phantoms import toroid
from napari_shadowinv.plotting import products_figure, save_figure

PICTURE = Path(__file__).parent / "pictures" / "products.png"
SIDE, COUNTS = 160, 100.0
MIDDLE = (SIDE - 1) / 2


def main() -> None:
    setup = ProtonSetup.example()
    phantom = toroid((SIDE, SIDE), setup, peak=60, sigma=24e-6)
    image = np.random.default_rng(0).poisson(COUNTS * synthetic_image(phantom.displacement))
    inversion = invert(image, source=np.full(image.shape, COUNTS))
    results = analyse(
        inversion,
        [
            {"product": "profile", "path": [(MIDDLE, 10), (MIDDLE, SIDE - 11)]},
            {"product": "current", "center": (MIDDLE, MIDDLE), "radius": 16},
            {"product": "current-density"},
        ],
        setup=setup,
        unit="MG µm",
    )
    save_figure(PICTURE, products_figure(results, title="toroid, 100 counts a pixel"), True)


if __name__ == "__main__":
    main()
