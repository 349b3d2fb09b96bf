"""Whether a fit's field may be believed: `Verdict`, `judged`.

χ² alone does not tell: one image, or several that the object displaces alike, can be explained
perfectly by a wrong field. What tells is whether other fields explain them as well.
"""

from __future__ import annotations

from collections.abc import Sequence
from enum import StrEnum

import numpy as np

from napari_shadowinv._typing import FloatArray

__all__ = ["Verdict", "judged"]

_FOLDED = 0.15  # of the pixels, in one image
# A fold that was found is deep; an answer that only should have one is squeezed flat there. The
# ratio is 3 to 10 for fields that come out well, 0 to 0.7 for those that do not.
_SQUEEZED, _FLAT, _MEETING, _DEEP = 0.01, 0.1, 0.2, 2.0
_MISFIT = 1.3  # χ²
_AS_GOOD = 0.03  # of the objective
_OTHER_FIELD = 0.05  # of the displacement, r.m.s.
_OPEN = 0.05  # of the displacement, r.m.s.
# Of a blob that the edge cuts, L2 error and this share: 1.5 % at 0.30, 25 % at 0.44; with a free
# edge 1.2 % at 0.61, 3.6 % at 0.88, 27 % at 0.97.
_AT_EDGE, _AT_FREE_EDGE = 0.3, 0.7


class Verdict(StrEnum):
    """What a fit's field is worth."""

    DETERMINED = "determined"
    SEVERAL = "one of several"
    AMBIGUOUS = "one image cannot tell"
    UNCERTAIN = "too uncertain"
    EDGE = "reaches the edge"
    MISFIT = "does not fit"


def judged(
    *,
    chi2: FloatArray,
    names: Sequence[str],
    others: Sequence[tuple[float, float]],
    single: bool,
    beam_unknown: bool,
    jacobian: FloatArray,
    folded: float,
    uncertainty: float,
    at_edge: float,
    edge_is_free: bool,
) -> tuple[Verdict, str]:
    """Return the verdict on a fit, and a sentence that says why.

    Parameters
    ----------
    chi2 : ndarray, shape (L,)
        Of each image.
    names : sequence of str
        What to call the images.
    others : sequence of (float, float)
        Other answers: how much worse their objective is, as a share, and how far away they are.
    single : bool
        Whether there is one image only, or several with the same information.
    beam_unknown : bool
        Whether the beam is fitted, too.
    jacobian : ndarray, shape (H, W)
        Determinant of the map to the image where it is folded most.
    folded : float
        Share of the pixels whose rays have crossed others, in the image where it is largest.
    uncertainty : float
        R.m.s. standard deviation of the displacement as a share of it; NaN if it is not known.
    at_edge : float
        Largest displacement at the image's edge as a share of the largest anywhere.
    edge_is_free : bool
        Whether the field was let go on beyond the edge.
    """
    worst = [
        f"{name} ({value:.2g})" for name, value in zip(names, chi2, strict=True) if value > _MISFIT
    ]
    if worst:
        return Verdict.MISFIT, (
            f"the forward model does not explain {', '.join(worst)}: χ² should be 1. The object "
            "may have changed between images; or energies, noise, source or point spread are not "
            "as given"
        )
    if single and beam_unknown:
        return Verdict.AMBIGUOUS, (
            "one image cannot tell the beam from the object: many pairs of them explain it; take "
            "another energy, or an image of the beam"
        )
    if single and folded > _FOLDED:
        return Verdict.AMBIGUOUS, (
            f"rays cross over {folded:.0%} of the image, and one image does not tell which came "
            "from where: the field may be wrong though the image is explained; take another energy"
        )
    if single and _is_squeezed(jacobian):
        return Verdict.AMBIGUOUS, (
            "rays meet or cross, and one image does not tell whether they have: the same bright "
            "lines come from a weaker field without folds and from a stronger one with them; take "
            "another energy"
        )
    rivals = [away for worse, away in others if worse < _AS_GOOD and away > _OTHER_FIELD]
    if rivals:
        return Verdict.SEVERAL, (
            f"{len(rivals) + 1} different fields explain the data about as well; they differ by "
            f"up to {max(rivals):.0%} (r.m.s.); take another energy, or compare them with what is "
            "known"
        )
    if uncertainty > _OPEN:
        return Verdict.UNCERTAIN, (
            f"the noise leaves {uncertainty:.0%} of the displacement open (r.m.s.): average "
            "shots, or take images at energies that differ more"
        )
    if at_edge > (_AT_FREE_EDGE if edge_is_free else _AT_EDGE):
        return Verdict.EDGE, (
            f"the field has {at_edge:.0%} of its peak at the image's edge, and what lies beyond "
            "bends it everywhere: record a larger field of view"
            + ("" if edge_is_free else ", or try a free edge (edge='free', --edge free)")
        )
    unchecked = "" if np.isfinite(uncertainty) else "; error bars were not worked out"
    several = "one image" if single else f"{len(chi2)} images"
    return Verdict.DETERMINED, (
        f"all starts lead to one field, which explains {several} to the noise (χ² "
        f"{np.min(chi2):.2f} to {np.max(chi2):.2f}){unchecked}"
    )


def _is_squeezed(jacobian: FloatArray) -> bool:
    """Whether rays nearly meet over much of an image without clearly crossing."""
    deep, flat = (jacobian < -_FLAT).sum(), (np.abs(jacobian) < _FLAT).sum()
    return bool((jacobian < _MEETING).mean() > _SQUEEZED and deep < _DEEP * flat)
