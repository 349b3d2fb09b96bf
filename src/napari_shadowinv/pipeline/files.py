"""Recipes as TOML files: `read_recipe`, `write_recipe`."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from napari_shadowinv._system.validation import validated
from napari_shadowinv.io import read_toml, replacing
from napari_shadowinv.preprocessing import MeasuredSource, Recipe

__all__ = ["read_recipe", "write_recipe"]


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

    folder = Path(path).parent.resolve()
    relative = _with_files(recipe, lambda file: Path(os.path.relpath(file.resolve(), folder)))
    content = _without_defaults(relative)
    with replacing(path, overwrite) as whole:
        Path(whole).write_text(tomli_w.dumps(content), encoding="utf-8")


def _with_files(recipe: Recipe, moved: Any) -> Recipe:
    changes: dict[str, Any] = {
        name: moved(getattr(recipe, name))
        for name in ("mask", "source_mask")
        if getattr(recipe, name) is not None
    }
    source = recipe.source
    if isinstance(source, MeasuredSource) and source.file is not None:
        changes["source"] = source.model_copy(update={"file": moved(source.file)})
    return recipe.model_copy(update=changes)


def _without_defaults(recipe: Recipe) -> dict[str, Any]:
    """Options that were chosen, and all that the rest says."""
    content = recipe.model_dump(exclude_none=True)
    content["options"] = recipe.options.model_dump(exclude_defaults=True)
    return {name: _plain(value) for name, value in content.items() if value not in ((), {})}


def _plain(value: Any) -> Any:
    """What TOML knows, which is neither paths nor None; ranges as they are typed."""
    if isinstance(value, dict):
        return {name: _plain(one) for name, one in value.items()}
    if isinstance(value, tuple) and len(value) == 2 and isinstance(value[0], int):
        return f"{value[0]}:{'' if value[1] is None else value[1]}"
    if isinstance(value, (list, tuple)):
        return [_plain(one) for one in value]
    return str(value) if isinstance(value, Path) else value
