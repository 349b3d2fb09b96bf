"""Beyond caustics: a toroidal field so strong that proton rays cross before the detector.

    python examples/caustic.py [--out DIR] [--small]

The toroid of Kasim et al., arXiv:1607.04179, Section IV, at 290 MG µm, where caustics begin at
185. Where rays have crossed, one image does not tell the whole field: the inversion finds the
smoothest field that explains the image, and marks where it is less certain.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from scipy.ndimage import binary_closing, binary_dilation, gaussian_filter

from napari_shadowinv import ProtonSetup, invert, synthetic_image
from napari_shadowinv.physics import jacobian_determinant, toroid

parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
parser.add_argument("--peak", type=float, default=290.0, help="peak of ∫B dl in MG µm")
parser.add_argument("--out", type=Path, default=Path(), help="folder for the picture")
parser.add_argument("--small", action="store_true", help="half the pixels on each side")
options = parser.parse_args()
options.out.mkdir(parents=True, exist_ok=True)

# %% The true field and its image
side = 100 if options.small else 200
setup = ProtonSetup.example().model_copy(update={"pixel_size": 300e-6 / side})
truth = toroid((side, side), setup, peak=options.peak, sigma=30e-6).displacement
image = synthetic_image(truth)

# %% The inversion
inversion = invert(image, source=np.ones_like(image))
true_field, found_field = (
    np.hypot(*setup.path_integrated_b(d, "MG um")) for d in (truth, inversion.displacement)
)
folded = jacobian_determinant(truth) < 0
# Rays share their landing places with others wherever a folded part of the map lands.
y, x = np.rint(np.indices(folded.shape) + truth).astype(int).clip(0, side - 1)
shared_places = np.zeros_like(folded)
shared_places[y[folded], x[folded]] = True
shared = binary_dilation(binary_closing(shared_places, iterations=3), iterations=2)[y, x]
error = np.hypot(*(inversion.displacement - truth)) / np.hypot(*truth).max()
errors = {
    "where rays share their landing places": float(error[shared].max()) if shared.any() else 0.0,
    "elsewhere": float(error[~shared].max()),
}
rms = float(np.sqrt(np.mean(inversion.residual**2)) / image.mean())
print(f"{shared.mean():.1%} of the rays share their places, {inversion.caustic.mean():.1%} marked")
print(
    f"peak {found_field.max():.0f} instead of {true_field.max():.0f} MG µm, residual {rms:.1%} rms"
)
for where, value in errors.items():
    print(f"error of the displacement {where}: {value:.1%} of its peak")

# %% The picture
width = side * setup.object_pixel_size * 1e6
extent = (0, width, width, 0)
figure = Figure(figsize=(11.5, 6.6), layout="constrained")
panels = figure.subplots(2, 3)
for panel, plane, title in (
    (panels[0, 0], image, "Image"),
    (panels[0, 1], inversion.reprojection, "Re-projection"),
):
    picture = panel.imshow(plane, cmap="gray", vmin=0, vmax=4, extent=extent)
    figure.colorbar(picture, ax=panel, label="Intensity / source", extend="max", shrink=0.8)
    panel.set_title(title)
for panel, plane, title in (
    (panels[1, 0], true_field, "True field"),
    (panels[1, 1], found_field, "Retrieved field"),
):
    picture = panel.imshow(plane, cmap="inferno", vmin=0, vmax=true_field.max(), extent=extent)
    figure.colorbar(picture, ax=panel, label="|∫B dl| (MG µm)", shrink=0.8)
    panel.set_title(title)

certainty = panels[1, 2]
picture = certainty.imshow(100 * error, cmap="Greys", vmin=0, vmax=20, extent=extent)
figure.colorbar(
    picture, ax=certainty, label="Error (% of the peak)", shrink=0.8, ticks=range(0, 21, 5)
)
for mask, colour in ((shared, "C0"), (inversion.caustic, "C3")):
    smooth = gaussian_filter(mask.astype(float), side / 200)
    certainty.contour(smooth, [0.4], colors=colour, extent=extent, origin="upper", linewidths=1.2)
for height, colour, text in (
    (0.93, "C0", "several rays to one place"),
    (0.03, "C3", "marked as caustic"),
):
    certainty.text(
        0.5, height, text, color=colour, ha="center", fontsize=8, transform=certainty.transAxes
    )
certainty.set_title("Error of the retrieved field")
for panel in (*panels[0, :2], *panels[1]):
    panel.set(xlabel="x (µm)", ylabel="y (µm)")

cut, middle = panels[0, 2], side // 2
x = (np.arange(side) + 0.5) * setup.object_pixel_size * 1e6
cut.plot(x, true_field[middle], lw=5, color="0.8", label="True")
cut.plot(x, found_field[middle], color="C3", label="Retrieved")
cut.set(title="Cut through the middle", xlabel="x (µm)", ylabel="|∫B dl| (MG µm)", xlim=(0, width))
cut.set_ylim(0, 1.4 * true_field.max())
cut.set_box_aspect(1)
cut.legend(frameon=False, fontsize=8, loc="upper right")

# %% The result
figure.savefig(options.out / "caustic.png", dpi=130)
