"""Images by charged particles that are traced through a 3-D field: `trace`.

- the image of a field on a grid: `trace`, with `TraceOptions`; the answer is a `TracedImage`
- particles with chosen starting points: `trace_particles`; they are `TracedParticles`
- the exact line integrals of a grid along straight rays: `line_integrals`

Nothing is assumed of the object: it may be thick, its fields may bend the particles inside it and
change their energy. So a traced image checks what the inversion and the fit make of it, which
hold the object for thin. Outside the grid particles fly straight, inside they are pushed by the
relativistic Boris scheme of `napari_shadowinv.physics.particle_push`.
"""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field
from scipy.ndimage import distance_transform_edt

from napari_shadowinv import __version__
from napari_shadowinv._system.arrays import PLANE, as_numbers, check_finite, plain_array
from napari_shadowinv._system.machine import available_threads, in_ranges
from napari_shadowinv._system.progress import OnProgress, Reporter, ShouldStop
from napari_shadowinv._system.safety import check_memory
from napari_shadowinv._system.validation import CheckedModel, as_model, check_instance
from napari_shadowinv._typing import AnyArray, FloatArray, IntArray
from napari_shadowinv.errors import InputError
from napari_shadowinv.physics.field_grid import FieldGrid, field_grid
from napari_shadowinv.physics.forward import MIN_SIDE_PX, synthetic_image
from napari_shadowinv.physics.particle_push import (
    TRAPPED,
    UNTOUCHED,
    integrate_rays,
    push_particles,
)
from napari_shadowinv.physics.setup import ProtonSetup
from napari_shadowinv.physics.units import label, place_coordinates

if TYPE_CHECKING:
    import xarray

__all__ = [
    "TraceOptions",
    "TracedImage",
    "TracedParticles",
    "line_integrals",
    "trace",
    "trace_particles",
]

Profile = ArrayLike | Callable[[FloatArray, FloatArray], ArrayLike]
Shape = tuple[int, int]

_JOULES_PER_MEV = 1.602176634e-13
_LIGHT_SPEED = 299792458.0
_BLOCK = 1 << 17  # particles; fixed, so that random numbers do not depend on the threads
_SMALLEST_RANGE = 256  # particles for a thread
_MAX_PATH = 20.0  # diagonals of the grid, beyond which a particle is trapped
_MAX_STEPS = 10_000_000  # of a particle across the grid
_MAX_REACH = 1.0  # sides of the image by which the launched area may exceed it
_SPARE_PX = 2
_BYTES_PER_RAY = 160
_VECTORS = ("component", *PLANE)


class TraceOptions(CheckedModel):
    """Choices of `trace`."""

    output: Literal["fluence", "counts"] = Field(
        default="fluence",
        title="Output",
        description=(
            "fluence: the exact image of regular rays, without noise; counts: particles drawn at "
            "random, with their counting statistics."
        ),
    )
    rays_per_pixel: int = Field(
        default=4,
        ge=1,
        le=256,
        title="Rays per pixel",
        description=(
            "Rays traced per pixel for a fluence; the next square number is used. Between the rays "
            "the displacement is interpolated by cubic splines."
        ),
    )
    counts: float = Field(
        default=100.0,
        gt=0,
        le=1e6,
        allow_inf_nan=False,
        title="Counts per pixel",
        description="Mean number of particles per pixel of the image without the object.",
    )
    source_size: float = Field(
        default=0.0,
        ge=0,
        le=1.0,
        allow_inf_nan=False,
        title="Source size (m)",
        description="Standard deviation of the Gaussian source in m (FWHM / 2.355); for counts.",
    )
    energy_spread: float = Field(
        default=0.0,
        ge=0,
        allow_inf_nan=False,
        title="Energy spread (MeV)",
        description="Standard deviation of the kinetic energy in MeV; for counts.",
    )
    step: float = Field(
        default=0.5,
        gt=0,
        le=1,
        title="Step (cells)",
        description="Longest step of a particle, in units of the smallest spacing of the grid.",
    )
    max_turn: float = Field(
        default=0.05,
        gt=0,
        le=0.5,
        title="Turn per step (rad)",
        description="Largest change of direction in a step, in the strongest field of the grid.",
    )
    keep_particles: bool = Field(
        default=False,
        title="Keep particles",
        description="Also return start, landing point and deflection of each particle; for counts.",
    )
    seed: int = Field(
        default=0, ge=0, title="Seed", description="Seed of all random choices; for counts."
    )


