"""Messages for a terminal: what files say, without control codes and of bounded length; times in words."""

import re

_MOST_ERROR_LENGTH = 2000


def plain(message: object, most: int = _MOST_ERROR_LENGTH) -> str:
    """A message for a terminal: control codes and what turns text around escaped, of bounded length."""
    text = re.sub(
        r"[\x00-\x09\x0b-\x1f\x7f-\x9f\u200e\u200f\u2028-\u202e\u2066-\u2069\ud800-\udfff]",
        lambda found: found[0].encode("unicode_escape").decode("ascii"),
        str(message),
    )
    return text if len(text) <= most else f"{text[: most - 1]}…"


def in_words(seconds: float) -> str:
    """A time, roughly: ``40 s``, ``12 min``, ``3.4 h``."""
    if seconds < 90:
        return f"{max(round(seconds, -1), 10):.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"
