"""Choices of a planned experiment, as a model: `ExperimentOptions`."""

from __future__ import annotations

from typing import Literal, Self

from pydantic import Field, model_validator

from napari_shadowinv._system.validation import CheckedModel, CombinationError, Seed, Threads
from napari_shadowinv.options import MaxError
from napari_shadowinv.options.fitting import (
    PointSpread,
    Resolution,
    SourceSize,
    refuse_two_point_spreads,
)


class ExperimentOptions(CheckedModel, allow_inf_nan=False):
    """Choices of a planned experiment, apart from its object, its setups and its instrument.

    Raises
    ------
    InputError
        If a value is out of range, or the point spread is given both in px and in m.

    Examples
    --------
    >>> ExperimentOptions(counts=300, reference="recorded").is_recorded
    True
    """

    counts: float = Field(
        default=1000.0,
        gt=0,
        le=1e9,
        description="Mean counts a pixel without the object, in each image.",
    )
    reference: Literal["none", "recorded"] = Field(
        default="none",
        description="'recorded': an image of the beam without the object is the source. 'none': a "
        "uniform beam is assumed.",
    )
    reference_counts: float | None = Field(
        default=None,
        gt=0,
        le=1e12,
        title="Counts of the reference",
        description="Mean counts a pixel of the reference. Default: as many as in an image.",
    )
    beam_structure: float = Field(
        default=0.0,
        ge=0,
        lt=0.5,
        description="Relative r.m.s. structure of the beam that the reference records, over the "
        "beam's length. How far the beam differs from its reference is a number of the instrument.",
    )
    psf: PointSpread = Field(default=None, le=20)
    source_size: SourceSize = None
    resolution: Resolution = None
    draws: int = Field(
        default=20,
        ge=2,
        le=1000,
        description="Number of simulated shots, each with its own imperfections and noise.",
    )
    method: Literal["automatic", "inversion", "fit"] = Field(
        default="automatic",
        description="'inversion' for one image, 'fit' for several or one. Default: an inversion "
        "for one image.",
    )
    searched: int = Field(
        default=1,
        ge=1,
        le=1000,
        title="Draws with a full search",
        description="Number of draws whose fit looks for alternative solutions from all starting "
        "points and computes error bars. The other fits start near the true field.",
    )
    max_error: MaxError = 0.05
    seed: Seed = 0
    threads: Threads = None

    @model_validator(mode="after")
    def _check_combinations(self) -> Self:
        refuse_two_point_spreads(self)
        if self.reference == "none":
            for name in ("reference_counts", "beam_structure"):
                if getattr(self, name):
                    raise CombinationError(
                        f"received {{{name}}}, but {{reference}} is 'none': state that a reference "
                        "is recorded, or leave it out"
                    )
        return self

    @property
    def is_recorded(self) -> bool:
        """Whether a reference is recorded."""
        return self.reference == "recorded"