@dataclass(frozen=True, eq=False)
class TracedParticles:
    """Particles that were traced one by one, in the order of their starting points.

    Attributes
    ----------
    aim : ndarray, shape (2, N)
        Where each would cross the object plane without the object, in px, axis order (y, x).
    displacement : ndarray, shape (2, N)
        Landing point minus that without the object, in px of the object plane; NaN if lost.
    deflection : ndarray, shape (2, N)
        Change of the angle of flight in rad, axis order (y, x); NaN if lost.
    energy : ndarray, shape (N,)
        Kinetic energy at the source in MeV.
    energy_change : ndarray, shape (N,)
        Change of the kinetic energy by the object in MeV.
    lost : ndarray of bool, shape (N,)
        Whether it did not reach the detector: it turned round, or stayed in the field.
    landing : ndarray, shape (2, N)
        Landing point on the detector, divided by the magnification, in px, axis order (y, x).
    steps : ndarray of int32, shape (N,)
        Number of steps inside the grid.
    """

    aim: FloatArray
    displacement: FloatArray
    deflection: FloatArray
    energy: FloatArray
    energy_change: FloatArray
    lost: AnyArray
    landing: FloatArray
    steps: AnyArray


@dataclass(frozen=True, eq=False)
class TracedImage:
    """The image that a 3-D field casts, and the truth about the field.

    Attributes
    ----------
    image : ndarray, shape (H, W)
        Particles in each pixel of the detector, or the fluence there.
    source : ndarray, shape (H, W)
        Expected image without the object, in the same unit.
    displacement : ndarray, shape (2, H, W)
        Displacement in px of the ray that is aimed at each pixel's centre, from a point source
        with the energy of the setup; NaN if it is lost.
    deflection : ndarray, shape (2, H, W)
        Change of its angle of flight in rad; NaN if it is lost.
    path_integrated_b : ndarray, shape (2, H, W)
        Exact (∫B_y dz, ∫B_x dz) in T m along the straight ray through each pixel's centre.
    path_integrated_e : ndarray, shape (2, H, W)
        Exact (∫E_y dz, ∫E_x dz) in V along the same ray.
    launched : int
        Particles or rays that were traced for the image.
    landed : int
        Those that landed in the image.
    outside : int
        Those that landed outside the image.
    lost : int
        Those that did not reach the detector.
    setup : ProtonSetup
    options : TraceOptions
    length : float
        Length of the grid along the beam in m.
    edge_share : float
        Largest field on the faces of the grid over the largest field in it.
    steps : int
        Steps of all particles inside the grid.
    particles : TracedParticles or None
        Each particle, where `TraceOptions.keep_particles` asks for them.
    """

    image: FloatArray
    source: FloatArray
    displacement: FloatArray
    deflection: FloatArray
    path_integrated_b: FloatArray
    path_integrated_e: FloatArray
    launched: int
    landed: int
    outside: int
    lost: int
    setup: ProtonSetup
    options: TraceOptions
    length: float
    edge_share: float
    steps: int
    particles: TracedParticles | None = None

    @property
    def thin_displacement(self) -> FloatArray:
        """Displacement in px, shape (2, H, W), if the object were thin.

        It follows from the true line integrals; `displacement` differs from it by the length of
        the object, by axial fields on oblique rays, and by the change of energy.
        """
        return self.setup.displacement_from_path_integrated_b(
            self.path_integrated_b
        ) + self.setup.displacement_from_path_integrated_e(self.path_integrated_e)

    @property
    def thin_screen_error(self) -> float:
        """Relative r.m.s. difference between `displacement` and `thin_displacement`."""
        thin = self.thin_displacement
        usable = np.isfinite(self.displacement).all(axis=0)
        norm = float(np.linalg.norm(thin[:, usable]))
        difference = float(np.linalg.norm((self.displacement - thin)[:, usable]))
        return difference / norm if norm > 0 else 0.0

    def to_dataset(self) -> xarray.Dataset:
        """Return all arrays with units and coordinates in m; options and setup as attributes."""
        import xarray as xr

        size = self.setup.object_pixel_size
        unit = "1" if self.options.output == "counts" else "1/pixel**2"
        variables: dict[str, Any] = {
            "image": (PLANE, self.image, label(unit, "Traced image")),
            "source": (PLANE, self.source, label(unit, "Undisturbed beam")),
        }
        vectors = {
            "displacement": ("pixel", "Displacement of the ray through each pixel"),
            "deflection": ("rad", "Change of the angle of flight"),
            "path_integrated_b": ("T m", "True path-integrated magnetic field"),
            "path_integrated_e": ("V", "True path-integrated electric field"),
        }
        for name, (units, long_name) in vectors.items():
            variables[name] = _VECTORS, getattr(self, name), label(units, long_name)
        shape = (self.image.shape[0], self.image.shape[1])
        coords = {
            "component": ("component", ["y", "x"], label("1", "Component of a vector")),
            **place_coordinates(shape, size),
        }
        attrs = {
            "package_version": __version__,
            "setup": self.setup.model_dump_json(),
            "trace_options": self.options.model_dump_json(),
            **{name: getattr(self, name) for name in ("launched", "landed", "outside", "lost")},
            "length_m": self.length,
            "edge_share": self.edge_share,
        }
        return xr.Dataset(variables, coords=coords, attrs=attrs)


