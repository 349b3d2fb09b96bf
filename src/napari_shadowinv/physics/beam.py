"""Beams that probe an object: the base class of all setups, and checks of their numbers.

- how a kind of setup is described: `BeamSetup`, `SIField`, `MainField`, `Deflector`, `BeamQuantity`
- whether its numbers are plausible: `setup_cautions`, `deflection_cautions`; for people to
  check: `geometry_text`, `field_of_view_text`
- the gradient of a potential in pixels: `displacement_from_potential`
- numbers with units in text, such as ``"14.7 MeV"``: `number_in_unit`, `text_in_unit`

A setup may be possible but unlike any experiment, mostly because of a unit: mm, µm or cm typed
where m is expected, eV where MeV is. The limits of its numbers leave room for every common
experiment: laser-driven and fusion protons, electrons, laser light.
"""

from __future__ import annotations

import itertools
import math
import re
from abc import abstractmethod
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from decimal import Decimal
from types import MappingProxyType
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field, ValidationInfo, field_validator, model_serializer, model_validator

from napari_shadowinv._system.validation import CheckedModel, CombinationError
from napari_shadowinv._typing import FloatArray
from napari_shadowinv.cautions import Caution
from napari_shadowinv.errors import InputError
from napari_shadowinv.physics.arrays import check_plane, plain_array, refuse_masked

_QUANTITY = re.compile(r"([+-]?(?:\d+\.?\d*|\.\d+))(?:[eE]([+-]?\d+))?\s*(.*)")
_UNIT_IN_TITLE = re.compile(r"\(([^()]+)\)$")
_UNIT = re.compile(r"([fpnµμumckMGT]?)(m|eV|s)\^?(-?\d*)")
_SUPERSCRIPTS = str.maketrans("⁻⁰¹²³⁴⁵⁶⁷⁸⁹", "-0123456789")
_POWERS = {"f": -15, "p": -12, "n": -9, "µ": -6, "μ": -6, "u": -6, "m": -3, "c": -2, "": 0}
_POWERS |= {"k": 3, "M": 6, "G": 9, "T": 12}
_SHOWN_PREFIXES = {-15: "f", -12: "p", -9: "n", -6: "µ", -3: "m", 0: "", 3: "k", 6: "M", 9: "G"}
_EXAMPLES = {"m": "1.3 mm", "MeV": "14.7 MeV"}


def unit_in_title(title: str | None) -> str:
    """Return the unit in a title such as ``"Wavelength (m)"``; empty if there is none."""
    match = _UNIT_IN_TITLE.search(title or "")
    return match[1] if match else ""


def number_in_unit(text: str, unit: str) -> float:
    """Read a number such as ``"1.3 mm"``, ``"1e19 cm⁻³"`` or ``"inf"``, exact to the last digit.

    A bare number is in the unit, such as "m", "MeV" or "". A ValueError if the text is no number,
    or its unit does not measure the same.
    """
    text = text.strip()
    if text.lower() in ("inf", "infinity", "infinite", "∞"):
        return math.inf
    example = _EXAMPLES.get(unit, f"8 {unit}")
    expected = f"expected a number in {unit}, or one with a unit such as '{example}'"
    match = _QUANTITY.fullmatch(text)
    if match is None or (match[3] and not unit):
        raise ValueError(expected if unit else "expected a number")
    digits, exponent, name = match.groups()
    power = int(exponent or 0)
    if name not in ("", unit):
        ratio = _power_of_ratio(name, unit)
        if ratio is None:
            raise ValueError(f"the unit '{name}' cannot be converted to {unit}; {expected}")
        power += ratio
    return float(f"{digits}e{power}")


def numbers_in_unit(text: str, unit: str, name: str) -> list[float]:
    """Read numbers separated by commas, as `number_in_unit`; `name` is what the text states."""
    try:
        return [number_in_unit(part, unit) for part in text.split(",")]
    except ValueError as error:
        raise InputError(f"{name} is '{text}': {error}, separated by commas") from None


