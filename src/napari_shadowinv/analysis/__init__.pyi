from ._analyse import analyse
from .frame import FIELD_UNITS, FieldFrame
from .lines import LineProfile
from .product import Product
from .result import ProductResult

__all__ = ["FIELD_UNITS", "FieldFrame", "LineProfile", "Product", "ProductResult", "analyse"]
