"""Repeat a result from its provenance: `rerun`.

- read the inputs first, to check them before the work: `collect_rerun`
- the provenance of a result, also of a shot of a stack: `provenance_of`
"""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from napari_shadowinv import __version__
from napari_shadowinv._system.progress import OnProgress, ShouldStop
from napari_shadowinv._system.safety import as_file_errors
from napari_shadowinv.errors import FileFormatError, InputError
from napari_shadowinv.facts import ResultKind, to_figures
from napari_shadowinv.fitting import Fit
from napari_shadowinv.inversion import Inversion
from napari_shadowinv.inversion.variables import setup_from_dataset
from napari_shadowinv.io import read_dataset, read_shot
from napari_shadowinv.io.files import join_address, split_address
from napari_shadowinv.physics.arrays import join_masks
from napari_shadowinv.pipeline._film import run_film
from napari_shadowinv.pipeline.fit_run import NUMBERS, run_fit, run_refinement
from napari_shadowinv.pipeline.inversion_run import AnyShot, load_shot, run
from napari_shadowinv.preprocessing import MeasuredSource, Recipe
from napari_shadowinv.provenance import Origin, Provenance
from napari_shadowinv.results import result_from_dataset
from napari_shadowinv.shot import Shot

if TYPE_CHECKING:
    import xarray

    from napari_shadowinv.results import AnyResult

IDENTICAL = "none: the same result, bit for bit"
_PAINTED = {"caustic"}  # may have been corrected by hand


@dataclass(frozen=True, eq=False)
class Rerun:
    """A repeated result, and the changes since the first one."""

    content: AnyResult
    dataset: xarray.Dataset  # all of it
    changes: tuple[str, ...]  # of the version and the files
    difference: str  # of the results, `IDENTICAL` if there is none

    @property
    def is_identical(self) -> bool:
        """Whether it is the same result, bit for bit."""
        return self.difference == IDENTICAL


@dataclass(frozen=True, eq=False)
class RerunInputs:
    """Inputs of a rerun: the first result, and the files of its provenance."""

    dataset: xarray.Dataset  # the first result
    provenance: Provenance
    recipe: Recipe  # with the dark frame where it is now
    shots: tuple[Shot, ...] = ()  # with source, masks and setup; none for a film pack
    files: tuple[Path, ...] = ()  # all that were read, the images first
    changes: tuple[str, ...] = ()  # of the version

    @property
    def kind(self) -> ResultKind:
        """Kind of the result."""
        return ResultKind.from_noun(self.provenance.kind)

    def run(
        self, on_progress: OnProgress | None = None, should_stop: ShouldStop | None = None
    ) -> Rerun:
        """Repeat the result, and compare it with the first."""
        callbacks: dict[str, Any] = {"on_progress": on_progress, "should_stop": should_stop}
        before = self.provenance
        content: AnyResult
        if before.pack is not None:
            content = run_film(before.pack, **callbacks)
        elif self.kind is ResultKind.FIT:
            content = self._fit(**callbacks)
        else:
            content = self._invert(self.recipe, **callbacks)
        dataset = content.to_dataset()
        after = content.provenance
        changes = [*self.changes, *([] if after is None else _image_changes(before, after))]
        difference = _difference(self.dataset, dataset)
        return Rerun(content, dataset, tuple(dict.fromkeys(changes)), difference)

    def _invert(self, recipe: Recipe, **callbacks: Any) -> Inversion:
        (shot,) = self.shots
        inversion = run(recipe, shot, **callbacks)
        assert inversion.provenance is not None
        # The masks were passed as arrays.
        masks_before = (self.provenance.start or self.provenance).masks
        provenance = inversion.provenance.model_copy(update={"masks": masks_before})
        return replace(inversion, provenance=provenance)

    def _fit(self, **callbacks: Any) -> Fit:
        start, choices = self.provenance.start, self.recipe.fit
        if start is not None and choices is not None:
            inversion = self._invert(_with_dark(start.recipe, self.recipe.dark_file), **callbacks)
            setup = self.provenance.image.setup
            return run_refinement(inversion, setup, choices, **callbacks)
        fit = run_fit(self.recipe, self.shots, **callbacks)
        assert fit.provenance is not None
        # Masks and rows were passed as arrays.
        origins = {"masks": self.provenance.masks, "fiducials": self.provenance.fiducials}
        return replace(fit, provenance=fit.provenance.model_copy(update=origins))


