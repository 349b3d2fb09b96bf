"""The convex function of one level, and its minimum, the transport from the source to the image.

    f(w) = -Σ_i [ w_i S_i + ∫_{P_i} (|r - r_i|² - w_i) I dr ],
    ∂f/∂w_i = T_i - S_i,   ∂²f/∂w_i∂w_j = -∫_{P_i ∩ P_j} I ds / (2 |r_i - r_j|)

- f, its gradient and its Hessian at given weights: `TransportObjective`; where flux may cross
  the image's edge: `OpenObjective`
- by damped Newton steps, from weights whose cells all hold flux: `newton`
- make such weights of any others: `with_full_cells`
- from a blurred image to the sharp one, for any image: `sharpen`
- by descent along gradients, as in the paper; slower, for comparison: `descend`
- the result of a solver: `Solution`

The tolerance is the largest relative flux error of a cell.

Damped Newton steps from zero weights fail where the image jumps: between bright and dark a
cell's flux is no smooth function of the weights, and cells in the dark must be kept from
emptying. Blur the image enough and they succeed; and the weights depend almost linearly on the
width of the blur, so the line through two solutions is a start for the next, narrower one.
That holds for widths below a pixel, too, where the pixels are split before the blur: else each
row of cells that passes a pixel's edge bends the way.

References
----------
Paper, Eqs. 5 and 6, section III.A; F. Aurenhammer, F. Hoffmann and B. Aronov, Algorithmica 20, 61
(1998); J. Kitagawa, Q. Mérigot and B. Thibert, J. Eur. Math. Soc. 21, 2603 (2019); D. C. Liu and
J. Nocedal, Math. Prog. 45, 503 (1989).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cache, partial
from typing import NamedTuple

import numpy as np
import scipy
from scipy.fft import dctn, idctn
from scipy.sparse import csr_array
from scipy.spatial import KDTree

from napari_shadowinv._system.machine import available_threads
from napari_shadowinv._system.progress import Reporter
from napari_shadowinv._typing import FloatArray
from napari_shadowinv.geometry.density import Density, side_of_squares, split_pixels
from napari_shadowinv.geometry.power_diagram import PowerDiagram
from napari_shadowinv.geometry.triangulation import RegularTriangulation
from napari_shadowinv.physics.arrays import complete_block_means
from napari_shadowinv.transport.linear import SimilarSystems
from napari_shadowinv.transport.sites import Margin, SiteLevel


@dataclass(frozen=True, eq=False)
class Solution:
    """Weights of one level and how they were reached."""

    weights: FloatArray  # shape (n,), px²; of mean zero, but where the boundary is free
    residual: float  # largest relative flux error of a cell
    iterations: int
    converged: bool  # whether the residual is within the tolerance
    reason: str = ""  # why it did not converge


@dataclass(eq=False)
class TransportObjective:
    """The function f(w) for given sites, their source flux S_i, and an image of the same flux.

    The triangulation of the sites follows the weights of the last call.
    """

    triangulation: RegularTriangulation
    mass: FloatArray
    image: Density
    threads: int | None = None

    def diagram(self, weights: FloatArray, *, with_moments: bool = False) -> PowerDiagram:
        """Return the power diagram for `weights`; empty cells are allowed."""
        self.triangulation.update(weights, threads=available_threads(self.threads))
        image = self.image_for(weights)
        return PowerDiagram(
            self.triangulation, image, with_moments=with_moments, threads=self.threads
        )

    def diagram_if_full(self, weights: FloatArray) -> PowerDiagram | None:
        """Return the power diagram for `weights`, or None as soon as a cell proves empty."""
        threads = available_threads(self.threads)
        if not self.triangulation.update(weights, stop_when_hidden=True, threads=threads):
            return None
        return PowerDiagram(self.triangulation, self.image_for(weights), threads=self.threads)

    def image_for(self, weights: FloatArray) -> Density:
        """Return the image that the cells divide among themselves."""
        return self.image

    def ground(self, weights: FloatArray) -> FloatArray | None:
        """Return the derivative of each site's image flux by its weight, if it is not zero."""
        return None

    def in_gauge(self, weights: FloatArray) -> FloatArray:
        """Fix the undetermined constant of the weights: their mean becomes zero."""
        centred: FloatArray = weights - weights.mean()
        return centred

    def value_and_gradient(self, weights: FloatArray) -> tuple[float, FloatArray]:
        """Return f(w) and its gradient T - S (paper, Eqs. 5 and 6)."""
        diagram = self.diagram(weights, with_moments=True)
        gradient = diagram.masses - self.mass
        return float(np.sum(weights * gradient - diagram.inertia)), gradient

    def residual(self, diagram: PowerDiagram) -> float:
        """Return the largest relative flux error of a cell, max |T - S| / S."""
        return float(np.max(np.abs(diagram.masses - self.mass) / self.mass))


