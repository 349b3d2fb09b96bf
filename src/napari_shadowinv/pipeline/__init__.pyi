from ._film import run_film
from .experiment import plan_experiment
from .experiment_options import ExperimentOptions
from .files import read_recipe, write_recipe
from .film_files import read_pack, write_layers
from .fit_run import run_fit
from .inversion_run import Cache, run
from .rerun import Rerun, rerun
from .run_options import RunOptions, WatchOptions

__all__ = [
    "Cache",
    "ExperimentOptions",
    "Rerun",
    "RunOptions",
    "WatchOptions",
    "plan_experiment",
    "read_pack",
    "read_recipe",
    "rerun",
    "run",
    "run_film",
    "run_fit",
    "write_layers",
    "write_recipe",
]
