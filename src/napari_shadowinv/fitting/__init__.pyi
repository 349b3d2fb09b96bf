from ._fit import compare, fit
from ._leave_one_out import leave_one_out
from .result import Basin, Fit, FitReport, FittedField
from .shots import FitShot, point_spread
from .windows import FitWindows, LeaveOneOut

__all__ = [
    "Basin",
    "Fit",
    "FitReport",
    "FitShot",
    "FitWindows",
    "FittedField",
    "LeaveOneOut",
    "compare",
    "fit",
    "leave_one_out",
    "point_spread",
]
