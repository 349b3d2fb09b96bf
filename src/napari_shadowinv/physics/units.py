"""Units of fields: in datasets, and with prefixes whose numbers are handy to read.

- the field that an experimenter asks for: `shown_fields`; the potential: `shown_potential`
- their strongest points in words: `peak_facts`
- the grey limits of an image: `intensity_limits`
- the error of a largest value: `PeakError`
- the prefix for a number: `prefix_for`; whether a unit takes one: `takes_prefix`
- attributes of a variable of a dataset: `label`; the places:
  `place_coordinates`, `vector_coordinates`; units as figures print them: `display_unit`
- a variable as an array: `numbers_of`; a dataset that lacks one: `refuse_missing`

Units of datasets are spelled as pint parses them, because napari passes the units of an xarray's
coordinates on to it. For pint ``px`` is a length, 1/96 inch, and ``flux`` a femtolux.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from napari_shadowinv._typing import AnyArray, BoolArray, FloatArray
from napari_shadowinv.errors import InputError
from napari_shadowinv.facts import (
    Assessment,
    Fact,
    Verdict,
    percent,
    round_down,
    to_figures,
    with_error,
)
from napari_shadowinv.physics.arrays import PLANE

if TYPE_CHECKING:
    import xarray

    from napari_shadowinv.physics.setup import Setup


_PREFIXES = {-12: "p", -9: "n", -6: "µ", -3: "m", 0: "", 3: "k", 6: "M"}


def takes_prefix(unit: str) -> bool:
    """Return whether a unit of a field in SI units may have a prefix."""
    from napari_shadowinv.physics.setup import SETUPS  # imports scipy

    # The prefix of a power, such as m⁻², would be raised to that power.
    units = {field.unit for kind in SETUPS.values() for field in kind.si_fields}
    return unit in units and unit.replace(" ", "").isalpha()


def prefix_for(largest: float, allowed: Collection[int] = tuple(_PREFIXES)) -> tuple[float, str]:
    """Return the factor and the SI prefix that bring a value to 1 or more."""
    if not largest > 0 or not np.isfinite(largest):
        return 1.0, ""
    power = max((p for p in allowed if largest >= 10.0**p), default=min(allowed))
    return 10.0**-power, _PREFIXES[power]


# What limits a field, what to do, if known to that, and if off by that.
_CONDITIONS = {
    "beam": (
        "the beam (assumed {} uneven)",
        "record a reference",
        "the beam is even to {}",
        "it is {} uneven",
    ),
    "reference": (
        "the reference (assumed {} off)",
        "compare two references",
        "beam and reference agree to {}",
        "they differ by {}",
    ),
    "detector": (
        "the detector (assumed)",
        "state the instrument",
        "the detector is exact to {}",
        "it is off by {}",
    ),
    "beam and detector": (
        "beam and detector (assumed)",
        "record a reference, state the instrument",
        "beam and detector are exact to {}",
        "they are off by {}",
    ),
}


class Condition(NamedTuple):
    """Errors of a field that depend on an unmeasured quantity, as shares of the field."""

    agreement: str  # of what was not measured, that leaves the field determined
    difference: str  # that is assumed
    peak_if_exact: float
    peak_if_off: float
    field_if_off: float  # r.m.s.
    subject: str  # what was not measured, of `_CONDITIONS`

    @classmethod
    def within(
        cls,
        largest: float,
        rest: tuple[float, float],
        assumed: Collection[tuple[str, float, float, float]],
        *,
        subject: str,
    ) -> Condition | None:
        """Return the condition for a total error of the field (r.m.s.) of at most `largest`.

        `rest` are the errors of field and peak by all that was measured; `assumed` has the unit of
        each number that was not, the number, and the errors that it makes. None if no smaller
        numbers make the total as small.
        """
        allowed = largest**2 - rest[0] ** 2
        by_assumed = math.hypot(*(field for _, _, field, _ in assumed))
        if not (allowed > 0 and by_assumed > 0):
            return None
        units, sizes, _, peaks = zip(*assumed, strict=True)
        known = [round_down(size * min(math.sqrt(allowed) / by_assumed, 1.0)) for size in sizes]
        agreement, difference = (
            " and ".join(f"{to_figures(n)} {unit}" for n, unit in zip(numbers, units, strict=True))
            for numbers in (known, sizes)
        )
        reduced = np.multiply(peaks, known) / sizes
        at_peak = math.hypot(rest[1], *reduced), math.hypot(rest[1], *peaks)
        return cls(agreement, difference, *at_peak, math.hypot(rest[0], by_assumed), subject)


class PeakError(NamedTuple):
    """Total standard error of the largest value of a field."""

    share: float  # of that value
    cause: str  # the largest contribution


@dataclass(frozen=True)
class ShownField:
    """A vector field in the unit that it is shown in."""

    vectors: FloatArray  # (2, H, W)
    name: str
    symbol: str
    unit: str
    components: tuple[str, str]  # their symbols

    @property
    def magnitude(self) -> FloatArray:
        """Length of the vectors, shape (H, W); NaN where a mask hides the field."""
        return np.sqrt(np.sum(self.vectors**2, axis=0, dtype=np.float64))

    @property
    def largest(self) -> float:
        """Largest magnitude outside the mask."""
        return float(np.nanmax(self.magnitude))

    @property
    def peak(self) -> tuple[int, int]:
        """Row and column of the strongest point outside the mask."""
        row, column = np.unravel_index(np.nanargmax(self.magnitude), self.magnitude.shape)
        return int(row), int(column)

    def short_peak_text(self, error: PeakError | None = None) -> str:
        """Write the largest magnitude with its error."""
        share = error.share if error else 0.0
        return f"peak {self.symbol} {with_error(self.largest, share * self.largest)} {self.unit}"

    def conditional(self, condition: Condition) -> Assessment:
        """Return the assessment of the largest magnitude, whose error rests on an assumption."""
        limit, remedy, exact, off = _CONDITIONS[condition.subject]
        is_detector = condition.subject == "detector"
        peak = self.short_peak_text(PeakError(condition.peak_if_exact, ""))
        return Assessment(
            Verdict.DETECTOR if is_detector else Verdict.CONDITIONAL,
            f"limited by {limit.format(condition.difference)}",
            f"{remedy} for ± {to_figures(condition.peak_if_exact * self.largest)}",
            f"{peak} if {exact.format(condition.agreement)}; "
            f"± {to_figures(condition.peak_if_off * self.largest)} "
            f"(field {percent(condition.field_if_off)}) "
            f"if {off.format(condition.difference)} (assumed)",
        )

    def peak_text(self, error: PeakError | None = None) -> str:
        """Write the largest magnitude, path-integrated fields also in MG·µm."""
        share, cause = (error.share, error.cause) if error else (0.0, "")
        text = self.short_peak_text(error)
        if self.unit.endswith("T·m"):
            prefix = self.unit.removesuffix("T·m")
            power = next(power for power, name in _PREFIXES.items() if name == prefix)
            size = self.largest * 10.0**power / 1e-4
            text += f" ({with_error(size, share * size)} MG·µm)"
        return f"{text} ({cause})" if cause else text


def shown_fields(
    displacements: Collection[FloatArray],
    setup: Setup | None,
    deflector: str | None = None,
    *,
    mask: BoolArray | None = None,
) -> list[ShownField]:
    """Convert displacements in px to the field of interest, in one unit for all.

    It is the main field of the setup's kind: the path-integrated magnetic field of particles, or
    the deflection angle of light; without a setup, the displacement in px. For another
    `deflector`, such as an "electric field", it is the path integral of that field.
    Outside a `mask` of used pixels, shape (H, W), the fields are NaN.
    """
    if mask is not None and not mask.all():
        displacements = [np.where(mask, d, np.nan) for d in displacements]
    if setup is None:
        return [ShownField(d, "Displacement", "|d|", "px", ("dy", "dx")) for d in displacements]
    main = setup.other_fields.get(deflector or "", setup.main_field)
    (unit,) = (field.unit for field in setup.si_fields if field.name == main.name)
    fields = [setup.field_in_si(main.name, d) for d in displacements]
    factor, prefix = prefix_for(max(float(np.nanmax(np.hypot(*field))) for field in fields))
    unit = prefix + unit.replace(" ", "·")
    return [
        ShownField(field * factor, main.title, main.symbol, unit, main.components)
        for field in fields
    ]


def peak_facts(
    displacement: FloatArray,
    setup: Setup | None,
    deflector: str | None = None,
    *,
    mask: BoolArray | None = None,
    error: PeakError | None = None,
    field_error: PeakError | None = None,
) -> list[Fact]:
    """Return the strongest point of a field, whose displacement is in px, as facts.

    A setup adds the main field in SI units, or that of a deflector, see `shown_fields`; a mask, (H,
    W), has the pixels that count. The errors are the standard errors of the peak, and of the peak
    in SI units if that differs.
    """
    (pixels,) = shown_fields([displacement], None, mask=mask)
    row, column = pixels.peak
    text = f"{pixels.peak_text(error)}, at y = {row}, x = {column} px"
    if setup is None:
        return [Fact("displacement", "Displacement", text)]
    (field,) = shown_fields([displacement], setup, deflector, mask=mask)
    of_field = field_error or error
    return [
        Fact("field", "Field", field.peak_text(of_field)),
        Fact("displacement", "Displacement", text, is_detail=True),
    ]


def shown_potential(potential: FloatArray, setup: Setup | None) -> tuple[FloatArray, str]:
    """Turn a potential in px² into a handy unit, and name the unit."""
    if setup is None:
        return potential, "px²"
    metres = setup.potential(potential)
    factor, prefix = prefix_for(float(np.nanmax(np.abs(metres))))
    return metres * factor, f"{prefix}m"


def intensity_limits(
    image: AnyArray, *, ends: Sequence[float] = (0.1, 99.7), peak: float = 3.5, shade: float = 0.3
) -> tuple[float, float]:
    """Return grey limits of an image that a caustic's few bright pixels cannot spoil.

    They are the percentiles `ends` of darkest and brightest pixels, of a sample if the image is
    large. The lower limit is 0, unless the image has negative pixels or all of it is brighter than
    a `shade` of the upper limit, which is at most `peak` times the mean.
    """
    step = max(1, int(np.sqrt(image.size / 100_000)))
    sample = np.asarray(image[::step, ::step])
    finite = sample[np.isfinite(sample)]
    if not finite.size:
        return 0.0, 1.0
    dark, bright = (float(value) for value in np.percentile(finite, ends))
    mean = float(finite.mean())
    high = min(bright, peak * mean) if mean > 0 else bright
    low = 0.0 if 0 <= dark < shade * high else dark
    return (low, high) if high > low else (low, low + 1.0)


PIXEL = "pixel"
PIXEL_AREA = "pixel**2"
FLUX_DENSITY = "1/pixel**2"


def label(units: str, long_name: str) -> dict[str, str]:
    """Return the attributes of a variable."""
    return {"units": units, "long_name": long_name}


def place_coordinates(
    shape: tuple[int, ...], pixel_size: float | None, plane: str = "object plane"
) -> dict[str, Any]:
    """Return y and x of the pixels in metres, or their indices if their size is unknown.

    A pixel has its size in a plane, whose name is in the long names.
    """
    size, unit = (1.0, PIXEL) if pixel_size is None else (pixel_size, "m")
    return {
        name: (name, size * np.arange(count), label(unit, f"{name} in the {plane}"))
        for name, count in zip(PLANE, shape, strict=True)
    }


def vector_coordinates(shape: tuple[int, ...], pixel_size: float | None) -> dict[str, Any]:
    """Return the components of vectors, with the `place_coordinates` of the object plane."""
    components = "component", ["y", "x"], label("1", "Component of a vector")
    return {"component": components, **place_coordinates(shape, pixel_size)}


def display_unit(units: str) -> str:
    """Return the attribute ``units`` as figures print it: px² for ``pixel**2``."""
    return units.replace("**2", "²").replace("pixel", "px")


def refuse_missing(
    dataset: xarray.Dataset, content: str, variables: Iterable[str], attributes: Iterable[str] = ()
) -> None:
    """Raise an `InputError` if a dataset lacks variables or attributes that its content needs."""
    missing = [name for name in variables if name not in dataset]
    missing += [name for name in attributes if name not in dataset.attrs]
    if missing:
        raise InputError(f"dataset has no {', '.join(map(repr, missing))}: expected the {content}")


def numbers_of(dataset: xarray.Dataset, name: str) -> AnyArray:
    """Return a variable of a result as an array; a `ValueError` if it holds no numbers."""
    values = np.ascontiguousarray(dataset[name].values)
    if values.dtype.kind not in "buif":
        raise ValueError(f"{name} holds {values.dtype} values, expected numbers")
    return values
