from ._invert import count_sites, invert, plan_sites
from .error_bars import Maximum, Uncertainty, uncertainty
from .result import Cells, Inversion, Report

__all__ = [
    "Cells",
    "Inversion",
    "Maximum",
    "Report",
    "Uncertainty",
    "count_sites",
    "invert",
    "plan_sites",
    "uncertainty",
]
