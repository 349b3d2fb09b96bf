"""The base class of all setups, and the description of each kind of setup."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike
from pydantic import (
    ConfigDict,
    Field,
    ValidationInfo,
    field_validator,
    model_serializer,
    model_validator,
)

from napari_shadowinv._system.arrays import checked_plane, plain_array, unmasked
from napari_shadowinv._system.validation import CheckedModel
from napari_shadowinv._typing import FloatArray
from napari_shadowinv.physics.setup._quantities import (
    number_in_unit,
    takes_prefixes,
    unit_in_title,
)


@dataclass(frozen=True)
class SIField:
    """A field in SI units: a variable of a dataset, made by a method of the setup.

    A vector is made of the displacement in px, a plane of the normalised potential in px².
    The method has the name of the variable by default. `deflector` is the key of the only cause of
    deflection with which the field makes sense, empty for any.
    """

    name: str
    unit: str
    long_name: str
    is_vector: bool = False
    method: str = ""
    deflector: str = ""


@dataclass(frozen=True)
class MainField:
    """The vector among a setup's SI fields that figures and layers show, and how.

    `components` are the symbols along y and x; `arrows` is the title of the field's own arrows,
    empty where they would point along the displacement.
    """

    name: str
    title: str
    symbol: str
    components: tuple[str, str]
    arrows: str = ""


@dataclass(frozen=True)
class Deflector:
    """Cause of a deflection.

    `key` names it in a fit, `title` in words, in projections and in files, `label` in forms.
    """

    key: str
    title: str
    label: str


@dataclass(frozen=True)
class BeamQuantity:
    """Quantity that differs between the beams of several images of one object, such as the energy.

    `name` is the field of the setup, the column of tables and the coordinate of datasets; `noun`
    is for sentences.
    """

    name: str
    noun: str
    unit: str
    long_name: str
    description: str

    @property
    def plural(self) -> str:
        """Noun for several values, such as "energies"."""
        return f"{self.noun[:-1]}ies" if self.noun.endswith("y") else f"{self.noun}s"

    def text(self, *values: float, digits: int = 4) -> str:
        """Return values with their unit, such as "14.7 MeV" or "532, 810 nm"."""
        size, unit = length_unit(max(values)) if self.unit == "m" else (1.0, self.unit)
        return f"{', '.join(f'{value / size:.{digits}g}' for value in values)} {unit}"


def positive_field(title: str, description: str, default: Any = ..., *, most: float) -> Any:
    """Return the field of a positive number up to a limit."""
    return Field(
        default=default,
        gt=0,
        le=most,
        allow_inf_nan=False,
        title=title,
        description=description,
    )


# Beyond any experiment, and far from the numbers that products in double precision cannot hold.
_MAX_DISTANCE_M, _MAX_PIXEL_M = 1e9, 1e6
_MIN_LENGTH_M = 1e-15


class BeamSetup(CheckedModel):
    """Geometry that every probe has: distances, pixels, magnification.

    Made only as one of its kinds, which describe themselves: nothing else asks for the kind.
    A dump holds no None and takes inf, so it can be written as TOML or JSON and read back.
    """

    title: ClassVar[str]  # of the kind in a form
    beam: ClassVar[str]  # the particles or waves of the beam
    # What a result holds in SI units; `main_field` is the one of them that is shown.
    si_fields: ClassVar[tuple[SIField, ...]] = (
        SIField("potential_si", "m", "Deflection potential", method="potential"),
        SIField("deflection_angle", "rad", "Deflection angle", is_vector=True),
    )
    main_field: ClassVar = MainField("deflection_angle", "Deflection angle", "|α|", ("αy", "αx"))
    # What is shown instead where it is known that something else deflects.
    other_fields: ClassVar[dict[str, MainField]] = {}
    beam_field: ClassVar[str]  # name of the field with the `BeamQuantity`
    deflectors: ClassVar[tuple[Deflector, ...]]  # see `angle_ratio`
    in_pradformat: ClassVar[bool] = False  # whether that format can describe the beam
    # Whether a small source magnifies the object onto a film or plate, as it does with particles.
    projects: ClassVar[bool] = False

    model_config = ConfigDict(frozen=True, extra="forbid", ser_json_inf_nan="strings")

    kind: str = Field(title="Kind", description="Kind of probe.")
    source_object_distance: float = Field(
        gt=0,
        title="Source to object (m)",
        description="Distance l from the beam source to the object, in m; inf if collimated.",
    )
    object_image_distance: float = positive_field(
        "Object to image (m)",
        "Distance L from the object to the detector, in m.",
        most=_MAX_DISTANCE_M,
    )
    pixel_size: float | None = positive_field(
        "Pixel size at the object (m)",
        "Pixel size in the object plane, in m. Give either this or the detector pixel size.",
        None,
        most=_MAX_PIXEL_M,
    )
    detector_pixel_size: float | None = positive_field(
        "Pixel size at the detector (m)",
        "Pixel size in the detector plane, in m; it is divided by the magnification. Give "
        "either this or the pixel size at the object.",
        None,
        most=_MAX_PIXEL_M,
    )

    @field_validator("*", mode="before")
    @classmethod
    def _read_unit(cls, value: Any, info: ValidationInfo) -> Any:
        """Turn a text such as "14.7 MeV" into the number in the field's unit."""
        unit = unit_in_title(cls.model_fields[info.field_name or ""].title)
        if not isinstance(value, str) or not takes_prefixes(unit):
            return value
        try:
            return float(value)
        except ValueError:
            return number_in_unit(value, unit)

    @model_validator(mode="after")
    def _one_pixel_size(self) -> BeamSetup:
        is_set = [self.pixel_size is not None, self.detector_pixel_size is not None]
        if sum(is_set) != 1:
            received = "both" if all(is_set) else "neither"
            raise ValueError(
                "give either 'pixel_size' (m, in the object plane) or 'detector_pixel_size' "
                f"(m, in the detector plane), received {received}"
            )
        return self

    @model_validator(mode="after")
    def _lengths_in_range(self) -> BeamSetup:
        for name in self.model_fields_set:
            is_length = unit_in_title(type(self).model_fields[name].title) == "m"
            length = getattr(self, name) if is_length else None
            if length is not None and length < _MIN_LENGTH_M:
                raise ValueError(
                    f"'{name}' is {length:g} m, expected at least {_MIN_LENGTH_M:g} m: check its "
                    "unit"
                )
        distance = self.source_object_distance
        if math.isfinite(distance) and distance > _MAX_DISTANCE_M:
            raise ValueError(
                f"'source_object_distance' is {distance:g} m, expected at most "
                f"{_MAX_DISTANCE_M:g} m, or inf for a collimated beam"
            )
        return self

    @model_serializer(mode="wrap")
    def _without_none(self, dump: Callable[[BeamSetup], dict[str, Any]]) -> dict[str, Any]:
        return {name: value for name, value in dump(self).items() if value is not None}

    @property
    def magnification(self) -> float:
        """Magnification M = 1 + L / l of the object on the detector; 1 if collimated."""
        return 1 + self.object_image_distance / self.source_object_distance

    @property
    def is_collimated(self) -> bool:
        """Whether the beam is parallel before the object."""
        return math.isinf(self.source_object_distance)

    @property
    def object_pixel_size(self) -> float:
        """Side p of a pixel in the object plane in m."""
        if self.pixel_size is not None:
            return self.pixel_size
        assert self.detector_pixel_size is not None
        return self.detector_pixel_size / self.magnification

    @property
    def pixel_sizes(self) -> tuple[float, float]:
        """Side of a pixel in m in the object plane and in the detector plane."""
        return self.object_pixel_size, self.object_pixel_size * self.magnification

    @property
    def _angle_per_pixel(self) -> float:
        return self.object_pixel_size * self.magnification / self.object_image_distance

    def deflection_angle(self, displacement: ArrayLike) -> FloatArray:
        """Angle a = d p M / L in rad of rays displaced by d px (Eq. 3 of the paper)."""
        return scale_by(displacement, self._angle_per_pixel)

    def displacement(self, angle: ArrayLike) -> FloatArray:
        """Displacement d = a L / (p M) in px of rays deflected by a in rad."""
        return scale_by(angle, 1 / self._angle_per_pixel)

    def potential(self, phi: ArrayLike) -> FloatArray:
        """Potential Φ = φ p² M / L in m, with a = -∇Φ, from φ in px² (Eq. 1 of the paper)."""
        return scale_by(phi, self.object_pixel_size * self._angle_per_pixel)

    def normalized_potential(self, potential: ArrayLike) -> FloatArray:
        """Potential φ = Φ L / (p² M) in px², from Φ in m."""
        return scale_by(potential, 1 / (self.object_pixel_size * self._angle_per_pixel))

    def displacement_from_potential(self, potential: ArrayLike) -> FloatArray:
        """Displacement (px) of a potential in SI units (m); see the function of this name."""
        return displacement_from_potential(self.normalized_potential(potential))

    def field_in_si(self, name: str, values: ArrayLike) -> FloatArray:
        """One of `si_fields`, of the displacement (px) or the normalised potential (px²)."""
        (method,) = (field.method or name for field in self.si_fields if field.name == name)
        in_si: FloatArray = getattr(self, method)(values)
        return in_si

    @property
    def max_source_distance(self) -> float:
        """Distance in m from the object beyond which such a source is unusual."""
        return math.inf

    def probe_doubts(self) -> Iterator[str]:
        """Yield a sentence for everything about the probe itself that is unusual."""
        yield from ()

    @classmethod
    def beam_quantity(cls) -> BeamQuantity:
        """Describe the quantity that differs between images of one object."""
        field = cls.model_fields[cls.beam_field]
        title = (field.title or cls.beam_field).partition(" (")[0]
        noun = title.split()[-1].lower()
        return BeamQuantity(
            name=cls.beam_field,
            noun=noun,
            unit=unit_in_title(field.title),
            long_name=f"{noun.capitalize()} of the {cls.beam}",
            description=field.description or "",
        )

    @property
    def beam_value(self) -> float:
        """Value of the quantity that differs between images of one object."""
        value: float = getattr(self, self.beam_field)
        return value

    @classmethod
    def deflector_titles(cls) -> tuple[str, ...]:
        """Return the titles of the causes of a deflection."""
        return tuple(deflector.title for deflector in cls.deflectors)

    @classmethod
    def own_fields(cls) -> set[str]:
        """Names of the fields that only this kind has."""
        return cls.model_fields.keys() - BeamSetup.model_fields.keys()

    @property
    @abstractmethod
    def probe(self) -> str:
        """The beam in a few words, such as "14.7 MeV proton"."""

    @classmethod
    @abstractmethod
    def example(cls) -> Self:
        """Return an experiment to start from."""

    @abstractmethod
    def default_deflector(self, recorded_with: Any) -> str:
        """Return the default cause of the deflection; an `InputError` if there is none."""

    @abstractmethod
    def angle_ratio(self, recorded_with: Any, deflector: str) -> float:
        """Deflection angle by one object here over that with a setup of the same kind."""


