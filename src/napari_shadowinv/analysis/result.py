"""Products with their bands: `ProductResult`; in files and tables.

- products among the variables of a dataset: `add_products`, `products_in`
- all numbers as one table of comma-separated values: `products_table`
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from napari_shadowinv._system.safety import as_input_errors
from napari_shadowinv._typing import FloatArray
from napari_shadowinv.analysis.frame import FieldUnit, field_unit, si_unit_of
from napari_shadowinv.analysis.kinds import product_from_dict
from napari_shadowinv.analysis.paths import csv_text
from napari_shadowinv.analysis.product import BANDS, Coordinate, Measurand, Product, has_bands
from napari_shadowinv.errors import InputError
from napari_shadowinv.facts import Fact, Level, Summarised
from napari_shadowinv.inversion.error_bars import Quantity
from napari_shadowinv.physics.arrays import PLANE
from napari_shadowinv.physics.units import display_unit, label, numbers_of, prefix_for

if TYPE_CHECKING:
    import xarray

_ATTRIBUTE = "products"
SERIES_AXES: tuple[str, str] = ("time", "shot")
_STATISTICS = ("bias", "std", "low_68", "high_68", "low_95", "high_95")
_COLUMNS = ("product", "quantity", "place", "place_unit", "value", "unit", *_STATISTICS)


@dataclass(frozen=True, eq=False, repr=False)
class ProductResult(Summarised):
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
        are known and the product was not read from a file.
    variables : dict of str to Measurand
        Axes, unit and long name of each.
    coordinates : dict of str to Coordinate
        Places along the axes.
    facts : tuple of Fact
        The product in words, its cautions among them.
    limits : tuple of str
        What the image cannot show, and how the product has to be read.
    causes : tuple of str
        What the bands hold, such as "noise" and "discretisation"; empty without bands.
    stored : dict of str to dict of str to ndarray
        Of a product that was read from a file: "bias", "std" and the ends of the bands, such as
        "low_68", by the names of `variables`.
    """

    name: str
    product: Product
    field: str
    unit: FieldUnit
    quantities: dict[str, Quantity]
    variables: dict[str, Measurand]
    coordinates: dict[str, Coordinate]
    facts: tuple[Fact, ...]
    limits: tuple[str, ...]
    causes: tuple[str, ...]
    stored: dict[str, dict[str, FloatArray]] = dataclasses.field(default_factory=dict)

    @property
    def title(self) -> str:
        """Label of the product, or else its title."""
        return self.product.label or self.product.title

    @property
    def has_bands(self) -> bool:
        """Whether the errors of the field are known."""
        return bool(self.causes)

    @property
    def curve_names(self) -> tuple[str, ...]:
        """Variables along an axis that figures draw together, in one unit."""
        drawn = [name for name in self.product.curves if name in self.variables]
        names = [
            name
            for name in drawn or self.variables
            if len(self.variables[name].dims) == 1 and name not in self.product.recorded
        ]
        units = {self.variables[name].unit for name in names[:1]}
        return tuple(name for name in names if self.variables[name].unit in units)

    @property
    def is_series(self) -> bool:
        """Whether its axis runs over successive shots."""
        return not self.coordinates.keys().isdisjoint(SERIES_AXES)

    @property
    def curve_groups(self) -> tuple[tuple[str, ...], ...]:
        """Variables that figures draw, grouped by panel.

        Of a series these are all variables; lengths are apart from a displacement in pixels.
        """
        if not self.is_series:
            return (self.curve_names,) if self.curve_names else ()
        groups: dict[tuple[str, bool], list[str]] = {}
        for name, variable in self.variables.items():
            key = variable.unit, name in self.product.lengths
            groups.setdefault(key, []).append(name)
        return tuple(map(tuple, groups.values()))

    @property
    def is_logarithmic(self) -> bool:
        """Whether the axes of its curves are logarithmic."""
        return self.product.is_logarithmic and "k" in self.coordinates

    def __getitem__(self, name: str) -> Quantity:
        return self.quantities[name]

    def band(self, name: str, share: float = 0.68) -> tuple[FloatArray, FloatArray] | None:
        """Return lower and upper end of a variable's interval; None if it has none.

        Raises
        ------
        InputError
            If the share of probability is not between 0 and 1, or is neither 0.68 nor 0.95 for a
            product that was read from a file.
        """
        if has_bands(self.quantities[name]):
            return self.quantities[name].band(share)
        if name not in self.stored:
            return None
        if share not in BANDS:
            raise InputError(
                f"share is {share!r}, and files have bands of {' and '.join(map(str, BANDS))}: "
                "expected one of them, or analyse the result again"
            )
        stored = self.stored[name]
        return stored[f"low_{100 * share:.0f}"], stored[f"high_{100 * share:.0f}"]

    def statistics(self, name: str) -> dict[str, FloatArray]:
        """Return bias, standard deviation and ends of the bands of a variable, in SI units.

        Keys are "bias", "std", "low_68", "high_68", "low_95" and "high_95"; empty without bands.
        """
        quantity = self.quantities[name]
        if not has_bands(quantity):
            return self.stored.get(name, {})
        ends = (end for share in BANDS for end in quantity.band(share))
        return dict(zip(_STATISTICS, (quantity.bias, quantity.std, *ends), strict=True))

    def scale_of(self, name: str) -> tuple[float, str]:
        """Return the factor from SI to the unit in which a variable is shown, and that unit."""
        unit = self.variables[name].unit
        if unit == si_unit_of(self.field):
            return 1 / self.unit.size, self.unit.symbol
        return 1.0, display_unit(unit)

    def shown_scale(self, names: Sequence[str]) -> tuple[float, str]:
        """Return `scale_of` variables of one unit, with a prefix if they are lengths."""
        factor, unit = self.scale_of(names[0])
        if unit != "m":
            return factor, unit
        largest = max(float(np.max(np.abs(self.quantities[name].value))) for name in names)
        larger, prefix = prefix_for(largest)
        return larger * factor, f"{prefix}{unit}"

    def shown_places(self, name: str) -> tuple[FloatArray, str]:
        """Return the places along a variable's axis in a handy unit, and the axis in words."""
        coordinate = self.coordinates[self.variables[name].dims[0]]
        places = np.asarray(coordinate.values)
        unit = display_unit(coordinate.unit)
        if unit in ("m", "s"):
            factor, prefix = prefix_for(float(np.max(np.abs(places), initial=0.0)))
            places, unit = factor * places, f"{prefix}{unit}"
        return places, f"{coordinate.long_name} ({unit})" if unit else coordinate.long_name


