from .estimate import Estimate
from .estimates import (
    InterpolatedEstimate,
    LowPassEstimate,
    PolynomialEstimate,
    TotalVariationEstimate,
    UniformEstimate,
    low_pass_source,
    polynomial_source,
    total_variation_source,
    uniform_source,
)
from .filling import interpolated_source
from .filters import (
    BackgroundFilter,
    ButterworthFilter,
    Filter,
    HighPassFilter,
    LowPassFilter,
    butterworth,
    high_pass,
    low_pass,
    remove_background,
)
from .gaussian import GaussianEstimate, gaussian_source
from .hot_pixels import HotPixelFilter, remove_hot_pixels
from .isotropic import IsotropicEstimate, isotropic_source, uniform_warnings
from .pixels import fit_polynomial
from .radiograph import Radiograph
from .recipe import (
    ESTIMATES,
    FILTERS,
    STEPS,
    MeasuredSource,
    Origin,
    Provenance,
    Recipe,
    check_masks,
    estimated_source,
)
from .steps import Bin, Choice, Crop, Rotate, Step

__all__ = [
    "ESTIMATES",
    "FILTERS",
    "STEPS",
    "BackgroundFilter",
    "Bin",
    "ButterworthFilter",
    "Choice",
    "Crop",
    "Estimate",
    "Filter",
    "GaussianEstimate",
    "HighPassFilter",
    "HotPixelFilter",
    "InterpolatedEstimate",
    "IsotropicEstimate",
    "LowPassEstimate",
    "LowPassFilter",
    "MeasuredSource",
    "Origin",
    "PolynomialEstimate",
    "Provenance",
    "Radiograph",
    "Recipe",
    "Rotate",
    "Step",
    "TotalVariationEstimate",
    "UniformEstimate",
    "butterworth",
    "check_masks",
    "estimated_source",
    "fit_polynomial",
    "gaussian_source",
    "high_pass",
    "interpolated_source",
    "isotropic_source",
    "low_pass",
    "low_pass_source",
    "polynomial_source",
    "remove_background",
    "remove_hot_pixels",
    "total_variation_source",
    "uniform_source",
    "uniform_warnings",
]
