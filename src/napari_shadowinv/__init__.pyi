from ._napari.layers import add_to_viewer
from .analysis import analyse
from .errors import FileFormatError, InputError
from .fitting import Fit, fit
from .inversion import Inversion, invert
from .io import read, write
from .options import FitOptions, Instrument, InversionOptions
from .physics import (
    OpticalSetup,
    ProtonSetup,
    poisson_invert,
    predict_image,
    synthetic_image,
    trace,
)
from .pipeline import plan_experiment, rerun, run
from .preprocessing import Recipe
from .shot import Shot
from .stack import run_stack

__version__: str

__all__ = [
    "FileFormatError",
    "Fit",
    "FitOptions",
    "InputError",
    "Instrument",
    "Inversion",
    "InversionOptions",
    "OpticalSetup",
    "ProtonSetup",
    "Recipe",
    "Shot",
    "__version__",
    "add_to_viewer",
    "analyse",
    "fit",
    "invert",
    "plan_experiment",
    "poisson_invert",
    "predict_image",
    "read",
    "rerun",
    "run",
    "run_stack",
    "synthetic_image",
    "trace",
    "write",
]
