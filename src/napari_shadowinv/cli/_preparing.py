"""What is done to an image before it is inverted: filters, and an estimate of its source.

- the choices, from flags and the table ``[prepare]`` of an options file: `preparation_from`
- apply them: `repaired` before pixels are summed, `filtered` and `estimated` after it
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from napari_shadowinv import filters, sources
from napari_shadowinv.errors import InputError
from napari_shadowinv.io import Radiograph
from napari_shadowinv.validation import validated

__all__ = ["TABLE", "Preparation", "estimated", "filtered", "preparation_from", "repaired"]

Plane = NDArray[np.float64]
Mask = NDArray[np.bool_]

TABLE = "prepare"
"""Name of the table in an options file."""

Estimate = Literal[
    "uniform", "gaussian", "polynomial", "low-pass", "total-variation", "interpolated"
]


class Preparation(BaseModel):
    """Choices before an inversion; what is None is not done, or left to the function's default."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    hot_pixels: float | None = Field(
        default=None,
        gt=0,
        allow_inf_nan=False,
        title="Hot pixels (standard deviations)",
        description="Pixels that stand out by more are replaced by their neighbours' median.",
    )
    background_degree: int | None = Field(
        default=None,
        ge=0,
        le=10,
        title="Degree of the background",
        description="The image is divided by a polynomial of this degree fitted to it.",
    )
    high_pass: float | None = Field(
        default=None,
        gt=0,
        allow_inf_nan=False,
        title="Width of the high pass (px)",
        description="Structures much larger than this are taken away; the mean stays.",
    )
    low_pass: float | None = Field(
        default=None,
        gt=0,
        allow_inf_nan=False,
        title="Width of the low pass (px)",
        description="Image and source are blurred by a Gaussian of this standard deviation.",
    )
    source_from: Estimate | None = Field(
        default=None, title="Source from", description="How the source is guessed from the image."
    )
    source_degree: int | None = Field(
        default=None,
        ge=0,
        le=10,
        title="Degree of the source",
        description="Of a polynomial source.",
    )
    source_weight: float | None = Field(
        default=None,
        gt=0,
        allow_inf_nan=False,
        title="Weight (px)",
        description="Of a total-variation source: c r/2 removes a disc of contrast c, radius r.",
    )
    source_width: float | None = Field(
        default=None,
        gt=0,
        allow_inf_nan=False,
        title="Width of the source's blur (px)",
        description="Of a low-pass or interpolated source.",
    )

    @property
    def flattens(self) -> bool:
        """Whether the beam is taken out of the image."""
        return self.background_degree is not None or self.high_pass is not None


# Which estimate takes which parameter, and the keyword of its function.
_KEYWORDS: dict[str, tuple[str, tuple[Estimate, ...]]] = {
    "source_degree": ("degree", ("polynomial",)),
    "source_weight": ("weight", ("total-variation",)),
    "source_width": ("width", ("low-pass", "interpolated")),
}
_FUNCTIONS: dict[Estimate, Callable[..., Plane]] = {
    "uniform": sources.uniform_source,
    "gaussian": sources.gaussian_source,
    "polynomial": sources.polynomial_source,
    "low-pass": sources.low_pass_source,
    "total-variation": sources.total_variation_source,
    "interpolated": sources.interpolated_source,
}


def preparation_from(
    path: Path | None, flags: Mapping[str, Any], *, has_source: bool, has_source_mask: bool
) -> Preparation:
    """Choices from an options file's table, with flags on top, that make sense together."""
    from napari_shadowinv.io import read_toml

    where = "options" if path is None else f"{path}, table [{TABLE}]"
    chosen = {} if path is None else read_toml(path).get(TABLE, {})
    if isinstance(chosen, Mapping):
        given = {name: value for name, value in flags.items() if value is not None}
        chosen = {**chosen, **given}
    preparation = validated(Preparation, chosen, where)
    _check(preparation, has_source, has_source_mask)
    return preparation


def _flag(name: str) -> str:
    return "--" + name.replace("_", "-")


