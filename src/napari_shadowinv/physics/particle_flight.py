"""Flight of charged particles from the source through a field on a grid to the detector.

- particles that are aimed at points of the object plane: `trace_particles`; they are
  `TracedParticles`
- the exact line integrals of a grid along straight rays: `line_integrals`
- for an image: `Flight`, `pixel_centres`

Outside the grid particles fly straight; inside they are pushed by the kernels of `particle_push`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy import constants

from napari_shadowinv._system.machine import in_ranges
from napari_shadowinv._system.progress import Reporter
from napari_shadowinv._system.validation import as_model
from napari_shadowinv._typing import AnyArray, FloatArray, IntArray
from napari_shadowinv.errors import InputError
from napari_shadowinv.physics.arrays import as_numbers, check_finite
from napari_shadowinv.physics.field_grid import FieldGrid, field_grid
from napari_shadowinv.physics.forward import checked_shape, usable_threads
from napari_shadowinv.physics.particle_push import (
    TRAPPED,
    UNTOUCHED,
    integrate_rays,
    push_particles,
)
from napari_shadowinv.physics.setup import ProtonSetup
from napari_shadowinv.physics.trace_options import TraceOptions

Shape = tuple[int, int]

_JOULES_PER_MEV = 1e6 * constants.e
_LIGHT_SPEED = constants.c
PARTICLES_PER_BLOCK = 1 << 17
"""Particles that are traced, and drawn, together: the random numbers depend on it."""
_SMALLEST_RANGE = 256  # particles for a thread


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
        Kinetic energies in MeV. Default: the setup's energy.
    start : array_like, shape (2, N), optional
        Points of the source in m from its middle, axis order (y, x). Default: its middle.

    Raises
    ------
    InputError
        As `trace`; or if the arrays do not match.
    """
    grid = field_grid(field)
    check_particles(setup)
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
    flight = Flight(grid, setup, shape, options, usable_threads(threads), Reporter())
    return flight.push(points, "particles", energies, starts)


def line_integrals(
    field: Any, setup: ProtonSetup, shape: Shape, *, threads: int | None = None
) -> FloatArray:
    """Integrate a field over z along the straight rays from the source through the pixels' centres.

    Takes the arguments of `trace`, and raises its errors. Returns ∫B_y dz and ∫B_x dz in T m, ∫E_y
    dz and ∫E_x dz in V, (4, H, W); exact for a field that is trilinear between the nodes.
    """
    grid = field_grid(field)
    check_particles(setup)
    _check_place(grid, setup)
    shape = checked_shape(shape)
    rays = straight_rays(setup, shape, pixel_centres(*image_range(shape), 1))
    integrals = np.zeros((len(rays), 4 if grid.electric is not None else 2))
    in_ranges(
        integrate_rays,
        len(rays),
        usable_threads(threads),
        *_interleave(grid),
        rays,
        integrals,
        smallest=_SMALLEST_RANGE,
    )
    planes = np.zeros((4, *shape))
    planes[: integrals.shape[1]] = integrals.T.reshape(-1, *shape)
    return planes


