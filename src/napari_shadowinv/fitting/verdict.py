"""Whether a fit's field may be believed: `assess_verdict` returns its `Verdict`.

χ² alone does not show whether a field is right: one image, or several that the object displaces
alike, can be explained perfectly by a wrong field. The test is whether other fields explain them
as well. `hidden_contrast` finds masks that hide the structure that determines a field.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import ndimage

from napari_shadowinv._typing import BoolArray, FloatArray
from napari_shadowinv.facts import Verdict, to_figures
from napari_shadowinv.fitting.instrument import TITLES
from napari_shadowinv.fitting.measurements import NoiseMatch
from napari_shadowinv.fitting.pattern import SUSPECT_PATTERN, Pattern, noise_amplification
from napari_shadowinv.fitting.result import Fit
from napari_shadowinv.fitting.search import SMALL_PX
from napari_shadowinv.physics.edge import edge_doubt
from napari_shadowinv.physics.setup import deflector_titles
from napari_shadowinv.physics.units import shown_fields

_MIN_HOLE_RADIUS_PX = 6.0
_RIM_PX = 4
_SMOOTHED_PX = 1.0
_STRONGEST = 0.99  # quantile of the contrast, over the image


def hidden_contrast(contrast: FloatArray, used: BoolArray) -> float:
    """Return the contrast around the holes of a mask, as a share of the strongest.

    Parameters
    ----------
    contrast : ndarray, shape (L, H, W)
        Model images over their beams, minus 1.
    used : ndarray of bool, shape (L, H, W)
        The pixels that were fitted. A hole is where no image has any; smaller ones than 12 px are
        bridged by their surroundings.

    Returns
    -------
    float
        The largest of all images; 0 without holes.
    """
    used_anywhere = used.any(axis=0)
    # Holes begin where pixels are missing inside the image, not at its edge.
    depth = ndimage.distance_transform_edt(np.pad(~used_anywhere, 1))[1:-1, 1:-1]
    labels, _ = ndimage.label(~used_anywhere)
    wide = np.unique(labels[depth >= _MIN_HOLE_RADIUS_PX])
    hole = np.isin(labels, wide[wide > 0])
    if not hole.any():
        return 0.0
    rim = ndimage.binary_dilation(hole, iterations=_RIM_PX) & used_anywhere
    shares = []
    for image in contrast:
        strength = np.abs(ndimage.gaussian_filter(image, _SMOOTHED_PX))
        strongest = float(np.quantile(strength[used_anywhere], _STRONGEST))
        around = float(np.quantile(strength[rim], 0.9)) if rim.any() else 0.0
        shares.append(around / max(strongest, 1e-12))
    return max(shares)


MISFIT_CHI2 = 1.3
"""χ² of an image beyond which the model does not explain it."""
# Of rings that fold 14 % of one image, the found field was 20 % wrong with 7 to 10 % folded and χ²
# 0.93: where rays meet or cross, one image can be explained by fields of other folds.
_MEETING, _FEW = 0.2, 0.02  # Jacobian, and share of the object
_OBJECT = 0.1  # of the largest displacement
_NEARLY = 5.0  # χ² of a misfit by an edge alone
_TOO_QUIET = 0.4  # χ²; an estimated noise may be too large by a third
_AS_GOOD = 0.03  # of the objective
_OTHER_FIELD, _WITHIN_TOTALS = 0.05, 2.0  # of the displacement, r.m.s., and of its stated error
_OPEN = 0.05  # of the displacement, r.m.s.
_LOST = 0.01  # of the rays
# Of 60 fits on 96 px, the r.m.s. ratio of error to total was 1.0, with a transmission 1.3; of 60 on
# 64 px the largest was 3.9, of one on 200 px with a blur 3.0.
# Of 14 with an unknown beam it was up to 3.2 where momenta are close; of beams that differ between
# energies the r.m.s. ratio was 1.2, of weak rings 1.4.
_UNDERESTIMATED = {"blur", "gamma", "absorption"}
_SAFETY = 2.0
_MEASURE = "measure the {}, or add an image at another energy, which shows more of it"
_ADVICE = {
    "noise": "average shots, or take images at energies that differ more",
    "other_field": "fit both fields, with images at more energies",
    "registration": "align the images by marks on each of them",
    "edge": "record a larger field of view",
}
_HIDDEN_STRUCTURE = 0.5  # of the strongest contrast


def assess_verdict(
    fit: Fit,
    pattern: Pattern,
    jacobian: FloatArray,
    *,
    single: bool,
    beam_unknown: bool,
    hidden: float,
    searched: bool = True,
    noise: NoiseMatch | None = None,
) -> tuple[Verdict, str]:
    """Return the verdict on a fit, and a sentence that says why.

    Parameters
    ----------
    fit : Fit
        All else about it; its own verdict does not matter.
    pattern : Pattern
        Structure in the residuals.
    jacobian : ndarray, shape (H, W)
        Determinant of the map to the image where it is folded most.
    single : bool
        Whether there is one image only, or several with the same information.
    beam_unknown : bool
        Whether the beam is fitted, too.
    hidden : float
        Contrast around the mask's holes as a share of the strongest; see `hidden_contrast`.
    searched : bool, default True
        Whether the fit has started from several fields.
    noise : NoiseMatch, optional
        The noise of the images against the one that is given or estimated.
    """
    report, chi2, used = fit.report, fit.chi2, fit.used
    total, parts = report.total, report.parts
    max_error = fit.options.max_error
    displacement = np.sum([field.displacement for field in fit.fields], axis=0)
    names = [f"image {k + 1}" for k in range(len(chi2))]
    if fit.setups:
        pairs = zip(names, fit.setups, strict=True)
        names = [f"{name} ({setup.probe})" for name, setup in pairs]
    by_edge = parts.get("edge", 0.0)
    others = float(np.sqrt(max(report.total**2 - by_edge**2, 0.0)))
    at_edge = edge_doubt(by_edge, others, max_error, report.sides)
    if worst := _those(names, chi2, chi2 > MISFIT_CHI2):
        causes = "noise, source (uniform, measured or unknown) or point spread may be wrong"
        if len(chi2) > 1:
            causes = f"the object may have changed between images, or energies, {causes}"
        causes = _cause_text(pattern) or causes
        # An object that the edge cuts is explained by nothing within it, but nearly.
        is_near = chi2.max() < _NEARLY and not pattern.cause
        verdict = Verdict.EDGE if at_edge and is_near else Verdict.MISFIT
        misfit = f"the forward model does not explain {worst}, where 1 is expected"
        return verdict, f"{misfit}: {causes if verdict is Verdict.MISFIT else at_edge}"
    if single and beam_unknown:
        return Verdict.AMBIGUOUS, (
            "one image cannot tell the beam from the object: many pairs of them explain it; take "
            "another energy, or an image of the beam"
        )
    if pattern.cause and not pattern.is_certain:
        return Verdict.MISFIT, f"the images do not look like the model: likely {pattern.cause}"
    if single and (lost := _share_lost(displacement)) > _LOST:
        return Verdict.AMBIGUOUS, (
            f"the object sends {lost:.0%} of the rays past the image, and one image does not show "
            "which; record a larger field of view, or take another energy"
        )
    if single and (meeting := _share_squeezed(jacobian, displacement, _MEETING)) > _FEW:
        return Verdict.AMBIGUOUS, (
            f"rays meet or cross over {meeting:.0%} of the object, and one image does not show "
            "which came from where: the same bright lines come from fields with other folds; take "
            "another energy"
        )
    if pattern.is_certain:
        # An object that the edge cuts leaves a pattern, too.
        verdict = Verdict.EDGE if at_edge else Verdict.MISFIT
        return verdict, "; ".join(filter(None, [at_edge, _pattern_text(pattern, names)]))
    if pattern.lacks_counts and pattern.missing_counts > _OPEN:
        share = f"{pattern.missing_counts:.0%}"
        return Verdict.UNCERTAIN, (
            f"the noise is {share} smaller than that of as many counts: a dark level of about "
            f"{share} seems to be left in the images, or the detector's response is not linear, "
            "and either weakens the field; subtract the dark level from images and source, "
            "linearise the images, or, if the counts were averaged, scaled or "
            "smoothed, give their noise"
        )
    if at_edge:
        return Verdict.EDGE, at_edge
    best, *alternatives = fit.basins
    rivals = [
        basin.distance
        for basin in alternatives
        if basin.objective / best.objective - 1 < _AS_GOOD
        and basin.distance > max(_OTHER_FIELD, _WITHIN_TOTALS * total)
    ]
    if rivals:
        return Verdict.SEVERAL, (
            f"{len(rivals) + 1} different fields explain the data about as well; they differ by "
            f"up to {max(rivals):.0%} (r.m.s.); take another energy, or compare them with what is "
            "known"
        )
    is_small = min(used.shape) < SMALL_PX
    # That of one image, or of a recorded source, is a linear response.
    numbers = {key for key, share in parts.items() if share} - {"noise", "edge"}
    numbers -= {each.key for each, _ in report.assumed}
    is_fitted = fit.instrument.has_numbers or report.beam is None
    is_unsure = bool(numbers) and is_fitted and (is_small or _UNDERESTIMATED & numbers)
    safety = 1.0
    if beam_unknown or (fit.instrument.beam_between and not single):
        safety = _SAFETY
    elif is_unsure:
        fitted = sum(parts[key] ** 2 for key in numbers) / total**2
        safety = float(np.sqrt(1 + (_SAFETY**2 - 1) * min(fitted, 1.0)))
    condition = fit.condition(max_error / safety, beam_unknown=beam_unknown)
    if not condition and safety * total > max_error:
        ranking = ", ".join(f"{TITLES[key]} {share:.1%}" for key, share in parts.items())
        text = f"errors of {total:.1%} of the displacement (r.m.s.): {ranking}; "
        if total <= max_error:
            small = f"with fewer than {SMALL_PX} px along a side"
            where = small if is_small else "where these are fitted"
            text += f"{where}, errors can be {safety:.2g} times as large; "
        return Verdict.UNCERTAIN, (
            f"{text}{_ADVICE.get(next(iter(parts)), _MEASURE).format(TITLES[next(iter(parts))])}"
        )
    if single and noise is not None and noise.is_hidden:
        return Verdict.UNCERTAIN, (
            "the noise was not measured: structure fills the image, and noise that is correlated "
            "over a few pixels looks like it; give the noise, and its correlation if the image was "
            "smoothed or resampled"
        )
    if not report.converged:
        return Verdict.UNCERTAIN, (
            "the search reached its maximum number of iterations before it ended: allow more"
        )
    if hidden > _HIDDEN_STRUCTURE:
        return Verdict.UNCERTAIN, (
            f"the mask hides part of the object where its image has {hidden:.0%} of its strongest "
            "contrast: folds beneath were not seen, the field there is the smoothest that the "
            "surroundings allow, and the error bars do not include that; unmask what is sound, or "
            "add an image in which it is seen"
        )
    if condition and safety * total > max_error:
        setup, field = fit.setup, fit.fields[0]
        deflector = deflector_titles()[field.name]
        (shown,) = shown_fields([field.displacement], setup, deflector, mask=used)
        is_detector = condition.subject == "detector"
        verdict = Verdict.DETECTOR if is_detector else Verdict.CONDITIONAL
        return verdict, shown.conditional_text(condition)
    unchecked = "" if np.isfinite(total) else "; error bars were not worked out"
    if pattern.correlation > 0:
        unchecked += (
            f"; the noise is correlated over {pattern.correlation:.1f} px, which makes the error "
            f"bars {noise_amplification(pattern.correlation):.1f} times as large as for white noise"
        )
    if quiet := _those(names, chi2, chi2 < _TOO_QUIET):
        unchecked += f"; the noise is stated too large ({quiet}), and so are the error bars"
    elif noise is not None and noise.stated_times > 1:
        unchecked += f"; the noise was stated {noise.stated_times:.1f} times too large"
        unchecked += ", so the measured one was used"
    several = "one image" if single else f"{len(chi2)} images"
    starts = "all starts lead to" if searched else "the given start leads to"
    unchecked += "" if searched else "; alternative solutions were not looked for"
    return Verdict.DETERMINED, (
        f"{starts} one field, which explains {several} to the noise (χ² "
        f"{np.min(chi2):.2f} to {np.max(chi2):.2f}){unchecked}"
    )


def _pattern_text(pattern: Pattern, names: Sequence[str]) -> str:
    """The images whose residual has structure, and its likeliest cause."""
    patterned = [
        f"{name}: {strength:.0f}"
        for name, strength in zip(names, pattern.strengths, strict=True)
        if strength > SUSPECT_PATTERN
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


def _share_squeezed(jacobian: FloatArray, displacement: FloatArray, least: float) -> float:
    """The share of an object, where it displaces rays, with less of a Jacobian."""
    size = np.hypot(*displacement)
    return float((jacobian < least).sum() / max((size > _OBJECT * size.max()).sum(), 1))


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
