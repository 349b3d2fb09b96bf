"""Reasons to doubt an image, a setup or a result: `Caution`, with the codes of `CAUTION_CODES`.

People read the text. Scripts, `shadowinv info` and docs/trust.md go by the code, which stays the
same when a sentence is improved or a number in it changes.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

CAUTION_CODES: Mapping[str, str] = MappingProxyType(
    {
        # the solution
        "not-converged": "the solver did not converge",
        "misfit": "the re-projection misses a pattern in the image",
        "no-deflection": "the displacement is no larger than that by noise",
        "folds": "rays cross",
        "edge": "the object goes on beyond the edge of the image",
        "correlated-noise": "noise is correlated over too many pixels to be measured",
        "beam": "image and source differ outside the object",
        "masked-peak": "the peak of the field lies at masked pixels",
        "accuracy": "the requested accuracy was not reached",
        "verdict": "the fit is not determined by its images",
        "samples": "some samples of the error bars are unreliable",
        # the pixels
        "flux": "image and source differ in their flux",
        "negative-pixels": "negative pixels were set to zero",
        "dark-pixels": "dark pixels were raised to the floor",
        "mask": "the mask excludes many pixels",
        "unlit": "pixels without light were masked",
        "dark-level": "a dark level was left in the image",
        "saturation": "pixels are saturated",
        "hot-pixels": "single pixels stand out from their neighbours",
        "negative": "the image looks like a negative",
        "swapped": "image and source seem to be swapped",
        "register": "image and source are not in register",
        "source": "the estimated source is doubtful",
        "setup": "the setup is doubtful",
        # files
        "film-scan": "the image may be a scan of film",
        "gamma": "the pixels are not proportional to the light",
        "tracks": "the tracks of a CR-39 scan need a choice",
        "file": "part of the file was not used",
        "film-range": "a film is darker than its calibration covers",
        "film-alignment": "the alignment of the films is uncertain",
        "film-pixels": "the size of the films' pixels is unlike a scanner's",
        "film-side": "the side from which the films are seen is not known",
        # codes of later versions
        "other": "other warnings",
    }
)
"""Meaning of each code in a few words."""


@dataclass(frozen=True, slots=True)
class Caution:
    """A reason to doubt an image, a setup or a result."""

    code: str  # one of `CAUTION_CODES`
    text: str  # the observation, its effect on the result, and the remedy, in a sentence

    def __post_init__(self) -> None:
        if self.code not in CAUTION_CODES:
            raise ValueError(f"got the caution code {self.code!r}: expected one of CAUTION_CODES")

    def __str__(self) -> str:
        return self.text

    @property
    def short(self) -> str:
        """The observation in a few words, for a headline."""
        return self.text if self.code == "other" else CAUTION_CODES[self.code]

    def about(self, name: str) -> Caution:
        """Return the same caution with the name of its image or film in front."""
        return Caution(self.code, f"{name}: {self.text}")

    @classmethod
    def from_json(cls, content: Any) -> Caution:
        """Rebuild a caution from a result file, perhaps with a code of a later version."""
        if isinstance(content, cls):
            return content
        code = content["code"] if content["code"] in CAUTION_CODES else "other"
        return cls(code, content["text"])


OnCaution = Callable[[Caution], None]


def warn_of(caution: Caution) -> None:
    """Issue a caution as a Python warning, for callers that pass no callback."""
    warnings.warn(caution.text, stacklevel=3)
