"""What a recipe is read from, and what it is applied to.

- recipes as TOML files: `read_recipe`, `write_recipe`
- the setup from a TOML file, completed by what an image's file knows: `setup_from`
- an image, with word of which part of its file it is: `read_part`
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from napari_shadowinv._system.safety import resolved_path
from napari_shadowinv._system.validation import validated
from napari_shadowinv.io import read_radiograph, read_toml, replacing
from napari_shadowinv.physics.setup import SETUPS, Setup, setup_from_dict
from napari_shadowinv.preprocessing import MeasuredSource, Radiograph, Recipe

__all__ = ["read_part", "read_recipe", "setup_from", "write_recipe"]


def read_recipe(path: Path) -> Recipe:
    """Read a recipe; files that it names are looked for from its own folder.

    An `InputError` names the entry that is not understood, a `FileFormatError` says why the file
    cannot be read.
    """
    return _with_files(validated(Recipe, read_toml(path), str(path)), Path(path).parent.joinpath)


def write_recipe(path: Path, recipe: Recipe, *, overwrite: bool = False) -> None:
    """Write a recipe; files that it names are written relative to its own folder.

    A `FileFormatError` says why not: the file exists, unless `overwrite`, or cannot be written.
    """
    import tomli_w

    folder = resolved_path(Path(path).parent)
    relative = _with_files(recipe, lambda file: Path(os.path.relpath(resolved_path(file), folder)))
    content = _without_defaults(relative)
    with replacing(path, overwrite) as whole:
        Path(whole).write_text(tomli_w.dumps(content), encoding="utf-8")


def read_part(path: Path, channel: str | None = None, variable: str | None = None) -> Radiograph:
    """Read an image, and note which part of its file it is."""
    shot = read_radiograph(path, channel=channel, variable=variable)
    part = {name: one for name, one in (("channel", channel), ("variable", variable)) if one}
    return replace(shot, metadata={**shot.metadata, **part})


def setup_from(
    path: Path, known: Mapping[str, Any] | None = None, changes: Mapping[str, Any] | None = None
) -> Setup:
    """Setup from a file, with changes; what it leaves out is taken from what is `known`."""
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


def _with_files(recipe: Recipe, moved: Any) -> Recipe:
    changes: dict[str, Any] = {
        name: moved(getattr(recipe, name))
        for name in ("mask", "source_mask")
        if getattr(recipe, name) is not None
    }
    if (dark := recipe.dark_file) is not None:
        recipe = recipe.with_dark_file(moved(dark))
    source = recipe.source
    if isinstance(source, MeasuredSource) and source.file is not None:
        changes["source"] = source.model_copy(update={"file": moved(source.file)})
    return recipe.model_copy(update=changes)


def _without_defaults(recipe: Recipe) -> dict[str, Any]:
    """Options that were chosen, and all that the rest says."""
    content = recipe.model_dump(exclude_none=True)
    content["options"] = recipe.options.model_dump(exclude_defaults=True) or ()
    if recipe.fit is not None:  # without any choice it still says that there is to be a fit
        content["fit"] = recipe.fit.model_dump(exclude_defaults=True)
    return {name: _plain(value) for name, value in content.items() if value != ()}


def _plain(value: Any) -> Any:
    """What TOML knows, which is neither paths nor None; ranges as they are typed."""
    if isinstance(value, dict):
        return {name: _plain(one) for name, one in value.items()}
    if isinstance(value, tuple) and len(value) == 2 and isinstance(value[0], int):
        return f"{value[0]}:{'' if value[1] is None else value[1]}"
    if isinstance(value, (list, tuple)):
        return [_plain(one) for one in value]
    return str(value) if isinstance(value, Path) else value
