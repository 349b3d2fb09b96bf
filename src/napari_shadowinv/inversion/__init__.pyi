from ._invert import invert, plan_sites
from .error_bars import ErrorSamples, Maximum, Quantity
from .error_budget import ErrorBudget
from .result import Cells, Inversion, Report

__all__ = [
    "Cells",
    "ErrorBudget",
    "ErrorSamples",
    "Inversion",
    "Maximum",
    "Quantity",
    "Report",
    "invert",
    "plan_sites",
]
