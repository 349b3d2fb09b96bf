"""Estimates of the undisturbed beam, from an image that the object has already modulated.

An inversion needs the source: the image that the beam would make without the object. Where
none was recorded, or the beam changes from shot to shot, it must be estimated from the shot.

- the beam is flat, or nothing is known: `UniformEstimate`; whether it can be: `uniform_cautions`
- a point shines evenly in all directions: `IsotropicEstimate`; how far away: `point_distance`
- the beam is a Gaussian spot: `GaussianEstimate`
- the beam varies slowly, in no known way: `PolynomialEstimate`, `LowPassEstimate`
- the beam is smooth and random, and visible around the object: `KrigedEstimate`
- their base class: `Estimate`

Each is a source of a recipe, and makes that of one image by `Estimate.source`.

Structure that an estimate attributes to the beam is lost from the object, and vice versa. The
choice decides most of the error on large scales: Kasim et al., arXiv:1607.04179, section V.
"""

from __future__ import annotations

import math
from typing import ClassVar, Literal, Self

import numpy as np
import scipy
from numpy.typing import ArrayLike
from pydantic import PrivateAttr

from napari_shadowinv._system.progress import Reporter, ShouldStop
from napari_shadowinv._typing import BoolArray, FloatArray
from napari_shadowinv.cautions import Caution, OnCaution, warn_of
from napari_shadowinv.errors import InputError
from napari_shadowinv.facts import percent, to_figures
from napari_shadowinv.options import BeamPrior
from napari_shadowinv.physics.arrays import block_means
from napari_shadowinv.physics.setup import Setup
from napari_shadowinv.preprocessing import filters, pixels
from napari_shadowinv.preprocessing.kriging import kriged_prior, kriged_source
from napari_shadowinv.preprocessing.noise import NORMAL_MAD
from napari_shadowinv.preprocessing.steps import Choice, degree_field, width_field


class Estimate(Choice):
    """A way to estimate the undisturbed beam from the shot."""

    key = "method"
    needs_mask: ClassVar[bool] = False  # does it nothing without a mask
    uses_mask: ClassVar[bool] = True  # does it anything with one

    def adapt_to(
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
        image: ArrayLike,
        mask: ArrayLike | None = None,
        should_stop: ShouldStop | None = None,
        on_caution: OnCaution | None = None,
    ) -> FloatArray:
        """Estimate the source of an image.

        Parameters
        ----------
        image : array_like, shape (H, W)
            Counts, or any linear measure of fluence.
        mask : array_like of bool, shape (H, W), optional
            True where a pixel is usable; the others (dead areas, handwriting, a shadow) may hold
            anything, NaN too, and are filled in. Default: all are usable.
        should_stop : callable, optional
            Asked at each step of estimates that take long.
        on_caution : callable, optional
            Receives a `Caution` if the source is doubtful. Default: `warnings.warn` with its text.

        Returns
        -------
        ndarray of float64, shape (H, W)
            In the unit of the image, positive everywhere, with the same flux over the usable
            pixels.

        Raises
        ------
        InputError
            If image or mask cannot be used, the image has no flux, there is no mask where one is
            needed, or the estimate rises, where it sees nothing, to ten times the brightest pixel
            it saw.
        InversionCancelled
            If `should_stop` returned true.
        """
        values, usable = pixels.beam_pixels(image, mask)
        return self._estimate(values, usable, Reporter(None, should_stop), on_caution or warn_of)

    def _estimate(
        self, values: FloatArray, usable: BoolArray, report: Reporter, on_caution: OnCaution
    ) -> FloatArray:
        raise NotImplementedError

    def beam_prior(
        self, image: FloatArray, mask: BoolArray | None, should_stop: ShouldStop | None = None
    ) -> BeamPrior | None:
        """Return the prior of the beam's difference from `source`, if the image determines it."""
        return None