def trace(
    field: Any,
    setup: ProtonSetup,
    shape: Shape = (200, 200),
    *,
    options: TraceOptions | None = None,
    profile: Profile | None = None,
    spectrum: ArrayLike | None = None,
    threads: int | None = None,
    on_progress: OnProgress | None = None,
    should_stop: ShouldStop | None = None,
) -> TracedImage:
    """Image of a 3-D field on the detector, by particles that are traced through it.

    Parameters
    ----------
    field : FieldGrid, xarray.Dataset, or grid of PlasmaPy
        E and B around the object; see `napari_shadowinv.physics.field_grid`.
    setup : ProtonSetup
        The experiment; a collimated beam has an infinite `source_object_distance`.
    shape : tuple of int, default (200, 200)
        Height and width of the image in px.
    options : TraceOptions, optional
        Fluence or counts, source size, energy spread, accuracy, seed.
    profile : array_like of shape (H, W), or callable, optional
        Fluence of the beam on the object plane. An array covers the image and is constant within
        a pixel; a function is called with arrays of y and x in m from the middle of the image,
        also for points outside it. Default: 1 everywhere.
    spectrum : array_like, shape (2, n), optional
        Energies in MeV, increasing, and the number of particles per MeV there, linear in between;
        for counts. Default: the energy of the setup with the spread of the options.
    threads : int, optional
        Threads to use. Default: all cores. The result does not depend on it.
    on_progress, should_stop : callable, optional
        Receives a `Progress`; ends the work when it returns true.

    Returns
    -------
    TracedImage

    Raises
    ------
    InputError
        If the grid does not lie between source and detector or is nowhere near the image, a unit
        is missing, a value is not finite, a field is so strong that particles leave the range of
        floating-point numbers, or a choice makes no sense.
    InversionCancelled
        If `should_stop` returned true.

    Notes
    -----
    The direction of a particle changes by the exact angle in each step, so its error is that of
    the place where the field is taken: of second order in `step`. A step of half a cell and a
    turn of 0.05 rad leave an error of the deflection below 0.1 % for fields that the grid
    resolves; in a uniform field the gyroradius is 0.02 % too small.

    Each point of an extended source lights the object plane with the same profile.

    Examples
    --------
    >>> import numpy as np
    >>> magnetic = np.zeros((3, 5, 5, 5))
    >>> magnetic[1] = 20.0  # B_y
    >>> field = FieldGrid(magnetic, spacing=(1e-4, 1e-4, 1e-4))
    >>> traced = trace(field, ProtonSetup.example(), (20, 20))
    >>> traced.path_integrated_b[0, 10, 10].round(5)  # T m
    0.008
    """
    grid = field_grid(field)
    check_instance(setup, ProtonSetup, "setup")
    options = as_model(TraceOptions, options, "options")
    shape = _checked_shape(shape)
    _check_choices(options, setup, spectrum)
    report = Reporter(on_progress, should_stop)
    report("field", 0)
    work = _Work(grid, setup, shape, options, available_threads(_checked_threads(threads)), report)
    centres = _pixel_centres(*_ranges(shape), 1)
    straight = work.push(centres, "rays")
    plane = (2, *shape)
    lines = line_integrals(grid, setup, shape, threads=threads)
    reach = _reach(work, straight.displacement)
    if options.output == "counts":
        image, source, tally, particles = _count(work, reach, profile, spectrum)
    else:
        image, source, tally = _fluence(work, reach, profile, threads)
        particles = None
    return TracedImage(
        image=image,
        source=source,
        displacement=straight.displacement.reshape(plane),
        deflection=straight.deflection.reshape(plane),
        path_integrated_b=lines[:2],
        path_integrated_e=lines[2:],
        launched=tally.launched,
        landed=tally.landed,
        outside=tally.launched - tally.landed - tally.lost,
        lost=tally.lost,
        setup=setup,
        options=options,
        length=grid.length,
        edge_share=grid.edge_share,
        steps=int(straight.steps.sum()) + tally.steps,
        particles=particles,
    )


