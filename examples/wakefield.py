"""A plasma wave seen from the side by a short light pulse: from its shadowgram to its density.

    python examples/wakefield.py [--out DIR] [--small]

A simulated wake as in Kasim et al., arXiv:1607.04179, Section V: 810 nm light, plasma of
1.65e19 electrons per cm³. The image shows curvature of the refractive index; the inversion gives
the integral of the density modulation along the light, ∫Δn/n₀ dz.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from napari_shadowinv import OpticalSetup, invert, synthetic_image
from napari_shadowinv.physics.phantoms import plasma_wavelength, wakefield
from napari_shadowinv.preprocessing import filters

parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
parser.add_argument("--out", type=Path, default=Path(), help="folder for the picture")
parser.add_argument("--small", action="store_true", help="half the pixels on each side")
options = parser.parse_args()
options.out.mkdir(parents=True, exist_ok=True)

# %% The wave and its image, with the noise of 2000 counts per pixel
density = 1.65e25  # electrons per m³
factor = 2 if options.small else 1
setup = OpticalSetup.example()
setup = setup.model_copy(update={"pixel_size": setup.object_pixel_size * factor})
shape = (200 // factor, 360 // factor)
wave = wakefield(shape, setup, density=density)
counts = 2000.0 * factor**2
image = np.random.default_rng(0).poisson(counts * synthetic_image(wave.displacement))

# %% The inversion, and from its potential the density
inversion = invert(image, source=np.full(shape, counts))
retrieved = setup.relative_density_modulation(inversion.potential, density)
true = setup.relative_density_modulation(wave.potential, density)
# An inversion amplifies the slowest part of the noise; the wave is 33 pixels long, so what is much
# longer can be taken away from the potential.
found = retrieved - filters.LowPassFilter(width=40 / factor).filter_image(retrieved)
raw_error, error = (
    float(np.linalg.norm(plane - plane.mean() - true) / np.linalg.norm(true))
    for plane in (retrieved, found)
)
print(f"∫Δn/n₀ dz from {1e6 * found.min():.1f} to {1e6 * found.max():.1f} µm")
print(f"error {error:.1%}, without the high pass {raw_error:.1%}")

# %% The wavelength of the wave on its axis, from the spectrum of the middle rows
middle = found[shape[0] // 2 - 4 // factor : shape[0] // 2 + 4 // factor].mean(axis=0)
padded = 16 * shape[1]
spectrum = np.abs(np.fft.rfft(middle * np.hanning(shape[1]), padded))
frequency = np.fft.rfftfreq(padded, setup.object_pixel_size)
wavelength = 1 / frequency[1:][spectrum[1:].argmax()]
print(
    f"wavelength {1e6 * wavelength:.2f} µm, of the plasma {1e6 * plasma_wavelength(density):.2f} µm"
)

# %% The picture, in µm
pixel = setup.object_pixel_size * 1e6
extent = (0, shape[1] * pixel, shape[0] * pixel, 0)
largest = 1e6 * np.abs(true).max()
figure = Figure(figsize=(11, 6.2), layout="constrained")
panels = figure.subplots(2, 2)
picture = panels[0, 0].imshow(image / counts, cmap="gray", vmin=0.3, vmax=2.2, extent=extent)
figure.colorbar(picture, ax=panels[0, 0], label="Intensity / source", extend="both", shrink=0.8)
panels[0, 0].set_title("Image, 2000 counts per pixel")
for panel, plane, title in (
    (panels[0, 1], true, "True density modulation"),
    (panels[1, 0], found, f"Retrieved, {error:.0%} off"),
):
    picture = panel.imshow(1e6 * plane, cmap="RdBu_r", vmin=-largest, vmax=largest, extent=extent)
    figure.colorbar(picture, ax=panel, label="∫Δn/n₀ dz (µm)", shrink=0.8)
    panel.set_title(title)
for panel in panels.ravel()[:3]:
    panel.set(xlabel="x (µm)", ylabel="y (µm)")
cut, axis = panels[1, 1], shape[0] // 2
x = (np.arange(shape[1]) + 0.5) * pixel
cut.plot(x, 1e6 * true[axis], lw=5, color="0.8", label="True")
cut.plot(x, 1e6 * found[axis], color="C3", label="Retrieved")
raw = retrieved[axis] - retrieved.mean()
cut.plot(x, 1e6 * raw, color="C0", lw=1, ls="--", label="without the high pass")
cut.set(title="On the axis", xlabel="x (µm)", ylabel="∫Δn/n₀ dz (µm)", xlim=(0, x[-1]))
cut.set_ylim(-1.2 * largest, 1.6 * largest)
cut.legend(frameon=False, ncols=3, loc="upper center", fontsize=8)

# %% The result
figure.savefig(options.out / "wakefield.png", dpi=120)
