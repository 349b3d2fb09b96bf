"""Options that an inversion and a fit share: how far the true beam may be from its source."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

__all__ = ["BeamScale", "BeamVariation"]

BeamVariation = Annotated[
    float | None,
    Field(
        ge=0,
        lt=1,
        title="Beam variation",
        description=(
            "Relative r.m.s. difference between the true beam and the source, for the error bars. "
            "Default: 0.05 for a uniform or estimated source, 0 for a recorded one. An inversion "
            "uses the difference between image and source outside the object if that is larger."
        ),
    ),
]
BeamScale = Annotated[
    float,
    Field(
        gt=0,
        le=1,
        title="Beam scale",
        description=(
            "Length over which the true beam differs from the source, as a share of the image's "
            "shorter side."
        ),
    ),
]
