"""Scans of a film pack whose truth is known, made without the code that they test.

- a folder with scans, calibration, unexposed film and `pack.toml`, and its `Truth`: `simulate`
- where protons of an energy land, and how many in each pixel: `Scene`

A point source sends protons through an object at 1 cm onto a pack at 10 cm. Each ray is displaced
by the exact formula and counts where it lands on the scan of a film that lies askew; nothing is
interpolated between the pixels of a film and those of its scan. Of the package, only the dose that
a proton leaves in each film is used (`ResponseMatrix`). Straight rays cross the pack: energy loss
is that along the axis, and protons neither scatter nor straggle. Counting noise is that of each
film alone, although the same protons cross several.

Arrays are [y, x]. Pixels of the object are those of the first film over its magnification. Lengths
are in m and energies in MeV, unless stated otherwise.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import tifffile
from numba import njit
from numpy.typing import NDArray

from napari_shadowinv.film import Pack, PackLayer, Slab
from napari_shadowinv.film.unfolding import ResponseMatrix

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

DPI = 300
PITCH = 25.4e-3 / DPI  # of the scan's pixels
TO_OBJECT, TO_FILM = 0.01, 0.10
SLOWEST, FASTEST, TEMPERATURE = 2.0, 45.0, 8.0  # MeV
REST = 938.27208816  # MeV
LIGHT = 299_792_458.0
FILM = "HDV2"
FILTERS = (
    ("13 um Al", "25 um Fe"),
    ("100 um Mylar",),
    ("200 um Mylar",),
    ("200 um Mylar",),
    ("300 um Mylar",),
    ("200 um Fe",),
    ("250 um Fe",),
    *(("500 um Fe",),) * 3,
)  # before each film

RAYS = 3  # to the side of a pixel
FINE = 2  # cells to the side of a pixel, on which rays count
AROUND = 14  # px around the film from which rays start
BED_AROUND = 40  # px of bed around a film that has not moved
BED = np.array([63_700.0, 64_100.0, 63_600.0])
BASE = np.array([38_100.0, 40_300.0, 31_700.0])  # unexposed film
# Optical density 1.6 x / (1 + x) with x = (dose / half)^0.9, about that of HD-V2.
SATURATED, POWER = 1.6, 0.9
HALF = np.array([300.0, 750.0, 2000.0])  # Gy, for red, green and blue
# Gy; the first is a control, as good as unexposed.
CALIBRATED = np.append(0.01, np.geomspace(0.5, 1500.0, 18))
SCANNER, GRAIN = 0.003, 0.01  # noise of a pixel's brightness, and of its dose

# Blobs of the potentials: share, centre and two radii as shares of the height, width, smaller side.
B_BLOBS = ((1.0, 0.42, 0.37, 0.11, 0.11), (-0.3, 0.66, 0.31, 0.085, 0.11))
E_BLOBS = ((1.0, 0.50, 0.67, 0.095, 0.095),)

# Strokes of figures, (y, x) down and right in units of their height.
FIGURES = {
    "0": [[(0, 0.3), (0.2, 0), (0.8, 0), (1, 0.3), (0.8, 0.6), (0.2, 0.6), (0, 0.3)]],
    "1": [[(0.2, 0.1), (0, 0.3), (1, 0.3)]],
    "2": [[(0.2, 0), (0, 0.3), (0.2, 0.6), (1, 0), (1, 0.6)]],
    "3": [[(0, 0), (0, 0.5), (0.4, 0.2), (0.7, 0.6), (1, 0.2), (0.9, 0)]],
    "4": [[(0, 0.3), (0.6, 0), (0.6, 0.6)], [(0.3, 0.45), (1, 0.4)]],
    "5": [[(0, 0.6), (0, 0.1), (0.4, 0.05), (0.6, 0.6), (1, 0.3), (0.9, 0)]],
    "6": [[(0, 0.5), (0.6, 0), (1, 0.2), (0.8, 0.6), (0.5, 0.3), (0.7, 0)]],
    "7": [[(0, 0), (0, 0.6), (1, 0.2)]],
    "8": [[(0.1, 0.5), (0.2, 0), (0.8, 0.6), (1, 0.2), (0.8, 0), (0.1, 0.5)]],
    "9": [[(0.3, 0.55), (0, 0.3), (0.3, 0), (0.4, 0.5), (0.1, 0.55), (1, 0.45)]],
}


def momentum(energy: Any) -> Any:
    """Times the speed of light, in eV: deflection by ∫B is LIGHT ∫B / momentum."""
    return 1e6 * np.sqrt(energy**2 + 2 * energy * REST)


def momentum_times_velocity(energy: Any) -> Any:
    """In eV: deflection by ∫E is ∫E / momentum_times_velocity."""
    return 1e6 * (energy**2 + 2 * energy * REST) / (energy + REST)


class Placement(NamedTuple):
    """How a film lies on a scan: its middle (y, x) and how far it is turned clockwise (rad)."""

    shape: tuple[int, int]
    middle: tuple[float, float]
    turn: float = 0.0
    slip: tuple[float, float] = (0.0, 0.0)  # px by which the film was off the pack's axis

    @property
    def axes(self) -> Array:
        """Down and right along the film, as unit vectors of the scan."""
        cosine, sine = np.cos(self.turn), np.sin(self.turn)
        return np.array([[cosine, -sine], [sine, cosine]])

    def on_scan(self, places: Array) -> Array:
        """From (..., 2), px from the film's middle."""
        return places @ self.axes + np.array(self.middle)

    def on_film(self) -> Array:
        """Of the scan's pixels, px from the film's middle, shape (2, H, W)."""
        steps = np.moveaxis(np.indices(self.shape, dtype=float), 0, -1) - np.array(self.middle)
        return np.moveaxis(steps @ self.axes.T, -1, 0)


