"""A product over the shots of a stack: `time_series`, with growth rates of a `TimeSeries`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from napari_shadowinv._typing import FloatArray
from napari_shadowinv.analysis.product import Variable, has_bands
from napari_shadowinv.analysis.result import ProductResult
from napari_shadowinv.errors import InputError
from napari_shadowinv.inversion.error_bars import Quantity

__all__ = ["TimeSeries", "time_series"]

_MIN_SHOTS = 2
_LEAST = 1e-300


@dataclass(frozen=True, eq=False)
class TimeSeries:
    """Numbers of one product in successive shots.

    Attributes
    ----------
    times : ndarray, shape (n,)
        In s.
    quantities : dict of str to Quantity
        Values (n,) in SI units; errors of different shots are independent in their samples.
    variables : dict of str to Variable
        Unit and long name of each.
    """

    times: FloatArray
    quantities: dict[str, Quantity]
    variables: dict[str, Variable]

    def __getitem__(self, name: str) -> Quantity:
        return self.quantities[name]

    def growth_rate(self, name: str) -> Quantity:
        """Return the rate γ in 1/s of exponential growth, such as of the r.m.s. of a region.

        It is the slope of the logarithm over time, by least squares in which a shot counts as its
        relative error allows; the band follows from the samples.

        Raises
        ------
        InputError
            If there is no such number, or it does not keep its sign.
        """
        if name not in self.quantities:
            names = ", ".join(self.quantities)
            raise InputError(f"got the number {name!r}, expected one of {names}")
        quantity = self.quantities[name]
        sign = np.sign(quantity.value[0])
        if not (sign * quantity.value > 0).all():
            raise InputError(
                f"{name} is zero or changes its sign in the series: expected numbers that grow or "
                "decay, such as an r.m.s."
            )
        weights = np.ones(len(self.times))
        if has_bands(quantity):
            weights = (quantity.value / np.maximum(quantity.std, _LEAST)) ** 2
        from_middle = self.times - (weights * self.times).sum() / weights.sum()
        factors = weights * from_middle / (weights * from_middle**2).sum()

        def slope(values: FloatArray) -> FloatArray:
            return np.asarray(np.log(np.maximum(sign * values, _LEAST)) @ factors)

        return Quantity(slope(quantity.value), slope(quantity.samples))


def time_series(results: Sequence[ProductResult], times: ArrayLike) -> TimeSeries:
    """Join the numbers of one product in several shots.

    Parameters
    ----------
    results : sequence of ProductResult
        Of the same product and field, one for each shot, as `analyse` returns them.
    times : array_like, shape (n,)
        Of the shots, in s, increasing.

    Returns
    -------
    TimeSeries

    Raises
    ------
    InputError
        If there are fewer than two shots, the times do not increase, or the products differ.

    Notes
    -----
    Samples of different shots are drawn by the same random numbers, so they are shuffled here.
    Errors that all shots share, such as the energy's, then count as independent, which makes the
    interval of a growth rate too wide rather than too narrow.
    """
    places = np.asarray(times, dtype=np.float64)
    if len(results) < _MIN_SHOTS or places.shape != (len(results),):
        raise InputError(
            f"got {len(results)} results and times of shape {places.shape}, expected a time for "
            "each of at least two shots"
        )
    if not (np.isfinite(places).all() and (np.diff(places) > 0).all()):
        raise InputError("the times do not increase: expected those of successive shots, in s")
    first = results[0]
    kinds = {(type(each.product), each.field) for each in results}
    if len(kinds) > 1:
        raise InputError("the results are of different products or fields, expected one of each")
    count = min(len(next(iter(each.quantities.values())).samples) for each in results)
    orders = [np.random.default_rng(shot).permutation(count) for shot in range(len(results))]
    variables = {
        name: variable
        for name, variable in first.variables.items()
        if not variable.dims and name not in first.product.recorded
    }
    quantities = {}
    for name in variables:
        shots = [each.quantities[name] for each in results]
        samples = [shot.samples[:count][order] for shot, order in zip(shots, orders, strict=True)]
        values = np.array([float(shot.value) for shot in shots])
        quantities[name] = Quantity(values, np.stack(samples, axis=1))
    return TimeSeries(places, quantities, variables)