class UniformEstimate(Estimate):
    """The mean of the image, everywhere."""

    title = "uniform"
    uses_mask = False
    place = 10
    method: Literal["uniform"] = "uniform"

    def _estimate(
        self, values: FloatArray, usable: BoolArray, report: Reporter, on_caution: OnCaution
    ) -> FloatArray:
        return np.full(values.shape, values[usable].mean())


class PolynomialEstimate(Estimate):
    """A polynomial in y and x, fitted as by `fit_polynomial`.

    Where it falls below 0.001 of the image's mean, it is that.
    """

    title = "fitted polynomial"
    place = 40
    method: Literal["polynomial"] = "polynomial"
    degree: int = degree_field(": 0 is flat, 2 is bowl-shaped, 10 follows fine detail.")

    def _estimate(
        self, values: FloatArray, usable: BoolArray, report: Reporter, on_caution: OnCaution
    ) -> FloatArray:
        fit = pixels.fit_polynomial(values, usable, self.degree, report)
        return pixels.with_flux_of(fit, values, usable)


class LowPassEstimate(Estimate):
    """The shot, blurred until the object is gone.

    At each pixel it is the mean of the usable pixels around it, weighted by the Gaussian; its
    border is mirrored. Where none is within reach, the width is doubled until there is one.
    """

    title = "blurred shot"
    place = 50
    method: Literal["low-pass"] = "low-pass"
    width: float = width_field(
        30.0,
        "Standard deviation of the Gaussian blur in px; use a few times the object's size.",
        2.0,
        200.0,
    )

    def _estimate(
        self, values: FloatArray, usable: BoolArray, report: Reporter, on_caution: OnCaution
    ) -> FloatArray:
        width = self.width
        beam, support = _blur_masked(values, usable, width, report)
        while not support.all():
            width *= 2
            wider, reached = _blur_masked(values, usable, width, report)
            beam, support = np.where(support, beam, wider), support | reached
        return pixels.with_flux_of(beam, values, usable)


def _blur_masked(
    values: FloatArray, usable: BoolArray, width: float, report: Reporter, least: float = 1e-6
) -> tuple[FloatArray, BoolArray]:
    """Blur the usable pixels; return also where at least a share of them is within reach."""
    report("source", 0, 2)
    support = filters.blur(usable.astype(np.float64), width)
    report("source", 1, 2)
    blurred = filters.blur(np.where(usable, values, 0.0), width)
    return blurred / np.maximum(support, least), support >= least


class KrigedEstimate(Estimate):
    """A smooth random beam, predicted from around the object with its error.

    The mask must hide the object with its halo: there is a caution if the beam next to the masked
    pixels is not as the pixels farther away predict it. An `InputError` also refuses an image in
    which hardly a pixel is free of the object, or every one.
    """

    needs_mask = True
    title = "predicted under the mask"
    place = 80
    method: Literal["kriged"] = "kriged"

    def _estimate(
        self, values: FloatArray, usable: BoolArray, report: Reporter, on_caution: OnCaution
    ) -> FloatArray:
        return kriged_source(values, usable, report, on_caution)

    def beam_prior(
        self, image: FloatArray, mask: BoolArray | None, should_stop: ShouldStop | None = None
    ) -> BeamPrior:
        assert mask is not None
        return kriged_prior(image, mask, should_stop=should_stop)


class GaussianEstimate(Estimate):
    """An elliptical Gaussian plus a constant, fitted to the shot.

    There is a caution if it rises under the mask to 1.5 times the brightest pixel that was fitted.

    Notes
    -----
    Least squares with the soft L1 loss, whose unit is the median absolute deviation of the
    residuals, found by fitting again until it stays: modulation stronger than that counts
    in proportion, not squared. Centre, both widths, tilt, height and constant are free; the
    last two are not negative. Large images are averaged in blocks for the fit. A Gaussian
    narrower than 1/256 of the image, higher than 1000 times the mean, or more than three sides
    away from the middle of the usable pixels is not considered.
    """

    notable: ClassVar[float] = 1.5  # rise under the mask
    title = "fitted Gaussian"
    place = 30
    method: Literal["gaussian"] = "gaussian"

    def _estimate(
        self, values: FloatArray, usable: BoolArray, report: Reporter, on_caution: OnCaution
    ) -> FloatArray:
        side, mean = max(values.shape), values[usable].mean()
        y, x, sample = _block_samples(values / mean, usable)
        parameters = _fit_gaussian(y / side, x / side, sample, report)
        rows, columns = (np.arange(n) / side for n in values.shape)
        beam = _gaussian(parameters, rows[:, None], columns)
        rise = float(beam.max() / sample.max())
        source = pixels.with_flux_of(mean * beam, values, usable)
        if rise > self.notable:
            text = (
                f"the Gaussian beam rises to {to_figures(rise)} times the fitted data under the "
                "mask: compare it with another estimate, or mask less"
            )
            on_caution(Caution("source", text))
        return source


