"""Products with their bands: `ProductResult`, and all of one result, `Analysis`."""

from __future__ import annotations

from dataclasses import dataclass

from napari_shadowinv._typing import FloatArray
from napari_shadowinv.analysis.frame import FieldUnit
from napari_shadowinv.analysis.product import (
    Coordinate,
    Product,
    Variable,
    has_bands,
)
from napari_shadowinv.facts import Fact
from napari_shadowinv.inversion.error_bars import Quantity

__all__ = ["ProductResult"]


@dataclass(frozen=True, eq=False)
class ProductResult:
    """A product of a field, with its bands.

    Attributes
    ----------
    name : str
        Name of the product, unique in an analysis; variables in a file begin with it.
    product : Product
        The product with all choices, also those that follow from the noise.
    field : str
        Variable of the field, such as "path_integrated_b".
    unit : FieldUnit
        Unit in which the field is shown.
    quantities : dict of str to Quantity
        Values in SI units, by the names of `variables`; with samples if the errors of the field
        are known.
    variables : dict of str to Variable
        Axes, unit and long name of each.
    coordinates : dict of str to Coordinate
        Places along the axes.
    facts : tuple of Fact
        The product in words, its cautions first.
    limits : tuple of str
        What the image cannot show, and how the product has to be read.
    causes : tuple of str
        What the bands hold, such as "noise" and "discretisation"; empty without bands.
    """

    name: str
    product: Product
    field: str
    unit: FieldUnit
    quantities: dict[str, Quantity]
    variables: dict[str, Variable]
    coordinates: dict[str, Coordinate]
    facts: tuple[Fact, ...]
    limits: tuple[str, ...]
    causes: tuple[str, ...]

    @property
    def title(self) -> str:
        """Title of the product, or its label."""
        return self.product.label or self.product.title

    @property
    def has_bands(self) -> bool:
        """Whether the errors of the field are known."""
        return any(map(has_bands, self.quantities.values()))

    def __getitem__(self, name: str) -> Quantity:
        return self.quantities[name]

    def band(self, name: str, share: float = 0.68) -> tuple[FloatArray, FloatArray] | None:
        """Return lower and upper end of a variable's interval; None without samples."""
        quantity = self.quantities[name]
        return quantity.band(share) if has_bands(quantity) else None
