from ._invert import invert
from ._plan import count_sites, plan_sites
from .result import Inversion, Report

__all__ = ["Inversion", "Report", "count_sites", "invert", "plan_sites"]