@dataclass(frozen=True, eq=False)
class Scene:
    """Source, object and films: where protons go, and how many.

    Attributes
    ----------
    shape : tuple of int
        Of the films and the object, in px.
    energies : ndarray, shape (n,)
        Of protons that lose most in each film.
    distances : ndarray, shape (n,)
        From the object to the films' active layers.
    b_scale, e_scale : float
        Largest path-integrated fields, in T m and V.
    blur : float
        Standard deviation of the source's image on a film, px.
    protons : float
        Between 2 and 45 MeV, in a pixel of the object on average.
    beam_varies : bool
        Whether the beam is narrower at higher energies.
    """

    shape: tuple[int, int]
    energies: Array
    distances: Array
    b_scale: float
    e_scale: float
    blur: float
    protons: float
    beam_varies: bool = False

    @property
    def magnifications(self) -> Array:
        return 1 + self.distances / TO_OBJECT

    @property
    def pixel_size(self) -> float:
        """In the plane of the object, in m."""
        return float(PITCH / self.magnifications[0])

    @property
    def middle(self) -> Array:
        return (np.array(self.shape) - 1) / 2

    def spectrum(self, energy: Any) -> Any:
        """Return protons per MeV in a pixel of the object, on average."""
        total = TEMPERATURE * (np.exp(-SLOWEST / TEMPERATURE) - np.exp(-FASTEST / TEMPERATURE))
        inside = (energy >= SLOWEST) & (energy <= FASTEST)
        return np.where(inside, self.protons / total * np.exp(-energy / TEMPERATURE), 0.0)

    def b_field(self, y: Array, x: Array) -> Array:
        """(∫By dz, ∫Bx dz) in T m at pixels of the object; it has no divergence."""
        down, right = _slope(B_BLOBS, self.shape, y, x)
        return self.b_scale * np.stack([-right, down])

    def e_field(self, y: Array, x: Array) -> Array:
        """(∫Ey dz, ∫Ex dz) in V at pixels of the object; it has no curl."""
        return self.e_scale * _slope(E_BLOBS, self.shape, y, x)

    def beam(self, y: Array, x: Array, energy: float) -> Array:
        """Protons per pixel of the object over their mean where the first film shows it."""
        fluence = _beam(self.shape, y, x, self._widening(energy))
        return fluence / _beam(self.shape, *self._grid(), self._widening(energy)).mean()

    def _widening(self, energy: float) -> float:
        return (energy / self.energies[0]) ** -0.08 if self.beam_varies else 1.0

    def _grid(self) -> Array:
        return np.indices(self.shape, dtype=float)

    def displacement(self, energy: float, layer: int = 0) -> Array:
        """(y, x) in px of the object, by which protons are off, shape (2, H, W)."""
        by, bx = self.b_field(*self._grid())
        angle = LIGHT / momentum(energy) * np.stack([bx, -by])
        angle += self.e_field(*self._grid()) / momentum_times_velocity(energy)
        distance, magnification = self.distances[layer], self.magnifications[layer]
        return np.asarray(angle * distance / magnification / self.pixel_size)

    @cached_property
    def _rays(self) -> tuple[Array, Array, Array]:
        """Where rays cross the object (px), and their deflections by B and E times p and p v."""
        axes = [
            (np.arange(RAYS * (length + 2 * AROUND)) + 0.5) / RAYS - AROUND - 0.5
            for length in self.shape
        ]
        y, x = (np.ascontiguousarray(grid.ravel()) for grid in np.meshgrid(*axes, indexing="ij"))
        by, bx = LIGHT * self.b_field(y, x)
        return np.stack([y, x]), np.stack([bx, -by]), self.e_field(y, x)

    def landed(
        self,
        layer: int,
        energies: Array,
        weights: Array,
        placement: Placement | None = None,
        beam: Array | None = None,
    ) -> Array:
        """Return what reaches each pixel of a scan, of all that crosses the object.

        Parameters
        ----------
        layer : int
            Number of the film, from 0.
        energies, weights : ndarray, shape (m,)
            For each energy, what the protons in a pixel of the object come to on average.
        placement : Placement, optional
            Default: the scan is the film.
        beam : ndarray, shape (rays,), optional
            Weights of the rays instead of the beam's.
        """
        place = placement or Placement(self.shape, tuple(self.middle))
        rays, bend_b, bend_e = self._rays
        pad = 8
        fine = np.zeros(tuple(FINE * (length + 2 * pad) for length in place.shape))
        usual = beam
        for energy, weight in zip(energies, weights, strict=True):
            if usual is None or (beam is None and self.beam_varies):
                usual = self.beam(*rays, energy) / RAYS**2
            _count(
                fine,
                rays - self.middle[:, None],
                bend_b,
                bend_e,
                usual * weight,
                self.magnifications[layer] / self.magnifications[0],
                self.distances[layer] / PITCH / momentum(energy),
                self.distances[layer] / PITCH / momentum_times_velocity(energy),
                np.array(place.slip),
                place.axes,
                FINE * (np.array(place.middle) + pad),
            )
        return _blurred(fine, self.blur)[pad:-pad, pad:-pad]

    def fluence(self, layer: int, energy: float | None = None) -> Array:
        """Protons per m² and MeV on a film, shape (H, W); default: at the film's own energy."""
        film_energy = float(self.energies[layer]) if energy is None else energy
        each = np.array([self.spectrum(film_energy)])
        return self.landed(layer, np.array([film_energy]), each) / PITCH**2


