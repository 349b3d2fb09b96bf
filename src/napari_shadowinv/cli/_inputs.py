"""Inputs of a command: the recipe, with the flags and keys that override it, and the setup."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Any

from napari_shadowinv.cli._flags import FitFlags, InversionFlags
from napari_shadowinv.cli._settings import (
    FILE_KEYS,
    Settings,
    parse_choice,
    source_from,
    with_steps,
)
from napari_shadowinv.errors import InputError
from napari_shadowinv.options import FitChoices
from napari_shadowinv.preprocessing import MeasuredSource, Recipe
from napari_shadowinv.shot import Shot

if TYPE_CHECKING:
    from napari_shadowinv.physics.setup import Setup


def recipe_from(flags: InversionFlags | FitFlags, settings: Settings) -> Recipe:
    """Read a recipe, and override it with flags and settings."""
    from napari_shadowinv.pipeline import read_recipe

    recipe = Recipe() if flags.recipe is None else read_recipe(flags.recipe)
    files = {name: settings.values[name] for name in FILE_KEYS if name in settings.values}
    changes: dict[str, Any] = {name: Path(file) if file else None for name, file in files.items()}
    steps = [] if flags.bin is None else [f"bin {flags.bin}"]
    if flags.source is not None:
        is_known = flags.source != "unknown"
        changes["source"] = MeasuredSource(file=Path(flags.source)) if is_known else None
    if isinstance(flags, InversionFlags):
        if flags.dark is not None:
            steps.append(f"dark level={shlex.quote(flags.dark)}")
        if flags.source_from is not None:
            if flags.source is not None:
                raise InputError(
                    f"received --source and --source-from {flags.source_from}: choose one of them"
                )
            changes["source"] = source_from(flags.source_from, recipe.estimate)
    changes["steps"] = with_steps(recipe.steps, [*steps, *(flags.steps or ())])
    for section in ("instrument", "options"):
        changes[section] = settings.change(section, getattr(recipe, section))
    if "options.margin" in settings.values and changes["options"].boundary != "free":
        raise InputError("received options.margin: it needs --boundary free")
    if isinstance(flags, FitFlags):
        changes["fit"] = settings.change("fit", recipe.fit or FitChoices())
    return recipe.model_copy(update=changes)


def read_setup(path: Path | None, geometry: Any = None) -> Setup | None:
    """Read a setup from its file or a text such as "proton energy=3"; a geometry completes it."""
    from napari_shadowinv.physics.setup import SETUPS
    from napari_shadowinv.pipeline.files import complete_setup, setup_from

    if path is None:
        return None
    kind = str(path).partition(" ")[0]
    if kind not in SETUPS or path.exists():
        return setup_from(path, geometry)
    _, values = parse_choice("--setup", str(path), SETUPS)
    return complete_setup({"kind": kind, **values}, geometry or {}, "--setup")


def setup_for(path: Path | None, shot: Shot, recipe: Recipe) -> Setup | None:
    """Read a setup, completed with the geometry in the image's file; else the recipe's."""
    return read_setup(path, shot.metadata.get("geometry")) or recipe.setup or shot.setup