def rerun(
    result: Path | str | AnyResult | xarray.Dataset,
    images: Sequence[AnyShot] | AnyShot | None = None,
    *,
    source: Path | str | None = None,
    other_folders: bool = False,
    on_progress: OnProgress | None = None,
    should_stop: ShouldStop | None = None,
) -> Rerun:
    """Repeat a result from its provenance, and report the changes.

    With the same files and version the result is identical bit for bit.

    Parameters
    ----------
    result : path, Dataset, Inversion, Fit or FilmDoses
        An inversion, a fit, a film pack, or the dataset of one shot of a stack, which is
        inverted without another shot to start from.
    images : sequence of path, array_like or Shot, optional
        The images in their order. Default: the files that the provenance names, in the result's
        folder or the current one.
    source : path, optional
        The measured source, if it has moved.
    other_folders : bool, default False
        Read also files in other folders that the provenance names. A result may come from anybody.
    on_progress, should_stop : callable, optional
        As for `run`.

    Returns
    -------
    Rerun
        The new result, the changes of files and version, and the difference.

    Raises
    ------
    InputError
        If the result has no readable provenance, names files in other folders, or was made from
        another number of images.
    FileFormatError
        If a file does not exist or cannot be read.
    InversionCancelled
        If `should_stop` returned true.
    """
    inputs = collect_rerun(result, images, source=source, other_folders=other_folders)
    return inputs.run(on_progress, should_stop)


def collect_rerun(
    result: Path | str | AnyResult | xarray.Dataset,
    images: Sequence[AnyShot] | AnyShot | None = None,
    *,
    source: Path | str | None = None,
    other_folders: bool = False,
    folder: Path | None = None,
) -> RerunInputs:
    """Read a result and the files of its provenance, otherwise as `rerun`.

    `folder` is where the files of a result in memory are. Default: the current one.
    """
    dataset: Any = result
    name = "the result"
    if isinstance(result, (str, Path)):
        dataset, name = read_dataset(result), str(result)
        folder = Path(result).parent
    elif not hasattr(result, "data_vars"):
        dataset = result.to_dataset()
    provenance = _checked_provenance(dataset, name)
    listed: Any = () if images is None else images
    is_one = isinstance(listed, (str, Path, Shot)) or getattr(listed, "ndim", 0) == 2
    shots = (listed,) if is_one else tuple(listed)
    reader = _Reader(name, folder or Path(), shots, source, other_folders)
    if provenance.version != __version__:
        reader.changes.append(f"made by version {provenance.version}, now {__version__}")
    if provenance.pack is not None:
        files = provenance.pack.files
        for file in files:
            reader.check(file, "the file")
        changes = tuple(reader.changes)
        return RerunInputs(dataset, provenance, Recipe(), files=tuple(files), changes=changes)
    return reader.inputs(dataset, provenance)


def provenance_of(dataset: xarray.Dataset) -> Provenance | None:
    """Return the provenance of a result or of one shot of a stack, None if it has none."""
    provenance, report = Provenance.of(dataset.attrs, dataset.variables), _report_in_stack(dataset)
    if report is None:
        return provenance
    if "provenance" in report:
        return Provenance.of(report, dataset.variables)
    if provenance is None or provenance.kind != "inversion":
        return None
    origin = {"file": str(dataset["name"].values), "sha256": report.get("sha256", "")}
    return provenance.with_image(**origin)


def _report_in_stack(dataset: xarray.Dataset) -> dict[str, Any] | None:
    """Return the report of one shot of a stack, None of another result."""
    if "report" not in dataset.variables or dataset["report"].ndim:
        return None
    report: dict[str, Any] = json.loads(str(dataset["report"].values))
    return report


