"""Source estimates and filters with their parameters: what a form can show.

- how to guess the source: `ESTIMATES`
- how to clean the image beforehand: `FILTERS`

Each is a pydantic model with a method that does it. Defaults are those of the functions
that do the work, wherever these have one.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar, Literal

from pydantic import BaseModel, ConfigDict, Field, JsonValue

from napari_shadowinv.errors import InputError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    Image = NDArray[np.float64]
    Mask = NDArray[np.bool_]

__all__ = ["ESTIMATES", "FILTERS", "Estimate", "Filter"]

_WIDTHS: dict[str, JsonValue] = {"slider": [1.0, 200.0]}


class Estimate(BaseModel):
    """A way to guess the undisturbed beam from the shot."""

    model_config = ConfigDict(frozen=True, extra="forbid")
    title: ClassVar[str]

    def source(self, image: Image, mask: Mask | None) -> Image:
        """Estimate the source; see `napari_shadowinv.sources`."""
        raise NotImplementedError

    def coarser(self, factor: int) -> Estimate:
        """The same for an image with pixels `factor` times as large."""
        lengths = {
            name: getattr(self, name) / factor
            for name, field in type(self).model_fields.items()
            if (field.title or "").endswith("(px)")
        }
        return self.model_copy(update=lengths)


class UniformEstimate(Estimate):
    """The same everywhere."""

    title = "uniform"

    def source(self, image: Image, mask: Mask | None) -> Image:
        from napari_shadowinv.sources import uniform_source

        return uniform_source(image, mask=mask)


class GaussianEstimate(Estimate):
    """A fitted elliptical spot."""

    title = "fitted Gaussian"

    def source(self, image: Image, mask: Mask | None) -> Image:
        from napari_shadowinv.sources import gaussian_source

        return gaussian_source(image, mask=mask)


class PolynomialEstimate(Estimate):
    """A fitted polynomial."""

    title = "fitted polynomial"
    degree: int = Field(
        default=2,
        ge=0,
        le=10,
        title="Degree",
        description="Total degree of the polynomial: 0 is flat, 2 a bowl, 10 follows much.",
        json_schema_extra={"slider": [0, 10]},
    )

    def source(self, image: Image, mask: Mask | None) -> Image:
        from napari_shadowinv.sources import polynomial_source

        return polynomial_source(image, degree=self.degree, mask=mask)


class LowPassEstimate(Estimate):
    """The blurred shot."""

    title = "blurred shot"
    width: float = Field(
        default=30.0,
        gt=0,
        title="Width (px)",
        description="Standard deviation of the Gaussian blur in px: a few times the object.",
        json_schema_extra=_WIDTHS,
    )

    def source(self, image: Image, mask: Mask | None) -> Image:
        from napari_shadowinv.sources import low_pass_source

        return low_pass_source(image, self.width, mask=mask)


class TotalVariationEstimate(Estimate):
    """The shot without small structures, but with its edges."""

    title = "total variation"
    weight: float = Field(
        default=2.0,
        gt=0,
        title="Weight (px)",
        description=(
            "How much is taken away, in px: it takes c·r/2 to remove a disc of radius r px and "
            "contrast c."
        ),
        json_schema_extra={"slider": [0.05, 20.0]},
    )
    iterations: int = Field(
        default=1000,
        ge=1,
        title="Iterations",
        description="Most steps; an object of radius r px needs about r² of them.",
    )

    def source(self, image: Image, mask: Mask | None) -> Image:
        from napari_shadowinv.sources import total_variation_source

        return total_variation_source(
            image, weight=self.weight, iterations=self.iterations, mask=mask
        )

    def coarser(self, factor: int) -> Estimate:
        # A step reaches one pixel farther: fewer steps go as far in larger pixels.
        steps = max(1, self.iterations // factor**2)
        return super().coarser(factor).model_copy(update={"iterations": steps})


class InterpolatedEstimate(Estimate):
    """The shot, with the masked part filled in from around it."""

    title = "filled in under the mask"
    width: float = Field(
        default=5.0,
        gt=0,
        title="Width (px)",
        description="Length in px over which the surroundings are smoothed before they go on.",
        json_schema_extra={"slider": [0.5, 50.0]},
    )
    kind: Literal["biharmonic", "laplace"] = Field(
        default="biharmonic",
        title="Continuation",
        description=(
            "'biharmonic' continues slope and curvature of the beam: for gaps inside the image. "
            "'laplace' never leaves the range of the surroundings: for gaps at its edge."
        ),
    )

    def source(self, image: Image, mask: Mask | None) -> Image:
        from napari_shadowinv.sources import interpolated_source

        if mask is None:
            raise InputError(
                "this estimate fills in what the mask marks: choose a mask layer that covers "
                "the object"
            )
        return interpolated_source(image, mask, width=self.width, kind=self.kind)


class Filter(BaseModel):
    """Something done to the image before its inversion."""

    model_config = ConfigDict(frozen=True, extra="forbid")
    title: ClassVar[str]

    def filtered(self, image: Image, mask: Mask | None) -> Image:
        """Apply it; what is masked does not touch the rest. See `napari_shadowinv.filters`."""
        raise NotImplementedError


class LowPassFilter(Filter):
    """Take away small structures."""

    title = "low-pass (smooth)"
    width: float = Field(
        default=1.0,
        gt=0,
        title="Width (px)",
        description="Standard deviation of the Gaussian blur in px.",
        json_schema_extra={"slider": [0.1, 20.0]},
    )

    def filtered(self, image: Image, mask: Mask | None) -> Image:
        from napari_shadowinv.filters import low_pass

        return low_pass(_filled(image, mask), self.width)


class HighPassFilter(Filter):
    """Take away large structures."""

    title = "high-pass"
    width: float = Field(
        default=50.0,
        gt=0,
        title="Width (px)",
        description="Structures much larger than this standard deviation, in px, vanish.",
        json_schema_extra=_WIDTHS,
    )

    def filtered(self, image: Image, mask: Mask | None) -> Image:
        from napari_shadowinv.filters import high_pass

        return high_pass(_filled(image, mask), self.width)


class BackgroundFilter(Filter):
    """Flatten by a polynomial."""

    title = "flatten (polynomial)"
    degree: int = Field(
        default=2,
        ge=0,
        le=10,
        title="Degree",
        description="Total degree of the polynomial that is taken out of the image.",
        json_schema_extra={"slider": [0, 10]},
    )
    kind: Literal["divide", "subtract"] = Field(
        default="divide",
        title="How",
        description="'divide' by it, for an uneven beam, or 'subtract' it, for stray light.",
    )

    def filtered(self, image: Image, mask: Mask | None) -> Image:
        from napari_shadowinv.filters import remove_background

        return remove_background(_filled(image, mask), self.degree, kind=self.kind, mask=mask)


class HotPixelFilter(Filter):
    """Replace broken pixels."""

    title = "remove hot pixels"
    threshold: float = Field(
        default=6.0,
        gt=0,
        title="Threshold",
        description=(
            "How many standard deviations of the noise a pixel may differ from the median of "
            "its neighbours."
        ),
        json_schema_extra={"slider": [2.0, 20.0]},
    )

    def filtered(self, image: Image, mask: Mask | None) -> Image:
        from napari_shadowinv.filters import remove_hot_pixels

        return remove_hot_pixels(_filled(image, mask), threshold=self.threshold)[0]


def _filled(image: Image, mask: Mask | None) -> Image:
    """The image with the mean in its masked pixels, which may hold NaN."""
    import numpy as np

    if mask is None or mask.all() or not mask.any():
        return image
    return np.where(mask, image, image[mask].mean())


ESTIMATES: dict[str, type[Estimate]] = {
    "uniform": UniformEstimate,
    "gaussian": GaussianEstimate,
    "polynomial": PolynomialEstimate,
    "low_pass": LowPassEstimate,
    "total_variation": TotalVariationEstimate,
    "interpolated": InterpolatedEstimate,
}
FILTERS: dict[str, type[Filter]] = {
    "low_pass": LowPassFilter,
    "high_pass": HighPassFilter,
    "background": BackgroundFilter,
    "hot_pixels": HotPixelFilter,
}
