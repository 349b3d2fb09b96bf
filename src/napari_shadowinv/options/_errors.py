"""The largest error of a determined result, an option of inversions and fits: `MaxError`."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import Field

__all__ = ["BUDGET_PANEL", "MaxError"]

BUDGET_PANEL: Any = {"panel": "Error budget (docs/uncertainty.md)"}
"""Panel of flags in the help of a command."""

MaxError = Annotated[
    float,
    Field(
        gt=0,
        lt=1,
        title="Largest error",
        description="Largest total error, as a share of the field (r.m.s.), of a determined field.",
        json_schema_extra=BUDGET_PANEL,
    ),
]
