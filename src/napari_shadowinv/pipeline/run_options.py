"""Choices of a run over many shots, as models: `RunOptions`, `WatchOptions`."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

from pydantic import Field, field_validator

from napari_shadowinv._system.validation import CheckedModel


class _StoreOptions(CheckedModel, allow_inf_nan=False):
    variables: tuple[str, ...] | None = Field(
        default=None,
        description="Variables to store; on the command line, separated by commas. Default: "
        "potential, displacement, caustic and mask, at a million pixels 14 MB per shot before "
        "compression.",
    )
    dtype: Literal["float32", "float64"] = Field(
        default="float32",
        title="Stored type",
        description="Type of stored images; sites, weights and scalars keep 64 bits.",
    )
    overwrite: bool = Field(default=False, description="Discard the content of the store.")
    redo_failed: bool = Field(
        default=False, title="Retry failed shots", description="Resume, and retry failed shots."
    )

    @field_validator("variables", mode="before")
    @classmethod
    def _split(cls, value: Any) -> Any:
        if not isinstance(value, str):
            return value if value is None else tuple(value)
        return tuple(name.strip() for name in value.split(",") if name.strip())


class RunOptions(_StoreOptions):
    """Choices of a run over many shots.

    Raises
    ------
    InputError
        If a value is out of range or a name is unknown.

    Examples
    --------
    >>> RunOptions(variables="potential, weights").variables
    ('potential', 'weights')
    """

    workers: int | None = Field(
        default=None,
        ge=1,
        description="Shots that are processed at once on this machine. Default: one per core.",
    )


class WatchOptions(_StoreOptions):
    """Choices of a watched folder.

    Raises
    ------
    InputError
        If a value is out of range or a name is unknown.
    """

    pattern: str = Field(
        default="*",
        title="Names",
        description="File name pattern of the shots, in quotes on the command line, such as "
        "*.tif, or *.h5::/entry/data of an array in each; without an ending, images of the most "
        "frequent or first kind. Names that begin with a dot are ignored.",
    )
    latest: bool = Field(
        default=False,
        description="Invert the newest file next, and older ones when no newer one waits.",
    )
    status_file: Path | None = Field(
        default=None,
        description="JSON file with the report of the newest shot, the numbers of shots and the "
        "rate, replaced after each shot, for another program to show.",
    )
    settle: float = Field(
        default=0.5,
        gt=0,
        title="Settling time (s)",
        description="Seconds for which size and time of a file have not changed when it is "
        "complete; longer for a camera or network that pauses within a file.",
    )
    idle: float | None = Field(
        default=None,
        gt=0,
        title="Idle time (s)",
        description="Stop after this many seconds without a new file.",
    )
