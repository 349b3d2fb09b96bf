"""Invert a radiograph of 14.7 MeV protons, predict that of 3 MeV protons, and compare.

    python examples/project_other_energy.py [--out DIR] [--small]

A capsule of deuterium and helium-3 sends out protons of both energies at the same time. What
both radiographs have in common is the line-integrated field of the object: a magnetic one deflects
by charge over momentum, an electric one by charge over momentum times velocity. So the
prediction tells which of the two it was. Here it is magnetic, and its exact image is known.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from napari_shadowinv import ProtonSetup, invert, synthetic_image, write
from napari_shadowinv.physics import predict_image, toroid

parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
parser.add_argument("--out", type=Path, default=Path(), help="folder for the results")
parser.add_argument("--small", action="store_true", help="half the pixels on each side")
options = parser.parse_args()
options.out.mkdir(parents=True, exist_ok=True)

# %% One geometry, two energies, and detectors with different pixels
side = 100 if options.small else 200
fast = ProtonSetup(
    energy=14.7, source_object_distance=1e-2, object_image_distance=0.28, pixel_size=2e-3 / side
)
slow = fast.model_copy(update={"energy": 3.0, "pixel_size": 2.5e-3 / side})
print(f"momenta {fast.momentum / slow.momentum:.4f} to 1")

# %% What is measured: the image at 14.7 MeV, with 1000 protons per pixel
field = {"peak": 150.0, "sigma": 240e-6}  # MG µm and m
protons = 1000.0 * (200 / side) ** 2
exact_fast = synthetic_image(toroid((side, side), fast, **field).displacement)
measured = np.random.default_rng(0).poisson(protons * exact_fast)

# %% Its inversion, and what that predicts for 3 MeV
inversion = invert(measured, source=np.full((side, side), protons))
predicted = predict_image(inversion.displacement, fast, slow)
electric = predict_image(inversion.displacement, fast, slow, deflector="electric field")

# %% The exact image at 3 MeV
exact = synthetic_image(toroid(predicted.shape, slow, **field).displacement)
errors = {
    name: float(np.linalg.norm(image - exact) / np.linalg.norm(exact - 1))
    for name, image in (("magnetic", predicted), ("electric", electric))
}
for name, error in errors.items():
    print(f"predicted as {name}: {error:.1%} of the modulation is wrong")

# %% The picture
width = 1e3 * side * fast.object_pixel_size
extent = (0, width, width, 0)
figure = Figure(figsize=(10.5, 6.6), layout="constrained")
panels = figure.subplot_mosaic([["a", "b", "c"], ["cut", "cut", "cut"]], height_ratios=[1.45, 1])
for panel, image, title in (
    (panels["a"], measured / protons, "Measured, 14.7 MeV"),
    (panels["b"], predicted, "Predicted from it, 3 MeV"),
    (panels["c"], exact, "Exact, 3 MeV"),
):
    picture = panel.imshow(image, cmap="gray", vmin=0, vmax=3, extent=extent)
    panel.set(title=title, xlabel="x (mm)", ylabel="y (mm)")
images = [panels[name] for name in "abc"]
figure.colorbar(picture, ax=images, label="Intensity / source", extend="max", shrink=0.85)
cut, row = panels["cut"], len(exact) // 2
x = (np.arange(len(exact)) + 0.5) * 1e3 * slow.object_pixel_size
cut.plot(x, exact[row], lw=5, color="0.8", label="Exact")
cut.plot(x, predicted[row], color="C3", label="Predicted, magnetic")
cut.plot(x, electric[row], color="C0", lw=1.2, ls="--", label="Predicted, if it were electric")
cut.set(title="Cut through the middle at 3 MeV", xlabel="x (mm)", ylabel="Intensity / source")
cut.set(xlim=(0, width), ylim=(0, 1.1 * exact[row].max()))
cut.legend(frameon=False, loc="upper center")

# %% Results: the picture, and what the command line needs to do the same
figure.savefig(options.out / "project_other_energy.png", dpi=130)
write(options.out / "14.7MeV.shadowinv", inversion, setup=fast, overwrite=True)
slow_toml = "".join(f"{name} = {value!r}\n" for name, value in slow.model_dump().items())
(options.out / "3MeV.toml").write_text(slow_toml.replace("'", '"'), encoding="utf-8")
