"""Error bars by random samples of a field.

- a number that is derived from the field, with its samples: `Quantity`; of a maximum: `Maximum`
- mean and scatter of samples in every pixel: `ErrorSamples`, drawn by `Inversion.uncertainty`
- linear samples against those that were solved as well: `Linearity`

Bands mirror the samples at the value (the basic bootstrap): B. Efron and R. J. Tibshirani, *An
Introduction to the Bootstrap* (Chapman & Hall, 1993), chapter 13.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from statistics import NormalDist
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import stdtrit

from napari_shadowinv._typing import FloatArray
from napari_shadowinv.cautions import Caution
from napari_shadowinv.errors import InputError
from napari_shadowinv.facts import percent, to_figures
from napari_shadowinv.inversion.variables import dataset_from_field
from napari_shadowinv.physics.setup import Setup
from napari_shadowinv.physics.units import label

if TYPE_CHECKING:
    import xarray

_ENOUGH_FOR_QUANTILES = 40
_STORED = (
    *("n", "noise", "method", "linearity", "tolerance"),
    *("iterations", "residuals", "converged"),
)

QuantityOf = Callable[[FloatArray, FloatArray], ArrayLike]
Quantities = Mapping[str, QuantityOf] | Callable[[FloatArray], Mapping[str, QuantityOf]]


# Of a maximum of many equal values: its mean grows as the deviation of the noise, which samples,
# with the noise of the inversion and their own, have √2 times.
_BIAS_OF_MAXIMUM = 1 / (np.sqrt(2) - 1)
# The share of it that is uncertain; bands of one, two and many equal values hold 59 to 87 and 92 to
# 96 % of the truths.
_UNSURE_BIAS = 0.5


@dataclass(frozen=True)
class Maximum:
    """A function of potential and displacement that returns a maximum over places, such as a peak.

    Its bands take a stronger bias by noise into account (`Quantity.bias`).
    """

    measure: QuantityOf

    def __call__(self, potential: FloatArray, displacement: FloatArray) -> ArrayLike:
        return self.measure(potential, displacement)


@dataclass(frozen=True)
class Quantity:
    """A number, or an array of them, that is derived from the field.

    Attributes
    ----------
    value : ndarray
        Of the inversion.
    samples : ndarray, shape (n, ...)
        Of each sample.
    is_maximum : bool
        Whether it is a maximum over places.
    """

    value: FloatArray
    samples: FloatArray
    is_maximum: bool = False

    @property
    def std(self) -> FloatArray:
        """Standard deviation of the samples, of a maximum with half of its bias."""
        deviation = self.samples.std(axis=0, ddof=1)
        return np.asarray(np.hypot(deviation, _UNSURE_BIAS * self.bias * self.is_maximum))

    @property
    def bias(self) -> FloatArray:
        """Mean of the samples less the value, which noise and instrument add on average.

        Of a maximum 2.4 times as much: noise picks the largest of many nearly equal values, as
        around a ring, but the inversion, from which samples start, has one maximum by its noise.
        """
        added = np.asarray(self.samples.mean(axis=0) - self.value)
        return _BIAS_OF_MAXIMUM * added if self.is_maximum else added

    def band(self, share: float = 0.68) -> tuple[FloatArray, FloatArray]:
        """Return the lower and the upper end of the interval with a share of probability.

        Samples stray from the inversion as the inversion does from the truth, so the samples'
        interval is mirrored at the value (the basic bootstrap). It corrects a bias, such
        as that of a maximum, which noise raises. With fewer than 40 samples, as in a fit,
        it is Student's interval for the next sample, which takes their spread as normal.

        Raises
        ------
        InputError
            If the share is not between 0 and 1.
        """
        tails = (1 + _checked_share(share)) / 2, (1 - share) / 2
        count = len(self.samples)
        if 1 < count < _ENOUGH_FOR_QUANTILES:
            middle = self.value - self.bias
            width = stdtrit(count - 1, tails[0]) * np.sqrt(1 + 1 / count) * self.std
            return np.asarray(middle - width), np.asarray(middle + width)
        mirrored = self.mirrored()
        low, high = np.quantile(mirrored, tails[::-1], axis=0, method="weibull")
        return np.asarray(low), np.asarray(high)

    def mirrored(self) -> FloatArray:
        """Return values that are as likely as the true one, shape (n, ...).

        Samples mirrored at the value; of a maximum about the value less its bias.
        """
        if not self.is_maximum:
            return np.asarray(2 * self.value - self.samples)
        about_mean = self.samples - self.samples.mean(axis=0)
        spread = np.maximum(self.samples.std(axis=0, ddof=1), np.finfo(np.float64).tiny)
        return np.asarray(self.value - self.bias - self.std / spread * about_mean)


def _checked_share(share: float) -> float:
    if not 0 < share < 1:
        raise InputError(f"share is {share!r}, expected a number between 0 and 1, such as 0.95")
    return share


@dataclass(frozen=True)
class LinearityCheck:
    """Largest deviations of linear samples from solved ones that need no caution."""

    nonlinearity: float = 0.3
    spread: float = math.inf  # of `spread_ratio` from 1


NOISE_LINEARITY = LinearityCheck()
"""For samples of the noise alone."""

CORRECTED_LINEARITY = LinearityCheck(0.6)
"""For samples of noise and instrument, which are corrected by those that were solved."""

FIT_LINEARITY = LinearityCheck(0.5, 0.3)
"""For the few samples of a fit, of which two are solved."""


@dataclass(frozen=True)
class Linearity:
    """Linear samples against those that were solved as well."""

    nonlinearity: float  # deviation as a share of the change, r.m.s. over the image
    spread_ratio: float  # of the solved changes to the linear ones, r.m.s.
    mean_shift: float  # relative to the r.m.s. standard deviation

    def caution(self, check: LinearityCheck, cause: str, remedy: str) -> Caution | None:
        """Warn if the response to a cause is not linear, and say what to do."""
        is_spread = abs(self.spread_ratio - 1) > check.spread
        if not (is_spread or self.nonlinearity > check.nonlinearity):
            return None
        return Caution(
            "samples",
            f"the response to {cause} is not linear: linear samples differ from solved ones by "
            f"{percent(self.nonlinearity)} of their change, and solved ones scatter "
            f"{to_figures(self.spread_ratio)} times as far; {remedy}",
        )


@dataclass(frozen=True, eq=False)
class ErrorSamples:
    """Random samples of a field by its noise, and by its instrument and edge if these are drawn.

    Attributes
    ----------
    potential, displacement : ndarray, shape (H, W) and (2, H, W)
        The field itself, px² and px.
    potential_mean, potential_std : ndarray, shape (H, W)
        Mean and standard deviation of the samples' potentials, px². As each potential is zero
        in the mean over the border, the deviation refers to the difference to the border.
    displacement_mean, displacement_std : ndarray, shape (2, H, W)
        The same for the displacement, px, for each component.
    n : int
        Number of samples. The deviations themselves are known to 1 / √(2 (n - 1)): 16 % for 20.
    noise : str
        Assumed noise.
    method : {"linear", "resolve"}
        How samples were inverted.
    linearity : Linearity or None
        Linear samples against solved ones, by which means and deviations with an instrument are
        corrected; None where all were solved.
    tolerance : float
        Largest relative flux error of a cell that was allowed in a sample that was solved.
    iterations, residuals, converged : tuple of int, of float, of bool
        Of each sample that was solved, which of linear ones are the first few: solver steps,
        largest relative flux error of a cell, tolerance met.
    quantities : dict of str to Quantity
        Numbers derived from the field, by their names.
    """

    potential: FloatArray
    displacement: FloatArray
    potential_mean: FloatArray
    potential_std: FloatArray
    displacement_mean: FloatArray
    displacement_std: FloatArray
    n: int
    noise: str
    method: str
    linearity: Linearity | None
    tolerance: float
    iterations: tuple[int, ...]
    residuals: tuple[float, ...]
    converged: tuple[bool, ...]
    quantities: dict[str, Quantity]

    def band(self, share: float = 0.68) -> tuple[FloatArray, FloatArray]:
        """Return the displacement's lower and upper end at every pixel, (2, H, W) each, px.

        The interval of normal errors with a share of probability around the inversion less its
        bias.

        Raises
        ------
        InputError
            If the share is not between 0 and 1.
        """
        return _band(self.displacement, self.displacement_mean, self.displacement_std, share)

    def potential_band(self, share: float = 0.68) -> tuple[FloatArray, FloatArray]:
        """Return the same for the potential, (H, W) each, px²."""
        return _band(self.potential, self.potential_mean, self.potential_std, share)

    def added_to(self, dataset: xarray.Dataset, setup: Setup | None) -> xarray.Dataset:
        """Return the dataset of the inversion with the scatter of its samples.

        It then has ``potential_mean``, ``displacement_mean`` and a ``…_std`` for each potential,
        displacement and field. The method of the samples is a JSON text in the attribute
        ``uncertainty``.
        """
        values = {name: each for name, each in vars(self).items() if name in _STORED}
        values["linearity"] = self.linearity and asdict(self.linearity)
        means = {"potential": self.potential_mean, "displacement": self.displacement_mean}
        scatter = dataset_from_field(self.displacement_std, self.potential_std, setup)
        # each is its argument times a number, perhaps negative, perhaps with axes exchanged
        deviations = {str(name): np.abs(field.values) for name, field in scatter.items()}

        def statistic(name: str, quantity: str, values: FloatArray) -> tuple[Any, ...]:
            field = dataset[name]
            long_name = f"{field.attrs['long_name']}, {quantity} of noisy samples"
            return field.dims, values, label(field.attrs["units"], long_name)

        return dataset.assign(
            {f"{name}_mean": statistic(name, "mean", values) for name, values in means.items()}
            | {
                f"{name}_std": statistic(name, "standard deviation", values)
                for name, values in deviations.items()
            }
        ).assign_attrs(uncertainty=json.dumps(values))


def _band(
    value: FloatArray, mean: FloatArray, std: FloatArray, share: float
) -> tuple[FloatArray, FloatArray]:
    middle, width = 2 * value - mean, NormalDist().inv_cdf((1 + _checked_share(share)) / 2) * std
    return middle - width, middle + width
