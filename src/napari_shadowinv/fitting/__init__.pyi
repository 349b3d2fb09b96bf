from ._fit import compare, fit
from .result import Basin, Fit, FitReport, FittedField
from .shots import point_spread

__all__ = [
    "Basin",
    "Fit",
    "FitReport",
    "FittedField",
    "compare",
    "fit",
    "point_spread",
]
