from ._fit import fit
from .result import Basin, Fit, FitReport, FittedField
from .shots import point_spread

__all__ = [
    "Basin",
    "Fit",
    "FitReport",
    "FittedField",
    "fit",
    "point_spread",
]