def trace_particles(
    field: Any,
    setup: ProtonSetup,
    aim: ArrayLike,
    *,
    shape: Shape = (1, 1),
    energy: ArrayLike | None = None,
    start: ArrayLike | None = None,
    options: TraceOptions | None = None,
    threads: int | None = None,
) -> TracedParticles:
    """Trace particles that are aimed at points of the object plane.

    Parameters
    ----------
    field, setup, options, threads
        As for `trace`; of the options `step` and `max_turn`.
    aim : array_like, shape (2, N)
        Points of the object plane in px, axis order (y, x).
    shape : tuple of int, default (1, 1)
        Height and width of the image whose middle lies on the axis; pixels are counted in it.
    energy : array_like, shape (N,), optional
        Kinetic energies in MeV. Default: that of the setup.
    start : array_like, shape (2, N), optional
        Points of the source in m from its middle, axis order (y, x). Default: its middle.

    Returns
    -------
    TracedParticles

    Raises
    ------
    InputError
        As `trace`; or if the arrays do not match.
    """
    grid = field_grid(field)
    check_instance(setup, ProtonSetup, "setup")
    options = as_model(TraceOptions, options, "options")
    points = as_numbers("aim", aim)
    if points.ndim != 2 or points.shape[0] != 2:
        raise InputError(f"aim has shape {points.shape}: expected (2, N), the y component first")
    check_finite("aim", points)
    count = points.shape[1]
    energies = np.full(count, setup.energy) if energy is None else as_numbers("energy", energy)
    starts = np.zeros((2, count)) if start is None else as_numbers("start", start)
    if energies.shape != (count,) or starts.shape != (2, count):
        raise InputError(
            f"energy has shape {energies.shape} and start {starts.shape}: expected ({count},) and "
            f"(2, {count}), as many as aims"
        )
    check_finite("start", starts)
    if not (np.isfinite(energies).all() and (energies > 0).all()):
        raise InputError("energy has values that are not positive numbers: expected MeV above 0")
    threads = available_threads(_checked_threads(threads))
    work = _Work(grid, setup, shape, options, threads, Reporter())
    return work.push(points, "particles", energies, starts)


def line_integrals(
    field: Any, setup: ProtonSetup, shape: Shape, *, threads: int | None = None
) -> FloatArray:
    """Integrate a field over z along the straight rays from the source through the pixels' centres.

    Parameters
    ----------
    field, setup, shape, threads
        As for `trace`.

    Returns
    -------
    ndarray, shape (4, H, W)
        ∫B_y dz and ∫B_x dz in T m, ∫E_y dz and ∫E_x dz in V; exact for a field that is trilinear
        between the nodes.

    Raises
    ------
    InputError
        As `trace`.
    """
    grid = field_grid(field)
    check_instance(setup, ProtonSetup, "setup")
    _check_place(grid, setup)
    shape = _checked_shape(shape)
    rays = _straight_rays(setup, shape, _pixel_centres(*_ranges(shape), 1))
    integrals = np.zeros((len(rays), 4 if grid.electric is not None else 2))
    in_ranges(
        integrate_rays,
        len(rays),
        available_threads(_checked_threads(threads)),
        _interleave(grid),
        *_nodes(grid),
        rays,
        integrals,
        smallest=_SMALLEST_RANGE,
    )
    planes = np.zeros((4, *shape))
    planes[: integrals.shape[1]] = integrals.T.reshape(-1, *shape)
    return planes


@dataclass(frozen=True)
class _Tally:
    """Numbers of particles that were launched, landed in the image, or were lost; their steps."""

    launched: int
    landed: int
    lost: int
    steps: int


