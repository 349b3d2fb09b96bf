"""From a blurred image to the sharp one.

Damped Newton steps from zero weights fail where the image jumps: between bright and dark a
cell's flux is no smooth function of the weights, and cells in the dark must be kept from
emptying. Blur the image enough and they succeed; and the weights depend almost linearly on the
width of the blur, so the line through two solutions is a start for the next, narrower one.
That holds for widths below a pixel, too, where the pixels are split before the blur: else each
row of cells that passes a pixel's edge bends the way.

- solve one level for any image: `sharpen`
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache
from typing import NamedTuple

import numpy as np
from scipy.fft import dctn, idctn

from napari_shadowinv._system.machine import available_threads
from napari_shadowinv._system.progress import Reporter
from napari_shadowinv._typing import FloatArray
from napari_shadowinv.geometry.density import split_pixels
from napari_shadowinv.transport.minimise import newton, with_full_cells
from napari_shadowinv.transport.objective import Solution, TransportObjective
from napari_shadowinv.transport.sites import Level

__all__ = ["blurred", "sharpen"]

Soften = Callable[[Level, float, int], TransportObjective]

_MAX_BLUR_SHARE = 1 / 6  # of the image's longer side
_SHARP_BLUR_SPACINGS = 0.5  # in site spacings: from there the sharp image is tried
_RETRY_RATIO = 4.0  # times less blur before the sharp image is tried again
_MIN_BLUR_PX = 1e-3
_MIN_BLUR_RATIO = 1.02
_PATH_TOLERANCE = 0.3  # a blurred image's solution only has to start the next
_SHORTEST_STEP = 1e-2
_MAX_BLUR_IN_PIXELS = 16.0  # wider blurs are computed on means of pixels
_MIN_BLUR_IN_PIXELS = 1.5  # smallest blur, in pixels, that hides them
_MAX_PARTS = 8  # of a pixel's side
_MAX_PIXELS = 2**22  # after splitting
_SHARES_OF_PREDICTION = (1.0, 0.5, 0.25)
_MIN_PREDICTED_SHARE = 1e-2  # of the smallest flux to reach


def blurred(image: FloatArray, width: float, threads: int | None = 1) -> FloatArray:
    """Blur a positive image by a standard deviation in px, mirrored at the border.

    The kernel is the discrete Gaussian (T. Lindeberg, IEEE Trans. Pattern Anal. Mach. Intell. 12,
    234, 1990), which has no negative lobes at any width; the sum stays. For a wide blur, the means
    of squares much smaller than its width are blurred instead of pixels.
    """
    height, breadth = image.shape
    parts = max(1, int(width / _MAX_BLUR_IN_PIXELS))
    means = _means(image, parts)
    workers = available_threads(threads)
    spectrum = dctn(means, workers=workers)
    for axis in (0, 1):
        waves = np.pi * np.arange(means.shape[axis]) / means.shape[axis]
        damping = np.exp(-((width / parts) ** 2) * (1 - np.cos(waves)))
        spectrum *= np.expand_dims(damping, 1 - axis)
    few = np.maximum(idctn(spectrum, workers=workers), means.min())
    diffused: FloatArray = split_pixels(few, parts)[:height, :breadth]
    diffused *= image.sum() / diffused.sum()
    return diffused


def _means(image: FloatArray, parts: int) -> FloatArray:
    """Return the means of squares of pixels; the last pixels are repeated beyond the border."""
    height, width = image.shape
    padded = np.pad(image, ((0, -height % parts), (0, -width % parts)), mode="edge")
    rows = sum((padded[k::parts] for k in range(parts)), start=np.zeros(()))
    return sum((rows[:, k::parts] for k in range(parts)), start=np.zeros(())) / parts**2


def sharpen(
    level: Level,
    sharp: TransportObjective,
    soften: Soften,
    *,
    tolerance: float,
    max_iterations: int,
    report: Reporter | None = None,
) -> Solution:
    """Solve one level from zero weights by following the solution from a blurred image.

    `soften` makes the objective for the level of split pixels, the blur in those pixels, and the
    parts of a pixel's side (see `Level.split`). The limit of iterations covers all images together.
    If the sharp image cannot be solved, the solution of the sharpest solved image is returned and
    the reason names its blur; if the sharp image was nearly solved, that solution is returned.
    """
    solved: list[_Solved] = []
    nearest: Solution | None = None
    width: float | None = _MAX_BLUR_SHARE * max(level.shape)
    sharp_below = _SHARP_BLUR_SPACINGS * level.spacing
    split = cache(level.split)
    steps = 0
    while width is not None and steps < max_iterations:
        parts = _parts(width, level.shape)
        objective = soften(split(parts), parts * width, parts) if width else sharp
        # weights are squares of lengths
        before = [_Solved(earlier.width, parts**2 * earlier.weights) for earlier in solved[-2:]]
        for start in _starts(objective, split(parts), width, before):
            solution = newton(
                objective,
                start,
                tolerance=_PATH_TOLERANCE if width else tolerance,
                max_iterations=max_iterations - steps,
                shortest_step=_SHORTEST_STEP,
                report=report,
            )
            steps += solution.iterations
            if not width and (nearest is None or solution.residual < nearest.residual):
                nearest = solution
            if solution.converged or steps >= max_iterations:
                break
        if solution.converged and not width:
            return replace(solution, iterations=steps)
        if solution.converged:
            solved.append(_Solved(width, solution.weights / parts**2))
        if solved and not width:
            sharp_below = solved[-1].width / _RETRY_RATIO
        width = _next_width(width, solved, level, sharp_below, converged=solution.converged)
    answer = _blurred_solution(sharp, solved, level, tolerance)
    used_up = f"the solver used all {max_iterations} iterations allowed"
    if nearest is not None and nearest.residual < min(answer.residual, _PATH_TOLERANCE):
        reason = used_up if steps >= max_iterations else nearest.reason
        return replace(nearest, iterations=steps, reason=reason)
    reason = f"{used_up}; {answer.reason}" if steps >= max_iterations else answer.reason
    return replace(answer, iterations=steps, reason=reason)


def _parts(width: float, shape: tuple[int, int]) -> int:
    """Return the number of parts into which a pixel's side is split for a blur in px."""
    parts = 1
    while (
        0 < width * parts < _MIN_BLUR_IN_PIXELS
        and parts < _MAX_PARTS
        and 4 * parts**2 * shape[0] * shape[1] <= _MAX_PIXELS
    ):
        parts *= 2
    return parts


