"""A result made again from its provenance, and what has changed since."""

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
from napari_shadowinv.cli._terminal import inverted
from napari_shadowinv.errors import FileFormatError, InputError
from napari_shadowinv.inversion import Inversion
from napari_shadowinv.pipeline.files import read_part
from napari_shadowinv.preprocessing import MeasuredSource

if TYPE_CHECKING:
    import xarray

    from napari_shadowinv._typing import BoolArray
    from napari_shadowinv.preprocessing import Origin, Provenance, Radiograph, Recipe

SAME = "none: the same result, bit for bit"


@dataclass(frozen=True)
class Again:
    """A result made again, and what has changed since the first time."""

    inversion: Inversion
    shot: Radiograph
    changes: tuple[str, ...]
    difference: str


@dataclass(frozen=True)
class Places:
    """Where the files of a result are looked for: as named now, beside it, and here.

    A result may come from anybody: files in other folders are read only if they are `trusted`.
    """

    result: Path
    images: Sequence[Path] = ()
    source: Path | None = None
    trusted: bool = False

    def check(self, file: Path, name: str) -> None:
        """Refuse a file outside of the result's folder and the current one, unless trusted."""
        path = Path(os.path.abspath(file))  # a link beside the result is the user's
        folders = (self.result.parent, Path())
        inside = (path.is_relative_to(os.path.abspath(folder)) for folder in folders)
        if not self.trusted and not any(inside):
            raise InputError(
                f"{self.result} names {name} {file}, which is in another folder: name the file to "
                "use, or read what the result names with --other-folders if you trust it"
            )

    def check_recipe(self, recipe: Recipe) -> None:
        """Refuse files that a recipe names; that of a result names none."""
        files = {
            "a mask": recipe.mask,
            "a source mask": recipe.source_mask,
            "a dark frame": recipe.dark_file,
            "a source": recipe.source.file if isinstance(recipe.source, MeasuredSource) else None,
        }
        for name, file in files.items():
            if file is not None:
                self.check(file, name)

    def find(self, origin: Origin, name: str, given: Path | None = None) -> Path:
        """Return the file of an image, source, mask or table."""
        folders = (self.result.parent, Path())
        places = [folder / origin.file for folder in folders if origin.file]
        if given is None and places:
            self.check(places[0], name)
        path = given or next((place for place in places if place.is_file()), None)
        if path is None:
            found = f"{origin.file} is not there" if origin.file else "was not made from a file"
            raise FileFormatError(f"{name} {found}: name the file to use")
        return path

    def read(self, origin: Origin, name: str, given: Path | None = None) -> Radiograph:
        """Return the part of a file that an image or source was."""
        channel = None if origin.channel is None else str(origin.channel)
        return read_part(self.find(origin, name, given), channel, origin.variable)


def made_again(
    dataset: xarray.Dataset, places: Places, outputs: list[Path], *, quiet: bool = False
) -> Again:
    """Make an inversion again. Nothing that is read may be among `outputs`."""
    if len(places.images) > 1:
        raise InputError(
            f"received {len(places.images)} images, and {places.result} was made from one: name "
            "one, or none if it is beside the result"
        )
    before = Inversion.from_dataset(dataset)
    made = before.provenance
    if made is None:
        check_readable(dataset, places.result)
        raise InputError(
            f"{places.result} does not say how it was made, as results of scripts that call "
            "invert() do not: make it again with a recipe (docs/recipes.md)"
        )
    inversion, shot, changes = inversion_again(made, places, outputs, quiet=quiet)
    return Again(inversion, shot, tuple(changes), _difference(before, inversion))


def check_readable(dataset: xarray.Dataset, result: Path) -> None:
    """Refuse a provenance that is there, but which this version does not understand."""
    text = dataset.attrs.get("provenance", "")
    if not text:
        return
    try:
        version = json.loads(text)["version"]
    except (TypeError, ValueError, KeyError, RecursionError):
        version = __version__
    if version == __version__:
        raise InputError(
            f"{result} has a damaged provenance: make it again with a recipe (docs/recipes.md)"
        ) from None
    raise InputError(
        f"{result} was made by version {str(version)[:20]}, and version {__version__} does not "
        "understand how: use that version, or make it again with a recipe (docs/recipes.md)"
    )


def inversion_again(
    made: Provenance, places: Places, outputs: list[Path], *, quiet: bool = False
) -> tuple[Inversion, Radiograph, list[str]]:
    """Return the inversion that a provenance describes, its shot, and what has changed."""
    places.check_recipe(made.recipe)
    shot = places.read(made.image, "the image", next(iter(places.images), None))
    beam, own = None, (made.image.file, made.image.variable)
    if made.source is not None and (made.source.file, made.source.variable) != own:
        beam = places.read(made.source, "the source", places.source)
    protect(outputs, [places.result, shot.path, None if beam is None else beam.path])
    masks = {"mask": made.mask, "source_mask": made.source_mask}
    drawn = {name: _mask(origin, name.replace("_", " ")) for name, origin in masks.items()}
    # What else its file holds was not used, unless the provenance says so.
    image = shot.image if made.gain is None else shot.image / made.gain
    alone = replace(shot, image=image, setup=None, mask=None, source_mask=None)
    recipe = made.recipe
    if made.dark is not None:
        recipe = recipe.with_dark_file(places.find(made.dark, "the dark frame"))
    inversion = inverted(recipe, alone, beam, quiet, **drawn)
    if inversion.provenance is not None:
        told = inversion.provenance.model_copy(update={"gain": made.gain})
        inversion = replace(inversion, provenance=told)
    return inversion, shot, _changes(made, inversion)


def _mask(origin: Origin | None, name: str) -> BoolArray | None:
    if origin is None:
        return None
    mask = origin.mask()
    if mask is None:
        raise InputError(
            f"the {name} {origin.file} was too complex to be kept with the result: repeat the "
            "inversion with --recipe and the mask"
        )
    return mask


def _changes(before: Provenance, again: Inversion) -> list[str]:
    now = again.provenance
    assert now is not None
    return [
        *changed_version(before.version),
        *changed_file("image", before.image, now.image),
        *changed_file("source", before.source, now.source),
        *changed_file("dark frame", before.dark, now.dark),
    ]


def changed_version(before: str) -> list[str]:
    """Tell that another version is at work now, if it is."""
    return [] if before == __version__ else [f"made by version {before}, now {__version__}"]


def changed_file(name: str, before: Origin | None, now: Origin | None) -> list[str]:
    """Tell that a file is not what it was, if so."""
    if before is None or now is None:
        return []
    if not before.sha256:
        return [f"the {name} was no file before: {now.file} may differ from it"]
    if before.sha256 != now.sha256:
        return [f"the {name} {now.file} differs from the {before.file} used before"]
    return []


def _difference(before: Inversion, again: Inversion) -> str:
    if before.displacement.shape != again.displacement.shape:
        return f"another size: {again.image.shape}, before {before.image.shape}"
    names = ("displacement", "potential", "weights", "source", "image", "reprojection")
    if all(np.array_equal(getattr(before, one), getattr(again, one)) for one in names):
        return SAME
    largest = np.abs(before.displacement - again.displacement).max()
    return f"displacement differs by up to {largest:.2g} px"
