"""Images by charged particles that are traced through a 3-D field: `trace`.

- the image of a field on a grid: `trace`, with `TraceOptions`; the answer is a `TracedImage`
- displacements alone: `traced_displacement`

Nothing is assumed of the object: it may be thick, its fields may bend the particles inside it and
change their energy. So a traced image checks inversion and fit, which hold the
object for thin. Outside the grid particles fly straight, inside they are pushed by the
relativistic Boris scheme of `napari_shadowinv.physics.particle_push`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.ndimage import distance_transform_edt

from napari_shadowinv import __version__
from napari_shadowinv._system.progress import OnProgress, Reporter, ShouldStop
from napari_shadowinv._system.safety import check_memory
from napari_shadowinv._system.validation import as_model
from napari_shadowinv._typing import AnyArray, FloatArray, IntArray
from napari_shadowinv.errors import InputError
from napari_shadowinv.facts import Fact, Level, Summarised, percent
from napari_shadowinv.physics.arrays import (
    PLANE,
    VECTOR,
    as_numbers,
    block_sums,
    check_finite,
    check_shape,
    plain_array,
)
from napari_shadowinv.physics.field_grid import FieldGrid, field_grid
from napari_shadowinv.physics.forward import checked_shape, synthetic_image, usable_threads
from napari_shadowinv.physics.particle_flight import (
    PARTICLES_PER_BLOCK,
    Flight,
    Shape,
    TracedParticles,
    check_particles,
    image_range,
    line_integrals,
    pixel_centres,
)
from napari_shadowinv.physics.setup import ProtonSetup
from napari_shadowinv.physics.trace_options import TraceOptions
from napari_shadowinv.physics.units import label, vector_coordinates

if TYPE_CHECKING:
    import xarray

Profile = ArrayLike | Callable[[FloatArray, FloatArray], ArrayLike]

_MAX_THIN_ERROR = 0.05  # beyond it, the line integral is no good description
_MAX_EDGE_SHARE = 0.1


@dataclass(frozen=True, eq=False, repr=False)
class TracedImage(Summarised):
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

    @property
    def facts(self) -> tuple[Fact, ...]:
        """The result in words."""
        noun = "particles" if self.options.output == "counts" else "rays"
        counts = (
            f"{self.launched} {noun}: {self.landed} in the image, {self.outside} outside, "
            f"{self.lost} lost"
        )
        fields = (self.path_integrated_b, self.path_integrated_e)
        field_b, field_e = (float(np.hypot(*field).max()) for field in fields)
        peaks = [f"∫B dz {field_b:.3g} T m"] if field_b else []
        peaks += [f"∫E dz {field_e:.3g} V"] if field_e else []
        thin = self.thin_screen_error
        length = 1e3 * self.length
        thin_text = f"{percent(thin)} r.m.s. of the displacement; the grid is {length:.3g} mm long"
        thin_level = Level.DOUBTFUL if thin > _MAX_THIN_ERROR else Level.SOUND
        facts = [
            Fact("landed", noun.capitalize(), counts, Level.DOUBTFUL if self.lost else Level.SOUND),
            Fact("peak", "Peak", ", ".join(peaks) or "no field across the beam"),
            Fact("thin_screen_error", "Thin-screen error", thin_text, thin_level),
        ]
        if self.edge_share > _MAX_EDGE_SHARE:
            edge_text = (
                f"the field on the faces reaches {percent(self.edge_share)} of its peak: beyond "
                "them it is taken as zero, so the image has edges that the object has not"
            )
            facts.append(Fact("edge_share", "Edge of the grid", edge_text, Level.DOUBTFUL))
        return tuple(facts)

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
            variables[name] = VECTOR, getattr(self, name), label(units, long_name)
        coords = vector_coordinates(self.image.shape, size)
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
        Fluence or counts, source size, energy spread, accuracy, seed, threads.
    profile : array_like of shape (H, W), or callable, optional
        Fluence of the beam on the object plane. An array covers the image and is constant within
        a pixel; a function is called with arrays of y and x in m from the middle of the image,
        also for points outside it. Default: 1 everywhere.
    spectrum : array_like, shape (2, n), optional
        Energies in MeV, increasing, and the number of particles per MeV there, linear in between;
        for counts. Default: the energy of the setup with the spread of the options.
    on_progress, should_stop : callable, optional
        Receives a `Progress`; ends the work when it returns true.

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
    The direction of a particle changes by the exact angle in each step, so its error is by
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
    >>> round(float(traced.path_integrated_b[0, 10, 10]), 5)  # T m
    0.008
    """
    grid = field_grid(field)
    check_particles(setup)
    options = as_model(TraceOptions, options, "options")
    shape = checked_shape(shape)
    _check_choices(options, setup, spectrum)
    report, threads = Reporter(on_progress, should_stop), options.threads
    report("field", 0)
    flight = Flight(grid, setup, shape, options, usable_threads(threads), report)
    centres = pixel_centres(*image_range(shape), 1)
    straight = flight.push(centres, "rays")
    plane = (2, *shape)
    lines = line_integrals(grid, setup, shape, threads=threads)
    reach = _reach(flight, straight.displacement)
    if options.output == "counts":
        exposure = _count(flight, reach, profile, _energies(flight, spectrum), options.seed)
    else:
        exposure = _fluence(flight, reach, profile, threads)
    return TracedImage(
        **vars(exposure) | {"steps": int(straight.steps.sum()) + exposure.steps},
        displacement=straight.displacement.reshape(plane),
        deflection=straight.deflection.reshape(plane),
        path_integrated_b=lines[:2],
        path_integrated_e=lines[2:],
        outside=exposure.launched - exposure.landed - exposure.lost,
        setup=setup,
        options=options,
        length=grid.length,
        edge_share=grid.edge_share,
    )