def add_products(dataset: xarray.Dataset, results: Sequence[ProductResult]) -> xarray.Dataset:
    """Return a result's dataset with the variables of products, in SI units.

    Parameters
    ----------
    dataset : xarray.Dataset
        As of `Inversion.to_dataset`. Products that it has already are replaced.
    results : sequence of ProductResult

    Returns
    -------
    xarray.Dataset
        With ``<name>_<variable>``, and for those with bands also ``…_bias``, ``…_std``,
        ``…_low_68``, ``…_high_68``, ``…_low_95`` and ``…_high_95``. The attribute ``products`` is a
        JSON text with the choices and the facts.
    """
    if _ATTRIBUTE in dataset.attrs:
        dataset = _without_products(dataset)
    names = [each.name for each in results]
    if len(set(names)) < len(names):
        raise InputError("two products have the same name: give them labels")
    variables: dict[str, Any] = {}
    for each in results:
        for name, variable in each.variables.items():
            dims = tuple(axis if axis in PLANE else f"{each.name}_{axis}" for axis in variable.dims)
            key, long_name = f"{each.name}_{name}", variable.long_name
            variables[key] = dims, each.quantities[name].value, label(variable.unit, long_name)
            for statistic, numbers in each.statistics(name).items():
                attributes = label(variable.unit, f"{long_name}, {statistic}")
                variables[f"{key}_{statistic}"] = dims, numbers, attributes
        for axis, places in each.coordinates.items():
            if axis not in PLANE:
                key = f"{each.name}_{axis}"
                variables[key] = key, places.values, label(places.unit, places.long_name)
    taken = variables.keys() & dataset.variables.keys()
    if taken:
        raise InputError(f"the result has a variable {min(taken)!r} already: give another label")
    entries = [
        {
            "name": each.name,
            "choices": each.product.model_dump(mode="json", exclude_none=True),
            "field": each.field,
            "unit": each.unit.symbol,
            "variables": list(each.variables),
            "axes": list(each.coordinates),
            "facts": [asdict(fact) for fact in each.facts],
            "limits": each.limits,
            "causes": each.causes,
        }
        for each in results
    ]
    return dataset.assign(variables).assign_attrs({_ATTRIBUTE: json.dumps(entries)})


