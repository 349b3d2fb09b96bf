"""A night of shots: a first look, all of them, and across the shots."""

# %% [markdown]
# # A night of shots
#
# A burner's plume wanders in front of a camera: sixteen shots and one reference beam. They are
# inverted with dask into a store that survives a crash. Open this file as a
# notebook (Jupyter, VS Code and others read `# %%`), or run it: it writes into the folder `night`.

# %%
from pathlib import Path

import numpy as np
import tifffile
from distributed import Client
from matplotlib.figure import Figure

from napari_shadowinv import (
    InversionOptions,
    OpticalSetup,
    Recipe,
    Shot,
    read,
    run,
    run_stack,
    synthetic_image,
)
from napari_shadowinv.physics.phantoms import gaussian_blob
from napari_shadowinv.pipeline import RunOptions

# %% [markdown]
# ## The shots
#
# Yours are there already; these are simulated, with the grain of 2000 counts per pixel. One
# of them was lost when the disk filled up: that happens at night.

# %%
night = Path("night")
night.mkdir(exist_ok=True)
shape = (60, 80)
rng = np.random.default_rng(0)
y, x = np.indices(shape)
beam = 2000 * np.exp(-((y - 30) ** 2 + (x - 40) ** 2) / (2 * 60**2))
tifffile.imwrite(night / "reference.tif", rng.poisson(beam).astype(np.uint16))
for number in range(16):
    centre = (30 + 4 * np.sin(number / 2), 24 + 2 * number)
    plume = gaussian_blob(shape, 14 + 6 * np.sin(number), 9.0, centre)
    image = rng.poisson(synthetic_image(plume.displacement, beam))
    tifffile.imwrite(night / f"shot_{number}.tif", image.astype(np.uint16))
(night / "shot_5.tif").write_bytes(b"")

# %% [markdown]
# ## The workers
#
# Here they are threads of this process. On a large machine write `Client()`, on a cluster
# `Client("tcp://head:8786")`: nothing else changes. `distributed` comes with the extra
# `cluster` of this package; its dashboard (with bokeh installed) shows what each worker does.

# %%
client = Client(processes=False, dashboard_address="127.0.0.1:0")
port = client.scheduler_info()["services"]["dashboard"]
print(f"Dashboard: http://127.0.0.1:{port}/status")

# %% [markdown]
# ## A first look
#
# One shot alone, by the recipe that all of them will have.

# %%
setup = OpticalSetup(wavelength=532e-9, object_image_distance=0.3, pixel_size=20e-6)
recipe = Recipe(options=InversionOptions(n_sites=2000), setup=setup)
one = run(recipe, Shot(night / "shot_2.tif", source=night / "reference.tif"))
print(one.headline)

# %% [markdown]
# ## All of them, safely
#
# `run_stack` writes shot by shot. Interrupt it, kill it, pull the plug: run it again and it goes
# on. The shot that was lost fails alone, and says why.

# %%
result = run_stack(
    Shot(str(night / "shot_*.tif"), source=night / "reference.tif"),
    night / "night.shadowinv.zarr",
    recipe,
    run=RunOptions(overwrite=True),
)
for name, status in zip(result.name.values, result.status.values, strict=True):
    if status == 2:
        print("failed:", name)

# %% [markdown]
# ## Across the shots
#
# Everything stays lazy until it is drawn.

# %%
store = read(night / "night.shadowinv.zarr")
done = store.isel(shot=store.status == 1)
angles = (done.deflection_angle**2).sum("component").max(("y", "x")) ** 0.5

figure = Figure(figsize=(9, 2.8), layout="constrained")
mean, spread, peaks = figure.subplots(1, 3)
pixel = 1e3 * setup.object_pixel_size
extent = (-0.5 * pixel, (shape[1] - 0.5) * pixel, (shape[0] - 0.5) * pixel, -0.5 * pixel)
for axes, values, title in (
    (mean, done.potential_si.mean("shot"), "Mean of the shots"),
    (spread, done.potential_si.std("shot", ddof=1), "Standard deviation"),
):
    picture = axes.imshow(1e9 * values, extent=extent)
    figure.colorbar(picture, ax=axes, label="Potential (nm)", shrink=0.75)
    axes.set(title=title, xlabel="x (mm)", ylabel="y (mm)")
peaks.plot(done.shot, 1e6 * angles, "o-")
peaks.set(title="Strongest deflection", xlabel="Shot", ylabel="Angle (µrad)", ylim=(0, None))
figure.savefig(night / "night.png", dpi=120)

# %%
client.close()
