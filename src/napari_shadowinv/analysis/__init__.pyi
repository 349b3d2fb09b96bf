from ._analyse import analyse
from .contrast import Contrast
from .currents import EnclosedCharge, EnclosedCurrent, Flux
from .frame import FIELD_UNITS, FieldFrame
from .lines import LineProfile
from .maps import ChargeDensity, CurrentDensity
from .product import Product
from .regions import Region
from .result import ProductResult

__all__ = [
    "FIELD_UNITS",
    "ChargeDensity",
    "Contrast",
    "CurrentDensity",
    "EnclosedCharge",
    "EnclosedCurrent",
    "FieldFrame",
    "Flux",
    "LineProfile",
    "Product",
    "ProductResult",
    "Region",
    "analyse",
]
