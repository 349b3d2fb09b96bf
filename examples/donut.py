"""A published donut: a simulated proton radiograph with counting noise, inverted and compared.

    python examples/donut.py FOLDER [--out DIR] [--small]

FOLDER holds `intensity.npy`, counts per pixel, and `displacement.npy`, the truth in pixels. The
image was made by another code (PROBLEM): 14.7 MeV protons, 1.4 cm from source to object and
20 cm on to the detector, pixels of 10 µm at the object.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from napari_shadowinv import ProtonSetup, Recipe, poisson_invert, run, write
from napari_shadowinv.preprocessing import Bin

parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
parser.add_argument("folder", type=Path, help="folder with intensity.npy and displacement.npy")
parser.add_argument("--out", type=Path, default=Path(), help="folder for the results")
parser.add_argument("--small", action="store_true", help="sum 2×2 pixels first")
options = parser.parse_args()
options.out.mkdir(parents=True, exist_ok=True)

# %% The experiment and the image
setup = ProtonSetup(
    energy=14.7,
    source_object_distance=1.4e-2,
    object_image_distance=20e-2,
    pixel_size=10e-6,
)
truth = np.load(options.folder / "displacement.npy")
if options.small:
    truth = truth.reshape(2, 100, 2, 100, 2).mean(axis=(2, 4)) / 2

# %% The inversion, and the linear one for comparison
recipe = Recipe(steps=(Bin(factor=2),) if options.small else (), setup=setup)
inversion = run(recipe, options.folder / "intensity.npy")
setup = inversion.setup  # with the pixels of the result
linear = -np.array(np.gradient(poisson_invert(inversion.image)))

# %% The field in MG µm, and how far it is from the truth
fields = {
    "True": setup.path_integrated_b(truth, "MG um"),
    "Retrieved": setup.path_integrated_b(inversion.displacement, "MG um"),
    "Linear (Poisson)": setup.path_integrated_b(linear, "MG um"),
}
strength = {name: np.hypot(*field) for name, field in fields.items()}
errors = {
    name: float(np.linalg.norm(field - fields["True"]) / np.linalg.norm(fields["True"]))
    for name, field in fields.items()
}
for name, field in strength.items():
    print(f"{name}: peak {field.max():.1f} MG µm, error {errors[name]:.1%}")

# %% The picture
side = inversion.image.shape[0] * setup.object_pixel_size * 1e3
extent = (0, side, side, 0)
figure = Figure(figsize=(11.5, 6.6), layout="constrained")
panels = figure.subplots(2, 3)
for panel, image, title in (
    (panels[0, 0], inversion.image, "Image"),
    (panels[0, 1], inversion.reprojection, "Re-projection"),
):
    picture = panel.imshow(
        image / inversion.source.mean(), cmap="gray", vmin=0, vmax=5, extent=extent
    )
    figure.colorbar(picture, ax=panel, label="Intensity / source", extend="max", shrink=0.8)
    panel.set_title(title)
for panel, (name, field) in zip(panels[1], strength.items(), strict=True):
    picture = panel.imshow(
        field, cmap="inferno", vmin=0, vmax=strength["True"].max(), extent=extent
    )
    figure.colorbar(picture, ax=panel, label="|∫B dl| (MG µm)", shrink=0.8)
    panel.set_title(name if name == "True" else f"{name}: {errors[name]:.0%} off")
for panel in (*panels[0, :2], *panels[1]):
    panel.set(xlabel="x (mm)", ylabel="y (mm)")

cut, row = panels[0, 2], truth.shape[1] // 2
x = (np.arange(truth.shape[2]) + 0.5) * side / truth.shape[2]
styles = ({"lw": 5, "color": "0.8"}, {"color": "C3"}, {"color": "C0", "lw": 1})
for (name, field), style in zip(strength.items(), styles, strict=True):
    cut.plot(x, field[row], label=name, **style)
cut.set(title="Cut through the middle", xlabel="x (mm)", ylabel="|∫B dl| (MG µm)", xlim=(0, side))
cut.set_ylim(0, 1.55 * strength["True"].max())
cut.set_box_aspect(1)
cut.legend(frameon=False, fontsize=8, loc="upper right")

# %% Results: the picture, and everything in one file, with the recipe
figure.savefig(options.out / "donut.png", dpi=130)
write(options.out / "donut.shadowinv", inversion, overwrite=True)
