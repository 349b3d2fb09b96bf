"""Numbers with units in text, such as ``"14.7 MeV"`` in a TOML file."""

from __future__ import annotations

import re

_QUANTITY = re.compile(r"([+-]?(?:\d+\.?\d*|\.\d+))(?:[eE]([+-]?\d+))?\s*([^\W\d_]+)")
_UNIT_IN_TITLE = re.compile(r"\(([^()]+)\)$")
_POWERS = {"f": -15, "p": -12, "n": -9, "µ": -6, "μ": -6, "u": -6, "m": -3, "c": -2, "": 0}
_POWERS |= {"k": 3, "M": 6, "G": 9, "T": 12}
_BASES = ("eV", "m")
_EXAMPLES = {"m": "1.3 mm", "MeV": "14.7 MeV"}


def unit_in_title(title: str | None) -> str:
    """Return the unit in a title such as ``"Wavelength (m)"``; empty if there is none."""
    match = _UNIT_IN_TITLE.search(title or "")
    return match[1] if match else ""


def takes_prefixes(unit: str) -> bool:
    """Return whether numbers in a unit may be given with another prefix: in mm instead of m."""
    return any(unit.removesuffix(base) in _POWERS for base in _BASES if unit.endswith(base))


def number_in_unit(text: str, unit: str) -> float:
    """Read a number with a unit, exact to the last digit.

    Parameters
    ----------
    text : str
        Such as ``"1.3 mm"``.
    unit : str
        Unit of the answer that `takes_prefixes`, such as "m" or "MeV".

    Raises
    ------
    ValueError
        If the text is no number, or its unit does not measure the same.
    """
    base = next(base for base in _BASES if unit.endswith(base))
    match = _QUANTITY.fullmatch(text.strip())
    example = _EXAMPLES.get(unit, f"8 {unit}")
    expected = f"expected a number in {unit}, or one with a unit such as '{example}'"
    if match is None:
        raise ValueError(expected)
    digits, exponent, name = match.groups()
    prefix = name.removesuffix(base)
    if not name.endswith(base) or prefix not in _POWERS:
        raise ValueError(f"the unit '{name}' cannot be converted to {unit}; {expected}")
    power = int(exponent or 0) + _POWERS[prefix] - _POWERS[unit.removesuffix(base)]
    return float(f"{digits}e{power}")