def text_in_unit(value: float, unit: str) -> str:
    """Write a number with its unit, of which a length or an energy has a suitable prefix."""
    number = f"{value:.12g}"
    match = _UNIT.fullmatch(unit)
    if match is None or match[3] or not math.isfinite(value) or value == 0:
        return f"{number} {unit}" if unit and math.isfinite(value) else number
    decimal, own_power = Decimal(number), _POWERS[match[1]]
    power = 3 * ((decimal.adjusted() + own_power) // 3)
    power = min(max(power, min(_SHOWN_PREFIXES)), max(_SHOWN_PREFIXES))
    return f"{float(decimal.scaleb(own_power - power)):.12g} {_SHOWN_PREFIXES[power]}{match[2]}"


def _power_of_ratio(unit: str, other: str) -> int | None:
    """Return the power of ten by which a unit exceeds another; None for different quantities."""
    first, second = (_UNIT.fullmatch(each.translate(_SUPERSCRIPTS)) for each in (unit, other))
    if first is None or second is None or first.groups()[1:] != second.groups()[1:]:
        return None
    return (_POWERS[first[1]] - _POWERS[second[1]]) * int(first[3] or 1)


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
    """The vector among a setup's SI fields that figures and layers show, and how."""

    name: str
    title: str
    symbol: str
    components: tuple[str, str]  # symbols along y and x


@dataclass(frozen=True)
class Deflector:
    """Cause of a deflection."""

    key: str  # in a fit
    title: str  # in words, in projections and in files
    label: str  # in forms


@dataclass(frozen=True)
class BeamQuantity:
    """Quantity that differs between the beams of images of one object, such as the energy."""

    name: str  # of the setup's field, the column of tables and the coordinate of datasets
    noun: str  # for sentences
    unit: str
    long_name: str
    description: str

    def text(self, value: float) -> str:
        """Return a value with its unit, such as "14.7 MeV" or "532 nm"."""
        size, unit = length_unit(value) if self.unit == "m" else (1.0, self.unit)
        return f"{value / size:.4g} {unit}"


def number_field(title: str, description: str, default: Any = ..., **limits: Any) -> Any:
    """Return the field of a finite number within limits."""
    return Field(
        default=default, allow_inf_nan=False, title=title, description=description, **limits
    )


# Beyond any experiment, and far from the numbers that products in double precision cannot hold.
_MAX_DISTANCE_M, _MAX_PIXEL_M = 1e9, 1e6


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

    kind: str = Field(description="Kind of probe.")
    source_object_distance: float = Field(
        gt=0,
        title="Source to object (m)",
        description="Distance l from the beam source to the object, in m; inf if collimated.",
    )
    object_image_distance: float = number_field(
        "Object to image (m)",
        "Distance L from the object to the detector, in m.",
        gt=0,
        le=_MAX_DISTANCE_M,
    )
    pixel_size: float | None = number_field(
        "Pixel size at the object (m)",
        "Pixel size in the object plane, in m. Give either this or the detector pixel size.",
        None,
        gt=0,
        le=_MAX_PIXEL_M,
    )
    detector_pixel_size: float | None = number_field(
        "Pixel size at the detector (m)",
        "Pixel size in the detector plane, in m; it is divided by the magnification. Give "
        "either this or the pixel size at the object.",
        None,
        gt=0,
        le=_MAX_PIXEL_M,
    )

    @field_validator("*", mode="before")
    @classmethod
    def _read_unit(cls, value: Any, info: ValidationInfo) -> Any:
        """Turn a text such as "14.7 MeV" into the number in the field's unit."""
        unit = unit_in_title(cls.model_fields[info.field_name or ""].title)
        return number_in_unit(value, unit) if isinstance(value, str) and unit else value

    @model_validator(mode="after")
    def _one_pixel_size(self) -> BeamSetup:
        is_set = [self.pixel_size is not None, self.detector_pixel_size is not None]
        if sum(is_set) != 1:
            received = "both" if all(is_set) else "neither"
            raise CombinationError(
                f"received {received} of {{pixel_size}} and {{detector_pixel_size}}, expected one "
                "of them: the size of a pixel in the object plane or in the detector plane, in m"
            )
        return self

    @field_validator("*")
    @classmethod
    def _lengths_in_range(cls, value: Any, field: ValidationInfo) -> Any:
        name = str(field.field_name)
        if value is None or unit_in_title(cls.model_fields[name].title) != "m":
            return value
        if value < 1e-15:
            raise ValueError("expected at least 1e-15 m: check its unit")
        if name == "source_object_distance" and _MAX_DISTANCE_M < value < math.inf:
            raise ValueError(
                f"expected at most {_MAX_DISTANCE_M:g} m, or inf for a collimated beam"
            )
        return value

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
        return float(getattr(self, self.beam_field))

    def sensitivity_to_beam(self, name: str, *, step: float = 1e-3) -> float:
        """Return the relative change of one of `si_fields` by a relative change of `beam_field`."""
        factors = 1 - step, 1 + step
        setups = (self.model_copy(update={self.beam_field: f * self.beam_value}) for f in factors)
        low, high = (
            math.log(np.abs(setup.field_in_si(name, np.ones((2, 1, 1)))).max()) for setup in setups
        )
        return (high - low) / math.log(factors[1] / factors[0])

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

    >>> displacement_from_potential(np.tile(np.arange(4.0) ** 2, (3, 1)))[1, 0, 1:]
    array([-2., -4., -6.])
    """
    values = check_plane(plain_array(potential, "potential"), "potential", 3)
    plane = np.asarray(values, dtype=np.float64)
    return -np.stack([np.gradient(plane, axis=axis, edge_order=2) for axis in (0, 1)])


def scale_by(values: ArrayLike, factor: float) -> FloatArray:
    """Values times a factor, as float64."""
    product: FloatArray = np.asarray(refuse_masked(values, "values"), dtype=np.float64) * factor
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


@dataclass(frozen=True)
class UsualGeometry:
    """Limits of common experiments; mistakes in ``benchmarks/wrong_inputs.py`` are beyond them."""

    pixels: tuple[float, float] = (10e-9, 1e-3)  # m, at the object
    detector_pixel: float = 3e-6  # m, at least: no film scanner or plate reader resolves less
    distance: float = 10.0  # m, of the detector from the object, at most
    magnifications: tuple[float, float] = (2.0, 1000.0)  # the first with particles
    file_deviation: float = 0.03  # of a file's pixel size from the setup's
    deflection: float = 0.3  # rad, at most
    field: float = 10.0  # T m, at most


def geometry_text(setup: BeamSetup, shape: tuple[int, int] | None = None) -> str:
    """Return field of view, magnification and distance in a line, to be checked by eye.

    Without the shape of the image, the size of a pixel takes the place of the field of view.

    >>> from napari_shadowinv.physics.setup import ProtonSetup
    >>> lengths = {"source_object_distance": 1.3e-3, "object_image_distance": 2e-2}
    >>> geometry_text(ProtonSetup(energy=14.7, pixel_size=1.5e-6, **lengths), (200, 200))
    '300 × 300 µm at the object, M = 16.4, source to detector 2.13 cm'
    """
    pixel = f"pixel {length_text(setup.object_pixel_size)}"
    extent = pixel if shape is None else field_of_view_text(setup, shape)
    text = f"{extent} at the object, M = {setup.magnification:.3g}"
    if setup.is_collimated:
        return f"{text}, collimated, object to detector {length_text(setup.object_image_distance)}"
    total = setup.source_object_distance + setup.object_image_distance
    return f"{text}, source to detector {length_text(total)}"


def field_of_view_text(setup: BeamSetup, shape: tuple[int, int]) -> str:
    """Return width and height of an image of shape (H, W) at the object, such as "4 × 2 mm"."""
    pixel = setup.object_pixel_size
    unit_m, unit = length_unit(max(shape) * pixel)
    sides = " × ".join(f"{side * pixel / unit_m:.3g}" for side in reversed(shape))
    return f"{sides} {unit}"


def setup_cautions(
    setup: BeamSetup,
    shape: tuple[int, int] | None = None,
    metadata: Mapping[str, Any] = MappingProxyType({}),
    *,
    usual: UsualGeometry = UsualGeometry(),
) -> tuple[Caution, ...]:
    """Return a sentence for everything about a setup that no common experiment has.

    Without the shape of the image in px, the field of view is not checked. Its metadata may have
    the ``geometry`` in its file and the factor of its ``bin``.

    >>> from napari_shadowinv.physics.setup import ProtonSetup
    >>> lengths = {"source_object_distance": 0.28, "object_image_distance": 0.01}
    >>> (caution,) = setup_cautions(ProtonSetup(energy=14.7, pixel_size=1e-6, **lengths))
    >>> caution.text[:34]
    'setup: the magnification is 1.04: '
    """
    doubts = [*_pixel_doubts(setup, usual), *_distance_doubts(setup, shape, usual)]
    doubts += [*setup.probe_doubts(), *_file_doubts(setup, metadata, usual.file_deviation)]
    return tuple(Caution("setup", f"setup: {doubt}") for doubt in doubts)


def deflection_cautions(
    setup: BeamSetup, displacement: FloatArray, *, usual: UsualGeometry = UsualGeometry()
) -> tuple[Caution, ...]:
    """Warn of a displacement, (2, H, W) in px, that is larger than such an experiment can make."""
    largest = float(np.nanmax(np.hypot(*displacement), initial=0.0))
    angle, main = float(setup.deflection_angle(largest)), setup.main_field.name
    text = ""
    if angle > usual.deflection:
        text = (
            f"setup: the largest deflection is {angle:.3g} rad, and small angles (below "
            f"{usual.deflection:g}) are assumed: the field in SI units is not reliable; check "
            "the distances, the pixel size and their units"
        )
    elif main == "path_integrated_b":
        field = float(np.abs(setup.field_in_si(main, np.array([largest, 0.0]))).max())
        if field > usual.field:
            text = (
                f"setup: the path-integrated field reaches {field:.3g} T m, far more than any "
                "laboratory plasma has: check the energy (MeV), the distances and the pixel size"
            )
    return (Caution("setup", text),) if text else ()


def _file_doubts(setup: BeamSetup, metadata: Mapping[str, Any], deviation: float) -> Iterator[str]:
    """Compare the pixels with the file's, which may be of either plane."""
    geometry = metadata.get("geometry", {})
    names = ("pixel_size", "detector_pixel_size")
    stated = [geometry[name] * metadata.get("bin", 1) for name in names if geometry.get(name)]
    pairs = itertools.product(setup.pixel_sizes, stated)
    if stated and not any(abs(size / file - 1) < deviation for size, file in pairs):
        here, there = map(length_text, setup.pixel_sizes)
        yield (
            f"a pixel is {length_text(stated[0])} by the image's file, but {here} at the object "
            f"and {there} at the detector: all lengths scale with it; check it, unless a lens "
            "changes the size of the pixels"
        )


def _pixel_doubts(setup: BeamSetup, usual: UsualGeometry) -> Iterator[str]:
    pixel, (least, most) = setup.object_pixel_size, usual.pixels
    if not least <= pixel <= most:
        yield (
            f"a pixel is {length_text(pixel)} at the object, expected {length_text(least)} "
            f"to {length_text(most)}: all lengths and fields scale with it; it is given in m"
        )
    at_detector = setup.detector_pixel_size
    if at_detector is not None and setup.projects and at_detector < usual.detector_pixel:
        yield (
            f"a pixel is {length_text(at_detector)} at the detector, finer than films and plates "
            "are scanned: if this is its size at the object, give it as such"
        )


def _distance_doubts(
    setup: BeamSetup, shape: tuple[int, int] | None, usual: UsualGeometry
) -> Iterator[str]:
    to_object, to_detector = setup.source_object_distance, setup.object_image_distance
    least, most = usual.magnifications
    if setup.projects and setup.magnification < least and not setup.is_collimated:
        yield (
            f"the magnification is {setup.magnification:.3g}: the source is "
            f"{length_text(to_object)} from the object and the detector only "
            f"{length_text(to_detector)} behind it; check that the distances are not swapped, and "
            "that the first is from source to object, not to the detector"
        )
    elif setup.max_source_distance < to_object < math.inf:
        yield (
            f"the source is {length_text(to_object)} from the object, where small sources are "
            f"within {length_text(setup.max_source_distance)}: deflections scale with the "
            "distances; they are given in m"
        )
    if setup.magnification > most:
        yield (
            f"the magnification is {setup.magnification:.3g}: the source is "
            f"{length_text(to_object)} from the object and the detector "
            f"{length_text(to_detector)} behind it; both distances are given in m"
        )
    elif to_detector > usual.distance:
        yield (
            f"the detector is {length_text(to_detector)} behind the object: fields are too small "
            "by the factor by which that is too long; it is given in m"
        )
    nearest = min(to_object, to_detector)
    if shape is None or not (setup.projects or math.isfinite(to_object)):
        return  # light is often imaged from a plane close behind the object
    extent = max(shape) * setup.object_pixel_size
    if extent > nearest:
        yield (
            f"the field of view of {length_text(extent)} is wider than the {length_text(nearest)} "
            "between the object and source or detector, but rays near the axis are assumed: check "
            "the distances, and whether the pixel size is that at the object or at the detector"
        )
