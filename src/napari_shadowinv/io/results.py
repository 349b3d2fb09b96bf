"""The results that datasets hold: `result_from_dataset`."""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeAlias

from napari_shadowinv.facts import ResultKind

if TYPE_CHECKING:
    import xarray

    from napari_shadowinv.film_doses import FilmDoses
    from napari_shadowinv.fitting import Fit
    from napari_shadowinv.inversion import Inversion
    from napari_shadowinv.inversion.field import RetrievedField

    AnyResult: TypeAlias = Inversion | Fit | FilmDoses | RetrievedField

__all__ = ["AnyResult", "result_from_dataset"]


def result_from_dataset(dataset: xarray.Dataset) -> AnyResult:
    """Return the result in a dataset; its attributes decide on the kind.

    Raises
    ------
    InputError
        If a variable or attribute is missing or damaged.
    """
    from napari_shadowinv.film_doses import FilmDoses
    from napari_shadowinv.fitting import Fit
    from napari_shadowinv.inversion import Inversion
    from napari_shadowinv.inversion.field import RetrievedField

    classes: dict[ResultKind, type[AnyResult]] = {
        ResultKind.INVERSION: Inversion,
        ResultKind.FIT: Fit,
        ResultKind.FILM_DOSES: FilmDoses,
        ResultKind.FIELD: RetrievedField,
    }
    return classes[ResultKind.of(dataset.attrs)].from_dataset(dataset)
