"""A product over successive shots: `analyse_shots`.

- the time of each shot from the time between two: `shot_times`
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from napari_shadowinv._system.progress import OnProgress, Reporter, ShouldStop
from napari_shadowinv._typing import FloatArray
from napari_shadowinv.analysis._analyse import analyse
from napari_shadowinv.analysis.product import Coordinate, Measurand, Product
from napari_shadowinv.analysis.result import SERIES_AXES, ProductResult
from napari_shadowinv.errors import InputError
from napari_shadowinv.facts import Fact
from napari_shadowinv.inversion.error_bars import Quantity

if TYPE_CHECKING:
    import xarray

    from napari_shadowinv.physics.setup import Setup

_TIME, _SHOT = SERIES_AXES
_AXES = {"s": (_TIME, "time"), "": (_SHOT, "number of the shot")}


def _join(results: Sequence[ProductResult], places: FloatArray, unit: str) -> ProductResult:
    """Join results at times in s, or at numbers of shots."""
    if not (np.isfinite(places).all() and (np.diff(places) > 0).all()):
        places_in_words = "times" if unit else "numbers of the shots"
        raise InputError(
            f"the {places_in_words} do not increase: expected those of successive shots"
            f"{', in s' if unit else ''}"
        )
    first = results[0]
    axis, long_name = _AXES[unit]
    variables = {
        name: replace(variable, dims=(axis,)) for name, variable in _single_numbers(first).items()
    }
    quantities = {}
    for name in variables:
        shots = [each.quantities[name] for each in results]
        values = np.array([float(shot.value) for shot in shots])
        quantities[name] = Quantity(
            values, np.stack([shot.samples for shot in shots], axis=1), shots[0].is_maximum
        )
    result = replace(
        first,
        quantities=quantities,
        variables=variables,
        coordinates={axis: Coordinate(places, unit, long_name)},
        stored={},
    )
    return replace(result, facts=tuple(_facts(result)))


def _single_numbers(result: ProductResult) -> dict[str, Measurand]:
    variables = {
        name: variable
        for name, variable in result.variables.items()
        if not variable.dims and name not in result.product.recorded
    }
    if not variables:
        raise InputError(
            f"the {result.product.title} has no single number to follow over the shots: expected "
            "a product with one, such as a region or a flux"
        )
    return variables


def _facts(series: ProductResult) -> Iterator[Fact]:
    """Yield each number in the first and last shot, and the contents of the band."""
    for name, quantity in series.quantities.items():
        variable = series.variables[name]
        title = variable.title or name.replace("_", " ")
        factor, symbol = series.shown_scale([name])
        first, last = factor * quantity.value[[0, -1]]
        of_unit = "" if symbol == "1" else f" {symbol}"
        text = f"{first:.4g} to {last:.4g}{of_unit}, first to last shot"
        yield Fact(name, f"{title[:1].upper()}{title[1:]}", text, short=text)
    yield from (fact for fact in series.facts if fact.key == "bands")


def shot_times(numbers: Sequence[float], shots: Sequence[int], received: str) -> list[float]:
    """Return the times of numbered shots from the time in s between two, or from a list of all.

    An `InputError`, which begins with the text received, such as ``"--times is '1,2'"``, if there
    are neither one nor as many numbers as shots.
    """
    if len(numbers) == 1 and len(shots) > 1:
        return [float(shot) * numbers[0] for shot in shots]
    if len(numbers) != len(shots):
        raise InputError(
            f"{received}, expected the time between two shots in s, or a list for the "
            f"{len(shots)} finished ones"
        )
    return list(numbers)


def analyse_shots(
    stack: xarray.Dataset,
    products: Product | Mapping[str, Any] | Sequence[Product | Mapping[str, Any]],
    times: ArrayLike | None = None,
    *,
    unit: str | None = None,
    deflector: str | None = None,
    setup: Setup | None = None,
    on_progress: OnProgress | None = None,
    should_stop: ShouldStop | None = None,
) -> list[ProductResult]:
    """Measure products in each shot of a stack.

    A store keeps fields without the errors of their pixels, so the numbers have no bands.

    Parameters
    ----------
    stack : xarray.Dataset
        Shots of a store, as `read` returns them, along the axis ``shot``. Those without a field
        are left out.
    products, unit, deflector, setup, on_progress, should_stop
        As of `analyse`.
    times : array_like, shape (n,), optional
        Of all shots in s. Default: shots have their numbers in the stack's coordinate ``shot``.

    Returns
    -------
    list of ProductResult
        The single numbers along the axis of the shots, for each product, and each field that it is
        defined for.

    Raises
    ------
    InputError
        If it is no stack, fewer than two shots have a field, the times do not increase, or as of
        `analyse`.
    InversionCancelled
        If `should_stop` returned true.
    """
    if "shot" not in getattr(stack, "dims", ()) or "displacement" not in stack:
        raise InputError("got no stack of shots with fields, expected that of a store")
    count = stack.sizes["shot"]
    numbers = stack["shot"].values  # 0, 1, … if the stack has no coordinate
    if numbers.dtype.kind not in "iuf":
        numbers = np.arange(count)
    places = np.asarray(numbers if times is None else times, dtype=np.float64)
    if places.shape != (count,):
        raise InputError(
            f"got times of shape {places.shape}, expected one for each of {count} shots"
        )
    fitted = json.loads(stack.attrs.get("fields", "[]"))
    deflector = deflector or (fitted[0] if fitted else None)
    report = Reporter(on_progress, should_stop)
    used, shots = [], []
    for index in range(count):
        report("shots", index, count)
        shot = stack.isel(shot=index).load()
        if not np.isfinite(shot["displacement"].values).any():
            continue
        used.append(index)
        shots.append(analyse(shot, products, unit=unit, deflector=deflector, setup=setup))
        if len(shots) == 1:
            for result in shots[0]:
                _single_numbers(result)  # the other shots would be measured in vain
    if len(shots) < 2:
        raise InputError(f"{len(shots)} of {count} shots have a field, expected at least two")
    unit_of_places = "" if times is None else "s"
    return [_join(results, places[used], unit_of_places) for results in zip(*shots, strict=True)]
