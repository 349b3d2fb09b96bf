"""A simulated film pack, whose truth is known: what its scans can tell.

    python benchmarks/film_pack.py [--seeds 3] [--protons 2e6]
    python benchmarks/film_pack.py --chain [--seeds 3] [--bin 3]
    python benchmarks/film_pack.py --real pack.toml [--first 1] [--last 17]

With --chain: how far the fields and the beam, by a fit of all layers, are from the truth, as the
steps from the scans to the layers are added one by one; and of a pack whose films have slipped by
up to 6 px, laid on each other by what they show, or by three holes read to 0.3 px.

With --real: how the films of a real pack were moved and turned by their texture, against their
edges, and where the slit near their upper right corner lies on the upright films before and after.
Films that lie right show it at one place; where it is torn, too faint or masked, it is left out.

The scans are those of benchmarks/simulated_pack.py: rays counted where an exact formula puts them,
on films that lie askew. For each film: the energy of its protons and its doses; the protons that
make its counting noise, by pixel, and that noise; the noise of the dose as the red channel of the
scans tells it, with counting, grain and scanner, away from writing, over seeds; the largest
displacements by each field alone, in px of the object; the blur of a single ray on its scan without
the pixel's own, and the largest error of its dose by three rays to the side of a pixel against
eight.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import tifffile
from numpy.typing import NDArray
from scipy import ndimage

import simulated_pack
from napari_shadowinv import FitOptions, Recipe
from napari_shadowinv.film import write_corners
from napari_shadowinv.film.registration import move_corners
from napari_shadowinv.film.scans import straighten_film, upright
from napari_shadowinv.film_doses import FilmDoses
from napari_shadowinv.options import FitChoices
from napari_shadowinv.pipeline import read_pack, run_film, run_fit
from napari_shadowinv.preprocessing import Bin
from napari_shadowinv.shot import Shot
from simulated_pack import Truth, simulate

HEAD = (
    "film",
    "MeV",
    "M",
    "dose (Gy)",
    "protons",
    "counting (%)",
    "noise (%)",
    "B (px)",
    "E (px)",
    "blur (px)",
    "rays (%)",
)

FloatArray = NDArray[np.float64]


def deposit_blur(truth: Truth, layer: int) -> float:
    """Standard deviation in px of what one ray leaves on a scan."""
    scene = truth.scene
    rays, *_ = scene._rays
    beam = np.zeros(rays.shape[1])
    beam[np.argmin(np.hypot(*(rays - scene.middle[:, None] - 0.3)))] = 1.0
    energy = scene.energies[layer : layer + 1]
    image = scene.landed(layer, energy, np.ones(1), truth.placements[layer], beam)
    y, _ = np.indices(image.shape)
    mean = (image * y).sum()
    return float(np.sqrt((image * (y - mean) ** 2).sum() - 1 / 12))


def noise_of_scan(truth: Truth, layer: int) -> float:
    """Standard deviation of the dose over its truth, by the formula of the red channel."""
    place, film = truth.placements[layer], truth.scene.shape
    inside = (np.abs(place.on_film()) < np.array(film)[:, None, None] / 3).all(axis=0)
    scan = tifffile.imread(truth.files[layer])[..., 0][inside]
    pixels, _ = simulated_pack.table()
    known, logarithms = np.log(pixels[::-1, 0]), np.log(simulated_pack.CALIBRATED[::-1])
    told = np.exp(np.interp(np.log(scan), known, logarithms))
    return float(np.std(told / truth.doses[layer][inside]))


def error_of_rays(truth: Truth, layer: int, usual: FloatArray) -> float:
    """Largest error of a film's dose, against that by many more rays."""
    few, simulated_pack.RAYS = simulated_pack.RAYS, 8
    try:
        many = replace(truth, scene=replace(truth.scene)).dose(layer)
    finally:
        simulated_pack.RAYS = few
    return float(np.abs(usual / many - 1).max())


