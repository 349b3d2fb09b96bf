from ._invert import count_sites, invert, plan_sites
from .result import Headline, Inversion, Level, Report

__all__ = ["Headline", "Inversion", "Level", "Report", "count_sites", "invert", "plan_sites"]
