"""Line integrals of a field: `Flux`, `EnclosedCurrent`, `EnclosedCharge`.

A magnetic field b = ∫B dz deflects by a = ∇Φ turned by a right angle. So the flux of b across a
line is a difference of the potential at its ends, whatever the path between them; and its
circulation around an outline is the outward flux of the deflection.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar, Literal

import numpy as np
from scipy import constants

from napari_shadowinv._typing import FloatArray
from napari_shadowinv.analysis.frame import FieldFrame
from napari_shadowinv.analysis.lines import Path, path_field
from napari_shadowinv.analysis.outlines import Outlined
from napari_shadowinv.analysis.paths import edge_midpoints, interpolate_cubic
from napari_shadowinv.analysis.product import Measurand, Product, Values, mask_cautions
from napari_shadowinv.cautions import Caution
from napari_shadowinv.errors import InputError
from napari_shadowinv.inversion.error_bars import Quantity

_B, _E = "path_integrated_b", "path_integrated_e"


class Flux(Product):
    """Magnetic flux across a line: ∫(∫B dz)·n dl.

    The normal n points to the right of the line's direction as the image is shown, with y
    downwards. The flux depends on the ends of the line alone, because B has no sources.
    """

    title = "flux across a line"
    primary = "path"
    place = 30
    fields = (_B,)
    reading = (
        "The flux is that of the field integrated along the beam, across the line; a flux of "
        "it through an area of the image has no meaning.",
    )
    product: Literal["flux"] = "flux"
    path: Path = path_field("Corners of the line or path, (y, x) in px; only its ends count.")

    def check(self, frame: FieldFrame) -> None:
        if self.path[0] == self.path[-1]:
            raise InputError(
                "the line is closed, and the flux across a closed line is zero, as a magnetic "
                "field has no sources: expected an open line; the current inside is the product "
                "'current'"
            )
        super().check(frame)
        frame.check_points(np.array(self.path), "the path")

    def variables(self, frame: FieldFrame) -> dict[str, Measurand]:
        return {"flux": Measurand((), "Wb", "Magnetic flux across the line")}

    def measure(self, potential: FloatArray, displacement: FloatArray, frame: FieldFrame) -> Values:
        start, end = interpolate_cubic(potential, np.array([self.path[0], self.path[-1]]))
        # A displacement along the line belongs to a field across it.
        return {"flux": np.asarray((start - end) * unit_field(frame)[0] * frame.pixel)}


class _Enclosed(Outlined):
    """Outward flux of the deflection through an outline, which follows from sources inside."""

    unit: ClassVar[str]
    long_name: ClassVar[str]

    def variables(self, frame: FieldFrame) -> dict[str, Measurand]:
        return {self.name(): Measurand((), self.unit, self.long_name)}

    def measure(self, potential: FloatArray, displacement: FloatArray, frame: FieldFrame) -> Values:
        points, sides = edge_midpoints(self.outline)
        down, right = (interpolate_cubic(plane, points) for plane in displacement)
        # From x to y around the outline, outwards is to the left of the direction.
        outward = float((right * sides[:, 0] - down * sides[:, 1]).sum())
        return {self.name(): np.asarray(source_by_flux(frame) * outward * frame.pixel)}

    def cautions(self, quantities: Mapping[str, Quantity], frame: FieldFrame) -> list[Caution]:
        return mask_cautions(edge_midpoints(self.outline)[0], frame, "the outline")


class EnclosedCurrent(_Enclosed):
    """Current along the beam inside an outline: ∫I dz = ∮(∫B dz)·dl / µ₀.

    Positive along the beam, into the image as it is shown.
    """

    title = "enclosed current"
    place = 40
    fields = (_B,)
    unit = "A m"
    long_name = "Current inside the outline, integrated along z"
    reading = (
        "The current is integrated over the thickness of the object: divide by its length "
        "along the beam for a mean current in A.",
    )
    product: Literal["current"] = "current"


class EnclosedCharge(_Enclosed):
    """Charge inside an outline, ε₀ ∮(∫E dz)·n dl, over the thickness of the object."""

    title = "enclosed charge"
    place = 50
    fields = (_E,)
    unit = "C"
    long_name = "Charge inside the outline"
    reading = (
        "This is Gauss's law in the column behind the outline: it holds if the electric field "
        "along the beam vanishes before and behind the object.",
    )
    product: Literal["charge"] = "charge"


def unit_field(frame: FieldFrame) -> FloatArray:
    """Return the field (y, x) in SI units by a displacement of 1 px along x."""
    return np.asarray(frame.field(np.zeros(1), np.array([[0.0], [1.0]]))).ravel()


def source_by_flux(frame: FieldFrame) -> float:
    """Return a source of the field by an outward flux of the displacement of 1 px².

    It is (1/µ₀) ∮(∫B dz)·dl in A, or ε₀ ∮(∫E dz)·n dl in C/m, to be multiplied by the pixel size.
    """
    field_y, field_x = unit_field(frame)
    if frame.unit.field == _B:
        # In the direction from x to y around an outline, +y follows outwards +x.
        return float(field_y / constants.mu_0)
    return float(field_x * constants.epsilon_0)