def _checked_provenance(dataset: xarray.Dataset, name: str) -> Provenance:
    if "shot" in dataset.dims:
        raise InputError(
            f"{name} is a stack: expected one result, such as that of one of its shots"
        )
    if "report" in dataset.attrs:  # not of a shot of a stack, a film pack or a field alone
        as_file_errors(lambda _: result_from_dataset(dataset))(name)
    provenance = provenance_of(dataset)
    if provenance is None:
        raise InputError(f"{name} {_defect(dataset)}")
    return provenance


def _defect(dataset: xarray.Dataset) -> str:
    if "report" in dataset.variables:
        return "is a shot of a stack without a provenance: repeat it with shadowinv fit or batch"
    if not dataset.attrs.get("provenance"):
        return (
            "has no provenance, like all results of invert() and fit() in scripts: repeat it with "
            "a recipe (docs/recipes.md)"
        )
    return (
        "has a damaged provenance, or one of another version: use that version, or repeat it with "
        "a recipe (docs/recipes.md)"
    )


@dataclass
class _Reader:
    """Reads the files of a result: the caller's, or those in its folder or the current one."""

    result: str
    folder: Path
    images: tuple[AnyShot, ...]
    source: Path | str | None
    other_folders: bool
    files: list[Path] = field(default_factory=list)
    changes: list[str] = field(default_factory=list)

    def check(self, file: Path, name: str) -> None:
        """Refuse a file outside of the result's folder and the current one."""
        path = Path(os.path.abspath(file))  # a link in the result's folder belongs to the user
        folders = (self.folder, Path())
        is_inside = any(path.is_relative_to(os.path.abspath(folder)) for folder in folders)
        if not (self.other_folders or is_inside):
            raise InputError(
                f"{self.result} names {name} {file}, which is in another folder: name the file to "
                "use, or allow other folders if you trust the result",
                option="other_folders",
            )

    def inputs(self, dataset: xarray.Dataset, provenance: Provenance) -> RerunInputs:
        count = len(provenance.images)
        if len(self.images) not in (0, count):
            raise InputError(
                f"received {len(self.images)} images, and {self.result} was made from {count}: "
                "name all of them in their order, or none if they are in the result's folder"
            )
        # The image of a refinement was prepared by the recipe of its start.
        origins = provenance.start or provenance
        self._check_recipe(provenance.recipe)
        self._check_recipe(origins.recipe)
        is_fit = provenance.kind == "fit"
        names = [f"image {k + 1}" if is_fit else "the image" for k in range(count)]
        images = list(map(self._read, origins.images, names, self.images or [None] * count))
        report = _report_in_stack(dataset)
        if report is None or "provenance" in report:  # else it is that of all shots
            images = [replace(image, mask=None) for image in images]
        sources = [f"the source of {name}" if is_fit else "the source" for name in names]
        shots = [self._shot(origins, k, images[k], sources[k]) for k in range(count)]
        dark = origins.image.dark
        path = None
        if dark is not None:
            path = join_address(self._find(dark, "the dark frame"), dark.variable)
        shots[0] = replace(shots[0], fiducials=provenance.fiducial_rows)
        return RerunInputs(
            dataset,
            provenance,
            _with_dark(provenance.recipe, path),
            tuple(shots),
            tuple(self.files if path is None else [*self.files, path]),
            tuple(self.changes),
        )

    def _check_recipe(self, recipe: Recipe) -> None:
        files = {
            "a mask": recipe.mask,
            "a source mask": recipe.source_mask,
            "a dark frame": recipe.dark_file,
            "a source": recipe.source.file if isinstance(recipe.source, MeasuredSource) else None,
        }
        for name, file in files.items():
            if file is not None:
                self.check(file, name)

    def _find(self, origin: Origin, name: str) -> Path:
        candidates = [folder / origin.file for folder in (self.folder, Path()) if origin.file]
        if candidates:
            self.check(candidates[0], name)
        path = next((file for file in candidates if file.is_file()), None)
        if path is None:
            reason = f"{origin.file} does not exist" if origin.file else "was not made from a file"
            raise FileFormatError(f"{name} {reason}: name the file to use")
        return path

    def _read(self, origin: Origin, name: str, argument: AnyShot | None = None) -> Shot:
        """Read an image or source; an argument has precedence."""
        if argument is None:
            argument = self._find(origin, name)
        if not isinstance(argument, (str, Path)):
            return load_shot(argument, name)
        path, variable = split_address(argument)
        self.files.append(path)
        channel = None if origin.channel is None else str(origin.channel)
        return read_shot(path, channel=channel, variable=variable or origin.variable)

    def _shot(self, provenance: Provenance, k: int, image: Shot, source_name: str) -> Shot:
        origin, source = provenance.images[k], None
        if origin.source is not None:
            source = self._read(origin.source, source_name, self.source)
        mask, source_mask = map(provenance.mask_of, (origin.mask, origin.source_mask))
        return replace(
            image,
            # The provenance has the other contents of the file that were used.
            setup=origin.setup or provenance.recipe.setup,
            source=source,
            mask=join_masks(image.mask, mask and mask.mask()),
            source_mask=None if source_mask is None else source_mask.mask(),
            measured=origin.measured,
            **{name: getattr(origin, name) for name in NUMBERS},
        )