def displacement_from_potential(potential: ArrayLike) -> FloatArray:
    """Displacement d = -∇φ by central differences, for files with a potential only.

    Takes the normalised potential in px², shape (H, W); returns px, shape (2, H, W), of second
    order up to the border. An `InputError` if the potential is no plane, or smaller than 3 × 3.

    Examples
    --------
    >>> displacement_from_potential(np.tile(np.arange(4.0) ** 2, (3, 1)))[1, 0, 1:]
    array([-2., -4., -6.])
    """
    values = checked_plane(plain_array(potential, "potential"), "potential", 3)
    plane = np.asarray(values, dtype=np.float64)
    return -np.stack([np.gradient(plane, axis=axis, edge_order=2) for axis in (0, 1)])


def scale_by(values: ArrayLike, factor: float) -> FloatArray:
    """Values times a factor, as float64."""
    product: FloatArray = np.asarray(unmasked(values, "values"), dtype=np.float64) * factor
    return product


_LENGTH_UNITS = ((1e3, "km"), (1.0, "m"), (1e-2, "cm"), (1e-3, "mm"), (1e-6, "µm"), (1e-9, "nm"))


def length_text(length: float) -> str:
    """Return a length in m in the unit that suits it, such as "2.13 cm"."""
    size, unit = length_unit(length)
    return f"{length / size:.3g} {unit}"


def length_unit(length: float) -> tuple[float, str]:
    """Return the unit that suits a length in m: its size in m, and its symbol."""
    fitting = ((size, unit) for size, unit in _LENGTH_UNITS if length >= 0.9995 * size)
    return next(fitting, _LENGTH_UNITS[-1])
