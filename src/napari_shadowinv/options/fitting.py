"""Choices of a fit: `FitOptions` of its method, `FitChoices` of its unknowns and its data."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Annotated, Any, Literal, Self, get_args

from pydantic import BeforeValidator, Field, field_validator, model_validator

from napari_shadowinv._system.validation import CheckedModel, CombinationError, Seed, Threads
from napari_shadowinv.options.inversion import MaxError
from napari_shadowinv.physics.setup import deflector_titles

MAX_STRENGTH = 1e4
"""Largest ratio of an image's displacement to the first one's."""


PointSpread = Annotated[
    float | None,
    Field(
        ge=0,
        title="Point spread (px)",
        description="Standard deviation of the point spread in px after all steps. Default: none.",
    ),
]
SourceSize = Annotated[
    float | None,
    Field(
        ge=0,
        title="Source size (m)",
        description="Standard deviation of the beam's source in m (FWHM / 2.355). Use it with the "
        "resolution, instead of the point spread in px.",
    ),
]
Resolution = Annotated[
    float | None,
    Field(
        ge=0,
        title="Resolution (m)",
        description="Standard deviation of the detector's point spread in m, at the detector.",
    ),
]


def refuse_two_point_spreads(choices: Any) -> None:
    """Raise a `CombinationError` if a point spread is stated both in px and in m."""
    in_metres = [
        name for name in ("source_size", "resolution") if getattr(choices, name) is not None
    ]
    if choices.psf is not None and in_metres:
        raise CombinationError(
            f"received {{psf}}, a point spread in px, and {{{in_metres[0]}}} in m: expected one or "
            "the other"
        )


def _any_of(names: Iterable[str]) -> str:
    *most, last = names
    return f"{', '.join(most)} or {last}"


class FitOptions(CheckedModel, allow_inf_nan=False):
    """Choices of a fit; all have a default that suits most images.

    An `InputError` if a value is out of range or a name is unknown.

    Examples
    --------
    >>> FitOptions(align="shift").boundary
    'fading'
    """

    smoothness: float | None = Field(
        default=None,
        gt=0,
        description="Weight of the squared fourth derivatives of each field's potential (px). "
        "Default: weights of fourth and sixth derivatives estimated from the data, for each field.",
    )
    boundary: Literal["fading", "free"] = Field(
        default="fading",
        description="'fading': the object lies within the image and its field fades towards the "
        "edge. 'free': the object extends beyond the edge, where its potential decays.",
    )
    margin: int | None = Field(
        default=None,
        ge=16,
        multiple_of=8,
        title="Margin (px)",
        description="Width of the strip beyond each edge from which rays may enter. Default: 16, "
        "or with a free boundary a tenth of the image's shorter side.",
    )
    decay_length: float | None = Field(
        default=None,
        ge=0.1,
        le=1e6,
        title="Decay length (px)",
        description="Free boundary only: distance over which the potential decays beyond the edge. "
        "Default: the margin.",
    )
    align: Literal["none", "shift", "affine"] = Field(
        default="none",
        title="Alignment",
        description="Misalignment to fit for all images after the first: 'none', 'shift', or "
        "'affine' (also rotation, magnification and shear).",
    )
    align_spread: float = Field(
        default=5.0,
        gt=0,
        title="Expected shift (px)",
        description="Expected misalignment of later images (standard deviation in px after all "
        "steps). A small value attributes more of the displacement to the fields.",
    )
    max_error: MaxError = 0.05
    samples: int = Field(
        default=6,
        ge=0,
        le=1000,
        description="Number of random fields for the error bars, at least 16 where the beams of "
        "energies differ; 0 for no error bars.",
    )
    spacing: float | None = Field(
        default=None,
        ge=0.05,
        le=0.5,
        title="Ray spacing (px)",
        description="Largest distance between the landing points of neighbouring rays. Default: "
        "0.2, or 0.14 if bright lines need it.",
    )
    max_iterations: int = Field(
        default=120,
        ge=1,
        title="Iterations",
        description="Maximum solver iterations at full resolution.",
    )
    ambiguous: bool = Field(
        default=False,
        title="Allow an ambiguous fit",
        description="Fit a single image even if its source is unknown, although many beams and "
        "fields explain it equally well.",
    )
    seed: Seed = 0
    threads: Threads = None


def _parse_noise(value: Any) -> Any:
    if value is None or value in KINDS_OF_NOISE:
        return value
    try:
        deviation = float(value)
    except (TypeError, ValueError):
        deviation = 0.0
    if not 0 < deviation < float("inf"):
        raise ValueError("expected 'poisson', 'proportional' or the standard deviation of a pixel")
    return deviation


KindOfNoise = Literal["poisson", "proportional"]
KINDS_OF_NOISE = get_args(KindOfNoise)
Noise = Annotated[KindOfNoise | float, BeforeValidator(_parse_noise)]
"""The noise of an image: Poisson counts, a fraction of each pixel, or a standard deviation."""


class FitChoices(CheckedModel, allow_inf_nan=False):
    """Unknowns of a fit, and knowledge about its images.

    An `InputError` if a value is out of range, a name is unknown, or the point spread is given both
    in px and in m.

    Examples
    --------
    >>> FitChoices(fields="B, E", options=FitOptions(samples=0)).fields
    ('B', 'E')
    """

    fields: tuple[str, ...] | None = Field(
        default=None,
        description=(
            f"Cause of the deflection: {_any_of(deflector_titles())}. Two of them, "
            "separated by a comma, need images at two energies. Default: B, or phase for light."
        ),
    )
    beam: Literal["known", "unknown"] = Field(
        default="known",
        description="'known': the source is the beam. 'unknown': fit a smooth beam, the same for "
        "all images apart from its brightness.",
    )
    brightness: Literal["known", "free"] = Field(
        default="known",
        description="'known': images are as bright as the source. 'free': fit the brightness of "
        "each image relative to the source.",
    )
    noise: Noise | None = Field(
        default=None,
        description="'poisson' for images in counts; 'proportional' if the noise is a fraction of "
        "each pixel, as on film; or the standard deviation of a pixel after all steps. Default: "
        "estimated from the images, the same for all pixels.",
        examples=["estimated; or poisson, proportional"],
    )
    psf: PointSpread = None
    source_size: SourceSize = None
    resolution: Resolution = None
    options: FitOptions = Field(default=FitOptions(), description="Options of the fit.")

    @field_validator("fields", mode="before")
    @classmethod
    def _split_names(cls, value: Any) -> Any:
        return [name.strip() for name in value.split(",")] if isinstance(value, str) else value

    @field_validator("fields")
    @classmethod
    def _check_names(cls, names: tuple[str, ...] | None) -> tuple[str, ...] | None:
        unique, keys = set(names or ()), deflector_titles()
        if names is not None and (not unique or unique - keys.keys() or len(unique) < len(names)):
            raise ValueError(f"expected one or more of {', '.join(keys)}, each once")
        return names

    @model_validator(mode="after")
    def _check_point_spread(self) -> Self:
        refuse_two_point_spreads(self)
        return self