def row(truths: list[Truth], layer: int) -> list[str]:
    truth = truths[0]
    scene = truth.scene
    energy = float(scene.energies[layer])
    dose = truth.dose(layer)
    by_b, by_e = (
        np.hypot(*replace(scene, **{other: 0.0}).displacement(energy, layer)).max()
        for other in ("e_scale", "b_scale")
    )
    protons = truth.protons_per_pixel[layer]
    noise = np.sqrt(np.mean([noise_of_scan(one, layer) ** 2 for one in truths]))
    return [
        f"{layer + 1}",
        f"{energy:.2f}",
        f"{scene.magnifications[layer]:.3f}",
        f"{dose.min():.3g} to {dose.max():.3g}",
        f"{protons:.2g}",
        f"{100 / np.sqrt(protons):.2f}",
        f"{100 * noise:.2f}",
        f"{by_b:.2f}",
        f"{by_e:.2f}",
        f"{deposit_blur(truth, layer):.3f}",
        f"{100 * error_of_rays(truth, layer, dose):.2f}",
    ]


@dataclass(frozen=True, eq=False)
class Images:
    """What the fit is given: an image, a mask and a setup for each layer, and where it lies."""

    planes: list[FloatArray]
    masks: list[NDArray[np.bool_]]
    setups: list[Any]
    offset: FloatArray  # px by which the first layer's middle is off the object's

    @classmethod
    def of(cls, truth: Truth, doses: FilmDoses) -> Images:
        planes = [
            np.where(*both, 0.0)
            for both in zip(doses.usable, doses.fluence.astype(float), strict=True)
        ]
        pose = doses.shifts[0], float(doses.turns[0])
        _, middle, _ = upright(move_corners(doses.corners[0], *pose, 1.0))
        place = truth.placements[0]
        offset = np.array(place.axes) @ (middle - np.array(place.middle)) + np.array(place.slip)
        return cls(planes, list(doses.usable), list(doses.setups), offset)


def on_first_film(
    truth: Truth, plane: FloatArray, layer: int, shape: tuple[int, int], offset: Any = (0.0, 0.0)
) -> FloatArray:
    """A plane on a film, or with layer 0 one of the object, on the pixels of the first film."""
    scale = truth.scene.magnifications[layer] / truth.scene.magnifications[0]
    steps = [np.arange(length) - (length - 1) / 2 for length in shape]
    axes = [scale * step + away for step, away in zip(steps, offset, strict=True)]
    y, x = np.meshgrid(*axes, indexing="ij")
    at = np.stack([y, x]) + truth.scene.middle[:, None, None]
    return np.asarray(ndimage.map_coordinates(plane, at, order=3, mode="nearest"))


def fitted(
    truth: Truth, images: Images, binned: int, align: str, spread: float = 20.0
) -> list[str]:
    """How far fields and beam by a fit of all layers are from the truth, and are told to be, in %.

    With an `align` other than "none" films may be shifted by about `spread` px of the scan.
    """
    shots = [
        Shot(image=plane, setup=setup, mask=mask, source="unknown")
        for plane, mask, setup in zip(images.planes, images.masks, images.setups, strict=True)
    ]
    options = FitOptions(align=align, align_spread=spread / binned)
    choices = FitChoices(fields=("B", "E"), brightness="free", options=options)
    recipe = Recipe(steps=(Bin(factor=binned),), fit=choices)
    begun = time.perf_counter()
    fit = run_fit(recipe, shots)
    seconds = time.perf_counter() - begun
    shape = images.planes[0].shape

    def as_fitted(plane: FloatArray) -> FloatArray:
        """On the fit's pixels, which are means of blocks."""
        whole = on_first_film(truth, plane, 0, shape, images.offset)
        height, width = fit.images.shape[1:]
        blocks = whole[: height * binned, : width * binned]
        return np.asarray(blocks.reshape(height, binned, width, binned).mean(axis=(1, 3)))

    errors = []
    for field, b_part, e_part in zip(fit.fields, (1.0, 0.0), (0.0, 1.0), strict=True):
        scene = replace(
            truth.scene, b_scale=b_part * truth.scene.b_scale, e_scale=e_part * truth.scene.e_scale
        )
        # As the fit's energy displaces, in px of the fit.
        true = scene.displacement(images.setups[0].energy) / binned
        expected = np.stack([as_fitted(part) for part in true])
        errors.append(np.sqrt(((field.displacement - expected) ** 2).sum() / (expected**2).sum()))
    beam = as_fitted(truth.beam())
    source = fit.source[0]
    beam_error = np.std(source / source.mean() / (beam / beam.mean()) - 1)
    chi2 = f"{fit.chi2.min():.2f} to {fit.chi2.max():.2f}"
    told = fit.total_error
    figures = [f"{100 * error:.1f}" for error in (*errors, beam_error, told)]
    return [*figures, chi2, str(fit.verdict), f"{seconds:.0f}"]


