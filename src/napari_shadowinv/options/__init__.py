"""Choices of an inversion and of a fit, as validated models.

Each model is the keyword of a function, a part of a recipe, the flags of a command and a form in a
window, and is saved with each result: there is no second list of defaults.

- options of an inversion and of a fit: `InversionOptions`, `FitOptions`
- unknowns of a fit and knowledge about its images: `FitChoices`
"""

from napari_shadowinv.options.beam_prior import (
    ASSUMED_BEAM,
    REFERENCE_BEAM,
    UNKNOWN_BEAM_RMS,
    BeamComponents,
    BeamPrior,
)
from napari_shadowinv.options.fitting import (
    KINDS_OF_NOISE,
    MAX_STRENGTH,
    FitChoices,
    FitOptions,
    KindOfNoise,
    Noise,
)
from napari_shadowinv.options.instrument import (
    BEAM_SOURCES,
    DEFAULT_REGISTRATION,
    DETECTORS,
    Instrument,
)
from napari_shadowinv.options.inversion import MAX_DEFAULT_SITES, InversionOptions, MaxError

__all__ = [
    "ASSUMED_BEAM",
    "BEAM_SOURCES",
    "DEFAULT_REGISTRATION",
    "DETECTORS",
    "KINDS_OF_NOISE",
    "MAX_DEFAULT_SITES",
    "MAX_STRENGTH",
    "REFERENCE_BEAM",
    "UNKNOWN_BEAM_RMS",
    "BeamComponents",
    "BeamPrior",
    "FitChoices",
    "FitOptions",
    "Instrument",
    "InversionOptions",
    "KindOfNoise",
    "MaxError",
    "Noise",
]