@dataclass(frozen=True, eq=False)
class Truth:
    """What made the scans of a folder.

    Attributes
    ----------
    folder, pack : Path
        With the scans, and its `pack.toml`.
    scene : Scene
    fractions : tuple of (ndarray, ndarray)
        For each film: energies, and the dose times m² that the protons around them leave, of one
        pixel of the object on average.
    placements : tuple of Placement
        Of each film on its scan.
    doses : tuple of ndarray
        On each scan, in Gy, without noise.
    protons_per_pixel : tuple of float
        Mean number for each film that makes the counting noise of its dose.
    writing : tuple of ndarray of bool
        On each film's pixels; the notch is not part of it.
    notch : tuple of ndarray of bool
        On each film's pixels.
    """

    folder: Path
    pack: Path
    scene: Scene
    fractions: tuple[tuple[Array, Array], ...]
    placements: tuple[Placement, ...]
    doses: tuple[Array, ...]
    protons_per_pixel: tuple[float, ...]
    writing: tuple[Mask, ...]
    notch: tuple[Mask, ...]

    @property
    def files(self) -> list[Path]:
        return [self.folder / f"film_{k + 1:02d}.tif" for k in range(len(self.placements))]

    @property
    def b_field(self) -> Array:
        """(∫By dz, ∫Bx dz) in T m, shape (2, H, W)."""
        return self.scene.b_field(*np.indices(self.scene.shape, dtype=float))

    @property
    def e_field(self) -> Array:
        """(∫Ey dz, ∫Ex dz) in V, shape (2, H, W)."""
        return self.scene.e_field(*np.indices(self.scene.shape, dtype=float))

    def beam(self, layer: int = 0) -> Array:
        """At a film's energy in the plane of the object, over its mean, shape (H, W)."""
        places = np.indices(self.scene.shape, dtype=float)
        return self.scene.beam(*places, float(self.scene.energies[layer]))

    @property
    def corners(self) -> Array:
        """Of each film on its scan, (y, x) from its top left around, shape (n, 4, 2)."""
        half = np.array(self.scene.shape) / 2
        signs = np.array([(-1, -1), (-1, 1), (1, 1), (1, -1)])
        return np.array([place.on_scan(signs * half) for place in self.placements])

    def dose(self, layer: int) -> Array:
        """On a film's own pixels, in Gy, without noise, shape (H, W)."""
        return self.scene.landed(layer, *self.fractions[layer]) / PITCH**2


