"""The largest error of a determined result, an option of inversions and fits: `MaxError`."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

MaxError = Annotated[
    float,
    Field(
        gt=0,
        lt=1,
        title="Largest error",
        description="Largest total error, as a share of the field (r.m.s.), of a determined field.",
    ),
]
