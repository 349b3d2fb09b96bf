"""Measure the particle tracer: speed, accuracy, PlasmaPy, long objects, inversions of images.

    python benchmarks/tracing.py [speed] [steps] [plasmapy] [length] [inversion]

Without a name, all parts run. PlasmaPy is compared where it is installed. Speeds are given per
second of the clock and per second of processor time and core; the latter hardly depends on what
else the machine does.
"""

from __future__ import annotations

import argparse
import importlib.util
import math
import time
import warnings
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from napari_shadowinv import ProtonSetup, trace
from napari_shadowinv._system.machine import available_threads
from napari_shadowinv.physics import FieldGrid, TraceOptions
from napari_shadowinv.physics.particle_flight import trace_particles

Array = NDArray[np.float64]

SIDE = 1e-3
SETUP = ProtonSetup(
    energy=14.7, source_object_distance=1e-2, object_image_distance=0.28, pixel_size=5e-6
)


def nodes_of(count: int, lengths: tuple[float, float, float]) -> tuple[Array, Array, Array]:
    """Places z, y, x of the nodes of a box."""
    axes = [np.linspace(-length / 2, length / 2, count) for length in lengths]
    z, y, x = np.meshgrid(*axes, indexing="ij")
    return z, y, x


def spacing_of(count: int, lengths: tuple[float, float, float]) -> tuple[float, ...]:
    return tuple(length / (count - 1) for length in lengths)


def rod(peak: float, length: float = SIDE, nodes: int = 97) -> FieldGrid:
    """An azimuthal field about the beam, Gaussian across it and uniform along it.

    `peak` is its largest line integral in T m.
    """
    box = (length, SIDE, SIDE)
    _, y, x = nodes_of(nodes, box)
    width = SIDE / 9
    profile = np.exp(-(x**2 + y**2) / (2 * width**2)) * peak * math.exp(0.5) / (width * length)
    return FieldGrid(np.stack([0 * x, -x * profile, y * profile]), spacing=spacing_of(nodes, box))


def toroid(peak: float, nodes: int = 97) -> FieldGrid:
    """An azimuthal field about the beam, Gaussian across and along it, in 1 mm.

    `peak` is its largest line integral in T m.
    """
    box = (1.3 * SIDE, SIDE, SIDE)
    z, y, x = nodes_of(nodes, box)
    width, depth = SIDE / 9, SIDE / (2 * math.sqrt(2 * math.log(100)))
    profile = np.exp(-(x**2 + y**2) / (2 * width**2) - z**2 / (2 * depth**2))
    profile *= peak * math.exp(0.5) / (width * depth * math.sqrt(2 * math.pi))
    return FieldGrid(np.stack([0 * x, -x * profile, y * profile]), spacing=spacing_of(nodes, box))


