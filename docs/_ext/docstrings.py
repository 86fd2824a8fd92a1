"""Reads this package's docstrings for Sphinx: plain ``Returns`` sections, and the keys of designs."""

import re

from numpy.typing import ArrayLike
from pydantic import BaseModel
from reference_pages import key_lines
from sphinx.util.typing import stringify_annotation

SECTION = "Returned"
_HEADING = re.compile(r"^\s*Returns\s*$")
_RULE = re.compile(r"^\s*-{3,}\s*$")
_ARRAY_LIKE = stringify_annotation(ArrayLike, "smart", short_literals=False)


def setup(app) -> dict:
    """Register the readers, ahead of napoleon's."""
    app.config.napoleon_custom_sections = [SECTION]
    app.connect("autodoc-process-docstring", _read_docstring, priority=400)
    app.connect("autodoc-process-signature", _read_signature)
    app.connect("autodoc-process-bases", _read_bases)
    app.connect("autodoc-skip-member", lambda app, what, name, *_: True if name == "model_config" else None)
    return {"parallel_read_safe": True}


def plain_returns(lines: list[str]) -> list[str]:
    """Rename a docstring's ``Returns`` section, unless it has the name-and-indent form.

    Parameters
    ----------
    lines
        Of a docstring whose sections have NumPy's headings.

    Returns
    -------
    The same lines, the section renamed to one that napoleon sets as sentences and not as types.
    """
    rules = [k for k in range(1, len(lines)) if _RULE.match(lines[k]) and lines[k - 1].strip()]
    for rule in rules:
        if not _HEADING.match(lines[rule - 1]):
            continue
        end = next((k - 1 for k in rules if k > rule), len(lines))
        body = lines[rule + 1 : end]
        if any(line.startswith(" ") for line in body) or not any(body):
            return lines
        return [*lines[: rule - 1], SECTION, "-" * len(SECTION), *body, *lines[end:]]
    return lines


def _is_design(obj: object) -> bool:
    return isinstance(obj, type) and issubclass(obj, BaseModel) and obj is not BaseModel


def _read_docstring(app, what, name, obj, options, lines: list[str]) -> None:
    keys = ["", *key_lines(obj), ""] if _is_design(obj) else []
    # an absolute value in a sentence is no substitution
    said = [line if "``" in line else line.replace("|", r"\|") for line in plain_returns(lines)]
    lines[:] = [*said, *keys]


def _read_signature(app, what, name, obj, options, signature, returned) -> tuple | None:
    """Designs are shown by their keys; ``ArrayLike`` by its name."""
    if _is_design(obj):
        return "", None
    if signature and _ARRAY_LIKE in signature:
        return signature.replace(_ARRAY_LIKE, "ArrayLike"), returned
    return None


def _read_bases(app, name, obj, options, bases: list) -> None:
    if _is_design(obj):
        bases[:] = ["frozen pydantic model"]