def chain(folder: Path, seed: int, given: argparse.Namespace) -> None:
    """Print what each step from the scans to the fields costs."""
    choices = {"b_peak": 17.0, "e_peak": 11.0, "protons": given.protons}
    rows: dict[str, Images] = {}
    truth = simulate(folder / f"{seed}", layers=8, shape=(300, 400), seed=seed, **choices)
    corners = folder / "corners.csv"
    write_corners(corners, {str(k + 1): one for k, one in enumerate(truth.corners)})
    pack = read_pack(truth.pack)
    by_corners = pack.model_copy(update={"corners": corners, "align": "edges"})
    rows["doses and spectra; true corners"] = Images.of(truth, run_film(by_corners))
    by_edges = run_film(pack.model_copy(update={"align": "edges"}))
    rows["films found by their edges"] = Images.of(truth, by_edges)
    whole = Images.of(truth, run_film(pack))
    rows["films laid on each other by what they show, if their edges are off"] = whole
    for name, images in rows.items():
        cells = fitted(truth, images, given.bin, "none")
        print(f"| {seed} | {name} | {' | '.join(cells)} |", flush=True)
    cells = fitted(truth, whole, given.bin, "shift")
    print(f"| {seed} | … and by the fit | {' | '.join(cells)} |", flush=True)
    slipped = simulate(
        folder / f"{seed}_slipped", layers=8, shape=(300, 400), seed=seed, slips=6.0, **choices
    )
    pack = read_pack(slipped.pack)
    ways = {
        "films that slipped, laid by what they show": pack,
        "films that slipped, laid by fiducials": pack.model_copy(
            update={"fiducials": fiducials(slipped, seed)}
        ),
    }
    for name, way in ways.items():
        whole = Images.of(slipped, run_film(way))
        cells = fitted(slipped, whole, given.bin, "none")
        print(f"| {seed} | {name} | {' | '.join(cells)} |", flush=True)
    for way, name in (("shift", "by the fit"), ("affine", "turned by it")):
        cells = fitted(slipped, whole, given.bin, way, 0.2)
        print(f"| {seed} | … and {name}, within 0.2 px | {' | '.join(cells)} |", flush=True)


def fiducials(truth: Truth, seed: int) -> Path:
    """A table of three holes through the pack, as one reads them off the scans."""
    rng = np.random.default_rng(seed)
    sides = np.array(truth.scene.shape)
    path = truth.folder / "fiducials.csv"
    lines = ["film,name,y,x"]
    for number, place in enumerate(truth.placements, 1):
        for name, at in (("left", (-0.4, -0.45)), ("right", (-0.38, 0.45)), ("low", (0.42, 0.1))):
            on_scan = place.on_scan(np.array(at) * sides - np.array(place.slip))
            y, x = on_scan + rng.normal(0, 0.3, 2)
            lines.append(f"{number},{name},{y:.2f},{x:.2f}")
    path.write_text("\n".join(lines) + "\n")
    return path


