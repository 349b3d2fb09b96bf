"""What a command reads: options, the setup, images and fields."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from napari_shadowinv.errors import FileFormatError, InputError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

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
    from napari_shadowinv.io import read_toml

    if path is None:
        return recipe.setup or shot.setup
    return _setup(read_toml(path), shot.metadata.get("geometry", {}), str(path))


def setup_from(path: Path) -> Setup:
    """Setup from a file that tells all of it."""
    from napari_shadowinv.io import read_toml

    return _setup(read_toml(path), {}, str(path))


def _setup(entries: Mapping[str, Any], known: Mapping[str, Any], where: str) -> Setup:
    """Setup from a file's entries; what they leave out comes from the image's own file."""
    from napari_shadowinv.physics.setup import SETUPS, setup_from_dict

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
    return setup_from_dict({**known, **entries}, where)


@dataclass(frozen=True)
class Field:
    """A displacement in px, and where the file has them the source and setup that made it."""

    displacement: NDArray[np.float64]
    source: NDArray[np.float64] | None = None
    setup: Setup | None = None


def field_from(path: Path, variable: str | None = None) -> Field:
    """Displacement from a result, or from an array of px or px²."""
    from napari_shadowinv.inversion.labels import setup_from_dataset
    from napari_shadowinv.io import read_dataset
    from napari_shadowinv.io.formats import kind_of
    from napari_shadowinv.io.images import read_npy

    kind = kind_of(path)
    if variable is not None or kind == "mat":
        return Field(_displacement(path, _named_array(path, variable)))
    if kind in ("hdf5", "shadowinv"):
        dataset = read_dataset(path)
        source = dataset["source"].values if "source" in dataset else None
        return Field(dataset["displacement"].values, source, setup_from_dataset(dataset))
    if kind == "npy":
        return Field(_displacement(path, read_npy(path)))
    raise _no_field(path, f"a {kind.upper()} picture")


def _named_array(path: Path, variable: str | None) -> NDArray[Any]:
    """Plane of a MATLAB file, or array of any HDF5 file."""
    from napari_shadowinv.io import read_radiograph
    from napari_shadowinv.io.formats import kind_of
    from napari_shadowinv.io.hdf5 import read_hdf5

    if variable is not None and kind_of(path) in ("hdf5", "shadowinv"):
        return read_hdf5(path, variable)
    return read_radiograph(path, variable=variable).image


def _displacement(path: Path, array: NDArray[Any]) -> NDArray[np.float64]:
    from napari_shadowinv.physics.setup import displacement_from_potential

    if array.ndim == 2:
        return displacement_from_potential(array)
    if array.ndim == 3 and array.shape[0] == 2:
        return array.astype(float)
    raise _no_field(path, f"an array of shape {array.shape}")


def _no_field(path: Path, found: str) -> FileFormatError:
    return FileFormatError(
        f"{path} is {found}: expected a .shadowinv result, or NPY with a displacement "
        "(2, height, width) in px or a potential (height, width) in px²"
    )