def _check(chosen: Preparation, has_source: bool, has_source_mask: bool) -> None:
    """Refuse choices that contradict each other, before any work."""
    if has_source and chosen.source_from is not None:
        raise InputError(
            f"received --source and --source-from {chosen.source_from}: choose one of them"
        )
    if has_source and chosen.flattens:
        name = "high_pass" if chosen.background_degree is None else "background_degree"
        raise InputError(
            f"received --source and {_flag(name)}: what flattens the image takes the beam out of "
            "it, which the source still has; leave one of them out"
        )
    for name, (_, estimates) in _KEYWORDS.items():
        if getattr(chosen, name) is not None and chosen.source_from not in estimates:
            wanted = " or ".join(f"--source-from {estimate}" for estimate in estimates)
            raise InputError(f"received {_flag(name)}: it needs {wanted}")
    if has_source_mask and chosen.source_from in (None, "uniform"):
        raise InputError(
            "received --source-mask: it needs --source-from with an estimate that looks at the "
            "image, such as interpolated or polynomial"
        )
    if chosen.source_from == "interpolated" and not has_source_mask:
        raise InputError(
            "--source-from interpolated needs --source-mask: a picture of the image's size that "
            "is 0 where the object covers the beam"
        )
    if chosen.source_from == "low-pass" and chosen.source_width is None:
        raise InputError(
            "--source-from low-pass needs --source-width: the standard deviation of the blur in "
            "px, a few times the size of the object"
        )


def repaired(shot: Radiograph, chosen: Preparation) -> Radiograph:
    """Replace hot and dead pixels, while pixels are still those of the detector."""
    if chosen.hot_pixels is None:
        return shot
    found: list[Mask] = []

    def repair(image: Plane) -> Plane:
        clean, hot, dead = filters.remove_hot_pixels(image, threshold=chosen.hot_pixels or 0)
        found.extend((hot, dead))
        return clean

    image = _apply(shot, repair)
    usable = np.ones(image.shape, bool) if shot.mask is None else shot.mask
    hot, dead = (int((pixels & usable).sum()) for pixels in found)
    note = f"{hot} hot and {dead} dead pixels replaced (beyond {chosen.hot_pixels:g} deviations)"
    return _with(shot, image, note, {"hot_pixels": chosen.hot_pixels})


def filtered(shot: Radiograph, chosen: Preparation, *, is_source: bool = False) -> Radiograph:
    """Flatten and blur a shot; a measured source is only blurred, as much as its shot."""
    if chosen.background_degree is not None and not is_source:
        degree, usable = chosen.background_degree, shot.mask
        image = _apply(shot, lambda image: filters.remove_background(image, degree, mask=usable))
        note = f"divided by a polynomial of degree {degree}"
        shot = _with(shot, image, note, {"background_degree": degree})
    if chosen.high_pass is not None and not is_source:
        width = chosen.high_pass
        image = _apply(shot, lambda image: filters.high_pass(image, width))
        shot = _with(shot, image, f"high pass of {width:g} px", {"high_pass": width})
    if chosen.low_pass is not None:
        blur = chosen.low_pass
        image = _apply(shot, lambda image: filters.low_pass(image, blur))
        shot = _with(shot, image, f"low pass of {blur:g} px", {"low_pass": blur})
    return shot


def estimated(shot: Radiograph, chosen: Preparation, bare: Mask | None) -> Radiograph | None:
    """Guess the source from a shot; `bare` is True where the object is not."""
    if chosen.source_from is None:
        return None
    parameters = {
        name: getattr(chosen, name) for name in _KEYWORDS if getattr(chosen, name) is not None
    }
    usable = _both(shot.mask, bare)
    keywords = {_KEYWORDS[name][0]: value for name, value in parameters.items()}
    try:
        beam = _FUNCTIONS[chosen.source_from](shot.image, mask=usable, **keywords)
    except InputError as error:
        raise InputError(f"{shot.path}: {error}") from error
    details = "".join(f", {_KEYWORDS[name][0]} {value:g}" for name, value in parameters.items())
    recorded = {"source_from": chosen.source_from, **parameters}
    return _with(Radiograph(beam), beam, f"{chosen.source_from}{details}", recorded)


def _both(first: Mask | None, second: Mask | None) -> Mask | None:
    if first is None or second is None:
        return second if first is None else first
    return first & second


def _apply(shot: Radiograph, change: Callable[[Plane], Plane]) -> Plane:
    """Filter an image whose masked pixels, which may hold anything, must not leak out."""
    image = shot.image
    try:
        if shot.mask is not None and not shot.mask.all():
            image = np.where(shot.mask, image, sources.interpolated_source(image, shot.mask))
        return change(image)
    except InputError as error:
        raise InputError(f"{shot.path}: {error}") from error


def _with(shot: Radiograph, image: Plane, note: str, recorded: Mapping[str, Any]) -> Radiograph:
    """The same shot with another image, and word of what was done to it."""
    metadata = {
        **shot.metadata,
        "notes": (*shot.metadata.get("notes", ()), note),
        "preparation": {**shot.metadata.get("preparation", {}), **recorded},
    }
    return replace(shot, image=image, metadata=metadata)