def slit_of(film: FloatArray) -> tuple[float, float] | None:
    """Lower end and place across (y, x) in px of the slit near the upper right corner."""
    part = film[:60, -55:-20]
    away = np.abs(part - ndimage.median_filter(part, (1, 15)))
    profile = np.clip(away[12:28].mean(axis=0) - np.median(away[12:28].mean(axis=0)), 0, None)
    best = int(np.argmax(profile))
    near = slice(max(best - 3, 0), best + 4)
    line = away[:, max(best - 1, 0) : best + 2].max(axis=1)
    ended = np.flatnonzero(line[25:] < np.median(line[12:28]) / 2)
    if not profile[near].any() or not ended.size or ended[0] == 0:
        return None
    across = np.average(np.arange(part.shape[1])[near], weights=profile[near])
    return float(25 + ended[0]), float(film.shape[1] - 55 + across)


def print_real(pack: Path, first: int, last: int) -> None:
    """Print moves by texture against edges, and the places of slits by edges and as laid."""
    described = read_pack(pack)
    layers = tuple(
        layer if first <= number <= last else layer.model_copy(update={"exclude": True})
        for number, layer in enumerate(described.layers, 1)
    )
    doses = run_film(described.model_copy(update={"layers": layers}))
    shape = doses.dose.shape[1], doses.dose.shape[2]
    print("| film | type | shift y, x (px) | turn (°) | by | slit by edges | slit as laid |")
    print(f"|{'---|' * 7}")
    places: dict[str, list[float]] = {}
    for number in range(first, last + 1):
        corners, shift = doses.corners[number - 1], doses.shifts[number - 1]
        turn, film = float(doses.turns[number - 1]), described.layers[number - 1].film
        pixels = tifffile.imread(described.layers[number - 1].file)
        laid = move_corners(corners, shift, turn, 1.0)
        slits = [
            slit_of(straighten_film(pixels, where, shape=shape).mean(axis=-1))
            for where in (corners, laid)
        ]
        cells = ["–" if slit is None else f"{slit[0]:.0f}, {slit[1]:.1f}" for slit in slits]
        by = "texture" if doses.by_images[number - 1] else "edges"
        print(
            f"| {number} | {film} | {shift[0]:+.1f}, {shift[1]:+.1f} | "
            f"{np.rad2deg(turn):+.2f} | {by} | {' | '.join(cells)} |"
        )
        if by == "edges" and slits[1] is not None:
            places.setdefault(film, []).append(slits[1][1])
    for kind, across in places.items():
        print(f"\n{kind} laid by edges: slits within {np.ptp(across):.1f} px across.")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--protons", type=float, default=2e6, help="in a pixel of the object")
    parser.add_argument("--bin", type=int, default=3, help="pixels that are summed for the fit")
    parser.add_argument("--chain", action="store_true", help="fit fields, which takes long")
    parser.add_argument("--real", type=Path, help="pack.toml of real films with a slit")
    parser.add_argument("--first", type=int, default=1, help="film of the real pack")
    parser.add_argument("--last", type=int, default=17, help="film of the real pack")
    given = parser.parse_args()
    if given.real is not None:
        print_real(given.real, given.first, given.last)
        return
    with tempfile.TemporaryDirectory() as folder:
        if given.chain:
            print("| seed | steps | B (%) | E (%) | beam (%) | told ± (%) | χ² | verdict | s |")
            print(f"|{'---|' * 9}")
            for seed in range(given.seeds):
                chain(Path(folder), seed, given)
            return
        begun = time.perf_counter()
        truths = [
            simulate(Path(folder) / str(seed), seed=seed, protons=given.protons)
            for seed in range(given.seeds)
        ]
        seconds = (time.perf_counter() - begun) / given.seeds
        print(f"| {' | '.join(HEAD)} |\n|{'---|' * len(HEAD)}")
        for layer in range(len(truths[0].files)):
            print(f"| {' | '.join(row(truths, layer))} |", flush=True)
    print(f"\n{seconds:.0f} s for each pack.")


if __name__ == "__main__":
    main()
