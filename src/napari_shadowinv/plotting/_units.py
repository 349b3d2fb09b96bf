"""Lengths, fields and potentials in units whose numbers are handy to read."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from napari_shadowinv.physics.setup import Setup

FloatArray = NDArray[np.float64]

_PREFIXES = {-12: "p", -9: "n", -6: "µ", -3: "m", 0: "", 3: "k", 6: "M"}


def _prefix(largest: float, allowed: Collection[int] = tuple(_PREFIXES)) -> tuple[float, str]:
    """Return the factor and the SI prefix that bring a value to 1 or more."""
    if not largest > 0 or not np.isfinite(largest):
        return 1.0, ""
    power = max((p for p in allowed if largest >= 10.0**p), default=min(allowed))
    return 10.0**-power, _PREFIXES[power]


@dataclass(frozen=True)
class Scale:
    """Lengths of the image's axes: how long a pixel is, and in which unit."""

    pixel: float
    unit: str

    def extent(self, shape: tuple[int, int]) -> tuple[float, float, float, float]:
        """Left, right, bottom and top edge, for images whose first row is on top."""
        edges = (-0.5, shape[1] - 0.5, shape[0] - 0.5, -0.5)
        left, right, bottom, top = (edge * self.pixel for edge in edges)
        return left, right, bottom, top

    def centres(self, count: int) -> FloatArray:
        return np.arange(count, dtype=np.float64) * self.pixel


def image_scale(shape: tuple[int, int], setup: Setup | None) -> Scale:
    """Metres at the object with a setup, pixels without."""
    if setup is None:
        return Scale(1.0, "px")
    pixel = setup.object_pixel_size
    factor, prefix = _prefix(max(shape) * pixel, allowed=(-9, -6, -3, 0))
    return Scale(pixel * factor, f"{prefix}m")


@dataclass(frozen=True)
class ShownField:
    """A vector field in the unit that it is shown in.

    Attributes
    ----------
    vectors : ndarray, shape (2, H, W)
        Components in axis order (y, x).
    name, symbol, unit : str
        What it is.
    """

    vectors: FloatArray
    name: str
    symbol: str
    unit: str

    @property
    def magnitude(self) -> FloatArray:
        """Length of the vectors, shape (H, W)."""
        return np.sqrt(np.sum(self.vectors**2, axis=0, dtype=np.float64))

    @property
    def peak(self) -> tuple[int, int]:
        """Row and column of the strongest point."""
        row, column = np.unravel_index(np.argmax(self.magnitude), self.magnitude.shape)
        return int(row), int(column)

    @property
    def peak_text(self) -> str:
        """The largest magnitude in words, path-integrated fields in MG·µm, too."""
        largest = float(self.magnitude.max())
        text = f"peak {self.symbol} {largest:.3g} {self.unit}"
        if not self.unit.endswith("T·m"):
            return text
        prefix = self.unit.removesuffix("T·m")
        power = next(power for power, name in _PREFIXES.items() if name == prefix)
        return f"{text} ({largest * 10.0**power / 1e-4:.3g} MG·µm)"


def shown_fields(displacements: Collection[FloatArray], setup: Setup | None) -> list[ShownField]:
    """Turn displacements into what an experimenter asks for, in one unit for all.

    Parameters
    ----------
    displacements : collection of ndarray, shape (2, H, W)
        Displacements in px.
    setup : Setup or None
        With it, the path-integrated magnetic field of particles, or the deflection angle of
        light; without, the displacement in px.

    Returns
    -------
    list of ShownField
        One for each displacement.
    """
    if setup is None:
        return [ShownField(d, "Displacement", "|d|", "px") for d in displacements]
    if setup.kind == "proton":
        fields = [setup.path_integrated_b(d) for d in displacements]
        name, symbol, unit = "Path-integrated field", "|∫B×dz|", "T·m"
    else:
        fields = [setup.deflection_angle(d) for d in displacements]
        name, symbol, unit = "Deflection angle", "|α|", "rad"
    factor, prefix = _prefix(max(float(np.hypot(*field).max()) for field in fields))
    return [ShownField(field * factor, name, symbol, f"{prefix}{unit}") for field in fields]


def shown_potential(potential: FloatArray, setup: Setup | None) -> tuple[FloatArray, str]:
    """Turn a potential in px² into a handy unit, and name the unit."""
    if setup is None:
        return potential, "px²"
    metres = setup.potential(potential)
    factor, prefix = _prefix(float(np.abs(metres).max()))
    return metres * factor, f"{prefix}m"
