"""Mean, spread and peaks across the shots of a stack."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from napari_shadowinv.errors import InputError
from napari_shadowinv.io.store import DONE
from napari_shadowinv.physics.setup import SETUPS

if TYPE_CHECKING:
    import xarray


def stack_statistics(stack: xarray.Dataset) -> xarray.Dataset:
    """Describe mean, spread and peaks across the shots of a stack.

    Parameters
    ----------
    stack : xarray.Dataset
        From `invert_stack`, `run_stack` or `read`; its shots may be sliced. Shots that are not
        done are left out of mean and spread.

    Returns
    -------
    xarray.Dataset
        Lazy. For each field ``name``, by component: ``name_mean`` and ``name_std`` (y, x), the
        standard deviation of one shot (divided by shots - 1; NaN for a single shot), and
        ``name_peak`` (shot), the largest magnitude of each shot, without masked pixels if the
        stack contains a ``mask``, as a store of masked shots does.

    Raises
    ------
    InputError
        If the dataset has no shots, or no field.

    Examples
    --------
    >>> from napari_shadowinv import InversionOptions, Recipe, invert_stack
    >>> stack = invert_stack(np.ones((3, 20, 20)), Recipe(options=InversionOptions(n_sites=50)))
    >>> statistics = stack_statistics(stack)
    >>> float(statistics.displacement_peak.max())
    0.0
    """
    import xarray as xr

    in_si = [field.name for kind in SETUPS.values() for field in kind.si_fields]
    fields = dict.fromkeys(["potential", "displacement", *in_si])
    names = [name for name in fields if name in stack and "shot" in stack[name].dims]
    if not names:
        raise InputError(
            "the dataset has no fields of a series of shots: expected one from invert_stack, "
            "run_stack or a .shadowinv.zarr store"
        )
    variables: dict[str, Any] = {}
    for name in names:
        field = stack[name]
        done = field
        if "status" in stack:
            # By selection: NaN in their place would make every pixel of a mean a special case.
            done = field.isel(shot=np.flatnonzero(stack["status"].values == DONE))
        done = done.astype(np.float64)
        variables[f"{name}_mean"] = _labelled(
            done.mean("shot", skipna=False), field, "mean of shots"
        )
        spread = done.std("shot", ddof=1, skipna=False)
        if done.sizes["shot"] < 2:
            spread = spread * np.nan
        variables[f"{name}_std"] = _labelled(spread, field, "standard deviation of shots")
        peak = _peak(field, stack.get("mask"))
        variables[f"{name}_peak"] = _labelled(peak, field, "largest magnitude")
    return xr.Dataset(variables, attrs={**stack.attrs, "shots": stack.sizes["shot"]})


def _peak(field: xarray.DataArray, mask: xarray.DataArray | None) -> xarray.DataArray:
    """Return the largest magnitude of each shot among the pixels that were used."""
    squared = field.astype(np.float64) ** 2
    if "component" in field.dims:
        squared = squared.sum("component", skipna=False)
    if mask is not None:
        squared = squared.where(mask, 0.0)
    largest: xarray.DataArray = squared.max(("y", "x"), skipna=False)
    return largest**0.5


def _labelled(values: xarray.DataArray, field: xarray.DataArray, quantity: str) -> xarray.DataArray:
    name = str(field.attrs.get("long_name", field.name))
    return values.assign_attrs(units=field.attrs.get("units", "1"), long_name=f"{name}, {quantity}")
