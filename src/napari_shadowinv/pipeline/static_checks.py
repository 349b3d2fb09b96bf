"""Tests of one static field against several images: `run_leave_one_out`, `run_windows`.

Both, as far as requested, next to the fit of all images: `run_checks`.
Images are processed in order of energy, so results do not depend on their order in the call.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from napari_shadowinv._system.progress import OnProgress, Progress, ShouldStop
from napari_shadowinv._typing import FloatArray
from napari_shadowinv.errors import InputError
from napari_shadowinv.fitting import Fit, FitShot, FitWindows, LeaveOneOut, leave_one_out
from napari_shadowinv.fitting.measurements import strengths_of
from napari_shadowinv.fitting.shots import common_values
from napari_shadowinv.fitting.windows import check_count
from napari_shadowinv.options import FitChoices
from napari_shadowinv.pipeline.fit_run import FitInputs, collect_fit_inputs
from napari_shadowinv.pipeline.inversion_run import Shot
from napari_shadowinv.preprocessing import Recipe

if TYPE_CHECKING:
    import xarray


@dataclass(frozen=True)
class StaticChecks:
    """Checks that one static field explains the images, as far as requested."""

    left_out: LeaveOneOut | None = None
    windows: FitWindows | None = None

    def add_to(self, dataset: xarray.Dataset) -> xarray.Dataset:
        """Add the checks to the dataset of a fit."""
        if self.left_out is not None:
            addition = self.left_out.to_dataset()
            dataset = dataset.assign(addition.data_vars).assign_attrs(addition.attrs)
        return dataset if self.windows is None else self.windows.added_to(dataset)


def run_checks(
    recipe: Recipe,
    shots: Sequence[FitShot | Shot],
    fit: Fit,
    *,
    left_out: bool,
    window: int | None,
    on_progress: OnProgress | None = None,
    should_stop: ShouldStop | None = None,
) -> StaticChecks:
    """Leave out each image, and fit windows of `window` images, with the fields of a fit."""
    choices = (recipe.fit or FitChoices()).model_copy(
        update={"fields": tuple(field.name for field in fit.fields)}
    )
    chosen = recipe.model_copy(update={"fit": choices})
    callbacks: dict[str, Any] = {"on_progress": on_progress, "should_stop": should_stop}
    return StaticChecks(
        run_leave_one_out(chosen, shots, **callbacks) if left_out else None,
        None if window is None else run_windows(chosen, shots, window, **callbacks),
    )


def run_leave_one_out(
    recipe: Recipe,
    shots: Sequence[FitShot | Shot],
    *,
    on_progress: OnProgress | None = None,
    should_stop: ShouldStop | None = None,
) -> LeaveOneOut:
    """Predict each of several images of one object from a fit of the others, as `run_fit`.

    Parameters
    ----------
    recipe : Recipe
        Steps and options; without a section `fit` the defaults apply.
    shots : sequence of FitShot, Radiograph, array_like or path
        Three images or more, of one size after the steps.
    on_progress, should_stop
        As for `run_fit`.

    Returns
    -------
    LeaveOneOut
        Its images are in the order of `shots`.

    Raises
    ------
    InputError
        As `run_fit`, and if there are fewer than three images.
    FileFormatError
        If a file cannot be read.
    InversionCancelled
        If `should_stop` returned true.
    """
    check_count(len(shots))
    inputs = collect_fit_inputs(recipe, shots, should_stop=should_stop)
    order = _order_by_energy(inputs)
    left_out = leave_one_out(
        **inputs.only(order).keywords,
        fields=inputs.fields,
        on_progress=on_progress,
        should_stop=should_stop,
    )
    left_out = left_out.only([int(place) for place in np.argsort(order)])
    return replace(left_out, setups=inputs.setups or (), names=inputs.names)


def run_windows(
    recipe: Recipe,
    shots: Sequence[FitShot | Shot],
    size: int,
    *,
    on_progress: OnProgress | None = None,
    should_stop: ShouldStop | None = None,
) -> FitWindows:
    """Fit groups of neighbouring images, in order of energy, one after another, as `run_fit`.

    Slower particles pass the object later: the fields of all groups are a movie of it.

    Parameters
    ----------
    recipe, shots, on_progress, should_stop
        As for `run_fit`.
    size : int
        Number of images in a group.

    Returns
    -------
    FitWindows
        The first group has the images of the lowest energies, which are displaced most.

    Raises
    ------
    InputError
        As `run_fit`, and if a group would have no image, or more than there are.
    FileFormatError
        If a file cannot be read.
    InversionCancelled
        If `should_stop` returned true.
    """
    check_window(size, len(shots))
    inputs = collect_fit_inputs(recipe, shots, should_stop=should_stop)
    order = _order_by_energy(inputs)
    strengths = _strengths(inputs.only(order))[: len(order) - size + 1]
    groups = [order[first : first + size] for first in range(len(strengths))]
    fits = []
    for number, group in enumerate(groups, 1):

        def on_fit_progress(progress: Progress) -> None:
            if on_progress is not None:
                on_progress(replace(progress, stage=f"window {number} of {len(groups)}"))  # noqa: B023

        fits.append(inputs.only(group).run(on_fit_progress, should_stop))
    return FitWindows(tuple(map(tuple, groups)), tuple(fits), strengths)


def check_window(size: int, count: int) -> None:
    """Raise an `InputError` if groups would have no image, or more than there are."""
    if not 1 <= size <= count:
        raise InputError(
            f"received {count} image{'s' * (count != 1)} and windows of {size}: expected windows "
            f"of 1 to {count} image{'s' * (count != 1)}",
            option="energy_window",
        )


def _order_by_energy(inputs: FitInputs) -> list[int]:
    """Sort the images by energy, the most displaced first."""
    sizes = np.abs(_strengths(inputs)[:, 0])
    images = [shot.image.tobytes() for shot in inputs.shots]
    return sorted(range(len(images)), key=lambda k: (-sizes[k], images[k]))


def _strengths(inputs: FitInputs) -> FloatArray:
    """Displacement of each image by each field, relative to the first image."""
    strengths = common_values(inputs.names, [shot.strength for shot in inputs.recorded], "strength")
    if strengths is None:
        return strengths_of(inputs.setups, inputs.fields, len(inputs.shots), inputs.names)
    matrix = np.array(strengths, dtype=np.float64)
    return np.asarray(matrix / matrix[0])
