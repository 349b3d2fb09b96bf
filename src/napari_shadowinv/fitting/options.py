"""Every choice of a fit, in one validated model: `FitOptions`."""

from __future__ import annotations

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

__all__ = ["FitOptions"]


class FitOptions(BaseModel):
    """Choices of a fit; all have a default that suits most images.

    Raises
    ------
    pydantic.ValidationError
        (a `ValueError`) if a value is out of range or a name is unknown.

    Examples
    --------
    >>> FitOptions(align="shift").edge
    'fading'
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    smoothness: float | None = Field(
        default=None,
        gt=0,
        title="Smoothness",
        description=(
            "Weight of the squared fourth derivatives of each field's potential (px). Default: "
            "those of fourth and sixth derivatives are found from the data, for each field."
        ),
    )
    edge: Literal["fading", "free"] = Field(
        default="fading",
        title="Field at the edge",
        description=(
            "'fading': the object lies within the image, its field fades towards the edge. "
            "'free': it goes on beyond the edge, where its potential decays."
        ),
    )
    strip: int | None = Field(
        default=None,
        ge=16,
        multiple_of=8,
        title="Strip around the image (px)",
        description=(
            "Width of the strip beyond the edge from which rays may enter. Default: 16, or with a "
            "free edge a tenth of the shorter side."
        ),
    )
    fade_length: float | None = Field(
        default=None,
        gt=0,
        title="Decay length of the field (px)",
        description=(
            "Free edge only: length over which the potential decays beyond the edge. Default: "
            "the width of the strip."
        ),
    )
    align: Literal["none", "shift", "affine"] = Field(
        default="none",
        title="Align",
        description=(
            "What is not known of how later images lie on the first: 'none', their 'shift', or "
            "also rotation, magnification and shear ('affine')."
        ),
    )
    beam_modes: int = Field(
        default=8,
        ge=2,
        le=32,
        title="Cosines of the beam",
        description="With an unknown source: how many cosines its logarithm has along each axis.",
    )
    samples: int = Field(
        default=6,
        ge=0,
        le=1000,
        title="Samples",
        description="Random fields from which the error bars are made; 0 for none.",
    )
    evidence: bool = Field(
        default=False,
        title="Evidence",
        description=(
            "Work out how likely the choice of fields makes the data, to compare choices; takes "
            "as long as some samples."
        ),
    )
    spacing: float | None = Field(
        default=None,
        ge=0.05,
        le=0.5,
        title="Spacing of rays (px)",
        description=(
            "Largest distance between the landing points of neighbouring rays. Default: 0.2, and "
            "0.14 if bright lines need it."
        ),
    )
    steps: int = Field(
        default=120,
        ge=1,
        title="Steps at full size",
        description="Maximum number of steps with the pixels as recorded.",
    )
    ambiguous: bool = Field(
        default=False,
        title="Fit what one image cannot tell",
        description=(
            "Fit a single image with an unknown source, too, though many beams and fields explain "
            "it equally well."
        ),
    )
    seed: int = Field(
        default=0,
        ge=0,
        title="Random seed",
        description="Seed of all random choices; the same seed gives the same result.",
    )
    threads: int | None = Field(
        default=None,
        ge=1,
        title="Number of threads",
        description="Number of threads. Default: all cores. It does not affect the result.",
    )
