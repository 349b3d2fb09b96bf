"""Profiles about an axis: `AxisymmetricProfile` from the side, `AzimuthalProfile` face-on.

From the side, the profile follows from the deflection across the axis by an Abel inversion, see
`napari_shadowinv.analysis.abel`: refractive index, gas density and temperature, or electron density
of light; electric potential and radial field, or the axial field of a coil-like magnetic field, of
particles. An azimuthal magnetic field is seen along its axis only.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import ClassVar, Literal, Self

import numpy as np
from pydantic import Field, model_validator
from scipy.constants import mu_0

from napari_shadowinv._system.validation import CombinationError
from napari_shadowinv._typing import FloatArray
from napari_shadowinv.analysis.abel import choose_smoothing, operators
from napari_shadowinv.analysis.axis import (
    Axis,
    asymmetry,
    component_across,
    find_axis,
    sample_sides,
)
from napari_shadowinv.analysis.frame import FieldFrame
from napari_shadowinv.analysis.outlines import Point
from napari_shadowinv.analysis.paths import interpolate_cubic
from napari_shadowinv.analysis.product import (
    Coordinate,
    FieldNoise,
    Measurand,
    Product,
    Values,
    mask_cautions,
)
from napari_shadowinv.cautions import Caution
from napari_shadowinv.errors import InputError
from napari_shadowinv.facts import Fact, percent, to_figures
from napari_shadowinv.inversion.error_bars import Quantity
from napari_shadowinv.physics.beam import displacement_from_potential, length_text, number_field
from napari_shadowinv.physics.units import PIXEL

_B, _E, _N = "path_integrated_b", "path_integrated_e", "line_integrated_density"
_INDEX = "line_integrated_log_index"
_LENGTHS = ("displacement", "deflection_angle", _INDEX)
_MIN_RADIUS_PX = 8
_AZIMUTHAL = (
    "an azimuthal magnetic field is not visible from the side: its components across the beam "
    "cancel in each line of sight (∫B dz = 0), so it deflects nothing there; view it along its "
    "axis (azimuthal field along the beam), or choose the component of B 'axial' for the field of "
    "a coil"
)


@dataclass(frozen=True)
class AxisymmetryCheck:
    """Limits of the cautions of a profile, see tests/analysis/test_axisymmetric.py."""

    edge: float = 0.05  # deflection at the edge, over the largest
    asymmetry: float = 0.1  # of the halves
    length: float = 0.02  # of the object along the beam, over the distance to the source
    profile_end: float = 0.05  # value where the object ends, over the largest


class AxisymmetricProfile(Product):
    """Radial profiles of an object with an axis across the beam, by Abel inversion.

    The two halves are averaged, and inverted apart as a check. Beyond the radius the object is
    taken to be undisturbed, so that values are changes against the surroundings.
    """

    title = "axisymmetric profile"
    place = 60
    lengths: ClassVar = ("axis_offset",)
    fields: ClassVar = (*_LENGTHS, _N, _E, _B)
    reference: ClassVar = "Daun et al., Appl. Opt. 45, 4638 (2006)"
    limits: ClassVar = AxisymmetryCheck()
    product: Literal["axisymmetric"] = "axisymmetric"
    axis: tuple[Point, Point] | None = Field(
        default=None,
        title="Axis (px)",
        description="Two points (y, x) of the axis, which may be inclined; profiles are computed "
        "between them. Default: found from the symmetry of the field, from edge to edge.",
        json_schema_extra={"metavar": "Y,X Y,X"},
    )
    direction: Literal["vertical", "horizontal"] = Field(
        default="vertical", description="Rough direction of an axis that is to be found."
    )
    find_tilt: bool = Field(
        default=True,
        title="Inclined",
        description="Whether an axis that is to be found may be inclined.",
    )
    radius: float | None = number_field(
        "Radius (px)",
        "Distance from the axis in px beyond which the object is undisturbed. Default: the "
        "nearest edge of the image.",
        None,
        ge=_MIN_RADIUS_PX,
    )
    slice_width: float = number_field(
        "Slice (px)",
        "Length along the axis in px over which a profile is averaged. 0: the whole axis.",
        1.0,
        ge=0,
    )
    smoothing: float | None = number_field(
        "Smoothing",
        "Weight of the profile's second differences against the deflections. Default: as "
        "far as its error stays a quarter of that by noise, which the halves show.",
        None,
        ge=0,
    )
    component: Literal["azimuthal", "axial"] = Field(
        default="azimuthal",
        title="Component of B",
        description="Component of a magnetic field: 'axial' of a field without azimuthal "
        "component, such as that of a coil. An azimuthal field is not visible from the side.",
    )
    gladstone_dale: float | None = number_field(
        "Gladstone-Dale constant (m³/kg)",
        "(η - 1)/ρ of the gas in m³/kg, 2.26e-4 for air in visible light: gives the density.",
        None,
        gt=0,
    )
    ambient_density: float | None = number_field(
        "Ambient density (kg/m³)",
        "Density of the undisturbed gas in kg/m³, 1.20 for air at 20 °C.",
        None,
        gt=0,
    )
    ambient_temperature: float | None = number_field(
        "Ambient temperature (K)",
        "Temperature of the undisturbed gas in K: gives that of the object, an ideal gas of "
        "the same composition at the same pressure.",
        None,
        gt=0,
    )
    axis_error: float | None = Field(
        default=None,
        ge=0,
        title="Error of the axis (px)",
        description="Standard error of the axis' position in px. Default: from the noise.",
    )

    @model_validator(mode="after")
    def _complete(self) -> Self:
        if self.ambient_density is not None and self.gladstone_dale is None:
            raise CombinationError(
                "{ambient_density} is set without {gladstone_dale}, expected both: the density "
                "follows from the refractive index by that constant"
            )
        if self.ambient_temperature is not None and self.ambient_density is None:
            raise CombinationError(
                "{ambient_temperature} is set without {ambient_density}, expected both: the "
                "temperature follows from the ratio of the densities"
            )
        if self.axis is not None and self.axis[0] == self.axis[1]:
            raise CombinationError("{axis} has two equal points, expected a line with a length")
        return self

    def check(self, frame: FieldFrame) -> None:
        super().check(frame)
        if frame.unit.field == _B and self.component == "azimuthal":
            raise InputError(_AZIMUTHAL)
        if self.gladstone_dale is not None and not _is_index(frame):
            raise InputError(
                "a Gladstone-Dale constant is set, but the field is not a refractive index: "
                "expected the result of a beam of light, with the unit rad or m"
            )
        if self.axis is not None:
            frame.check_points(np.array(self.axis), "the axis")
            self._radius_px(frame)

    @property
    def _axis(self) -> Axis:
        assert self.axis is not None  # by `adapt`
        return Axis(*self.axis)

    def _radius_px(self, frame: FieldFrame) -> int:
        return _chosen_radius(self.radius, self._axis.max_radius(frame.shape), "axis")

    def _sides(
        self, displacement: FloatArray, frame: FieldFrame, shift: float = 0.0
    ) -> tuple[FloatArray, FloatArray]:
        """Return both sides of the object, (slices, radius), averaged over each slice.

        They are deflections across the axis in px, or the axial magnetic field in T m.
        """
        axis = self._axis
        if shift:
            start, end = (np.array(end) + shift * axis.across for end in (axis.start, axis.end))
            axis = Axis((float(start[0]), float(start[1])), (float(end[0]), float(end[1])))
        is_odd = frame.unit.field != _B
        if is_odd:
            component = component_across(displacement, axis)
        else:
            field = frame.field(displacement[0], displacement)
            component = np.asarray(np.tensordot(axis.direction, field, axes=1))
        right_rows, left_rows = sample_sides(component, axis, self._radius_px(frame), is_odd=is_odd)
        edges = self._slices
        widths = np.diff([*edges, len(right_rows)])[:, None]
        right_side, left_side = (
            np.add.reduceat(rows, edges, axis=0) / widths for rows in (right_rows, left_rows)
        )
        return right_side, left_side

    @property
    def _slices(self) -> list[int]:
        """First place of each slice along the axis."""
        count = len(self._axis.places())
        number = max(round(count / self.slice_width), 1) if self.slice_width else 1
        return [int(place) for place in np.unique(np.linspace(0, count, number + 1)[:-1].round())]

    def _operators(self, frame: FieldFrame) -> tuple[FloatArray, FloatArray]:
        # Before it is chosen, only the first operator is used, which does not depend on it.
        smoothing = 1.0 if self.smoothing is None else self.smoothing
        of_deflection = frame.unit.field != _B
        return operators(self._radius_px(frame), smoothing, of_deflection=of_deflection)

    def adapt(self, potential: FloatArray, noise: FieldNoise | None, frame: FieldFrame) -> Self:
        displacement = displacement_from_potential(potential)
        changes: dict[str, object] = {}
        if self.axis is None:
            if frame.unit.field == _B:
                raise InputError(
                    "the axis of a magnetic field cannot be found from its symmetry, expected two "
                    "points of the axis"
                )
            axis, error = _found_axis(displacement, noise, self.direction, self.find_tilt)
            changes["axis"] = (axis.start, axis.end)
            if self.axis_error is None:
                changes["axis_error"] = error
        product = self.model_copy(update=changes)
        if self.smoothing is None:
            matrix, _ = product._operators(frame)
            smoothing = choose_smoothing(matrix, *product._sides(displacement, frame))
            product = product.model_copy(update={"smoothing": smoothing})
        return product

    def variables(self, frame: FieldFrame) -> dict[str, Measurand]:
        profiles = self._profile_variables(frame)
        first = next(iter(profiles.values()))
        difference = f"{first.long_name}, right half minus left half"
        halves = "Difference of the halves of the deflection, relative (r.m.s.)"
        offset = "Symmetry axis of the field, offset from the axis"
        return profiles | {
            "half_difference": replace(first, long_name=difference),
            "asymmetry": Measurand((), "1", halves),
            "edge": Measurand((), "1", "Deflection at the edge, relative to the largest"),
            "axis_offset": Measurand((), PIXEL, offset),
        }

    def _profile_variables(self, frame: FieldFrame) -> dict[str, Measurand]:
        dims = ("along", "radius") if self._has_slices else ("radius",)
        field = frame.unit.field
        if field == _B:
            return {"axial_field": Measurand(dims, "T", "Axial magnetic field")}
        if field == _E:
            return {
                "electric_potential": Measurand(dims, "V", "Electric potential"),
                "radial_field": Measurand(dims, "V/m", "Radial electric field"),
            }
        if field == _N:
            return {"electron_density": Measurand(dims, "m⁻³", "Electron density")}
        if not _is_index(frame):
            long_name = "Deflection potential for each pixel along the beam"
            return {"profile": Measurand(dims, PIXEL, long_name)}
        profiles = {"refractive_index": Measurand(dims, "1", "Change of the refractive index")}
        if self.gladstone_dale is not None:
            profiles["density_change"] = Measurand(dims, "kg/m³", "Change of the density")
        if self.ambient_density is not None:
            profiles["density"] = Measurand(dims, "kg/m³", "Density")
        if self.ambient_temperature is not None:
            profiles["temperature"] = Measurand(dims, "K", "Temperature at constant pressure")
        return profiles

    def coordinates(self, frame: FieldFrame) -> dict[str, Coordinate]:
        count = len(self._axis.places())
        edges = np.array([*self._slices, count])
        middles = (edges[:-1] + edges[1:] - 1) / 2
        radii = np.arange(float(self._radius_px(frame)))
        coordinates = {
            "along": Coordinate.in_plane(middles, frame, "Distance along the axis"),
            "radius": Coordinate.in_plane(radii, frame, "Distance from the axis"),
        }
        if not self._has_slices:
            del coordinates["along"]
        return coordinates

    @property
    def _has_slices(self) -> bool:
        return len(self._slices) > 1

    def measure(self, potential: FloatArray, displacement: FloatArray, frame: FieldFrame) -> Values:
        right_side, left_side = self._sides(displacement, frame)
        _, inverse = self._operators(frame)
        values = self._profiles((right_side + left_side) / 2 @ inverse.T, frame)
        scale = _scale(frame)
        values["half_difference"] = scale * (right_side - left_side) @ inverse.T
        if not self._has_slices:
            values = {name: profiles[0] for name, profiles in values.items()}
        values["asymmetry"] = np.asarray(asymmetry(right_side, left_side))
        mean = np.abs((right_side + left_side) / 2)
        width = _end_width(mean.shape[1])
        edge = np.abs((right_side + left_side)[:, -width:].mean(axis=1) / 2).max()
        values["edge"] = np.asarray(edge / max(mean.max(), 1e-300))
        values["axis_offset"] = np.asarray(_axis_offset(right_side, left_side))
        return values

    def _profiles(self, profile: FloatArray, frame: FieldFrame, least: float = 0.02) -> Values:
        """Return the profiles; below a least ratio of densities a temperature is only noise."""
        first, *further = self._profile_variables(frame)
        change = _scale(frame) * profile
        values = {first: change}
        if "radial_field" in further:
            # The profile is even at the axis and ends at 0.
            padded = np.concatenate([change[:, 1:2], change, 0 * change[:, :1]], axis=1)
            values["radial_field"] = -(padded[:, 2:] - padded[:, :-2]) / (2 * frame.pixel)
        if self.gladstone_dale is not None:
            values["density_change"] = change / self.gladstone_dale
        if self.ambient_density is not None:
            values["density"] = self.ambient_density + values["density_change"]
        if self.ambient_temperature is not None and self.ambient_density is not None:
            ratio = values["density"] / self.ambient_density
            hot = self.ambient_temperature / np.maximum(ratio, least)
            values["temperature"] = hot
        return values

    def systematic(
        self, potential: FloatArray, displacement: FloatArray, frame: FieldFrame
    ) -> Values:
        """Return the changes by one more smoothing and by the axis' error."""
        matrix, inverse = self._operators(frame)
        right_side, left_side = self._sides(displacement, frame)
        profile = (right_side + left_side) / 2 @ inverse.T
        values = self._profiles(profile, frame)
        again = self._profiles(profile @ matrix.T @ inverse.T, frame)
        errors = {name: np.abs(again[name] - value) for name, value in values.items()}
        if self.axis_error:
            pairs = (self._sides(displacement, frame, sign * self.axis_error) for sign in (1, -1))
            moved = [self._profiles((a + b) / 2 @ inverse.T, frame) for a, b in pairs]
            for name, error in errors.items():
                change = np.abs(moved[0][name] + moved[1][name] - 2 * values[name]) / 2
                errors[name] = np.hypot(error, change)
        if not self._has_slices:
            errors = {name: error[0] for name, error in errors.items()}
        return errors

    def facts(self, quantities: Mapping[str, Quantity], frame: FieldFrame) -> list[Fact]:
        # Noise raises both shares, which say how far the object is from the assumptions.
        shares = {name: float(quantities[name].value) for name in ("asymmetry", "edge")}
        return [
            replace(fact, text=percent(shares[fact.key]), short="") if fact.key in shares else fact
            for fact in super().facts(quantities, frame)
        ]

    def cautions(self, quantities: Mapping[str, Quantity], frame: FieldFrame) -> Iterator[Caution]:
        axis, radius = self._axis, self._radius_px(frame)
        points = axis.points(axis.places(), np.arange(-radius + 1.0, radius)).reshape(-1, 2)
        yield from mask_cautions(points, frame, "the object")
        edge, halves = (float(quantities[name].value) for name in ("edge", "asymmetry"))
        if edge > self.limits.edge:
            yield Caution(
                "edge",
                f"the deflection at the edge is {percent(edge)} of the largest: the object does "
                "not end inside the radius, which shifts and bends the profile; use a wider image",
            )
        if halves > self.limits.asymmetry:
            yield Caution(
                "misfit",
                f"the halves of the object differ by {percent(halves)} (r.m.s.): it is not "
                "symmetric about this axis, and the profile is that of the mean of the halves",
            )
        profile = np.atleast_2d(quantities[next(iter(self._profile_variables(frame)))].value)
        yield from _length_cautions(np.abs(profile), frame, self.limits)

    def remarks(self, frame: FieldFrame) -> Iterator[str]:
        yield (
            "The profile assumes rotational symmetry about the axis, and no change beyond the "
            "radius; an inclination of the axis towards the beam is not seen."
        )
        (y0, x0), (y1, x1) = self._axis.start, self._axis.end
        error = "" if self.axis_error is None else f", position ± {to_figures(self.axis_error)} px"
        yield (
            f"The axis runs from y = {y0:.1f}, x = {x0:.1f} to y = {y1:.1f}, x = {x1:.1f} px"
            f"{error}."
        )
        if self.ambient_temperature is not None:
            yield (
                "Density and temperature assume one Gladstone-Dale constant and one molar mass "
                "everywhere; those of burnt gas differ from those of air by several per cent."
            )


