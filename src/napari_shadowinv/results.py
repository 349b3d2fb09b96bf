"""The result of one shot, of any kind: `AnyResult`, `result_from_dataset`, `unpack_result`."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, TypeAlias

from napari_shadowinv.errors import InputError
from napari_shadowinv.facts import ResultKind

if TYPE_CHECKING:
    import xarray

    from napari_shadowinv.film_doses import FilmDoses
    from napari_shadowinv.fitting import Fit
    from napari_shadowinv.inversion import Inversion
    from napari_shadowinv.inversion.result import RetrievedField

    AnyResult: TypeAlias = Inversion | Fit | FilmDoses | RetrievedField


def result_from_dataset(dataset: xarray.Dataset) -> AnyResult:
    """Return the result in a dataset; its attributes decide on the kind.

    An `InputError` if a variable or attribute is missing or damaged.
    """
    from napari_shadowinv.film_doses import FilmDoses
    from napari_shadowinv.fitting import Fit
    from napari_shadowinv.inversion import Inversion
    from napari_shadowinv.inversion.result import RetrievedField

    kind = ResultKind.of(dataset.attrs)
    classes: tuple[type[AnyResult], ...] = (Inversion, Fit, FilmDoses, RetrievedField)
    return next(each for each in classes if each.kind is kind).from_dataset(dataset)


def unpack_result(result: Any) -> AnyResult:
    """Return a result, or the result in a dataset, of a single shot; else an `InputError`."""
    if hasattr(type(result), "headline"):
        content: AnyResult = result
        return content
    if not hasattr(result, "data_vars"):
        raise InputError(f"got {type(result).__name__}, expected a result or its dataset")
    if "shot" in result.dims:
        raise InputError(
            "got a stack of shots, expected the result of one shot: choose one by its index"
        )
    return result_from_dataset(result)
