"""Estimates of the undisturbed beam, from an image that the object has already modulated.

An inversion needs the source: the image that the beam would make without the object. Where
none was recorded, or the beam changes from shot to shot, it must be estimated from the shot.

- the beam is flat, or nothing is known: `uniform_source`; whether it can be: `uniform_warnings`
- a point shines evenly in all directions: `isotropic_source`; how far away: `point_distance`
- the beam is a Gaussian spot: `gaussian_source`
- the beam varies slowly, in no known way: `polynomial_source`, `low_pass_source`
- the beam has edges that matter: `total_variation_source`
- the object covers a known part of the image: `interpolated_source`

Each takes an image ``[y, x]`` and returns one of the same shape that is positive everywhere
and has the same flux over the usable pixels. A `mask` is True where a pixel is usable; the
others (dead areas, handwriting, a shadow) may hold anything, NaN too, and are filled in.
An estimate that rises there to ten times the brightest pixel it saw is refused.
Those that take long ask `should_stop` at each of their steps.

Structure that an estimate attributes to the beam is lost from the object, and vice versa. The
choice decides most of the error on large scales: Kasim et al., arXiv:1607.04179, section V.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
import scipy
from numpy.typing import ArrayLike
from pydantic import Field

from napari_shadowinv._system.progress import OnWarning, Reporter, ShouldStop
from napari_shadowinv._typing import BoolArray, FloatArray
from napari_shadowinv.preprocessing.estimate import Estimate
from napari_shadowinv.preprocessing.filling import FILL_WIDTH, filled, interpolated_source
from napari_shadowinv.preprocessing.filters import low_pass
from napari_shadowinv.preprocessing.pixels import (
    beam_pixels,
    checked_integer,
    checked_number,
    fit_polynomial,
    with_flux_of,
)
from napari_shadowinv.preprocessing.steps import degree_field, width_field

_LEAST_SUPPORT = 1e-6
_NARROWEST_WAVES = 2.0  # px; a Gaussian that is narrower has waves too short for the pixels


def uniform_source(image: ArrayLike, *, mask: ArrayLike | None = None) -> FloatArray:
    """Flat beam with the mean of the image.

    Parameters
    ----------
    image : array_like, shape (H, W)
        The shot; counts or any linear measure of fluence.
    mask : array_like of bool, shape (H, W), optional
        True where a pixel is usable. Default: everywhere.

    Returns
    -------
    ndarray of float64, shape (H, W)
        The same number everywhere, in the unit of `image`.

    Raises
    ------
    InputError
        If image and mask cannot be used, or the image has no flux.

    Examples
    --------
    >>> uniform_source([[1, 2], [3, 6]])
    array([[3., 3.], [3., 3.]])
    """
    values, usable = beam_pixels(image, mask)
    return np.full(values.shape, values[usable].mean())


class UniformEstimate(Estimate):
    """The same everywhere."""

    title = "uniform"
    uses_mask = False
    method: Literal["uniform"] = "uniform"

    def _source(
        self,
        image: FloatArray,
        mask: BoolArray | None,
        should_stop: ShouldStop | None,
        on_warning: OnWarning | None,
    ) -> FloatArray:
        return uniform_source(image, mask=mask)


def polynomial_source(
    image: ArrayLike,
    *,
    degree: int = 2,
    mask: ArrayLike | None = None,
    should_stop: ShouldStop | None = None,
) -> FloatArray:
    """Polynomial in y and x, fitted to the image and little moved by its modulation.

    Parameters
    ----------
    image : array_like, shape (H, W)
        The shot; counts or any linear measure of fluence.
    degree : int, default 2
        Total degree of the polynomial in y and x, from 0 to 10.
    mask : array_like of bool, shape (H, W), optional
        True where a pixel is usable. Default: everywhere.
    should_stop : callable, optional
        Asked at each step; when it returns true the estimate ends.

    Returns
    -------
    ndarray of float64, shape (H, W)
        The fitted beam in the unit of `image`; where the polynomial falls below 0.001 of the
        image's mean, it is that.

    Raises
    ------
    InputError
        If image and mask cannot be used, the image has no flux, the degree is out of range,
        or there are fewer usable pixels than coefficients.
    InversionCancelled
        If `should_stop` returned true.

    See Also
    --------
    napari_shadowinv.preprocessing.filters.remove_background : flatten an image by the same fit.

    Examples
    --------
    >>> import numpy as np
    >>> ramp = np.linspace(1, 3, 50) * np.ones((50, 1))
    >>> float(abs(polynomial_source(ramp, degree=1) - ramp).max()) < 1e-12
    True
    """
    values, usable = beam_pixels(image, mask)
    fit = fit_polynomial(values, degree, mask=usable, should_stop=should_stop)
    return with_flux_of(fit, values, usable)


class PolynomialEstimate(Estimate):
    """A fitted polynomial."""

    title = "fitted polynomial"
    method: Literal["polynomial"] = "polynomial"
    degree: int = degree_field(": 0 is flat, 2 is bowl-shaped, 10 follows fine detail.")

    def _source(
        self,
        image: FloatArray,
        mask: BoolArray | None,
        should_stop: ShouldStop | None,
        on_warning: OnWarning | None,
    ) -> FloatArray:
        return polynomial_source(image, degree=self.degree, mask=mask, should_stop=should_stop)


def low_pass_source(
    image: ArrayLike,
    width: float,
    *,
    mask: ArrayLike | None = None,
    should_stop: ShouldStop | None = None,
) -> FloatArray:
    """The image, blurred until the object is gone.

    Parameters
    ----------
    image : array_like, shape (H, W)
        The shot; counts or any linear measure of fluence.
    width : float
        Standard deviation of the Gaussian blur in px; a few times the size of the object.
    mask : array_like of bool, shape (H, W), optional
        True where a pixel is usable. Default: everywhere.
    should_stop : callable, optional
        Asked at each step; when it returns true the estimate ends.

    Returns
    -------
    ndarray of float64, shape (H, W)
        The blurred image in its own unit: at each pixel the mean of the usable pixels around
        it, weighted by the Gaussian. Its border is mirrored.

    Raises
    ------
    InputError
        If image and mask cannot be used, the image has no flux, or the width is not positive.
    InversionCancelled
        If `should_stop` returned true.

    Notes
    -----
    Where no usable pixel is within reach, the width is doubled until there is one.

    Examples
    --------
    >>> import numpy as np
    >>> shot = 5 + np.random.default_rng(0).normal(size=(60, 60))
    >>> float(low_pass_source(shot, 10.0).std()) < 0.05
    True
    """
    values, usable = beam_pixels(image, mask)
    width = checked_number("width", width, above=0, unit="px")
    report = Reporter(None, should_stop)
    beam, support = _masked_blur(values, usable, width, report)
    while not support.all():
        width *= 2
        wider, reached = _masked_blur(values, usable, width, report)
        beam, support = np.where(support, beam, wider), support | reached
    return with_flux_of(beam, values, usable)


class LowPassEstimate(Estimate):
    """The blurred shot."""

    title = "blurred shot"
    method: Literal["low-pass"] = "low-pass"
    width: float = width_field(
        30.0,
        "Standard deviation of the Gaussian blur in px; use a few times the object's size.",
        1.0,
        200.0,
    )

    def _source(
        self,
        image: FloatArray,
        mask: BoolArray | None,
        should_stop: ShouldStop | None,
        on_warning: OnWarning | None,
    ) -> FloatArray:
        return low_pass_source(image, self.width, mask=mask, should_stop=should_stop)


def _masked_blur(
    values: FloatArray, usable: BoolArray, width: float, report: Reporter
) -> tuple[FloatArray, BoolArray]:
    """Blur of the usable pixels, and where there was enough of them to tell."""
    report("source", 0, 2)
    support = _blurred(usable.astype(np.float64), width)
    report("source", 1, 2)
    blurred = _blurred(np.where(usable, values, 0.0), width)
    return blurred / np.maximum(support, _LEAST_SUPPORT), support >= _LEAST_SUPPORT


def _blurred(values: FloatArray, width: float) -> FloatArray:
    """Gaussian blur with a mirrored border."""
    if width < _NARROWEST_WAVES:
        return np.asarray(scipy.ndimage.gaussian_filter(values, width, mode="reflect"))
    # Takes no longer for a wide Gaussian than for a narrow one.
    return low_pass(values, width)


def total_variation_source(
    image: ArrayLike,
    *,
    weight: float = 2.0,
    iterations: int = 1000,
    mask: ArrayLike | None = None,
    should_stop: ShouldStop | None = None,
) -> FloatArray:
    """The image without small structures, but with its edges.

    Parameters
    ----------
    image : array_like, shape (H, W)
        The shot; counts or any linear measure of fluence.
    weight : float, default 2
        Strength of the smoothing, in px: a disc of radius r px is lowered by 2·weight/r of the
        image's mean. So it takes c·r/2 to remove a disc of contrast c.
    iterations : int, default 1000
        Maximum iterations; an object of radius r px needs about r².
    mask : array_like of bool, shape (H, W), optional
        True where a pixel is usable. Default: everywhere. The others are first filled as by
        `interpolated_source`.
    should_stop : callable, optional
        Asked at each step; when it returns true the estimate ends.

    Returns
    -------
    ndarray of float64, shape (H, W)
        The smoothed image, in its own unit.

    Raises
    ------
    InputError
        If image and mask cannot be used, the image has no flux, or the weight or the number
        of iterations is not positive.
    InversionCancelled
        If `should_stop` returned true.

    References
    ----------
    A. Chambolle, "An algorithm for total variation minimization and applications", Journal
    of Mathematical Imaging and Vision 20, 89 (2004).

    Examples
    --------
    >>> import numpy as np
    >>> shot = np.where(np.arange(60) < 30, 2.0, 4.0) + np.zeros((60, 1))
    >>> shot[10:14, 10:14] = 3.0
    >>> beam = total_variation_source(shot, weight=0.5)
    >>> bool(abs(beam[10:14, 10:14] - 2).max() < 0.1), bool(beam[40, 30] - beam[40, 29] > 1.8)
    (True, True)
    """
    from napari_shadowinv.preprocessing._total_variation import least_variation

    values, usable = beam_pixels(image, mask)
    weight = checked_number("weight", weight, above=0, unit="px")
    iterations = checked_integer("iterations", iterations, least=1)
    report = Reporter(None, should_stop)
    whole = values if usable.all() else filled(values, usable, FILL_WIDTH, 2, report)
    mean = values[usable].mean()
    beam = mean * least_variation(whole / mean, weight, iterations, report)
    return with_flux_of(beam, values, usable)


class TotalVariationEstimate(Estimate):
    """The shot without small structures, but with its edges."""

    title = "total variation"
    method: Literal["total-variation"] = "total-variation"
    weight: float = Field(
        default=2.0,
        gt=0,
        title="Weight (px)",
        description=(
            "Strength of the smoothing, in px: c·r/2 removes a disc of radius r px and contrast c."
        ),
        json_schema_extra={"slider": [0.05, 20.0]},
    )
    iterations: int = Field(
        default=1000,
        ge=1,
        title="Iterations",
        description="Maximum iterations; an object of radius r px needs about r².",
    )

    def coarser(self, factor: int) -> Estimate:
        # A step reaches one pixel farther: fewer steps go as far in larger pixels.
        steps = max(1, self.iterations // factor**2)
        return super().coarser(factor).model_copy(update={"iterations": steps})

    def _source(
        self,
        image: FloatArray,
        mask: BoolArray | None,
        should_stop: ShouldStop | None,
        on_warning: OnWarning | None,
    ) -> FloatArray:
        return total_variation_source(
            image,
            weight=self.weight,
            iterations=self.iterations,
            mask=mask,
            should_stop=should_stop,
        )


class InterpolatedEstimate(Estimate):
    """The shot, with the masked part filled in from around it."""

    needs_mask = True
    title = "filled in under the mask"
    method: Literal["interpolated"] = "interpolated"
    width: float = width_field(
        5.0,
        "Standard deviation in px of the blur applied to the surroundings before they are "
        "extrapolated.",
        0.5,
        50.0,
    )
    kind: Literal["biharmonic", "laplace"] = Field(
        default="biharmonic",
        title="Continuation",
        description=(
            "'biharmonic' continues the slope and curvature of the beam; use it for gaps inside "
            "the image. 'laplace' stays within the range of the surrounding values; use it for "
            "gaps at the edge."
        ),
    )

    def _source(
        self,
        image: FloatArray,
        mask: BoolArray | None,
        should_stop: ShouldStop | None,
        on_warning: OnWarning | None,
    ) -> FloatArray:
        assert mask is not None  # checked before
        return interpolated_source(
            image, mask, width=self.width, kind=self.kind, should_stop=should_stop
        )