class _Work:
    """A field ready for the kernels, with the experiment around it."""

    def __init__(
        self,
        grid: FieldGrid,
        setup: ProtonSetup,
        shape: Shape,
        options: TraceOptions,
        threads: int,
        report: Reporter,
    ) -> None:
        _check_place(grid, setup)
        self.grid, self.setup, self.shape, self.options = grid, setup, shape, options
        self.threads, self.report = threads, report
        self.field = _interleave(grid)
        self.origin, self.spacing = _nodes(grid)
        particle = setup.particle
        self.rest_energy = particle.mass * _LIGHT_SPEED**2 / _JOULES_PER_MEV
        self.charge = particle.charge / (particle.mass * _LIGHT_SPEED)
        self.peaks = np.array([grid.peak("magnetic"), grid.peak("electric") / _LIGHT_SPEED])
        self.longest = options.step * float(self.spacing.min())
        diagonal = math.hypot(*((n - 1) * d for n, d in zip(grid.shape, grid.spacing, strict=True)))
        self.max_path = _MAX_PATH * diagonal
        self._check_strength(setup.energy)

    def _check_strength(self, energy: float) -> None:
        """Refuse a field in which a particle would take too many steps, or get no finite speed."""
        u = float(self.momenta(np.array([energy]))[0])
        gamma = math.hypot(1.0, u)
        strength = abs(self.charge) * (self.peaks[0] + self.peaks[1] * gamma / u)
        if not math.isfinite(strength * self.max_path) or (
            strength * self.grid.length / self.options.max_turn > _MAX_STEPS
        ):
            name, unit = ("electric", "V/m") if self.peaks[1] > self.peaks[0] else ("magnetic", "T")
            raise InputError(
                f"the {name} field reaches {self.grid.peak(name):.3g} {unit}, which bends "
                f"{self.setup.probe} to a radius of {1 / strength:.3g} m, far below the grid's "
                f"{self.grid.length:.3g} m: check the unit of the field"
            )

    def momenta(self, energy: FloatArray) -> FloatArray:
        """Momentum over m c of kinetic energies in MeV."""
        ratio = energy / self.rest_energy
        momenta: FloatArray = np.sqrt(ratio * (ratio + 2))
        return momenta

    def push(
        self,
        aim: FloatArray,
        stage: str,
        energy: FloatArray | None = None,
        start: FloatArray | None = None,
    ) -> TracedParticles:
        """Trace particles; aims in px, energies in MeV, points of the source in m."""
        count = aim.shape[1]
        energies = np.full(count, self.setup.energy) if energy is None else energy
        particles = _straight_rays(self.setup, self.shape, aim, start)
        particles[:, 3:] *= self.momenta(energies)[:, None]
        straight = particles.copy()
        status, steps = np.zeros(count, np.int8), np.zeros(count, np.int32)
        for first in range(0, count, _BLOCK):
            self.report(stage, first, count)
            block = slice(first, min(first + _BLOCK, count))
            in_ranges(
                push_particles,
                block.stop - first,
                self.threads,
                self.field,
                self.origin,
                self.spacing,
                particles[block],
                status[block],
                steps[block],
                self.charge,
                self.longest,
                self.options.max_turn,
                self.peaks,
                self.max_path,
                smallest=_SMALLEST_RANGE,
            )
        # Without the object the landing point is the aim, moved by the source's own size.
        shift = 0.0
        if start is not None and not self.setup.is_collimated:
            ratio = self.setup.object_image_distance / self.setup.source_object_distance
            shift = start * ratio / self.setup.pixel_sizes[1]
        return self._arrivals(aim, aim - shift, energies, straight, particles, status, steps)

    def _arrivals(
        self,
        aim: FloatArray,
        free_landing: FloatArray,
        energies: FloatArray,
        straight: FloatArray,
        particles: FloatArray,
        status: AnyArray,
        steps: AnyArray,
    ) -> TracedParticles:
        """Fly particles from the grid to the detector, and compare with a flight without field."""
        if not np.isfinite(particles).all():
            bad = int((~np.isfinite(particles)).any(axis=1).sum())
            raise InputError(
                f"{bad} particles left the range of floating-point numbers: check the unit of the "
                "field and the energy"
            )
        distance = self.setup.object_image_distance
        lost = (status == TRAPPED) | (particles[:, 5] <= 0)
        lost |= particles[:, 2] > distance
        with np.errstate(divide="ignore", invalid="ignore"):
            free, landing = (
                (state[:, 1::-1] + state[:, 4:2:-1] / state[:, 5:] * (distance - state[:, 2:3])).T
                for state in (straight, particles)
            )
            displacement = (landing - free) / self.setup.pixel_sizes[1]
            angles = (
                np.arctan2(state[:, 4:2:-1], state[:, 5:]).T for state in (particles, straight)
            )
            deflection = next(angles) - next(angles)
        displacement[:, status == UNTOUCHED] = 0.0
        deflection[:, status == UNTOUCHED] = 0.0
        displacement[:, lost] = deflection[:, lost] = np.nan
        start, end = ((state[:, 3:] ** 2).sum(axis=1) for state in (straight, particles))
        gammas = np.sqrt(1 + start), np.sqrt(1 + end)
        change = (end - start) / (gammas[0] + gammas[1]) * self.rest_energy
        return TracedParticles(
            aim=aim,
            displacement=displacement,
            deflection=deflection,
            energy=energies,
            energy_change=np.where(status == UNTOUCHED, 0.0, change),
            lost=lost,
            landing=free_landing + displacement,
            steps=steps,
        )


