"""What a phantom is, and what all of them share."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from napari_shadowinv.errors import InputError

FloatArray = NDArray[np.float64]
Center = tuple[float, float] | None


@dataclass(frozen=True, eq=False)
class Phantom:
    """An object's exact potential and displacement, at the pixels' centres.

    Attributes
    ----------
    potential : ndarray of float64, shape (H, W)
        Normalised potential φ in px², zero far away from the object.
    displacement : ndarray of float64, shape (2, H, W)
        Displacement d = -∇φ in px, axis order (y, x).
    """

    potential: FloatArray
    displacement: FloatArray

    def __add__(self, other: Phantom) -> Phantom:
        """Both objects in one beam: thin objects' deflections add up."""
        if not isinstance(other, Phantom):
            return NotImplemented
        if self.potential.shape != other.potential.shape:
            raise InputError(
                f"phantoms have shapes {self.potential.shape} and {other.potential.shape}: "
                "they must match"
            )
        return Phantom(self.potential + other.potential, self.displacement + other.displacement)


def offsets(shape: tuple[int, int], center: Center) -> tuple[FloatArray, FloatArray]:
    """Distances in y and x of the pixels' centres from a point, broadcastable."""
    height, width = shape
    if height < 1 or width < 1:
        raise InputError(f"shape is {shape}: height and width must be 1 or more")
    y, x = ((height - 1) / 2, (width - 1) / 2) if center is None else center
    if not np.isfinite([y, x]).all():
        raise InputError(f"center is {center}: expected finite (y, x) in px")
    rows, columns = np.arange(height, dtype=np.float64), np.arange(width, dtype=np.float64)
    return rows[:, None] - y, columns[None, :] - x


def require_positive(name: str, value: float, unit: str) -> None:
    """Refuse a length that is none."""
    if not (np.isfinite(value) and value > 0):
        raise InputError(f"{name} is {value}: it must be positive, in {unit}")


def require_finite(**values: float) -> None:
    """Refuse numbers that are infinite or not a number."""
    if not np.isfinite(list(values.values())).all():
        received = ", ".join(f"{name} {value}" for name, value in values.items())
        verb = "it must" if len(values) == 1 else "all must"
        raise InputError(f"received {received}: {verb} be finite")
