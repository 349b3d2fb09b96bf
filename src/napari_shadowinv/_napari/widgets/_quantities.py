"""Numbers with units, as people write them: ``1.3 mm``, ``810 nm``, ``inf``.

- read what was typed: `parsed`
- show a number in a handy unit: `shown`
- which unit a field's title names: `unit_of_title`
"""

from __future__ import annotations

import math
import re

from napari_shadowinv.errors import InputError

__all__ = ["parsed", "shown", "unit_of_title"]

_TITLE = re.compile(r"^(?P<name>.*\S)\s*\((?P<unit>[^()]+)\)$")
_NUMBER = re.compile(
    r"^\s*(?P<number>[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)\s*(?P<unit>\S*)\s*$"
)
# Units that come with prefixes; a kilopixel helps nobody.
_PREFIXED = ("m", "eV", "MeV")


def unit_of_title(title: str) -> tuple[str, str]:
    """Split a title such as ``"Wavelength (m)"`` into its name and its unit.

    Examples
    --------
    >>> unit_of_title("Kinetic energy (MeV)")
    ('Kinetic energy', 'MeV')
    >>> unit_of_title("Floor")
    ('Floor', '')
    """
    match = _TITLE.match(title)
    return (match["name"], match["unit"]) if match else (title, "")


def parsed(text: str, unit: str) -> float:
    """Read a number, in the unit if it names none.

    Parameters
    ----------
    text : str
        What was typed.
    unit : str
        The unit of the result; empty for a plain number.

    Returns
    -------
    float

    Raises
    ------
    InputError
        If it is no number, or its unit is of another kind.

    Examples
    --------
    >>> parsed("1.3 mm", "m"), parsed("inf", "m"), parsed("1e-3", "")
    (0.0013, inf, 0.001)
    """
    if text.strip().lower() in ("inf", "infinite", "∞"):
        return math.inf
    match = _NUMBER.match(text)
    if match is None:
        raise InputError(f"{text!r} is not a number, expected {_example(unit)}")
    number = float(match["number"])
    if match["unit"] in ("", unit):
        return number
    return _converted(match["number"], match["unit"], unit)


def shown(value: float, unit: str) -> str:
    """Write a number with the prefix of its unit that makes it handy.

    Examples
    --------
    >>> shown(8.1e-7, "m"), shown(14.7, "MeV"), shown(0.001, "")
    ('810 nm', '14.7 MeV', '0.001')
    """
    if math.isinf(value) or not unit:
        return f"{value:.12g}"
    if unit not in _PREFIXED or value == 0:
        return f"{value:.12g} {unit}"
    import pint

    compact = pint.application_registry.Quantity(value, unit).to_compact()
    return f"{compact.magnitude:.12g} {compact.units:~P}"


def _converted(number: str, from_unit: str, to_unit: str) -> float:
    import pint

    # By the text of the number, so that 1.3 mm is 0.0013 m to the last digit.
    if not to_unit:
        raise InputError(f"{number} {from_unit} has a unit, expected a plain number")
    registry = pint.application_registry
    try:
        factor = registry.Quantity(1.0, from_unit).to(to_unit).magnitude
    except (pint.errors.PintError, AttributeError, ValueError):
        raise InputError(
            f"{number} {from_unit} cannot be converted to {to_unit}, expected {_example(to_unit)}"
        ) from None
    power = round(math.log10(factor)) if factor > 0 else 0
    if math.isclose(factor, 10.0**power, rel_tol=1e-9):
        mantissa, _, exponent = number.lower().partition("e")
        return float(f"{mantissa}e{int(exponent or 0) + power}")
    return float(number) * float(factor)


def _example(unit: str) -> str:
    examples = {"m": "something like 1.3 mm", "MeV": "something like 14.7 MeV"}
    return examples.get(unit, f"a number in {unit}" if unit else "a number")
