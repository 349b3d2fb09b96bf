"""Eleven real shadowgrams of a burner's plume, inverted with their reference, on one strip.

    python examples/burner_strip.py FOLDER [--out DIR] [--small]

FOLDER holds `Image_00000.bmp`, the beam without the plume, and the frames `Image_2024….bmp`, whose
names end with the time in ms (doi:10.1016/j.expthermflusci.2025.111562). Nothing is known of
distances, pixel and wavelength, so results are in pixels.
"""

from __future__ import annotations

import argparse
from datetime import datetime
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from napari_shadowinv import InversionOptions, invert, read
from napari_shadowinv.inversion import plan_sites

parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
parser.add_argument("folder", type=Path, help="folder with the frames and Image_00000.bmp")
parser.add_argument("--out", type=Path, default=Path(), help="folder for the picture")
parser.add_argument("--small", action="store_true", help="sum 8×8 pixels, not 2×2")
options = parser.parse_args()
options.out.mkdir(parents=True, exist_ok=True)

# %% The frames and the undisturbed beam, with 2×2 pixels summed
factor = 8 if options.small else 2
reference = read(options.folder / "Image_00000.bmp").bin_pixels(factor).image
files = sorted(options.folder.glob("Image_2*.bmp"))
frames = [read(file).bin_pixels(factor).image for file in files]
times = [datetime.strptime(file.stem[6:], "%Y%m%d%H%M%S%f") for file in files]
seconds = [(time - times[0]).total_seconds() for time in times]

# %% The inversions; the sites are spread over the reference once for all of them
plan = plan_sites(reference, InversionOptions())
inversions = []
for file, frame in zip(files, frames, strict=True):
    inversions.append(invert(frame, plan=plan))
    report = inversions[-1].report
    print(f"{file.name}: converged {report.converged} in {sum(report.seconds.values()):.1f} s")

# %% Displacements in pixels of the camera, and how well they explain the frames
strengths = [factor * np.hypot(*inversion.displacement) for inversion in inversions]
modulation = [float(np.std(inv.image / inv.source)) for inv in inversions]
unexplained = [float(np.std(inv.residual / inv.source)) for inv in inversions]
for time, strength, before, after in zip(seconds, strengths, modulation, unexplained, strict=True):
    print(f"{time:.3f} s: up to {strength.max():.1f} px; modulation {before:.1%} → {after:.1%}")

# %% The strip: the plume only, all frames on the same two scales
height, width = reference.shape
part = (slice(None), slice(round(0.19 * width), round(0.93 * width)))
extent = (factor * part[1].start, factor * part[1].stop, factor * height, 0)
largest = float(np.percentile(strengths, 99.9))
figure = Figure(figsize=(15, 3.5), layout="constrained")
panels = figure.subplots(2, len(frames))
for column, (time, inversion, strength) in enumerate(
    zip(seconds, inversions, strengths, strict=True)
):
    top, bottom = panels[:, column]
    relative = (inversion.image / inversion.source)[part]
    light = top.imshow(relative, cmap="gray", vmin=0.6, vmax=1.6, extent=extent)
    field = bottom.imshow(strength[part], cmap="inferno", vmin=0, vmax=largest, extent=extent)
    top.set_title(f"{time:.2f} s")
    for panel in (top, bottom):
        panel.set(xticks=[], yticks=[])
figure.colorbar(
    light, ax=list(panels[0]), label="Frame / ref.", ticks=[0.6, 1, 1.4], extend="both", pad=0.008
)
figure.colorbar(
    field, ax=list(panels[1]), label="|d| (px)", ticks=range(9), extend="max", pad=0.008
)
for panel in panels[:, 0]:
    left, low = extent[0] + 40, extent[2] - 40
    panel.plot([left, left + 200], [low, low], color="white", lw=3)
    panel.text(left, low - 25, "200 px", color="white", va="bottom", fontsize=8)

for row, label in ((0, "Image / reference"), (1, "Displacement |d|")):
    panels[row, 0].set_ylabel(label)

# %% The result
figure.savefig(options.out / "burner_strip.png", dpi=110)
