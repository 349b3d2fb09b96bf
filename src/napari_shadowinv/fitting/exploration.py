"""How far images leave a fit open: `explore`, and where its other starts end: `find_basins`."""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, replace

import numpy as np

from napari_shadowinv._typing import FloatArray
from napari_shadowinv.fitting.conjugate_gradients import SoftModes
from napari_shadowinv.fitting.forward import Scene
from napari_shadowinv.fitting.instrument import ASSUMED, EXACT, Imperfect
from napari_shadowinv.fitting.measurements import FitData
from napari_shadowinv.fitting.parallel import OnStep
from napari_shadowinv.fitting.posterior import (
    BeamShifts,
    Posterior,
    Sample,
    compare_samples,
    displacement_errors,
    errors_by_part,
    shares_of,
    shifts_by_beam,
)
from napari_shadowinv.fitting.result import Basin
from napari_shadowinv.fitting.rivals import transmission_of
from napari_shadowinv.fitting.search import (
    SPACING_WITH_NUMBERS,
    Minimum,
    in_recorded_pixels,
    settle_minimum,
)
from napari_shadowinv.fitting.unknowns import Unknowns
from napari_shadowinv.instrument.effects import EFFECTS, RESPONSES
from napari_shadowinv.inversion.samples import Pairs


@dataclass(frozen=True)
class PosteriorSummary:
    """How far the images leave the best unknowns open, and how far an instrument would move them.

    Errors are displacements.
    """

    posterior: Posterior | None  # for counts alone
    samples: list[Sample]
    pairs: Pairs | None  # samples to first order, where these serve, and solved in full
    errors: FloatArray | None
    by_part: dict[str, FloatArray]
    by_beam: BeamShifts | None
    assumed: dict[str, Unknowns]  # likely changes by a detector of which nothing was stated
    sensitivities: dict[str, FloatArray]  # shares of each field's displacement, (M,)


def find_basins(
    scene: Scene, best: Minimum, others: Sequence[Minimum], on_step: OnStep
) -> tuple[Basin, ...]:
    """Return the best answer and others, with the same λ and without blur.

    Smoother fields have decided which is best: the present λ favours what follows the
    noise.
    """
    ends = [best]
    for minimum in others[:2]:
        rival = minimum if minimum.bin == best.bin else in_recorded_pixels(scene, minimum)
        unknowns = rival.unknowns._replace(
            common=best.unknowns.common, separate=best.unknowns.separate
        )
        rival = replace(rival, unknowns=unknowns)
        ends.append(settle_minimum(scene, rival, on_step, "other starts"))
    middle = best.coarsen(scene)
    chi2 = [float(middle.chi2(middle.model(end.unknowns)).mean()) for end in ends]
    return tuple(
        Basin(end.start, end.value, each, best.distance(end), end.displacement)
        for end, each in zip(ends, chi2, strict=True)
    )


def explore(
    data: FitData,
    scene: Scene,
    best: Minimum,
    rng: np.random.Generator,
    on_step: OnStep,
    *,
    spacing: float = 1 / 3,
    checked: int = 2,
    solved_of_beams: tuple[int, int] = (16, 8),
) -> PosteriorSummary:
    """Draw samples around the best unknowns, and respond to a detector that nobody stated.

    Rays are `spacing` px apart. Of samples of an instrument, `checked` are solved, too. Where each
    image has a beam of its own, a few directions hold most of the error, along which images are not
    linear: `solved_of_beams` samples are the least, and steps the most in which each is solved.
    """

    def posterior_with(scene: Scene, start: Minimum, modes: SoftModes | None = None) -> Posterior:
        # What rays that are far apart add would tell fields from what resembles them.
        is_dense = scene.imperfect.resembles_fields
        rays = SPACING_WITH_NUMBERS if is_dense else spacing
        middle = replace(best.coarsen(scene), spacing=rays)
        return Posterior(middle, start.unknowns, rng, lambda: on_step("samples", np.nan), modes)

    posterior = posterior_with(scene, best, None if data.single else copy(best.modes))
    options, pairs = data.options, None
    count = options.samples if options.samples > 1 else 0
    if count and "beam_between" in scene.imperfect.keys:
        least, steps = solved_of_beams
        samples = posterior.solve(posterior.draw_samples(max(count, least)), steps)
    else:
        samples = posterior.draw_samples(count)
        linear = samples[: checked if scene.imperfect.of_response else 0]
        if solved := posterior.solve(linear, steps=1):
            pairs = compare_samples(posterior.scene, linear, solved)
    changes = [sample.change for sample in samples]
    errors = displacement_errors(scene, changes, data.size) if changes else None
    by_part = errors_by_part(scene, posterior, samples, data.size)
    if errors is not None and not by_part:
        by_part = {"noise": errors}
    by_beam = shifts_by_beam(data, scene, posterior, samples)
    responses: dict[str, tuple[Unknowns, float]] = {}
    sensitivities: dict[str, FloatArray] = {}
    if samples:
        tested = replace(scene, imperfect=_tested_instrument(data, best))
        response = posterior_with(tested, adapt(best, tested.imperfect, EXACT))
        # Without an instrument that is fitted, residuals ask for anything.
        is_exact = not scene.imperfect.parts
        responses = response.responses(np.random.default_rng(options.seed), asked=is_exact)
        moves = response.scene.displacement
        of_best = moves(best.unknowns)
        sensitivities = {
            key: shares_of(moves(change), of_best) for key, (change, _) in responses.items()
        }
    # Counts are those of a detector that is linear and has no dark level.
    is_linear = data.counted or data.instrument.has_numbers
    return PosteriorSummary(
        posterior if data.counted else None,  # its Jacobians are large
        samples,
        pairs,
        errors=errors,
        by_part=by_part,
        by_beam=by_beam,
        assumed={
            key: change.zeros().plus(change, size)
            for key, (change, size) in responses.items()
            if key in ASSUMED and not is_linear
        },
        sensitivities=sensitivities,
    )


def _tested_instrument(data: FitData, minimum: Minimum) -> Imperfect:
    sizes = {each.key: each.tested for each in EFFECTS if each.tested}
    shapes = transmission_of(data, minimum, sizes["absorption"])
    responses = {each.key: each.tested for each in RESPONSES}
    return Imperfect(responses, blur=sizes["blur"] ** 2, shapes=(shapes,))


def adapt(minimum: Minimum, imperfect: Imperfect, before: Imperfect) -> Minimum:
    """Return a minimum with the numbers of other imperfections than before."""
    return replace(minimum, unknowns=imperfect.adapt(minimum.unknowns, before))
