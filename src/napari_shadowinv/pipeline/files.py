"""Files of recipes, setups and images.

- recipes as TOML files: `read_recipe`, `write_recipe`; as a command: `command_of`
- the setup from a TOML file, completed from an image's file: `setup_from`
"""

from __future__ import annotations

import os
import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from napari_shadowinv._system.safety import resolved_path
from napari_shadowinv._system.validation import map_paths, validate
from napari_shadowinv.io import read_toml
from napari_shadowinv.io.files import join_address, write_toml
from napari_shadowinv.physics.setup import SETUPS, Setup, setup_from_dict
from napari_shadowinv.preprocessing import MeasuredSource, Recipe

_PIXEL_SIZES = {"pixel_size", "detector_pixel_size"}


def read_recipe(path: Path) -> Recipe:
    """Read a recipe; file names in it are relative to its folder.

    An `InputError` names an invalid entry; a `FileFormatError` gives the reason if the file cannot
    be read.
    """
    return map_paths(validate(Recipe, read_toml(path), str(path)), Path(path).parent.joinpath)


def write_recipe(path: Path, recipe: Recipe, *, overwrite: bool = False) -> None:
    """Write a recipe; file names in it become relative to its folder.

    A `FileFormatError` is raised if the file exists, unless `overwrite`, or cannot be written.
    """
    folder = resolved_path(Path(path).parent)
    relative = map_paths(recipe, lambda file: Path(os.path.relpath(resolved_path(file), folder)))
    write_toml(path, recipe_entries(relative), overwrite)


def recipe_entries(recipe: Recipe) -> dict[str, Any]:
    """Return a recipe as values of TOML, from which it can be made again.

    Options at their defaults are left out.
    """
    content = recipe.model_dump(exclude_none=True)
    content["instrument"] = recipe.instrument.stated or ()
    content["options"] = recipe.options.model_dump(exclude_defaults=True) or ()
    if recipe.fit is not None:  # an empty section still requests a fit
        content["fit"] = recipe.fit.model_dump(exclude_defaults=True)
    return {name: _to_toml(value) for name, value in content.items() if value != ()}


def command_of(recipe: Recipe, image: str | Path) -> str:
    """Return the line for a shell that inverts an image by a recipe."""
    entries = recipe_entries(recipe)

    def described(choice: Mapping[str, Any], key: str) -> str:
        values = (f"{k}={shlex.quote(str(v))}" for k, v in choice.items() if k != key)
        return " ".join([choice[key], *values])

    words = ["shadowinv", "invert", str(image)]
    if "setup" in entries:
        words += ["--setup", described(entries["setup"], "kind")]
    source = recipe.source
    if isinstance(source, MeasuredSource):
        file = None if source.file is None else str(join_address(source.file, source.variable))
        words += [] if file is None else ["--source", file]
    elif source is not None:
        words += ["--source-from", described(entries["source"], "method")]
    for step in entries.get("steps", ()):
        words += ["--step", described(step, "step")]
    files = ("mask", "source_mask")
    settings: dict[str, Any] = {name: entries[name] for name in files if name in entries}
    for section in ("instrument", "options"):
        settings |= {f"{section}.{key}": v for key, v in entries.get(section, {}).items()}
    return shlex.join([*words, *(f"--set={key}={value}" for key, value in settings.items())])


def setup_from(
    path: Path, defaults: Mapping[str, Any] | None = None, changes: Mapping[str, Any] | None = None
) -> Setup:
    """Read a setup from a file, with changes; missing entries come from `defaults`."""
    return complete_setup({**read_toml(path), **(changes or {})}, defaults or {}, str(path))


def complete_setup(entries: Mapping[str, Any], defaults: Mapping[str, Any], where: str) -> Setup:
    """Make a setup from entries, and from `defaults` for those that are missing."""
    if "kind" in defaults and entries.get("kind", defaults["kind"]) != defaults["kind"]:
        defaults = {}
    elif defaults and "kind" not in defaults:
        # A text image contains distances, and the energy of particles, but not their species.
        is_particle = "proton" if defaults.keys() - _PIXEL_SIZES else ""
        kind = entries.get("kind") or _kind_of(entries) or _kind_of(defaults) or is_particle
        others = (model.own_fields() for name, model in SETUPS.items() if name != kind)
        strange = set().union(*others)
        defaults = {name: defaults[name] for name in defaults if name not in strange}
        defaults |= {"kind": kind} if kind else {}
    if _PIXEL_SIZES & entries.keys():
        defaults = {name: value for name, value in defaults.items() if name not in _PIXEL_SIZES}
    return setup_from_dict({**defaults, **entries}, where)


def _kind_of(entries: Mapping[str, Any]) -> str:
    """Return the first kind of setup that alone has one of the entries, empty without one."""
    kinds = (kind for kind, model in SETUPS.items() if entries.keys() & model.own_fields())
    return next(kinds, "")


def _to_toml(value: Any) -> Any:
    """Convert a value to types of TOML: paths to text, ranges as they are typed."""
    if isinstance(value, dict):
        return {name: _to_toml(item) for name, item in value.items()}
    if isinstance(value, tuple) and len(value) == 2 and isinstance(value[0], int):
        return f"{value[0]}:{'' if value[1] is None else value[1]}"
    if isinstance(value, (list, tuple)):
        return [_to_toml(item) for item in value]
    return str(value) if isinstance(value, Path) else value