class AzimuthalProfile(Product):
    """Azimuthal magnetic field around an axis along the beam, and the current that it encloses.

    Seen along its axis an azimuthal field deflects radially, so its line integral is read off: the
    mean of ∫B_φ dz over circles. The enclosed current is 2πr ∫B_φ dz / µ₀, in A m, since the field
    is integrated along the beam. Positive fields run counter-clockwise in the image as shown.
    """

    title = "azimuthal field along the beam"
    place = 65
    fields: ClassVar = (_B,)
    curves: ClassVar = ("azimuthal_field", "variation")
    reading: ClassVar = (
        "A positive current flows along the beam, and its field runs clockwise in the image.",
    )
    product: Literal["azimuthal"] = "azimuthal"
    center: Point = Field(
        title="Centre (px)",
        description="Centre (y, x) of the circles in px.",
        json_schema_extra={"metavar": "Y,X"},
    )
    radius: float | None = number_field(
        "Radius (px)",
        "Radius of the largest circle in px. Default: up to the edge of the image.",
        None,
        ge=_MIN_RADIUS_PX,
    )

    def check(self, frame: FieldFrame) -> None:
        super().check(frame)
        frame.check_points(np.array([self.center]), "the centre")
        self._radii(frame)

    def _radii(self, frame: FieldFrame) -> FloatArray:
        pairs = zip(self.center, frame.shape, strict=True)
        most = min(min(place, count - 1 - place) for place, count in pairs)
        return np.arange(_chosen_radius(self.radius, most, "centre") + 1.0)

    def variables(self, frame: FieldFrame) -> dict[str, Measurand]:
        dims = ("radius",)
        return {
            "azimuthal_field": Measurand(dims, "T m", "Path-integrated azimuthal magnetic field"),
            "current": Measurand(dims, "A m", "Path-integrated enclosed current"),
            "variation": Measurand(dims, "T m", "Variation of the field along the circle (r.m.s.)"),
        }

    def coordinates(self, frame: FieldFrame) -> dict[str, Coordinate]:
        return {"radius": Coordinate.in_plane(self._radii(frame), frame, "Distance from the axis")}

    def measure(self, potential: FloatArray, displacement: FloatArray, frame: FieldFrame) -> Values:
        radii = self._radii(frame)
        angles = 2 * np.pi * np.arange(max(int(6 * radii[-1]), 16)) / max(int(6 * radii[-1]), 16)
        sine, cosine = np.sin(angles), np.cos(angles)
        points = np.array(self.center) + radii[:, None, None] * np.stack([sine, cosine], axis=-1)
        field = frame.field(potential, displacement)
        # Counter-clockwise with y downwards: along (y, x) = (-cos, sin) of the angle from x to y.
        azimuthal = -cosine * interpolate_cubic(field[0], points)
        azimuthal += sine * interpolate_cubic(field[1], points)
        mean = azimuthal.mean(axis=1)
        # With x to the right, y down and z into the screen, a current along the beam has a
        # field from x to y, which is clockwise as shown.
        return {
            "azimuthal_field": mean,
            "current": -2 * np.pi * frame.length(1.0) * radii * mean / mu_0,
            "variation": azimuthal.std(axis=1),
        }


