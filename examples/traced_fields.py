"""Three-dimensional fields, traced, inverted, measured and compared with the truth.

    python examples/traced_fields.py [--out DIR] [--small]

Protons are traced through a laser-driven bubble, a rod of current as long as a tenth of its
distance from the source, and a cube of turbulence. Tracing assumes neither that the object is thin
nor that the deflection is a gradient, so the comparison shows what these assumptions cost.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from napari_shadowinv import ProtonSetup, analyse, invert, trace
from napari_shadowinv.inversion.result import RetrievedField
from napari_shadowinv.inversion.variables import dataset_from_field
from napari_shadowinv.physics import FieldGrid
from napari_shadowinv.physics.poisson import potential_from_displacement

parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
parser.add_argument("--out", type=Path, default=Path(), help="folder for the picture")
parser.add_argument("--small", action="store_true", help="half the pixels on each side")
options = parser.parse_args()
options.out.mkdir(parents=True, exist_ok=True)

# %% The fields, in T on a grid in m, components (z, y, x), beam along z
side = 100 if options.small else 200
setup = ProtonSetup(
    energy=14.7, source_object_distance=1e-2, object_image_distance=0.28, pixel_size=1e-3 / side
)
places = np.linspace(-6e-4, 6e-4, 97)
spacing = places[1] - places[0]
z, y, x = np.meshgrid(places, places, places, indexing="ij", sparse=True)
radius = np.hypot(y, x)


def azimuthal(profile: np.ndarray) -> np.ndarray:
    """Return a field around the beam, which grows with the distance from the axis."""
    return np.stack([0 * profile, -x * profile, y * profile])


def turbulent(seed: int) -> np.ndarray:
    """Return a curl within a ball, with E(k) ∝ k^(-5/3) from 60 to 400 µm."""
    k = 2 * np.pi * np.fft.fftfreq(len(places), spacing)
    size = np.sqrt(k[:, None, None] ** 2 + k[:, None] ** 2 + k**2)
    used = (size > 2 * np.pi / 4e-4) & (size < 2 * np.pi / 6e-5)
    noise = np.random.default_rng(seed).normal(size=(3, *size.shape))
    amplitude = used * np.where(used, size, 1.0) ** (-11 / 6 - 1)
    potential = np.fft.ifftn(amplitude * np.fft.fftn(noise, axes=(1, 2, 3)), axes=(1, 2, 3)).real
    a_z, a_y, a_x = potential * np.exp(-((np.hypot(radius, z) / 4e-4) ** 8))
    curl = np.stack(
        [
            np.gradient(a_y, axis=2) - np.gradient(a_x, axis=1),
            np.gradient(a_x, axis=0) - np.gradient(a_z, axis=2),
            np.gradient(a_z, axis=1) - np.gradient(a_y, axis=0),
        ]
    )
    inside = np.hypot(radius, z) < 3e-4
    return 3.0 * curl / np.sqrt((curl**2).sum(axis=0)[inside].mean())


shell = np.exp(-(((np.hypot(radius, z) - 2.5e-4) / 5e-5) ** 2)) * (z < 0)
rod = np.exp(-(radius**2) / (2 * 8e-5**2)) / (1 + (z / 5e-4) ** 16)
fields = {
    "bubble": azimuthal(20 / 2.5e-4 * shell),
    "rod of current": azimuthal(6 / 8e-5 * rod),
    "turbulence": turbulent(1),
}
circle = {"product": "current", "center": ((side - 1) / 2,) * 2, "radius": 0.12 * side}

# %% Each traced, with 400 protons a pixel, inverted, and compared
rows = {}
for number, (name, magnetic) in enumerate(fields.items()):
    traced = trace(FieldGrid(magnetic, spacing=(spacing,) * 3), setup, (side, side))
    mean = traced.source.mean()
    image = np.random.default_rng(number).poisson(400 * traced.image / mean).astype(float)
    inversion = invert(image, source=np.full(image.shape, 400.0))
    truth = setup.displacement_from_path_integrated_b(traced.path_integrated_b)
    exact = RetrievedField(dataset_from_field(truth, potential_from_displacement(truth), setup))
    error = np.linalg.norm(inversion.displacement - truth) / np.linalg.norm(truth)
    currents = [
        float(analyse(each, circle, setup=setup, samples=20)[0]["current"].value)
        for each in (inversion, exact)
    ]
    rows[name] = traced, image / 400, truth, inversion.displacement, error, currents
    print(
        f"{name}: field {error:.1%} off, of which thin screen {traced.thin_screen_error:.1%}; "
        f"current in a circle {currents[0]:.3g} A m, true {currents[1]:.3g} A m"
    )

# %% The picture
width = 1e3 * side * setup.object_pixel_size
extent = (0, width, width, 0)
figure = Figure(figsize=(11.5, 8.2), layout="constrained")
panels = figure.subplots(len(rows), 4)
for row, (name, (_, image, truth, moved, _, _)) in zip(panels, rows.items(), strict=True):
    true, found = (1e3 * np.hypot(*setup.path_integrated_b(each)) for each in (truth, moved))
    picture = row[0].imshow(image, cmap="gray", vmin=0, vmax=3, extent=extent)
    figure.colorbar(picture, ax=row[0], label="protons / beam", shrink=0.8, extend="max")
    row[0].set_title(f"{name[:1].upper()}{name[1:]}: traced image")
    for panel, plane, title in ((row[1], true, "True"), (row[2], found, "Retrieved")):
        picture = panel.imshow(plane, cmap="inferno", vmin=0, vmax=true.max(), extent=extent)
        panel.set_title(f"{title} |∫B dz|")
    figure.colorbar(picture, ax=row[2], label="T mm", shrink=0.8)
    line = (np.arange(side) + 0.5) * width / side
    row[3].plot(line, true[side // 2], lw=5, color="0.8", label="true")
    row[3].plot(line, found[side // 2], color="C3", label="retrieved")
    row[3].set(title="Cut", xlabel="x (mm)", ylabel="|∫B dz| (T mm)", xlim=(0, width))
    row[3].set_ylim(0, 1.3 * true.max())
    row[3].set_box_aspect(1)
    row[3].legend(frameon=False, fontsize=8, loc="upper right")
    for panel in row[:3]:
        panel.set(xlabel="x (mm)", ylabel="y (mm)")

# %% The result
figure.savefig(options.out / "traced_fields.png", dpi=130)
