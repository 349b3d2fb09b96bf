"""Fields and potentials in units whose numbers are handy to read.

- the field that an experimenter asks for: `shown_fields`; the potential: `shown_potential`
- the grey limits of an image: `intensity_limits`
- a number with its errors: `with_errors`
- the prefix for a number: `prefix_for`; the units that take one: `PREFIXED_UNITS`
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from napari_shadowinv._typing import AnyArray, FloatArray
from napari_shadowinv.physics.setup import SETUPS, Setup

__all__ = [
    "PREFIXED_UNITS",
    "ShownField",
    "intensity_limits",
    "prefix_for",
    "shown_fields",
    "shown_potential",
    "with_errors",
]

_SHOWN_PERCENTILES = 0.1, 99.7
_MAX_SHOWN_PER_MEAN = 3.5
_MIN_SHADE = 0.3  # of the brightest intensity; the limits of darker images begin at 0
_SAMPLED_PIXELS = 100_000

_PREFIXES = {-12: "p", -9: "n", -6: "µ", -3: "m", 0: "", 3: "k", 6: "M"}

# The prefix of a power, such as m⁻², would be raised to that power.
PREFIXED_UNITS = {
    field.unit
    for kind in SETUPS.values()
    for field in kind.si_fields
    if field.unit.replace(" ", "").isalpha()
}


def prefix_for(largest: float, allowed: Collection[int] = tuple(_PREFIXES)) -> tuple[float, str]:
    """Return the factor and the SI prefix that bring a value to 1 or more."""
    if not largest > 0 or not np.isfinite(largest):
        return 1.0, ""
    power = max((p for p in allowed if largest >= 10.0**p), default=min(allowed))
    return 10.0**-power, _PREFIXES[power]


def with_errors(value: float, errors: Mapping[str, float]) -> str:
    """Write a number with its errors, which are shares of it, to two figures of the largest.

    >>> with_errors(97.13, {"noise": 0.0212, "discretisation": 0.0021})
    '97.1 ± 2.1 (noise) ± 0.2 (discretisation)'
    """
    sizes = {name: abs(value) * share for name, share in errors.items()}
    largest = max(sizes.values(), default=0.0)
    if not largest > 0 or not np.isfinite(largest):
        return f"{value:.3g}"
    decimals = max(0, 1 - math.floor(math.log10(largest)))

    def written(size: float) -> str:
        return f"{size:.{decimals}f}" if round(size, decimals) else f"{size:.1g}"

    told = [f"± {written(size)} ({name})" for name, size in sizes.items()]
    return " ".join([f"{value:.{decimals}f}", *told])


@dataclass(frozen=True)
class ShownField:
    """A vector field in the unit that it is shown in."""

    vectors: FloatArray  # (2, H, W)
    name: str
    symbol: str
    unit: str
    components: tuple[str, str]  # their symbols
    arrows: str = ""  # title of its arrows; empty where they would point along the displacement

    @property
    def magnitude(self) -> FloatArray:
        """Length of the vectors, shape (H, W)."""
        return np.sqrt(np.sum(self.vectors**2, axis=0, dtype=np.float64))

    @property
    def peak(self) -> tuple[int, int]:
        """Row and column of the strongest point."""
        row, column = np.unravel_index(np.argmax(self.magnitude), self.magnitude.shape)
        return int(row), int(column)

    def peak_text(self, errors: Mapping[str, float] = MappingProxyType({})) -> str:
        """The largest magnitude in words, path-integrated fields in MG·µm, too.

        Its errors are shares of it by their names.
        """
        largest = float(self.magnitude.max())
        text = f"peak {self.symbol} {with_errors(largest, errors)} {self.unit}"
        if not self.unit.endswith("T·m"):
            return text
        prefix = self.unit.removesuffix("T·m")
        power = next(power for power, name in _PREFIXES.items() if name == prefix)
        return f"{text} ({with_errors(largest * 10.0**power / 1e-4, errors)} MG·µm)"


def shown_fields(
    displacements: Collection[FloatArray], setup: Setup | None, deflector: str | None = None
) -> list[ShownField]:
    """Turn displacements in px into what an experimenter asks for, in one unit for all.

    That is the main field of the setup's kind: the path-integrated magnetic field of particles,
    or the deflection angle of light; without a setup, the displacement in px. If it is known that
    the `deflector` is another one, such as an "electric field", its own path integral is shown.
    """
    if setup is None:
        return [ShownField(d, "Displacement", "|d|", "px", ("dy", "dx")) for d in displacements]
    main = setup.other_fields.get(deflector or "", setup.main_field)
    (unit,) = (field.unit for field in setup.si_fields if field.name == main.name)
    fields = [setup.field_in_si(main.name, d) for d in displacements]
    factor, prefix = prefix_for(max(float(np.hypot(*field).max()) for field in fields))
    unit = prefix + unit.replace(" ", "·")
    return [
        ShownField(field * factor, main.title, main.symbol, unit, main.components, main.arrows)
        for field in fields
    ]


def shown_potential(potential: FloatArray, setup: Setup | None) -> tuple[FloatArray, str]:
    """Turn a potential in px² into a handy unit, and name the unit."""
    if setup is None:
        return potential, "px²"
    metres = setup.potential(potential)
    factor, prefix = prefix_for(float(np.abs(metres).max()))
    return metres * factor, f"{prefix}m"


def intensity_limits(image: AnyArray) -> tuple[float, float]:
    """Return grey limits of an image that a caustic's few bright pixels cannot spoil.

    The lower limit is 0, unless the image has negative pixels or all of it is bright.

    Parameters
    ----------
    image : ndarray
        Intensities in any unit. A large image is sampled.

    Returns
    -------
    tuple of float
        Darkest and brightest intensity to show, the second larger.
    """
    step = max(1, int(np.sqrt(image.size / _SAMPLED_PIXELS)))
    sample = np.asarray(image[::step, ::step])
    finite = sample[np.isfinite(sample)]
    if not finite.size:
        return 0.0, 1.0
    dark, bright = (float(value) for value in np.percentile(finite, _SHOWN_PERCENTILES))
    mean = float(finite.mean())
    high = min(bright, _MAX_SHOWN_PER_MEAN * mean) if mean > 0 else bright
    low = 0.0 if 0 <= dark < _MIN_SHADE * high else dark
    return (low, high) if high > low else (low, low + 1.0)
