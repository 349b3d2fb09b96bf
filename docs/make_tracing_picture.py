"""Make the picture of docs/tracing.md.

    python docs/make_tracing_picture.py

A laser-driven bubble with an azimuthal field in its shell is traced face-on, and its image
inverted.
"""

from __future__ import annotations

import numpy as np
from _drawing import DARK, ORANGE, save, show, tidy
from matplotlib.figure import Figure

from napari_shadowinv import ProtonSetup, invert, trace
from napari_shadowinv.physics import FieldGrid

SETUP = ProtonSetup(
    energy=14.7, source_object_distance=1e-2, object_image_distance=0.28, pixel_size=5e-6
)
SIDE = 1e-3
NODES = 129


def bubble(peak: float) -> FieldGrid:
    """An azimuthal field in a thin hemispherical shell, its peak in T."""
    places = np.linspace(-SIDE / 2, SIDE / 2, NODES)
    z, y, x = np.meshgrid(places, places, places, indexing="ij")
    z = z + SIDE / 4
    radius, width = 0.3 * SIDE, 0.05 * SIDE
    distance = np.sqrt(x**2 + y**2 + z**2) + 1e-12
    shell = np.exp(-((distance - radius) ** 2) / (2 * width**2)) / distance
    shell *= peak * 0.5 * (1 + np.tanh(z / width))
    return FieldGrid(np.stack([0 * x, -x * shell, y * shell]), spacing=(SIDE / (NODES - 1),) * 3)


def main() -> None:
    field = bubble(20.0)
    traced = trace(field, SETUP)
    retrieved = 1e3 * SETUP.path_integrated_b(invert(traced.image).displacement)
    truth = 1e3 * traced.path_integrated_b
    figure = Figure(figsize=(13, 8), layout="constrained")
    axes = figure.subplots(2, 2).ravel()
    cut = np.hypot(field.magnetic[1], field.magnetic[2])[:, NODES // 2]
    # Arrays of the grid have the beam down; the cut shows it from left to right.
    show(axes[0], cut.T, "|B| in the plane of the beam", "|B| (T)", (0, float(cut.max())), "magma")
    axes[0].set(xlabel="z, along the beam (cells)", ylabel="x (cells)")
    bright = float(np.percentile(traced.image, 99.8))
    show(axes[1], traced.image, "Traced image", "Fluence", (0, bright))
    limits = (0.0, float(np.hypot(*truth).max()))
    show(axes[2], np.hypot(*retrieved), "Retrieved |∫B×dz|", "T mm", limits, "magma")
    row = traced.image.shape[0] // 2
    axes[3].plot(retrieved[0, row], color=ORANGE, label="retrieved by `invert`".replace("`", ""))
    axes[3].plot(truth[0, row], color=DARK, ls="--", label="line integral of the grid")
    axes[3].legend(frameon=False)
    tidy(axes[3], "Cut through the middle", "x (px)", "∫B$_y$ dz (T mm)", 0.8)
    save(figure, "tracing.png")


if __name__ == "__main__":
    main()
