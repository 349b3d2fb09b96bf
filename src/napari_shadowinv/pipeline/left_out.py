"""Test of one static field against several images: `run_leave_one_out`.

Images are processed in order of energy, so results do not depend on their order in the call.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from napari_shadowinv._system.progress import OnProgress, ShouldStop
from napari_shadowinv.fitting import LeaveOneOut, leave_one_out
from napari_shadowinv.fitting.left_out import check_count
from napari_shadowinv.fitting.measurements import displacements_of
from napari_shadowinv.fitting.shots import names_of
from napari_shadowinv.options import FitChoices
from napari_shadowinv.pipeline.fit_run import FitInputs, collect_fit_inputs
from napari_shadowinv.pipeline.inversion_run import AnyShot
from napari_shadowinv.preprocessing import Recipe


def run_leave_one_out(
    recipe: Recipe,
    shots: Sequence[AnyShot],
    fields: Sequence[str] | None = None,
    *,
    on_progress: OnProgress | None = None,
    should_stop: ShouldStop | None = None,
) -> LeaveOneOut:
    """Predict each of several images of one object from a fit of the others, as `run_fit`.

    Parameters
    ----------
    recipe : Recipe
        Steps and options; without a section `fit` the defaults apply.
    shots : sequence of Shot, array_like or path
        Three images or more, of one size after the steps.
    fields : sequence of {"B", "E", "n"}, optional
        The fields of the object. Default: those of the recipe.
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
    if fields is not None:
        choices = recipe.fit or FitChoices()
        recipe = recipe.model_copy(
            update={"fit": choices.model_copy(update={"fields": tuple(fields)})}
        )
    inputs = collect_fit_inputs(recipe, shots, should_stop=should_stop)
    order = _order_by_energy(inputs)
    images = [replace(inputs.shots[k], fiducials=None) for k in order]
    left_out = leave_one_out(
        images,
        fields=inputs.fields,
        options=inputs.choices.options,
        on_progress=on_progress,
        should_stop=should_stop,
    )
    left_out = left_out.only([int(place) for place in np.argsort(order)])
    return replace(left_out, setups=inputs.setups or (), names=names_of(inputs.shots))


def _order_by_energy(inputs: FitInputs) -> list[int]:
    """Sort the images by energy, the most displaced first."""
    shots = inputs.shots
    strengths, _ = displacements_of(shots, names_of(shots), inputs.fields)
    sizes = np.abs(strengths[:, 0])
    images = [shot.image.tobytes() for shot in shots]
    return sorted(range(len(images)), key=lambda k: (-sizes[k], images[k]))
