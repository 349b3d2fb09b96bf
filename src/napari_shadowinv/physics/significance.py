"""How far a field stands above its standard deviation, pixel by pixel and in structures.

- standard deviation of the length of the displacement: `deviation_along`
- the map |d|/σ: `significance`
- connected regions that errors alone do not explain: `find_structures`
- all of it in words: `significance_facts`
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from napari_shadowinv._typing import BoolArray, FloatArray
from napari_shadowinv.facts import Fact, Level, percent, to_figures

LEVEL = 2.0
"""Standard deviations at which the border of a structure lies."""


@dataclass(frozen=True, eq=False)
class Structures:
    """Connected regions in which a field stands above its standard deviation."""

    labels: NDArray[np.int32]  # (H, W), number of the structure, 1 the most significant; 0 outside
    peaks: tuple[float, ...]  # largest significance in each, in the same order
    share: float  # of the used pixels, that lies in a structure
    largest: float  # significance of any used pixel
    limit: float  # significance that errors alone exceed somewhere with a probability of 5 %
    n_pixels: int  # used ones


def deviation_along(displacement: FloatArray, std: FloatArray) -> FloatArray:
    """Return the standard deviation of the length of a displacement, (2, ...), in its unit.

    The errors of its components count as independent, to first order. 0 where the displacement is
    0, for which there is no direction.

    >>> deviation_along(np.array([3.0, 4.0]), np.array([0.5, 0.5])).item()
    0.5
    """
    length = np.hypot(*displacement)
    across = np.hypot(*(displacement * std))
    return np.asarray(np.divide(across, length, out=np.zeros_like(length), where=length > 0))


def significance(displacement: FloatArray, std: FloatArray) -> FloatArray:
    """Return how many standard deviations a displacement, (2, ...), is away from zero, |d|/σ.

    For errors alone, with independent normal components, it exceeds u with a probability of at most
    exp(-u²/2): 14 % for 2, for which a component alone would have 5 %. It is 0 where the
    displacement is 0; infinite where it is not, but has no error; NaN where it, or its error, is
    NaN.

    >>> significance(np.array([3.0, 4.0]), np.array([0.5, 0.5])).item()
    10.0
    """
    length, deviation = np.hypot(*displacement), deviation_along(displacement, std)
    exact = np.where(length > 0, np.inf, length)
    ratio = np.divide(length, deviation, out=np.asarray(exact), where=deviation > 0)
    return np.where(np.isnan(length + std.sum(axis=0)), np.nan, ratio)


def find_structures(
    significant: FloatArray,
    mask: BoolArray | None = None,
    *,
    element: float = 1.0,
    false_alarm: float = 0.05,
    least_elements: float = 9,
) -> Structures:
    """Find the connected regions that stand above 2 σ and are not due to errors alone.

    Among many pixels, errors alone take some far above 2 σ, and since they are correlated these
    form patches. A region of the map of `significance`, (H, W), is a structure if it contains a
    pixel above the level that errors alone exceed somewhere in the image with a probability of 5 %,
    √(2 ln(20 n)) for n pixels (4.4 σ for 1,000, 5.5 σ for a million), and covers at least nine
    resolution elements, such as the areas of sites, in px. The level holds whether or not the
    errors of pixels are correlated.
    """
    from scipy.ndimage import label

    used = ~np.isnan(significant) & (True if mask is None else mask)
    n_pixels = int(used.sum())
    limit = math.sqrt(2 * math.log(max(n_pixels, 1) / false_alarm))
    regions, count = label(used & (significant > LEVEL), structure=np.ones((3, 3)))
    peaks = np.zeros(count + 1)
    np.maximum.at(peaks, regions, np.where(regions > 0, significant, 0.0))
    sizes = np.bincount(regions.ravel(), minlength=count + 1)
    # Small images of few sites are one structure at most.
    smallest = min(least_elements * element, n_pixels / 2)
    is_structure = (peaks > limit) & (sizes >= smallest)
    is_structure[0] = False
    ranked = np.flatnonzero(is_structure)
    ranked = ranked[np.argsort(-peaks[ranked], kind="stable")]
    numbers = np.zeros(count + 1, dtype=np.int32)
    numbers[ranked] = np.arange(1, len(ranked) + 1)
    labels = numbers[regions]
    return Structures(
        labels=labels,
        peaks=tuple(float(peak) for peak in peaks[ranked]),
        share=float((labels > 0).sum() / max(n_pixels, 1)),
        largest=float(significant[used].max(initial=0.0)),
        limit=limit,
        n_pixels=n_pixels,
    )


def structures_of(
    displacement: FloatArray,
    std: FloatArray | None,
    mask: BoolArray | None = None,
    *,
    element: float = 1.0,
) -> Structures | None:
    """Return the structures of a displacement, see `find_structures`; None without its error."""
    if std is None:
        return None
    return find_structures(significance(displacement, std), mask, element=element)


def significance_facts(
    structures: Structures | None,
    causes: Sequence[str],
    *,
    key: str = "significance",
    name: str = "",
) -> list[Fact]:
    """Return the structures of a field in words; none without structures.

    The causes are the errors that the standard deviation holds, such as "noise" and "beam, 5 %",
    empty if they are not known; a name stands for one of several fields.
    """
    if structures is None:
        return []
    by_causes = f" (σ by {'; '.join(causes)})" if causes else ""
    title = f"Significance {name}".strip()
    if structures.peaks:
        count = len(structures.peaks)
        subject = "1 structure stands" if count == 1 else f"{count} structures stand"
        strongest = structures.peaks[0]
        peak = f"up to {strongest:.3g} σ" if math.isfinite(strongest) else "without any error"
        text = f"{subject} above {LEVEL:g} σ, on {percent(structures.share)} of the pixels"
        return [Fact(key, title, f"{text}, {peak}{by_causes}")]
    text = f"no structure stands above {LEVEL:g} σ{by_causes}"
    if structures.largest > structures.limit:
        reason = f"{structures.largest:.3g} σ are reached, but by a few pixels only"
    elif structures.largest > LEVEL:
        reason = (
            f"the field reaches {to_figures(structures.largest)} σ, errors alone up to "
            f"{to_figures(structures.limit)} σ among {structures.n_pixels:,} pixels"
        )
    else:
        reason = f"the field reaches {to_figures(structures.largest)} σ"
    return [Fact(key, title, f"{text}: {reason}", Level.DOUBTFUL)]
