"""The axis of an object in the plane of a field: coordinates along and across it, and its place.

- sample a field on both sides of an axis: `Axis`, `sample_sides`
- find the axis from the symmetry of the field: `find_axis`; where a field has none: `asymmetry`
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize

from napari_shadowinv._typing import FloatArray
from napari_shadowinv.analysis.abel import FIRST_OFFSET
from napari_shadowinv.analysis.paths import interpolate_cubic


@dataclass(frozen=True)
class Axis:
    """A straight axis in the image plane, with its ends (y, x) in px."""

    start: tuple[float, float]
    end: tuple[float, float]

    @property
    def length(self) -> float:
        """Distance of the ends in px."""
        return math.dist(self.start, self.end)

    @property
    def direction(self) -> FloatArray:
        """Unit vector (y, x) from start to end."""
        return np.asarray((np.array(self.end) - np.array(self.start)) / self.length)

    @property
    def across(self) -> FloatArray:
        """Unit vector (y, x) across the axis, to the right of an axis that points downwards."""
        along_y, along_x = self.direction
        return np.array([-along_x, along_y])

    def places(self) -> FloatArray:
        """Return distances from the start along the axis, one px apart."""
        return np.arange(math.floor(self.length + 1e-9) + 1.0)

    def points(self, places: FloatArray, offsets: FloatArray) -> FloatArray:
        """Return points (places, offsets, 2) of the image."""
        along = np.array(self.start) + places[:, None] * self.direction
        return np.asarray(along[:, None] + offsets[:, None] * self.across)

    def max_radius(self, shape: tuple[int, int]) -> float:
        """Return the largest distance from the axis at which both sides are inside the image."""
        limits = [math.inf]
        for end in (self.start, self.end):
            for place, step, count in zip(end, self.across, shape, strict=True):
                if abs(step) > 1e-9:
                    room = min(place + 0.5, count - 0.5 - place)
                    limits.append(room / abs(step))
        return max(min(limits), 0.0)


def sample_sides(
    component: FloatArray, axis: Axis, radius: int, *, is_odd: bool = True, every: int = 1
) -> tuple[FloatArray, FloatArray]:
    """Return a component, (H, W), of the field on both sides of an axis, (places, radius) each.

    Places along the axis are `every` px apart. If the component is odd, it changes its sign across
    the axis of a symmetric object: the second side is turned round, and distances are as in
    `abel.deflection_matrix`, else as in `projection_matrix`. Sides of a symmetric field are equal.
    """
    first = FIRST_OFFSET if is_odd else 0.0
    offsets, places = first + np.arange(float(radius)), axis.places()[::every]
    right_side = interpolate_cubic(component, axis.points(places, offsets))
    left_side = interpolate_cubic(component, axis.points(places, -offsets))
    return right_side, -left_side if is_odd else left_side


def asymmetry(right_side: FloatArray, left_side: FloatArray) -> float:
    """Return the difference of two sides relative to their mean (r.m.s.)."""
    mean = float(np.linalg.norm(right_side + left_side)) / 2
    return float(np.linalg.norm(right_side - left_side)) / mean if mean > 0 else math.inf


def component_across(displacement: FloatArray, axis: Axis) -> FloatArray:
    """Return the component of vectors (2, H, W) across an axis."""
    return np.asarray(np.tensordot(axis.across, displacement, axes=1))


def find_axis(
    displacement: FloatArray,
    direction: str = "vertical",
    *,
    start: Axis | None = None,
    find_tilt: bool = True,
    most_tilt: float = 20.0,
    radius_share: float = 0.9,
    places: int = 200,
) -> Axis:
    """Return the axis about which the deflection, (2, H, W), across it is most nearly odd.

    It is refined from a start, by default the best of all positions along a direction, "vertical"
    or "horizontal". With `find_tilt` it may be inclined, by `most_tilt` degrees. The radius is a
    share of the largest, so that a shifted axis stays inside; of a long axis, not fewer than
    `places` places are compared, as neighbours share their noise. The axis is so long that all of
    its both sides are inside the image; from a start, as long as that.
    """
    shape = displacement.shape[1:]
    is_free = start is None
    if start is None:
        start = _best_parallel(displacement, direction)
    radius = max(int(radius_share * start.max_radius(shape)), 4)
    middle = (np.array(start.start) + np.array(start.end)) / 2
    half = start.length / 2
    every = max(int(start.length) // places, 1)

    def axis_at(shift: float, tilt: float) -> Axis:
        along = math.cos(tilt) * start.direction + math.sin(tilt) * start.across
        centre = middle + shift * start.across
        first, last = centre - half * along, centre + half * along
        return Axis((float(first[0]), float(first[1])), (float(last[0]), float(last[1])))

    def mismatch(choice: FloatArray) -> float:
        shift, tilt = float(choice[0]), float(choice[1]) / half if find_tilt else 0.0
        if abs(tilt) > math.radians(most_tilt):
            return math.inf
        axis = axis_at(shift, tilt)
        component = component_across(displacement, axis)
        return asymmetry(*sample_sides(component, axis, radius, every=every))

    # Both numbers are px: the shift of the middle, and that of the ends against it.
    size = 2 if find_tilt else 1
    simplex = np.vstack([np.zeros(size), 1.0 * np.eye(size)])
    best = minimize(
        mismatch,
        np.zeros(size),
        method="Nelder-Mead",
        options={"initial_simplex": simplex, "xatol": 1e-3, "fatol": 1e-9},
    )
    axis = axis_at(float(best.x[0]), float(best.x[1]) / half if find_tilt else 0.0)
    return _inset(axis, shape) if is_free else axis


def _inset(axis: Axis, shape: tuple[int, ...]) -> Axis:
    """Shorten an inclined axis so that its sides do not leave the image at its ends."""
    wide = int(np.argmax(np.abs(axis.across)))
    room = min(min(end[wide], shape[wide] - 1 - end[wide]) for end in (axis.start, axis.end))
    margin = room * abs(axis.across[1 - wide]) / abs(axis.direction[1 - wide])
    if not 0 < 2 * margin < axis.length:
        return axis
    start = np.array(axis.start) + margin * axis.direction
    end = np.array(axis.end) - margin * axis.direction
    return Axis((float(start[0]), float(start[1])), (float(end[0]), float(end[1])))


def _best_parallel(displacement: FloatArray, direction: str, radius_share: float = 0.3) -> Axis:
    """Return the best of all axes along y or x, by whole pixels; radii over the side across."""
    height, width = displacement.shape[1:]
    is_vertical = direction == "vertical"
    component = displacement[1] if is_vertical else displacement[0].T
    radius = max(int(radius_share * component.shape[1]), 4)
    best, best_position = math.inf, component.shape[1] / 2
    power = component**2
    for position in range(radius, component.shape[1] - radius):
        sides = component[:, position : position + radius]
        mirrored = component[:, position : position - radius : -1]
        odd = np.sum((sides - mirrored) ** 2) / 4
        score = 1.0 - odd / max(float(power.sum()) / 2, 1e-300)
        if score < best:
            best, best_position = float(score), float(position)
    if is_vertical:
        return Axis((0.0, best_position), (height - 1.0, best_position))
    # An axis along x points to the left, so that across points downwards.
    return Axis((best_position, width - 1.0), (best_position, 0.0))
