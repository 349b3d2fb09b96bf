"""Rerun of a fit from its provenance, and the changes since."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from napari_shadowinv._system.safety import as_file_errors
from napari_shadowinv.cli._fit_result import fit_images, refine_inversion
from napari_shadowinv.cli._outputs import protect
from napari_shadowinv.cli._rerun import (
    UNCHANGED,
    FileLocator,
    check_readable,
    file_changes,
    repeat_inversion,
    version_changes,
)
from napari_shadowinv.cli._summary import two_columns
from napari_shadowinv.errors import InputError
from napari_shadowinv.fitting import Fit
from napari_shadowinv.io.files import sha256
from napari_shadowinv.pipeline import FitShot
from napari_shadowinv.pipeline.inversion_run import picture_mask

if TYPE_CHECKING:
    import xarray
    from rich.table import Table

    from napari_shadowinv._typing import BoolArray, FloatArray
    from napari_shadowinv.preprocessing import FitProvenance, Origin, Radiograph


@dataclass(frozen=True)
class FitRerun:
    """A repeated fit, and the changes since the first one."""

    fit: Fit
    names: tuple[str, ...]
    changes: tuple[str, ...]
    difference: str


def rerun_fit(
    dataset: xarray.Dataset, files: FileLocator, outputs: list[Path], *, quiet: bool = False
) -> FitRerun:
    """Repeat a fit; `outputs` must not contain an input."""
    before = _read_fit(files.result, dataset)
    provenance = before.provenance
    if provenance is None:
        check_readable(dataset, files.result)
        raise InputError(
            f"{files.result} has no provenance, like all results of fit() in scripts: repeat the "
            "fit with shadowinv fit (docs/fit.md)"
        )
    count = len(provenance.images)
    if len(files.images) not in (0, count):
        raise InputError(
            f"received {len(files.images)} images, and {files.result} was made from {count}: "
            "name all of them in their order, or none if they are in the result's folder"
        )
    if provenance.start is not None:
        inversion, shot, changes = repeat_inversion(provenance.start, files, outputs, quiet=quiet)
        again = refine_inversion(inversion, provenance, quiet)
        return FitRerun(again, (str(shot.path),), tuple(changes), _difference(before, again))
    files.check_recipe(provenance.recipe)
    inputs = _FitInputs(files, provenance)
    shots = [inputs.shot(k) for k in range(count)]
    fiducials = inputs.fiducials()
    protect(outputs, [files.result, *inputs.paths])
    from napari_shadowinv.preprocessing import Origin

    recipe, dark = provenance.recipe, provenance.recipe.dark_file
    if dark is not None:
        recipe = recipe.with_dark_file(files.find(Origin(file=dark.name), "the dark frame"))
    again = fit_images(recipe, shots, fiducials, quiet)
    names = [str(path) for path in inputs.paths[:count]]
    changes = [
        *version_changes(provenance.version),
        *_changes(provenance, again),
        *inputs.changes,
    ]
    return FitRerun(again, tuple(names), tuple(changes), _difference(before, again))


@as_file_errors
def _read_fit(path: Path, dataset: xarray.Dataset) -> Fit:
    return Fit.from_dataset(dataset)


class _FitInputs:
    """Inputs of a fit, read again, and the changes of its masks and tables."""

    def __init__(self, files: FileLocator, provenance: FitProvenance) -> None:
        self._files, self._provenance = files, provenance
        self._images = [self._image(k) for k in range(len(provenance.images))]
        self.paths = [Path(str(image.path)) for image in self._images]
        self.changes: list[str] = []

    def _image(self, k: int) -> Radiograph:
        argument = self._files.images[k] if self._files.images else None
        return self._files.read(self._provenance.images[k].image, f"image {k + 1}", argument)

    def shot(self, k: int) -> FitShot:
        """Return an image with its setup, source, masks and numbers."""
        origin, image = self._provenance.images[k], self._images[k]
        image_part, source = (origin.image.file, origin.image.variable), None
        if origin.source is not None and (origin.source.file, origin.source.variable) != image_part:
            name = f"the source of image {k + 1}"
            source = self._files.read(origin.source, name, self._files.source)
            self.paths.append(Path(str(source.path)))
        # The provenance says which other contents of the file were used.
        alone = replace(image, setup=None, mask=None, source_mask=None)
        return FitShot(
            image=alone,
            setup=origin.setup,
            source=source,
            mask=self._mask(origin.mask, image.mask),
            source_mask=self._mask(origin.source_mask, image.source_mask),
            strength=origin.strength,
            brightness=origin.brightness,
            psf=origin.psf,
            noise=origin.noise,
        )

    def _mask(self, index: int | None, image_mask: BoolArray | None) -> BoolArray | None:
        if index is None:
            return None
        origin = self._provenance.masks[index]
        mask = origin.mask()
        if mask is not None:
            return mask
        if not origin.file and image_mask is None:
            raise InputError(
                "a mask is too complex to be stored in the result, and was not a file: repeat the "
                "fit with shadowinv fit and the mask"
            )
        if not origin.file:
            return image_mask
        path = self._files.find(origin, "the mask")
        self._record_input("mask", origin, path)
        return picture_mask(path)

    def fiducials(self) -> FloatArray | Path | None:
        """Return the fiducial displacements, from the result or from their table."""
        provenance = self._provenance
        if provenance.fiducial_rows is not None:
            return np.array(provenance.fiducial_rows)
        if provenance.fiducials is None:
            return None
        path = self._files.find(provenance.fiducials, "the table of fiducials")
        self._record_input("table of fiducials", provenance.fiducials, path)
        return path

    def _record_input(self, name: str, before: Origin, path: Path) -> None:
        """Record a file, and whether it has changed."""
        self.paths.append(path)
        after = before.model_copy(update={"file": path.name, "sha256": sha256(path)})
        changes = file_changes(name, before, after)
        self.changes += [change for change in changes if change not in self.changes]


def _changes(before: FitProvenance, again: Fit) -> Sequence[str]:
    assert again.provenance is not None
    changes: list[str] = []
    for k, (old, new) in enumerate(zip(before.images, again.provenance.images, strict=True), 1):
        changes += file_changes(f"image {k}", old.image, new.image)
        changes += file_changes(f"source of image {k}", old.source, new.source)
    return changes


def _difference(before: Fit, again: Fit) -> str:
    if before.images.shape != again.images.shape:
        return f"different size: {again.images.shape[1:]}, before {before.images.shape[1:]}"
    pairs = list(zip(before.fields, again.fields, strict=True))
    names = ("images", "source", "brightness", "frames", "reprojection", "chi2")
    is_equal = all(np.array_equal(getattr(before, name), getattr(again, name)) for name in names)
    is_equal = is_equal and all(
        np.array_equal(getattr(old, name), getattr(new, name))
        for old, new in pairs
        for name in ("potential", "displacement")
    )
    if is_equal:
        return UNCHANGED
    largest = max(np.abs(old.displacement - new.displacement).max() for old, new in pairs)
    text = f"displacement differs by up to {largest:.2g} px"
    if before.verdict != again.verdict:
        text += f"; the verdict was '{before.verdict}'"
    return text


def refit_table(again: FitRerun, written: list[Path]) -> Table:
    """Build the table of a repeated fit: the changes since the first one."""
    rows = [
        *[(f"image {k}", name) for k, name in enumerate(again.names, 1)],
        *[("changed", text) for text in again.changes or ("nothing",)],
        ("difference", again.difference),
        ("verdict", str(again.fit.verdict)),
        *[("written", str(path)) for path in written],
    ]
    return two_columns("Rerun", rows)