class OpenObjective(TransportObjective):
    """The function for a level over image and margin; the potential sets the margin's flux.

    The decay length ℓ is in px; see `napari_shadowinv.transport.sites`.
    """

    def __init__(
        self,
        level: SiteLevel,
        image: Density,
        margin: Margin,
        decay_length: float,
        *,
        threads: int | None = None,
    ) -> None:
        self._side = image.side
        margin = margin.split(round(1 / image.side))
        self._pixels = margin.beam.copy()
        margin.within(self._pixels)[:] = image.image
        density = Density.from_image(self._pixels, side=image.side)
        super().__init__(level.triangulation.copy(), level.mass, density, threads=threads)
        self._beyond = np.nonzero(margin.beyond)
        self._beam = margin.beam[self._beyond]
        places = image.side * (np.stack(self._beyond, axis=1) + 0.5) - 0.5
        self._site = KDTree(level.sites).query(places, workers=available_threads(threads))[1]
        self._gain = 0.5 / decay_length**2  # the potential is half the weight

    def image_for(self, weights: FloatArray) -> Density:
        """Return the image with the flux that arrives around it."""
        excess = self._gain * weights[self._site]
        # 1 + x where that is more than 1, else eˣ, which is never negative
        share = np.where(excess > 0, 1 + excess, np.exp(np.minimum(excess, 0)))
        self._pixels[self._beyond] = self._beam * share
        return Density.from_image(self._pixels, side=self._side)

    def ground(self, weights: FloatArray) -> FloatArray:
        """Return the derivative: more weight in the margin attracts more flux."""
        excess = self._gain * weights[self._site]
        slope = self._gain * self._beam * np.exp(np.minimum(excess, 0))
        return np.bincount(self._site, slope, len(weights)).astype(np.float64)

    def in_gauge(self, weights: FloatArray) -> FloatArray:
        """Return the weights as they are: far outside they are zero."""
        return weights


def newton(
    objective: TransportObjective,
    weights: FloatArray,
    tolerance: float,
    max_iterations: int,
    report: Reporter | None = None,
    *,
    shortest_step: float = 1e-7,
    fill: bool = False,
    even: float = 1.0,
) -> Solution:
    """Solve T(w) = S by damped Newton steps that never empty a cell.

    With `fill`, empty cells are filled first (`with_full_cells`). A start with a larger relative
    flux error of a cell than `even` is evened out before the first step. The solver stops without
    convergence if the error has not halved in 15 steps (a bad start), or if less than
    `shortest_step` of Newton's step is possible.
    """
    mass = objective.mass
    if fill:
        weights, diagram = with_full_cells(objective, weights)
    else:
        diagram = objective.diagram(weights)
    weights, diagram = _even_out(objective, weights, diagram, even)
    # Steps keep this gauge. The triangulation belongs to the weights after any step.
    weights = objective.in_gauge(weights)
    residual = objective.residual(diagram)
    keep = 0.5 * min(float(diagram.masses.min() / mass.mean()), float(mass.min() / mass.mean()))
    errors = [_length(mass - diagram.masses)]
    systems = SimilarSystems(objective.threads)
    first = 1.0
    reason = f"the solver used all {max_iterations} iterations allowed"
    while residual > tolerance and len(errors) <= max_iterations:
        message = f"{len(mass):,} sites, residual {residual:.2g}"
        alive = partial(report or Reporter(), "transport", len(errors) - 1, None, message)
        alive()
        gap = mass - diagram.masses
        laplacian = diagram.laplacian()
        del diagram  # the trial steps need its memory
        ground = objective.ground(weights)
        try:
            step = systems.solve(laplacian, gap, ground=ground)
        except RuntimeError as error:
            reason = f"Newton's system cannot be solved: {error}"
            break
        del laplacian
        shares = (first, shortest_step)
        damped = _damped_step(objective, weights, step, gap, keep * mass.mean(), shares, alive)
        if damped is None:
            reason = "no step along Newton's direction lowers the error without emptying a cell"
            break
        weights, diagram, share = damped
        first = min(1.0, (8 if share == first else 2) * share)
        residual = objective.residual(diagram)
        errors.append(_length(mass - diagram.masses))
        if len(errors) > 15 and errors[-1] > 0.5 * errors[-16]:
            reason = "the error has not halved in 15 steps"
            break
    converged = residual <= tolerance
    return Solution(weights, residual, len(errors) - 1, converged, "" if converged else reason)


