from ._fit import compare, fit
from ._leave_one_out import leave_one_out
from .left_out import LeaveOneOut
from .result import Basin, Fit, FitReport, FittedField
from .shots import point_spread

__all__ = [
    "Basin",
    "Fit",
    "FitReport",
    "FittedField",
    "LeaveOneOut",
    "compare",
    "fit",
    "leave_one_out",
    "point_spread",
]
