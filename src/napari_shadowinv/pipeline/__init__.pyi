from ._film import run_film
from .experiment import plan_experiment, sweep_experiment
from .experiment_options import ExperimentOptions
from .files import read_recipe, write_recipe
from .film_files import read_pack, write_layers
from .fit_run import run_comparison, run_fit, run_leave_one_out, run_refinement
from .inversion_run import Cache, Inputs, collect_inputs, run, run_prepared
from .rerun import Rerun, rerun
from .run_options import RunOptions, WatchOptions

__all__ = [
    "Cache",
    "ExperimentOptions",
    "Inputs",
    "Rerun",
    "RunOptions",
    "WatchOptions",
    "collect_inputs",
    "plan_experiment",
    "read_pack",
    "read_recipe",
    "rerun",
    "run",
    "run_comparison",
    "run_film",
    "run_fit",
    "run_leave_one_out",
    "run_prepared",
    "run_refinement",
    "sweep_experiment",
    "write_layers",
    "write_recipe",
]
