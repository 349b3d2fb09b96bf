"""The beam behind an object, predicted from the image around it: `kriged_source`, `kriged_prior`.

The logarithm of the beam is a Gaussian process: smooth, random, correlated by exp(-r²/2L²). Blocks
of pixels without the object give its r.m.s., its length L and the noise by their marginal
likelihood; lengths count in proportion to it. The process varies about a quadratic, such as the
logarithm of a Gaussian spot. The conditional mean is the source, the conditional variance the prior
of the error that remains. The process is a sum of cosines over a domain half as large again as the
image, so that the border needs no slope of its own, and of a quadratic of any size.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy
from numpy.typing import ArrayLike
from threadpoolctl import threadpool_limits

from napari_shadowinv._system.progress import Reporter, ShouldStop
from napari_shadowinv._typing import BoolArray, FloatArray
from napari_shadowinv.cautions import Caution, OnCaution
from napari_shadowinv.errors import InputError
from napari_shadowinv.facts import percent
from napari_shadowinv.options import BeamComponents, BeamPrior
from napari_shadowinv.physics.arrays import block_means
from napari_shadowinv.preprocessing.pixels import beam_pixels, complete_blocks, with_flux_of

_LENGTHS = np.geomspace(0.1, 1.2, 12)  # shorter sides; errors are too small with half of them
_RATIOS = np.geomspace(1e-4, 1e8, 97)  # variance of the beam over the noise of a block
_LOG_2PI = math.log(2 * math.pi)
_FREE = 6  # terms of a quadratic
_LEAST_CHANGE = 1e-4  # of the logarithm, as smooth beams are no exact sums of waves


def kriged_source(
    values: FloatArray, usable: BoolArray, report: Reporter, on_caution: OnCaution
) -> FloatArray:
    """Beam predicted from the pixels without the object, as a Gaussian process."""
    blocks = _Blocks.of(values, usable)
    with _one_thread():
        fits = blocks.fits(report)
        caution = _halo_caution(blocks, max(fits, key=lambda fit: fit.evidence))
        weighted = zip(_weights(fits), fits, strict=True)
        beam = np.asarray(sum(weight * fit.at_pixels for weight, fit in weighted if weight))
    if caution is not None:
        on_caution(caution)
    return with_flux_of(blocks.level * np.exp(beam), blocks.values, blocks.usable)


def kriged_prior(
    image: ArrayLike, mask: ArrayLike, *, should_stop: ShouldStop | None = None, most: int = 32
) -> BeamPrior:
    """Return the prior of the error of `kriged_source`, in `most` components or fewer."""
    blocks = _Blocks.of(image, mask)
    with _one_thread():
        fits = blocks.fits(Reporter(None, should_stop))
        weights = _weights(fits)
        likely = [(weight, fit) for weight, fit in zip(weights, fits, strict=True) if weight]
        mean = np.asarray(sum(weight * fit.mean for weight, fit in likely))
        columns = [
            math.sqrt(weight)
            * np.concatenate([fit.deviations, (fit.mean - mean)[..., None]], axis=2)
            for weight, fit in likely
        ]
        flat = np.concatenate(columns, axis=2).reshape(mean.size, -1)
        # Few of the many columns matter: the others hold a thousandth of the variance.
        powers, turned = scipy.linalg.eigh(flat.T @ flat)
        beyond = np.cumsum(powers) < 1e-3 * powers.sum()
        chosen = turned[:, ~beyond][:, -most:]
        # The sum of their squares is the variance of the beam in each block.
        patterns = np.ascontiguousarray((flat @ chosen).T.reshape(-1, *mean.shape))
    light, variance = np.exp(mean), (patterns**2).sum(axis=0)
    rms = math.sqrt(float((light * variance).sum() / light.sum()))
    height, width = blocks.values.shape
    components = BeamComponents(patterns, blocks.block, (height, width), 0.0, "outside")
    length = float(np.exp(weights @ np.log(_LENGTHS)))
    return BeamPrior(rms=min(rms, 0.99), length=min(length, 1.0)).with_components(components)


@dataclass(frozen=True, eq=False)
class _Blocks:
    """Means of an image over square blocks of pixels, and which show the bare beam."""

    values: FloatArray
    usable: BoolArray
    block: int  # px
    bare: BoolArray  # (h, w)
    level: float
    logs: FloatArray  # (h, w), of the means over the level, 0 elsewhere
    counts: FloatArray  # (h, w), weights by the light

    @classmethod
    def of(
        cls, image: ArrayLike, mask: ArrayLike, *, side: int = 64, dimmest: float = 0.01
    ) -> _Blocks:
        """Return `side` blocks or fewer along a side; refuse an image where few show the beam."""
        values, usable = beam_pixels(image, mask)
        if usable.all():
            raise InputError(
                "the mask hides no pixel, so the object would be taken for the beam: mask the "
                "object with its halo"
            )
        block = -(-max(values.shape) // side)
        share = block_means(usable.astype(np.float64), block)
        means = block_means(np.where(usable, values, 0.0), block) / np.maximum(share, 1e-300)
        # A part of a block has another middle.
        whole = complete_blocks(usable, block)
        bare = np.pad(whole, [(0, n - m) for n, m in zip(share.shape, whole.shape, strict=True)])
        if bare.sum() < _least_blocks(bare):
            bare = share > 0.5
        if bare.any():
            bare &= means > dimmest * means[bare].mean()
        if bare.sum() < _least_blocks(bare):
            raise InputError(
                f"{percent(bare.mean())} of the image is free of the object, too little to predict "
                "the beam behind it: mask less, or choose another estimate"
            )
        level = float(means[bare].mean())
        logs = np.log(np.where(bare, means / level, 1.0))
        return cls(values, usable, block, bare, level, logs, share * means / level)

    def fits(self, report: Reporter) -> list[_Fit]:
        """Return the process of each length."""
        fits = []
        for length in _LENGTHS * min(self.values.shape):
            report("source", 0)
            functions = _Functions(self.values.shape, self.block, length)
            fits.append(_Fit.to(functions, self.bare, self.logs[self.bare], self.counts[self.bare]))
        return fits


def _least_blocks(bare: BoolArray, share: float = 0.1, count: int = 20) -> float:
    """Return how many blocks must show the beam."""
    return max(share * bare.size, count)


def _halo_caution(
    blocks: _Blocks,
    fit: _Fit,
    *,
    rim: float = 0.15,  # its width over the largest distance to a hidden block
    rim_blocks: float = 1.5,  # at least
    most_places: int = 400,  # hidden blocks that are compared
    share: float = 0.9,  # of the variance, in shapes that are compared
    most_shapes: int = 6,
    least_chance: float = 1e-4,  # of a larger difference; see tests/preprocessing/test_kriging.py
) -> Caution | None:
    """Warn if blocks next to the hidden ones change their prediction by more than its variance."""
    hidden = ~blocks.bare
    if not hidden.any():
        return None
    rows, columns = np.nonzero(hidden)
    step = -(-len(rows) // most_places)
    places = rows[::step], columns[::step]
    depth, distance = (scipy.ndimage.distance_transform_edt(part) for part in (hidden, ~hidden))
    farther = blocks.bare & (distance > max(rim * float(depth.max()), rim_blocks))
    if farther.sum() < _least_blocks(farther):
        return None
    without_rim = _Fit.to(fit.functions, farther, blocks.logs[farther], blocks.counts[farther])
    change = (fit.mean - without_rim.mean)[places]
    # Of nested data, the change of a mean has the variance that the data take away.
    spread, wider = (each.deviations[places] for each in (fit, without_rim))
    powers, shapes = scipy.linalg.eigh(wider @ wider.T - spread @ spread.T)
    powers, shapes = powers[::-1], shapes[:, ::-1]
    shares = np.cumsum(np.maximum(powers, 0)) / max(float(powers[powers > 0].sum()), 1e-300)
    count = min(int(np.searchsorted(shares, share)) + 1, most_shapes)
    amplitudes = shapes[:, :count].T @ change
    least = _LEAST_CHANGE**2 * len(change)  # of an image without noise
    square = float((amplitudes**2 / np.maximum(powers[:count], least)).sum())
    chance = scipy.special.gammaincc(count / 2, square / 2)  # of a larger χ²
    if chance > least_chance:
        return None
    text = (
        "the image next to the source mask is not as the beam farther away predicts it, by "
        f"{math.sqrt(square / count):.1f} standard deviations: the mask may not cover the object "
        "with its halo, or the beam is not smooth; mask more, or compare with another estimate"
    )
    return Caution("source", text)


@dataclass(frozen=True, eq=False)
class _Functions:
    """Functions whose random sum is the logarithm of a beam of a length, px.

    Cosines over the domain with the length's spectrum, whose variances sum to 1, and a quadratic.
    """

    shape: tuple[int, ...]
    block: int
    length: float
    domain: float = 1.5  # sides of the image
    shortest: float = 3.6  # wave number in units of 1/L, where the spectrum has fallen to 1/650
    quadratic: float = 100.0  # deviation of its terms, over that of the sum of cosines

    @cached_property
    def _numbers(self) -> list[FloatArray]:
        """Wave numbers along y and x, rad/px."""
        steps = [np.pi / (self.domain * side) for side in self.shape]
        counts = [max(2, int(self.shortest / (self.length * step)) + 1) for step in steps]
        return [step * np.arange(float(n)) for step, n in zip(steps, counts, strict=True)]

    @cached_property
    def deviations(self) -> FloatArray:
        """Deviations of the products of functions along y and x, 0 for those that are not used."""
        along_y, along_x = self._numbers
        squares = self.length**2 * (along_y[:, None] ** 2 + along_x**2)
        spectrum = np.where(squares <= self.shortest**2, np.exp(-0.5 * squares), 0.0)
        degrees = np.add.outer(np.arange(3), np.arange(3))
        return np.asarray(
            scipy.linalg.block_diag(
                np.sqrt(spectrum / spectrum.sum()), self.quadratic * (degrees <= 2)
            )
        )

    def along(self, block: int) -> list[FloatArray]:
        """Return the functions at blocks along y and x, shape (blocks, functions).

        Cosines with a mean square of 1, then the powers 0 to 2 of places from -1 to 1.
        """
        bases = []
        for side, numbers in zip(self.shape, self._numbers, strict=True):
            middles = block * (np.arange(-(-side // block)) + 0.5)  # px from the edge
            places = middles + (self.domain - 1) / 2 * side
            cosines = np.where(numbers > 0, math.sqrt(2), 1.0) * np.cos(np.outer(places, numbers))
            powers = (2 * middles[:, None] / side - 1) ** np.arange(3)
            bases.append(np.hstack([cosines, powers]))
        return bases

    @cached_property
    def at_blocks(self) -> FloatArray:
        """Functions of one standard deviation at the middles of blocks, (h, w, functions)."""
        along_y, along_x = self.along(self.block)
        rows, columns = np.nonzero(self.deviations)
        products = along_y[:, None, rows] * along_x[None, :, columns]
        return np.asarray(products * self.deviations[rows, columns])


@dataclass(frozen=True, eq=False)
class _Fit:
    """Sum of the functions of one length, conditioned on the bare blocks."""

    functions: _Functions
    coefficients: FloatArray  # (functions,), mean amplitudes, in their standard deviations
    spread: FloatArray  # (functions, functions), columns whose squares sum to the covariance
    evidence: float  # logarithm of the marginal likelihood, up to a constant

    @property
    def mean(self) -> FloatArray:
        """Mean of the logarithm of the beam in each block."""
        return np.asarray(self.functions.at_blocks @ self.coefficients)

    @property
    def deviations(self) -> FloatArray:
        """Shapes whose squares sum to the variance in each block, (h, w, functions)."""
        return np.asarray(self.functions.at_blocks @ self.spread)

    @property
    def at_pixels(self) -> FloatArray:
        """Mean of the logarithm of the beam in each pixel."""
        table = self.functions.deviations.copy()
        table[table > 0] *= self.coefficients
        along_y, along_x = self.functions.along(1)
        return np.asarray(along_y @ table @ along_x.T)

    @classmethod
    def to(
        cls, functions: _Functions, bare: BoolArray, logs: FloatArray, counts: FloatArray
    ) -> _Fit:
        """Fit the logarithms of bare blocks, whose noise has a variance of σ² / counts."""
        roots = np.sqrt(counts / counts.mean())
        rows, data = roots[:, None] * functions.at_blocks[bare], roots * logs
        powers, turned = scipy.linalg.eigh(rows.T @ rows)
        powers = np.maximum(powers, 0.0)
        pull = turned.T @ (rows.T @ data)
        gain = _RATIOS[:, None] / (1 + _RATIOS[:, None] * powers)
        freedom = len(data) - _FREE
        noise = np.maximum((data @ data - gain @ pull**2) / freedom, _LEAST_CHANGE**2)
        # The quadratic is as good as free, so its size does not count.
        volume = np.log1p(_RATIOS[:, None] * powers).sum(axis=1) - _FREE * np.log(_RATIOS)
        evidences = -0.5 * (volume + freedom * (np.log(noise) + 1 + _LOG_2PI))
        best = int(evidences.argmax())
        return cls(
            functions,
            turned @ (gain[best] * pull),
            turned * np.sqrt(noise[best] * gain[best]),
            float(evidences[best]),
        )


def _weights(fits: list[_Fit], least: float = 0.02) -> FloatArray:
    """Return the weights of processes by their evidence, 0 for those below a least weight."""
    evidence = np.array([fit.evidence for fit in fits])
    weights = np.exp(evidence - evidence.max())
    weights[weights < least * weights.sum()] = 0.0
    return np.asarray(weights / weights.sum())


def _one_thread() -> threadpool_limits:
    """Keep BLAS from threads, which on a busy machine wait for each other far longer than work."""
    import scipy.linalg  # noqa: F401  only libraries that are loaded are limited

    return threadpool_limits(limits=1, user_api="blas")
