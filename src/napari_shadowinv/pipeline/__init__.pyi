from ._run import Inputs, gathered, run, run_prepared
from .cache import Cache
from .files import read_recipe, write_recipe

__all__ = [
    "Cache",
    "Inputs",
    "gathered",
    "read_recipe",
    "run",
    "run_prepared",
    "write_recipe",
]
