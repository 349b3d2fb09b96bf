"""Source estimates and filters together with their parameters, to keep, show and hand on.

- guess the source: `UniformEstimate`, `IsotropicEstimate`, `GaussianEstimate`,
  `PolynomialEstimate`, `LowPassEstimate`, `TotalVariationEstimate`, `InterpolatedEstimate`; by
  name: `ESTIMATES`
- clean the image beforehand: `LowPassFilter`, `HighPassFilter`, `ButterworthFilter`,
  `BackgroundFilter`, `HotPixelFilter`; by name: `FILTERS`

Each is a pydantic model whose fields are keywords of a function in `sources` or `filters`.
Defaults are those of the function, wherever it has one.

Examples
--------
>>> LowPassEstimate(width=20).described
'blurred shot, width 20.0'
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, PrivateAttr

from napari_shadowinv.errors import InputError

if TYPE_CHECKING:
    from napari_shadowinv._system.progress import OnWarning, ShouldStop
    from napari_shadowinv.physics.setup import Setup

__all__ = [
    "ESTIMATES",
    "FILTERS",
    "BackgroundFilter",
    "ButterworthFilter",
    "Estimate",
    "Filter",
    "GaussianEstimate",
    "HighPassFilter",
    "HotPixelFilter",
    "InterpolatedEstimate",
    "IsotropicEstimate",
    "LowPassEstimate",
    "LowPassFilter",
    "PolynomialEstimate",
    "TotalVariationEstimate",
    "UniformEstimate",
    "without_masked",
]

Image = NDArray[np.float64]
Mask = NDArray[np.bool_]


class _Recipe(BaseModel):
    """Something done to an image."""

    model_config = ConfigDict(frozen=True, extra="forbid")
    title: ClassVar[str]
    function: ClassVar[str]

    @property
    def described(self) -> str:
        """Title and parameters, the same for the same choices."""
        return ", ".join([self.title, *(f"{name} {value}" for name, value in self)])


class Estimate(_Recipe):
    """A way to guess the undisturbed beam from the shot.

    Attributes
    ----------
    needs_mask : bool
        Whether it does nothing without a mask.
    warns : bool
        Whether its function takes `on_warning`.
    """

    needs_mask: ClassVar[bool] = False
    warns: ClassVar[bool] = False

    def check(self, *, has_mask: bool) -> None:
        """Refuse to work without a mask where one is needed.

        Parameters
        ----------
        has_mask : bool
            Whether there is one.

        Raises
        ------
        InputError
            If there is none, and one is needed.
        """
        if self.needs_mask and not has_mask:
            raise InputError(
                f"got the estimate '{self.title}' without a mask: it fills in the masked pixels; "
                "choose a mask that covers the object"
            )

    def placed(
        self,
        setup: Setup | None,
        shape: tuple[int, ...],
        corner: tuple[int, int] = (0, 0),
    ) -> Estimate:
        """Return the same for the images of an experiment; most estimates do not depend on it.

        Parameters
        ----------
        setup : Setup or None
            The experiment, None if it is not known.
        shape : tuple of int
            Shape (H, W) of the whole image.
        corner : tuple of int, optional
            First row and column of the part of it whose source is to be estimated.

        Raises
        ------
        InputError
            If the estimate needs another setup.
        """
        return self

    def source(
        self,
        image: Image,
        mask: Mask | None,
        should_stop: ShouldStop | None = None,
        on_warning: OnWarning | None = None,
    ) -> Image:
        """Estimate the source by a function of `napari_shadowinv.preprocessing.sources`.

        Parameters
        ----------
        image : ndarray, shape (H, W)
            The shot.
        mask : ndarray of bool, shape (H, W), or None
            The pixels to look at.
        should_stop : callable, optional
            Asked now and then by estimates that take long.
        on_warning : callable, optional
            Receives a sentence where the estimate has to be doubted. Default: `warnings.warn`.

        Returns
        -------
        ndarray, shape (H, W)

        Raises
        ------
        InputError
            If the image cannot be used.
        InversionCancelled
            If `should_stop` returned true.
        """
        from napari_shadowinv.preprocessing import sources

        self.check(has_mask=mask is not None)
        told = {"on_warning": on_warning} if self.warns else {}
        estimated: Image = getattr(sources, self.function)(
            image, mask=mask, should_stop=should_stop, **told, **self.model_dump()
        )
        return estimated

    def coarser(self, factor: int) -> Estimate:
        """Return the same for an image with pixels `factor` times as large."""
        lengths = {
            name: getattr(self, name) / factor
            for name, field in type(self).model_fields.items()
            if (field.title or "").endswith("(px)")
        }
        return self.model_copy(update=lengths)


class Filter(_Recipe):
    """Something done to the image before its inversion."""

    @property
    def flattens(self) -> bool:
        """Whether it takes the beam out of the image, so that a measured source fits no more."""
        return False

    def filtered(
        self, image: Image, mask: Mask | None, should_stop: ShouldStop | None = None
    ) -> Image:
        """Apply it, so that what is masked, even NaN, does not touch the rest.

        Parameters
        ----------
        image : ndarray, shape (H, W)
            The shot.
        mask : ndarray of bool, shape (H, W), or None
            The pixels that can be used.
        should_stop : callable, optional
            Asked now and then by filters that take long.

        Returns
        -------
        ndarray, shape (H, W)

        Raises
        ------
        InputError
            If the image cannot be used.
        InversionCancelled
            If `should_stop` returned true.
        """
        return self._applied(without_masked(image, mask, should_stop), mask, should_stop)

    def _applied(self, image: Image, mask: Mask | None, should_stop: ShouldStop | None) -> Image:
        """Apply a function of `napari_shadowinv.preprocessing.filters`."""
        from napari_shadowinv.preprocessing import filters

        result: Image = getattr(filters, self.function)(image, **self.model_dump())
        return result


def without_masked(image: Image, mask: Mask | None, should_stop: ShouldStop | None = None) -> Image:
    """Fill in masked pixels from around them, so that nothing of them leaks out.

    Parameters
    ----------
    image, mask, should_stop
        See `Filter.filtered`.

    Returns
    -------
    ndarray, shape (H, W)
    """
    if mask is None or mask.all() or not mask.any():
        return image
    from napari_shadowinv.preprocessing.sources import interpolated_source

    return np.where(mask, image, interpolated_source(image, mask, should_stop=should_stop))


def _degree(description: str) -> Any:
    return Field(
        default=2,
        ge=0,
        le=10,
        title="Degree",
        description=f"Total degree of the polynomial{description}",
        json_schema_extra={"slider": [0, 10]},
    )


def _width(default: float, description: str, least: float, most: float) -> Any:
    return Field(
        default=default,
        gt=0,
        title="Width (px)",
        description=description,
        json_schema_extra={"slider": [least, most]},
    )


class UniformEstimate(Estimate):
    """The same everywhere."""

    title = "uniform"
    function = "uniform_source"

    def source(
        self,
        image: Image,
        mask: Mask | None,
        should_stop: ShouldStop | None = None,
        on_warning: OnWarning | None = None,
    ) -> Image:
        from napari_shadowinv.preprocessing.sources import uniform_source

        return uniform_source(image, mask=mask)


class IsotropicEstimate(Estimate):
    """A point that shines evenly in all directions, on a flat detector."""

    title = "isotropic point source"
    function = "isotropic_source"
    centre_y: float | None = Field(
        default=None,
        allow_inf_nan=False,
        title="Centre y (px)",
        description="Row at which the detector faces the source. Default: the image centre.",
    )
    centre_x: float | None = Field(
        default=None,
        allow_inf_nan=False,
        title="Centre x (px)",
        description="Column at which the detector faces the source. Default: the image centre.",
    )
    # Not a parameter: every face of the package asks for the setup elsewhere.
    _setup: Any = PrivateAttr(default=None)

    def placed(
        self,
        setup: Setup | None,
        shape: tuple[int, ...],
        corner: tuple[int, int] = (0, 0),
    ) -> Estimate:
        if setup is None:
            raise _without_setup()
        from napari_shadowinv.preprocessing.sources import point_distance

        point_distance(setup)  # refuses a collimated beam before any work
        height, width = shape
        y = (height - 1) / 2 if self.centre_y is None else self.centre_y
        x = (width - 1) / 2 if self.centre_x is None else self.centre_x
        return self._at(y - corner[0], x - corner[1], setup)

    def source(
        self,
        image: Image,
        mask: Mask | None,
        should_stop: ShouldStop | None = None,
        on_warning: OnWarning | None = None,
    ) -> Image:
        from napari_shadowinv.preprocessing.sources import isotropic_source

        if self._setup is None:
            raise _without_setup()
        return isotropic_source(image, self._setup, mask=mask, **self.model_dump())

    def coarser(self, factor: int) -> Estimate:
        if self._setup is None or self.centre_y is None or self.centre_x is None:
            return self
        from napari_shadowinv.physics.setup import binned_setup

        y, x = ((c + 0.5) / factor - 0.5 for c in (self.centre_y, self.centre_x))
        return self._at(y, x, binned_setup(self._setup, factor))

    def _at(self, y: float, x: float, setup: Setup) -> Self:
        placed = self.model_copy(update={"centre_y": y, "centre_x": x})
        placed._setup = setup
        return placed


def _without_setup() -> InputError:
    return InputError(
        "got the source 'isotropic' without a setup, which is needed for the distance of the "
        "point source and the pixel size: give a setup, or choose the source 'uniform'"
    )


class GaussianEstimate(Estimate):
    """A fitted elliptical spot."""

    warns = True
    title = "fitted Gaussian"
    function = "gaussian_source"


class PolynomialEstimate(Estimate):
    """A fitted polynomial."""

    title = "fitted polynomial"
    function = "polynomial_source"
    degree: int = _degree(": 0 is flat, 2 is bowl-shaped, 10 follows fine detail.")


class LowPassEstimate(Estimate):
    """The blurred shot."""

    title = "blurred shot"
    function = "low_pass_source"
    width: float = _width(
        30.0,
        "Standard deviation of the Gaussian blur in px; use a few times the object's size.",
        1.0,
        200.0,
    )


class TotalVariationEstimate(Estimate):
    """The shot without small structures, but with its edges."""

    title = "total variation"
    function = "total_variation_source"
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
    function = "interpolated_source"
    width: float = _width(
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


class LowPassFilter(Filter):
    """Take away small structures."""

    title = "low-pass (smooth)"
    function = "low_pass"
    width: float = _width(1.0, "Standard deviation of the Gaussian blur in px.", 0.1, 20.0)


class HighPassFilter(Filter):
    """Take away large structures."""

    title = "high-pass"
    function = "high_pass"
    width: float = _width(
        50.0, "Structures much larger than this standard deviation, in px, are removed.", 1.0, 200.0
    )

    @property
    def flattens(self) -> bool:
        return True


class ButterworthFilter(Filter):
    """Take away large or small structures, with a chosen steepness."""

    title = "Butterworth"
    function = "butterworth"
    cutoff: float = Field(
        default=100.0,
        gt=0,
        title="Cutoff (px)",
        description="Wavelength in px at which the amplitude drops to 1/√2.",
        json_schema_extra={"slider": [2.0, 500.0]},
    )
    order: int = Field(
        default=2,
        ge=1,
        le=20,
        title="Order",
        description=(
            "Beyond the cutoff the amplitude falls as this power of the wavelength; high orders "
            "ring."
        ),
        json_schema_extra={"slider": [1, 20]},
    )
    kind: Literal["high", "low"] = Field(
        default="high",
        title="Keeps",
        description="'high' removes structures larger than the cutoff, 'low' removes smaller ones.",
    )

    @property
    def flattens(self) -> bool:
        return self.kind == "high"


class BackgroundFilter(Filter):
    """Flatten by a polynomial."""

    title = "flatten (polynomial)"
    function = "remove_background"
    degree: int = _degree(" that is divided out or subtracted.")
    kind: Literal["divide", "subtract"] = Field(
        default="divide",
        title="How",
        description="'divide' by the polynomial (uneven beam) or 'subtract' it (stray light).",
    )

    @property
    def flattens(self) -> bool:
        return True

    def _applied(self, image: Image, mask: Mask | None, should_stop: ShouldStop | None) -> Image:
        from napari_shadowinv.preprocessing.filters import remove_background

        return remove_background(
            image, self.degree, kind=self.kind, mask=mask, should_stop=should_stop
        )


class HotPixelFilter(Filter):
    """Replace broken pixels."""

    title = "remove hot pixels"
    function = "remove_hot_pixels"
    threshold: float = Field(
        default=6.0,
        gt=0,
        title="Threshold",
        description=(
            "Replace pixels that differ from the median of their neighbours by more than this "
            "many standard deviations of the noise."
        ),
        json_schema_extra={"slider": [2.0, 20.0]},
    )

    def _applied(self, image: Image, mask: Mask | None, should_stop: ShouldStop | None) -> Image:
        from napari_shadowinv.preprocessing.filters import remove_hot_pixels

        return remove_hot_pixels(image, threshold=self.threshold, should_stop=should_stop)[0]


ESTIMATES: dict[str, type[Estimate]] = {
    "uniform": UniformEstimate,
    "isotropic": IsotropicEstimate,
    "gaussian": GaussianEstimate,
    "polynomial": PolynomialEstimate,
    "low_pass": LowPassEstimate,
    "total_variation": TotalVariationEstimate,
    "interpolated": InterpolatedEstimate,
}
FILTERS: dict[str, type[Filter]] = {
    "low_pass": LowPassFilter,
    "high_pass": HighPassFilter,
    "butterworth": ButterworthFilter,
    "background": BackgroundFilter,
    "hot_pixels": HotPixelFilter,
}
