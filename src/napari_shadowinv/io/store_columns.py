"""Numbers and words of each shot, as stores, tables and windows list them: `COLUMNS`.

A column is described once. Who reads a store gets an array of each of its columns, ``shadowinv
export --format csv`` writes them all, the window of a stack lists those that have a function to
`show` them. A store itself holds them in the reports of its shots.

- add a column: one entry of `COLUMNS`
- the columns of a store: `columns_of`; their values from a result: `column_values`
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from operator import attrgetter
from typing import Any

import numpy as np

from napari_shadowinv._typing import AnyArray
from napari_shadowinv.facts import percent
from napari_shadowinv.physics.units import display_unit


@dataclass(frozen=True)
class ShotColumn:
    """Quantity of each shot of a store."""

    key: str  # name of its array and of its entry in a shot's report
    long_name: str  # label of the array
    title: str = ""  # heading of tables for people, if it is not the key
    unit: str = "1"  # of the array
    kind: type = float  # or bool, int or str
    # Returns the value of an `Inversion`, None if this one has none. Without it, the value comes
    # from the run.
    value: Callable[[Any], Any] | None = None
    show: Callable[[Any], str] | None = None  # in tables for people, which omit columns without it

    def __post_init__(self) -> None:
        object.__setattr__(self, "title", self.title or self.key.replace("_", " "))

    @property
    def labels(self) -> dict[str, str]:
        """Attributes of the array."""
        return {"units": self.unit, "long_name": self.long_name}

    @property
    def heading(self) -> str:
        """Heading of tables for programs."""
        return self.key if self.unit == "1" else f"{self.key} ({display_unit(self.unit)})"

    def values(self, reports: Iterable[Mapping[str, Any]]) -> AnyArray:
        """Return the values from the reports of shots; NaN, 0 or no text without one."""
        fill: Any = {str: "", float: math.nan}.get(self.kind, 0)
        values = [report.get(self.key, fill) for report in reports]
        return np.array(values, object if self.kind is str else self.kind)

    def text(self, report: Mapping[str, Any]) -> str:
        """Return the value from a shot's report as text, empty without a value."""
        return self.show(report[self.key]) if self.show and self.key in report else ""


# In the order of all tables.
COLUMNS: tuple[ShotColumn, ...] = (
    ShotColumn("seconds", "Time its worker spent on the shot", unit="s"),
    ShotColumn(
        "verdict",
        "Whether the field may be believed",
        kind=str,
        value=lambda result: str(result.verdict),
        show=str,
    ),
    ShotColumn(
        "cautions",
        "Codes of the reasons to doubt the result",
        kind=str,
        value=lambda result: " ".join(dict.fromkeys(each.code for each in result.cautions)),
    ),
    ShotColumn(
        "total_error",
        "Error of the displacement, r.m.s., as a share of it",
        title="errors",
        value=attrgetter("total_error"),
    ),
    ShotColumn(
        "limited_by",
        "Largest part of the error, as a share of the displacement",
        kind=str,
        value=attrgetter("limited_by"),
        show=str,
    ),
    ShotColumn(
        "converged", "Whether the solver converged", kind=bool, value=attrgetter("report.converged")
    ),
    ShotColumn(
        "flux_residual",
        "Largest relative flux error of a cell",
        value=attrgetter("report.residual"),
    ),
    ShotColumn(
        "iterations",
        "Iterations of the solver, on all levels",
        kind=int,
        value=attrgetter("report.iterations"),
    ),
    ShotColumn(
        "image_residual",
        "Image minus re-projection, r.m.s. relative to the mean",
        value=attrgetter("report.image_residual"),
        show=percent,
    ),
)


def columns_of(own_setups: str | None) -> tuple[ShotColumn, ...]:
    """Return the columns of a store, with energies or wavelengths if each shot has its own setup.

    `own_setups` is the kind of these setups, None where all shots share one.
    """
    beam = () if own_setups is None else (_beam_column(own_setups),)
    return (COLUMNS[0], *beam, *COLUMNS[1:])


def _beam_column(setup_kind: str) -> ShotColumn:
    from napari_shadowinv.physics.setup import SETUPS

    quantity = SETUPS.get(setup_kind, SETUPS["proton"]).beam_quantity()
    return ShotColumn(
        quantity.name,
        quantity.long_name,
        title=quantity.noun if quantity.unit == "m" else quantity.unit,
        unit=quantity.unit,
        value=lambda inversion: inversion.setup and inversion.setup.beam_value,
        show="{:g}".format,
    )


def column_values(inversion: Any, *, own_setup: bool = False) -> dict[str, Any]:
    """Return the values of an inversion by the columns' keys, for the shot's report."""
    columns = columns_of(inversion.setup.kind if own_setup and inversion.setup else None)
    values = {column.key: column.value(inversion) for column in columns if column.value}
    return {key: value for key, value in values.items() if value is not None}
