"""What is to be done to an image before it is inverted: filters, and an estimate of its source.

- the choices, from flags and the table ``[prepare]`` of an options file: `choices_from`
- apply them: `napari_shadowinv.cli._preparing`
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field

from napari_shadowinv._system.validation import validated
from napari_shadowinv.errors import InputError
from napari_shadowinv.io import read_toml
from napari_shadowinv.preprocessing.recipes import (
    ESTIMATES,
    BackgroundFilter,
    ButterworthFilter,
    Estimate,
    Filter,
    HighPassFilter,
    LowPassFilter,
)

__all__ = ["FILTER_CHOICES", "KEYWORDS", "TABLE", "Choices", "choices_from"]

TABLE = "prepare"
"""Name of the table in an options file."""

_EstimateName = Literal[
    "uniform",
    "isotropic",
    "gaussian",
    "polynomial",
    "low-pass",
    "total-variation",
    "interpolated",
]


class Choices(BaseModel):
    """Choices before an inversion; what is None is not done, or left to the function's default."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    hot_pixels: float | None = Field(
        default=None,
        gt=0,
        allow_inf_nan=False,
        title="Hot pixels (standard deviations)",
        description="Pixels that deviate by more are replaced by the median of their neighbours.",
    )
    background_degree: int | None = Field(
        default=None,
        ge=0,
        le=10,
        title="Background degree",
        description="The image is divided by a polynomial of this degree fitted to it.",
    )
    high_pass: float | None = Field(
        default=None,
        gt=0,
        allow_inf_nan=False,
        title="High-pass width (px)",
        description="Structures much larger than this are removed; the mean is kept.",
    )
    butterworth: float | None = Field(
        default=None,
        gt=0,
        allow_inf_nan=False,
        title="Butterworth cutoff (px)",
        description="Wavelength at which the amplitude drops to 1/√2.",
    )
    butterworth_order: int | None = Field(
        default=None,
        ge=1,
        le=20,
        title="Butterworth order",
        description="The amplitude falls as this power of the wavelength.",
    )
    butterworth_kind: Literal["high", "low"] | None = Field(
        default=None,
        title="Butterworth kind",
        description="'high' removes structures larger than the cutoff, 'low' removes smaller ones.",
    )
    low_pass: float | None = Field(
        default=None,
        gt=0,
        allow_inf_nan=False,
        title="Low-pass width (px)",
        description="Image and source are blurred with a Gaussian of this standard deviation.",
    )
    source_from: _EstimateName | None = Field(
        default=None, title="Source from", description="How the source is estimated from the image."
    )
    source_centre_y: float | None = Field(
        default=None,
        allow_inf_nan=False,
        title="Centre y (px)",
        description="Row at which the detector faces an isotropic source.",
    )
    source_centre_x: float | None = Field(
        default=None,
        allow_inf_nan=False,
        title="Centre x (px)",
        description="Column at which the detector faces an isotropic source.",
    )
    source_degree: int | None = Field(
        default=None,
        ge=0,
        le=10,
        title="Source degree",
        description="Degree of a polynomial source.",
    )
    source_weight: float | None = Field(
        default=None,
        gt=0,
        allow_inf_nan=False,
        title="Weight (px)",
        description=(
            "For a total-variation source: c·r/2 removes a disc of contrast c and radius r."
        ),
    )
    source_width: float | None = Field(
        default=None,
        gt=0,
        allow_inf_nan=False,
        title="Source blur width (px)",
        description="Blur width of a low-pass or interpolated source.",
    )

    @property
    def flattens(self) -> bool:
        """Whether the beam is taken out of the image."""
        return any(one.flattens for one in self.filters())

    def filters(self) -> tuple[Filter, ...]:
        """Filters after pixels were summed, in their order."""
        chosen: list[Filter] = []
        if self.background_degree is not None:
            chosen.append(BackgroundFilter(degree=self.background_degree))
        if self.high_pass is not None:
            chosen.append(HighPassFilter(width=self.high_pass))
        if self.butterworth is not None:
            more = self.given("butterworth_order", "butterworth_kind")
            parameters = {name.removeprefix("butterworth_"): more[name] for name in more}
            chosen.append(ButterworthFilter(cutoff=self.butterworth, **parameters))
        if self.low_pass is not None:
            chosen.append(LowPassFilter(width=self.low_pass))
        return tuple(chosen)

    def estimate(self) -> Estimate | None:
        """How the source is guessed."""
        if self.source_from is None:
            return None
        parameters = {KEYWORDS[name][0]: value for name, value in self.given(*KEYWORDS).items()}
        return ESTIMATES[self.source_from.replace("-", "_")](**parameters)

    def given(self, *names: str) -> dict[str, Any]:
        """Those of some choices that were made, by name."""
        return {name: getattr(self, name) for name in names if getattr(self, name) is not None}


