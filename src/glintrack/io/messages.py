"""Messages for a terminal: whatever a file says, without control codes and of bounded length."""

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
