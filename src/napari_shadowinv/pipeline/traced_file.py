"""A 3-D field in a file: its image, `trace_file`; an object to plan with, `object_of_file`."""

from __future__ import annotations

from pathlib import Path

from numpy.typing import ArrayLike

from napari_shadowinv._system.progress import OnProgress, ShouldStop
from napari_shadowinv.io.field_grids import read_field_grid
from napari_shadowinv.physics.particle_flight import check_particles
from napari_shadowinv.physics.setup import Setup
from napari_shadowinv.physics.trace_options import GridView, SizedView, TraceOptions
from napari_shadowinv.physics.tracing import TracedImage, trace
from napari_shadowinv.pipeline.experiment_object import TracedObject, object_of_field


def trace_file(
    path: Path,
    setup: Setup | None,
    *,
    view: SizedView | None = None,
    options: TraceOptions | None = None,
    source: ArrayLike | None = None,
    iteration: str | None = None,
    on_progress: OnProgress | None = None,
    should_stop: ShouldStop | None = None,
) -> TracedImage:
    """Trace particles through the field in a file.

    Parameters
    ----------
    path : Path
        An openPMD or NetCDF 4 file; see `napari_shadowinv.io.field_grids.read_field_grid`.
    setup : Setup or None
        The experiment, of particles.
    view : SizedView, optional
        Direction of the beam, and the size of the image if there is no source. Default: along z,
        with x to the right.
    options, on_progress, should_stop
        As for `napari_shadowinv.trace`.
    source : array_like, shape (H, W), optional
        Undisturbed beam. Default: 1.
    iteration : str, optional
        Iteration of an openPMD file that holds several.

    Returns
    -------
    TracedImage

    Raises
    ------
    InputError, FileFormatError
        As `read_field_grid` and `napari_shadowinv.trace`; or if the setup is none of particles.
    """
    checked = check_particles(setup)
    view = view or SizedView()
    return trace(
        view.apply(read_field_grid(path, iteration=iteration)),
        checked,
        getattr(source, "shape", (view.height, view.width)),
        options=options,
        profile=source,
        on_progress=on_progress,
        should_stop=should_stop,
    )


def object_of_file(path: Path, setup: Setup | None, view: GridView | None = None) -> TracedObject:
    """Return the field in a file as the object of a planned experiment.

    Parameters
    ----------
    path : Path
        As for `trace_file`.
    setup : Setup or None
        The experiment of the first image, of particles.
    view : GridView, optional
        Direction of the beam. Default: along z, with x to the right.

    Raises
    ------
    InputError, FileFormatError
        As `read_field_grid` and `object_of_field`.
    """
    checked = check_particles(setup)
    grid = (view or GridView()).apply(read_field_grid(path))
    return object_of_field(grid, checked, title=path.name)
