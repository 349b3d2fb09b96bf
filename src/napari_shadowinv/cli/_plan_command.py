"""The command `plan`: whether an experiment would determine a field, before its shot."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any

from typer import Exit, Option

from napari_shadowinv._system.tables import write_cells
from napari_shadowinv.cli import _flags
from napari_shadowinv.cli._inputs import read_setup
from napari_shadowinv.cli._objects import HELP as OBJECT
from napari_shadowinv.cli._objects import file_of, object_of
from napari_shadowinv.cli._outputs import Outputs, figure_beside
from napari_shadowinv.cli._settings import Sections, settings_of
from napari_shadowinv.cli._summary import fact_rows, headline_row
from napari_shadowinv.cli._terminal import EXIT_NOT_CONVERGED, notify_errors, work_callbacks
from napari_shadowinv.options import Instrument
from napari_shadowinv.physics.trace_options import GridView
from napari_shadowinv.pipeline.experiment_options import ExperimentOptions

# Help of arguments, where it is longer than a line.
HELP = {
    "energies": "MeV of each image, or wavelength in m.",
    "size": "Height and width, such as 200x200.",
}
SECTIONS: Sections = {"plan": ExperimentOptions, "instrument": Instrument, "view": GridView}
EPILOG = """
shadowinv plan toroid:peak=60 --setup setup.toml --energies 5,15 --instrument film,TNSA

shadowinv plan shot.shadowinv --setup next.toml --counts 300

Phantoms: toroid, four_toroids, coaxial, wakefield, blob.

Exit codes: 0 determined; 2 invalid input; 3 not determined; 130 cancelled.
"""


@dataclass(frozen=True)
class PlanFlags:
    """Flags of the experiment that an object is put into."""

    setup: _flags.SetupFile = None
    deflector: _flags.Deflector = None
    energies: Annotated[str | None, Option(metavar="X,X,…", help=HELP["energies"])] = None
    instrument: _flags.InstrumentNames = None
    counts: Annotated[float | None, Option(help="Mean counts a pixel. Default: 1000.")] = None
    size: Annotated[str | None, Option(metavar="HxW", help=HELP["size"])] = None


@notify_errors
@_flags.takes_flags
def plan(
    object: Annotated[str, _flags.argument(help=OBJECT)],
    flags: PlanFlags,
    outputs: Outputs,
    settings: Annotated[list[str] | None, _flags.setting(SECTIONS, "plan.draws=5")] = None,
    out: Annotated[Path, Option(help="Table (.csv) of draws.")] = Path("plan.csv"),
    figure: _flags.Figure = None,
) -> None:
    """Simulate shots of an experiment, and report whether the field would be determined."""
    from napari_shadowinv.io.files import replacing
    from napari_shadowinv.io.formats import FIGURE_SUFFIXES, TABLE
    from napari_shadowinv.pipeline.experiment import plan_experiment
    from napari_shadowinv.pipeline.experiment_object import setups_of_text, shape_of_text
    from napari_shadowinv.plotting import plan_figure

    page = figure or figure_beside(out)
    outputs.check(
        [(out, TABLE.suffixes), (page, FIGURE_SUFFIXES)],
        [flags.setup, file_of(object)],
    )
    keys = _flags.instrument_keys(flags.instrument) | {"plan.counts": ("--counts", flags.counts)}
    stated = settings_of(settings or (), SECTIONS, keys)
    setups = setups_of_text(read_setup(flags.setup), flags.energies or "", "--energies")
    shape = None if flags.size is None else shape_of_text(flags.size, "--size")
    target = object_of(object, flags.deflector, stated, stated.change("view", GridView()))
    choices: dict[str, Any] = {
        "shape": shape,
        "instrument": stated.change("instrument", Instrument()),
        "options": stated.change("plan", ExperimentOptions()),
    }
    outputs.warn_of_setups((each, shape) for each in setups or ())
    with work_callbacks(outputs.quiet) as callbacks:
        result = plan_experiment(target, setups, **choices, **callbacks)
    with replacing(out, outputs.overwrite) as temporary:
        rows_of_draws = result.rows()
        write_cells(temporary, [*rows_of_draws[0]], rows_of_draws)
    outputs.write_figures({page: partial(plan_figure, result)})
    rows = [headline_row(result.headline), *fact_rows(result.facts)]
    outputs.show("Plan", rows)
    if not result.is_determined:
        raise Exit(EXIT_NOT_CONVERGED)
