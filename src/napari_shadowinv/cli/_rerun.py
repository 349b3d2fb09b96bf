"""Rerun of an inversion from its provenance, and the changes since."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from napari_shadowinv import __version__
from napari_shadowinv.cli._outputs import protect
from napari_shadowinv.cli._terminal import invert_shot
from napari_shadowinv.errors import FileFormatError, InputError
from napari_shadowinv.inversion import Inversion
from napari_shadowinv.pipeline.files import read_part
from napari_shadowinv.preprocessing import MeasuredSource

if TYPE_CHECKING:
    import xarray

    from napari_shadowinv._typing import BoolArray
    from napari_shadowinv.preprocessing import Origin, Provenance, Radiograph, Recipe

UNCHANGED = "none: the same result, bit for bit"


@dataclass(frozen=True)
class InversionRerun:
    """A repeated inversion, and the changes since the first one."""

    inversion: Inversion
    shot: Radiograph
    changes: tuple[str, ...]
    difference: str


@dataclass(frozen=True)
class FileLocator:
    """Locator of the files of a result: in the arguments, its folder or the current folder.

    A result may come from anybody: files in other folders are read only if they are `trusted`.
    """

    result: Path
    images: Sequence[Path] = ()
    source: Path | None = None
    trusted: bool = False

    def check(self, file: Path, name: str) -> None:
        """Refuse a file outside of the result's folder and the current one, unless trusted."""
        path = Path(os.path.abspath(file))  # a link in the result's folder belongs to the user
        folders = (self.result.parent, Path())
        is_inside = any(path.is_relative_to(os.path.abspath(folder)) for folder in folders)
        if not (self.trusted or is_inside):
            raise InputError(
                f"{self.result} names {name} {file}, which is in another folder: name the file to "
                "use, or add --other-folders if you trust the result"
            )

    def check_recipe(self, recipe: Recipe) -> None:
        """Refuse files that a recipe names in other folders."""
        files = {
            "a mask": recipe.mask,
            "a source mask": recipe.source_mask,
            "a dark frame": recipe.dark_file,
            "a source": recipe.source.file if isinstance(recipe.source, MeasuredSource) else None,
        }
        for name, file in files.items():
            if file is not None:
                self.check(file, name)

    def find(self, origin: Origin, name: str, argument: Path | None = None) -> Path:
        """Return the file of an image, source, mask or table; an argument has precedence."""
        folders = (self.result.parent, Path())
        candidates = [folder / origin.file for folder in folders if origin.file]
        if argument is None and candidates:
            self.check(candidates[0], name)
        path = argument or next((file for file in candidates if file.is_file()), None)
        if path is None:
            reason = f"{origin.file} does not exist" if origin.file else "was not made from a file"
            raise FileFormatError(f"{name} {reason}: name the file to use")
        return path

    def read(self, origin: Origin, name: str, argument: Path | None = None) -> Radiograph:
        """Read an image or source from its file."""
        channel = None if origin.channel is None else str(origin.channel)
        return read_part(self.find(origin, name, argument), channel, origin.variable)


def rerun_inversion(
    dataset: xarray.Dataset, files: FileLocator, outputs: list[Path], *, quiet: bool = False
) -> InversionRerun:
    """Repeat an inversion; `outputs` must not contain an input."""
    if len(files.images) > 1:
        raise InputError(
            f"received {len(files.images)} images, and {files.result} was made from one: name "
            "one, or none if it is in the result's folder"
        )
    before = Inversion.from_dataset(dataset)
    provenance = before.provenance
    if provenance is None:
        check_readable(dataset, files.result)
        raise InputError(
            f"{files.result} has no provenance, like all results of invert() in scripts: "
            "repeat the inversion with a recipe (docs/recipes.md)"
        )
    inversion, shot, changes = repeat_inversion(provenance, files, outputs, quiet=quiet)
    return InversionRerun(inversion, shot, tuple(changes), _difference(before, inversion))


def check_readable(dataset: xarray.Dataset, result: Path) -> None:
    """Refuse a provenance that is damaged or of another version."""
    text = dataset.attrs.get("provenance", "")
    if not text:
        return
    try:
        version = json.loads(text)["version"]
    except (TypeError, ValueError, KeyError, RecursionError):
        version = __version__
    if version == __version__:
        raise InputError(
            f"{result} has a damaged provenance: repeat it with a recipe (docs/recipes.md)"
        ) from None
    raise InputError(
        f"{result} was made by version {str(version)[:20]}, and version {__version__} cannot read "
        "its provenance: use that version, or repeat it with a recipe (docs/recipes.md)"
    )


def repeat_inversion(
    provenance: Provenance, files: FileLocator, outputs: list[Path], *, quiet: bool = False
) -> tuple[Inversion, Radiograph, list[str]]:
    """Return the inversion that a provenance describes, its shot, and the changes since."""
    image, source = provenance.image, provenance.source
    files.check_recipe(provenance.recipe)
    shot = files.read(image, "the image", next(iter(files.images), None))
    beam = None
    if source is not None and (source.file, source.variable) != (image.file, image.variable):
        beam = files.read(source, "the source", files.source)
    protect(outputs, [files.result, shot.path, None if beam is None else beam.path])
    origins = {"mask": provenance.mask, "source_mask": provenance.source_mask}
    masks = {name: _mask(origin, name.replace("_", " ")) for name, origin in origins.items()}
    # The provenance says which other contents of the file were used.
    pixels = shot.image if provenance.brightness is None else shot.image / provenance.brightness
    alone = replace(shot, image=pixels, setup=None, mask=None, source_mask=None)
    recipe = provenance.recipe
    if provenance.dark is not None:
        recipe = recipe.with_dark_file(files.find(provenance.dark, "the dark frame"))
    inversion = invert_shot(recipe, alone, beam, quiet, **masks)
    if inversion.provenance is not None:
        completed = inversion.provenance.model_copy(update={"brightness": provenance.brightness})
        inversion = replace(inversion, provenance=completed)
    return inversion, shot, _changes(provenance, inversion)


def _mask(origin: Origin | None, name: str) -> BoolArray | None:
    if origin is None:
        return None
    mask = origin.mask()
    if mask is None:
        raise InputError(
            f"the {name} {origin.file} is too complex to be stored in the result: repeat the "
            "inversion with --recipe and the mask"
        )
    return mask


def _changes(before: Provenance, again: Inversion) -> list[str]:
    after = again.provenance
    assert after is not None
    return [
        *version_changes(before.version),
        *file_changes("image", before.image, after.image),
        *file_changes("source", before.source, after.source),
        *file_changes("dark frame", before.dark, after.dark),
    ]


def version_changes(before: str) -> list[str]:
    """Report a change of the program's version."""
    return [] if before == __version__ else [f"made by version {before}, now {__version__}"]


def file_changes(name: str, before: Origin | None, after: Origin | None) -> list[str]:
    """Report a change of a file."""
    if before is None or after is None:
        return []
    if not before.sha256:
        return [f"the {name} was not a file before: {after.file} may differ from it"]
    if before.sha256 != after.sha256:
        return [f"the {name} {after.file} differs from the {before.file} used before"]
    return []


def _difference(before: Inversion, again: Inversion) -> str:
    if before.displacement.shape != again.displacement.shape:
        return f"different size: {again.image.shape}, before {before.image.shape}"
    names = ("displacement", "potential", "weights", "source", "image", "reprojection")
    if all(np.array_equal(getattr(before, name), getattr(again, name)) for name in names):
        return UNCHANGED
    largest = np.abs(before.displacement - again.displacement).max()
    return f"displacement differs by up to {largest:.2g} px"
