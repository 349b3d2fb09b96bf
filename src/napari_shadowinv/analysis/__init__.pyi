from ._analyse import analyse
from .axisymmetric import AxisymmetricProfile, AzimuthalProfile
from .contrast import Contrast
from .currents import EnclosedCharge, EnclosedCurrent, Flux
from .frame import FIELD_UNITS, FieldFrame
from .kinds import PRODUCTS, product_from_dict, product_from_text
from .lines import LineProfile
from .maps import ChargeDensity, CurrentDensity, PhaseCurvature
from .product import Product
from .regions import Region
from .result import ProductResult, add_products, products_in, products_table
from .series import analyse_shots
from .spectra import TurbulenceSpectrum

__all__ = [
    "FIELD_UNITS",
    "PRODUCTS",
    "AxisymmetricProfile",
    "AzimuthalProfile",
    "ChargeDensity",
    "Contrast",
    "CurrentDensity",
    "EnclosedCharge",
    "EnclosedCurrent",
    "FieldFrame",
    "Flux",
    "LineProfile",
    "PhaseCurvature",
    "Product",
    "ProductResult",
    "Region",
    "TurbulenceSpectrum",
    "add_products",
    "analyse",
    "analyse_shots",
    "product_from_dict",
    "product_from_text",
    "products_in",
    "products_table",
]
