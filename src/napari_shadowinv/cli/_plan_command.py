"""The command `plan`: whether an experiment would determine a field, before its shot."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from typer import Exit, Option

from napari_shadowinv._system.validation import validate
from napari_shadowinv.cli import _flags, _inputs
from napari_shadowinv.cli._settings import Sections, Settings, settings_of
from napari_shadowinv.cli._terminal import (
    EXIT_NOT_CONVERGED,
    notify_errors,
    say,
    warn_of_setups,
    work_callbacks,
)
from napari_shadowinv.errors import InputError
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
    "recorded_with": "TOML file of the object's setup.",
    "deflector": "Cause of the object's deflection.",
    "counts": "Mean counts a pixel. Default: 1000.",
    "sweep": "A curve, such as counts=100,300,1000.",
    "out": "Table (.csv) of draws or sweep.",
}
SECTIONS: Sections = {"plan": ExperimentOptions, "instrument": Instrument, "view": GridView}
EPILOG = """
shadowinv plan toroid:peak=60 --setup setup.toml --energies 5,15 --instrument film,TNSA

shadowinv plan shot.shadowinv --setup next.toml --sweep counts=100,300,1000

Phantoms: toroid, four_toroids, coaxial, wakefield, blob.

Exit codes: 0 determined; 1 no figure; 2 invalid input; 3 not determined; 130 cancelled.
"""


@dataclass(frozen=True, kw_only=True)
class PlanFlags:
    """Flags of the object and of the experiment."""

    setup: _flags.SetupFile = None
    energies: Annotated[str | None, Option(metavar="X,X,…", help=HELP["energies"])] = None
    instrument: _flags.InstrumentNames = None
    counts: Annotated[float | None, Option(help=HELP["counts"])] = None
    size: Annotated[str | None, Option(metavar="HxW", help=HELP["size"])] = None
    recorded_with: Annotated[Path | None, Option(help=HELP["recorded_with"])] = None
    deflector: Annotated[str | None, Option(metavar="CAUSE", help=HELP["deflector"])] = None
    sweep: Annotated[str | None, Option(metavar="NAME=VALUES", help=HELP["sweep"])] = None


@notify_errors
@_flags.takes_flags
def plan(
    object: Annotated[str, _flags.argument(help=HELP["object"])],
    flags: PlanFlags,
    settings: Annotated[list[str] | None, _flags.setting(SECTIONS, "plan.draws=5")] = None,
    out: Annotated[Path, Option(help=HELP["out"])] = Path("plan.csv"),
    figure: _flags.Figure = None,
    overwrite: _flags.Overwrite = False,
    quiet: _flags.Quiet = False,
) -> None:
    """Simulate shots of an experiment, and report whether the field would be determined."""
    from napari_shadowinv.cli._summary import fact_rows, headline_row, two_columns, written_rows
    from napari_shadowinv.io.files import replacing
    from napari_shadowinv.io.formats import FIGURE_SUFFIXES, SITES
    from napari_shadowinv.pipeline.experiment import plan_experiment, sweep_experiment
    from napari_shadowinv.pipeline.experiment_object import shape_of_text
    from napari_shadowinv.pipeline.experiment_result import ExperimentSweep, table_text
    from napari_shadowinv.pipeline.files import setup_from
    from napari_shadowinv.plotting import plan_figure, sweep_figure

    page = figure or _inputs.figure_beside(out)
    _inputs.check_outputs([(out, SITES.suffixes), (page, FIGURE_SUFFIXES)], overwrite)
    _inputs.protect([out, page], [flags.setup, flags.recorded_with, _file_of(object)])
    keys = _flags.instrument_keys(flags.instrument) | {"plan.counts": ("--counts", flags.counts)}
    stated = settings_of(settings or (), SECTIONS, keys)
    options = stated.change("plan", ExperimentOptions())
    instrument = stated.change("instrument", Instrument())
    setup = None if flags.setup is None else setup_from(flags.setup)
    setups = _setups(setup, flags.energies)
    shape = None if flags.size is None else shape_of_text(flags.size, "--size")
    target: Any = _object(object, flags, setups, stated)
    choices: dict[str, Any] = {"shape": shape, "instrument": instrument, "options": options}
    warn_of_setups((each, shape) for each in setups or ())
    result: Any
    with work_callbacks(quiet) as callbacks:
        choices |= callbacks
        if flags.sweep is None:
            result = plan_experiment(target, setups, **choices)
        else:
            quantity, values = _sweep(flags.sweep)
            result = sweep_experiment(target, setups, quantity=quantity, values=values, **choices)
    is_sweep = isinstance(result, ExperimentSweep)
    with replacing(out, overwrite) as temporary:
        temporary.write_text(table_text(result.rows()), encoding="utf-8")
    draw: Any = partial(sweep_figure if is_sweep else plan_figure, result)
    failed = _inputs.write_figures({page: draw}, overwrite)
    if not quiet:
        rows = [
            headline_row(result.headline),
            *fact_rows(result.facts),
            *written_rows([out, page], failed),
        ]
        say(two_columns("Sweep" if is_sweep else "Plan", rows))
    if not result.is_determined:
        raise Exit(EXIT_NOT_CONVERGED)
    _inputs.exit_unless_drawn(failed)


def _file_of(text: str) -> Path | None:
    return Path(text) if Path(text).suffix else None


def _object(
    text: str, flags: PlanFlags, setups: list[Setup] | None, settings: Settings
) -> PlannedObject | Any:
    """Return the phantom of a text, or the object of a file."""
    from napari_shadowinv.io import is_field_grid
    from napari_shadowinv.pipeline.experiment_object import object_of_displacement, phantom_of_text
    from napari_shadowinv.pipeline.traced_file import object_of_file

    recorded_with, deflector = flags.recorded_with, flags.deflector
    is_file = _file_of(text.partition(":")[0]) is not None
    is_grid = is_file and is_field_grid(Path(text))
    view = [key for key in settings.values if key.startswith("view.")]
    if view and not is_grid:
        names = ", ".join(view)
        raise InputError(f"received {names}, but {text} is no 3-D field: leave them out")
    if is_grid:
        if recorded_with is not None or deflector is not None:
            raise InputError(
                f"received --recorded-with or --deflector, but {text} is a 3-D field, which needs "
                "only --setup: leave them out"
            )
        if setups is None:
            raise InputError(f"{text} is a 3-D field: particles through it need --setup")
        return object_of_file(Path(text), setups[0], settings.change("view", GridView()))
    if not is_file:
        if recorded_with is not None or deflector is not None:
            flag = "--deflector" if recorded_with is None else "--recorded-with"
            raise InputError(f"received {flag}: it belongs to the object of a file, not a phantom")
        return phantom_of_text(text)
    from napari_shadowinv.cli._shot_commands import field_from
    from napari_shadowinv.pipeline.files import setup_from

    path = Path(text)
    content = field_from(path)
    if content.setup is not None and recorded_with is not None:
        raise InputError(f"{path} has its setup: leave out --recorded-with")
    original = content.setup if recorded_with is None else setup_from(recorded_with)
    return object_of_displacement(
        content.displacement, original, deflector=deflector, title=path.name
    )


def _setups(setup: Setup | None, energies: str | None) -> list[Setup] | None:
    if energies is None:
        return None if setup is None else [setup]
    if setup is None:
        raise InputError("received --energies: it needs --setup, the geometry of all images")
    return [
        validate(type(setup), {**setup.model_dump(), setup.beam_field: value}, "--energies")
        for value in _numbers("--energies", energies)
    ]


def _numbers(flag: str, text: str) -> list[float]:
    try:
        return [float(part) for part in text.split(",")]
    except ValueError:
        raise InputError(f"{flag} is '{text}': expected numbers separated by commas") from None


def _sweep(text: str) -> tuple[str, list[float]]:
    name, equals, values = text.partition("=")
    if not equals:
        raise InputError(f"--sweep is '{text}': expected NAME=VALUES, such as counts=100,300,1000")
    return name.strip().replace("-", "_"), _numbers("--sweep", values)