def simulate(
    folder: str | Path,
    *,
    layers: int = 8,
    shape: tuple[int, int] = (200, 260),
    seed: int = 0,
    b_peak: float = 4.0,
    e_peak: float = 2.5,
    blur: float = 0.7,
    protons: float = 2e6,
    rotations: float = 2.0,
    shifts: float = 20.0,
    slips: float = 0.0,
    handwriting: bool = True,
    notch: bool = True,
    noise: bool = True,
    beam_varies: bool = False,
    control: bool = True,
    strata: int = 12,
) -> Truth:
    """Write the scans of a film pack, and return what made them.

    Parameters
    ----------
    folder : str or Path
        Made if it is not there.
    layers : int
        Number of films, at most ten.
    shape : tuple of int
        Of the films, in px at 300 dpi.
    b_peak, e_peak : float
        Largest displacements in px by each field at the first film and its energy.
    blur : float
        Standard deviation of the source's image on a film, px; at least 0.4.
    protons : float
        Between 2 and 45 MeV, in a pixel of the object on average; 0 for films that see none.
    rotations, shifts : float
        By how many degrees and px films lie askew on their scans at most.
    slips : float
        By how many px films are off the pack's axis at most, to each side.
    handwriting, notch, noise, beam_varies : bool
    control : bool
        Whether the calibration begins with film that is as good as unexposed. Without it, its
        lightest film received 0.5 Gy, and only `unexposed.tif` tells what no dose looks like.
    strata : int
        Energies between those of neighbouring films.
    """
    if not 1 <= layers <= len(FILTERS) or blur < 0.4:
        raise ValueError(f"layers is {layers} and blur {blur}: expected 1 to 10, and at least 0.4")
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(seed)
    pack = _pack(layers)
    response = ResponseMatrix.of(pack, np.arange(SLOWEST, FASTEST, 0.002) + 0.001)
    energies = np.array([band.peak for band in response.bands])
    distances = TO_FILM + _depths(pack)
    angle = PITCH / TO_FILM  # by 1 px on the first film
    scene = Scene(
        shape,
        energies,
        distances,
        float(b_peak * angle * momentum(energies[0]) / LIGHT),
        float(e_peak * angle * momentum_times_velocity(energies[0])),
        blur,
        protons,
        beam_varies,
    )
    bed = (shape[0] + 2 * (BED_AROUND + int(shifts)), shape[1] + 2 * (BED_AROUND + int(shifts)))
    placements = [_placed(bed, rng, rotations, shifts, slips) for _ in range(layers + 1)]
    fractions, doses, counts, writing, notches = [], [], [], [], []
    for k, place in enumerate(placements[:-1]):
        shares, per_proton = _fractions(scene, response, k, strata)
        dose = np.maximum(scene.landed(k, *shares, place), 0) / PITCH**2
        pen = _figures(shape, f"{k + 1}", f"{seed % 100}") if handwriting else []
        hole = _notch(shape, place) if notch else (0.0, 0.0, 0.0, 0.0)
        noisy_dose = _counted(dose, per_proton / PITCH**2, rng) if noise else dose
        scan = _scan(shape, place, noisy_dose, pen, hole, rng if noise else None)
        _write(folder / f"film_{k + 1:02d}.tif", scan)
        fractions.append(shares)
        doses.append(dose)
        counts.append(float(shares[1].sum() / per_proton))
        film = np.moveaxis(np.indices(shape, dtype=float), 0, -1) - scene.middle
        writing.append(_inked(np.moveaxis(film, -1, 0), pen) > 0.3)
        notches.append(_in_notch(np.moveaxis(film, -1, 0), hole) > 0.01)
    blank = _scan(shape, placements[-1], np.zeros(bed), [], (0.0,) * 4, rng if noise else None)
    _write(folder / "unexposed.tif", blank)
    _write_table(folder / f"{FILM}.csv", first=0 if control else 1)
    _write_pack(folder / "pack.toml", layers)
    return Truth(
        folder,
        folder / "pack.toml",
        scene,
        tuple(fractions),
        tuple(placements[:-1]),
        tuple(doses),
        tuple(counts),
        tuple(writing),
        tuple(notches),
    )


