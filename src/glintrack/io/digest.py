"""One hash for names of cached files, keys of cases and checksums: SHA-256."""

import hashlib
from collections.abc import Iterable


def content_hash(parts: str | bytes | Iterable[str | bytes], digits: int = 64) -> str:
    """Leading hexadecimal digits of the SHA-256 of parts one after another; text as UTF-8."""
    found = hashlib.sha256()
    for part in (parts,) if isinstance(parts, str | bytes) else parts:
        found.update(part.encode() if isinstance(part, str) else part)
    return found.hexdigest()[:digits]
