"""The command `plan`: whether an experiment would determine a field, before its shot."""

from __future__ import annotations

import os
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from typer import Exit, Option

from napari_shadowinv._system.tables import write_cells
from napari_shadowinv.cli import _flags
from napari_shadowinv.cli._inputs import read_setup
from napari_shadowinv.cli._outputs import Outputs, figure_beside
from napari_shadowinv.cli._settings import Sections, Settings, settings_of
from napari_shadowinv.cli._summary import fact_rows, headline_row
from napari_shadowinv.cli._terminal import EXIT_NOT_CONVERGED, notify_errors, work_callbacks
from napari_shadowinv.errors import InputError
from napari_shadowinv.io.files import split_address
from napari_shadowinv.options import Instrument
from napari_shadowinv.physics.trace_options import GridView
from napari_shadowinv.pipeline.experiment_options import ExperimentOptions

if TYPE_CHECKING:
    from napari_shadowinv.physics.setup import Setup
    from napari_shadowinv.pipeline.experiment_object import PlannedObject

# Help of arguments, where it is longer than a line.
HELP = {
    "object": "A phantom such as toroid:peak=60,radius=3e-5, a result, a displacement (.npy), or "
    "E and B on a 3-D grid.",
    "energies": "MeV of each image, or wavelength in m.",
    "size": "Height and width, such as 200x200.",
}
SECTIONS: Sections = {"plan": ExperimentOptions, "instrument": Instrument, "view": GridView}
EPILOG = """
shadowinv plan toroid:peak=60 --setup setup.toml --energies 5,15 --instrument film,TNSA

shadowinv plan shot.shadowinv --setup next.toml --counts 300

Phantoms: toroid, four_toroids, coaxial, wakefield, blob.

Exit codes: 0 determined; 1 no figure; 2 invalid input; 3 not determined; 130 cancelled.
"""


@dataclass(frozen=True, kw_only=True)
class PlanFlags:
    """Flags of the object and of the experiment."""

    setup: _flags.SetupFile = None
    energies: Annotated[str | None, Option(metavar="X,X,…", help=HELP["energies"])] = None
    instrument: _flags.InstrumentNames = None
    counts: Annotated[float | None, Option(help="Mean counts a pixel. Default: 1000.")] = None
    size: Annotated[str | None, Option(metavar="HxW", help=HELP["size"])] = None
    recorded_with: Annotated[Path | None, Option(help="TOML file of the object's setup.")] = None
    deflector: _flags.Deflector = None


@notify_errors
@_flags.takes_flags
def plan(
    object: Annotated[str, _flags.argument(help=HELP["object"])],
    flags: PlanFlags,
    settings: Annotated[list[str] | None, _flags.setting(SECTIONS, "plan.draws=5")] = None,
    out: Annotated[Path, Option(help="Table (.csv) of draws.")] = Path("plan.csv"),
    figure: _flags.Figure = None,
    overwrite: _flags.Overwrite = False,
    quiet: _flags.Quiet = False,
) -> None:
    """Simulate shots of an experiment, and report whether the field would be determined."""
    from napari_shadowinv.io.files import replacing
    from napari_shadowinv.io.formats import FIGURE_SUFFIXES, TABLE
    from napari_shadowinv.pipeline.experiment import plan_experiment
    from napari_shadowinv.pipeline.experiment_object import setups_of_text, shape_of_text
    from napari_shadowinv.plotting import plan_figure

    page, outputs = figure or figure_beside(out), Outputs(overwrite, quiet)
    outputs.check(
        [(out, TABLE.suffixes), (page, FIGURE_SUFFIXES)],
        [flags.setup, flags.recorded_with, _file_of(object)],
    )
    keys = _flags.instrument_keys(flags.instrument) | {"plan.counts": ("--counts", flags.counts)}
    stated = settings_of(settings or (), SECTIONS, keys)
    options = stated.change("plan", ExperimentOptions())
    instrument = stated.change("instrument", Instrument())
    setups = setups_of_text(read_setup(flags.setup), flags.energies or "", "--energies")
    shape = None if flags.size is None else shape_of_text(flags.size, "--size")
    target: Any = _object(object, flags, setups, stated)
    choices: dict[str, Any] = {"shape": shape, "instrument": instrument, "options": options}
    outputs.warn_of_setups((each, shape) for each in setups or ())
    with work_callbacks(quiet) as callbacks:
        result = plan_experiment(target, setups, **choices, **callbacks)
    with replacing(out, overwrite) as temporary:
        cells = [
            {name: f"{v:.6g}" if isinstance(v, float) else v for name, v in row.items()}
            for row in result.rows()
        ]
        write_cells(temporary, [*cells[0]], cells)
    outputs.write_figures({page: partial(plan_figure, result)})
    rows = [headline_row(result.headline), *fact_rows(result.facts)]
    outputs.show("Plan", rows)
    if not result.is_determined:
        raise Exit(EXIT_NOT_CONVERGED)
    outputs.exit_unless_drawn()


def _file_of(text: str) -> Path | None:
    """Return the file of an object; None for a phantom, such as toroid:peak=1.5."""
    file, _ = split_address(text)
    is_file = os.path.exists(file) or (file.suffix and "=" not in text)
    return file if is_file else None


def _object(
    text: str, flags: PlanFlags, setups: list[Setup] | None, settings: Settings
) -> PlannedObject | Any:
    """Return the phantom of a text, or the object of a file."""
    from napari_shadowinv.cli._forward_command import field_from
    from napari_shadowinv.io.field_grids import is_field_grid, read_field_grid
    from napari_shadowinv.pipeline.experiment_object import (
        object_of_displacement,
        object_of_field,
        phantom_of_text,
    )

    is_file = _file_of(text) is not None
    is_grid = is_file and is_field_grid(Path(text))
    stated = {"--recorded-with": flags.recorded_with, "--deflector": flags.deflector}
    received = [] if is_file and not is_grid else [flag for flag in stated if stated[flag]]
    received += [] if is_grid else [key for key in settings.values if key.startswith("view.")]
    if received:
        kind = "a 3-D field" if is_grid else "a displacement" if is_file else "a phantom"
        raise InputError(
            f"received {', '.join(received)}, which does not apply to {text}, {kind}: leave it out"
        )
    if is_grid:
        if setups is None:
            raise InputError(f"{text} is a 3-D field: particles through it need --setup")
        grid = settings.change("view", GridView()).apply(read_field_grid(Path(text)))
        return object_of_field(grid, setups[0], title=Path(text).name)
    if not is_file:
        return phantom_of_text(text)
    content, original = field_from(Path(text)), read_setup(flags.recorded_with)
    if content.setup is not None and original is not None:
        raise InputError(f"{text} has its setup: leave out --recorded-with")
    return object_of_displacement(
        content.displacement,
        original or content.setup,
        deflector=flags.deflector or content.deflector,
        title=Path(text).name,
    )
