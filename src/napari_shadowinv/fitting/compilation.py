"""The compiler's work before a first fit, done once after an installation.

- do it before a fit that somebody waits for: `ensure_compiled`
- whether it was done: `is_compiled`
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from napari_shadowinv._system.progress import OnProgress, Reporter, ShouldStop
from napari_shadowinv.fitting import _ray_kernels
from napari_shadowinv.fitting.rays import RayModel, TracedBeam
from napari_shadowinv.geometry.compiler import has_machine_code
from napari_shadowinv.inversion import compilation as of_transport
from napari_shadowinv.inversion.machine_code import compilation_frequency

_KERNELS: tuple[Any, ...] = tuple(
    kernel
    for name, kernel in vars(_ray_kernels).items()
    if hasattr(kernel, "py_func") and not name.startswith("_")
)


def ensure_compiled(
    on_progress: OnProgress | None = None, should_stop: ShouldStop | None = None
) -> None:
    """Compile the kernels of ray tracing and of starts from transport unless that was done."""
    if not is_compiled():
        _compile_rays(Reporter(on_progress, should_stop))
    of_transport.ensure_compiled(on_progress, should_stop)


def is_compiled() -> bool:
    """Return whether this or an earlier run has compiled the kernels that trace rays."""
    return all(map(has_machine_code, _KERNELS))


def _compile_rays(report: Reporter) -> None:
    rays = RayModel((8, 8), threads=1)
    potential = np.zeros(rays.shape)
    traced = TracedBeam(potential, rays.ray_counts(potential), rays.around(np.ones(rays.size)))
    weights = np.ones(rays.seen)

    def use_jacobian() -> None:
        jacobian = rays.jacobian(traced)
        columns = rays.pull(jacobian, rays.push(jacobian, np.zeros(jacobian.shape[1])))
        rays.normal_times([jacobian], [columns], [weights], [weights], [weights])
        potentials = potential[None]
        _ray_kernels.add_ties(potentials, potential > 0, 1.0, 1.0, np.zeros(potentials.shape))

    works: tuple[Callable[[], object], ...] = (
        lambda: rays.image(traced),
        lambda: rays.gradient(traced, weights),
        use_jacobian,
    )
    for step, work in enumerate(works):
        report("compile", step, None, "rays, " + compilation_frequency())
        work()