def _even_out(
    objective: TransportObjective,
    weights: FloatArray,
    diagram: PowerDiagram,
    even: float,
    *,
    steps: int = 3,
    share: float = 0.6,
) -> tuple[FloatArray, PowerDiagram]:
    """Let cells that are almost empty or far too full settle with their neighbours.

    A start from coarser sites has a few such cells near caustics, and they alone would keep
    Newton's steps short for the whole image.
    """
    for _ in range(steps):
        if objective.residual(diagram) <= even:
            break
        gap = np.clip(objective.mass - diagram.masses, -objective.mass, objective.mass)
        stiffness = _stiffness(diagram.laplacian())
        if not stiffness.all():
            break
        step = share * gap / stiffness
        trial = objective.diagram_if_full(weights + step)
        if trial is None:
            # The triangulation has followed the trial.
            return weights, objective.diagram(weights)
        weights, diagram = weights + step, trial
    return weights, diagram


def _stiffness(laplacian: csr_array) -> FloatArray:
    """Diagonal of a Laplacian, of nodes with hardly any ties the mean of their neighbours'."""
    diagonal = laplacian.diagonal()
    ties = laplacian.copy()
    ties.data = np.ones_like(ties.data)
    around = (ties @ diagonal) / np.diff(ties.indptr)
    return np.asarray(np.maximum(diagonal, around))


def _damped_step(
    objective: TransportObjective,
    weights: FloatArray,
    step: FloatArray,
    gap: FloatArray,
    least: float,
    shares: tuple[float, float],
    alive: Callable[[], None],
) -> tuple[FloatArray, PowerDiagram, float] | None:
    """Halve the share of the step until all cells keep some flux and the error falls."""
    error = _length(gap)
    share, shortest = shares
    while share > shortest:
        diagram = None  # one at a time: they are large
        alive()
        trial = weights + share * step
        diagram = objective.diagram_if_full(trial)
        if diagram is not None and diagram.masses.min() > least:
            now = _length(objective.mass - diagram.masses)
            if now < (1 - 0.1 * share) * error:
                return trial, diagram, share
        share /= 2
    return None


def _length(vector: FloatArray) -> float:
    """Return the length without BLAS, whose idle threads spin and whose sums depend on them."""
    return float(np.sqrt(np.sum(vector * vector)))


def with_full_cells(
    objective: TransportObjective,
    weights: FloatArray,
    *,
    shares: tuple[float, ...] = (1.0, 0.999, 0.99, 0.9, 0.5),
) -> tuple[FloatArray, PowerDiagram]:
    """Find nearby weights for which every cell holds some flux, and their diagram.

    Hidden sites, if any, are lowered to where they just show; then a little of the zero weights,
    for which every cell is round and full, is mixed in.
    """
    visible = objective.triangulation.lower_hidden(
        weights, threads=available_threads(objective.threads)
    )
    all_seen = np.array_equal(visible, weights)
    for share in shares if all_seen else shares[1:]:
        diagram = objective.diagram_if_full(share * visible)
        if diagram is not None and diagram.masses.min() > 1e-12 * objective.mass.mean():
            return share * visible, diagram
    weights = np.zeros(len(weights))
    return weights, objective.diagram(weights)


