"""Time and memory of a run, estimated before it.

- the cost of an inversion: `inversion_cost`; of a fit: `fit_cost`
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from napari_shadowinv._system.machine import physical_memory
from napari_shadowinv.options import MAX_DEFAULT_SITES, FitChoices, Instrument, InversionOptions

# Twice what two fast cores take for two to four images of 64² to 400² px without crossing rays.
# Crossing rays, or a search for the cause of a misfit, multiply the time by 1.9 to 4.
_TIME_S, _TIME_PER_PIXEL_S = 0.45, 1.7e-5
_CROSSING_RAYS_FACTOR = 4.0
_TWO_FIELDS_FACTOR, _UNKNOWN_BEAM_FACTOR = 1.5, 1.2
# Time of an error bar's sample relative to the fit.
_TIME_PER_SAMPLE, _TIME_PER_BEAM_SAMPLE = 0.008, 0.012
# Where the beam changes between energies, samples are fitted, and are this many at least; up to
# twice as long for images of less than 100² px.
_TIME_PER_FITTED_SAMPLE, _LEAST_FITTED_SAMPLES = 0.1, 16
# Of an inversion; measured on two cores with images of 0.25 to 4 Mpx and 5,000 to 1,000,000 sites,
# including the layers of the result.
_SECONDS_PER_PIXEL, _SECONDS_PER_SITE = 3e-6, 11e-6
_BYTES, _BYTES_PER_PIXEL, _BYTES_PER_SITE = 200e6, 280.0, 1700.0
_MIN_PIXELS_FOR_ESTIMATE = 1_000_000
_MINUTE_S, _HOUR_S = 60, 3600


@dataclass(frozen=True)
class Cost:
    """Estimated time of a run, and a sentence about it, empty for a small one."""

    seconds: float
    text: str
    exceeds_memory: bool = False


def inversion_cost(shape: Sequence[int], options: InversionOptions) -> Cost:
    """Estimate an inversion from times on two cores."""
    pixels, available = shape[0] * shape[1], physical_memory()
    sites = options.n_sites or min(pixels, MAX_DEFAULT_SITES)
    seconds = _SECONDS_PER_PIXEL * pixels + _SECONDS_PER_SITE * sites
    memory = _BYTES + _BYTES_PER_PIXEL * pixels + _BYTES_PER_SITE * sites
    text = (
        f"{pixels / 1e6:.3g} Mpx with {sites:,} sites: about {_in_words(seconds)} and up to "
        f"{memory / 1e9:.1f} GB"
    )
    if available is not None and memory > available:
        advice = "crop or bin the image, or choose fewer sites"
        text += f", more than this machine's {available / 1e9:.1f} GB: {advice}."
        return Cost(seconds, text, exceeds_memory=True)
    return Cost(seconds, f"{text}." if pixels >= _MIN_PIXELS_FOR_ESTIMATE else "")


def fit_cost(
    shape: Sequence[int],
    images: int,
    choices: FitChoices,
    instrument: Instrument | None = None,
) -> Cost:
    """Estimate a fit without crossing rays."""
    fields, is_unknown = len(choices.fields or ("B",)), choices.beam == "unknown"
    seconds = _TIME_S + _TIME_PER_PIXEL_S * images * shape[0] * shape[1]
    seconds *= _TWO_FIELDS_FACTOR if fields > 1 else 1
    seconds *= _UNKNOWN_BEAM_FACTOR if is_unknown else 1
    per_sample = _TIME_PER_BEAM_SAMPLE if is_unknown else _TIME_PER_SAMPLE
    samples = choices.options.samples if choices.options.samples > 1 else 0
    of_samples = samples * per_sample
    if samples and images > 1 and instrument is not None and instrument.beam_between:
        of_samples = max(samples, _LEAST_FITTED_SAMPLES) * _TIME_PER_FITTED_SAMPLE
    seconds *= 1 + of_samples
    count = "one image" if images == 1 else f"{images} images"
    more = f", {fields} fields" if fields > 1 else ""
    more += ", unknown beam" if is_unknown else ""
    basis = f"up to {_in_words(_CROSSING_RAYS_FACTOR * seconds)} if rays cross"
    subject = f"{count} of {shape[0]} × {shape[1]} px{more}"
    return Cost(seconds, f"{subject}: about {_in_words(seconds)}, {basis}.")


def _in_words(seconds: float) -> str:
    """Format an approximate time with a suitable unit."""
    if seconds < 2 * _MINUTE_S:
        return f"{float(f'{seconds:.1g}'):g} s" if seconds < 10 else f"{round(seconds, -1):g} s"
    if seconds < 2 * _HOUR_S:
        return f"{seconds / _MINUTE_S:.0f} min"
    return f"{seconds / _HOUR_S:.1f} h"