def _chosen_radius(radius: float | None, most: float, middle: str) -> int:
    """Return the radius in px, by default the distance of the axis or centre from the edge."""
    if most < _MIN_RADIUS_PX:
        raise InputError(
            f"the {middle} comes within {most:.3g} px of the edge of the image, expected at least "
            f"{_MIN_RADIUS_PX} px from the edge: shorten or move it"
        )
    if radius is not None and radius > most + 0.5:
        raise InputError(
            f"radius is {radius:g} px, expected at most {most:.1f} px: the distance of the "
            f"{middle} from the edge of the image"
        )
    return int(most if radius is None else min(radius, most))


def _scale(frame: FieldFrame) -> float:
    """Return the first of the profiles for a profile of 1 px."""
    field, setup, pixel = frame.unit.field, frame.setup, frame.pixel
    unit_plane = np.ones(1)
    if field == _B:
        return 1.0 / pixel
    if setup is None or not (field in (_E, _N) or _is_index(frame)):
        return 1.0
    if field == _E:
        return float(setup.field_in_si(_E, np.ones((2, 1)))[0, 0])
    if field == _N:
        return float(setup.field_in_si(_N, unit_plane)[0]) / pixel
    return -float(setup.potential(unit_plane)[0]) / pixel


def _is_index(frame: FieldFrame) -> bool:
    if frame.setup is None:
        return False
    is_light = any(each.name == _INDEX for each in frame.setup.si_fields)
    return is_light and frame.unit.field in ("deflection_angle", _INDEX)