def _block_samples(
    values: FloatArray, usable: BoolArray, most: int = 2**16
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return positions y, x and means of blocks of usable pixels, few enough for a fit."""
    block = int(np.ceil(np.sqrt(values.size / most)))
    share = block_means(usable.astype(np.float64), block)
    means = block_means(np.where(usable, values, 0.0), block)
    # A block is used only if it is complete, since a part of it has another middle.
    # Under a mask so fine that no block is complete, the fullest are used.
    y, x = np.nonzero(share >= share.max())
    middle = (block - 1) / 2
    rows, columns = (np.asarray(axis * block + middle, dtype=np.float64) for axis in (y, x))
    return rows, columns, np.asarray(means[y, x] / share[y, x])


def _fit_gaussian(y: FloatArray, x: FloatArray, sample: FloatArray, report: Reporter) -> FloatArray:
    """Fit the parameters of `_gaussian` to samples, by repeated robust least squares."""
    # Without bounds it may hide behind a mask: see the notes of `GaussianEstimate`.
    ranges = [
        *[(0, 1e3)] * 2,
        *((axis.mean() - 3, axis.mean() + 3) for axis in (y, x)),
        *[(-256.0, 256.0)] * 3,
    ]
    bounds = tuple(np.transpose(ranges))

    def excess(p: FloatArray) -> FloatArray:
        report("source", 0)
        return _gaussian(p, y, x) - sample

    def fitted(start: FloatArray, loss: str, scale: float) -> FloatArray:
        fit = scipy.optimize.least_squares(
            excess, start, bounds=bounds, loss=loss, f_scale=scale, x_scale="jac", max_nfev=200
        )
        return np.asarray(fit.x)

    # A plain fit first: the robust loss, from far away, would call the whole beam an outlier.
    constant, peak = np.percentile(sample, [2, 98])
    guess = [peak - constant, constant, y.mean(), x.mean(), 4.0, 0.0, 4.0]
    parameters = fitted(np.maximum(guess, bounds[0] + 1e-3), "linear", 1.0)
    scale = 0.0
    for _ in range(10):
        residual = _gaussian(parameters, y, x) - sample
        previous, scale = scale, max(NORMAL_MAD * float(np.median(np.abs(residual))), 1e-6)
        if abs(scale - previous) < 1e-2 * scale:
            break
        parameters = fitted(parameters, "soft_l1", scale)
    return parameters


def _gaussian(parameters: FloatArray, y: FloatArray, x: FloatArray) -> FloatArray:
    """Return height · exp(-½(u² + v²)) + constant, with u = a·dy + b·dx and v = c·dx."""
    # The factors of the inverse covariance, unlike its entries, may take any value.
    height, constant, centre_y, centre_x, a, b, c = parameters
    u = a * (y - centre_y) + b * (x - centre_x)
    v = c * (x - centre_x)
    return np.asarray(height * np.exp(-0.5 * (u**2 + v**2)) + constant)


def uniform_cautions(
    setup: Setup | None,
    shape: tuple[int, int],
    recorded: tuple[int, int],
    matrix: FloatArray,
    *,
    notable: float = 0.01,
) -> tuple[Caution, ...]:
    """Warn if an isotropic point source would light an image too unevenly to count as uniform.

    The fluence may fall by a `notable` share from the brightest pixel of the image, (H, W), to the
    dimmest; the recorded image and the matrix to it are those of `Estimate.adapt_to`.
    """
    if setup is None or setup.is_collimated:
        return ()
    point = IsotropicEstimate().adapt_to(setup, recorded, matrix)
    fall = point.fall_over(shape)
    if fall <= notable:
        return ()
    text = (
        f"the source is assumed uniform, but a point source {setup.source_object_distance:.3g} m "
        f"from the object lights this image unevenly, by {percent(fall)} between brightest and "
        "dimmest pixel: if yours emits isotropically, choose the source 'isotropic'"
    )
    return (Caution("source", text),)


class IsotropicEstimate(Estimate):
    """A point that shines evenly in all directions, on a flat detector that faces it in its middle.

    It needs a setup with a point source, by `adapt_to`, for the distance of the point and the side
    of a pixel.

    Notes
    -----
    A pixel receives its share of the solid angle; for small pixels that is proportional to
    cos³θ, with θ the angle between its line of sight to the point and the detector's normal.

    Examples
    --------
    >>> from napari_shadowinv import ProtonSetup
    >>> shape = (201, 201)
    >>> beam = IsotropicEstimate().adapt_to(ProtonSetup.example(), shape).source(np.ones(shape))
    >>> float(round(beam[0, 0] / beam[100, 100], 3))  # the corner, 9.3 degrees from the axis
    0.961
    """

    title = "isotropic point source"
    uses_mask = False
    place = 20
    method: Literal["isotropic"] = "isotropic"
    # Distance of the point and place of the axis, px: the user gives the setup elsewhere.
    _point: tuple[float, tuple[float, float]] | None = PrivateAttr(default=None)

    def adapt_to(
        self, setup: Setup | None, shape: tuple[int, int], matrix: FloatArray | None = None
    ) -> Self:
        middle = [(side - 1) / 2 for side in shape]
        if matrix is not None:
            middle = [float(v) for v in np.linalg.solve(matrix, [*middle, 1.0])[:2]]
        estimate = self.model_copy()
        estimate._point = point_distance(setup), (middle[0], middle[1])
        return estimate

    def fall_over(self, shape: tuple[int, int]) -> float:
        """Return the fall of the fluence from the brightest pixel of an image to the dimmest."""
        distance, axis = self._point or (point_distance(None), ())
        places = list(zip(axis, shape, strict=True))
        near = [max(0.0, place - (side - 1), -place) for place, side in places]
        far = [max(place, side - 1 - place) for place, side in places]
        highest, lowest = ((1 + (math.hypot(*r) / distance) ** 2) ** -1.5 for r in (near, far))
        return float(1 - lowest / highest)

    def _estimate(
        self, values: FloatArray, usable: BoolArray, report: Reporter, on_caution: OnCaution
    ) -> FloatArray:
        distance, axis = self._point or (point_distance(None), ())  # refused without a setup
        # Solid angle of the rectangle between the axis and each corner of the pixels.
        y, x = (
            (np.arange(-0.5, side) - place) / distance
            for side, place in zip(values.shape, axis, strict=True)
        )
        angles = np.arctan2(y[:, None] * x, np.sqrt(1 + y[:, None] ** 2 + x**2))
        beam = np.diff(np.diff(angles, axis=0), axis=1)
        return np.asarray(beam * (values[usable].mean() / beam[usable].mean()))


def point_distance(setup: Setup | None) -> float:
    """Return the distance from the point source to the detector, in px of the detector."""
    if setup is None or setup.is_collimated:
        received = "a setup with a collimated beam" if setup else "no setup"
        raise InputError(
            f"got the source 'isotropic' and {received}, but it needs the distance of a point "
            "source and the pixel size: give a setup with them, or choose the source 'uniform'"
        )
    # The magnification enlarges distance and pixel alike.
    return setup.source_object_distance / setup.object_pixel_size
