"""Estimates of the undisturbed beam, from an image that the object has already modulated.

An inversion needs the source: the image that the beam would make without the object. Where
none was recorded, or the beam changes from shot to shot, it must be estimated from the shot.

- the beam is flat, or nothing is known: `uniform_source`; whether it can be: `uniform_warnings`
- a point shines evenly in all directions: `isotropic_source`; how far away: `point_distance`
- the beam is a Gaussian spot: `gaussian_source`
- the beam varies slowly, in no known way: `polynomial_source`, `low_pass_source`
- the beam has edges that matter: `total_variation_source`
- the object covers a known part of the image: `interpolated_source`
- their base class in a recipe: `Estimate`

Each takes an image ``[y, x]``, counts or any linear measure of fluence, and returns float64
of the same shape and unit that is positive everywhere and has the same flux over the usable
pixels. A `mask` is True where a pixel is usable; the others (dead areas, handwriting, a shadow)
may hold anything, NaN too, and are filled in. Default: all are usable.

An `InputError` refuses an image and a mask that cannot be used, an image without flux, a parameter
out of range, and an estimate that rises, where it sees nothing, to ten times the brightest pixel
it saw. Estimates that take long ask `should_stop` at each of their steps, and raise
`InversionCancelled` when it returns true.

Structure that an estimate attributes to the beam is lost from the object, and vice versa. The
choice decides most of the error on large scales: Kasim et al., arXiv:1607.04179, section V.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import numpy as np
import scipy
from numpy.typing import ArrayLike
from pydantic import Field

from napari_shadowinv._system.progress import Reporter, ShouldStop
from napari_shadowinv._typing import BoolArray, FloatArray
from napari_shadowinv.cautions import OnCaution
from napari_shadowinv.errors import InputError
from napari_shadowinv.preprocessing import pixels
from napari_shadowinv.preprocessing.filling import FILL_WIDTH, fill_masked, interpolated_source
from napari_shadowinv.preprocessing.filters import low_pass
from napari_shadowinv.preprocessing.steps import Choice, degree_field, width_field

if TYPE_CHECKING:
    from napari_shadowinv.physics.setup import Setup

_LEAST_SUPPORT = 1e-6
_NARROWEST_WAVES = 2.0  # px; a Gaussian that is narrower has waves too short for the pixels


class Estimate(Choice):
    """A way to estimate the undisturbed beam from the shot."""

    key = "method"
    # Makes the source; takes the image, the parameters, ``mask`` and ``should_stop``.
    function: ClassVar[Callable[..., FloatArray]]
    needs_mask: ClassVar[bool] = False  # does it nothing without a mask
    uses_mask: ClassVar[bool] = True  # does it anything with one

    def placed(
        self, setup: Setup | None, shape: tuple[int, int], matrix: FloatArray | None = None
    ) -> Estimate:
        """Return the estimate for the images of an experiment; most do not depend on it.

        The setup, or None if unknown, belongs to the image whose source is estimated, the shape
        (H, W) to the recorded image; the matrix, shape (3, 3), takes (y, x, 1) from the first to
        the second. Default: both are the same. Raises an `InputError` if it needs another setup.
        """
        return self

    def source(
        self,
        image: FloatArray,
        mask: BoolArray | None,
        should_stop: ShouldStop | None = None,
        on_caution: OnCaution | None = None,
    ) -> FloatArray:
        """Estimate the source; `on_caution` receives a `Caution` if it is doubtful.

        An `InputError` if the image cannot be used, or there is no mask where one is needed.
        """
        if self.needs_mask and mask is None:
            raise InputError(
                f"got the estimate '{self.title}' without a mask: it fills in the masked pixels; "
                "choose a mask that covers the object"
            )
        return self._source(image, mask, should_stop, on_caution)

    def _source(
        self,
        image: FloatArray,
        mask: BoolArray | None,
        should_stop: ShouldStop | None,
        on_caution: OnCaution | None,
    ) -> FloatArray:
        return self.function(image, mask=mask, should_stop=should_stop, **self.values())

    def coarser(self, factor: int) -> Estimate:
        """Return the estimate for an image with pixels `factor` times as large."""
        lengths = {
            name: getattr(self, name) / factor
            for name, field in self.parameters().items()
            if (field.title or "").endswith("(px)")
        }
        return self.model_copy(update=lengths)


def uniform_source(image: ArrayLike, *, mask: ArrayLike | None = None) -> FloatArray:
    """Flat beam with the mean of the image.

    Parameters
    ----------
    image : array_like, shape (H, W)
    mask : array_like of bool, shape (H, W), optional

    Examples
    --------
    >>> uniform_source([[1, 2], [3, 6]])
    array([[3., 3.], [3., 3.]])
    """
    values, usable = pixels.beam_pixels(image, mask)
    return np.full(values.shape, values[usable].mean())


class UniformEstimate(Estimate):
    """The same everywhere."""

    title = "uniform"
    uses_mask = False
    place = 10
    method: Literal["uniform"] = "uniform"

    def _source(self, image: FloatArray, mask: BoolArray | None, *_: Any) -> FloatArray:
        return uniform_source(image, mask=mask)


def polynomial_source(
    image: ArrayLike,
    *,
    degree: int = 2,
    mask: ArrayLike | None = None,
    should_stop: ShouldStop | None = None,
) -> FloatArray:
    """Polynomial in y and x, fitted to the image as by `fit_polynomial`.

    Parameters
    ----------
    image : array_like, shape (H, W)
    degree : int, default 2
        Total degree of the polynomial in y and x, from 0 to 10.
    mask, should_stop : optional

    Returns
    -------
    ndarray of float64, shape (H, W)
        Where the polynomial falls below 0.001 of the image's mean, it is that.
    """
    values, usable = pixels.beam_pixels(image, mask)
    fit = pixels.fit_polynomial(values, degree, mask=usable, should_stop=should_stop)
    return pixels.with_flux_of(fit, values, usable)


class PolynomialEstimate(Estimate):
    """A fitted polynomial."""

    title = "fitted polynomial"
    function = staticmethod(polynomial_source)
    place = 40
    method: Literal["polynomial"] = "polynomial"
    degree: int = degree_field(": 0 is flat, 2 is bowl-shaped, 10 follows fine detail.")


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
    width : float
        Standard deviation of the Gaussian blur in px; a few times the size of the object.
    mask, should_stop : optional

    Returns
    -------
    ndarray of float64, shape (H, W)
        At each pixel the mean of the usable pixels around it, weighted by the Gaussian; its border
        is mirrored. Where none is within reach, the width is doubled until there is one.
    """
    values, usable = pixels.beam_pixels(image, mask)
    width = pixels.checked_number("width", width, above=0, unit="px")
    report = Reporter(None, should_stop)
    beam, support = _blur_masked(values, usable, width, report)
    while not support.all():
        width *= 2
        wider, reached = _blur_masked(values, usable, width, report)
        beam, support = np.where(support, beam, wider), support | reached
    return pixels.with_flux_of(beam, values, usable)


