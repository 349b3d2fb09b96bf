"""How far the true beam may be from the source of an image: `BeamPrior`.

- of a beam that nobody measured: `ASSUMED_BEAM`; that was recorded in another exposure:
  `REFERENCE_BEAM`
- shapes in which it varies, and the rest: `BeamComponents`
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Annotated, Any, Literal, Self

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field, PrivateAttr

from napari_shadowinv._system.arrays import (
    block_means,
    check_finite,
    check_plane,
    check_shape,
    estimated_noise,
)
from napari_shadowinv._system.validation import CheckedModel
from napari_shadowinv._typing import FloatArray
from napari_shadowinv.errors import InputError

Share = Annotated[float, Field(ge=0, lt=1)]

_GRID = 128  # blocks along the longer side
_DIMMEST = 1e-2  # of the mean beam, for a relative difference
_MIN_NOISE_RATIO = 1.5  # variance of a component, over its share of the noise
_MIN_VARIANCE = 1e-3  # of a component, as a share of the total
_HALF_WIDTH = np.exp(-0.5)  # correlation at the length of a prior


@dataclass(frozen=True, eq=False)
class BeamComponents:
    """Shapes in which a beam varies relative to its mean, known block by block.

    The basis is their origin: 'references'; 'outside' for an image outside its object; 'assumed' or
    'stated' for the remains after filters and a source estimate; 'filtered' for the part that they
    take from an object in an exact beam.
    """

    patterns: FloatArray  # (k, h, w), relative, by one standard deviation of each, means of blocks
    block: int  # side of a square block, px
    shape: tuple[int, int]  # of the image
    rest: float  # relative r.m.s. of what they leave, with the length of the prior
    basis: Literal["references", "outside", "assumed", "stated", "filtered"]
    mean: FloatArray | None = None  # (H, W), whose mean is 1

    def check_shape(self, shape: tuple[int, ...]) -> None:
        """Raise an `InputError` if an image has another shape."""
        if self.shape != shape:
            raise InputError(
                f"the beam's prior is of images of shape {self.shape}, the image has {shape}: they "
                "must match"
            )


class BeamPrior(CheckedModel, allow_inf_nan=False):
    """Expected difference between the true beam and the source of an image.

    Attributes
    ----------
    rms : float
        Relative r.m.s. difference.
    length : float
        Length over which it varies, as a share of the image's shorter side.
    between : float
        Relative r.m.s. difference of the beams of two energies of one shot.

    Raises
    ------
    InputError
        If a value is out of range.
    """

    rms: Share = 0.0
    length: float = Field(default=0.25, ge=1e-6, le=1)
    between: Share = 0.0
    _components: BeamComponents | None = PrivateAttr(default=None)

    @property
    def components(self) -> BeamComponents | None:
        """Shapes in which the beam varies; None for random waves of a length."""
        return self._components

    @property
    def mean(self) -> FloatArray | None:
        """Mean beam of the references, (H, W), a source for shots between them."""
        return None if self._components is None else self._components.mean

    def with_components(self, components: BeamComponents) -> Self:
        """Return the prior of a beam that varies in certain shapes."""
        prior = self.model_copy()
        prior._components = components
        return prior

    @classmethod
    def from_references(cls, images: Iterable[ArrayLike], **numbers: Any) -> Self:
        """Return the prior of a beam that varies as between shots without an object.

        Parameters
        ----------
        images : iterable of array_like, shape (H, W)
            At least two shots of the beam; their total flux may differ.
        **numbers
            Such as `between`.

        Raises
        ------
        InputError
            If there are fewer than two images, they differ in shape, or one is no image of a beam.

        Notes
        -----
        The images are divided by their flux. Principal components of their relative differences,
        less the share of white noise, are the shapes of the prior, as in dynamic flat-field
        correction. What the other references leave of each one, on average, is taken to vary as
        random waves of the prior's length. A new shot differs from the mean of n references by
        (n + 1) / n of their variance.

        References
        ----------
        V. Van Nieuwenhove et al., "Dynamic intensity normalization using eigen flat fields in
        X-ray imaging", Optics Express 23, 27975 (2015).

        Examples
        --------
        >>> y = np.linspace(-1, 1, 64)[:, None] * np.ones(64)
        >>> prior = BeamPrior.from_references([1 + a * y for a in (-0.1, 0.0, 0.1)])
        >>> round(prior.rms, 3), len(prior.components.patterns)
        (0.068, 1)
        """
        beams = _normalise(images)
        mean = np.mean(beams, axis=0)
        block = -(-max(mean.shape) // _GRID)
        coarse = np.stack([block_means(beam, block) for beam in beams])
        level = coarse.mean(axis=0)
        weights = level / level.sum()
        bright = level > _DIMMEST * level.mean()
        ratios = np.where(bright, coarse / np.where(bright, level, 1.0) - 1, 0.0)
        noises = [estimated_noise(ratio, bright) ** 2 for ratio in ratios]
        noise = float(np.mean(noises))
        rows = (np.sqrt(weights) * ratios).reshape(len(beams), -1)
        _, strengths, shapes = np.linalg.svd(rows, full_matrices=False)
        # Of n images, n - 1 differences are independent.
        by_noise = noise / (len(beams) - 1)
        variances = strengths**2 / (len(beams) - 1)
        of_noisiest = max(noises) / (len(beams) - 1)
        clear = variances > max(_MIN_NOISE_RATIO * of_noisiest, _MIN_VARIANCE * variances.sum())
        variances = np.maximum(variances - by_noise, 0) * (1 + 1 / len(beams))
        rms = float(np.sqrt(variances[clear].sum()))
        share = _share_beyond(rows, noise)
        scale = np.sqrt((1 - share) * variances[clear])
        patterns = scale[:, None] * shapes[clear] / np.sqrt(np.maximum(weights.ravel(), 1e-300))
        patterns = np.where(bright, patterns.reshape(-1, *level.shape), 0.0)
        size = (mean.shape[0], mean.shape[1])
        if share == 1:
            patterns = patterns[:0]
        rest = rms * np.sqrt(share)
        components = BeamComponents(patterns, block, size, rest, "references", mean)
        length = _length(ratios, bright, noise) * block / min(size)
        numbers = {"rms": rms, "length": float(np.clip(length, 1 / min(size), 1)), **numbers}
        return cls(**numbers).with_components(components)


ASSUMED_BEAM = BeamPrior(rms=0.05, length=0.25)
"""Prior of a beam that nobody measured, unless another one is stated."""

REFERENCE_BEAM = BeamPrior(rms=0.005, length=0.25)
"""Prior of a beam whose source was recorded in another exposure, unless another one is stated."""

UNKNOWN_BEAM_RMS = 0.15
"""Relative r.m.s. variation of a beam that is called unknown, unless another one is stated."""


def _normalise(images: Iterable[ArrayLike]) -> list[FloatArray]:
    """Return references with a mean of 1, all of one shape."""
    beams: list[FloatArray] = []
    for number, image in enumerate(images, start=1):
        name = f"reference {number}"
        beam = check_plane(image, name, least=4).astype(np.float64)
        check_finite(name, beam)
        if beams:
            check_shape(name, beam.shape, beams[0].shape, "the first")
        if not beam.mean() > 0:
            raise InputError(f"{name} has a mean of {beam.mean():.4g}, expected a positive one")
        beams.append(beam / beam.mean())
    if len(beams) < 2:
        raise InputError(
            f"got {len(beams)} references, expected at least two: the beam's variation follows "
            "from their differences"
        )
    return beams


def _share_beyond(rows: FloatArray, noise: float) -> float:
    """Return the share of each image's variance that the shapes of the others leave."""
    if len(rows) == 2:
        return 1.0
    # In the space of the rows, which has few dimensions.
    rows = np.asarray(np.linalg.qr(rows.T, mode="r")).T
    before = after = 0.0
    for index, row in enumerate(rows):
        others = np.delete(rows, index, axis=0)
        middle = others.mean(axis=0)
        difference = row - middle
        _, strengths, shapes = np.linalg.svd(others - middle, full_matrices=False)
        shapes = shapes[strengths > 1e-9 * max(float(strengths.max()), 1e-300)]
        by_noise = noise * (1 + 1 / len(others))
        before += max(float(difference @ difference) - by_noise, 0.0)
        left = difference - (difference @ shapes.T) @ shapes
        after += max(float(left @ left) - by_noise, 0.0)
    return min(after / before, 1.0) if before > 0 else 0.0


def _length(ratios: FloatArray, bright: Any, noise: float) -> float:
    """Return the lag in blocks at which differences are correlated by exp(-1/2)."""
    ratios = ratios - ratios.mean(axis=0)
    variance = float((ratios[:, bright] ** 2).mean()) - noise * (1 - 1 / len(ratios))
    if not variance > 0:
        return float(min(bright.shape)) * 0.25
    before = 1.0
    for lag in range(1, min(bright.shape)):
        products = [
            (first * second)[:, used].mean()
            for first, second, used in (
                (ratios[:, lag:], ratios[:, :-lag], bright[lag:] & bright[:-lag]),
                (ratios[:, :, lag:], ratios[:, :, :-lag], bright[:, lag:] & bright[:, :-lag]),
            )
            if used.any()
        ]
        correlation = float(np.mean(products)) / variance if products else 0.0
        if correlation < _HALF_WIDTH:
            return float(lag - (_HALF_WIDTH - correlation) / max(before - correlation, 1e-9))
        before = correlation
    return float(min(bright.shape))
