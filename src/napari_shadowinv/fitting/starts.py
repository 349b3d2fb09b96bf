"""Where the search of a fit begins: `collect_starts`."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.ndimage import gaussian_filter

from napari_shadowinv._system.progress import Reporter, ShouldStop
from napari_shadowinv._typing import FloatArray
from napari_shadowinv.errors import InputError
from napari_shadowinv.fitting.measurements import FitData
from napari_shadowinv.fitting.parallel import OnStep
from napari_shadowinv.fitting.search import Stages, Start
from napari_shadowinv.inversion import plan_sites
from napari_shadowinv.inversion.normalise import prepare
from napari_shadowinv.inversion.readout import read_out
from napari_shadowinv.options import InversionOptions
from napari_shadowinv.transport.solvers import Target, solve


def collect_starts(
    data: FitData,
    on_step: OnStep,
    should_stop: ShouldStop | None,
    *,
    shares: Sequence[float] = (1.0, 1.4, 1.9, 2.4),
    rounded: float = 8.0,
    from_far: Stages = ((4, 2.0), (4, 1.0), (2, 1.0)),
    from_near: Stages = ((4, 2.0), (2, 2.0), (2, 1.0)),
    from_field: Stages = ((4, 1.0), (2, 1.0)),
) -> list[Start]:
    """Return the starting points: no field, a field that is known, and inversions by transport.

    Past caustics transport is too weak, so one image starts from several `shares` of its
    potential, which is blurred by `rounded` px.
    """
    # A beam that is about uniform comes after the field.
    scene, is_held = data.scene, data.assumed
    candidates = []
    if data.near is not None:
        return [Start("near field", ((2, 1.0),), data.start)]
    if data.start is not None:
        candidates.append(Start("given", ((2, 1.0),), data.start, is_held))
    if not data.single:
        candidates.append(Start("from far", from_far, beam_held=is_held))
    candidates.append(Start("from near", from_near, beam_held=is_held))
    if data.unknown and not data.single:
        candidates.append(Start("from far, beam held", from_far, beam_held=True))
    if scene.strengths.shape[1] > 1 or data.unknown:
        return candidates
    sizes = np.abs(scene.strengths[:, 0])  # zero where the object does not deflect: a blank shot
    weakest = int(np.argmin(np.where(sizes > 0, sizes, np.inf)))
    on_step("transport", float("nan"))
    transported = _transport_potential(data, weakest, should_stop)
    if transported is None:
        return candidates
    potential = gaussian_filter(transported, rounded) / scene.strengths[weakest, 0]
    if not data.single:
        return [*candidates, Start("transport", ((2, 2.0), (2, 1.0)), potential, is_held)]
    return candidates + [
        Start(f"{share:g} × transport", from_field, share * potential) for share in shares
    ]


def _transport_potential(
    data: FitData, number: int, should_stop: ShouldStop | None, most_sites: int = 10_000
) -> FloatArray | None:
    height, width = data.size
    scene = data.scene
    image = scene.images[number, :height, :width]
    used = scene.weights[number, :height, :width] > 0
    pad = scene.pad
    beam = scene.beams[number, pad : pad + height, pad : pad + width]
    options = InversionOptions(
        # Less than a third of the width by which it is blurred apart.
        n_sites=min(most_sites, height * width // 4),
        negative="clip",
        threads=scene.threads,
        tolerance=0.05,
    )
    # The potential alone: a start needs no errors of it.
    try:
        prepared = prepare(image, beam, options, used)
        plan = plan_sites(prepared.source, options, mask=used, should_stop=should_stop)
        target = Target.of(prepared.floored_image, options)
        solved = solve(plan.levels, target, Reporter(None, should_stop))
    except InputError:
        return None
    return read_out(solved[-1], options)[0]