class LowPassEstimate(Estimate):
    """The blurred shot."""

    title = "blurred shot"
    function = staticmethod(low_pass_source)
    place = 50
    method: Literal["low-pass"] = "low-pass"
    width: float = width_field(
        30.0,
        "Standard deviation of the Gaussian blur in px; use a few times the object's size.",
        1.0,
        200.0,
    )


def _blur_masked(
    values: FloatArray, usable: BoolArray, width: float, report: Reporter
) -> tuple[FloatArray, BoolArray]:
    """Blur the usable pixels; return also where enough of them are within reach."""
    report("source", 0, 2)
    support = _blur(usable.astype(np.float64), width)
    report("source", 1, 2)
    blurred = _blur(np.where(usable, values, 0.0), width)
    return blurred / np.maximum(support, _LEAST_SUPPORT), support >= _LEAST_SUPPORT


def _blur(values: FloatArray, width: float) -> FloatArray:
    """Blur by a Gaussian with a mirrored border."""
    if width < _NARROWEST_WAVES:
        return np.asarray(scipy.ndimage.gaussian_filter(values, width, mode="reflect"))
    # Its time does not depend on the width.
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
    weight : float, default 2
        Strength of the smoothing, in px: a disc of radius r px is lowered by 2·weight/r of the
        image's mean. So it takes c·r/2 to remove a disc of contrast c.
    iterations : int, default 1000
        Maximum iterations; an object of radius r px needs about r².
    mask : array_like of bool, shape (H, W), optional
        Unusable pixels are first filled as by `interpolated_source`.
    should_stop : callable, optional

    References
    ----------
    A. Chambolle, "An algorithm for total variation minimization and applications", Journal
    of Mathematical Imaging and Vision 20, 89 (2004).
    """
    from napari_shadowinv.preprocessing._total_variation import least_variation

    values, usable = pixels.beam_pixels(image, mask)
    weight = pixels.checked_number("weight", weight, above=0, unit="px")
    iterations = pixels.checked_integer("iterations", iterations, least=1)
    report = Reporter(None, should_stop)
    complete = values if usable.all() else fill_masked(values, usable, FILL_WIDTH, 2, report)
    mean = values[usable].mean()
    beam = mean * least_variation(complete / mean, weight, iterations, report)
    return pixels.with_flux_of(beam, values, usable)


class TotalVariationEstimate(Estimate):
    """The shot without small structures, but with its edges."""

    title = "total variation"
    function = staticmethod(total_variation_source)
    place = 60
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


class InterpolatedEstimate(Estimate):
    """The shot, with the masked part filled in from around it."""

    needs_mask = True
    title = "filled in under the mask"
    function = staticmethod(interpolated_source)
    place = 70
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