class _Solved(NamedTuple):
    """A blur in px and the weights that solve the image with it."""

    width: float
    weights: FloatArray


def _next_width(
    width: float, solved: list[_Solved], level: Level, sharp_below: float, *, converged: bool
) -> float | None:
    """Return the next blur to try, or None if there is none."""
    if converged:
        return width / 2 if width >= 2 * sharp_below else 0.0
    if not solved:
        return 2 * width if width < max(level.shape) else None
    before = solved[-1].width
    width = np.sqrt(width * before) if width else before / 2
    return float(width) if _MIN_BLUR_PX < width < before / _MIN_BLUR_RATIO else None


def _starts(
    objective: TransportObjective, level: Level, width: float, solved: list[_Solved]
) -> Iterator[FloatArray]:
    """Yield the weights to start from, the most promising first."""
    if not solved:
        yield np.zeros(len(level.sites))
        yield with_full_cells(objective, _same_moments(level, objective.image.image))[0]
        return
    last = solved[-1]
    if len(solved) > 1:
        least = _MIN_PREDICTED_SHARE * float(objective.mass.min())
        slope = (last.weights - solved[-2].weights) / (last.width - solved[-2].width)
        for share in _SHARES_OF_PREDICTION:
            predicted = last.weights + share * (width - last.width) * slope
            diagram = objective.diagram_if_full(predicted)
            if diagram is not None and diagram.masses.min() > least:
                yield predicted
                if not width:
                    return
                break
    yield last.weights


def _same_moments(level: Level, image: FloatArray) -> FloatArray:
    """Return the weights of the affine map that gives the source the image's first two moments."""
    pixels = np.indices(image.shape).reshape(2, -1).T.astype(np.float64)
    centre, spread = _moments(level.sites, level.mass)
    image_centre, image_spread = _moments(pixels, image.ravel())
    root = _square_root(spread)
    inverse = np.linalg.inv(root)
    matrix = inverse @ _square_root(root @ image_spread @ root) @ inverse
    away = level.sites - centre
    # d = -∇φ with φ half the weight; no BLAS, whose idle threads spin
    stretch = np.einsum("ni,ij,nj->n", away, np.eye(2) - matrix, away)
    return np.asarray(stretch - 2 * (away * (image_centre - centre)).sum(axis=1))


def _moments(points: FloatArray, flux: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the centre of flux and the covariance, which includes the extent of a pixel."""
    share = (flux / flux.sum())[:, None]
    centre = (share * points).sum(axis=0)
    away = points - centre
    return centre, np.einsum("ni,nj->ij", share * away, away) + np.eye(2) / 12


def _square_root(matrix: FloatArray) -> FloatArray:
    values, vectors = np.linalg.eigh(matrix)
    root: FloatArray = (vectors * np.sqrt(np.maximum(values, 0))) @ vectors.T
    return root


def _blurred_solution(
    sharp: TransportObjective, solved: list[_Solved], level: Level, tolerance: float
) -> Solution:
    """Return the sharpest solution, with its residual for the sharp image."""
    width, weights = solved[-1] if solved else _Solved(np.inf, np.zeros(len(level.sites)))
    residual = sharp.residual(sharp.diagram(weights))
    rounded = float(f"{width:.2g}")
    reason = (
        f"only the image blurred by {rounded:g} px could be solved; that solution is returned"
        if solved
        else "even the blurred image could not be solved; the field is set to zero"
    )
    return Solution(sharp.in_gauge(weights), residual, 0, residual <= tolerance, reason)
