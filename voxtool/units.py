"""Units of length: how many of one another is."""

from __future__ import annotations

from fractions import Fraction

from voxtool.choices import NANOMETRES

LENGTHS = {"nm": 1, **NANOMETRES}
# Names that other programs and formats have for units.
NAMES = {
    "nm": ("nanometer", "nanometers"),
    "um": ("µm", "μm", "micron", "microns", "micrometer", "micrometers"),
    "mm": ("millimeter", "millimeters"),
    "cm": ("centimeter", "centimeters"),
    "m": ("meter", "meters"),
    "in": ("inch", "inches"),
    "ft": ("foot", "feet"),
}
SHORT = {long: short for short, names in NAMES.items() for long in names}


def factor(units: str, into: str) -> Fraction:
    """Return how many of the unit `into` one of `units` is; 1 if one of them is not known, as of
    images that count pixels."""
    one, other = (LENGTHS.get(SHORT.get(unit, unit), 0) for unit in (units, into))
    return Fraction(one, other) if one and other else Fraction(1)


def difference(units: str, other: str, hint: str) -> str:
    """Return the message for two things, in these units, that have to be in one; "" if they are,
    or if one of them states no unit."""
    if not units or not other or SHORT.get(units, units) == SHORT.get(other, other):
        return ""
    if (ratio := factor(units, other)) == 1:
        return f"in {units} and in {other}: {hint}"
    larger, smaller = (units, other) if ratio > 1 else (other, units)
    count = f"{float(max(ratio, 1 / ratio)):.12g}"
    return f"in {units} and in {other}: 1 {larger} is {count} {smaller}: {hint}"
