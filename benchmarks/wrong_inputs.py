"""How many wrong images, references and setups are noticed, and how many right ones doubted.

    python benchmarks/wrong_inputs.py [--seeds 3]

Wrong: a dark level, saturation, a negative, a reference shifted or exchanged with its image, hot
pixels, a dark rim, a beam stop, gaps of a detector, all put into simulated shots of a toroid in two
beams with noise of counting; and setups with common mistakes of units. Right: all phantoms with
Gaussian noise of 0 to 30 % and 30 to 1000 counts, with a uniform, a smooth and a structured beam;
the reference images, where they are there;
frames of a real plume with their real reference; and the setups of the examples. No inversion is
needed: the checks look at what goes into it.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from collections.abc import Callable, Iterator

import imageio.v3 as iio
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from napari_shadowinv import (
    Instrument,
    InversionOptions,
    OpticalSetup,
    ProtonSetup,
    read,
    synthetic_image,
)
from napari_shadowinv.cautions import Caution
from napari_shadowinv.errors import InputError
from napari_shadowinv.inversion.normalise import mask_unlit, prepare
from napari_shadowinv.physics import phantoms
from napari_shadowinv.physics.beam import setup_cautions
from napari_shadowinv.physics.setup import SETUPS, setup_from_dict
from napari_shadowinv.preprocessing import image_cautions
from napari_shadowinv.preprocessing.alignment import register_source
from reference import DATA, donut_case, toroid_case

FloatArray = NDArray[np.float64]
Shot = tuple[FloatArray, FloatArray | None]

SHAPE = (200, 200)
GAUSSIAN_NOISE = (0.0, 0.03, 0.1, 0.3)
COUNTS = (30, 100, 300, 1000)

PAPER = {
    "kind": "proton",
    "energy": 14.7,
    "source_object_distance": 1.3e-3,
    "object_image_distance": 2e-2,
    "pixel_size": 1.5e-6,
}
FILM = {**PAPER, "source_object_distance": 0.01, "object_image_distance": 0.28, "pixel_size": 5e-6}
SCAN = {name: value for name, value in FILM.items() if name != "pixel_size"}
LIGHT = {
    "kind": "optical",
    "wavelength": 532e-9,
    "object_image_distance": 0.3,
    "pixel_size": 20e-6,
}
WRONG_SETUPS = {
    "pixel in µm": {**FILM, "pixel_size": 5.0},
    "pixel in mm": {**FILM, "pixel_size": 5e-3},
    "pixel in nm, taken for pm": {**FILM, "pixel_size": 5e-9},
    "detector pixel in mm": {**SCAN, "detector_pixel_size": 0.145},
    "detector pixel given for the object": {**FILM, "pixel_size": 145e-6},
    "object pixel given for the detector": {**SCAN, "detector_pixel_size": 1.5e-6},
    "distances in mm": {**PAPER, "source_object_distance": 1.3, "object_image_distance": 20.0},
    "distances in cm": {**FILM, "source_object_distance": 1.0, "object_image_distance": 28.0},
    "source distance in mm": {**FILM, "source_object_distance": 10.0},
    "detector distance in cm": {**FILM, "object_image_distance": 28.0},
    "distances swapped": {**FILM, "source_object_distance": 0.28, "object_image_distance": 0.01},
    "source to detector, not to object": {**FILM, "source_object_distance": 0.29},
    "energy in eV": {**FILM, "energy": 14.7e6},
    "energy in keV": {**FILM, "energy": 14.7e3},
    "energy ten times too large": {**FILM, "energy": 147.0},
    "wavelength in nm": {**LIGHT, "wavelength": 532.0},
    "wavelength in mm": {**LIGHT, "wavelength": 532e-6},
    "pixel of light in mm": {**LIGHT, "pixel_size": 20e-3},
    "distance of light in mm": {**LIGHT, "object_image_distance": 300.0},
}
RIGHT_SETUPS = {
    "paper": PAPER,
    "film": FILM,
    "scan": {**SCAN, "detector_pixel_size": 145e-6},
    "light": LIGHT,
    "far detector": {**FILM, "object_image_distance": 1.3, "pixel_size": 20e-6},
    "electrons": {**FILM, "species": "electron", "energy": 200.0},
}


def beam(kind: str, shape: tuple[int, int] = SHAPE) -> FloatArray:
    """Return a beam of mean 1: uniform, smooth, or smooth with structure of 10 %."""
    y, x = np.indices(shape) / np.reshape(shape, (2, 1, 1))
    smooth = np.exp(-((y - 0.45) ** 2 + (x - 0.55) ** 2) / (2 * 0.5**2))
    if kind == "uniform":
        smooth = np.ones(shape)
    if kind == "structured":
        texture = gaussian_filter(np.random.default_rng(5).normal(size=shape), 4)
        smooth = smooth * (1 + 0.1 * texture / texture.std())
    return np.asarray(smooth / smooth.mean())


def wrong_shots(image: FloatArray, source: FloatArray, counts: int) -> Iterator[tuple[str, Shot]]:
    """Yield every mistake with a right shot."""
    dark = counts / 10
    yield "dark level 10 %", (image + dark, source + dark)
    yield "dark level 20 %", (image + 2 * dark, source + 2 * dark)
    yield "dark level 200 counts", (image + 200, source + 200)
    yield "saturation", (np.minimum(image, 1.5 * counts), source)
    yield "negative", (image.max() - image, source)
    yield "reference shifted by 5 px", (image[5:], source[:-5])
    yield "reference shifted by 25 px", (image[:, 25:], source[:, :-25])
    yield "swapped", (source, image)
    hot = image.copy()
    places = np.random.default_rng(0).integers(4, min(image.shape) - 4, (2, 20))
    hot[tuple(places)] = 10 * counts
    yield "hot pixels", (hot, source)
    y, x = np.indices(image.shape) - np.reshape(image.shape, (2, 1, 1)) / 2
    rim, stop = np.hypot(y, x) > 0.45 * image.shape[0], np.hypot(y + 40, x) < 9
    unlit = np.random.default_rng(1).poisson(0.3, (2, *image.shape)).astype(float)
    for name, dark in (("dark rim", rim), ("beam stop", stop)):
        planes = np.where(dark, unlit, (image, source))
        yield name, (planes[0], planes[1])
    yield "dark rim, no reference", (np.where(rim, unlit[0], image), None)
    for mark in (2**32 - 1, -1):
        gaps = image.copy()
        gaps[150:157] = mark
        yield f"gaps of {mark}", (gaps, source)


CODES = {
    "dark level 10 %": "dark-level",
    "dark level 20 %": "dark-level",
    "dark level 200 counts": "dark-level",
    "hot pixels": "hot-pixels",
    "reference shifted by 5 px": "register",
    "reference shifted by 25 px": "register",
    "dark rim": "unlit",
    "dark rim, no reference": "unlit",
    "beam stop": "unlit",
    "gaps of 4294967295": "unlit",
    "gaps of -1": "unlit",
}
"""Caution of each mistake that is not named like it."""


def cautions_of(image: FloatArray, source: FloatArray | None) -> list[Caution]:
    """Return all cautions about an image, those of pixels without light among them."""
    mask, cautions = mask_unlit(image, source, None)
    usable = None if mask is None else np.asarray(mask)
    cautions = [*cautions, *image_cautions(image, source, usable)]
    if source is not None:
        shot = prepare(image, source, InversionOptions(negative="clip"), usable)
        moved = register_source(shot.image, shot.source, shot.mask, Instrument()).caution
        cautions += [moved] if moved else []
    return cautions


def noticed_shots(seeds: int) -> dict[str, list[bool]]:
    """Return for each mistake whether it was named, over strengths, beams, counts and seeds."""
    named: dict[str, list[bool]] = {}
    for peak in (97.0, 194.0):
        truth = phantoms.toroid(SHAPE, ProtonSetup.example(), peak, 30e-6).displacement
        for kind in ("smooth", "structured"):
            clean = beam(kind)
            folded = synthetic_image(truth, clean)
            for counts in (100, 1000):
                for seed in range(seeds):
                    rng = np.random.default_rng(seed)
                    shot = rng.poisson(counts * folded).astype(float)
                    source = rng.poisson(counts * clean).astype(float)
                    for mistake, (image, reference) in wrong_shots(shot, source, counts):
                        codes = {caution.code for caution in cautions_of(image, reference)}
                        code = CODES.get(mistake, mistake)
                        named.setdefault(mistake, []).append(code in codes)
    return named


def right_shots(seeds: int) -> Iterator[tuple[str, Shot]]:
    """Yield right shots: all phantoms with all noises and beams, and the reference images."""
    setup = ProtonSetup.example()
    scenes: dict[str, Callable[[], phantoms.Phantom]] = {
        "toroid 24": lambda: phantoms.toroid(SHAPE, setup, 24.0, 30e-6),
        "toroid 97": lambda: phantoms.toroid(SHAPE, setup, 97.0, 30e-6),
        "toroid 194": lambda: phantoms.toroid(SHAPE, setup, 194.0, 30e-6),
        "four toroids": lambda: phantoms.four_toroids(SHAPE, setup),
        "cosine ellipses": lambda: phantoms.cosine_ellipses(SHAPE, setup),
        "focusing pair": lambda: phantoms.focusing_pair(SHAPE, setup),
        "opposite pair": lambda: phantoms.opposite_pair(SHAPE, setup),
        "coaxial line": lambda: phantoms.coaxial_line(SHAPE, setup)[0],
        "ellipse pair": lambda: phantoms.ellipse_pair(SHAPE),
        "blob": lambda: phantoms.gaussian_blob(SHAPE, 100.0, 20.0),
        "plasma wave": lambda: phantoms.wakefield(SHAPE, OpticalSetup.example()),
    }
    for name, make in scenes.items():
        displacement = make().displacement
        for kind in ("uniform", "smooth", "structured"):
            clean = beam(kind)
            image = synthetic_image(displacement, clean)
            for seed in range(seeds):
                rng = np.random.default_rng(seed)
                for counts in COUNTS:
                    source = rng.poisson(counts * clean).astype(float)
                    label = f"{name}, {kind}, {counts} counts"
                    yield label, (rng.poisson(counts * image).astype(float), source)
                for noise in GAUSSIAN_NOISE:
                    noisy = image + noise * rng.normal(size=SHAPE)
                    label = f"{name}, {kind}, noise {noise:.0%}"
                    yield label, (noisy, clean + noise / 3 * rng.normal(size=SHAPE))
    yield from _reference_images()


def _reference_images() -> Iterator[tuple[str, Shot]]:
    cases = [toroid_case(peak, noise) for peak in (24, 97, 194) for noise in (False, True)]
    for case in filter(None, [*cases, donut_case()]):
        yield case.name, (np.asarray(case.image, float), None)
    for file in sorted(DATA.glob("pradformat/*.h5")) + sorted(DATA.glob("prns/target*.txt")):
        yield file.name, (read(file).image, None)
    frames = sorted(DATA.glob("burner/data/*.bmp"))
    pictures = [iio.imread(file).astype(float) for file in frames]
    for file, picture in zip(frames[1:], pictures[1:], strict=True):
        for step in (1, 2, 4):
            yield f"{file.name} / {step}", (picture[::step, ::step], pictures[0][::step, ::step])
        for corner in (0, 300, 600):
            part = np.s_[corner : corner + 300, corner : corner + 400]
            yield f"{file.name} from {corner}", (picture[part], pictures[0][part])


def is_refused_or_doubted(values: dict[str, object]) -> bool:
    """Whether a setup is refused, or something is said of it."""
    try:
        return bool(setup_cautions(setup_from_dict(values), SHAPE))
    except InputError:
        return True


def main() -> None:
    """Print what was noticed, and what was an alarm without reason."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=3, help="of the noise")
    seeds = parser.parse_args().seeds

    print("| wrong input | named, % |\n|---|---|")
    for mistake, results in noticed_shots(seeds).items():
        print(f"| {mistake} | {100 * np.mean(results):.0f} of {len(results)} cases |")
    missed = [name for name, values in WRONG_SETUPS.items() if not is_refused_or_doubted(values)]
    count = len(WRONG_SETUPS)
    print(
        f"| setups | {count - len(missed)} of {count}{': not ' if missed else ''}"
        f"{', '.join(missed)} |"
    )

    total, alarms, seconds = 0, Counter[str](), 0.0
    examples: dict[str, str] = {}
    for label, (image, source) in right_shots(seeds):
        began = time.process_time()
        cautions = cautions_of(image, source)
        seconds += time.process_time() - began
        total += 1
        for caution in cautions:
            # All frames of the plume lie 0.8 px beside their reference, in the same direction.
            if caution.code == "register" and ".bmp" in label:
                continue
            alarms[caution.code] += 1
            examples.setdefault(caution.code, label)
    false = sum(alarms.values())
    print(
        f"\nFalse alarms: {false} on {total} right shots ({100 * false / total:.1f} %), "
        f"{1e3 * seconds / total:.0f} ms each"
    )
    for kind, number in alarms.items():
        print(f"- {kind}: {number}, such as {examples[kind]}")
    usual = {
        **RIGHT_SETUPS,
        **{kind: model.example().model_dump() for kind, model in SETUPS.items()},
    }
    doubted = [name for name, values in usual.items() if is_refused_or_doubted(values)]
    print(f"False alarms on setups: {len(doubted)} of {len(usual)} {', '.join(doubted)}")


if __name__ == "__main__":
    main()
