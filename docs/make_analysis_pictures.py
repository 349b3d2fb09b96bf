"""Make the pictures of products: the burner's profile, turbulence, a toroid's integrals.

    python docs/make_analysis_pictures.py [BURNER]

BURNER is the folder with the frames of the burner (doi:10.1016/j.expthermflusci.2025.111562); its
picture is left out without it. The numbers of the tutorial on the flame are printed.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from _drawing import BLUE, DARK, ORANGE, FloatArray, save, show, tidy
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Rectangle

from napari_shadowinv import (
    InversionOptions,
    OpticalSetup,
    ProtonSetup,
    analyse,
    invert,
    read,
    synthetic_image,
)
from napari_shadowinv.analysis.power_spectra import random_displacement, ring_spectrum
from napari_shadowinv.inversion import plan_sites
from napari_shadowinv.inversion.error_bars import Quantity
from napari_shadowinv.inversion.result import RetrievedField
from napari_shadowinv.inversion.variables import dataset_from_field
from napari_shadowinv.physics.phantoms import toroid
from napari_shadowinv.plotting import make_logarithmic

BINNED = 8
T_DRAWS = 50  # of Student's t, for each sample by the images
# Assumed: the distances of the burner were not published.
PIXEL_M, DISTANCE_M = 0.1e-3, 1.0
AIR = {"gladstone_dale": 2.26e-4, "ambient_density": 1.20, "ambient_temperature": 293.0}


def mean_of_frames(frames: Sequence[FloatArray], errors: Sequence[FloatArray]) -> Quantity:
    """Return the mean of frames, with samples of its error.

    The frames scatter about their mean, which is uncertain by Student's t. Errors by the images
    count as shared by all frames, as the reference's are.

    Parameters
    ----------
    frames : sequence of ndarray
        A profile for each frame.
    errors : sequence of ndarray, shape (samples, ...)
        Samples of the profile of each frame by errors of the images.
    """
    count, rng = len(frames), np.random.default_rng(0)
    mean, scatter = np.mean(frames, axis=0), np.std(frames, axis=0, ddof=1)
    by_images = np.repeat(np.mean(errors, axis=0), T_DRAWS, axis=0)
    draws = rng.standard_t(count - 1, (len(by_images), *np.ones(mean.ndim, int)))
    return Quantity(mean, by_images + draws * scatter / np.sqrt(count))


def burner_profile(folder: Path) -> None:
    """Draw the profiles of the mean of all frames, with their bands."""
    setup = OpticalSetup(
        wavelength=532e-9, object_image_distance=DISTANCE_M, pixel_size=BINNED * PIXEL_M
    )
    reference = read(folder / "Image_00000.bmp").bin_pixels(BINNED).image
    plan = plan_sites(reference, InversionOptions(n_sites=reference.size))
    frames = [read(file).bin_pixels(BINNED).image for file in sorted(folder.glob("Image_2*.bmp"))]
    fields = [invert(frame, plan=plan, options=InversionOptions(n_sites=reference.size))
              for frame in frames]  # fmt: skip
    displacement = np.mean([field.displacement for field in fields], axis=0)
    potential = np.mean([field.potential for field in fields], axis=0)
    mean = RetrievedField(dataset_from_field(displacement, potential, setup))
    product = {"product": "axisymmetric", "slice_width": 15, **AIR}
    (profile,) = analyse(mean, product, setup=setup)
    for fact in profile.facts:
        print(f"{fact.title}: {fact.text}")
    # The axis and the smoothing of the mean, so that the mean of the profiles is its profile.
    of_frames = [analyse(field, profile.product, setup=setup)[0]["density"] for field in fields]
    density = mean_of_frames(
        [each.value for each in of_frames], [each.samples for each in of_frames]
    )
    figure = Figure(figsize=(11, 3.7), layout="constrained")
    left, middle, right = figure.subplots(1, 3)
    strength = BINNED * np.hypot(*displacement)
    top = float(np.percentile(strength, 99.8))
    show(
        left,
        strength,
        f"Mean of {len(fields)} frames",
        "displacement (camera px)",
        (0, top),
        "inferno",
    )
    (y0, x0), (y1, x1) = profile.product.axis
    left.plot([x0, x1], [y0, y1], color="white", lw=1)
    radius = 1e3 * profile.coordinates["radius"].values
    along = 1e3 * profile.coordinates["along"].values
    heated = AIR["ambient_density"] * AIR["ambient_temperature"]  # of an ideal gas: T ρ
    for axes, name, label in (
        (middle, "density", "density (kg/m³)"),
        (right, "temperature", "temperature (K)"),
    ):
        for number, colour in ((1, BLUE), (len(along) // 2, ORANGE), (len(along) - 2, DARK)):
            curve = profile[name].value[number]
            axes.plot(radius, curve, color=colour, label=f"{along[number]:.0f} mm")
            print(f"{name} at {along[number]:.0f} mm: {curve[0]:.3g} on the axis", end="")
            for share, opacity in ((0.68, 0.3), (0.95, 0.13)):
                ends = [end[number] for end in density.band(share)]
                if name == "temperature":
                    ends = [heated / end for end in ends[::-1]]
                axes.fill_between(radius, *ends, color=colour, alpha=opacity, lw=0)
                print(f", {share:.0%}: {ends[0][0]:.3g} to {ends[1][0]:.3g}", end="")
            print()
        tidy(axes, name.capitalize(), "distance from the axis (mm)", label, 0.9)
    right.legend(title="from the top", frameon=False)
    footer = (
        "Bands of 68 and 95 % by the scatter of the frames and the errors of the images. "
        "0.1 mm a pixel and 1 m to the camera are assumed."
    )
    save(figure, "pictures/burner-profile.png", footer)


def turbulence(side: int = 200, slope: float = -5 / 3, contrast: float = 0.6) -> None:
    """Invert a shot of turbulence, and draw its spectrum before and after the correction."""
    setup = ProtonSetup(
        energy=14.7, source_object_distance=1e-2, object_image_distance=0.3, pixel_size=5e-6
    )
    unit, size = 2 * np.pi / side, int(1.3 * side)
    potential, displacement = random_displacement(
        lambda k: np.where((k > 2 * unit) & (k < 25 * unit), (k / unit) ** (slope - 2), 0.0),
        (size, size), np.random.default_rng(0),
    )  # fmt: skip
    divergence = sum(np.gradient(part, axis=axis) for axis, part in enumerate(displacement))
    strength = contrast / float(np.std(divergence))
    inner = slice((size - side) // 2, (size - side) // 2 + side)
    image = np.random.default_rng(1).poisson(
        250 * synthetic_image(strength * displacement)[inner, inner]
    )
    inversion = invert(image, source=np.full(image.shape, 250.0))
    product = {"product": "spectrum", "path_length": 1e-3, "shortest": side / 23}
    (spectrum,) = analyse(inversion, product, setup=setup, samples=40)
    from napari_shadowinv.analysis.power_spectra import window_weights

    weights = window_weights(inversion.mask, 0.125)
    scale = float(np.abs(setup.path_integrated_b(np.ones((2, 1)))).max()) ** 2 * 5e-6
    k = 1e-3 * spectrum.coordinates["k"].values
    figure = Figure(figsize=(11, 4.6), layout="constrained")
    left, right = figure.subplots(1, 2)
    show(left, image / 250, "Proton image", "counts / beam", (0, 3))
    true = scale * ring_spectrum(strength * potential[inner, inner], weights).power
    raw = scale * ring_spectrum(inversion.potential, weights).power
    make_logarithmic(right)
    right.plot(k, true, color=DARK, lw=3, alpha=0.4, label="true field")
    right.plot(k, raw, color=ORANGE, lw=1, label="inversion as it is")
    low, high = spectrum.band("power") or (raw, raw)
    trusted = spectrum["trusted"].value > 0
    right.plot(k, spectrum["power"].value, color=BLUE, lw=1.3, label="corrected")
    right.fill_between(k[trusted], low[trusted], high[trusted], color=BLUE, alpha=0.25, lw=0)
    right.plot(k, spectrum["noise"].value, color="0.6", lw=1, label="noise")
    right.set_xlim(k[1], k[45])
    right.set_ylim(true[2:24].min() / 300, true.max() * 3)
    right.legend(frameon=False)
    tidy(right, "Ring-summed spectrum P(k)", "k (rad/mm)", "P (T² m³)", 0.8)
    for fact in spectrum.facts:
        print(f"{fact.title}: {fact.text}")
    save(figure, "pictures/turbulence-spectrum.png")


def integrals(side: int = 160, sigma: float = 24e-6) -> None:
    """Draw a flux, a current and a region of a toroid, its azimuthal field, and the contrast."""
    setup, middle = ProtonSetup.example(), (side - 1) / 2
    figure = Figure(figsize=(11, 3.5), layout="constrained")
    left, centre, right = figure.subplots(1, 3)
    for peak, colour in ((60, BLUE), (6, ORANGE)):
        phantom = toroid((side, side), setup, peak=peak, sigma=sigma)
        image = np.random.default_rng(0).poisson(1000 * synthetic_image(phantom.displacement))
        inversion = invert(image, source=np.full(image.shape, 1000.0))
        *numbers, azimuthal, current, contrast = analyse(
            inversion,
            [
                f"flux {middle},{middle} {middle},{middle + 50}",
                f"current center={middle},{middle} radius=30",
                "region rectangle=20,20 60,60",
                f"azimuthal center={middle},{middle} radius=60",
                "current-density",
                "contrast",
            ],
            setup=setup,
            unit="MG µm",
        )
        mu = float(contrast["mu"].value)
        row = slice(int(middle) - 1, int(middle) + 3)
        map_of_image = -current["density"].value[row].mean(axis=0)
        right.plot(
            map_of_image / np.abs(map_of_image).max(), color=colour, label=f"field, µ = {mu:.2g}"
        )
        seen = 1 - image[row].mean(axis=0) / 1000
        right.plot(seen / np.abs(seen).max(), color=colour, lw=0.8, alpha=0.6, label="image")
        if peak < 60:
            continue
        strength = 1e4 * np.hypot(*setup.path_integrated_b(inversion.displacement))
        show(left, strength, "Field", "MG µm", (0, float(strength.max())), "inferno")
        left.plot([middle, middle + 50], [middle, middle], color="white", lw=1.2)
        left.add_patch(Circle((middle, middle), 30, fill=False, color="cyan", lw=1.2))
        left.add_patch(Rectangle((20, 20), 40, 40, fill=False, color="lime", lw=1.2))
        for result in numbers:
            print(f"{result.name}: {result.facts[0].text}")
        radius = 1e6 * azimuthal.coordinates["radius"].values
        centre.plot(radius, 1e4 * azimuthal["azimuthal_field"].value, color=BLUE)
        tidy(centre, "Azimuthal field", "radius (µm)", "∫B dz (MG µm)", 0.9)
    right.legend(frameon=False, fontsize=7, loc="upper left")
    tidy(right, "Contrast of field and image", "x (px)", "over its largest", 0.9)
    save(figure, "pictures/integrals.png")


def main() -> None:
    turbulence()
    integrals()
    if len(sys.argv) > 1:
        burner_profile(Path(sys.argv[1]))


if __name__ == "__main__":
    main()