def _slope(blobs: tuple[Any, ...], shape: tuple[int, int], y: Array, x: Array) -> Array:
    """Of Gaussian blobs, downhill, over the largest on the object's pixels."""
    return _raw_slope(blobs, shape, y, x) / _largest_slope(blobs, shape)


@lru_cache
def _largest_slope(blobs: tuple[Any, ...], shape: tuple[int, int]) -> float:
    return float(np.hypot(*_raw_slope(blobs, shape, *np.indices(shape, dtype=float))).max())


def _raw_slope(blobs: tuple[Any, ...], shape: tuple[int, int], y: Array, x: Array) -> Array:
    height, width = shape
    total = np.zeros((2, *np.shape(y)))
    for share, row, column, *radii in blobs:
        tall, wide = np.array(radii) * min(shape)
        v, u = (y - row * (height - 1)) / tall, (x - column * (width - 1)) / wide
        total += share * np.exp(-(v**2 + u**2) / 2) * np.stack([v / tall, u / wide])
    return total


def _beam(shape: tuple[int, int], y: Array, x: Array, widening: float) -> Array:
    """A broad Gaussian off the middle, with a slope."""
    height, width = shape
    v, u = y / (height - 1) - 0.45, x / (width - 1) - 0.53
    return np.exp(-(v**2 + u**2) / 2 / (0.6 * widening) ** 2) * (1 + 0.25 * u - 0.15 * v)


def _slabs(layer: int) -> Iterator[Slab]:
    for text in FILTERS[layer]:
        thickness, unit, material = text.split()
        assert unit == "um"
        yield Slab(material=material, thickness=float(thickness) * 1e-6)


def _pack(layers: int) -> Pack:
    films = [PackLayer(film=FILM, filters=tuple(_slabs(k))) for k in range(layers)]
    return Pack(layers=tuple(films))


def _depths(pack: Pack) -> Array:
    """Of the middles of active layers, from that of the first film."""
    depths, front = [], 0.0
    for layer in pack.layers:
        film = pack.film(layer)
        front += sum(slab.thickness for slab in (*layer.filters, *film.before))
        depths.append(front + film.active.thickness / 2)
        front += sum(slab.thickness for slab in (film.active, *film.behind))
    return np.array(depths) - depths[0]


def _fractions(
    scene: Scene, response: ResponseMatrix, layer: int, strata: int
) -> tuple[tuple[Array, Array], float]:
    """Energies and what they leave in a film, by all protons; and what one leaves, on average."""
    ends = [SLOWEST, *scene.energies, FASTEST]
    parts = [np.geomspace(a, b, strata + 1)[:-1] for a, b in pairwise(ends)]
    edges = np.append(np.concatenate(parts), FASTEST)
    step = response.energies[1] - response.energies[0]
    fluence = scene.spectrum(response.energies) * step
    deposited = fluence * response.doses[layer]
    part = np.searchsorted(edges, response.energies, side="right") - 1
    total = np.bincount(part, deposited, len(edges))
    # The same dose as by all of them, where the dose is left.
    mean = np.bincount(part, deposited * response.energies, len(edges))
    used = total > 1e-7 * total.sum()
    doses = response.doses[layer]
    usual = np.exp(-response.energies / TEMPERATURE) * doses
    each = (usual * doses).sum() / usual.sum()
    return (mean[used] / total[used], total[used]), float(each)


