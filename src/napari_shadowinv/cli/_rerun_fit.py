"""A fit made again from its provenance, and what has changed since."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from napari_shadowinv._system.safety import refusing_damage
from napari_shadowinv.cli._fit_result import fitted, refined
from napari_shadowinv.cli._outputs import protect
from napari_shadowinv.cli._rerun import (
    SAME,
    Places,
    changed_file,
    changed_version,
    check_readable,
    inversion_again,
)
from napari_shadowinv.cli._summary import two_columns
from napari_shadowinv.errors import InputError
from napari_shadowinv.fitting import Fit
from napari_shadowinv.io.files import sha256
from napari_shadowinv.pipeline import FitShot
from napari_shadowinv.pipeline._run import picture_mask

if TYPE_CHECKING:
    import xarray
    from rich.table import Table

    from napari_shadowinv._typing import BoolArray, FloatArray
    from napari_shadowinv.preprocessing import FitProvenance, Origin, Radiograph


@dataclass(frozen=True)
class FitAgain:
    """A fit made again, and what has changed since the first time."""

    fit: Fit
    names: tuple[str, ...]
    changes: tuple[str, ...]
    difference: str


def fit_made_again(
    dataset: xarray.Dataset, places: Places, outputs: list[Path], *, quiet: bool = False
) -> FitAgain:
    """Make a fit again. Nothing that is read may be among `outputs`."""
    before = _fit_in(places.result, dataset)
    made = before.provenance
    if made is None:
        check_readable(dataset, places.result)
        raise InputError(
            f"{places.result} does not say how it was made, as fits of scripts that call fit() do "
            "not: make it again with shadowinv fit (docs/fit.md)"
        )
    count = len(made.images)
    if len(places.images) not in (0, count):
        raise InputError(
            f"received {len(places.images)} images, and {places.result} was made from {count}: "
            "name all of them in their order, or none if they are beside the result"
        )
    if made.start is not None:
        inversion, shot, changes = inversion_again(made.start, places, outputs, quiet=quiet)
        again = refined(inversion, made, quiet)
        return FitAgain(again, (str(shot.path),), tuple(changes), _difference(before, again))
    places.check_recipe(made.recipe)
    files = _Files(places, made)
    shots = [files.shot(k) for k in range(count)]
    fiducials = files.fiducials()
    protect(outputs, [places.result, *files.read])
    from napari_shadowinv.preprocessing import Origin

    recipe, dark = made.recipe, made.recipe.dark_file
    if dark is not None:
        recipe = recipe.with_dark_file(places.find(Origin(file=dark.name), "the dark frame"))
    again = fitted(recipe, shots, fiducials, quiet)
    names = [str(files.read[k]) for k in range(count)]
    changes = [*changed_version(made.version), *_changes(made, again), *files.changes]
    return FitAgain(again, tuple(names), tuple(changes), _difference(before, again))


@refusing_damage
def _fit_in(path: Path, dataset: xarray.Dataset) -> Fit:
    return Fit.from_dataset(dataset)


class _Files:
    """The files of a fit, found again; what of their masks and tables differs from before."""

    def __init__(self, places: Places, made: FitProvenance) -> None:
        self._places, self._made = places, made
        self._images = [self._image(k) for k in range(len(made.images))]
        self.read = [Path(str(image.path)) for image in self._images]
        self.changes: list[str] = []

    def _image(self, k: int) -> Radiograph:
        given = self._places.images[k] if self._places.images else None
        return self._places.read(self._made.images[k].image, f"image {k + 1}", given)

    def shot(self, k: int) -> FitShot:
        """An image with all that was known about it."""
        origin, image = self._made.images[k], self._images[k]
        own, source = (origin.image.file, origin.image.variable), None
        if origin.source is not None and (origin.source.file, origin.source.variable) != own:
            name = f"the source of image {k + 1}"
            source = self._places.read(origin.source, name, self._places.source)
            self.read.append(Path(str(source.path)))
        # What else its file holds was not used, unless the provenance says so.
        alone = replace(image, setup=None, mask=None, source_mask=None)
        return FitShot(
            image=alone,
            setup=origin.setup,
            source=source,
            mask=self._mask(origin.mask, image.mask),
            source_mask=self._mask(origin.source_mask, image.source_mask),
            strength=origin.strength,
            gain=origin.gain,
            psf=origin.psf,
            noise=origin.noise,
        )

    def _mask(self, place: int | None, own: BoolArray | None) -> BoolArray | None:
        if place is None:
            return None
        origin = self._made.masks[place]
        kept = origin.mask()
        if kept is not None:
            return kept
        if not origin.file and own is None:
            raise InputError(
                "a mask was too complex to be kept with the result, and was no file: make the fit "
                "again with shadowinv fit and the mask"
            )
        if not origin.file:
            return own
        path = self._places.find(origin, "the mask")
        self._note("mask", origin, path)
        return picture_mask(path)

    def fiducials(self) -> FloatArray | Path | None:
        """Known displacements, from the result or from their table."""
        made = self._made
        if made.fiducial_rows is not None:
            return np.array(made.fiducial_rows)
        if made.fiducials is None:
            return None
        path = self._places.find(made.fiducials, "the table of fiducials")
        self._note("table of fiducials", made.fiducials, path)
        return path

    def _note(self, name: str, before: Origin, path: Path) -> None:
        """Keep in mind what was read, and whether it is what it was."""
        self.read.append(path)
        now = before.model_copy(update={"file": path.name, "sha256": sha256(path)})
        self.changes += [one for one in changed_file(name, before, now) if one not in self.changes]


def _changes(before: FitProvenance, again: Fit) -> Sequence[str]:
    assert again.provenance is not None
    found: list[str] = []
    for k, (old, new) in enumerate(zip(before.images, again.provenance.images, strict=True), 1):
        found += changed_file(f"image {k}", old.image, new.image)
        found += changed_file(f"source of image {k}", old.source, new.source)
    return found


def _difference(before: Fit, again: Fit) -> str:
    if before.images.shape != again.images.shape:
        return f"another size: {again.images.shape[1:]}, before {before.images.shape[1:]}"
    pairs = list(zip(before.fields, again.fields, strict=True))
    names = ("images", "source", "gains", "frames", "reprojection", "chi2")
    same = all(np.array_equal(getattr(before, one), getattr(again, one)) for one in names)
    same = same and all(
        np.array_equal(getattr(old, one), getattr(new, one))
        for old, new in pairs
        for one in ("potential", "displacement")
    )
    if same:
        return SAME
    largest = max(np.abs(old.displacement - new.displacement).max() for old, new in pairs)
    told = f"displacement differs by up to {largest:.2g} px"
    if before.verdict != again.verdict:
        told += f"; the verdict was '{before.verdict}'"
    return told


def refit_table(again: FitAgain, written: list[Path]) -> Table:
    """Tell what has changed since a fit was made first."""
    rows = [
        *[(f"image {k}", name) for k, name in enumerate(again.names, 1)],
        *[("changed", text) for text in again.changes or ("nothing",)],
        ("difference", again.difference),
        ("verdict", str(again.fit.verdict)),
        *[("written", str(path)) for path in written],
    ]
    return two_columns("Rerun", rows)