def _without_products(dataset: xarray.Dataset) -> xarray.Dataset:
    prefixes = tuple(f"{entry['name']}_" for entry in json.loads(dataset.attrs[_ATTRIBUTE]))
    of_products = [name for name in dataset.variables if str(name).startswith(prefixes)]
    cleared = dataset.drop_vars(of_products)
    cleared.attrs = {key: value for key, value in dataset.attrs.items() if key != _ATTRIBUTE}
    return cleared


def products_in(dataset: xarray.Dataset) -> list[ProductResult]:
    """Return the products in the dataset of a file; an empty list if it has none.

    Raises
    ------
    InputError
        If a variable or an attribute is damaged.
    """
    if _ATTRIBUTE not in dataset.attrs:
        return []
    with as_input_errors("the products"):
        return [_from_entry(dataset, entry) for entry in json.loads(dataset.attrs[_ATTRIBUTE])]


def _from_entry(dataset: xarray.Dataset, entry: dict[str, Any]) -> ProductResult:
    name = entry["name"]
    quantities, variables, stored = {}, {}, {}
    for variable in entry["variables"]:
        array = dataset[f"{name}_{variable}"]
        values = np.asarray(numbers_of(dataset, f"{name}_{variable}"), dtype=np.float64)
        values = values.reshape(array.shape)
        dims = tuple(str(axis).removeprefix(f"{name}_") for axis in array.dims)
        variables[variable] = Measurand(dims, array.attrs["units"], array.attrs["long_name"])
        quantities[variable] = Quantity(values, np.zeros((0, *values.shape)))
        if f"{name}_{variable}_std" in dataset:
            stored[variable] = {
                statistic: np.asarray(dataset[f"{name}_{variable}_{statistic}"].values)
                for statistic in _STATISTICS
            }
    coordinates = {}
    for axis in entry["axes"]:
        places = dataset[axis if axis in PLANE else f"{name}_{axis}"]
        words = str(places.attrs["units"]), str(places.attrs["long_name"])
        coordinates[axis] = Coordinate(np.asarray(places.values), *words)
    return ProductResult(
        name=name,
        product=product_from_dict(entry["choices"]),
        field=entry["field"],
        unit=field_unit(entry["unit"]),
        quantities=quantities,
        variables=variables,
        coordinates=coordinates,
        facts=tuple(Fact(**{**each, "level": Level(each["level"])}) for each in entry["facts"]),
        limits=tuple(entry["limits"]),
        causes=tuple(entry["causes"]),
        stored=stored,
    )


def products_table(results: Sequence[ProductResult]) -> str:
    """Return all numbers except maps as comma-separated values, one in each row.

    Columns: product, quantity, place along its axis with its unit, value, unit, bias by noise,
    standard deviation and the ends of the bands, all in the unit of the row. Fields are in the
    unit that they are shown in.
    """
    rows = [list(_COLUMNS)]
    for result in results:
        for name, variable in result.variables.items():
            if len(variable.dims) <= 1:
                rows += _rows(result, name)
    return csv_text(rows)


def _rows(result: ProductResult, name: str) -> Iterator[list[str]]:
    factor, unit = result.scale_of(name)
    values = np.atleast_1d(result.quantities[name].value)
    numbers = result.statistics(name)
    unknown = np.full(values.shape, np.nan)
    columns = [np.atleast_1d(numbers.get(each, unknown)) for each in _STATISTICS]
    places, place_unit = [""] * len(values), ""
    for axis in result.variables[name].dims:
        coordinate = result.coordinates[axis]
        places = [f"{place:.9g}" for place in coordinate.values]
        place_unit = display_unit(coordinate.unit)
    for place, value, *row in zip(places, values, *columns, strict=True):
        cells = ("" if np.isnan(number) else f"{factor * number:.9g}" for number in row)
        yield [result.name, name, place, place_unit, f"{factor * value:.9g}", unit, *cells]
