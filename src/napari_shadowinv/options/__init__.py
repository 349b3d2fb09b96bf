"""Every choice of an inversion and of a fit, as validated models.

The same model is the keyword of a function, a part of a recipe, the flags of a command, a form
in a window, and is saved with each result: there is no second list of defaults.

- `InversionOptions`; `FitOptions`, and with what a fit is to find and to know: `FitChoices`
- what can deflect a beam, by name: `FIELDS`
"""

from napari_shadowinv.options.fitting import (
    FIELDS,
    KINDS_OF_NOISE,
    MAX_STRENGTH,
    FitChoices,
    FitOptions,
    KindOfNoise,
    Noise,
)
from napari_shadowinv.options.inversion import MAX_DEFAULT_SITES, InversionOptions

__all__ = [
    "FIELDS",
    "KINDS_OF_NOISE",
    "MAX_DEFAULT_SITES",
    "MAX_STRENGTH",
    "FitChoices",
    "FitOptions",
    "InversionOptions",
    "KindOfNoise",
    "Noise",
]
