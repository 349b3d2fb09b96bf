"""Arguments and flags that commands share, each with its help.

A dataclass declares flags of several commands; `takes_flags` adds its fields to a command.
"""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Collection
from dataclasses import dataclass, fields, is_dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any, get_type_hints

from typer import Argument, Option

from napari_shadowinv._system.validation import suggestion
from napari_shadowinv.cli._settings import Sections, completing, keys_of
from napari_shadowinv.errors import InputError
from napari_shadowinv.io.formats import IMAGE_TITLES
from napari_shadowinv.options import BEAM_SOURCES, DETECTORS
from napari_shadowinv.preprocessing import ESTIMATES, STEPS

_KEYWORD = inspect.Parameter.KEYWORD_ONLY

argument = partial(Argument, show_default=False)

ImageFile = Annotated[Path, argument(help=f"{IMAGE_TITLES}; run.h5::/name for an array.")]
StoreFolder = Annotated[Path, argument(help="name.shadowinv.zarr, from shadowinv batch.")]
SourceFile = Annotated[Path | None, Option(help="Image of the beam. Default: uniform.")]
MaskFile = Annotated[Path | None, Option(help="Image, 0 at unusable pixels.")]
RecipeFile = Annotated[Path | None, Option(help="TOML file of steps, files and options.")]
SaveRecipe = Annotated[Path | None, Option(help="Write the recipe to a TOML file.")]
SetupFile = Annotated[Path | None, Option(help="Geometry, for SI units: TOML or 'proton …'.")]
Channel = Annotated[str | None, Option(help="red, green, blue, mean or an index.")]
ChosenShots = Annotated[str | None, Option(help="Shots such as 3, 3:20, ::10 or 1,4,9.")]
Figure = Annotated[Path | None, Option(help=".png, .pdf or .svg. Default: a PNG.")]
# Names of two words have a hyphen on the command line.
Deflector = Annotated[
    str | None,
    Option(
        metavar="CAUSE",
        help="Cause of the deflection.",
        callback=lambda text: text and text.replace("-", " "),
    ),
]
InstrumentNames = Annotated[
    str | None, Option(metavar="NAMES", help="Detector, beam, or both: film,TNSA.")
]


def setting(sections: Sections, example: str, names: Collection[str] = ()) -> Any:
    """Return the flag --set for the keys of some sections."""
    return Option(
        "--set",
        metavar="KEY=VALUE",
        help=f"Any other key: {example}.",
        autocompletion=completing(f"{key}=" for key in (*names, *keys_of(sections))),
    )


@dataclass(frozen=True, kw_only=True)
class ShotFlags:
    """Flags of all commands that process images by a recipe."""

    setup: SetupFile = None
    mask: MaskFile = None
    instrument: InstrumentNames = None
    recipe: RecipeFile = None
    channel: Channel = None
    bin: Annotated[int | None, Option(metavar="N", help="Sum blocks of N × N pixels.")] = None
    steps: Annotated[
        list[str] | None,
        Option(
            "--step",
            metavar="TEXT",
            help="Another step, such as 'hot-pixels 6'.",
            autocompletion=completing(STEPS),
        ),
    ] = None

    @property
    def by_key(self) -> dict[str, tuple[str, Any]]:
        """Name and value of each flag for a value of a recipe, by its key."""
        return {"mask": ("--mask", self.mask), **instrument_keys(self.instrument)}


@dataclass(frozen=True, kw_only=True)
class InversionFlags(ShotFlags):
    """Flags of the commands that invert shots."""

    source: SourceFile = None
    source_from: Annotated[
        str | None,
        Option(
            metavar="TEXT",
            help="Its estimate: 'polynomial degree=3'.",
            autocompletion=completing(ESTIMATES),
        ),
    ] = None
    dark: Annotated[str | None, Option(metavar="COUNTS|FILE", help="Dark level or image.")] = None
    accuracy: Annotated[float | None, Option(help="Of the displacement. Default: 0.01.")] = None
    boundary: Annotated[
        str | None, Option(metavar="closed|free", help="Whether flux crosses the edge.")
    ] = None

    @property
    def by_key(self) -> dict[str, tuple[str, Any]]:
        return super().by_key | {
            "options.accuracy": ("--accuracy", self.accuracy),
            "options.boundary": ("--boundary", self.boundary),
        }


@dataclass(frozen=True, kw_only=True)
class FitFlags(ShotFlags):
    """Flags of a fit."""

    source: Annotated[str | None, Option(metavar="FILE", help="Image of the beam, or unknown.")] = (
        None
    )
    energies: Annotated[str | None, Option(metavar="MEV,MEV,…", help="Energy of each image.")] = (
        None
    )
    noise: Annotated[str | None, Option(help="poisson, proportional or a deviation.")] = None
    fiducials: Annotated[Path | None, Option(help="Table (.csv) of known displacements.")] = None

    @property
    def by_key(self) -> dict[str, tuple[str, Any]]:
        beam = None if self.source is None else "unknown" if self.source == "unknown" else "known"
        return super().by_key | {
            "fit.noise": ("--noise", self.noise),
            "fit.beam": ("--source", beam),
        }


def instrument_keys(text: str | None) -> dict[str, tuple[str, Any]]:
    """Return the detector and the source of the beam in a text such as "film,TNSA", by key."""
    keys: dict[str, str] = dict.fromkeys(DETECTORS, "instrument.detector")
    keys.update((name, "instrument.beam_source") for name in BEAM_SOURCES)
    values: dict[str, tuple[str, Any]] = {}
    for name in [] if text is None else map(str.strip, text.split(",")):
        if name not in keys:
            raise InputError(f"--instrument is '{text}': {suggestion(name, keys)}")
        if keys[name] in values:
            raise InputError(f"--instrument is '{text}': expected one detector and one beam")
        values[keys[name]] = ("--instrument", name)
    return values


def takes_flags(command: Callable[..., None]) -> Callable[..., None]:
    """Let a command take the fields of a dataclass as flags, in place of the dataclass."""
    parameters = inspect.signature(command, eval_str=True).parameters.values()
    kinds: dict[str, Any] = {
        each.name: each.annotation for each in parameters if is_dataclass(each.annotation)
    }
    groups = {name: [f for f in fields(kind) if f.init] for name, kind in kinds.items()}

    @functools.wraps(command)
    def with_flags(**arguments: Any) -> None:
        for name, group in groups.items():
            arguments[name] = kinds[name](**{f.name: arguments.pop(f.name) for f in group})
        command(**arguments)

    listed = []
    for each in parameters:
        hints = get_type_hints(kinds.get(each.name, object), include_extras=True)
        listed += [
            inspect.Parameter(f.name, _KEYWORD, default=f.default, annotation=hints[f.name])
            for f in groups.get(each.name, ())
        ] or [each.replace(kind=_KEYWORD)]
    listed.sort(key=lambda each: each.name in ("overwrite", "quiet"))  # the last on a help page
    with_flags.__signature__ = inspect.Signature(listed)  # type: ignore[attr-defined]
    with_flags.__annotations__ = {}
    return with_flags
