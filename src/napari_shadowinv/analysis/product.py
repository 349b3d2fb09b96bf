"""The base class of all products, and descriptions of their numbers: `Product`, `Measurand`.

- a number with its bands in words: `quantity_text`, `value_text`
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar, Self

import numpy as np
from pydantic import Field

from napari_shadowinv._system.progress import Reporter
from napari_shadowinv._typing import AnyArray, FloatArray
from napari_shadowinv.analysis.frame import FIELD_UNITS, FieldFrame
from napari_shadowinv.cautions import Caution
from napari_shadowinv.errors import InputError
from napari_shadowinv.facts import Fact, decimals_of, percent, power_of_ten
from napari_shadowinv.inversion.error_bars import Quantity
from napari_shadowinv.physics.units import PIXEL, display_unit, prefix_for
from napari_shadowinv.preprocessing.steps import Choice

Values = dict[str, FloatArray]
"""Values, or errors of values, by the names of a product's variables."""

BANDS = 0.68, 0.95
"""Shares of probability of the bands that files, tables and figures have."""

_NO_PREFIX = ("", "1", PIXEL, "m⁻²", "m⁻³")


@dataclass(frozen=True)
class Measurand:
    """Number, or array of numbers, of a product."""

    dims: tuple[str, ...]  # names of its axes; empty for a number, "y" and "x" for a map
    unit: str  # of its values; those in the frame's `si_unit` are shown in its `unit`
    long_name: str  # in words
    title: str = ""  # in a few words, for tables. Default: its name


@dataclass(frozen=True, eq=False)
class Coordinate:
    """Places along an axis of a product: values, unit and name in words."""

    values: AnyArray
    unit: str
    long_name: str

    @classmethod
    def in_plane(cls, pixels: AnyArray, frame: FieldFrame, long_name: str) -> Coordinate:
        """Return places, given in px, as lengths in the object plane."""
        return cls(frame.length(1.0) * pixels, frame.length_unit, long_name)


@dataclass(frozen=True, eq=False)
class FieldNoise:
    """A few random errors of a field, from which a product chooses its smoothing."""

    potentials: FloatArray  # (k, H, W), changes of the potential in px² by noise and instrument
    spacing: float = 0.0  # of the sites in px; 0 for a field without sites
    of_pixels: bool = False  # whether the sites' cells of the source are the pixels
    report: Reporter = dataclasses.field(default_factory=Reporter)  # for choices that take long


class Product(Choice):
    """A quantity that is computed from a retrieved field.

    A subclass names itself in a field ``product: Literal["…"]``, has its choices as fields, and
    defines `variables`, `measure` and, for arrays, `coordinates`.
    """

    key = "product"
    # Keys of the fields that it can be computed from, such as "path_integrated_b"; empty for any.
    fields: ClassVar[tuple[str, ...]] = ()
    reference: ClassVar[str] = ""  # literature and equation
    # Variables that are recorded and not retrieved, such as the image's intensity.
    recorded: ClassVar[tuple[str, ...]] = ()
    # Variables that are a maximum over places.
    maxima: ClassVar[tuple[str, ...]] = ()
    # Whether `measure` already corrects the mean effect of noise, so that bands need not.
    subtracts_noise: ClassVar[bool] = False
    # Of several variables along an axis, those that figures show; empty for all.
    curves: ClassVar[tuple[str, ...]] = ()
    is_logarithmic: ClassVar[bool] = False  # whether their axes are
    # Variables that are places or lengths in the object plane and do not grow with the field.
    lengths: ClassVar[tuple[str, ...]] = ()
    reading: ClassVar[tuple[str, ...]] = ()  # how it always has to be read, in sentences

    label: str = Field(
        default="",
        max_length=60,
        pattern=r"^[\w .()+-]*$",
        description="Name in files and figures. Default: that of the product.",
    )

    def check(self, frame: FieldFrame) -> None:
        """Raise an `InputError` if the product cannot be measured in a frame."""
        if self.is_defined_for(frame.unit.field):
            return
        if frame.setup is None:
            raise InputError(
                f"{self.title} needs the setup of the experiment, and the result has none: give it "
                "to the inversion"
            )
        units = ", ".join(unit.symbol for unit in FIELD_UNITS.values() if unit.field in self.fields)
        raise InputError(
            f"{self.title} is not defined for a field in {frame.unit.symbol}: choose one of "
            f"{units} as the unit"
        )

    def is_defined_for(self, field: str) -> bool:
        """Return whether it can be computed from a field, such as "path_integrated_b"."""
        return not self.fields or field in self.fields

    def adapt(self, potential: FloatArray, noise: FieldNoise | None, frame: FieldFrame) -> Self:
        """Return the product with the choices that follow from the noise of the field.

        Parameters
        ----------
        potential : ndarray, shape (H, W)
            In px².
        noise : FieldNoise or None
            None if it is not known.
        frame : FieldFrame
        """
        return self

    def variables(self, frame: FieldFrame) -> dict[str, Measurand]:
        """Describe the numbers that `measure` and `constants` return."""
        raise NotImplementedError

    def coordinates(self, frame: FieldFrame) -> dict[str, Coordinate]:
        """Return the places along the axes of the variables, by the names of the axes."""
        return {}

    def measure(self, potential: FloatArray, displacement: FloatArray, frame: FieldFrame) -> Values:
        """Compute the product of a field in SI units.

        It must not change its arguments: several threads call it at once, for many samples.

        Parameters
        ----------
        potential : ndarray, shape (H, W)
            In px².
        displacement : ndarray, shape (2, H, W)
            In px.
        frame : FieldFrame
        """
        raise NotImplementedError

    def constants(self, frame: FieldFrame) -> Values:
        """Return variables that do not depend on the field, such as the recorded intensity."""
        return {}

    def systematic(
        self, potential: FloatArray, displacement: FloatArray, frame: FieldFrame
    ) -> Values:
        """Return likely errors by the product's own method, such as its smoothing.

        They widen the bands of the variables that they name.
        """
        return {}

    def refine(self, quantities: dict[str, Quantity]) -> dict[str, Quantity]:
        """Return the quantities with errors derived from other quantities. Default: as they are.

        Parameters
        ----------
        quantities : dict of str to Quantity
            All that `measure` returns, with samples if the errors of the field are known.
        """
        return quantities

    def facts(self, quantities: Mapping[str, Quantity], frame: FieldFrame) -> Iterable[Fact]:
        """Return the product in words. Default: each number, and the peak of each array."""
        for name, variable in self.variables(frame).items():
            quantity = quantities[name]
            title = variable.title or name.replace("_", " ")
            if variable.dims:
                quantity, title = at_peak(quantity), f"largest {title}"
            text = quantity_text(quantity, variable.unit, frame)
            yield Fact(name, f"{title[:1].upper()}{title[1:]}", text, short=text)

    def cautions(self, quantities: Mapping[str, Quantity], frame: FieldFrame) -> Iterable[Caution]:
        """Return reasons to doubt the product."""
        return ()

    def remarks(self, frame: FieldFrame) -> Iterable[str]:
        """Return how the product has to be read, in sentences. Default: `reading`."""
        return self.reading


