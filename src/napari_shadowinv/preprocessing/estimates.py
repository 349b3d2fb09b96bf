"""Estimates of the undisturbed beam, from an image that the object has already modulated.

An inversion needs the source: the image that the beam would make without the object. Where
none was recorded, or the beam changes from shot to shot, it must be estimated from the shot.

- the beam is flat, or nothing is known: `uniform_source`; whether it can be: `uniform_cautions`
- a point shines evenly in all directions: `isotropic_source`; how far away: `point_distance`
- the beam is a Gaussian spot: `gaussian_source`
- the beam varies slowly, in no known way: `polynomial_source`, `low_pass_source`
- the beam has edges that matter: `total_variation_source`
- the object covers a known part of the image: `interpolated_source`
- the beam is smooth and random, and visible around the object: `kriged_source`
- in a recipe: `Estimate` and the classes derived from it

Each takes an image ``[y, x]``, counts or any linear measure of fluence, and returns float64
of the same shape and unit that is positive everywhere and has the same flux over the usable
pixels. A `mask` is True where a pixel is usable; the others (dead areas, handwriting, a shadow)
may hold anything, NaN too, and are filled in. Default: all are usable.

An `InputError` refuses an image and a mask that cannot be used, an image without flux, a parameter
out of range, and an estimate that rises, where it sees nothing, to ten times the brightest pixel
it saw. Estimates that take long ask `should_stop` at each of their steps, that of total variation
before its first, and raise `InversionCancelled` when it returns true.

Structure that an estimate attributes to the beam is lost from the object, and vice versa. The
choice decides most of the error on large scales: Kasim et al., arXiv:1607.04179, section V.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import Any, ClassVar, Literal, Self

import numpy as np
import scipy
from numpy.typing import ArrayLike
from pydantic import Field, PrivateAttr

from napari_shadowinv._system.arrays import NORMAL_MAD, block_means
from napari_shadowinv._system.progress import Reporter, ShouldStop
from napari_shadowinv._typing import BoolArray, FloatArray
from napari_shadowinv.cautions import Caution, OnCaution, warn_of
from napari_shadowinv.errors import InputError
from napari_shadowinv.facts import percent, to_figures
from napari_shadowinv.options import BeamPrior
from napari_shadowinv.physics.setup import Setup, bin_setup
from napari_shadowinv.preprocessing import pixels
from napari_shadowinv.preprocessing.filters import low_pass
from napari_shadowinv.preprocessing.kriging import kriged_prior, kriged_source
from napari_shadowinv.preprocessing.steps import Choice, degree_field, width_field


class Estimate(Choice):
    """A way to estimate the undisturbed beam from the shot."""

    key = "method"
    # Takes the image and the parameters, and may take `mask`, `should_stop` and `on_caution`.
    function: ClassVar[Callable[..., FloatArray]]
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
        options = {"mask": mask, "should_stop": should_stop, "on_caution": on_caution}
        return self.call(self.function, image, **options)

    def beam_prior(
        self, image: FloatArray, mask: BoolArray | None, should_stop: ShouldStop | None = None
    ) -> BeamPrior | None:
        """Return the prior of the beam's difference from `source`, if the image determines it."""
        return None

    def coarsen(self, factor: int) -> Estimate:
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
    function = staticmethod(uniform_source)
    uses_mask = False
    place = 10
    method: Literal["uniform"] = "uniform"


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
    values: FloatArray, usable: BoolArray, width: float, report: Reporter, least: float = 1e-6
) -> tuple[FloatArray, BoolArray]:
    """Blur the usable pixels; return also where at least a share of them is within reach."""
    blur: Callable[[FloatArray], FloatArray] = partial(low_pass, width=width)
    if width < 2:  # px, with waves too short for the pixels; its time depends on the width
        blur = partial(scipy.ndimage.gaussian_filter, sigma=width, mode="reflect")
    report("source", 0, 2)
    support = blur(usable.astype(np.float64))
    report("source", 1, 2)
    blurred = blur(np.where(usable, values, 0.0))
    return blurred / np.maximum(support, least), support >= least


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
        Asked before the iterations, which take 10 s a megapixel and cannot be stopped.

    References
    ----------
    A. Chambolle, "An algorithm for total variation minimization and applications", Journal
    of Mathematical Imaging and Vision 20, 89 (2004).
    """
    from skimage.restoration import denoise_tv_chambolle

    values, usable = pixels.beam_pixels(image, mask)
    weight = pixels.checked_number("weight", weight, above=0, unit="px")
    iterations = pixels.checked_integer("iterations", iterations, least=1)
    report = Reporter(None, should_stop)
    complete = values if usable.all() else pixels.fill_masked(values, usable, report)
    mean = values[usable].mean()
    report("source", 0)
    relative = (complete / mean).astype(np.float32)
    # By scikit-image's own tolerance, fields would change by 17 to 64 times their noise error.
    smooth: FloatArray = denoise_tv_chambolle(  # type: ignore[no-untyped-call]
        relative, weight, eps=1e-7, max_num_iter=iterations
    )
    return pixels.with_flux_of(mean * smooth.astype(np.float64), values, usable)


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
        description="Strength of the smoothing, in px: c·r/2 removes a disc of radius r px and "
        "contrast c.",
        json_schema_extra={"slider": [0.05, 20.0]},
    )
    iterations: int = Field(
        default=1000,
        ge=1,
        description="Maximum iterations; an object of radius r px needs about r².",
    )

    def coarsen(self, factor: int) -> Estimate:
        # A step reaches one pixel farther: fewer steps go as far in larger pixels.
        steps = max(1, self.iterations // factor**2)
        return super().coarsen(factor).model_copy(update={"iterations": steps})


class InterpolatedEstimate(Estimate):
    """The shot, with the masked part filled in from around it."""

    needs_mask = True
    title = "filled in under the mask"
    function = staticmethod(pixels.interpolated_source)
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
        description="'biharmonic' continues the slope and curvature of the beam; use it for gaps "
        "inside the image. 'laplace' stays within the range of the surrounding values; use it for "
        "gaps at the edge.",
    )


class KrigedEstimate(Estimate):
    """A smooth random beam, predicted from around the object with its error."""

    needs_mask = True
    title = "predicted under the mask"
    function = staticmethod(kriged_source)
    place = 80
    method: Literal["kriged"] = "kriged"

    def beam_prior(
        self, image: FloatArray, mask: BoolArray | None, should_stop: ShouldStop | None = None
    ) -> BeamPrior:
        assert mask is not None
        return kriged_prior(image, mask, should_stop=should_stop)


def gaussian_source(
    image: ArrayLike,
    *,
    mask: ArrayLike | None = None,
    notable: float = 1.5,
    should_stop: ShouldStop | None = None,
    on_caution: OnCaution | None = None,
) -> FloatArray:
    """Elliptical Gaussian plus a constant, fitted to the image.

    It is an estimate as in `napari_shadowinv.preprocessing.estimates`.

    Parameters
    ----------
    image : array_like, shape (H, W)
    mask, should_stop : optional
    notable : float, default 1.5
        Rise under the mask, over the brightest pixel that was fitted, above which it is doubtful.
    on_caution : callable, optional
        Receives a `Caution` if the fit is doubtful. Default: `warnings.warn` with its text.

    Returns
    -------
    ndarray of float64, shape (H, W)
        Uniform if the fit rises under the mask to ten times the brightest usable pixel.

    Notes
    -----
    Least squares with the soft L1 loss, whose unit is the median absolute deviation of the
    residuals, found by fitting again until it stays: modulation stronger than that counts
    in proportion, not squared. Centre, both widths, tilt, height and constant are free; the
    last two are not negative. Large images are averaged in blocks for the fit. A Gaussian
    narrower than 1/256 of the image, higher than 1000 times the mean, or more than three sides
    away from the middle of the usable pixels is not considered.
    """
    values, usable = pixels.beam_pixels(image, mask)
    side, mean = max(values.shape), values[usable].mean()
    y, x, sample = _block_samples(values / mean, usable)
    parameters = _fit_gaussian(y / side, x / side, sample, Reporter(None, should_stop))
    rows, columns = (np.arange(n) / side for n in values.shape)
    beam = _gaussian(parameters, rows[:, None], columns)
    rise = float(beam.max() / sample.max())
    report_caution = on_caution or warn_of
    if rise > pixels.MAX_EXTRAPOLATION:
        text = (
            "no Gaussian beam can be fitted to the unmasked pixels, so the source is assumed "
            "uniform: mask less, or choose another estimate"
        )
        report_caution(Caution("source", text))
        return uniform_source(image, mask=mask)
    if rise > notable:
        text = (
            f"the Gaussian beam rises to {to_figures(rise)} times the fitted data under the mask: "
            "compare it with another estimate, or mask less"
        )
        report_caution(Caution("source", text))
    return pixels.with_flux_of(mean * beam, values, usable)


class GaussianEstimate(Estimate):
    """A fitted elliptical spot."""

    title = "fitted Gaussian"
    function = staticmethod(gaussian_source)
    place = 30
    method: Literal["gaussian"] = "gaussian"


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
    # Without bounds it may hide behind a mask: see the notes of `gaussian_source`.
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
    parameters = fitted(np.clip(_guess_gaussian(y, x, sample), *bounds), "linear", 1.0)
    scale = 0.0
    for _ in range(10):
        residual = _gaussian(parameters, y, x) - sample
        previous, scale = scale, max(NORMAL_MAD * float(np.median(np.abs(residual))), 1e-6)
        if abs(scale - previous) < 1e-2 * scale:
            break
        parameters = fitted(parameters, "soft_l1", scale)
    return parameters


def _guess_gaussian(y: FloatArray, x: FloatArray, sample: FloatArray) -> FloatArray:
    """Return parameters of `_gaussian` by the moments of the image above its dark corners."""
    constant, peak = (float(level) for level in np.percentile(sample, [2, 98]))
    weights = np.maximum(sample - constant, 0) + 1e-9
    centre_y, centre_x = np.average(y, weights=weights), np.average(x, weights=weights)
    widths = [
        max(float(np.sqrt(np.average((axis - centre) ** 2, weights=weights))), 1e-3)
        for axis, centre in ((y, centre_y), (x, centre_x))
    ]
    height = max(peak - constant, 1e-3)
    return np.array(
        [height, max(constant, 1e-3), centre_y, centre_x, 1 / widths[0], 0.0, 1 / widths[1]]
    )


def _gaussian(parameters: FloatArray, y: FloatArray, x: FloatArray) -> FloatArray:
    """Return height · exp(-½(u² + v²)) + constant, with u = a·dy + b·dx and v = c·dx."""
    # The factors of the inverse covariance, unlike its entries, may take any value.
    height, constant, centre_y, centre_x, a, b, c = parameters
    u = a * (y - centre_y) + b * (x - centre_x)
    v = c * (x - centre_x)
    return np.asarray(height * np.exp(-0.5 * (u**2 + v**2)) + constant)


def centre_within(
    shape: tuple[int, ...],
    matrix: FloatArray | None = None,
    y: float | None = None,
    x: float | None = None,
) -> tuple[float, float]:
    """Return the coordinates of a pixel of the recorded image, by default its centre, in a part."""
    recorded = [(n - 1) / 2 if c is None else c for n, c in zip(shape, (y, x), strict=True)]
    if matrix is not None:
        recorded = [float(v) for v in np.linalg.solve(matrix, [*recorded, 1.0])[:2]]
    return recorded[0], recorded[1]


def uniform_cautions(
    shape: tuple[int, int],
    setup: Setup | None,
    *,
    centre: tuple[float, float] | None = None,
    notable: float = 0.01,
) -> tuple[Caution, ...]:
    """Warn if a point source would light an image too unevenly to count as uniform.

    Parameters
    ----------
    shape : tuple of int
        Height and width of the image.
    setup : Setup or None
        The experiment; no warning if it is unknown.
    centre : tuple of float, optional
        Pixel (y, x) in which the detector faces the point. Default: the middle of the image.
    notable : float, default 0.01
        Fall of the fluence of an isotropic point source, from the brightest pixel to the dimmest.

    Returns
    -------
    tuple of Caution
        Empty where it does not fall by more.
    """
    if setup is None or setup.is_collimated:
        return ()
    distance = point_distance(setup)
    axis = centre_within(shape) if centre is None else centre
    places = list(zip(axis, shape, strict=True))
    near = [max(0.0, place - (side - 1), -place) for place, side in places]
    far = [max(place, side - 1 - place) for place, side in places]
    highest, lowest = ((1 + (math.hypot(*r) / distance) ** 2) ** -1.5 for r in (near, far))
    fall = 1 - lowest / highest
    if fall <= notable:
        return ()
    text = (
        f"the source is assumed uniform, but a point source {setup.source_object_distance:.3g} m "
        f"from the object lights this image unevenly, by {percent(fall)} between brightest and "
        "dimmest pixel: if yours emits isotropically, choose the source 'isotropic'"
    )
    return (Caution("source", text),)


def isotropic_source(
    image: ArrayLike,
    setup: Setup,
    *,
    centre_y: float | None = None,
    centre_x: float | None = None,
    mask: ArrayLike | None = None,
) -> FloatArray:
    """Beam of a point that shines evenly in all directions, on a flat detector.

    It is an estimate as in `napari_shadowinv.preprocessing.estimates`; an `InputError` also refuses
    a setup with a collimated beam.

    Parameters
    ----------
    image : array_like, shape (H, W)
        The shot; only its flux is used.
    setup : Setup
        The experiment: distance of the point, and side of a pixel.
    centre_y, centre_x : float, optional
        Pixel in which the detector faces the point. Default: the middle of the image.
    mask : array_like of bool, shape (H, W), optional

    Notes
    -----
    A pixel receives its share of the solid angle; for small pixels that is proportional to
    cos³θ, with θ the angle between its line of sight to the point and the detector's normal.

    Examples
    --------
    >>> from napari_shadowinv import ProtonSetup
    >>> beam = isotropic_source(np.ones((201, 201)), ProtonSetup.example())
    >>> float(round(beam[0, 0] / beam[100, 100], 3))  # the corner, 9.3 degrees from the axis
    0.961
    """
    values, usable = pixels.beam_pixels(image, mask)
    distance = point_distance(setup)
    centre = centre_within(values.shape, y=centre_y, x=centre_x)
    edges = []
    for axis, side, place in zip("yx", values.shape, centre, strict=True):
        if not math.isfinite(place):
            raise InputError(f"centre_{axis} is {place!r}, expected a finite number of px")
        edges.append((np.arange(-0.5, side) - place) / distance)
    y, x = edges[0][:, None], edges[1]
    # Solid angle of the rectangle between the axis and each corner of the pixels.
    angles = np.arctan2(y * x, np.sqrt(1 + y**2 + x**2))
    beam = np.diff(np.diff(angles, axis=0), axis=1)
    return np.asarray(beam * (values[usable].mean() / beam[usable].mean()))


def _centre_field(axis: str, line: str) -> Any:
    return Field(
        default=None,
        allow_inf_nan=False,
        title=f"Centre {axis} (px)",
        description=(
            f"{line} of the recorded image at which the detector faces the source. Default: its "
            "centre."
        ),
    )


class IsotropicEstimate(Estimate):
    """A point that shines evenly in all directions, on a flat detector."""

    title = "isotropic point source"
    function = staticmethod(isotropic_source)
    uses_mask = False
    place = 20
    method: Literal["isotropic"] = "isotropic"
    centre_y: float | None = _centre_field("y", "Row")
    centre_x: float | None = _centre_field("x", "Column")
    # Not a parameter: the user gives the setup elsewhere.
    _setup: Any = PrivateAttr(default=None)

    def adapt_to(
        self, setup: Setup | None, shape: tuple[int, int], matrix: FloatArray | None = None
    ) -> Estimate:
        point_distance(setup)  # refuses a collimated beam before any work
        return self._at(*centre_within(shape, matrix, self.centre_y, self.centre_x), setup)

    def coarsen(self, factor: int) -> Estimate:
        if self._setup is None or self.centre_y is None or self.centre_x is None:
            return self
        y, x = ((c + 0.5) / factor - 0.5 for c in (self.centre_y, self.centre_x))
        return self._at(y, x, bin_setup(self._setup, factor))

    def call(self, function: Callable[..., FloatArray], *args: Any, **options: Any) -> FloatArray:
        point_distance(self._setup)  # refuses a missing setup before a wrong image
        return super().call(function, *args, setup=self._setup, **options)

    def _at(self, y: float, x: float, setup: Setup | None) -> Self:
        estimate = self.model_copy(update={"centre_y": y, "centre_x": x})
        estimate._setup = setup
        return estimate


def point_distance(setup: Setup | None) -> float:
    """Return the distance from the point source to the detector, in px of the detector."""
    if setup is None:
        raise InputError(
            "got the source 'isotropic' without a setup, which is needed for the distance of the "
            "point source and the pixel size: give a setup, or choose the source 'uniform'"
        )
    if setup.is_collimated:
        raise InputError(
            "got the source 'isotropic' and a setup with a collimated beam (the distance from "
            "source to object is inf): give the distance of the point source, or choose the source "
            "'uniform'"
        )
    # The magnification enlarges distance and pixel alike.
    return setup.source_object_distance / setup.object_pixel_size