def _found_axis(
    displacement: FloatArray,
    noise: FieldNoise | None,
    direction: str,
    find_tilt: bool,
    tilt_errors: float = 4.0,  # by few draws, below which an inclination is not significant
) -> tuple[Axis, float | None]:
    """Return the axis with its standard error in px; an inclination within its error is none."""
    axis = find_axis(displacement, direction, find_tilt=find_tilt)
    if noise is None or len(noise.potentials) < 3:
        return axis, None
    ends = []
    for change in noise.potentials:
        moved = displacement + displacement_from_potential(change)
        shifted = find_axis(moved, start=axis, find_tilt=find_tilt)
        ends.append((np.array([shifted.start, shifted.end]) - [axis.start, axis.end]) @ axis.across)
    start, end = np.array(ends).T
    tilt = abs(axis.across[0] if direction == "vertical" else axis.across[1]) * axis.length
    if find_tilt and tilt < tilt_errors * float(np.std(end - start, ddof=1)):
        return _found_axis(displacement, noise, direction, find_tilt=False)
    return axis, float(np.sqrt((np.var(start, ddof=1) + np.var(end, ddof=1)) / 2))


def _end_width(radius: int, share: float = 0.06) -> int:
    """Return over how many px from the edge, by which the field should end, it is averaged."""
    return max(round(share * radius), 2)


def _axis_offset(right_side: FloatArray, left_side: FloatArray) -> float:
    """Return by how many px the axis of the field is to the right of the assumed axis.

    To first order, halves (δ(y), -δ(-y)) differ by -2 Δ δ'(y) of a field that is shifted by Δ.
    """
    slope = np.gradient((right_side + left_side) / 2, axis=1)
    size = float(np.sum(slope**2))
    return -float(np.sum((right_side - left_side) * slope)) / (2 * size) if size > 0 else 0.0


def _length_cautions(
    profile: FloatArray, frame: FieldFrame, limits: AxisymmetryCheck
) -> Iterator[Caution]:
    """Warn of an object that is not thin against its distance from a point source."""
    setup = frame.setup
    if setup is None or setup.is_collimated:
        return
    strong = np.flatnonzero((profile > limits.profile_end * profile.max()).any(axis=0))
    length = 2 * frame.length(float(strong.max()) if len(strong) else 0.0)
    share = length / setup.source_object_distance
    if share > limits.length:
        yield Caution(
            "setup",
            f"the object is {length_text(length)} long along the beam, {percent(share)} of its "
            "distance from the source: rays are not parallel inside it and magnify its front more "
            "than its back, which the Abel inversion does not allow for",
        )
