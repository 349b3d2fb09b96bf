"""Whether a fit's field may be believed: `assess_verdict` returns its `Verdict`.

χ² alone does not show whether a field is right: one image, or several that the object displaces
alike, can be explained perfectly by a wrong field. The test is whether other fields explain them
as well. `hidden_contrast` finds masks that hide the structure that determines a field.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from napari_shadowinv._typing import BoolArray, FloatArray
from napari_shadowinv.facts import Assessment, Verdict, assess, percent, to_figures
from napari_shadowinv.fitting.noise_match import NoiseMatch
from napari_shadowinv.fitting.pattern import Pattern, noise_amplification
from napari_shadowinv.fitting.result import Fit
from napari_shadowinv.fitting.search import SMALL_PX
from napari_shadowinv.physics.edge import LARGER_FIELD, beyond_sides
from napari_shadowinv.physics.units import Condition


def hidden_contrast(
    contrast: FloatArray,
    used: BoolArray,
    *,
    radius: float = 6.0,
    rim_width: int = 4,
    smoothing: float = 1.0,
) -> float:
    """Return the contrast around the holes of a mask, as a share of the strongest; 0 without holes.

    The contrast (L, H, W) is between model images and their beams, the largest of all images
    counts. A hole is where no image has a pixel that was fitted; holes of a smaller `radius` in px
    are bridged by their surroundings. A rim of `rim_width` px around a hole is looked at;
    `smoothing` is the standard deviation of a blur of the contrast, px.
    """
    used_anywhere = used.any(axis=0)
    # Holes begin where pixels are missing inside the image, not at its edge.
    depth = ndimage.distance_transform_edt(np.pad(~used_anywhere, 1))[1:-1, 1:-1]
    labels, _ = ndimage.label(~used_anywhere)
    wide = np.unique(labels[depth >= radius])
    hole = np.isin(labels, wide[wide > 0])
    if not hole.any():
        return 0.0
    rim = ndimage.binary_dilation(hole, iterations=rim_width) & used_anywhere
    shares = []
    for image in contrast:
        strength = np.abs(ndimage.gaussian_filter(image, smoothing))
        strongest = float(np.quantile(strength[used_anywhere], 0.99))
        around = float(np.quantile(strength[rim], 0.9)) if rim.any() else 0.0
        shares.append(around / max(strongest, 1e-12))
    return max(shares)


_UNDERESTIMATED = {"blur", "gamma", "absorption"}


@dataclass(frozen=True)
class VerdictLimits:
    """Limits of the rules, as benchmarks/trust.py shows them to be needed.

    Of rings that fold 14 % of one image, the found field was 20 % wrong with 7 to 10 % folded and
    χ² 0.93: where rays meet or cross, one image can be explained by fields of other folds. Of
    60 fits of one image, of objects whose steepest displacement has slopes of 0.85 to 1.3 and whose
    rays meet in up to 50 % of the object, no field was wrong; 0.02 refused unfolded objects.

    Of 60 fits with a fitted instrument on 96 px, the r.m.s. ratio of error to total was 1.0, with a
    transmission 1.3; of 60 on 64 px the largest was 3.9, of one on 200 px with a blur 3.0. Of 14
    with an unknown beam it was up to 3.2 where momenta are close; of beams that differ between
    energies the r.m.s. ratio was 1.2, of weak rings 1.4: hence the safety.
    """

    misfit_chi2: float = 1.3  # of an image that the model does not explain
    chi2_at_edge: float = 5.0  # of a misfit by an edge alone
    quiet_chi2: float = 0.4  # an estimated noise may be too large by a third
    as_good: float = 0.03  # of the objective
    other_field: float = 0.05  # of the displacement, r.m.s.
    within_totals: float = 2.0  # of other fields, in stated errors
    missing_counts: float = 0.05
    lost_rays: float = 0.01
    meeting: float = 0.2  # Jacobian
    few: float = 0.04  # share of the object in which rays meet
    hidden: float = 0.5  # of the strongest contrast
    safety: float = 2.0


@dataclass(frozen=True, eq=False)
class Evidence:
    """Evidence for the verdict on a fit, whose own verdict does not matter."""

    fit: Fit
    pattern: Pattern  # in the residuals
    jacobian: FloatArray  # (H, W), determinant of the map to the image where it is folded most
    single: bool  # one image, or several with the same information
    beam_unknown: bool  # it is fitted, too
    hidden: float  # as `hidden_contrast` returns it
    searched: bool = True  # whether the fit has started from several fields
    noise: NoiseMatch | None = None
    limits: VerdictLimits = VerdictLimits()

    @property
    def names(self) -> list[str]:
        """Names of the images in sentences."""
        names = [f"image {k + 1}" for k in range(len(self.fit.chi2))]
        if not self.fit.setups:
            return names
        pairs = zip(names, self.fit.setups, strict=True)
        return [f"{name} ({setup.probe})" for name, setup in pairs]

    @property
    def displacement(self) -> FloatArray:
        """Displacement by all fields."""
        return np.asarray(np.sum([field.displacement for field in self.fit.fields], axis=0))

    @property
    def at_edge(self) -> str:
        """Why an object beyond the edge may matter; "" if it does not."""
        errors = self.fit.errors
        caution = errors and errors.edge_caution(self.fit.options.max_error)
        return caution.text if caution else ""

    @property
    def is_small(self) -> bool:
        """Whether errors of numbers come out too small for want of pixels."""
        return bool(min(self.fit.used.shape) < SMALL_PX)

    @property
    def safety(self) -> float:
        """How many times as large as stated the errors can be."""
        fit, errors, limit = self.fit, self.fit.errors, self.limits.safety
        if errors is None or self.beam_unknown or (fit.instrument.beam_between and not self.single):
            return limit
        # That of one image, or of a recorded source, is a linear response.
        parts = errors.shares
        numbers = {title for title, share in parts.items() if share} - {"noise", "edge"}
        numbers -= {name.partition(",")[0] for name in errors.assumed}
        is_fitted = fit.instrument.has_numbers or errors.beam_sensitivity is None
        if not (numbers and is_fitted and (self.is_small or _UNDERESTIMATED & numbers)):
            return 1.0
        fitted = sum(parts[title] ** 2 for title in numbers) / errors.share**2
        return float(np.sqrt(1 + (limit**2 - 1) * min(fitted, 1.0)))

    @property
    def condition(self) -> Condition | None:
        """Condition on which the errors are small, if there is one."""
        errors, max_error = self.fit.errors, self.fit.options.max_error / self.safety
        return None if errors is None else errors.condition(max_error)

    @property
    def is_too_uncertain(self) -> bool:
        """Whether the errors may be larger than allowed."""
        total = self.fit.total_error
        return total is not None and self.safety * total > self.fit.options.max_error


Answer = Assessment | None


def assess_verdict(evidence: Evidence) -> Assessment:
    """Return the assessment of a fit by the first rule that applies."""
    return assess(evidence, (*_RULES, _determined))


def _not_explained(case: Evidence) -> Answer:
    chi2, pattern = case.fit.chi2, case.pattern
    misfits = chi2 > case.limits.misfit_chi2
    if not misfits.any():
        return None
    causes = "noise, source (uniform, measured or unknown) or point spread may be wrong"
    if len(chi2) > 1:
        causes = f"the object may have changed between images, or energies, {causes}"
    causes = _cause_text(pattern) or causes
    # An object that the edge cuts is explained by nothing within it, but nearly.
    if case.at_edge and chi2.max() < case.limits.chi2_at_edge and not pattern.cause:
        verdict, causes = Verdict.EDGE, case.at_edge
    else:
        verdict = Verdict.MISFIT
    worst = case.names[int(np.argmax(chi2))]
    return Assessment(
        verdict,
        f"the model does not explain {worst} (χ² {to_figures(chi2.max())})",
        _short_cause(case) if verdict is Verdict.MISFIT else LARGER_FIELD,
        f"the forward model does not explain {_those(case.names, chi2, misfits)}, where 1 is "
        f"expected: {causes}",
    )


def _beam_or_object(case: Evidence) -> Answer:
    if not (case.single and case.beam_unknown):
        return None
    return _doubt(
        Verdict.AMBIGUOUS,
        "one image cannot tell the beam from the object",
        "many pairs of them explain it",
        "take another energy, or an image of the beam",
    )


def _likely_cause(case: Evidence) -> Answer:
    if not case.pattern.cause or case.pattern.is_certain:
        return None
    reason = "the images do not look like the model"
    why = f"{reason}: likely {case.pattern.cause}"
    return Assessment(Verdict.MISFIT, reason, _short_cause(case), why)


def _rays_lost(case: Evidence) -> Answer:
    if not case.single or (lost := _share_lost(case.displacement)) <= case.limits.lost_rays:
        return None
    return _doubt(
        Verdict.AMBIGUOUS,
        f"{percent(lost)} of the rays miss the image",
        "one image does not show which",
        "record a larger field of view, or another energy",
    )


def _rays_meet(case: Evidence) -> Answer:
    if not case.single:
        return None
    meeting = _share_squeezed(case.jacobian, case.displacement, case.limits.meeting)
    if meeting <= case.limits.few:
        return None
    return _doubt(
        Verdict.AMBIGUOUS,
        f"rays meet or cross over {percent(meeting)} of the object",
        "one image does not show which came from where, and the same bright lines come from fields "
        "with other folds",
        "take another energy",
    )


def _pattern_left(case: Evidence) -> Answer:
    if not case.pattern.is_certain:
        return None
    pattern_text = _pattern_text(case.pattern, case.names)
    if case.at_edge:  # an object that the edge cuts leaves a pattern, too
        return _cut_by_edge(case, f"{case.at_edge}; {pattern_text}")
    reason = "the residual has a pattern"
    return Assessment(Verdict.MISFIT, reason, _short_cause(case), pattern_text)


def _counts_missing(case: Evidence) -> Answer:
    pattern = case.pattern
    if not pattern.lacks_counts() or pattern.missing_counts <= case.limits.missing_counts:
        return None
    share = percent(pattern.missing_counts)
    return _doubt(
        Verdict.UNCERTAIN,
        f"the noise is {share} below that of counts",
        f"either a dark level of about {share} is left in images and source, or the response is "
        "not linear, both of which weaken the field, or the counts were averaged, scaled or "
        "smoothed",
        "subtract the dark level, or give the noise",
    )


def _beyond_edge(case: Evidence) -> Answer:
    return _cut_by_edge(case, case.at_edge) if case.at_edge else None


def _other_answers(case: Evidence) -> Answer:
    (best, *alternatives), limits = case.fit.basins, case.limits
    least = max(limits.other_field, limits.within_totals * (case.fit.total_error or 0.0))
    rivals = [
        basin.distance
        for basin in alternatives
        if basin.objective / best.objective - 1 < limits.as_good and basin.distance > least
    ]
    if not rivals:
        return None
    return _doubt(
        Verdict.SEVERAL,
        f"{len(rivals) + 1} fields, up to {percent(max(rivals))} apart, explain the data as well",
        "compare them with prior knowledge",
        "take another energy",
    )


def _errors_large(case: Evidence) -> Answer:
    if case.condition or not case.is_too_uncertain:
        return None
    explanation = ""
    if (case.fit.total_error or 0.0) <= case.fit.options.max_error:
        small = f"with fewer than {SMALL_PX} px along a side"
        where = small if case.is_small else "where these are fitted"
        explanation = f"{where}, errors can be {case.safety:.2g} times as large"
    return Assessment(Verdict.UNCERTAIN, _limited(case), case.fit.next_step, explanation)


def _search_unfinished(case: Evidence) -> Answer:
    if case.fit.report.converged:
        return None
    reason = f"not converged in {case.fit.report.iterations} steps"
    return Assessment(Verdict.UNCERTAIN, reason, "allow more")


def _object_masked(case: Evidence) -> Answer:
    if case.hidden <= case.limits.hidden:
        return None
    return _doubt(
        Verdict.UNCERTAIN,
        "the mask hides part of the object",
        f"its image has {percent(case.hidden)} of its strongest contrast there; folds beneath were "
        "not seen, the field there is the smoothest that the surroundings allow, and the error "
        "bars do not include that",
        "unmask it, or add an image",
    )


def _conditional(case: Evidence) -> Answer:
    condition, fit = case.condition, case.fit
    if not condition or not case.is_too_uncertain:
        return None
    (worst, *_) = (field for field in fit.fields if field.errors is fit.errors)
    return fit.shown(worst).conditional(condition)


_RULES = (
    _not_explained,
    _beam_or_object,
    _likely_cause,
    _rays_lost,
    _rays_meet,
    _pattern_left,
    _counts_missing,
    _beyond_edge,
    _other_answers,
    _errors_large,
    _search_unfinished,
    _object_masked,
    _conditional,
)


def _doubt(verdict: Verdict, reason: str, detail: str, advice: str) -> Assessment:
    return Assessment(verdict, reason, advice, f"{reason}: {detail}; {advice}")


def _limited(case: Evidence) -> str:
    return "" if case.fit.errors is None else case.fit.errors.limit


def _cut_by_edge(case: Evidence, explanation: str) -> Assessment:
    reason = f"the object goes on {beyond_sides(case.fit.errors.sides if case.fit.errors else ())}"
    return Assessment(Verdict.EDGE, reason, LARGER_FIELD, explanation)


def _short_cause(case: Evidence) -> str:
    cause = case.pattern.cause.partition(":")[0]
    return f"likely {cause}" if cause else "check noise, source and point spread"


def _determined(case: Evidence) -> Assessment:
    fit, pattern, noise, chi2 = case.fit, case.pattern, case.noise, case.fit.chi2
    unchecked = "" if fit.errors else "; error bars were not worked out"
    if pattern.correlation > 0:
        unchecked += (
            f"; the noise is correlated over {pattern.correlation:.1f} px, which makes the error "
            f"bars {noise_amplification(pattern.correlation):.1f} times as large as for white noise"
        )
    if quiet := _those(case.names, chi2, chi2 < case.limits.quiet_chi2):
        unchecked += f"; the noise is stated too large ({quiet}), and so are the error bars"
    elif noise is not None and noise.stated_times > 1:
        unchecked += f"; the noise was stated {noise.stated_times:.1f} times too large"
        unchecked += ", so the measured one was used"
    several = "one image" if case.single else f"{len(chi2)} images"
    starts = "all starts lead to" if case.searched else "the given start leads to"
    unchecked += "" if case.searched else "; alternative solutions were not looked for"
    return Assessment(
        Verdict.DETERMINED,
        _limited(case) or "error bars were not worked out",
        "",
        f"{starts} one field, which explains {several} to the noise (χ² "
        f"{np.min(chi2):.2f} to {np.max(chi2):.2f}){unchecked}",
    )


def _pattern_text(pattern: Pattern, names: Sequence[str]) -> str:
    """The images whose residual has structure, and its likeliest cause."""
    patterned = [
        f"{name}: {strength:.0f}"
        for name, strength in zip(names, pattern.strengths, strict=True)
        if strength > pattern.suspect
    ]
    cause = _cause_text(pattern) or (
        "source, brightness, point spread, dark level or registration may be wrong, or the "
        "object absorbs"
    )
    return (
        f"the residual is no noise: smoothed, it stands out by {'; '.join(patterned)} standard "
        f"deviations, so the field may be wrong by many times its error bars: {cause}"
    )


def _cause_text(pattern: Pattern) -> str:
    """The likeliest cause of a misfit, or all that do not explain it; "" if none was tried."""
    if pattern.cause:
        return f"likely {pattern.cause}"
    return pattern.tried and f"not explained by {pattern.tried}"


def _share_squeezed(
    jacobian: FloatArray, displacement: FloatArray, least: float, part: float = 0.1
) -> float:
    """The share of an object, `part` of the largest displacement, with less of a Jacobian."""
    size = np.hypot(*displacement)
    return float((jacobian < least).sum() / max((size > part * size.max()).sum(), 1))


def _share_lost(displacement: FloatArray) -> float:
    """The share of the rays from an image's pixels that miss it."""
    landed = np.indices(displacement.shape[1:]) + displacement
    sides = np.array(displacement.shape[1:])[:, None, None]
    return float(((landed < -0.5) | (landed > sides - 0.5)).any(axis=0).mean())


def _those(names: Sequence[str], chi2: FloatArray, which: BoolArray) -> str:
    rows = zip(names, chi2, which, strict=True)
    return "; ".join(
        f"{name}: χ² {to_figures(value)}" for name, value, is_listed in rows if is_listed
    )
