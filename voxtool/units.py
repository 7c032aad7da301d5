"""Units of length: how many of one another is."""

from __future__ import annotations

from fractions import Fraction

from voxtool.choices import LENGTH_UNITS, NANOMETRES
from voxtool.errors import VoxtoolError

# Names that other programs and formats have for units.
NAMES = {
    "um": ("µm", "μm", "micron", "microns", "micrometer", "micrometers"),
    "mm": ("millimeter", "millimeters"),
    "cm": ("centimeter", "centimeters"),
    "m": ("meter", "meters"),
    "in": ("inch", "inches"),
    "ft": ("foot", "feet"),
}
SHORT = {long: short for short, names in NAMES.items() for long in names}


def factor(units: str, into: str) -> Fraction:
    """Return how many of the unit `into` one of `units` is; 1 if one of them is not known ("").

    Raises
    ------
    VoxtoolError
        If they differ, and one of them is no unit of length.
    """
    if not units or not into or units == into:
        return Fraction(1)
    for unit in (units, into):
        if SHORT.get(unit, unit) not in NANOMETRES:
            raise VoxtoolError(
                f"units {units!r} and {into!r} differ, and {unit!r} is none of "
                f"{', '.join(LENGTH_UNITS)}: say what the numbers mean with --units and --scale"
            )
    return Fraction(*(NANOMETRES[SHORT.get(unit, unit)] for unit in (units, into)))


def difference(units: str, other: str, hint: str) -> str:
    """Return the message for two things, in these units, that have to be in one; "" if they are,
    or if the units of one are not known."""
    if (ratio := factor(units, other)) == 1:
        return ""
    larger, smaller = (units, other) if ratio > 1 else (other, units)
    count = f"{float(max(ratio, 1 / ratio)):.12g}"
    return f"in {units} and in {other}: 1 {larger} is {count} {smaller}: {hint}"
