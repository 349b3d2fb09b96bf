from ._film import run_film
from ._fit import FitShot, run_comparison, run_fit
from ._refine import run_refinement
from ._run import Inputs, collect_inputs, run, run_prepared
from ._static import run_leave_one_out, run_windows
from .cache import Cache
from .files import read_recipe, write_recipe
from .film_files import read_pack, write_layers

__all__ = [
    "Cache",
    "FitShot",
    "Inputs",
    "collect_inputs",
    "read_pack",
    "read_recipe",
    "run",
    "run_comparison",
    "run_film",
    "run_fit",
    "run_leave_one_out",
    "run_prepared",
    "run_refinement",
    "run_windows",
    "write_layers",
    "write_recipe",
]