@njit(nogil=True, cache=True)
def _count(grid, rays, bend_b, bend_e, weights, scale, by_b, by_e, slip, axes, middle):  # type: ignore[no-untyped-def]
    """Add rays to a grid, each to 3 × 3 cells around where it lands, by a quadratic B-spline."""
    height, width = grid.shape
    for k in range(rays.shape[1]):
        v = scale * rays[0, k] + by_b * bend_b[0, k] + by_e * bend_e[0, k] - slip[0]
        u = scale * rays[1, k] + by_b * bend_b[1, k] + by_e * bend_e[1, k] - slip[1]
        y = middle[0] + FINE * (v * axes[0, 0] + u * axes[1, 0])
        x = middle[1] + FINE * (v * axes[0, 1] + u * axes[1, 1])
        i, j = int(np.floor(y + 0.5)), int(np.floor(x + 0.5))
        if i < 1 or j < 1 or i >= height - 1 or j >= width - 1:
            continue
        t, s = y - i, x - j
        down = (0.5 * (0.5 - t) ** 2, 0.75 - t**2, 0.5 * (0.5 + t) ** 2)
        right = (0.5 * (0.5 - s) ** 2, 0.75 - s**2, 0.5 * (0.5 + s) ** 2)
        for a in range(3):
            for b in range(3):
                grid[i + a - 1, j + b - 1] += weights[k] * down[a] * right[b]


def _blurred(fine: Array, blur: float) -> Array:
    """Blur by the source and average over pixels, exactly: the spline's own blur is undone."""
    factors = []
    for length, frequencies in zip(fine.shape, (np.fft.fftfreq, np.fft.rfftfreq), strict=True):
        f = FINE * frequencies(length)  # per px
        spline = np.sinc(f / FINE) ** 3
        factors.append(np.exp(-2 * (np.pi * blur * f) ** 2) * np.sinc(f) / spline)
    spectrum = np.fft.rfft2(fine) * factors[0][:, None] * factors[1]
    # Each pixel's value stands at its centre, for FINE² cells.
    return np.fft.irfft2(spectrum, fine.shape)[::FINE, ::FINE] * FINE**2


def _placed(
    bed: tuple[int, int], rng: np.random.Generator, rotations: float, shifts: float, slips: float
) -> Placement:
    turn, down, right = rng.uniform(-1, 1, 3) * [np.deg2rad(rotations), shifts, shifts]
    slip = rng.uniform(-1, 1, 2) * slips
    middle = ((bed[0] - 1) / 2 + down, (bed[1] - 1) / 2 + right)
    return Placement(bed, middle, float(turn), (float(slip[0]), float(slip[1])))


def _counted(dose: Array, per_proton: float, rng: np.random.Generator) -> Array:
    """Doses by whole numbers of protons, with the grain of the film."""
    counted = rng.poisson(dose / per_proton) * per_proton
    return np.asarray(counted * np.maximum(1 + GRAIN * rng.normal(size=dose.shape), 0))


def density(doses: Array) -> Array:
    """Net optical density by the formula, shape (..., 3)."""
    x = (np.asarray(doses)[..., None] / HALF) ** POWER
    return np.asarray(SATURATED * x / (1 + x))


def table() -> tuple[Array, Array]:
    """Pixels of the calibrated films and their spreads, as written, shape (19, 3)."""
    pixels = BASE / 10 ** density(CALIBRATED)
    slope = np.log(BASE / pixels) * POWER / (1 + (CALIBRATED[:, None] / HALF) ** POWER)
    return pixels.round(2), (pixels * np.hypot(SCANNER, GRAIN * slope)).round(2)


def brightness(doses: Array) -> Array:
    """Of film that received doses, shape (..., 3): in the table, linear in both logarithms."""
    pixels, _ = table()
    least = CALIBRATED[0]
    logarithm = np.log(np.maximum(doses, least))
    planes = []
    for c in range(3):
        inside = np.exp(np.interp(logarithm, np.log(CALIBRATED), np.log(pixels[:, c])))
        # The first darkening is in proportion to the dose.
        first = BASE[c] * (pixels[0, c] / BASE[c]) ** (np.minimum(doses, least) / least)
        planes.append(np.where(doses < least, first, inside))
    return np.stack(planes, axis=-1)