FILTER_CHOICES = (
    "background_degree",
    "high_pass",
    "butterworth",
    "butterworth_order",
    "butterworth_kind",
    "low_pass",
)
"""What tells the filters after pixels were summed."""

KEYWORDS: dict[str, tuple[str, tuple[_EstimateName, ...]]] = {
    "source_centre_y": ("centre_y", ("isotropic",)),
    "source_centre_x": ("centre_x", ("isotropic",)),
    "source_degree": ("degree", ("polynomial",)),
    "source_weight": ("weight", ("total-variation",)),
    "source_width": ("width", ("low-pass", "interpolated")),
}
"""The keyword of an estimate for each parameter, and which estimates take it."""


def choices_from(
    path: Path | None, flags: Mapping[str, Any], *, has_source: bool, has_source_mask: bool
) -> Choices:
    """Choices from an options file's table, with flags on top, that make sense together."""
    where = "options" if path is None else f"{path}, table [{TABLE}]"
    chosen = {} if path is None else read_toml(path).get(TABLE, {})
    if isinstance(chosen, Mapping):
        chosen = {**chosen, **flags}
    choices = validated(Choices, chosen, where)
    _check(choices, has_source, has_source_mask)
    return choices


def _flag(name: str) -> str:
    return "--" + name.replace("_", "-")


def _check(chosen: Choices, has_source: bool, has_source_mask: bool) -> None:
    """Refuse choices that contradict each other, before any work."""
    if has_source and chosen.source_from is not None:
        raise InputError(
            f"received --source and --source-from {chosen.source_from}: choose one of them"
        )
    if chosen.butterworth is None:
        for name in chosen.given("butterworth_order", "butterworth_kind"):
            raise InputError(f"received {_flag(name)}: it needs --butterworth with a cutoff in px")
    if has_source and chosen.flattens:
        (name, *_) = chosen.given("background_degree", "high_pass", "butterworth")
        raise InputError(
            f"received --source and {_flag(name)}: flattening removes the beam from the image "
            "but not from the source; use only one of them"
        )
    for name, (_, estimates) in KEYWORDS.items():
        if getattr(chosen, name) is not None and chosen.source_from not in estimates:
            wanted = " or ".join(f"--source-from {estimate}" for estimate in estimates)
            raise InputError(f"received {_flag(name)}: it needs {wanted}")
    if has_source_mask and chosen.source_from in (None, "uniform", "isotropic"):
        raise InputError(
            "received --source-mask: it needs --source-from with an estimate based on the "
            "image, such as interpolated or polynomial"
        )
    if chosen.source_from == "interpolated" and not has_source_mask:
        raise InputError(
            "--source-from interpolated needs --source-mask: an image of the same size that is "
            "0 where the object covers the beam"
        )
    if chosen.source_from == "low-pass" and chosen.source_width is None:
        raise InputError(
            "--source-from low-pass needs --source-width: the standard deviation of the blur in "
            "px, a few times the object's size"
        )