def _fluence(
    work: _Work, reach: tuple[IntArray, IntArray], profile: Profile | None, threads: int | None
) -> tuple[FloatArray, FloatArray, _Tally]:
    """Return the image of regular rays, the beam without object, and the numbers of rays."""
    fine = math.isqrt(work.options.rays_per_pixel - 1) + 1
    first, last = reach
    size = tuple((last - first) * fine)
    check_memory(size, _BYTES_PER_RAY, "an image")
    rays = work.push(_pixel_centres(first, last, fine), "rays")
    displacement = (fine * rays.displacement).reshape(2, *size)
    flux = _beam(work, profile, first, last, fine) / fine**2
    lost = rays.lost.reshape(size)
    if lost.any():
        # Rays that are lost carry nothing; the spline needs a value there.
        nearest = distance_transform_edt(lost, return_distances=False, return_indices=True)
        displacement = displacement[:, nearest[0], nearest[1]] if not lost.all() else 0 * size
        flux = np.where(lost, 0.0, flux)
    cut = tuple(slice(-low, height - low) for low, height in zip(first, work.shape, strict=True))
    image = np.zeros(size)
    if flux.any():
        image = synthetic_image(displacement, flux, rays_per_pixel=4, threads=threads)
    source = _beam(work, profile, *_ranges(work.shape), 1)
    inside = _is_inside(rays.landing, work.shape)
    tally = _Tally(lost.size, int(inside.sum()), int(lost.sum()), int(rays.steps.sum()))
    blocks = image.reshape(size[0] // fine, fine, size[1] // fine, fine).sum(axis=(1, 3))
    return blocks[cut], source, tally


def _count(
    work: _Work,
    reach: tuple[IntArray, IntArray],
    profile: Profile | None,
    spectrum: ArrayLike | None,
) -> tuple[FloatArray, FloatArray, _Tally, TracedParticles | None]:
    """Return the image of random particles, the expected beam, numbers, and the particles."""
    first, last = reach
    options = work.options
    beam = _beam(work, profile, first, last, 1)
    source = _beam(work, profile, *_ranges(work.shape), 1)
    if not source.sum() > 0:
        raise InputError("the profile is zero in the whole image: expected some fluence")
    scale = options.counts / source.mean()
    cumulative = np.cumsum(beam.ravel())
    total = round(float(cumulative[-1]) * scale)
    cumulative /= cumulative[-1]
    energies = _energies(work, spectrum)
    image = np.zeros(work.shape[0] * work.shape[1], np.int64)
    landed = lost = steps = 0
    batches: list[TracedParticles] = []
    for block, at in enumerate(range(0, total, _BLOCK)):
        work.report("particles", at, total)
        generator = np.random.default_rng([options.seed, block])
        count = min(_BLOCK, total - at)
        # In the order of the pixels, so that neighbours use the same part of the field.
        pixels = np.sort(np.searchsorted(cumulative, generator.random(count), side="right"))
        rows, columns = np.divmod(pixels, beam.shape[1])
        aim = np.stack([rows, columns]) + first[:, None] + generator.random((2, count)) - 0.5
        start = options.source_size * generator.standard_normal((2, count))
        particles = work.push(aim, "particles", energies(generator, count), start)
        inside = _is_inside(particles.landing, work.shape)
        row, column = np.floor(particles.landing[:, inside] + 0.5).astype(np.int64)
        image += np.bincount(row * work.shape[1] + column, minlength=image.size)
        landed += int(inside.sum())
        lost += int(particles.lost.sum())
        steps += int(particles.steps.sum())
        if options.keep_particles:
            batches.append(particles)
    names = [part.name for part in dataclasses.fields(TracedParticles)]
    particles_of_all = (
        TracedParticles(
            *(np.concatenate([getattr(batch, name) for batch in batches], axis=-1) for name in names)
        )
        if batches
        else None
    )
    counts = image.reshape(work.shape).astype(np.float64)
    return counts, source * scale, _Tally(total, landed, lost, steps), particles_of_all


def _is_inside(landing: FloatArray, shape: Shape) -> AnyArray:
    """Whether points in px lie in the image; NaN does not."""
    inside = np.ones(landing.shape[1], np.bool_)
    for at, count in zip(landing, shape, strict=True):
        inside &= (at >= -0.5) & (at < count - 0.5)
    return inside


def _energies(
    work: _Work, spectrum: ArrayLike | None
) -> Callable[[np.random.Generator, int], FloatArray]:
    """Return a function that draws kinetic energies in MeV."""
    centre, spread = work.setup.energy, work.options.energy_spread
    if spectrum is not None:
        table = as_numbers("spectrum", spectrum)
        if table.ndim != 2 or table.shape[0] != 2 or table.shape[1] < 2:
            raise InputError(
                f"spectrum has shape {table.shape}: expected (2, n), energies in MeV and numbers"
            )
        check_finite("spectrum", table)
        energy, density = table
        if not (energy[0] > 0 and (np.diff(energy) > 0).all()):
            raise InputError("spectrum has energies that do not increase from above 0: sort them")
        if density.min() < 0 or not density.max() > 0:
            raise InputError("spectrum has negative numbers or none above 0: expected 0 or more")
        return lambda generator, count: _draw_from(energy, density, generator.random(count))
    if spread == 0:
        return lambda generator, count: np.full(count, centre)
    if spread > centre / 4:
        raise InputError(
            f"energy spread is {spread:g} MeV at {centre:g} MeV: expected at most a quarter of the "
            "energy; use a spectrum"
        )

    def draw(generator: np.random.Generator, count: int) -> FloatArray:
        # Four standard deviations reach down to zero energy at most.
        return centre + spread * np.clip(generator.standard_normal(count), -3.9, 3.9)

    return draw


def _draw_from(energy: FloatArray, density: FloatArray, share: FloatArray) -> FloatArray:
    """Return energies below which a piecewise linear density has the shares of its integral."""
    areas = np.diff(energy) * (density[1:] + density[:-1]) / 2
    cumulative = np.concatenate([[0.0], np.cumsum(areas)])
    target = share * cumulative[-1]
    part = np.clip(np.searchsorted(cumulative, target, side="right") - 1, 0, len(areas) - 1)
    width, low = np.diff(energy)[part], density[part]
    slope = (density[part + 1] - low) / width
    excess = target - cumulative[part]
    # low s + slope s²/2 = excess, in the form that is stable for small slopes
    root = np.sqrt(np.maximum(low**2 + 2 * slope * excess, 0.0))
    with np.errstate(divide="ignore", invalid="ignore"):
        way = np.where(excess > 0, 2 * excess / (low + root), 0.0)
    drawn: FloatArray = energy[part] + np.clip(way, 0.0, width)
    return drawn


def _beam(
    work: _Work, profile: Profile | None, first: IntArray, last: IntArray, fine: int
) -> FloatArray:
    """Return the fluence on the object plane, at the centres of pixels or of parts of them."""
    size = tuple((last - first) * fine)
    if profile is None:
        return np.ones(size)
    if callable(profile):
        size_m = work.setup.object_pixel_size
        middle = (np.array(work.shape) - 1) / 2
        y, x = (_pixel_centres(first, last, fine) - middle[:, None]) * size_m
        values = np.asarray(profile(y.reshape(size), x.reshape(size)), dtype=np.float64)
        beam = np.broadcast_to(values, size) if values.ndim == 0 else values
        if beam.shape != size:
            raise InputError(
                f"the profile returned shape {beam.shape} for points of shape {size}: they must "
                "match"
            )
    else:
        plane = np.asarray(plain_array(profile, "profile"), dtype=np.float64)
        if plane.shape != work.shape:
            raise InputError(f"profile has shape {plane.shape}, image {work.shape}: they must match")
        padding = [(-low, high - n) for low, high, n in zip(first, last, work.shape, strict=True)]
        beam = np.kron(np.pad(plane, padding), np.ones((fine, fine)))
    check_finite("profile", beam)
    if beam.min() < 0:
        raise InputError(f"profile has negative values (lowest {beam.min():g}): expected 0 or more")
    return np.array(beam)


def _reach(work: _Work, displacement: FloatArray) -> tuple[IntArray, IntArray]:
    """Return the first pixel and the one behind the last that rays are aimed at, along y and x.

    Rays from outside the image may be deflected into it. They pass through the grid, and start no
    farther outside than the field moves them.
    """
    first, last = _ranges(work.shape)
    shadow = _shadow(work)
    if (shadow[1] < -0.5).any() or (shadow[0] > last - 0.5).any():
        (_, y, x), size = work.grid.extent, 1e3 * work.setup.object_pixel_size * last
        raise InputError(
            f"the grid covers x from {1e3 * x[0]:.4g} to {1e3 * x[1]:.4g} mm and y from "
            f"{1e3 * y[0]:.4g} to {1e3 * y[1]:.4g} mm, the image only {size[1]:.4g} × "
            f"{size[0]:.4g} mm around the beam's axis: centre the grid on the object, or check its "
            "unit of length"
        )
    most = np.nanmax(np.abs(displacement), initial=0.0) if displacement.size else 0.0
    limit = math.ceil(_MAX_REACH * max(work.shape))
    pad = limit if np.isnan(displacement).any() else min(math.ceil(most) + _SPARE_PX, limit)
    low = np.maximum(np.floor(shadow[0]).astype(np.int64), first - pad)
    high = np.minimum(np.ceil(shadow[1]).astype(np.int64) + 1, last + pad)
    return np.minimum(low, first), np.maximum(high, last)


def _shadow(work: _Work) -> FloatArray:
    """Lowest and highest row and column, in px, of rays that pass through the grid."""
    (z_low, z_high), *sides = work.grid.extent
    distance = work.setup.source_object_distance
    scale = work.setup.object_pixel_size
    factors = [1.0 if math.isinf(distance) else distance / (distance + z) for z in (z_low, z_high)]
    corners = np.array([[factor * end for factor in factors for end in side] for side in sides])
    middle = (np.array(work.shape) - 1) / 2
    return np.stack([corners.min(axis=1), corners.max(axis=1)]) / scale + middle


def _ranges(shape: Shape) -> tuple[IntArray, IntArray]:
    return np.zeros(2, np.int64), np.array(shape, np.int64)


def _pixel_centres(first: IntArray, last: IntArray, fine: int) -> FloatArray:
    """Return centres of pixels, or of the parts of pixels, in px, shape (2, N)."""
    axes = [
        low - 0.5 + (np.arange((high - low) * fine) + 0.5) / fine
        for low, high in zip(first, last, strict=True)
    ]
    return np.stack(np.meshgrid(*axes, indexing="ij")).reshape(2, -1)


def _straight_rays(
    setup: ProtonSetup, shape: Shape, aim: FloatArray, start: FloatArray | None = None
) -> FloatArray:
    """Return points of the object plane (m) and unit directions as x, y, z, shape (N, 6)."""
    middle = (np.array(shape) - 1) / 2
    places = (aim - middle[:, None]) * setup.object_pixel_size
    rays = np.zeros((aim.shape[1], 6))
    rays[:, 1], rays[:, 0] = places
    rays[:, 5] = 1.0
    if not setup.is_collimated:
        slopes = (places if start is None else places - start) / setup.source_object_distance
        rays[:, 4], rays[:, 3] = slopes
        rays[:, 3:] /= np.sqrt((rays[:, 3:] ** 2).sum(axis=1))[:, None]
    return rays


def _interleave(grid: FieldGrid) -> AnyArray:
    """Return the field as the kernels take it, shape (Y, X, Z, 3) or (Y, X, Z, 6)."""
    depth, height, width = grid.shape
    parts = [grid.magnetic] if grid.electric is None else [grid.magnetic, grid.electric]
    field = np.zeros((height, width, depth, 3 * len(parts)), np.float32)
    for part, array in enumerate(parts):
        if array is None:
            continue
        for component in range(3):  # from (z, y, x) to (x, y, z)
            field[..., 3 * part + component] = np.asarray(array)[2 - component].transpose(1, 2, 0)
    return field


def _nodes(grid: FieldGrid) -> tuple[FloatArray, FloatArray]:
    """Return the place of the first node and the spacing along x, y, z in m."""
    origin = np.array([low for low, _ in grid.extent[::-1]])
    return origin, np.array(grid.spacing[::-1])


def _check_place(grid: FieldGrid, setup: ProtonSetup) -> None:
    low, high = grid.extent[0]
    source, detector = -setup.source_object_distance, setup.object_image_distance
    if not (source < low and high < detector):
        raise InputError(
            f"the grid reaches from {low:.4g} to {high:.4g} m along the beam, but the source is at "
            f"{source:.4g} m and the detector at {detector:.4g} m from the object: centre the grid "
            "on the object, or check its unit of length"
        )


def _checked_shape(shape: Shape) -> Shape:
    if len(tuple(shape)) != 2 or min(shape) < MIN_SIDE_PX:
        raise InputError(
            f"the image has shape {tuple(shape)}: expected (height, width), at least {MIN_SIDE_PX} "
            "pixels each way"
        )
    return int(shape[0]), int(shape[1])


def _checked_threads(threads: int | None) -> int | None:
    if threads is not None and threads < 1:
        raise InputError(f"threads is {threads}: expected 1 or more, or None for all cores")
    return threads


def _check_choices(options: TraceOptions, setup: ProtonSetup, spectrum: ArrayLike | None) -> None:
    if options.output == "fluence":
        names = [
            name
            for name, is_set in (
                ("source_size", options.source_size > 0),
                ("energy_spread", options.energy_spread > 0),
                ("spectrum", spectrum is not None),
                ("keep_particles", options.keep_particles),
            )
            if is_set
        ]
        if names:
            raise InputError(
                f"{' and '.join(names)} cannot be used for a fluence, which has one ray a point: "
                "use output 'counts'"
            )
    if options.source_size > 0 and setup.is_collimated:
        raise InputError(
            f"source_size is {options.source_size:g} m but the beam is collimated: leave it out"
        )
    if spectrum is not None and options.energy_spread > 0:
        raise InputError("received spectrum and energy_spread, expected one of them")
