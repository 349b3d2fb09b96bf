"""What an inversion will take, told before it begins: `Cost`, `cost_of`."""

from __future__ import annotations

from dataclasses import dataclass

from napari_shadowinv._system.memory import physical_memory
from napari_shadowinv.options import MAX_DEFAULT_SITES, InversionOptions

__all__ = ["Cost", "cost_of"]

# Measured on two cores, images of 0.25 to 4 Mpx with 5,000 to 1,000,000 sites; a window's layers
# of the result are counted with the pixels.
_SECONDS_PER_PIXEL, _SECONDS_PER_SITE = 3e-6, 11e-6
_BYTES, _BYTES_PER_PIXEL, _BYTES_PER_SITE = 200e6, 280.0, 1700.0
_WORTH_TELLING = 1_000_000  # pixels
_MINUTE, _HOUR = 60, 3600


@dataclass(frozen=True)
class Cost:
    """Time and memory of an inversion.

    Attributes
    ----------
    pixels, sites : int
        How large it is.
    seconds : float
        About how long it takes.
    memory : float
        Bytes at most, about.
    """

    pixels: int
    sites: int
    seconds: float
    memory: float

    @property
    def is_too_much(self) -> bool:
        """Whether it needs more memory than this machine has."""
        there_is = physical_memory()
        return there_is is not None and self.memory > there_is

    @property
    def text(self) -> str:
        """In a sentence; empty for an image that takes no time to speak of."""
        if self.pixels < _WORTH_TELLING and not self.is_too_much:
            return ""
        text = (
            f"{self.pixels / 1e6:.3g} Mpx with {self.sites:,} sites: about "
            f"{_duration(self.seconds)} and up to {self.memory / 1e9:.1f} GB"
        )
        if not self.is_too_much:
            return f"{text}."
        return (
            f"{text}, more than this machine's {(physical_memory() or 0) / 1e9:.1f} GB: crop or "
            "bin the image, or choose fewer sites."
        )


def cost_of(shape: tuple[int, ...], options: InversionOptions, pace: float = 1.0) -> Cost:
    """Forecast an inversion.

    Parameters
    ----------
    shape : tuple of int
        Height and width of the part that is inverted.
    options : InversionOptions
        How many sites.
    pace : float
        How much longer than forecast the last inversion on this machine took.

    Returns
    -------
    Cost
    """
    pixels = shape[0] * shape[1]
    sites = options.n_sites or min(pixels, MAX_DEFAULT_SITES)
    return Cost(
        pixels,
        sites,
        pace * (_SECONDS_PER_PIXEL * pixels + _SECONDS_PER_SITE * sites),
        _BYTES + _BYTES_PER_PIXEL * pixels + _BYTES_PER_SITE * sites,
    )


def _duration(seconds: float) -> str:
    if seconds < 2 * _MINUTE:
        return f"{float(f'{seconds:.1g}'):g} s" if seconds < 10 else f"{round(seconds, -1):g} s"
    if seconds < 2 * _HOUR:
        return f"{seconds / _MINUTE:.0f} min"
    return f"{seconds / _HOUR:.1f} h"