def at_peak(quantity: Quantity) -> Quantity:
    """Return an array's quantity at the place where its magnitude is largest."""
    place = int(np.nanargmax(np.abs(quantity.value)))
    samples = quantity.samples.reshape(len(quantity.samples), quantity.value.size)
    return Quantity(np.asarray(quantity.value.ravel()[place]), samples[:, place])


def mask_cautions(
    points: AnyArray, frame: FieldFrame, name: str, *, notable: float = 0.02
) -> list[Caution]:
    """Warn if a notable share of points (n, 2) lies at masked pixels."""
    rows, columns = (
        np.clip(np.rint(points[:, axis]).astype(int), 0, frame.shape[axis] - 1) for axis in (0, 1)
    )
    share = 1 - float(frame.mask[rows, columns].mean())
    if share <= notable:
        return []
    text = (
        f"{percent(share)} of {name} is at masked pixels, where the field is only a smooth "
        "continuation"
    )
    return [Caution("mask", text)]


def has_bands(quantity: Quantity) -> bool:
    """Return whether a quantity has samples for a band."""
    return len(quantity.samples) >= 2


def shown_unit(unit: str, frame: FieldFrame, largest: float) -> tuple[float, str]:
    """Return the factor from a unit of a dataset to a handy one, and the unit's name."""
    if unit == frame.si_unit and frame.unit.size != 1:
        return 1 / frame.unit.size, frame.unit.symbol
    power, text = power_of_ten(largest)
    if text and (unit == "1" or (power > 0 and not unit.isascii())):
        return 10.0**-power, text if unit == "1" else f"{text} {unit}"
    if unit in _NO_PREFIX or not unit.isascii() or PIXEL in unit:
        return 1.0, display_unit(unit).replace("1", "") if unit == "1" else display_unit(unit)
    factor, prefix = prefix_for(largest)
    return factor, f"{prefix}{unit}"


def corrected(quantity: Quantity, *, notable: float = 0.3) -> FloatArray:
    """Return values without the bias by noise, where it is a notable part of their errors."""
    if not has_bands(quantity):
        return quantity.value
    is_biased = np.abs(quantity.bias) > notable * quantity.std
    return np.asarray(quantity.value - np.where(is_biased, quantity.bias, 0.0))


def quantity_text(quantity: Quantity, unit: str, frame: FieldFrame) -> str:
    """Return a number, corrected for a bias by noise, with its bands in words; "none" for NaN."""
    value = float(corrected(quantity))
    if np.isnan(value):
        return "none"
    bands = [quantity.band(share) for share in BANDS] if has_bands(quantity) else []
    ends = [tuple(float(end) for end in band) for band in bands]
    largest = max(map(abs, filter(math.isfinite, (value, *itertools.chain(*ends)))), default=0.0)
    factor, name = shown_unit(unit, frame, largest)
    return value_text(factor * value, [tuple(factor * end for end in band) for band in ends], name)


def value_text(value: float, ends: Sequence[tuple[float, ...]], unit: str) -> str:
    """Return a number with the ends of its bands, to two figures of the narrowest.

    >>> value_text(97.13, [(95.2, 99.1), (93.4, 101.0)], "T m")
    '97.1 T m (95.2 to 99.1; 95 %: 93.4 to 101.0)'
    """
    unit = f" {unit}" if unit else ""
    width = (ends[0][1] - ends[0][0]) / 2 if ends else 0.0
    if not (width > 0 and np.isfinite(width)):
        return f"{value:.4g}{unit}"
    decimals = decimals_of(width)
    bands = [f"{low:.{decimals}f} to {high:.{decimals}f}" for low, high in ends]
    shares = ("", *(f"{share:.0%} ".replace("%", " %:") for share in BANDS[1:]))
    listed = "; ".join(f"{share}{band}" for share, band in zip(shares, bands, strict=True))
    return f"{value:.{decimals}f}{unit} ({listed})"