def _with_dark(recipe: Recipe, path: Path | None) -> Recipe:
    return recipe if path is None else recipe.with_dark_file(path)


def _image_changes(before: Provenance, after: Provenance) -> list[str]:
    changes: list[str] = []
    for number, (old, new) in enumerate(zip(before.images, after.images, strict=False), 1):
        name = "image" if before.kind == "inversion" else f"image {number}"
        of_image = "" if before.kind == "inversion" else f" of image {number}"
        changes += _file_changes(f"film {number}" if before.pack else name, old, new)
        changes += _file_changes(f"source{of_image}", old.source, new.source)
        changes += _file_changes("dark frame", old.dark, new.dark)
    return changes


def _file_changes(name: str, before: Origin | None, after: Origin | None) -> list[str]:
    if before is None or after is None:
        return []
    if not before.sha256:
        return [f"the {name} was not a file before: {after.file} may differ from it"]
    if before.sha256 != after.sha256:
        return [f"the {name} {after.file} differs from the {before.file} used before"]
    return []


def _difference(before: xarray.Dataset, after: xarray.Dataset) -> str:
    shapes = [(dataset.sizes["y"], dataset.sizes["x"]) for dataset in (after, before)]
    if shapes[0] != shapes[1]:
        return f"different size: {shapes[0]}, before {shapes[1]}"
    setup = setup_from_dataset(before)
    in_si = () if setup is None else tuple(si_field.name for si_field in setup.si_fields)
    names = [
        str(name)
        for name in before.data_vars
        # Fields in SI units follow from those in pixels, and the setup may be of a later choice.
        if name in after.data_vars and name not in _PAINTED and not str(name).startswith(in_si)
    ]
    pairs: dict[str, tuple[Any, Any]] = {}
    for name in names:
        old, new = before[name].values, after[name].values
        new = new.astype(old.dtype) if old.dtype.kind == "f" else new
        is_number = old.dtype.kind in "fc" and new.dtype.kind in "fc"
        if not np.array_equal(old, new, equal_nan=is_number):
            pairs[name] = old, new
    if not pairs:
        return IDENTICAL
    verdict = before.attrs.get("verdict")  # a shot of a stack has none in its attributes
    is_changed = verdict not in (None, after.attrs.get("verdict"))
    displacements = [
        np.abs(old - new).max()
        for name, (old, new) in pairs.items()
        if name.startswith("displacement") and old.shape == new.shape
    ]
    text = f"{', '.join(pairs)} differ{'s' * (len(pairs) == 1)}"
    if displacements:
        text = f"displacement differs by up to {to_figures(max(displacements))} px"
    return text + (f"; the verdict was '{verdict}'" if is_changed else "")
