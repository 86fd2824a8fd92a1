"""Unit of a key of a design, from the ending of its name; times and numbers as people write them."""

import math
import re
from collections.abc import Mapping

from glintrack.core.installation import read_data

_COMMA = re.compile(r"([-+]?\d+),(\d+)(?![\d.,])")
_WITH_UNIT = re.compile(r"[-+]?\d[\d.,]*\s*(?!e[-+]?\d+$)(?:[^\W\d_]\S{0,9}|[°%])", re.IGNORECASE)

_UNITS: Mapping[str, str] = read_data("words.toml")["units"]  # the first that a name ends in counts


def unit_of(name: str) -> str:
    """Return the unit that a key's name ends in; may be empty."""
    return next((unit for ending, unit in _UNITS.items() if name.endswith(ending)), "")


def format_duration(seconds: float) -> str:
    """Format a time to one or two digits: ``40 s``, ``12 min``, ``3.4 h``."""
    if seconds < 90:
        return f"{max(round(seconds, -1), 10):.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"


def number_hint(value: object) -> str:
    """Remedy for a number with a comma or a unit, such as " Write 3.45, with a point."; else empty."""
    text, hint = value.strip() if isinstance(value, str) else "", ""
    if found := _COMMA.match(text):
        thousands = f"{found[1]}{found[2]} or " if len(found[2]) == 3 else ""
        hint = f" Write {thousands}{found[1]}.{found[2]}, with a point."
    return f"{hint} Write the number without its unit." if _WITH_UNIT.fullmatch(text) else hint


def format_number(value: float, digits: int = 3) -> str:
    """Format a number to some significant digits, with thousands separators: ``1,110``, ``0.0797``."""
    if not math.isfinite(value) or abs(value) < 1e-6:
        return f"{value:.0f}"
    rounded = float(f"{value:.{digits - 1}e}")
    return f"{rounded:,.{max(digits - 1 - math.floor(math.log10(abs(rounded))), 0)}f}"