def descend(
    objective: TransportObjective,
    start: FloatArray,
    tolerance: float,
    max_iterations: int,
    report: Reporter | None = None,
    *,
    kept: int = 20,
) -> Solution:
    """Minimise by L-BFGS, from `kept` pairs of steps and gradients; cells may be empty at first."""
    mass = objective.mass
    flux = float(mass.mean())
    # weights in units of the cells' area and flux in units of a cell's make a well-scaled problem
    height, width = objective.image.shape
    area = height * width / len(mass)
    residual = np.inf
    steps = 0

    def scaled_problem(weights: FloatArray) -> tuple[float, FloatArray]:
        nonlocal residual
        value, gradient = objective.value_and_gradient(area * weights)
        residual = float(np.max(np.abs(gradient) / mass))
        return value / (area * flux), gradient / flux

    def after_step(_: FloatArray) -> None:
        nonlocal steps
        steps += 1
        if report is not None:
            report("transport", steps, None, f"{len(mass):,} sites, residual {residual:.2g}")
        if residual <= tolerance:
            raise StopIteration

    result = scipy.optimize.minimize(
        scaled_problem,
        start / area,
        jac=True,
        method="L-BFGS-B",
        callback=after_step,
        options={
            "maxiter": max_iterations,
            "maxfun": 10**9,
            "maxcor": kept,
            "ftol": 0.0,
            "gtol": 0.0,
        },
    )
    weights = area * result.x
    residual = objective.residual(objective.diagram(weights))
    converged = residual <= tolerance
    reason = "" if converged else f"L-BFGS ended after {steps} iterations: {result.message}"
    return Solution(weights - weights.mean(), residual, steps, converged, reason)


Soften = Callable[[SiteLevel, float, int], TransportObjective]


@dataclass(frozen=True)
class BlurPath:
    """Blurs from a wide one to none, along which a sharp image is approached."""

    first: float = 1 / 6  # of the image's longer side
    sharp_below: float = 0.5  # site spacings: from there the sharp image is tried
    retry: float = 4.0  # times less blur before it is tried again
    least: float = 1e-3  # px
    least_ratio: float = 1.02  # of two blurs
    tolerance: float = 0.3  # of a blurred image's solution, which only has to start the next
    shortest_step: float = 1e-2
    predicted: tuple[float, ...] = (1.0, 0.5, 0.25)  # of the step along the line through two
    least_flux: float = 1e-2  # that a prediction leaves each cell, of the smallest one's

    def next_width(
        self, width: float, solved: list[_Solved], most: int, sharp: float, *, converged: bool
    ) -> float | None:
        """Return the next blur to try, or None if there is none."""
        if converged:
            return width / 2 if width >= 2 * sharp else 0.0
        if not solved:
            return 2 * width if width < most else None
        before = solved[-1].width
        width = np.sqrt(width * before) if width else before / 2
        return float(width) if self.least < width < before / self.least_ratio else None

    def starts(
        self, objective: TransportObjective, level: SiteLevel, width: float, solved: list[_Solved]
    ) -> Iterator[FloatArray]:
        """Yield the weights to start from, the most promising first."""
        if not solved:
            yield np.zeros(len(level.sites))
            pixels = split_pixels(objective.image.image, round(objective.image.side))
            yield with_full_cells(objective, _same_moments(level, pixels))[0]
            return
        last = solved[-1]
        if len(solved) > 1:
            least = self.least_flux * float(objective.mass.min())
            slope = (last.weights - solved[-2].weights) / (last.width - solved[-2].width)
            for share in self.predicted:
                predicted = last.weights + share * (width - last.width) * slope
                diagram = objective.diagram_if_full(predicted)
                if diagram is not None and diagram.masses.min() > least:
                    yield predicted
                    if not width:
                        return
                    break
        yield last.weights


_MAX_BLUR_IN_PIXELS = 16.0  # wider blurs are computed on means of pixels


def blur_image(image: FloatArray, width: float, threads: int | None = 1) -> FloatArray:
    """Blur a positive image by a standard deviation in px, mirrored at the border.

    The kernel is the discrete Gaussian (T. Lindeberg, IEEE Trans. Pattern Anal. Mach. Intell. 12,
    234, 1990), which has no negative lobes at any width; the sum stays. For a wide blur, the means
    of squares much smaller than its width are blurred instead of pixels.
    """
    height, breadth = image.shape
    parts = max(1, int(width / _MAX_BLUR_IN_PIXELS))
    diffused = split_pixels(_blur_means(image, width, parts, threads), parts)[:height, :breadth]
    diffused *= image.sum() / diffused.sum()
    return diffused