def traced_displacement(
    field: FieldGrid, setup: ProtonSetup, shape: Shape = (200, 200)
) -> FloatArray:
    """Return the displacement, (2, H, W) in px, of the ray through each pixel, without an image.

    Takes the arguments of `trace`, and raises its errors; also if a ray misses the detector.
    """
    check_particles(setup)
    size, threads = checked_shape(shape), usable_threads(None)
    flight = Flight(field_grid(field), setup, size, TraceOptions(), threads, Reporter())
    rays = flight.push(pixel_centres(*image_range(size), 1), "rays")
    if rays.lost.any():
        raise InputError(
            f"{rays.lost.sum()} of {rays.lost.size} particles do not reach the detector: expected "
            "a weaker field or a higher energy"
        )
    return np.asarray(rays.displacement.reshape(2, *size))


@dataclass(frozen=True, eq=False)
class _Exposure:
    """An image, the beam without object, and numbers of particles; with the particles if kept."""

    image: FloatArray
    source: FloatArray
    launched: int
    landed: int
    lost: int
    steps: int
    particles: TracedParticles | None = None


def _fluence(
    flight: Flight, reach: tuple[IntArray, IntArray], profile: Profile | None, threads: int | None
) -> _Exposure:
    fine = math.isqrt(flight.options.rays_per_pixel - 1) + 1
    first, last = reach
    size = tuple((last - first) * fine)
    check_memory(size, 160, "an image")
    rays = flight.push(pixel_centres(first, last, fine), "rays")
    displacement = (fine * rays.displacement).reshape(2, *size)
    flux = _beam(flight, profile, first, last, fine) / fine**2
    lost = rays.lost.reshape(size)
    if lost.any() and not lost.all():
        # Rays that are lost carry nothing; the spline needs a value there.
        nearest = distance_transform_edt(lost, return_distances=False, return_indices=True)
        displacement = displacement[:, nearest[0], nearest[1]]
    flux = np.where(lost, 0.0, flux)
    cut = tuple(slice(-low, height - low) for low, height in zip(first, flight.shape, strict=True))
    image = np.zeros(size)
    if flux.any():
        image = synthetic_image(displacement, flux, rays_per_pixel=4, threads=threads)
    source = _beam(flight, profile, *image_range(flight.shape), 1)
    inside = _is_inside(rays.landing, flight.shape)
    numbers = lost.size, int(inside.sum()), int(lost.sum()), int(rays.steps.sum())
    return _Exposure(block_sums(image, fine)[cut], source, *numbers)


def _count(
    flight: Flight,
    reach: tuple[IntArray, IntArray],
    profile: Profile | None,
    energies: Callable[[np.random.Generator, int], FloatArray],
    seed: int,
) -> _Exposure:
    first, last = reach
    options = flight.options
    beam = _beam(flight, profile, first, last, 1)
    source = _beam(flight, profile, *image_range(flight.shape), 1)
    if not source.sum() > 0:
        raise InputError("the profile is zero in the whole image: expected some fluence")
    scale = options.counts / source.mean()
    cumulative = np.cumsum(beam.ravel())
    total = round(float(cumulative[-1]) * scale)
    cumulative /= cumulative[-1]
    image = np.zeros(flight.shape[0] * flight.shape[1], np.int64)
    landed = lost = steps = 0
    batches: list[TracedParticles] = []
    for block, at in enumerate(range(0, total, PARTICLES_PER_BLOCK)):
        flight.report("particles", at, total)
        generator = np.random.default_rng([seed, block])
        count = min(PARTICLES_PER_BLOCK, total - at)
        # In the order of the pixels, so that neighbours use the same part of the field.
        pixels = np.sort(np.searchsorted(cumulative, generator.random(count), side="right"))
        rows, columns = np.divmod(pixels, beam.shape[1])
        aim = np.stack([rows, columns]) + first[:, None] + generator.random((2, count)) - 0.5
        start = options.source_size * generator.standard_normal((2, count))
        particles = flight.push(aim, "particles", energies(generator, count), start)
        inside = _is_inside(particles.landing, flight.shape)
        row, column = np.floor(particles.landing[:, inside] + 0.5).astype(np.int64)
        image += np.bincount(row * flight.shape[1] + column, minlength=image.size)
        landed += int(inside.sum())
        lost += int(particles.lost.sum())
        steps += int(particles.steps.sum())
        if options.keep_particles:
            batches.append(particles)
    all_particles = None
    if batches:
        arrays = zip(*(vars(batch).values() for batch in batches), strict=True)
        all_particles = TracedParticles(*(np.concatenate(parts, axis=-1) for parts in arrays))
    counts = image.reshape(flight.shape).astype(np.float64)
    return _Exposure(counts, source * scale, total, landed, lost, steps, all_particles)


