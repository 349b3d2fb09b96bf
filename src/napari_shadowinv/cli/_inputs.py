"""What a command reads: a recipe, options, the setup and images."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from napari_shadowinv.errors import InputError

if TYPE_CHECKING:
    from napari_shadowinv.options import InversionOptions
    from napari_shadowinv.physics.setup import Setup
    from napari_shadowinv.preprocessing import Radiograph, Recipe


def recipe_from(
    flags: Mapping[str, Any],
    recipe: Path | None,
    options: Path | None,
    *,
    clip_negative: bool,
    source: Path | None = None,
    source_variable: str | None = None,
    mask: Path | None = None,
    source_mask: Path | None = None,
) -> Recipe:
    """Recipe from a file, with an options file and flags on top."""
    from napari_shadowinv.cli._flags import recipe_of
    from napari_shadowinv.io import read_toml
    from napari_shadowinv.pipeline import read_recipe
    from napari_shadowinv.preprocessing import MeasuredSource, Recipe

    base = Recipe() if recipe is None else read_recipe(recipe)
    content = {} if options is None else read_toml(options)
    if "prepare" in content:
        raise InputError(
            f"{options} has a table [prepare], which recipes replace: write steps and source "
            "into a file for --recipe (--save-recipe shows how)"
        )
    if clip_negative:
        flags = {"negative": "clip", **flags}
    files = {"mask": mask, "source_mask": source_mask}
    chosen = recipe_of(flags, base, content, "options" if options is None else str(options))
    chosen = chosen.model_copy(update={name: file for name, file in files.items() if file})
    if source is None and source_variable is None:
        return chosen
    if "source_from" in flags:
        raise InputError(
            f"received --source and --source-from {flags['source_from']}: choose one of them"
        )
    measured = MeasuredSource(file=source, variable=source_variable)
    return chosen.model_copy(update={"source": measured})


def options_from(flags: Mapping[str, Any], clip_negative: bool) -> InversionOptions:
    """Options from flags alone."""
    return recipe_from(flags, None, None, clip_negative=clip_negative).options


def read_shot(path: Path, channel: str | None, variable: str | None) -> Radiograph:
    """Read an image, and note which part of its file it is."""
    from napari_shadowinv.io import read_radiograph

    shot = read_radiograph(path, channel=channel, variable=variable)
    part = {name: one for name, one in (("channel", channel), ("variable", variable)) if one}
    return replace(shot, metadata={**shot.metadata, **part})


def source_from(recipe: Recipe, image: Path, channel: str | None) -> Radiograph | None:
    """Read the measured source that a recipe names; one without a file is in the image's."""
    from napari_shadowinv.preprocessing import MeasuredSource

    measured = recipe.source
    if not isinstance(measured, MeasuredSource) or measured == MeasuredSource():
        return None
    return read_shot(measured.file or image, channel, measured.variable)


def setup_for(path: Path | None, shot: Radiograph, recipe: Recipe) -> Setup | None:
    """Setup from a file, completed by the geometry that the image's file knows."""
    if path is None:
        return recipe.setup or shot.setup
    return setup_from(path, shot.metadata.get("geometry"))


def setup_from(
    path: Path, known: Mapping[str, Any] | None = None, changes: Mapping[str, Any] | None = None
) -> Setup:
    """Setup from a file, with changes; what it leaves out is taken from what is `known`."""
    from napari_shadowinv.io import read_toml
    from napari_shadowinv.physics.setup import SETUPS, setup_from_dict

    entries, known = {**read_toml(path), **(changes or {})}, known or {}
    if "kind" in known and entries.get("kind", known["kind"]) != known["kind"]:
        known = {}
    elif known and "kind" not in known:
        # A text image tells distances, and of particles the energy, but not what flew.
        meant = [kind for kind, model in SETUPS.items() if entries.keys() & model.own_fields()]
        kind = entries.get("kind", meant[-1] if meant else "proton")
        strange = () if kind == "proton" else SETUPS["proton"].own_fields()
        known = {name: known[name] for name in known if name not in strange} | {"kind": kind}
    pixel_sizes = {"pixel_size", "detector_pixel_size"}
    if pixel_sizes & entries.keys():
        known = {name: value for name, value in known.items() if name not in pixel_sizes}
    return setup_from_dict({**known, **entries}, str(path))
