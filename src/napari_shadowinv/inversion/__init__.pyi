from ._invert import count_sites, invert, plan_sites
from .result import Inversion, Report

__all__ = ["Inversion", "Report", "count_sites", "invert", "plan_sites"]