def turbulence(rms: float, nodes: int = 97, slope: float = -11 / 3, seed: int = 0) -> FieldGrid:
    """A random field without divergence in a cube, `rms` in T, that fades towards the faces."""
    z, y, x = nodes_of(nodes, (SIDE,) * 3)
    numbers = np.fft.fftfreq(nodes, 1 / nodes)
    kz, ky, kx = np.meshgrid(numbers, numbers, numbers, indexing="ij")
    k = np.sqrt(kx**2 + ky**2 + kz**2)
    amplitude = np.where((k >= 3) & (k <= 14), np.maximum(k, 1) ** (slope / 2 - 1), 0.0)
    noise = np.random.default_rng(seed).normal(size=(3, nodes, nodes, nodes))
    potential = np.fft.ifftn(np.fft.fftn(noise, axes=(1, 2, 3)) * amplitude, axes=(1, 2, 3)).real
    fade = np.prod([np.cos(math.pi * at / SIDE) ** 2 for at in (z, y, x)], axis=0)
    az, ay, ax = potential * fade
    step = SIDE / (nodes - 1)

    def slope_along(values: Array, axis: int) -> Array:
        return np.asarray(np.gradient(values, step, axis=axis))

    field = np.stack(
        [
            slope_along(ay, 2) - slope_along(ax, 1),
            slope_along(ax, 0) - slope_along(az, 2),
            slope_along(az, 1) - slope_along(ay, 0),
        ]
    )
    middle = (slice(None), *(slice(nodes // 4, -nodes // 4),) * 3)
    field *= rms / np.sqrt((field[middle] ** 2).sum(axis=0).mean())
    return FieldGrid(field, spacing=(step,) * 3)


def bubble(peak: float, nodes: int = 129) -> FieldGrid:
    """A laser-driven bubble seen face-on: an azimuthal field in a thin hemispherical shell."""
    z, y, x = nodes_of(nodes, (SIDE,) * 3)
    z = z + SIDE / 4
    radius, width = 0.3 * SIDE, 0.05 * SIDE
    distance = np.sqrt(x**2 + y**2 + z**2) + 1e-12
    shell = np.exp(-((distance - radius) ** 2) / (2 * width**2)) / distance
    shell *= peak * 0.5 * (1 + np.tanh(z / width))
    return FieldGrid(np.stack([0 * x, -x * shell, y * shell]), spacing=(SIDE / (nodes - 1),) * 3)


def relative(values: Array, truth: Array) -> float:
    return float(np.linalg.norm(values - truth) / np.linalg.norm(truth))


def measure_speed() -> None:
    """Print the particle steps a second on a grid of 128³ nodes."""
    values = np.random.default_rng(0).normal(size=(2, 3, 128, 128, 128)).astype(np.float32)
    spacing = (SIDE / 127,) * 3
    grids = {
        "B": FieldGrid(100 * values[0], spacing=spacing),
        "E and B": FieldGrid(100 * values[0], 1e8 * values[1], spacing=spacing),
    }
    side = 200
    aim = np.stack(np.mgrid[:side, :side]).reshape(2, -1) * (160 / side) - 80
    trace_particles(grids["B"], SETUP, aim[:, :100])
    for name, grid in grids.items():
        for threads in (1, available_threads(None)):
            best = [0.0, 0.0]
            for _ in range(5):
                clock, processor = time.perf_counter(), time.process_time()
                steps = int(trace_particles(grid, SETUP, aim, threads=threads).steps.sum())
                clock = time.perf_counter() - clock
                processor = time.process_time() - processor
                best = [max(best[0], steps / clock), max(best[1], steps / processor)]
            print(
                f"speed   {name:8} {threads} threads: {best[0]:.3g} steps/s, "
                f"{best[1]:.3g} per processor second ({steps:.3g} steps)"
            )


def measure_steps() -> None:
    """Print the error of the deflection by the length of a step."""
    aim = np.random.default_rng(0).uniform(-60, 60, (2, 2000))
    grids = {"toroid": toroid(0.02), "turbulence": turbulence(50.0), "bubble": bubble(100.0)}
    for name, grid in grids.items():
        exact = trace_particles(grid, SETUP, aim, options=TraceOptions(step=0.02)).deflection
        for step in (1.0, 0.5, 0.25):
            options = TraceOptions(step=step)
            deflection = trace_particles(grid, SETUP, aim, options=options).deflection
            print(f"steps   {name:10} step {step:4} cells: {relative(deflection, exact):.2e}")


def compare_with_plasmapy(grid: FieldGrid, count: int = 1000, courant: float = 0.25) -> float:
    """Return the relative r.m.s. difference of the deflections from those by PlasmaPy.

    Both start the same particles on the first face of the grid. `courant` is the time step of
    PlasmaPy in cells.
    """
    import astropy.units as u
    from plasmapy.particles import Particle
    from plasmapy.plasma.grids import CartesianGrid
    from plasmapy.simulation.particle_tracker.particle_tracker import ParticleTracker
    from plasmapy.simulation.particle_tracker.termination_conditions import (
        TimeElapsedTerminationCondition,
    )

    setup = SETUP
    low, high = (np.array(ends)[::-1] for ends in zip(*grid.extent, strict=True))
    aim = np.random.default_rng(2).uniform(-0.35, 0.35, (2, count)) * SIDE
    pixels = aim / setup.object_pixel_size
    ours = trace_particles(grid, setup, pixels)

    directions = np.stack([aim[1], aim[0], np.full(count, setup.source_object_distance)], axis=1)
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    start = np.stack([aim[1], aim[0], np.zeros(count)], axis=1)
    start += directions * ((low[2] + 1e-9 - start[:, 2]) / directions[:, 2])[:, None]
    velocity = directions * setup.velocity
    fields = {}
    for symbol, array, unit in (
        ("B", grid.magnetic, u.T),
        ("E", grid.electric, u.V / u.m),
    ):
        if array is not None:
            for k, axis in enumerate("zyx"):
                fields[f"{symbol}_{axis}"] = np.asarray(array[k]).transpose(2, 1, 0) * unit
    step = courant * min(grid.spacing) / setup.velocity * u.s
    duration = 1.2 * grid.length / setup.velocity * u.s
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        theirs = CartesianGrid(low * u.m, high * u.m, num=grid.shape[::-1])
        theirs.add_quantities(**fields)
        tracker = ParticleTracker(
            theirs,
            termination_condition=TimeElapsedTerminationCondition(duration),
            dt=step,
            verbose=False,
        )
        tracker.load_particles(start * u.m, velocity * u.m / u.s, Particle("p+"))
        tracker.run()
    end = tracker.v
    angles = np.arctan2(end[:, 1::-1], end[:, 2:]) - np.arctan2(velocity[:, 1::-1], velocity[:, 2:])
    return relative(ours.deflection, angles.T)


def measure_plasmapy() -> None:
    """Print the difference from PlasmaPy, particle by particle."""
    if importlib.util.find_spec("plasmapy") is None:
        print("plasmapy  not installed: pip install plasmapy")
        return
    magnetic = toroid(0.02)
    electric = np.asarray(magnetic.magnetic)[[0, 2, 1]] * 1e7
    grids = {
        "toroid, B": magnetic,
        "toroid, E": FieldGrid(electric=electric, spacing=magnetic.spacing),
        "toroid, both": FieldGrid(magnetic.magnetic, electric, spacing=magnetic.spacing),
        "turbulence": turbulence(50.0),
        "bubble": bubble(100.0),
    }
    for name, grid in grids.items():
        texts = [
            f"{compare_with_plasmapy(grid, courant=courant):.2e} ({courant} cells)"
            for courant in (0.5, 0.25, 0.1)
        ]
        print(f"plasmapy  {name:12} r.m.s. difference with its steps: {', '.join(texts)}")


def measure_length() -> None:
    """Print how far the displacement of a long object is from that of a thin one."""
    print("length  of the object over source distance; r.m.s. contrast of the image;")
    print("        difference of the displacement from the line integral along diverging rays,")
    print("        and along parallel ones")
    for share in (0.02, 0.05, 0.1, 0.2, 0.4):
        for peak in (1e-5, 2e-3, 5e-3, 1e-2):
            long, short = (rod(peak, part * SETUP.source_object_distance) for part in (share, 1e-3))
            traced = trace(long, SETUP, options={"rays_per_pixel": 1})
            thin = trace(short, SETUP, options={"rays_per_pixel": 1}).thin_displacement
            contrast, error = traced.image.std(), traced.thin_screen_error
            parallel = relative(traced.displacement, thin)
            print(f"length  {share:4}  contrast {contrast:.3f}  {error:7.2%}  {parallel:7.2%}")


def measure_inversion() -> None:
    """Print the errors of inversions of traced images against the true line integrals."""
    from napari_shadowinv import invert

    thick = 0.2 * SETUP.source_object_distance
    objects: dict[str, Callable[[float], FieldGrid]] = {
        "turbulence": turbulence,
        "rod of 1 mm": lambda peak: rod(peak),
        "rod of 2 mm": lambda peak: rod(peak, thick),
        "bubble": bubble,
    }
    strengths = {
        "turbulence": (2.0, 5.0),
        "rod of 1 mm": (3e-3, 6e-3),
        "rod of 2 mm": (3e-3, 6e-3),
        "bubble": (20.0, 30.0),
    }
    for name, make in objects.items():
        for strength in strengths[name]:
            traced = trace(make(strength), SETUP)
            inversion = invert(traced.image)
            field = SETUP.path_integrated_b(inversion.displacement)
            print(
                f"inversion  {name:11} ({strength:g}): "
                f"image contrast {traced.image.std():.2f} r.m.s., "
                f"∫B dz {relative(field, traced.path_integrated_b):.1%} L2 from the truth, "
                f"displacement {relative(inversion.displacement, traced.displacement):.1%}; "
                f"thin-screen error {traced.thin_screen_error:.1%}"
            )


PARTS = {
    "speed": measure_speed,
    "steps": measure_steps,
    "plasmapy": measure_plasmapy,
    "length": measure_length,
    "inversion": measure_inversion,
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("parts", nargs="*", choices=[*PARTS, []], help="default: all")
    for part in parser.parse_args().parts or PARTS:
        PARTS[part]()


if __name__ == "__main__":
    main()
