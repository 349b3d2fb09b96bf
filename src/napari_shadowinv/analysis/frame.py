"""The plane in which products are measured, and the units of its field: `FieldFrame`.

- units to choose from: `FIELD_UNITS`, `field_unit`
- the limits of a radiograph, in sentences: `FieldFrame.limits`
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from napari_shadowinv._typing import AnyArray, BoolArray, FloatArray
from napari_shadowinv.analysis.paths import is_inside
from napari_shadowinv.errors import InputError
from napari_shadowinv.facts import percent
from napari_shadowinv.physics.beam import SIField
from napari_shadowinv.physics.setup import Setup
from napari_shadowinv.physics.units import PIXEL

# Error of rods whose rays nearly cross, and their length over the distance to the source, by
# `benchmarks/tracing.py length`.
_THIN_SCREEN_ERRORS = (0.015, 0.1), (0.032, 0.2)
_DISPLACEMENT = SIField("displacement", PIXEL, "Displacement", is_vector=True)


@dataclass(frozen=True)
class FieldUnit:
    """Unit in which a field is shown."""

    symbol: str  # as people write it, such as "MG µm"
    size: float  # in the SI unit of the field
    field: str  # its variable, such as "path_integrated_b"; one of the setup's `si_fields`


_B, _E = "path_integrated_b", "path_integrated_e"
FIELD_UNITS: dict[str, FieldUnit] = {
    unit.symbol: unit
    for unit in (
        FieldUnit("T m", 1.0, _B),
        FieldUnit("T mm", 1e-3, _B),
        FieldUnit("MG µm", 1e-4, _B),
        FieldUnit("kG cm", 1e-3, _B),
        FieldUnit("G cm", 1e-6, _B),
        FieldUnit("V", 1.0, _E),
        FieldUnit("m⁻²", 1.0, "line_integrated_density"),
        FieldUnit("m", 1.0, "line_integrated_log_index"),
        FieldUnit("rad", 1.0, "deflection_angle"),
        FieldUnit("px", 1.0, "displacement"),
    )
}
"""Units of fields by their symbols. Each belongs to one field, which it chooses."""

_SPELLINGS = {"MG um": "MG µm", "m-2": "m⁻²", "m^-2": "m⁻²"}


def field_unit(symbol: str) -> FieldUnit:
    """Return a unit by its symbol; an `InputError` if there is no such unit.

    Examples
    --------
    >>> field_unit("MG um").size
    0.0001
    """
    spaced = symbol.replace("·", " ").replace("μ", "µ")
    unit = FIELD_UNITS.get(_SPELLINGS.get(spaced, spaced))
    if unit is None:
        raise InputError(f"unit is {symbol!r}, expected one of {', '.join(FIELD_UNITS)}")
    return unit


def si_unit_of(field: str) -> str:
    """Return the unit of a field in datasets, such as "T m" of "path_integrated_b"."""
    if field == "displacement":
        return PIXEL
    return next(unit.symbol for unit in FIELD_UNITS.values() if unit.field == field)


@dataclass(frozen=True, eq=False)
class FieldFrame:
    """The plane of a field: its pixels, its setup, and the unit of the field.

    Attributes
    ----------
    shape : tuple of int
        Height and width in px.
    mask : ndarray of bool, shape (H, W)
        Pixels that were used; elsewhere the field is a smooth continuation.
    setup : Setup or None
        The experiment. None: everything is measured in pixels.
    deflector : str
        Key of the cause of the deflection, such as "B" or "E"; empty if there is no setup.
    unit : FieldUnit
        Unit of the field, which also decides which field is measured.
    image, source : ndarray, shape (H, W), or None
        The recorded image and the undisturbed beam in its unit; NaN where masked.
    has_crossed_rays : bool
        Whether the result says that rays cross.
    """

    shape: tuple[int, int]
    mask: BoolArray
    setup: Setup | None
    deflector: str
    unit: FieldUnit
    image: AnyArray | None = None
    source: AnyArray | None = None
    has_crossed_rays: bool = False

    @cached_property
    def contrast(self) -> FloatArray | None:
        """Image over source, less 1, shape (H, W); 0 where there is no source."""
        if self.image is None or self.source is None:
            return None
        is_lit = self.source > 0
        ratio = np.divide(self.image, self.source, out=np.ones(self.shape), where=is_lit)
        return np.asarray(np.where(is_lit, ratio - 1, 0.0), dtype=np.float64)

    @property
    def pixel(self) -> float:
        """Side of a pixel in the object plane in m; 1 without a setup."""
        return 1.0 if self.setup is None else self.setup.object_pixel_size

    @property
    def length_unit(self) -> str:
        """Unit of lengths in datasets: "m", or pixels without a setup."""
        return PIXEL if self.setup is None else "m"

    @property
    def si_unit(self) -> str:
        """Unit of the field's values in datasets, such as "T m"."""
        return si_unit_of(self.unit.field)

    @cached_property
    def _si_field(self) -> SIField:
        """The setup's field in the unit, or the displacement in pixels."""
        if self.setup is None or self.unit.field == _DISPLACEMENT.name:
            return _DISPLACEMENT
        return next(field for field in self.setup.si_fields if field.name == self.unit.field)

    @property
    def long_name(self) -> str:
        """The field in words, such as "Path-integrated magnetic field"."""
        return self._si_field.long_name.partition(",")[0]

    @property
    def is_vector(self) -> bool:
        """Whether the field has components, as line-integrated densities have not."""
        return self._si_field.is_vector

    def field(self, potential: FloatArray, displacement: FloatArray) -> FloatArray:
        """Return the field in SI units.

        Parameters
        ----------
        potential : ndarray, shape (H, W)
            In px².
        displacement : ndarray, shape (2, H, W)
            In px.

        Returns
        -------
        ndarray, shape (2, H, W), or (H, W) if it is no vector
            Of a vector the components along y and x.
        """
        if self._si_field is _DISPLACEMENT or self.setup is None:
            return displacement
        return self.setup.field_in_si(
            self.unit.field, displacement if self.is_vector else potential
        )

    @cached_property
    def limits(self) -> tuple[str, ...]:
        """Sentences on the parts of this field that the image cannot show."""
        axial = {
            _B: "A magnetic field along the beam deflects nothing, and neither does any field "
            "whose line integral across the beam vanishes, such as the azimuthal field of a "
            "current across the beam seen from the side.",
            _E: "An electric field along the beam changes the energy of the particles, not their "
            "direction, and is not measured.",
        }.get(self.unit.field, "Only gradients across the beam deflect.")
        sentences = [
            axial,
            "A rotation of the displacement is not seen: the deflection is taken as the gradient "
            "of a potential, as it is for thin objects.",
            "A uniform deflection shifts the whole image, and a purely magnifying one scales it: "
            "neither differs from a shifted beam or another distance, unless the position of the "
            "beam on the detector is known.",
        ]
        if self.setup is not None and not self.setup.is_collimated:
            source = self.setup.source_object_distance
            errors = " and ".join(
                f"{percent(error)} for an object of {1e3 * share * source:.3g} mm along the beam"
                for error, share in _THIN_SCREEN_ERRORS
            )
            sentences.append(
                f"The object is taken as thin: this errs by about {errors}; fields along the beam "
                "add to it."
            )
        return tuple(sentences)

    def check_points(self, points: FloatArray, name: str) -> None:
        """Refuse points (n, 2) of which any is outside the image, with an `InputError`."""
        outside = ~is_inside(points, self.shape)
        if not np.isfinite(points).all():
            raise InputError(f"{name} has a point that is not finite, expected (y, x) in px")
        if outside.any():
            y, x = points[outside][0]
            raise InputError(
                f"{name} has the point y = {y:g}, x = {x:g} px, expected points inside the image "
                f"of {self.shape[0]} × {self.shape[1]} px"
            )

    def length(self, pixels: float) -> float:
        """Return a length in px in the unit of lengths."""
        return pixels * self.pixel
