"""The answer of a fit.

- in recorded pixels, with its verdict: `summarise`
- its errors: `field_errors`, `error_budget`; its report: `report_of`
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from napari_shadowinv._typing import BoolArray, FloatArray
from napari_shadowinv.facts import Assessment, Verdict
from napari_shadowinv.fitting.conjugate_gradients import product
from napari_shadowinv.fitting.exploration import PosteriorSummary
from napari_shadowinv.fitting.forward import Scene
from napari_shadowinv.fitting.instrument import TITLES, Imperfect, numbers_in_units
from napari_shadowinv.fitting.measurements import FitData
from napari_shadowinv.fitting.pattern import Pattern
from napari_shadowinv.fitting.posterior import (
    displacement_errors,
    potentials_of,
    sampled_potentials,
)
from napari_shadowinv.fitting.result import Basin, Fit, FitReport, FittedField
from napari_shadowinv.fitting.search import FineMinimum
from napari_shadowinv.fitting.verdict import Evidence, assess_verdict, hidden_contrast
from napari_shadowinv.instrument.effects import EFFECTS
from napari_shadowinv.inversion.error_budget import ErrorBudget, ErrorEstimate, root_of
from napari_shadowinv.physics.edge import edge_changes, edge_sides
from napari_shadowinv.physics.forward import jacobian_determinant
from napari_shadowinv.physics.significance import deviation_along


@dataclass(frozen=True)
class FieldErrors:
    """Errors of displacements, (M, 2, H, W) px: in all, and by each part."""

    in_all: FloatArray
    by_part: dict[str, FloatArray]
    samples: FloatArray  # of potentials, (M, n, H, W)
    sides: tuple[str, ...] = ()  # beyond which an object may lie

    def with_part(self, key: str, errors: FloatArray) -> FieldErrors:
        """Return the same with another part."""
        in_all = np.hypot(self.in_all, errors)
        return replace(self, in_all=in_all, by_part={**self.by_part, key: errors})


def field_errors(
    data: FitData, scene: Scene, summary: PosteriorSummary, amplification: float
) -> FieldErrors | None:
    """Return the errors by noise, numbers, beam and an assumed detector, and samples of fields.

    Correlated noise makes those by noise larger, by an `amplification`. None without samples.
    """
    if summary.errors is None:
        return None
    noise = summary.by_part["noise"]
    in_all = np.sqrt(summary.errors**2 + (amplification**2 - 1) * noise**2)
    by_beam = summary.by_beam
    shifts = [*(() if by_beam is None else by_beam.changes), *summary.assumed.values()]
    samples = sampled_potentials(scene, summary.samples, shifts, data.size, data.options.seed)
    before, after = summary.errors.ravel(), in_all.ravel()
    samples *= np.float32(np.sqrt(product(after, after) / product(before, before)))
    errors = FieldErrors(in_all, {**summary.by_part, "noise": amplification * noise}, samples)
    if by_beam is not None:
        errors = errors.with_part("beam", by_beam.errors)
    for key, change in summary.assumed.items():
        errors = errors.with_part(key, displacement_errors(scene, [change], data.size))
    return errors


def with_edge(
    errors: FieldErrors, potentials: FloatArray, displacements: FloatArray, seed: int
) -> FieldErrors:
    """Return errors with one by objects beyond the edge, as far as it exceeds them."""
    changes = _changes_by_edge(potentials, displacements, errors.in_all)
    by_edge = np.sqrt((changes[:, :, 1:] ** 2).sum(axis=1))
    if by_edge.any():
        samples = _beyond_edge(errors.samples, changes[:, :, 0], seed)
        errors = replace(errors.with_part("edge", by_edge), samples=samples)
    return replace(errors, sides=edge_sides((by_edge**2).sum(axis=(0, 1))))


def summarise(
    data: FitData,
    refined: FineMinimum,
    basins: tuple[Basin, ...],
    summary: PosteriorSummary,
    errors: FieldErrors | None,
    report: FitReport,
    pattern: Pattern,
) -> Fit:
    """Return the answer of a fit in recorded pixels, with its verdict."""
    scene, unknowns = refined.scene, refined.unknowns
    height, width = data.size
    units = data.units[:, None, None]
    used = scene.weights[:, :height, :width] > 0
    images = scene.images[:, :height, :width] * units
    model = refined.seen[:, :height, :width] * units
    brightness = np.exp(unknowns.brightness)
    beams = scene.beam(unknowns)[:, :height, :width] * units * brightness[:, None, None]
    displacements = scene.displacement(unknowns)[..., :height, :width].copy()
    potentials = potentials_of(scene, unknowns, data.size)
    if errors is not None:
        errors = with_edge(errors, potentials, displacements, data.options.seed)
    jacobian = _most_folded(scene, displacements)
    in_any = np.asarray(used.any(axis=0))
    unassessed = Fit(
        images=images,
        mask=used,
        strengths=scene.strengths,
        fields=tuple(
            FittedField(
                name,
                potentials[m],
                displacements[m],
                error_budget(
                    data, errors, summary, m, displacements[m], in_any, pattern.correlation
                ),
                (float(scene.smoothness[m, 0]), float(scene.smoothness[m, 1])),
                None if errors is None else errors.samples[m],
            )
            for m, name in enumerate(data.fields)
        ),
        source=beams,
        brightness=brightness * data.brightness,
        frames=unknowns.frames,
        reprojection=model,
        residual=np.where(used, images - model, 0.0),
        chi2=data.noise.relative_chi2(scene.chi2(refined.seen)),
        basins=basins,
        folded=float((jacobian < 0).mean()),
        assessment=Assessment(Verdict.UNCERTAIN, ""),
        report=report,
        options=data.options,
        instrument=data.instrument,
        setups=data.setups or (),
        noise=data.noise_of(scene.weights),
    )
    evidence = Evidence(
        unassessed,
        pattern,
        jacobian,
        single=data.single,
        beam_unknown=data.unknown,
        hidden=hidden_contrast(model / np.maximum(beams, 1e-3 * units) - 1, used),
        searched=data.near is None,
        noise=data.noise,
    )
    return replace(unassessed, assessment=assess_verdict(evidence))


def report_of(
    data: FitData,
    instrument: Imperfect,
    refined: FineMinimum,
    summary: PosteriorSummary,
    pattern: Pattern,
) -> FitReport:
    """Return the report of a fit, without its errors."""
    unknowns, pairs = refined.unknowns, summary.pairs
    return FitReport(
        objective=refined.objective,
        iterations=refined.iterations,
        converged=refined.converged,
        seconds={},
        pattern=pattern.largest,
        numbers=numbers_in_units(
            instrument,
            instrument.adapt(unknowns, refined.scene.imperfect),
            [sample.change for sample in summary.samples],
        ),
        linearity=None if pairs is None else pairs.linearity,
    )


def error_budget(
    data: FitData,
    errors: FieldErrors | None,
    summary: PosteriorSummary,
    number: int,
    displacement: FloatArray,
    used: BoolArray,
    correlation: float,
) -> ErrorBudget | None:
    """Return the error budget of a field by its number and displacement, (2, H, W), if it has one.

    Noise is correlated as by a blur of `correlation` px.
    """
    if errors is None:
        return None
    length = np.where(used, np.hypot(*displacement), 0.0)
    row, column = np.unravel_index(length.argmax(), length.shape)

    def estimate(std: FloatArray) -> ErrorEstimate:
        at_peak = deviation_along(displacement[:, row, column], std[:, row, column])
        return ErrorEstimate(_length(std), float(at_peak))

    parts = {key: estimate(each[number]) for key, each in errors.by_part.items()}
    noise, edge, by_beam = (parts.pop(key, None) for key in ("noise", "edge", "beam"))
    assert noise is not None
    if edge is not None:  # it is what exceeds the others
        others = [part for part in (noise, by_beam, *parts.values()) if part is not None]
        edge = root_of(*(np.array([edge, *others]) ** 2).sum(axis=0))
    # Shares of no displacement are large, not infinite.
    field = ErrorEstimate(max(_length(displacement), 1e-6), max(float(length.max()), 1e-6))
    assumed = [each for each in EFFECTS if each.key in summary.assumed]
    sizes = {each.name(each.tested): each.tested for each in assumed}
    names = TITLES | {each.key: each.name(each.tested) for each in assumed}
    budget = ErrorBudget(
        peak=field.at_peak,
        rms=field.rms,
        noise=noise,
        effects={names[key]: part for key, part in parts.items()},
        edge=edge,
        sides=errors.sides,
        beam=by_beam if data.beam.rms else None,
        beam_sensitivity=None
        if summary.by_beam is None
        else estimate(summary.by_beam.by_percent[number]),
        sensitivities={
            each.name(each.tested): field.times(float(summary.sensitivities[each.key][number]))
            for each in EFFECTS
            if each.key in summary.sensitivities.keys() - errors.by_part.keys()
        },
        sizes=sizes,
        beam_variation=data.beam.rms,
        beam_scale=data.beam.length,
        beam_basis=_beam_basis(data),
        noise_correlation=correlation,
        assumed=tuple(sizes),
        sampled=estimate(errors.in_all[number]),
        per_pixel=errors.in_all[number],
    )
    return replace(budget, causes=budget.causes_of_parts)


def _length(vectors: FloatArray) -> float:
    """Return the length of vectors, (2, H, W), r.m.s. over the image."""
    return float(np.sqrt((vectors**2).sum(axis=0).mean()))


def _beam_basis(data: FitData) -> str:
    """Return where the difference of beam and source comes from; see `ErrorBudget`."""
    if data.unknown:
        return "unknown"
    if data.instrument.beam_rms is not None:
        return "stated"
    if data.beam.components is not None:
        return data.beam.components.basis
    return "assumed" if data.assumed else "reference"


def _most_folded(scene: Scene, displacements: FloatArray) -> FloatArray:
    jacobians = [
        jacobian_determinant(moved)
        for moved in np.einsum("lm,mcyx->lcyx", scene.strengths, displacements)
    ]
    return max(jacobians, key=lambda each: int((each < 0).sum()))


def _changes_by_edge(
    potentials: FloatArray, displacements: FloatArray, errors: FloatArray
) -> FloatArray:
    """Return each field's `edge_changes`, (M, k, 3, H, W), as far as they exceed other errors.

    Other errors, (M, 2, H, W), move the fields at the edge, too.
    """
    changes = np.array(list(map(edge_changes, potentials, displacements)))
    squares = (changes[:, :, 1:] ** 2).sum(axis=1).mean(axis=(1, 2, 3))
    explained = (errors**2).mean(axis=(1, 2, 3))
    excess = np.maximum(1 - explained / np.maximum(squares, 1e-300), 0.0)
    return np.asarray(np.sqrt(excess)[:, None, None, None, None] * changes)


def _beyond_edge(samples: FloatArray, changes: FloatArray, seed: int) -> FloatArray:
    """Add objects beyond the edge, (M, k, H, W), to samples of potentials, (M, n, H, W)."""
    rng = np.random.default_rng([seed, *b"edge"])
    draws = rng.normal(size=(samples.shape[1], changes.shape[1]))
    beyond = np.einsum("sk,mkyx->msyx", draws, changes).astype(np.float32)
    return np.asarray(samples + beyond)
