"""Real radiochromic film: five layers of one laser-proton shot, from scan to dose to deflection.

    python examples/rcf_layers.py FOLDER [--out DIR] [--small]

FOLDER holds the scans `RCF_18H.tif` to `RCF_18L.tif` (16 bits, 300 dpi), unexposed film
`HDV2.tif` and the dose calibration `HDV2_3_calibration.csv`.

What cannot be known from this. the beam without the object was not recorded: it is estimated
by blurring the dose, so structures wider than the blur are lost, and the guess decides the
strength of the rest. A layer stops protons of one nominal energy, but faster ones leave dose in
it, too, and each energy is deflected by another angle. Distances were not told, so displacements
are in pixels of the film. The film's edge cuts the beam, and flux that crosses the edge is
taken for a deflection: trust nothing near the rim. Film saturates: beyond the doses that were
calibrated, the pixels only say "more".
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import tifffile
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from napari_shadowinv import InversionOptions, Shot, invert
from napari_shadowinv.film import Calibration, dose
from napari_shadowinv.preprocessing import LowPassEstimate

parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
parser.add_argument("folder", type=Path, help="folder with the scans and the calibration")
parser.add_argument("--out", type=Path, default=Path(), help="folder for the picture")
parser.add_argument("--small", action="store_true", help="sum 5×5 pixels, not 2×2")
options = parser.parse_args()
options.out.mkdir(parents=True, exist_ok=True)

# %% Layers: nominal energy in MeV, and the corner (y, x) of the same part of each film, clear of
# its edges and of the handwriting
LAYERS = {
    "H": (26.7, 160, 170),
    "I": (31.9, 190, 70),
    "J": (36.6, 180, 125),
    "K": (40.8, 195, 90),
    "L": (44.8, 190, 150),
}
HEIGHT, WIDTH = 190, 500
factor = 5 if options.small else 2

# %% From the scan to the dose, on the part of the table that was measured, not extrapolated
calibration = Calibration.from_csv(
    options.folder / "HDV2_3_calibration.csv", dose_range=(0.0, 2000.0)
)
unexposed = tifffile.imread(options.folder / "HDV2.tif")
doses, outside = {}, {}
for layer, (energy, top, left) in LAYERS.items():
    scan = tifffile.imread(options.folder / f"RCF_18{layer}.tif")
    scan = scan[top : top + HEIGHT, left : left + WIDTH]
    found = dose(scan, calibration, background=unexposed)
    doses[layer] = Shot(found.dose).bin_pixels(factor).image / factor**2
    outside[layer] = float(found.outside.mean())
    print(
        f"{layer}, {energy} MeV: {doses[layer].min():.1f} to {doses[layer].max():.0f} Gy, "
        f"{outside[layer]:.1%} of the pixels beyond the calibration"
    )

# %% A guess of the beam, and the deflection that explains the rest
blur = 30 / factor  # 30 px of the film, 2.5 mm
sources = {layer: LowPassEstimate(width=blur).source(image) for layer, image in doses.items()}
inversions = {
    layer: invert(
        image,
        source=sources[layer],
        options=InversionOptions(floor=1e-2),
        measured=False,  # a guess
    )
    for layer, image in doses.items()
}
strengths = {
    layer: factor * np.hypot(*inversion.displacement) for layer, inversion in inversions.items()
}
for layer, inversion in inversions.items():
    print(f"{layer}: converged {inversion.report.converged}, up to {strengths[layer].max():.1f} px")

# %% The picture: a column for each layer, one scale for each row
figure = Figure(figsize=(15, 4.1), layout="constrained")
panels = figure.subplots(3, len(LAYERS))
extent = (0, WIDTH * 25.4 / 300, HEIGHT * 25.4 / 300, 0)  # mm at the film
dark = max(image.max() for image in doses.values())
largest = float(np.percentile(list(strengths.values()), 99.5))
for column, (layer, (energy, *_)) in enumerate(LAYERS.items()):
    norm = LogNorm(1, dark)
    film = panels[0, column].imshow(doses[layer], cmap="magma", norm=norm, extent=extent)
    panels[1, column].imshow(sources[layer], cmap="magma", norm=norm, extent=extent)
    field = panels[2, column].imshow(
        strengths[layer], cmap="viridis", vmin=0, vmax=largest, extent=extent
    )
    panels[0, column].set_title(f"Layer {layer}, {energy} MeV")
    panels[2, column].set_xlabel("x (mm)")
    for panel in panels[:2, column]:
        panel.set_xticklabels([])
    if column:
        for panel in panels[:, column]:
            panel.set_yticklabels([])
for panel, label in zip(panels[:, 0], ("Dose", "Guessed beam", "Displacement"), strict=True):
    panel.set_ylabel(f"{label}\ny (mm)")
figure.colorbar(film, ax=list(panels[:2].ravel()), label="Dose (Gy)", pad=0.005, aspect=30)
figure.colorbar(
    field,
    ax=list(panels[2]),
    label="px of the film",
    ticks=range(0, 90, 5),
    extend="max",
    pad=0.005,
    aspect=15,
)

# %% The result
figure.savefig(options.out / "rcf_layers.png", dpi=110)
