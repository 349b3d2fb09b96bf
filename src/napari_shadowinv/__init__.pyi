from ._napari.layers import add_inversion
from ._system.progress import Progress
from .analysis import analyse
from .cautions import Caution
from .errors import FileFormatError, InputError, InversionCancelled
from .fitting import Fit, fit
from .inversion import Inversion, Report, invert, plan_sites
from .inversion.error_bars import Maximum, Uncertainty, uncertainty
from .io import read, write
from .options import BeamPrior, FitOptions, Instrument, InversionOptions
from .physics.field_grid import FieldGrid
from .physics.forward import synthetic_image
from .physics.poisson import poisson_invert
from .physics.projection import project, project_potential
from .physics.setup import OpticalSetup, ProtonSetup
from .physics.trace_options import TraceOptions
from .physics.tracing import TracedImage, trace
from .pipeline import run
from .pipeline.rerun import Rerun, rerun
from .pipeline.run_options import RunOptions, WatchOptions
from .preprocessing import Recipe
from .shot import Shot
from .stack import invert_stack, run_stack, stack_statistics, watch_stack

__version__: str

__all__ = [
    "BeamPrior",
    "Caution",
    "FieldGrid",
    "FileFormatError",
    "Fit",
    "FitOptions",
    "InputError",
    "Instrument",
    "Inversion",
    "InversionCancelled",
    "InversionOptions",
    "Maximum",
    "OpticalSetup",
    "Progress",
    "ProtonSetup",
    "Recipe",
    "Report",
    "Rerun",
    "RunOptions",
    "Shot",
    "TraceOptions",
    "TracedImage",
    "Uncertainty",
    "WatchOptions",
    "__version__",
    "add_inversion",
    "analyse",
    "fit",
    "invert",
    "invert_stack",
    "plan_sites",
    "poisson_invert",
    "project",
    "project_potential",
    "read",
    "rerun",
    "run",
    "run_stack",
    "stack_statistics",
    "synthetic_image",
    "trace",
    "uncertainty",
    "watch_stack",
    "write",
]
