from ._fit import compare, fit
from .measurements import FIELDS, point_spread
from .options import FitOptions
from .result import Basin, Fit, FitReport, FittedField
from .verdict import Verdict

__all__ = [
    "FIELDS",
    "Basin",
    "Fit",
    "FitOptions",
    "FitReport",
    "FittedField",
    "Verdict",
    "compare",
    "fit",
    "point_spread",
]