def blur_to_density(image: FloatArray, width: float, threads: int | None = 1) -> Density:
    """Return the density of `blur_image`, on squares of pixels where they tile the image."""
    side = side_of_squares((image.shape[0], image.shape[1]), width / _MAX_BLUR_IN_PIXELS)
    if side == 1:
        return Density.from_image(blur_image(image, width, threads), threads=threads)
    diffused = _blur_means(image, width, side, threads)
    diffused *= image.sum() / diffused.sum()
    return Density.from_image(diffused, side=side, threads=threads)


def _blur_means(image: FloatArray, width: float, parts: int, threads: int | None) -> FloatArray:
    """Blur the means of squares of pixels; the last are repeated beyond the border."""
    height, breadth = image.shape
    if height % parts or breadth % parts:
        image = np.pad(image, ((0, -height % parts), (0, -breadth % parts)), mode="edge")
    means = complete_block_means(image, parts)
    workers = available_threads(threads) if means.size > 2**17 else 1
    spectrum = dctn(means, workers=workers)
    for axis in (0, 1):
        waves = np.pi * np.arange(means.shape[axis]) / means.shape[axis]
        damping = np.exp(-((width / parts) ** 2) * (1 - np.cos(waves)))
        spectrum *= np.expand_dims(damping, 1 - axis)
    return np.asarray(np.maximum(idctn(spectrum, workers=workers), means.min()))


def sharpen(
    level: SiteLevel,
    sharp: TransportObjective,
    soften: Soften,
    tolerance: float,
    max_iterations: int,
    report: Reporter | None = None,
    *,
    path: BlurPath = BlurPath(),
) -> Solution:
    """Solve one level from zero weights by following the solution from a blurred image.

    `soften` makes the objective for the level of split pixels, the blur in those pixels, and the
    parts of a pixel's side (see `SiteLevel.split`). The limit of iterations covers all images
    together. If the sharp image cannot be solved, the solution of the sharpest solved image is
    returned and the reason names its blur; if the sharp image was nearly solved, that solution is.
    """
    solved: list[_Solved] = []
    nearest: Solution | None = None
    width: float | None = path.first * max(level.shape)
    sharp_below = path.sharp_below * level.spacing
    split = cache(level.split)
    steps = 0
    while width is not None and steps < max_iterations:
        parts = _parts(width, level.shape)
        objective = soften(split(parts), parts * width, parts) if width else sharp
        # weights are squares of lengths
        before = [_Solved(earlier.width, parts**2 * earlier.weights) for earlier in solved[-2:]]
        for start in path.starts(objective, split(parts), width, before):
            solution = newton(
                objective,
                start,
                path.tolerance if width else tolerance,
                max_iterations - steps,
                report,
                shortest_step=path.shortest_step,
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
            sharp_below = solved[-1].width / path.retry
        width = path.next_width(
            width, solved, max(level.shape), sharp_below, converged=solution.converged
        )
    answer = _blurred_solution(sharp, solved, level, tolerance)
    used_up = f"the solver used all {max_iterations} iterations allowed"
    if nearest is not None and nearest.residual < min(answer.residual, path.tolerance):
        reason = used_up if steps >= max_iterations else nearest.reason
        return replace(nearest, iterations=steps, reason=reason)
    reason = f"{used_up}; {answer.reason}" if steps >= max_iterations else answer.reason
    return replace(answer, iterations=steps, reason=reason)


def _parts(
    width: float, shape: tuple[int, int], *, hidden: float = 1.5, most: int = 8, pixels: int = 2**22
) -> int:
    """Return the number of parts into which a pixel's side is split for a blur in px.

    A blur by `hidden` parts hides them; `most` limits the parts, and `pixels` all of the image's.
    """
    parts, area = 1, shape[0] * shape[1]
    while 0 < width * parts < hidden and parts < most and 4 * parts**2 * area <= pixels:
        parts *= 2
    return parts


class _Solved(NamedTuple):
    """A blur in px and the weights that solve the image with it."""

    width: float
    weights: FloatArray


def _same_moments(level: SiteLevel, image: FloatArray) -> FloatArray:
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
    sharp: TransportObjective, solved: list[_Solved], level: SiteLevel, tolerance: float
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
