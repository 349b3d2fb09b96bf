"""A result made again from its provenance, and what has changed since."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from napari_shadowinv import __version__
from napari_shadowinv.cli._inputs import read_shot
from napari_shadowinv.cli._outputs import protect
from napari_shadowinv.cli._terminal import inverted
from napari_shadowinv.errors import FileFormatError, InputError
from napari_shadowinv.inversion import Inversion
from napari_shadowinv.inversion.labels import is_fit
from napari_shadowinv.io import read_dataset

if TYPE_CHECKING:
    from napari_shadowinv._typing import BoolArray
    from napari_shadowinv.preprocessing import Origin, Provenance, Radiograph


@dataclass(frozen=True)
class Again:
    """A result made again, and what has changed since the first time."""

    inversion: Inversion
    shot: Radiograph
    changes: tuple[str, ...]
    difference: str


def made_again(
    result: Path,
    image: Path | None,
    source: Path | None,
    outputs: list[Path],
    *,
    quiet: bool = False,
) -> Again:
    """Make a result again; files are looked for beside it and in the current folder.

    Nothing that is read may be among `outputs`.
    """
    dataset = read_dataset(result)
    if is_fit(dataset.attrs):
        raise InputError(
            f"{result} is a fit, expected the result of an inversion: repeat the command "
            "shadowinv fit to make it again"
        )
    before = Inversion.from_dataset(dataset)
    made = before.provenance
    if made is None:
        raise InputError(
            f"{result} does not say how it was made, as results of scripts that call invert() do "
            "not: make it again with a recipe (docs/recipes.md)"
        )
    folders = [result.parent, Path()]
    shot = _read(made.image, image, folders, "the image")
    beam, own = None, (made.image.file, made.image.variable)
    if made.source is not None and (made.source.file, made.source.variable) != own:
        beam = _read(made.source, source, folders, "the source")
    protect(outputs, [result, shot.path, None if beam is None else beam.path])
    masks = {"mask": made.mask, "source_mask": made.source_mask}
    drawn = {name: _mask(origin, name.replace("_", " ")) for name, origin in masks.items()}
    inversion = inverted(made.recipe, shot, beam, quiet, **drawn)
    return Again(inversion, shot, tuple(_changes(made, inversion)), _difference(before, inversion))


def _read(origin: Origin, given: Path | None, folders: Sequence[Path], name: str) -> Radiograph:
    places = [folder / origin.file for folder in folders if origin.file]
    path = given or next((place for place in places if place.is_file()), None)
    if path is None:
        found = f"{origin.file} is not there" if origin.file else "was not made from a file"
        raise FileFormatError(f"{name} {found}: name the file to use")
    channel = None if origin.channel is None else str(origin.channel)
    return read_shot(path, channel, origin.variable)


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
    changes = []
    if before.version != __version__:
        changes.append(f"made by version {before.version}, now {__version__}")
    for name in ("image", "source"):
        old, new = getattr(before, name), getattr(now, name)
        if old is None or new is None:
            continue
        if not old.sha256:
            changes.append(f"the {name} was no file before: {new.file} may differ from it")
        elif old.sha256 != new.sha256:
            changes.append(f"the {name} {new.file} differs from the {old.file} used before")
    return changes


def _difference(before: Inversion, again: Inversion) -> str:
    if before.displacement.shape != again.displacement.shape:
        return f"another size: {again.image.shape}, before {before.image.shape}"
    names = ("displacement", "potential", "weights", "source", "image", "reprojection")
    if all(np.array_equal(getattr(before, one), getattr(again, one)) for one in names):
        return "none: the same result, bit for bit"
    largest = np.abs(before.displacement - again.displacement).max()
    return f"displacement differs by up to {largest:.2g} px"