class Flight:
    """A field ready for the kernels, with the experiment around it."""

    def __init__(
        self,
        grid: FieldGrid,
        setup: ProtonSetup,
        shape: Shape,
        options: TraceOptions,
        threads: int,
        report: Reporter,
        *,
        max_path: float = 20.0,  # diagonals of the grid, beyond which a particle is trapped
    ) -> None:
        _check_place(grid, setup)
        self.grid, self.setup, self.shape, self.options = grid, setup, shape, options
        self.threads, self.report = threads, report
        self.field = _interleave(grid)
        particle = setup.particle
        self.rest_energy = particle.mass * _LIGHT_SPEED**2 / _JOULES_PER_MEV
        self.charge = particle.charge / (particle.mass * _LIGHT_SPEED)
        self.peaks = np.array([grid.peak("magnetic"), grid.peak("electric") / _LIGHT_SPEED])
        diagonal = math.hypot(*((n - 1) * d for n, d in zip(grid.shape, grid.spacing, strict=True)))
        self.max_path = max_path * diagonal
        self._check_strength(setup.energy)

    def _check_strength(self, energy: float, *, max_steps: int = 10_000_000) -> None:
        u = float(self.momenta(np.array([energy]))[0])
        gamma = math.hypot(1.0, u)
        strength = abs(self.charge) * (self.peaks[0] + self.peaks[1] * gamma / u)
        if not math.isfinite(strength * self.max_path) or (
            strength * self.grid.length / self.options.max_turn > max_steps
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
        return np.asarray(np.sqrt(ratio * (ratio + 2)))

    def push(
        self,
        aim: FloatArray,
        stage: str,
        energy: FloatArray | None = None,
        start: FloatArray | None = None,
    ) -> TracedParticles:
        """Trace particles to the detector; aims in px, energies in MeV, starts in m."""
        energies = np.full(aim.shape[1], self.setup.energy) if energy is None else energy
        particles = straight_rays(self.setup, self.shape, aim, start)
        particles[:, 3:] *= self.momenta(energies)[:, None]
        straight = particles.copy()
        status, steps = self._push_through_grid(particles, stage)
        if not np.isfinite(particles).all():
            bad = int((~np.isfinite(particles)).any(axis=1).sum())
            raise InputError(
                f"{bad} particles left the range of floating-point numbers: check the unit of the "
                "field and the energy"
            )
        # They are compared with a flight without field.
        distance = self.setup.object_image_distance
        lost = (status == TRAPPED) | (particles[:, 5] <= 0) | (particles[:, 2] > distance)
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
        squares, last_squares = ((state[:, 3:] ** 2).sum(axis=1) for state in (straight, particles))
        gammas = np.sqrt(1 + squares), np.sqrt(1 + last_squares)
        change = (last_squares - squares) / (gammas[0] + gammas[1]) * self.rest_energy
        # Without the object the landing point is the aim, moved by the source's own size.
        shift: FloatArray | float = 0.0
        if start is not None and not self.setup.is_collimated:
            ratio = self.setup.object_image_distance / self.setup.source_object_distance
            shift = start * ratio / self.setup.pixel_sizes[1]
        return TracedParticles(
            aim=aim,
            displacement=displacement,
            deflection=deflection,
            energy=energies,
            energy_change=np.where(status == UNTOUCHED, 0.0, change),
            lost=lost,
            landing=aim - shift + displacement,
            steps=steps,
        )

    def _push_through_grid(self, particles: FloatArray, stage: str) -> tuple[AnyArray, AnyArray]:
        """Move particles to where they leave the grid; return their status and their steps."""
        count = len(particles)
        status, steps = np.zeros(count, np.int8), np.zeros(count, np.int32)
        longest = self.options.step * min(self.grid.spacing)
        limits = self.charge, longest, self.options.max_turn, self.peaks, self.max_path
        for first in range(0, count, PARTICLES_PER_BLOCK):
            self.report(stage, first, count)
            block = slice(first, first + PARTICLES_PER_BLOCK)
            moved = particles[block], status[block], steps[block]
            arguments = *self.field, *moved, *limits
            in_ranges(
                push_particles, len(moved[0]), self.threads, *arguments, smallest=_SMALLEST_RANGE
            )
        return status, steps


def straight_rays(
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


def _interleave(grid: FieldGrid) -> tuple[AnyArray, FloatArray, FloatArray]:
    """Return the field as the kernels take it, its first node and the spacing of x, y, z in m."""
    depth, height, width = grid.shape
    parts = [grid.magnetic] if grid.electric is None else [grid.magnetic, grid.electric]
    field = np.zeros((height, width, depth, 3 * len(parts)), np.float32)
    for part, array in enumerate(parts):
        if array is None:
            continue
        for component in range(3):  # from (z, y, x) to (x, y, z)
            field[..., 3 * part + component] = np.asarray(array)[2 - component].transpose(1, 2, 0)
    origin = np.array([low for low, _ in grid.extent[::-1]])
    return field, origin, np.array(grid.spacing[::-1])


def _check_place(grid: FieldGrid, setup: ProtonSetup) -> None:
    low, high = grid.extent[0]
    source, detector = -setup.source_object_distance, setup.object_image_distance
    if not (source < low and high < detector):
        raise InputError(
            f"the grid reaches from {low:.4g} to {high:.4g} m along the beam, but the source is at "
            f"{source:.4g} m and the detector at {detector:.4g} m from the object: centre the grid "
            "on the object, or check its unit of length"
        )


def image_range(shape: Shape) -> tuple[IntArray, IntArray]:
    """Return the first pixel and the one behind the last along y and x."""
    return np.zeros(2, np.int64), np.array(shape, np.int64)


def pixel_centres(first: IntArray, last: IntArray, fine: int) -> FloatArray:
    """Return centres of pixels, or of the parts of pixels, in px, shape (2, N)."""
    axes = [
        low - 0.5 + (np.arange((high - low) * fine) + 0.5) / fine
        for low, high in zip(first, last, strict=True)
    ]
    return np.stack(np.meshgrid(*axes, indexing="ij")).reshape(2, -1)


def check_particles(setup: Any) -> ProtonSetup:
    """Return the setup, or raise an `InputError` if it is none of charged particles."""
    if not isinstance(setup, ProtonSetup):
        kind = f"setup is of {setup.beam}" if hasattr(setup, "beam") else f"setup is {setup!r:.60}"
        raise InputError(
            f"{'there is no setup' if setup is None else kind}: expected one of charged particles, "
            "with energy, distances and pixel size, to trace them through a 3-D field"
        )
    return setup