def _is_inside(landing: FloatArray, shape: Shape) -> AnyArray:
    """Return whether points in px lie in the image; NaN does not."""
    size = np.array(shape)[:, None]
    return np.asarray(((landing >= -0.5) & (landing < size - 0.5)).all(axis=0))


def _energies(
    flight: Flight, spectrum: ArrayLike | None
) -> Callable[[np.random.Generator, int], FloatArray]:
    """Return a function that draws kinetic energies in MeV."""
    centre, spread = flight.setup.energy, flight.options.energy_spread
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
    # Four standard deviations reach down to zero energy at most.
    return lambda generator, count: (
        centre + spread * np.clip(generator.standard_normal(count), -3.9, 3.9)
    )


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
    return np.asarray(energy[part] + np.clip(way, 0.0, width))


def _beam(
    flight: Flight, profile: Profile | None, first: IntArray, last: IntArray, fine: int
) -> FloatArray:
    """Return the fluence on the object plane, at the centres of pixels or of parts of them."""
    size = tuple((last - first) * fine)
    if profile is None:
        return np.ones(size)
    if callable(profile):
        size_m = flight.setup.object_pixel_size
        middle = (np.array(flight.shape) - 1) / 2
        y, x = (pixel_centres(first, last, fine) - middle[:, None]) * size_m
        values: Any = np.asarray(profile(y.reshape(size), x.reshape(size)), dtype=np.float64)
        beam: AnyArray = np.broadcast_to(values, size) if values.ndim == 0 else values
        if beam.shape != size:
            raise InputError(
                f"the profile returned shape {beam.shape} for points of shape {size}: they must "
                "match"
            )
    else:
        plane = np.asarray(plain_array(profile, "profile"), dtype=np.float64)
        check_shape("profile", plane.shape, flight.shape)
        padding = [(-low, high - n) for low, high, n in zip(first, last, flight.shape, strict=True)]
        beam = np.kron(np.pad(plane, padding), np.ones((fine, fine)))
    check_finite("profile", beam)
    if beam.min() < 0:
        raise InputError(f"profile has negative values (lowest {beam.min():g}): expected 0 or more")
    return np.array(beam)


def _reach(
    flight: Flight, displacement: FloatArray, *, count: int = 64, spare: int = 2
) -> tuple[IntArray, IntArray]:
    """Return the first pixel and the one behind the last that rays are aimed at, along y and x.

    Rays from outside the image may be deflected into it. They pass through the grid, and start no
    farther outside than the field moves them, and `spare` px. How far that is, `count` rays each
    way through the whole grid show.
    """
    first, last = image_range(flight.shape)
    shadow = _shadow(flight)
    if (shadow[1] < -0.5).any() or (shadow[0] > last - 0.5).any():
        (_, y, x), size = flight.grid.extent, 1e3 * flight.setup.object_pixel_size * last
        raise InputError(
            f"the grid covers x from {1e3 * x[0]:.4g} to {1e3 * x[1]:.4g} mm and y from "
            f"{1e3 * y[0]:.4g} to {1e3 * y[1]:.4g} mm, the image only {size[1]:.4g} × "
            f"{size[0]:.4g} mm around the beam's axis: centre the grid on the object, or check its "
            "unit of length"
        )
    low, high = np.floor(shadow[0]).astype(np.int64), np.ceil(shadow[1]).astype(np.int64) + 1
    samples = [np.linspace(start, end, count) for start, end in shadow.T]
    elsewhere = flight.push(np.stack(np.meshgrid(*samples)).reshape(2, -1), "rays").displacement
    moves = np.concatenate([displacement, elsewhere], axis=1)
    if not np.isnan(moves).any():
        pad = math.ceil(np.abs(moves).max()) + spare
        low, high = np.maximum(low, first - pad), np.minimum(high, last + pad)
    return np.minimum(low, first), np.maximum(high, last)


def _shadow(flight: Flight) -> FloatArray:
    """Lowest and highest row and column, in px, of rays that pass through the grid."""
    (z_low, z_high), *sides = flight.grid.extent
    distance = flight.setup.source_object_distance
    scale = flight.setup.object_pixel_size
    factors = [1.0 if math.isinf(distance) else distance / (distance + z) for z in (z_low, z_high)]
    corners = np.array([[factor * end for factor in factors for end in side] for side in sides])
    middle = (np.array(flight.shape) - 1) / 2
    return np.stack([corners.min(axis=1), corners.max(axis=1)]) / scale + middle


def _check_choices(options: TraceOptions, setup: ProtonSetup, spectrum: ArrayLike | None) -> None:
    if options.output == "fluence":
        choices = {
            "source_size": options.source_size > 0,
            "energy_spread": options.energy_spread > 0,
            "spectrum": spectrum is not None,
            "keep_particles": options.keep_particles,
        }
        names = [name for name, is_set in choices.items() if is_set]
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