def _scan(
    shape: tuple[int, int],
    place: Placement,
    dose: Array,
    pen: list[Array],
    hole: tuple[float, ...],
    rng: np.random.Generator | None,
) -> Array:
    film = place.on_film()
    cover = np.ones(place.shape)
    for along, length in zip(film, shape, strict=True):
        cover *= np.clip(0.5 + length / 2 - np.abs(along), 0, 1)
    cover *= 1 - _in_notch(film, hole)
    planes = brightness(dose)
    ink = _inked(film, pen)
    if ink.any():
        # A black pen on bright film, a white one on dark film.
        colour = [4_200, 4_000, 8_500] if planes[ink > 0, 0].mean() > 20_000 else [57_000] * 3
        planes += ink[..., None] * (np.array(colour) - planes)
    uneven = 1 + 0.004 * np.linspace(-1, 1, place.shape[1])[:, None]
    planes = BED * uneven + cover[..., None] * (planes - BED * uneven)
    if rng is not None:
        planes *= 1 + SCANNER * rng.normal(size=planes.shape)
    return planes


def _figures(shape: tuple[int, int], left: str, right: str) -> list[Array]:
    """Strokes in the lower corners, ends as (y, x) in px from the film's middle."""
    size = 0.11 * shape[0]
    top = shape[0] / 2 - 1.6 * size
    strokes = []
    for text, start in (
        (left, 0.6 * size - shape[1] / 2),
        (right, shape[1] / 2 - (0.6 + 0.85 * len(right)) * size),
    ):
        for number, figure in enumerate(text):
            for stroke in FIGURES[figure]:
                ends = np.array(stroke) * size
                ends[:, 1] += start + 0.85 * number * size - 0.15 * ends[:, 0]
                strokes.append(ends + np.array([top, 0.12 * size]))
    return strokes


def _inked(film: Array, pen: list[Array]) -> Array:
    """How much of each place is covered by strokes 3 px wide."""
    nearest = np.full(film.shape[1:], np.inf)
    for stroke in pen:
        for start, end in pairwise(stroke):
            y, x = film[0] - start[0], film[1] - start[1]
            along = end - start
            share = np.clip((y * along[0] + x * along[1]) / (along @ along), 0, 1)
            nearest = np.minimum(nearest, np.hypot(y - share * along[0], x - share * along[1]))
    return np.clip(2.0 - nearest, 0, 1)


def _notch(shape: tuple[int, int], place: Placement) -> tuple[float, ...]:
    """Middle, half height and half width of what was punched, in px from the film's middle."""
    height, width = shape
    deep, wide = 0.07 * height, 0.035 * height
    return -height / 2 - place.slip[0], width / 2 - 0.2 * height - place.slip[1], deep, wide


def _in_notch(film: Array, hole: tuple[float, ...]) -> Array:
    """How much of each place was punched out, at the top edge."""
    y, x, deep, wide = hole
    if not deep:
        return np.zeros(film.shape[1:])
    return np.clip(0.5 + deep - (film[0] - y), 0, 1) * np.clip(0.5 + wide - abs(film[1] - x), 0, 1)


def _write(path: Path, planes: Array) -> None:
    values = np.clip(np.round(planes), 0, 65_535).astype(np.uint16)
    options = {"resolution": (DPI, DPI), "resolutionunit": "INCH", "photometric": "rgb"}
    tifffile.imwrite(path, values, **options)


def _write_table(path: Path, first: int) -> None:
    head = "Film No's,Actual Dose,Log Dose,Red Ch,std dev,Green Ch,std dev,Blue Ch,std dev"
    lines = [head, "(C ),(Gy),log10(Gy),pix,,pix,,pix,"]
    rows = list(zip(CALIBRATED, *table(), strict=True))[first:]
    for number, (dose, *row) in enumerate(rows, 1):
        cells = np.stack(row, axis=1).ravel()
        values = ",".join(f"{cell:.2f}" for cell in cells)
        lines.append(f"{number},{dose:.9g},{np.log10(dose):.9f},{values}")
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _write_pack(path: Path, layers: int) -> None:
    lines = [
        'seen_from = "source"',
        "[setup]",
        'kind = "proton"',
        f"source_object_distance = {TO_OBJECT}",
        f"object_image_distance = {TO_FILM}",
        "",
        f"[films.{FILM}]",
        f'calibration = "{FILM}.csv"',
        'unexposed = "unexposed.tif"',
    ]
    for k in range(layers):
        filters = ", ".join(f'"{text}"' for text in FILTERS[k])
        lines += ["", "[[layers]]", f'film = "{FILM}"', f"filters = [{filters}]"]
        lines += [f'file = "film_{k + 1:02d}.tif"']
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
